"""Sockets, tokens, systemd and the state file: what stands between the service and everybody else on the machine."""

import contextlib
import json
import os
import socket
import stat
import threading
import time
from http.client import HTTPResponse

import numpy as np
import pytest

from stagectl.client import Client
from stagectl.errors import LinkError, ProfileError, RecordError, RequestError
from stagectl.row import ROW
from stagectl.service import admission, api, messages, places
from stagectl.service.access import BODY_LIMIT_BYTES, LEASE_HEADER, Access, Role, header, read_tokens, role_of
from stagectl.service.admission import CONNECTIONS_LIMIT, RESERVE_COUNT
from stagectl.service.api import application
from stagectl.service.desk import Desk
from stagectl.service.exposition import Figures
from stagectl.service.listener import Listener
from stagectl.service.notify import Notifier
from stagectl.service.places import is_served, listen_tcp, listen_unix, one_service_of
from stagectl.service.remembered import FILE, Remembered, keep, recall
from stagectl.service.service_log import ServiceLog
from stagectl.service.stage_loop import StageLoop
from stagectl.service.stage_state import Settings


def test_the_socket_is_for_owner_and_group(tmp_path):
    path = tmp_path / "run" / "stage.socket"
    listening = listen_unix(path)
    assert stat.S_IMODE(path.stat().st_mode) == 0o660
    assert is_served(path)
    with pytest.raises(LinkError, match="a service listens here already; stop it"):
        listen_unix(path)
    listening.close()
    assert not is_served(path)
    listen_unix(path).close()  # a dead service's socket is no obstacle


