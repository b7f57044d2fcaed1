"""The daemon as a real process on the software rig, over its Unix socket: what clients do, and what they can't."""

import asyncio
import contextlib
import fcntl
import json
import os
import signal
import socket
import stat
import subprocess
import sys
import time
from pathlib import Path

import pytest
import websockets

from stagectl.client import Client
from stagectl.errors import LinkError, RequestError
from stagectl.record import read_run
from stagectl.ring import writer_alive
from stagectl.service import messages
from stagectl.service.access import read_tokens
from stagectl.service.admission import CONNECTIONS_LIMIT
from tests.service.daemon import REST_M_PER_S, Daemon

# httpcore leaves the socket of a Unix connection that is refused (of a killed service) to the garbage collector.
pytestmark = [
    pytest.mark.real_time,
    pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning"),
]


def move_away(client: Client) -> None:
    """Home where that is needed, arm, and begin a long slow way.

    At full speed it was over in 0.6 s, and on a busy host before anybody had seen it move.
    """
    if not client.status().homed:
        client.home()
    if client.status().state == "idle":
        client.arm()
    at_m = client.status().positions.end_position_m
    assert at_m is not None
    segment = messages.Segment(target_m=-0.14 if at_m > 0.0 else 0.14, velocity_m_per_s=0.1)
    client.begin("scan", messages.Scan(segments=[segment]))


def test_a_service_that_is_ended_while_it_begins_ends(tmp_path):
    """The signal was swallowed, and the service worked on."""
    folder = tmp_path / "run"
    folder.mkdir()
    descriptor = os.open(folder, os.O_RDONLY)
    fcntl.flock(descriptor, fcntl.LOCK_EX)  # it waits here, for a while
    command = [sys.executable, "-m", "stagectl.cli", "serve", "single-axis", "--backend", "rig", "--json"]
    command += ["--socket", str(folder / "s"), "--state", str(tmp_path / "state"), "--runs", str(tmp_path / "runs")]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        until_s = time.monotonic() + 30.0
        while not (tmp_path / "state").exists() and time.monotonic() < until_s:  # its signals are its own by then
            time.sleep(0.01)
        process.terminate()
        time.sleep(0.2)
        os.close(descriptor)
        out, err = process.communicate(timeout=30.0)
    finally:
        process.kill()
    assert (process.returncode, json.loads(out)["exit_code"]) == (0, 0), err
    assert "idle" not in err


def test_a_client_homes_moves_and_jogs(idle):
    client = idle.client
    with client.lease("anna"):
        homed = client.home()
        assert (homed.state, homed.stop) == ("done", "FINISHED")
        client.arm()
        assert client.move(0.02).stop == "FINISHED"
        assert idle.plant["macro_position_m"] == pytest.approx(
            client.status().positions.macro_position_m, abs=5e-3
        )  # the rig's zero is its own
        before_m = client.status().positions.end_position_m
        until_s = time.monotonic() + 1.5
        command = client.begin_jog(hold_s=0.5)
        while time.monotonic() < until_s:
            client.jog_at(command.key, 0.02, hold_s=0.5)
            time.sleep(0.1)
        assert client.command(command.key, 5.0).stop == "FINISHED"  # the key was let go of
        after_m = client.status().positions.end_position_m
        assert 0.005 < after_m - before_m < 0.05
        assert client.status().state == "armed"
    idle.state_is("idle")


def test_one_operator_at_a_time(idle):
    client, other = idle.client, Client(idle.socket)
    with client.lease("anna"), other:
        with pytest.raises(RequestError, match=r"anna holds the lease for .* one operator at a time"):
            other.take_lease("bert")
        other.lease_token = "guessed"
        for ask in (lambda: other.move(0.0), other.arm, other.home, other.renew_lease, other.give_lease_back):
            with pytest.raises(RequestError, match="not the lease that anna holds"):
                ask()


def test_anybody_may_stop(idle):
    client = idle.client
    with client.lease("anna"):
        move_away(client)
        idle.until(lambda: abs(idle.plant["macro_velocity_m_per_s"]) > 0.05, "speed")
        with Client(idle.socket) as other:
            other.stop()
        idle.state_is("idle")
        assert abs(idle.plant["macro_velocity_m_per_s"]) < REST_M_PER_S
        assert client.status().fault is None


