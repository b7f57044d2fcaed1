"""The servo's world in real time, on a hub and a pseudo-terminal: what is taken, kept, and gone for good."""

import os
import subprocess
import sys
import tty
from pathlib import Path

import pytest

from drivers.can_bus import ERROR_FLAG, open_cyclic
from drivers.serial_port import SerialPort
from drivers.transport import CHUNK_LIMIT_BYTES, RealtimeTransport
from drivers.wire import Inbox
from sim_backend.hub import Hub
from stagectl.servo_process import shares_cpu

pytestmark = pytest.mark.real_time

TPDO, HEARTBEAT, BUS_OFF = 0x181, 0x701, ERROR_FLAG | 0x40
MS = 1_000_000


class World:
    """A hub and a pty, with a transport on both."""

    def __init__(self, path: str, shares_cpu: bool) -> None:
        self.hub = Hub(path)
        self.master, slave = os.openpty()
        tty.setraw(slave)
        self.port = SerialPort(os.ttyname(slave), 921_600.0)
        os.close(slave)
        bus = open_cyclic("hub", path, [TPDO])
        self.transport = RealtimeTransport(bus, self.port, {TPDO: "macro_tpdo"}, shares_cpu=shares_cpu)

    def serve(self) -> None:
        """Let the hub read what its clients sent."""
        for fileno in self.hub.filenos():
            self.hub.read(fileno)

    def cycle(self) -> Inbox:
        """Receive for a few milliseconds."""
        inbox = Inbox()
        due_t_ns = self.transport.now_t_ns() + 3 * MS
        self.transport.sleep(due_t_ns, inbox)
        self.transport.receive(due_t_ns, inbox)
        return inbox

    def unplug(self) -> None:
        """Take the interferometer's plug out."""
        os.close(self.master)
        self.master = -1

    def close(self) -> None:
        """Give everything back."""
        self.transport.close()
        self.hub.close()
        if self.master >= 0:
            os.close(self.master)


@pytest.fixture(params=[True, False], ids=["cpu-shared", "cpu-alone"])
def world(tmp_path, request):
    made = World(str(tmp_path / "hub"), request.param)
    yield made
    made.close()


def test_frames_before_the_filter_took_effect_are_left_alone(world):
    """The hub hears of the filter a moment after the connection: until then everything comes."""
    (listening,) = world.hub.filenos()
    world.hub.read(listening)  # the client is in, its filter not yet read
    world.hub.relay(HEARTBEAT, b"\x05")
    world.hub.relay(TPDO, bytes(8))
    inbox = world.cycle()
    assert inbox.macro_tpdo == bytes(8)
    assert world.transport.failure == ""


def test_what_one_row_can_not_hold_comes_with_the_next_cycle(world):
    data = bytes(range(256)) * 3
    os.write(world.master, data)
    first, second, third = world.cycle(), world.cycle(), world.cycle()
    assert len(first.sensor_bytes) == CHUNK_LIMIT_BYTES
    assert first.sensor_bytes + second.sensor_bytes == data
    assert third.sensor_bytes == b""


def test_bytes_that_come_while_others_are_kept_push_none_out(world, monkeypatch):
    """The port is looked at again in the last stretch before the deadline: a full row must leave it alone."""
    monkeypatch.setattr("drivers.transport._SPIN_NS", 10 * MS)  # so long that a slow host is awake in it
    first, second = bytes(range(256)) * 3, b"and more"
    os.write(world.master, first)
    transport, inbox = world.transport, Inbox()
    due_t_ns = transport.now_t_ns() + 20 * MS
    assert transport.await_bytes(due_t_ns, inbox)
    os.write(world.master, second)
    transport.receive(due_t_ns, inbox)
    received = inbox.sensor_bytes + world.cycle().sensor_bytes + world.cycle().sensor_bytes
    assert received == first + second


def test_the_first_bytes_of_a_cycle_are_there_before_it_is_due_and_keep_their_own_time(world):
    """The servo decodes them meanwhile; what comes later has a time of its own."""
    transport, inbox = world.transport, Inbox()
    due_t_ns = transport.now_t_ns() + 200 * MS
    os.write(world.master, b"first")
    assert transport.await_bytes(due_t_ns, inbox)
    assert transport.now_t_ns() < due_t_ns - 100 * MS
    assert (inbox.sensor_bytes, inbox.first_bytes_count) == (b"first", 5)
    os.write(world.master, b" and the rest")
    due_t_ns = transport.now_t_ns() + 5 * MS
    assert transport.receive(due_t_ns, inbox) >= due_t_ns
    assert (inbox.sensor_bytes, inbox.first_bytes_count) == (b"first and the rest", 5)
    assert 0 < inbox.first_arrival_t_ns < inbox.sensor_arrival_t_ns


