"""What pages cost: the servo nothing that can be seen in its process, the service one client, the page's own bounds."""

import asyncio
import contextlib
import json
import os
import socket
import threading
import time
from pathlib import Path

import pytest
import websockets

from stagectl.page import application
from stagectl.page.feed import Feed
from stagectl.service import admission
from stagectl.service.access import Role
from tests.service.daemon import servo_pid
from tests.service.pages import PageServer

pytestmark = pytest.mark.real_time

ENOUGH_CYCLES = 1000


@pytest.fixture(scope="module")
def page(daemon):
    server = PageServer(daemon.socket, daemon.runs)
    yield server
    server.end()


def sizes_of(pid):
    """What a process holds: memory in kB, threads."""
    lines = dict(line.split(":", 1) for line in Path(f"/proc/{pid}/status").read_text().splitlines())
    return {name: lines[name].strip() for name in ("VmSize", "VmData", "VmLck", "VmRSS", "Threads")}


def descriptors_of(pid):
    """What a process has open: number to target."""
    folder = Path(f"/proc/{pid}/fd")
    found = {}
    for entry in folder.iterdir():
        with contextlib.suppress(FileNotFoundError):
            found[entry.name] = os.readlink(entry)
    return found


def socket_inodes(pid):
    return {target for target in descriptors_of(pid).values() if target.startswith("socket:")}


def unix_paths(inodes):
    """The paths of Unix sockets among these inodes."""
    lines = [line.split() for line in Path("/proc/net/unix").read_text().splitlines()[1:]]
    return {line[7] for line in lines if len(line) > 7 and f"socket:[{line[6]}]" in inodes}


def internet_inodes():
    lines = [line.split() for kind in ("tcp", "tcp6", "udp", "udp6") for line in _net(kind)]
    return {f"socket:[{line[9]}]" for line in lines}


def _net(kind):
    path = Path(f"/proc/net/{kind}")
    return path.read_text().splitlines()[1:] if path.exists() else []


@contextlib.contextmanager
def clients(page, daemon):
    """Nine pages: three that read, three that don't, three that shout; and one that stalls on the service's socket."""
    with page.browser(Role.OBSERVE) as browser:
        cookie = "; ".join(f"{name}={value}" for name, value in browser.cookies.items())
    ready, over = threading.Event(), threading.Event()

    async def read(stream):
        async for _ in stream:
            pass

    async def shout(stream):
        with contextlib.suppress(websockets.ConnectionClosed):
            while True:
                for message in ("x" * 3000, b"\xff\x00" * 1000, '{"mode": 2}', "", "[" * 2000):
                    await stream.send(message)
                await asyncio.sleep(0.01)

    async def work():
        headers = {"Cookie": cookie}
        uri = f"ws://127.0.0.1:{page.port}/v1/stream"
        async with contextlib.AsyncExitStack() as stack:
            streams = [
                await stack.enter_async_context(
                    websockets.connect(uri, origin=page.address, additional_headers=headers, max_size=None)
                )
                for _ in range(9)
            ]
            tasks = [asyncio.create_task(read(one)) for one in streams[:3]]
            tasks += [asyncio.create_task(shout(one)) for one in streams[3:6]]
            ready.set()
            while not over.is_set():
                await asyncio.sleep(0.05)
            for task in tasks:
                task.cancel()

    thread = threading.Thread(target=lambda: asyncio.run(work()))
    thread.start()
    stalled = socket.socket(socket.AF_UNIX)
    try:
        stalled.connect(str(daemon.socket))
        stalled.sendall(
            b"GET /v1/stream?rate_hz=30 HTTP/1.1\r\nHost: x\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
            b"Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\nSec-WebSocket-Version: 13\r\n\r\n"
        )
        assert stalled.recv(12) == b"HTTP/1.1 101"
        assert ready.wait(20.0)
        yield
    finally:
        over.set()
        thread.join(20.0)
        stalled.close()


def after_cycles(daemon, count):
    begin = daemon.client.status().health.cycles_count
    daemon.until(lambda: daemon.client.status().health.cycles_count >= begin + count, f"{count} cycles")