def test_of_services_that_begin_at_once_one_has_the_socket(tmp_path):
    """Between the look whether one listens and the listening itself another's new socket was taken for a dead one's."""
    path = tmp_path / "run" / "stage.socket"
    for _ in range(100):
        together, had = threading.Barrier(4), []

        def begin(together=together, had=had):
            together.wait()
            with contextlib.suppress(LinkError):
                had.append(listen_unix(path))

        threads = [threading.Thread(target=begin) for _ in range(4)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        for listening in had:
            listening.close()
        assert len(had) == 1


def test_a_folder_that_somebody_keeps_locked_is_not_waited_for_without_end(tmp_path, monkeypatch):
    monkeypatch.setattr(places, "_AT_ONCE_S", 0.1)
    with one_service_of(tmp_path), pytest.raises(LinkError, match="somebody keeps this folder locked"):
        listen_unix(tmp_path / "stage.socket")
    listen_unix(tmp_path / "stage.socket").close()


def test_a_state_has_one_service(tmp_path):
    """With a socket of its own a second one commanded the same stage."""
    twice = pytest.raises(LinkError, match="another service works with this state; stop it, or give another")
    with one_service_of(tmp_path / "state"), twice, one_service_of(tmp_path / "state"):
        pass
    with one_service_of(tmp_path / "state"):
        pass
    (tmp_path / "file").write_text("")
    no_folder = pytest.raises(RecordError, match=r"can't be made: .*; give another folder with --state")
    with no_folder, one_service_of(tmp_path / "file"):
        pass


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can be somebody else")
def test_a_socket_in_a_folder_that_is_not_for_us_is_served(tmp_path):
    path = tmp_path / "run" / "stage.socket"
    with listen_unix(path):
        path.parent.chmod(0o700)
        os.seteuid(65534)
        try:
            assert is_served(path)
            with Client(path) as client, pytest.raises(LinkError, match="not for this user; join the group of its"):
                client.stop()
        finally:
            os.seteuid(0)


def test_no_socket_can_have_such_a_name(tmp_path):
    path = tmp_path / ("a" * 300) / "stage.socket"
    assert not is_served(path)
    with Client(path) as client, pytest.raises(LinkError, match="no socket can be there: File name too long"):
        client.status()


def test_a_service_too_busy_to_answer_keeps_its_socket(tmp_path):
    path = tmp_path / "stage.socket"
    with contextlib.ExitStack() as waiting, listen_unix(path) as listening:
        last = waiting.enter_context(nonblocking())
        while last.connect_ex(str(path)) == 0:
            last = waiting.enter_context(nonblocking())
        before = path.stat().st_ino
        assert is_served(path)
        with pytest.raises(LinkError, match="a service listens here already; stop it"):
            listen_unix(path)
        assert path.stat().st_ino == before
        listening.accept()[0].close()
        assert last.connect_ex(str(path)) == 0  # it is still reached here


def nonblocking():
    """A Unix socket that waits for nobody."""
    made = socket.socket(socket.AF_UNIX)
    made.setblocking(False)
    return made


@pytest.mark.parametrize(
    ("kind", "make"),
    [
        ("a file", lambda path: path.write_text("no socket")),
        ("a folder", lambda path: path.mkdir()),
        ("a symbolic link", lambda path: path.symlink_to(path.parent / "nowhere")),
        ("a symbolic link", lambda path: path.symlink_to(listened_to_once(path.parent / "dead"))),
    ],
    ids=["file", "folder", "dangling link", "link to a dead socket"],
)
def test_what_is_no_socket_is_not_removed(tmp_path, kind, make):
    path = tmp_path / "precious"
    make(path)
    before = path.lstat().st_ino
    with pytest.raises(LinkError, match=f"precious: {kind} is here, no socket; remove it, or give another path"):
        listen_unix(path)
    assert path.lstat().st_ino == before


def listened_to_once(path):
    """The path of a dead service."""
    listen_unix(path).close()
    return path


def test_a_folder_of_everybody_is_refused(tmp_path):
    tmp_path.chmod(0o777)
    with pytest.raises(LinkError, match="others may put a socket of theirs here"):
        listen_unix(tmp_path / "stage.socket")


def test_tcp_is_loopback_only():
    listening = listen_tcp(0)
    host, port = listening.getsockname()
    assert host == "127.0.0.1"
    with pytest.raises(LinkError, match=f"127.0.0.1:{port}: can't listen: Address already in use"):
        listen_tcp(port)
    listening.close()
    with pytest.raises(RequestError, match="--tcp 70000: a port is a number"):
        listen_tcp(70000)


def test_tokens_are_made_once_and_are_nobody_elses(tmp_path):
    path = tmp_path / "tokens"
    tokens = read_tokens(path)
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    assert read_tokens(path) == tokens
    assert role_of(tokens, tokens[Role.OBSERVE]) is Role.OBSERVE
    assert role_of(tokens, tokens[Role.OPERATE]) is Role.OPERATE
    for wrong in ("", tokens[Role.OPERATE][:-1], tokens[Role.OPERATE] + "x", "\udcff", "ä" * 30):
        assert role_of(tokens, wrong) is None
    path.chmod(0o640)
    with pytest.raises(ProfileError, match="mode 0640, others may read it; chmod 600"):
        read_tokens(path)


@pytest.mark.parametrize("text", ["", "operate short\n", "operate " + "a" * 30 + "\n", "observe {0}\noperate {0}\n"])
def test_a_tokens_file_that_lets_anybody_in_is_refused(tmp_path, text):
    path = tmp_path / "tokens"
    path.write_text(text.format("b" * 30))
    path.chmod(0o600)
    with pytest.raises(ProfileError, match="needs a line 'ROLE TOKEN'"):
        read_tokens(path)


def test_systemd_hears_what_there_is_to_hear(tmp_path):
    place = tmp_path / "notify"
    manager = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK)
    manager.bind(str(place))
    now_s = [0.0]
    notifier = Notifier({"NOTIFY_SOCKET": str(place), "WATCHDOG_USEC": "2000000"}, lambda: now_s[0])

    def heard():
        said = []
        while True:
            try:
                said.append(manager.recv(4096).decode())
            except BlockingIOError:
                return said

    notifier.say(READY=1, STATUS="waiting:\nfor CAN")
    assert heard() == ["READY=1\nSTATUS=waiting: for CAN"]
    notifier.feed(1000)
    assert heard() == ["WATCHDOG=1"]
    notifier.feed(1001)  # news, but too soon after the last
    now_s[0] = 0.6
    notifier.feed(1000)  # time, but the servo stands still
    assert heard() == []
    notifier.feed(1002)
    assert heard() == ["WATCHDOG=1"]
    now_s[0] = 100.0
    for _ in range(5):
        notifier.feed(1002)
    assert heard() == []
    notifier.allow(240.0)
    notifier.allow(0.0)
    assert heard() == ["WATCHDOG=1\nWATCHDOG_USEC=240000000", "WATCHDOG=1\nWATCHDOG_USEC=2000000"]
    manager.close()
    notifier.say(STATUS="nobody listens")