def test_a_client_that_vanishes_stops_the_stage(idle):
    with Client(idle.socket) as vanishing:
        vanishing.take_lease("ghost", duration_s=3.0)
        renewed = vanishing.renew_lease()
        if not idle.client.status().homed:
            pytest.skip("needs the homing of the first test")
        vanishing.arm()
        vanishing.renew_lease()
        move_away(vanishing)
        assert renewed.holder == "ghost"
    idle.state_is("fault")
    fault = idle.client.fault()
    assert fault.kind == "LEASE"
    assert abs(idle.plant["macro_velocity_m_per_s"]) < REST_M_PER_S


HOSTILE = [
    ("POST", "/v1/move", b'{"target_m": NaN}', 422),
    ("POST", "/v1/move", b'{"target_m": 1e999}', 422),
    ("POST", "/v1/move", b'{"target_m": "0.1"}', 422),
    ("POST", "/v1/move", b'{"target_m": 0.1, "speed": 3}', 422),
    ("POST", "/v1/move", b"[" * 10_000, 400),
    ("POST", "/v1/move", b"\xff\xfe", 422),
    ("POST", "/v1/move", b'{"target_m": 0.1}' + b" " * 100_000, 413),
    ("PUT", "/v1/jogging/jog-1", b'{"velocity_m_per_s": 0.1, "hold_s": 1e9}', 422),
    ("POST", "/v1/backend", b'{"backend": "plant"}', 422),
    ("POST", "/v1/lease", b'{"holder": "a\\u0000b"}', 422),
    ("GET", "/v1/commands/%2e%2e%2fstatus", b"", 404),
    ("GET", "/v1/commands/none?wait_s=nan", b"", 422),
    ("GET", "/v1/../../etc/passwd", b"", 404),
    ("PATCH", "/v1/status", b"", 405),
]


@pytest.mark.parametrize(("method", "path", "body", "code"), HOSTILE)
def test_hostile_requests_are_refused(idle, method, path, body, code):
    before = idle.plant["macro_position_m"]
    with idle.client.lease("mallory"):
        headers = {"Stagectl-Lease": idle.client.lease_token, "Content-Type": "application/json"}
        answer = idle.client._http.request(method, path, content=body, headers=headers)
    assert answer.status_code == code
    assert messages.Failure.model_validate(answer.json()).message
    assert idle.client.status().state == "idle"
    assert idle.plant["macro_position_m"] == pytest.approx(before, abs=1e-4)


def test_tcp_needs_a_token_and_its_role(idle):
    tokens = read_tokens(idle.state / "tokens")
    assert stat.S_IMODE((idle.state / "tokens").stat().st_mode) == 0o600
    port = idle.tcp_port
    for token in ("", "wrong" * 8):
        with Client(tcp_port=port, token=token) as nobody:
            for ask in (nobody.status, nobody.stop, nobody.metrics, lambda: nobody.take_lease("x")):
                with pytest.raises(RequestError, match="a token is needed"):
                    ask()
    with Client(tcp_port=port, token=tokens["observe"]) as watcher:
        assert watcher.status().state == "idle"
        for ask in (watcher.stop, lambda: watcher.take_lease("x"), watcher.home):
            with pytest.raises(RequestError, match="may observe only"):
                ask()
    with Client(tcp_port=port, token=tokens["operate"]) as operator:
        operator.take_lease("x")
        operator.give_lease_back()


def test_no_crowd_on_a_port_keeps_the_lease_s_holder_out(idle):
    tokens = read_tokens(idle.state / "tokens")
    with Client(tcp_port=idle.tcp_port, token=tokens["operate"]) as operator, contextlib.ExitStack() as crowd:
        operator.take_lease("x", 30.0)
        for _ in range(CONNECTIONS_LIMIT + 10):
            crowd.enter_context(socket.create_connection(("127.0.0.1", idle.tcp_port)))
        with Client(tcp_port=idle.tcp_port, token=tokens["observe"]) as watcher:
            with pytest.raises(RequestError, match="connections are open, the limit"):
                watcher.status()
            assert idle.client.status().state == "idle"  # the socket's own clients are counted apart
        operator.renew_lease()
        operator.give_lease_back()