def test_the_servo_has_no_way_to_a_client_and_nothing_in_it_grows_by_one(idle, page):
    pid = servo_pid(idle)
    after_cycles(idle, ENOUGH_CYCLES)  # past whatever it touches for the first time
    sizes, descriptors = sizes_of(pid), descriptors_of(pid)
    with clients(page, idle):
        after_cycles(idle, ENOUGH_CYCLES)
        assert descriptors_of(pid) == descriptors
        assert sizes_of(pid) == sizes
        served = socket_inodes(idle.process.pid)
        assert str(idle.socket) in unix_paths(served)  # what is looked for can be seen
        assert served & internet_inodes()
        assert not socket_inodes(pid) & internet_inodes()
        assert str(idle.socket) not in unix_paths(socket_inodes(pid))
    assert sizes_of(pid) == sizes


def test_a_page_that_does_not_read_is_let_go_of_and_the_others_hear_on(tmp_path):
    """A service that talks fast stands in for half a minute of a slow one."""
    path = tmp_path / "fast.socket"
    said = 500
    message = {"status": {}, "samples": {"columns": ["t_s"], "rows": []}}

    async def talk(stream):
        for number in range(said):
            await stream.send(json.dumps(message | {"samples": {"columns": ["t_s"], "rows": [[float(number)]]}}))
            await asyncio.sleep(0.0)
        await stream.wait_closed()

    async def play():
        feed = Feed(path)
        heard = []
        reading, sleeping = feed.listen(), feed.listen()
        await anext(sleeping)  # the story so far; then it reads no more

        async def read():
            async for text in reading:
                heard.append(text)
                if len(heard) > said:
                    return

        async with websockets.unix_serve(talk, str(path)):
            tasks = [asyncio.create_task(read()), asyncio.create_task(feed.work())]
            await asyncio.wait_for(tasks[0], 20.0)
            pages_count = feed.pages_count
            left = [text async for text in sleeping]
            tasks[1].cancel()
            await asyncio.gather(*tasks, return_exceptions=True)
        return heard, left, pages_count

    heard, left, pages_count = asyncio.run(play())
    assert json.loads(heard[-1])["samples"]["rows"] == [[said - 1.0]]
    assert len(left) <= 100  # what waited for it, and then the end
    assert pages_count == 1


@contextlib.contextmanager
def loud_service(path):
    """What a page hears of a service that says 200 kB fifty times a second."""
    message = json.dumps({"status": {"text": "x" * 200_000}, "samples": {"columns": ["t_s"], "rows": []}})
    over = threading.Event()

    async def talk(stream):
        while True:
            await stream.send(message)
            await asyncio.sleep(0.02)

    async def serve():
        async with websockets.unix_serve(talk, str(path)):
            while not over.is_set():
                await asyncio.sleep(0.05)

    thread = threading.Thread(target=lambda: asyncio.run(serve()))
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join(20.0)


def test_a_page_that_does_not_read_is_counted_no_more(tmp_path, monkeypatch):
    monkeypatch.setattr(admission, "LOOK_S", 0.1)
    monkeypatch.setattr(application, "_SEND_S", 0.5)
    server = PageServer(tmp_path / "loud", tmp_path)
    try:
        with loud_service(tmp_path / "loud"), server.browser(Role.OBSERVE) as browser, socket.socket() as deaf:
            cookie = "; ".join(f"{name}={value}" for name, value in browser.cookies.items())
            deaf.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
            deaf.connect(("127.0.0.1", server.port))
            deaf.sendall(
                f"GET /v1/stream HTTP/1.1\r\nHost: 127.0.0.1:{server.port}\r\nOrigin: {server.address}\r\n"
                f"Cookie: {cookie}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
                "Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\nSec-WebSocket-Version: 13\r\n\r\n".encode()
            )
            assert deaf.recv(12) == b"HTTP/1.1 101"
            monkeypatch.setattr(admission, "CONNECTIONS_LIMIT", 1)
            assert browser.get("/session").status_code == 503
            give_up_s = time.monotonic() + 30.0
            while browser.get("/session").status_code == 503:
                assert time.monotonic() < give_up_s
                time.sleep(0.1)
    finally:
        server.end()