def test_without_systemd_nothing_is_said():
    notifier = Notifier({})
    notifier.say(READY=1)
    notifier.feed(1)
    assert notifier.watchdog_us == 0


def test_the_state_survives_and_a_damaged_one_is_said(tmp_path):
    backlash = messages.Backlash(
        width_m=2e-4, centre_m=1e-5, left_m=9e-5, right_m=1.1e-4, left_stiffness_n_per_m=1e4,
        right_stiffness_n_per_m=1.2e4, width_sd_m=1e-7, at="2026-11-22T02:00:00+00:00", run="r", profile_name="p",
        backend="rig",
    )  # fmt: skip
    remembered = Remembered(profile="/etc/stagectl/p.toml", profile_name="p", backend="rig", joints={"rig p": backlash})
    assert recall(tmp_path) == (Remembered(), "")
    keep(tmp_path / "deep", remembered)
    assert recall(tmp_path / "deep") == (remembered, "")
    path = tmp_path / "deep" / FILE
    for damage in ("{", "[]", json.dumps({"profile": 3}), json.dumps({"homed": True})):
        path.write_text(damage)
        found, remark = recall(tmp_path / "deep")
        assert found == Remembered()
        assert "can't be read" in remark
    assert sorted(os.listdir(tmp_path / "deep")) == [FILE]
    with pytest.raises(RecordError, match="can't be kept"):
        keep(path, remembered)


@pytest.mark.parametrize("length", [b"", b"Content-Length: 5\r\n"], ids=["in pieces", "in pieces, with a length"])
def test_no_body_in_pieces_gets_as_far_as_the_application(tmp_path, length):
    taken_bytes = []

    async def reading(scope, receive, send):
        more = True
        while more:
            said = await receive()
            taken_bytes.append(len(said.get("body", b"")))
            more = said.get("more_body", False)
        await send({"type": "http.response.start", "status": 200, "headers": [(b"content-length", b"0")]})
        await send({"type": "http.response.body", "body": b""})

    tokens = read_tokens(tmp_path / "tokens")
    listener = Listener([(listen_unix(tmp_path / "s"), Access(reading, tokens))])
    listener.start()
    piece = b"%x\r\n%s\r\n" % (BODY_LIMIT_BYTES, b"x" * BODY_LIMIT_BYTES)
    try:
        with socket.socket(socket.AF_UNIX) as one:
            one.settimeout(10.0)
            one.connect(str(tmp_path / "s"))
            one.sendall(b"PUT /v1/lease HTTP/1.1\r\nHost: s\r\nTransfer-Encoding: chunked\r\n" + length)
            one.sendall(b"Authorization: Bearer %s\r\n\r\n" % tokens[Role.OBSERVE].encode())
            for _ in range(16):
                one.sendall(piece)
            one.sendall(b"0\r\n\r\n")
            assert one.recv(12) == b"HTTP/1.1 411"
    finally:
        listener.close()
    assert sum(taken_bytes) == 0