def test_without_bytes_the_wait_ends_when_the_cycle_is_due(world):
    inbox = Inbox()
    due_t_ns = world.transport.now_t_ns() + 2 * MS
    assert not world.transport.await_bytes(due_t_ns, inbox)
    assert world.transport.now_t_ns() >= due_t_ns


def test_a_port_that_is_unplugged_is_said_and_the_bus_goes_on(world):
    world.serve()
    world.unplug()
    world.cycle()
    assert "is gone" in world.transport.failure
    assert "arm and home again" in world.transport.failure
    world.serve()
    world.hub.relay(TPDO, bytes(8))
    assert world.cycle().macro_tpdo == bytes(8)
    assert world.transport.send([(0x201, bytes(4))])[0]


def test_bus_off_is_said(world):
    world.serve()
    world.serve()
    world.hub.relay(BUS_OFF, bytes(8))
    world.cycle()
    assert world.transport.failure.startswith("CAN controller is bus-off: check cable")


def test_other_error_frames_are_counted_only(world):
    world.serve()
    world.serve()
    world.hub.relay(ERROR_FLAG | 0x4, bytes(8))
    world.cycle()
    assert world.transport.failure == ""
    assert world.transport.error_frames_count == 1


def test_a_bus_that_is_gone_is_said_when_receiving_and_when_sending(world):
    world.serve()
    world.hub.close()
    assert world.transport.send([(0x201, bytes(4))])[0] is False
    assert "arm again" in world.transport.failure
    world.transport.failure = ""
    world.cycle()
    assert "closed" in world.transport.failure or "arm again" in world.transport.failure


KERNEL_WORK = Path("/sys/devices/virtual/workqueue/cpumask")
_BUSY = """
import os, sys, time
os.sched_setaffinity(0, {int(sys.argv[1])})
os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))
print("busy", flush=True)
until_s = time.monotonic() + 0.3
while time.monotonic() < until_s:
    pass
"""


@pytest.fixture
def apart():
    """Keep the kernel's work on the first processor, and this process on the last; yields the first."""
    processors = os.sched_getaffinity(0)
    if len(processors) < 2 or not os.access(KERNEL_WORK, os.W_OK):
        pytest.skip("needs root and two processors: the kernel's own work is kept on one of them")
    before = KERNEL_WORK.read_text()
    KERNEL_WORK.write_text(f"{1 << min(processors):x}")
    os.sched_setaffinity(0, {max(processors)})
    yield min(processors)
    os.sched_setaffinity(0, processors)
    KERNEL_WORK.write_text(before)


def test_a_line_that_the_kernel_has_not_handed_over_yet_holds_no_cycle_up(apart, tmp_path):
    """What hands it over has the priority of any program, and here it gets no processor for 0.3 s."""
    world = World(str(tmp_path / "hub"), shares_cpu=False)
    os.write(world.master, b"first")
    assert world.cycle().sensor_bytes == b"first"
    with subprocess.Popen([sys.executable, "-c", _BUSY, str(apart)], stdout=subprocess.PIPE) as busy:
        assert busy.stdout is not None
        busy.stdout.readline()
        os.write(world.master, b"second")
        held_back = [world.cycle().sensor_bytes for _ in range(10)]
        assert busy.poll() is None
    assert held_back == [b""] * 10
    assert world.cycle().sensor_bytes == b"second"
    world.close()


@pytest.mark.parametrize(
    ("mask", "cpu", "shared"),
    [
        ("3", 1, True),
        ("1", 1, False),
        ("ffffffff,00000000", 1, False),
        ("ffffffff,00000000", 33, True),
        ("3", None, True),
    ],
)
def test_where_the_kernel_may_put_its_own_work_is_read_from_its_mask(tmp_path, mask, cpu, shared):
    (tmp_path / "cpumask").write_text(mask + "\n")
    assert shares_cpu(cpu, tmp_path / "cpumask") is shared


def test_a_kernel_that_does_not_say_where_it_works_may_work_anywhere(tmp_path):
    assert shares_cpu(1, tmp_path / "none")
