"""What comes after something is gone: a fault that says so, and the way back without restarting the daemon."""

import os
import signal
from pathlib import Path

import pytest

from stagectl.errors import RequestError
from stagectl.record import read_run
from tests.service.daemon import servo_pid
from tests.service.test_daemon import move_away

pytestmark = pytest.mark.real_time

SHARED_MEMORY = Path("/dev/shm")


def test_a_killed_servo_is_a_fault_that_is_recovered_from(idle):
    client = idle.client
    with client.lease("anna"):
        move_away(client)
        idle.until(lambda: abs(idle.plant["macro_velocity_m_per_s"]) > 0.05, "speed")
        os.kill(servo_pid(idle), signal.SIGKILL)
        idle.state_is("fault")
        fault = client.fault()
        assert fault.kind == "LinkError"
        assert "the servo process ended with -9" in fault.values
        assert "acknowledge" in fault.remedy
        with pytest.raises(RequestError, match="not possible in state fault"):
            client.home()
        client.acknowledge(fault.number)
    run = read_run(sorted(idle.runs.glob("*-service-arm"))[-1])
    assert run.manifest["record"]["state"] == "closed"
    assert run.manifest["end"]["stop"] == "LINK_LOST"
    assert run.rows.size > 100
    idle.state_is("idle")
    assert not client.status().homed
    with client.lease("anna"):
        with pytest.raises(RequestError, match="not homed since it was connected"):
            client.arm()
        idle.finishes(client.home)
        idle.finishes(client.arm)


def test_a_service_that_was_killed_whole_leaves_no_memory_to_the_next(idle):
    """As systemd's watchdog or the kernel's OOM killer end it: nobody is left who could put anything away."""
    servo, supervisor = servo_pid(idle), idle.process
    blocks = f"stagectl-{supervisor.pid}-*"
    os.kill(supervisor.pid, signal.SIGSTOP)
    os.kill(servo, signal.SIGKILL)
    supervisor.kill()
    supervisor.wait()
    assert len(list(SHARED_MEMORY.glob(blocks))) == 4
    idle.socket.unlink()  # httpcore leaves a socket unclosed that was refused
    idle.start()
    idle.state_is("idle")
    assert list(SHARED_MEMORY.glob(blocks)) == []


def test_a_servo_that_hangs_is_noticed(idle):
    client = idle.client
    pid = servo_pid(idle)
    os.kill(pid, signal.SIGSTOP)
    try:
        idle.state_is("fault")
        assert client.fault().kind == "TimingError"
        assert "has done no cycle for" in client.fault().values
    finally:
        os.kill(pid, signal.SIGCONT)  # it hears that it was asked to leave


def test_a_servo_that_hangs_in_motion_is_recovered_from(idle):
    """The drives stop the stage; nobody waits for the motion's end, or for systemd's watchdog."""
    client = idle.client
    with client.lease("anna"):
        move_away(client)
        idle.until(lambda: abs(idle.plant["macro_velocity_m_per_s"]) > 0.05, "speed")
        servo = servo_pid(idle)
        os.kill(servo, signal.SIGSTOP)
        try:
            idle.state_is("fault")
        finally:
            os.kill(servo, signal.SIGKILL)  # as the service does itself, after its patience
        fault = client.fault()
        assert (fault.kind, fault.state) == ("TimingError", "moving")
        client.acknowledge(fault.number)
    idle.state_is("idle")
    with client.lease("anna"):
        idle.finishes(client.home)
        idle.finishes(client.arm)


def test_the_world_is_changed_without_power_only_and_every_client_is_told(idle):
    client = idle.client
    with client.lease("anna"):
        client.home()
        client.arm()
        with pytest.raises(RequestError, match=r"without power only; the state is armed: stop first"):
            client.swap_backend("hardware")
    with client.lease("anna"):
        client.swap_backend("hardware")
        idle.until(lambda: "not there; plug it in" in client.status().waiting_for, "a missing interface")
        status = client.status()
        assert (status.state, status.backend, status.homed) == ("off", "hardware", False)
        assert status.banner == "HARDWARE: what moves here is real"
        with pytest.raises(RequestError, match="not possible in state off"):
            client.home()
        client.swap_backend("rig")
    idle.state_is("idle")
    assert client.status().banner == "SOFTWARE RIG: nothing real moves"
    session = max(idle.runs.glob("*-service"), key=os.path.getmtime)
    assert read_run(session).manifest["backend"] == "rig"