@pytest.mark.parametrize("piece", [b"zz\r\nabc", b"5\r\nabcdefgh\r\n"])
@pytest.mark.parametrize("when", ["with its head", "behind the refusal"])
def test_a_broken_piece_ends_the_connection_and_nothing_else(tmp_path, caplog, piece, when):
    """h11 raised at a second answer, here from uvicorn and there from the application: a traceback in the journal."""

    async def answering(scope, receive, send):
        await send({"type": "http.response.start", "status": 200, "headers": [(b"content-length", b"0")]})
        await send({"type": "http.response.body", "body": b""})

    listener = Listener([(listen_unix(tmp_path / "s"), Access(answering, None))])
    listener.start()
    head = b"PUT /v1/lease HTTP/1.1\r\nHost: s\r\nTransfer-Encoding: chunked\r\n\r\n"
    try:
        with socket.socket(socket.AF_UNIX) as one:
            one.settimeout(10.0)
            one.connect(str(tmp_path / "s"))
            if when == "with its head":
                one.sendall(head + piece)
                code, answer = b"400", one.recv(4096)
            else:
                one.sendall(head)
                code, answer = b"411", one.recv(4096)
                one.sendall(piece)
            assert answer.startswith(b"HTTP/1.1 " + code)
            while one.recv(4096):  # until it is closed
                pass
        with socket.socket(socket.AF_UNIX) as other:
            other.settimeout(10.0)
            other.connect(str(tmp_path / "s"))
            other.sendall(b"GET /v1/lease HTTP/1.1\r\nHost: s\r\n\r\n")
            assert other.recv(4096).startswith(b"HTTP/1.1 200")
    finally:
        listener.close()
    assert [one for one in caplog.records if one.levelname == "ERROR"] == []


class Crowd:
    """Raw connections to a served API: silent ones, and streams."""

    def __init__(self, path):
        self.path = str(path)
        self.sockets = []

    def connect(self, sent=b""):
        one = socket.socket(socket.AF_UNIX)
        one.connect(self.path)
        one.sendall(sent)
        self.sockets.append(one)
        return one

    def close(self):
        for one in self.sockets:
            one.close()


@pytest.fixture
def crowd(tmp_path):
    """A served API without a stage, and who crowds it: (crowd, desk, client)."""
    path = tmp_path / "s"
    log = ServiceLog(None)
    desk = Desk(log)
    loop = StageLoop(Settings("none", "rig", tmp_path, tmp_path), desk, log, Remembered(), Notifier({}), Figures())
    loop._tick()
    listener = Listener(
        [(listen_unix(path), Access(application(desk, log, Figures(), tmp_path, "0"), None))],
        from_operator=lambda scope: desk.is_lease_token(header(scope, LEASE_HEADER)),
    )
    listener.start()
    made = Crowd(path)
    with Client(path) as client:
        yield made, desk, client
    made.close()
    listener.close()


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_a_thread_that_answers_no_more_is_noticed(tmp_path):
    listening = listen_unix(tmp_path / "deaf")
    listening.close()
    heard = threading.Event()
    listener = Listener([(listening, Access(None, None))], ended=heard.set)
    listener.start()
    assert heard.wait(10.0)
    assert listener.has_failed
    good = Listener([(listen_unix(tmp_path / "good"), Access(None, None))], ended=heard.clear)
    good.start()
    good.close()
    assert heard.is_set()
    assert not good.has_failed


@pytest.mark.parametrize("asked", [b"", b"GET /v1/status HTTP/1.1\r\nHost: s\r\n"], ids=["silent", "half a request"])
def test_no_crowd_keeps_a_stop_out(crowd, asked):
    many, desk, client = crowd
    for _ in range(CONNECTIONS_LIMIT + 3 * RESERVE_COUNT):
        many.connect(asked)
    with pytest.raises(RequestError, match="connections are open, the limit; close some and try again"):
        client.status()
    assert client.stop().state == "off"
    assert desk.stop_asked
    many.close()
    for _ in range(100):
        try:
            assert client.status().state == "off"
            return
        except RequestError:
            time.sleep(0.02)
    raise AssertionError("still refused")


def renewed(connection, token):
    """Renew a lease over an open connection, and return the answer's code."""
    connection.sendall(f"PUT /v1/lease HTTP/1.1\r\nHost: s\r\nStagectl-Lease: {token}\r\n\r\n".encode())
    answer = HTTPResponse(connection)
    answer.begin()
    answer.read()
    return answer.status


def test_no_crowd_keeps_the_operator_s_renewals_out(crowd):
    many, desk, client = crowd
    token = client.take_lease("the operator", 30.0).token
    before = many.connect()
    for number in range(CONNECTIONS_LIMIT + 3 * RESERVE_COUNT):
        if number % RESERVE_COUNT == 0:
            assert renewed(before, token) == 200  # older than all that made room
        many.connect()
    with pytest.raises(RequestError, match="connections are open, the limit"), Client(many.path) as other:
        other.status()
    assert renewed(before, token) == 200
    assert renewed(many.connect(), token) == 200
    assert renewed(many.connect(), "guessed") == 503
    desk.give_lease_back(token)
    assert renewed(many.connect(), token) == 503