def test_the_stream_carries_status_and_samples(idle):
    async def listen():
        async with websockets.unix_connect(str(idle.socket), "ws://stagectl/v1/stream?rate_hz=20") as stream:
            return [json.loads(await stream.recv()) for _ in range(5)]

    heard = asyncio.run(listen())
    assert heard[-1]["status"]["state"] == "idle"
    columns = heard[-1]["samples"]["columns"]
    rows = [row for message in heard for row in message["samples"]["rows"]]
    assert rows
    times_s = [row[columns.index("t_s")] for row in rows]
    assert times_s == sorted(set(times_s))

    async def without_token():
        async with websockets.connect(f"ws://127.0.0.1:{idle.tcp_port}/v1/stream"):
            pass

    with pytest.raises(websockets.InvalidStatus):
        asyncio.run(without_token())


def test_systemd_is_told_and_the_watchdog_follows_the_servo(daemon):
    said = daemon.heard()
    assert any(note.startswith("READY=1") for note in said)
    daemon.until(lambda: "WATCHDOG=1" in daemon.heard(), "a fed watchdog")


def test_the_document_is_served(daemon):
    answer = daemon.client._http.get("/openapi.json").json()
    assert {"/v1/status", "/v1/move", "/v1/stop", "/v1/lease"} <= set(answer["paths"])
    assert stat.S_IMODE(daemon.socket.stat().st_mode) == 0o660
    assert "stagectl_cycle_lateness_seconds_bucket" in daemon.client.metrics()


def test_sigterm_in_mid_motion_brings_the_stage_to_rest_and_closes_the_run(tmp_path):
    daemon = Daemon(tmp_path)
    try:
        daemon.state_is("idle")
        client = daemon.client
        with client.lease("anna"):
            move_away(client)
            daemon.until(lambda: abs(daemon.plant["macro_velocity_m_per_s"]) > 0.05, "speed")
            daemon.process.terminate()
            assert daemon.process.wait(30.0) == 0
        (folder,) = daemon.runs.glob("*-service-arm")
        run = read_run(folder)
        assert run.manifest["record"]["state"] == "closed"
        assert run.manifest["banner"].startswith("SOFTWARE RIG")
        assert abs(run.rows["macro_position_m"][-1] - run.rows["macro_position_m"][-50]) < 50e-3 * REST_M_PER_S
        assert not daemon.socket.exists()
    finally:
        daemon.end()


def test_kill_9_of_the_daemon_stops_the_stage_and_loses_no_row(tmp_path):
    daemon = Daemon(tmp_path)
    try:
        daemon.state_is("idle")
        with daemon.client.lease("anna"):
            move_away(daemon.client)
            daemon.until(lambda: abs(daemon.plant["macro_velocity_m_per_s"]) > 0.05, "speed")
            rings = [
                ring for ring in Path("/dev/shm").glob("stagectl-*.ring") if f"-{daemon.process.pid}-" in ring.name
            ]
            daemon.process.send_signal(signal.SIGKILL)
            daemon.process.wait()
        give_up_s = time.monotonic() + 4.0  # the rig outlives its owner by 5 s
        speed = 1.0
        while speed > REST_M_PER_S and time.monotonic() < give_up_s:
            speed = abs(daemon.plant["macro_velocity_m_per_s"])
        assert speed <= REST_M_PER_S
        (ring,) = rings
        daemon.until(lambda: not ring.exists(), "rows saved")
        assert not writer_alive(ring)
        (folder,) = daemon.runs.glob("*-service-arm")
        record = read_run(folder).manifest["record"]
        assert (record["state"], record["rows_lost_count"]) == ("recovered", 0)
        daemon.start()
        daemon.state_is("fault")
        assert daemon.client.fault().kind == "SERVICE_LOST"
    finally:
        daemon.end()


def test_no_service_is_a_link_error(tmp_path):
    with Client(tmp_path / "none") as client, pytest.raises(LinkError, match="is `stagectl serve` running"):
        client.status()