UPGRADE = b"""GET /v1/stream?rate_hz=30 HTTP/1.1\r
Host: s\r
Connection: Upgrade\r
Upgrade: websocket\r
Sec-WebSocket-Version: 13\r
Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r
\r
"""
GOING_AWAY = b"\x88\x82\0\0\0\0\x03\xe9"


def test_streams_up_to_the_limit_leave_room_for_a_stop(crowd):
    many, desk, client = crowd
    answers = [many.connect(UPGRADE).recv(12) for _ in range(CONNECTIONS_LIMIT + 20)]
    assert answers[0] == b"HTTP/1.1 101"
    assert answers[-1] == b"HTTP/1.1 403"
    assert client.stop().state == "off"
    assert desk.stop_asked


@pytest.fixture
def soon(monkeypatch):
    """A service that loses its patience ten times as fast, and has room for three."""
    monkeypatch.setattr(admission, "LOOK_S", 0.1)
    monkeypatch.setattr(admission, "CONNECTIONS_LIMIT", 3)
    monkeypatch.setattr(api, "SEND_S", 0.5)


def is_refused(client):
    """Whether there is no room for a client's request."""
    try:
        client.status()
    except RequestError as error:
        return "connections are open, the limit" in str(error)
    return False


def says_much(desk):
    """Have streams more to say than kernel and service hold for one that does not read: 50 kB, ten times."""
    for _ in range(10):
        desk.scope.add(np.zeros(10_000, ROW))
        time.sleep(0.05)


@pytest.mark.parametrize(
    ("asked", "said_later"),
    [(UPGRADE, b""), (UPGRADE, GOING_AWAY), (b"GET /openapi.json HTTP/1.1\r\nHost: s\r\n\r\n" * 50, b"")],
    ids=["a stream", "a stream that says that it ends", "many answers"],
)
def test_a_client_that_does_not_read_is_counted_no_more(soon, crowd, asked, said_later):
    many, desk, client = crowd
    for _ in range(3):
        assert many.connect(asked).recv(12) in (b"HTTP/1.1 101", b"HTTP/1.1 200")  # and reads no more
    assert is_refused(client)
    says_much(desk)
    for one in many.sockets:
        with contextlib.suppress(BrokenPipeError):  # let go of already
            one.sendall(said_later)
    give_up_s = time.monotonic() + 20.0
    while is_refused(client):
        assert time.monotonic() < give_up_s
        time.sleep(0.1)


def test_a_client_that_reads_slowly_reads_to_its_close_frame(soon, crowd):
    many, desk, _ = crowd
    stream = many.connect(UPGRADE)
    assert stream.recv(12) == b"HTTP/1.1 101"
    says_much(desk)
    stream.settimeout(10.0)
    heard, begun_s = b"", time.monotonic()
    while piece := stream.recv(4096):
        heard += piece
        time.sleep(0.05)
        if heard.endswith(b"lower rate_hz"):
            break
    assert time.monotonic() - begun_s > 3.0  # one that reads nothing is let go of after 1 s
    opcodes, bodies = frames(heard.partition(b"\r\n\r\n")[2])
    assert set(opcodes[:-1]) == {1}
    assert opcodes[-1] == 8
    assert bodies[-1].startswith(b"\x03\xf5")  # 1013: try again later


def frames(text):
    """The frames of a server's side of a WebSocket, whole ones only: opcodes and bodies."""
    opcodes, bodies = [], []
    while text:
        length, begin = text[1], 2
        if length == 126:
            length, begin = int.from_bytes(text[2:4]), 4
        elif length == 127:
            length, begin = int.from_bytes(text[2:10]), 10
        opcodes.append(text[0] & 0x0F)
        bodies.append(text[begin : begin + length])
        assert len(bodies[-1]) == length
        text = text[begin + length :]
    return opcodes, bodies
