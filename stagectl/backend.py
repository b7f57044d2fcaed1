"""The one place that opens a world: the rig in batch, the rig as a process, or hardware.

Everything above sees a master's bus, an identity to demand, and a servo that runs when time passes.
"""

import contextlib
import json
import os
import secrets
import select
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import can
import numpy as np

from drivers.arming import DriveMapping
from drivers.can_bus import ERROR_FLAG, open_network
from drivers.hub_socket import connect_hub
from drivers.transport import CHUNK_LIMIT_BYTES, error_frame_text, now_t_ns
from drivers.wire import Inbox, WireDecoder, WireEncoder, frame_names
from sim_backend.batch import BatchWire
from sim_backend.rig import Rig
from stagectl import estimator
from stagectl.errors import DriveError, LinkError, ProfileError, RecordError, TimingError
from stagectl.profile import Profile
from stagectl.replay import describe_mapping
from stagectl.requests import REQUEST, RESTING, STATUS, Mode
from stagectl.ring import SHARED_MEMORY, RequestReader, RequestWriter, RingReader, RingWriter
from stagectl.servo import RELEASE_CYCLES, Servo
from stagectl.signals import SETPOINT
from stagectl.tracker import Tracker
from stagectl.undisturbed import undisturbed

SEGMENT_ROWS = 300_000
"""Setpoints that the segment table holds: 5 minutes at 1 kHz."""


@dataclass(slots=True)
class ServoLink:
    """What the supervisor holds of a servo: both blocks, the ring, the segment table, and a way to let time pass."""

    requests: RequestWriter
    status: RequestReader
    rows: RingReader
    segments: np.ndarray
    tracker_belief: np.ndarray
    snapshot: dict[str, np.ndarray]
    pass_time: Callable[[float], None]
    now_t_ns: Callable[[], int]
    close: Callable[[], None]
    """Have the servo bring a moving stage to rest, take the power away and end."""
    forget_rows: Callable[[], None]
    """Give the ring up, once all its rows are on the disk."""


class Backend(Protocol):
    """A world that a supervisor can work in."""

    name: str
    description: str
    may_move: bool
    """False where real drives stand on a simulated interferometer: to be watched only."""

    @property
    def vendor_id(self) -> int | None:
        """Vendor id that every node must show; None = the profile's."""
        ...

    def network_bus(self) -> can.BusABC:
        """Return the bus of the master."""
        ...

    synchronous: bool

    def clock_s(self) -> float:
        """Return the clock of heartbeat ages."""
        ...

    def pause(self, duration_s: float) -> None:
        """Let time pass while no servo runs."""
        ...

    def start_servo(self, profile: Profile, mappings: Mapping[str, DriveMapping], run_folder: Path) -> ServoLink:
        """Start the servo."""
        ...

    def truth(self) -> dict[str, np.ndarray] | None:
        """Return what was true, for scoring; None where nobody knows."""
        ...

    remarks: list[str]
    """What the host or the port refused, in words."""

    def close(self) -> None:
        """Let go of the world."""
        ...


_END_S = 20.0
"""The longest that a stage takes to come to rest."""

_SYNC_STEP_NS = 230_000
_SYNC_PATIENCE_NS = 460_000  # two RPDOs and SYNC take 220 us; longer means that the bus does not carry it


RIG_VENDOR_ID = 0x5254
"""Identity of the rig's drives; hardware never shows it."""


class BatchTransport:
    """The servo's world in virtual time; a tick takes the time that was measured for it."""

    def __init__(self, wire: BatchWire, names: dict[int, str], tick_ns: int):
        """Take over a batch wire."""
        self._wire, self._names, self._tick_ns = wire, names, tick_ns
        wire.cyclic.set_ids(names)
        self._kept = b""  # read already, but beyond what one row holds
        self._port_failed = False
        self.failure = ""

    @property
    def lost_count(self) -> int:
        """Frames that the bus did not take."""
        return self._wire.cyclic.lost_count

    def now_t_ns(self) -> int:
        """Return virtual time."""
        return self._wire.t_ns

    def sleep(self, deadline_t_ns: int, inbox: Inbox) -> bool:
        """Nobody waits in virtual time, and no cache cools down."""
        return False

    def await_bytes(self, deadline_t_ns: int, inbox: Inbox) -> bool:
        """Tell nothing before the deadline: in virtual time decoding early gains nothing."""
        return False

    def receive(self, deadline_t_ns: int, inbox: Inbox) -> int:
        """Let everything happen until the deadline, line by line, so that each has its own arrival."""
        wire = self._wire
        if self._kept:
            self._add(inbox, self._kept, inbox.sensor_arrival_t_ns)
        until_t_ns = max(deadline_t_ns, wire.t_ns)
        while not self._kept and not self._port_failed and (line_t_ns := wire.next_line_t_ns()) <= until_t_ns:
            wire.advance_to(line_t_ns)
            if not self._read(inbox):
                break
        wire.advance_to(deadline_t_ns)
        if not inbox.sensor_bytes and not self._port_failed:
            self._read(inbox)  # a port that is gone says so without a line
        while (frame := wire.cyclic.receive()) is not None:
            if frame[0] & ERROR_FLAG:
                self.failure = error_frame_text(frame[0]) or self.failure
            elif frame[0] in self._names:
                inbox.take(self._names[frame[0]], frame[1])
        return wire.t_ns

    def _read(self, inbox: Inbox) -> bool:
        """Take what has arrived; False where nothing has, or the port is gone."""
        try:
            data = self._wire.serial.read()
        except LinkError as error:
            self.failure = str(error)
            self._port_failed = True
            return False
        if not data:
            return False
        self._add(inbox, data, self._wire.serial.arrival_t_ns)
        return True

    def _add(self, inbox: Inbox, data: bytes, arrival_t_ns: int) -> None:
        """Give the inbox what its row can hold, keep the rest for the next."""
        room = CHUNK_LIMIT_BYTES - len(inbox.sensor_bytes)
        inbox.add_sensor_bytes(data[:room], arrival_t_ns)
        self._kept = data[room:]

    def send(self, frames: list[tuple[int, bytes]]) -> tuple[bool, int]:
        """Queue frames after the tick's time; the bus's arbitration does the rest."""
        wire = self._wire
        wire.advance_to(wire.t_ns + self._tick_ns)
        sent = True
        for can_id, payload in frames:
            sent &= wire.cyclic.send(can_id, payload)
        before_t_ns, give_up_t_ns = wire.last_sync_t_ns, wire.t_ns + _SYNC_PATIENCE_NS
        while wire.last_sync_t_ns == before_t_ns and wire.t_ns < give_up_t_ns:
            wire.advance_to(wire.t_ns + _SYNC_STEP_NS)
        return sent, wire.last_sync_t_ns


class BatchBackend:
    """Rig, wire and servo in one process and in virtual time: deterministic for a seed."""

    name = "batch"
    may_move = True
    vendor_id = RIG_VENDOR_ID
    synchronous = True

    def __init__(self, machine, *, seed: int = 0, tick_s: float = 60e-6, faults=(), rig: Rig | None = None):
        """Make the rig of a machine."""
        self.rig = Rig(machine, seed=seed, faults=faults) if rig is None else rig
        self.wire = BatchWire(self.rig)
        self.description = f"software rig {machine.name}, virtual time, seed {seed}"
        self.seed = seed
        self.remarks: list[str] = []
        self._tick_ns = round(tick_s * 1e9)
        self.servo: Servo | None = None

    def network_bus(self) -> can.BusABC:
        """Return the bus of the master."""
        return self.wire.network_bus

    def clock_s(self) -> float:
        """Return virtual time."""
        return self.wire.t_ns * 1e-9

    def pause(self, duration_s: float) -> None:
        """Let virtual time pass."""
        self.wire.advance_to(self.wire.t_ns + round(duration_s * 1e9))

    def start_servo(self, profile: Profile, mappings: Mapping[str, DriveMapping], run_folder: Path) -> ServoLink:
        """Make the servo in this process; it runs when time passes."""
        with contextlib.suppress(LinkError):  # of a port that is gone the servo says so
            self.wire.serial.read()  # lines that waited are old: their arrival says nothing
        decoder = WireDecoder(profile, mappings)
        encoder = WireEncoder(profile, mappings)
        tracker = Tracker(profile, has_drives=True)
        snapshot = {**decoder.snapshot(), "belief": tracker.new_belief()}
        segments = np.zeros(SEGMENT_ROWS, SETPOINT)
        requests = RequestWriter(None, REQUEST)
        status = RequestWriter(None, STATUS)
        ring = RingWriter(None, run_folder=run_folder)
        transport = BatchTransport(self.wire, frame_names(mappings), self._tick_ns)
        servo = Servo(
            profile, decoder, encoder, tracker, transport, segments, requests.reader(), status, ring, lambda: 0
        )
        self.servo = servo

        def pass_time(duration_s: float) -> None:
            until_t_ns = self.wire.t_ns + round(duration_s * 1e9)
            with undisturbed():  # a cycle that Ctrl-C splits would lack its row
                while self.wire.t_ns < until_t_ns:
                    servo.cycle()

        def end() -> None:
            requests.publish({"mode": int(Mode.EXIT)})
            until_t_ns = self.wire.t_ns + round(_END_S * 1e9)
            leaving = 0
            while self.wire.t_ns < until_t_ns and not (leaving > 1 and (servo.released or leaving > RELEASE_CYCLES)):
                servo.cycle()
                leaving += servo.phase in RESTING

        return ServoLink(
            requests=requests,
            status=status.reader(),
            rows=ring.reader(),
            segments=segments,
            tracker_belief=tracker.new_belief(),
            snapshot=snapshot,
            pass_time=pass_time,
            now_t_ns=lambda: self.wire.t_ns,
            close=end,
            forget_rows=lambda: None,
        )

    def truth(self) -> dict[str, np.ndarray]:
        """Return the rig's log."""
        return self.rig.truth.arrays()

    def close(self) -> None:
        """Nothing outside this process."""


class _Child:
    """A process of ours that talks in JSON lines over stdin and stdout."""

    def __init__(self, name: str, command: list[str]):
        self.name = name
        self.process = subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            bufsize=1,
            cwd=_ROOT,
            env=_CHILD_ENVIRONMENT,
            process_group=0,  # Ctrl-C and Ctrl-Z are for the command: a frozen servo stops no stage
        )
        self._has_spoken = False

    def tell(self, message: dict) -> None:
        """Send one line; LinkError where the process is gone."""
        try:
            self.process.stdin.write(json.dumps(message) + "\n")  # pyright: ignore[reportOptionalMemberAccess]
            self.process.stdin.flush()  # pyright: ignore[reportOptionalMemberAccess]
        except OSError as error:
            raise LinkError(f"the {self.name} process is gone ({self._end()}); see its messages above") from error

    def hear(self, timeout_s: float) -> dict:
        """Return the next line; LinkError on silence, end or a reported error."""
        stdout = self.process.stdout
        ready = stdout is not None and select.select([stdout], [], [], timeout_s)[0]
        line = stdout.readline() if ready and stdout is not None else ""
        if not line and ready:
            with contextlib.suppress(subprocess.TimeoutExpired):
                self.process.wait(2.0)  # its exit code comes right behind the end of its words
            raise LinkError(f"the {self.name} process has nothing more to say ({self._end()}); see its messages above")
        if not line:
            raise LinkError(f"the {self.name} process said nothing within {timeout_s:g} s ({self._end()})")
        self._has_spoken = True
        message = json.loads(line)
        if "error" in message:
            raise _KINDS.get(message.get("kind", ""), LinkError)(f"{self.name}: {message['error']}")
        return message

    def _end(self) -> str:
        code = self.process.poll()
        return "still running" if code is None else f"ended with {code}"

    @property
    def running(self) -> bool:
        """Whether the process still lives."""
        return self.process.poll() is None

    def stop(self, timeout_s: float = 10.0) -> None:
        """End it: terminate, then kill; at once where it still compiles, and holds nothing that moves."""
        for stream in (self.process.stdin, self.process.stdout):
            if stream is not None:
                stream.close()
        if self.running and self._has_spoken:
            self.process.terminate()
        elif self.running:
            self.process.kill()
        try:
            self.process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()


# numpy's and numba's library pools would put idle threads beside the servo's only one.
_CHILD_ENVIRONMENT = {**os.environ, "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
_ROOT = Path(__file__).resolve().parent.parent
_KINDS = {kind.__name__: kind for kind in (DriveError, LinkError, ProfileError, RecordError, TimingError)}
_WARM_TIMEOUT_S = 180.0  # a cold compile cache on a slow host
_SERVO_START_TIMEOUT_S = 30.0
_RIG_ANSWER_S = 5.0


class RealtimeBackend:
    """Servo in a process of its own, on a real clock; what bus and port lead to is the caller's business."""

    synchronous = False
    may_move = True

    def __init__(self, profile: Profile, name: str, vendor_id: int | None, interface: str, channel: str, port: str):
        """Take what is needed; nothing is started or opened yet."""
        self.name, self.vendor_id = name, vendor_id
        self.description = f"{name}: CAN {interface} {channel}, interferometer {port}"
        self.remarks: list[str] = []
        self._interface, self._channel, self._port = interface, channel, port
        self._profile = profile
        self._warming: _Child | None = None
        self._warm = False
        self._paths: dict[str, Path] = {}

    def network_bus(self) -> can.BusABC:
        """Open the master's bus."""
        return open_network(self._interface, self._channel)

    def clock_s(self) -> float:
        """Return the clock of heartbeat ages."""
        return time.monotonic()

    def pause(self, duration_s: float) -> None:
        """Sleep."""
        time.sleep(duration_s)

    def _servo(self) -> _Child:
        """Return the servo's process, begun where it wasn't: it compiles or loads everything, and opens nothing.

        Not before somebody needs it: a stage whose drives are silent would load one at each try, seconds of a CPU.
        """
        if self._warming is None:
            self._warming = _Child("servo", [sys.executable, "-m", "stagectl.servo_process"])
            self._warming.tell(self._profile.effective())
        return self._warming

    @property
    def servo_pid(self) -> int:
        """Process id of the servo."""
        return self._servo().process.pid

    def wait_warm(self) -> None:
        """Wait until the servo has compiled or loaded everything."""
        if not self._warm:
            self._servo().hear(_WARM_TIMEOUT_S)
            self._warm = True

    def start_servo(self, profile: Profile, mappings: Mapping[str, DriveMapping], run_folder: Path) -> ServoLink:
        """Give the servo its bus, port and memory; it cycles when this returns."""
        self.wait_warm()
        token = f"{os.getpid()}-{secrets.token_hex(4)}"
        blocks = ("ring", "requests", "status", "segments")
        paths = {name: SHARED_MEMORY / f"stagectl-{token}.{name}" for name in blocks}
        self._paths = paths
        segments = np.memmap(paths["segments"], dtype=SETPOINT, mode="w+", shape=(SEGMENT_ROWS,))
        requests = RequestWriter(paths["requests"], REQUEST)
        cpus = sorted(os.sched_getaffinity(0))
        self._servo().tell(
            {
                "supervisor_pid": os.getpid(),
                "profile": profile.effective(),
                "mappings": {axis: describe_mapping(mapping) for axis, mapping in mappings.items()},
                "interface": self._interface,
                "channel": self._channel,
                "port": self._port,
                "baud_bit_per_s": profile.interferometer.baud_bit_per_s,
                "run_folder": str(run_folder.absolute()),  # it may lead elsewhere later
                "cpu": cpus[-1] if len(cpus) > 1 else None,
                **{name: str(path) for name, path in paths.items()},
            }
        )
        answer = self._servo().hear(_SERVO_START_TIMEOUT_S)
        self.remarks = [f"the host refused the servo {what}" for what in answer["refused"]] + answer["warnings"]
        tracker_belief = estimator.belief(profile)
        snapshot = {**WireDecoder(profile, mappings).snapshot(), "belief": tracker_belief}
        return ServoLink(
            requests=requests,
            status=RequestReader.attach(paths["status"], STATUS),
            rows=RingReader.attach(paths["ring"]),
            segments=segments,
            tracker_belief=tracker_belief,
            snapshot=snapshot,
            pass_time=self._pass_time,
            now_t_ns=now_t_ns,
            close=lambda: self._end_servo(requests),
            forget_rows=lambda: paths["ring"].unlink(missing_ok=True),
        )

    def _pass_time(self, duration_s: float) -> None:
        """Sleep; LinkError where the servo has died meanwhile."""
        time.sleep(duration_s)
        if not self._servo().running:
            raise LinkError(
                f"the servo process ended with {self._servo().process.returncode}; the drives stop the stage by "
                "themselves; its last cycles are in the run"
            )

    def _end_servo(self, requests: RequestWriter) -> None:
        """Ask the servo to exit and wait for it."""
        requests.publish({"counter": 1 << 40, "mode": int(Mode.EXIT)})
        try:
            self._servo().process.wait(_END_S)
        except subprocess.TimeoutExpired:
            self._servo().stop()

    def truth(self) -> dict[str, np.ndarray] | None:
        """Nobody knows what is true of a machine."""
        return None

    def close(self) -> None:
        """End the servo and remove the shared memory; rows that nobody drained stay for the next start."""
        if self._warming is not None:
            self._warming.stop()
        for name, path in self._paths.items():
            if name != "ring":
                path.unlink(missing_ok=True)


class HardwareBackend(RealtimeBackend):
    """The machine that the profile describes."""

    def __init__(self, profile: Profile):
        """Take bus and port from the profile; every node must show the profile's identity."""
        super().__init__(
            profile, "hardware", None, profile.can.interface, profile.can.channel, profile.interferometer.port
        )


def ask_rig(channel: str, message: dict) -> dict:
    """Send a request to the rig process behind a hub's socket and return its answer; LinkError where none comes."""
    asked = connect_hub(channel)
    try:
        asked.settimeout(_RIG_ANSWER_S)
        asked.send(b"FILT")
        asked.send(b"RIG " + json.dumps(message).encode())
        while not (answer := asked.recv(1 << 16)).startswith(b"RIG "):
            if not answer:  # the end of the connection; what else comes was under way before the filter took effect
                raise LinkError(f"rig {channel}: it ended without an answer; start it again")
    except OSError as error:
        raise LinkError(f"rig {channel}: no answer: {error.strerror or error}; is it still running?") from error
    finally:
        asked.close()
    return json.loads(answer.removeprefix(b"RIG "))


RIG, RIG_DRIVES, RIG_SENSOR = "rig", "rig-drives", "rig-sensor"
"""Which part the rig plays: all of the stage; its drives, on a real interferometer; its interferometer alone."""


class RigBackend(RealtimeBackend):
    """The software rig in a process of its own: the same bytes, in real time."""

    def __init__(
        self, profile: Profile, machine: str | Path, *, seed: int = 0, linger_s: float = 5.0, plays: str = RIG
    ):
        """Start the rig; servo and rig compile side by side. It outlives a killed owner by `linger_s`.

        What it doesn't play is the profile's hardware; real drives on its interferometer may never move.
        """
        self._folder = Path(tempfile.mkdtemp(prefix="stagectl-rig-"))
        self._rig_channel, port = str(self._folder / "can.socket"), str(self._folder / "interferometer")
        self.may_move = plays != RIG_SENSOR
        drives = (RIG_VENDOR_ID, "hub", self._rig_channel)
        if plays == RIG_SENSOR:
            drives = (None, profile.can.interface, profile.can.channel)
        sensor = profile.interferometer.port if plays == RIG_DRIVES else port
        super().__init__(profile, plays, *drives, sensor)
        self.seed = seed
        self._truth_path = self._folder / "truth.npz"
        command = [sys.executable, "-m", "sim_backend", str(machine), "--socket", self._rig_channel, "--pty-link", port]
        command += ["--seed", str(seed), "--truth", str(self._truth_path), "--linger-s", str(linger_s)]
        command += ["--own-folder", str(self._folder)]
        self._rig = _Child("rig", command)
        try:
            self._servo()  # begun now, for both to compile side by side
            self._rig.hear(_WARM_TIMEOUT_S)
        except BaseException:
            with undisturbed():
                self.close()
            raise
        with_what = {
            RIG: "",
            RIG_DRIVES: f" for the drives, real interferometer {sensor}",
            RIG_SENSOR: f" for the interferometer, real drives on {self._interface} {self._channel}, watched only",
        }
        self.description = f"software rig {Path(machine).stem}{with_what[plays]}, real time, seed {seed}"

    @property
    def channel(self) -> str:
        """Path of the hub's socket."""
        return self._rig_channel

    @property
    def rig_pid(self) -> int:
        """Process id of the rig."""
        return self._rig.process.pid

    def request(self, message: dict) -> dict:
        """Ask the rig process something: {"fault": ...}, {"truth": path}, {"state": true}."""
        return ask_rig(self._rig_channel, message)

    def truth(self) -> dict[str, np.ndarray] | None:
        """Return the rig's log so far; None where the rig is dead. LinkError where it lives and does not answer.

        Nobody knows what is true of a stage of which a part is real.
        """
        if self.name != RIG:
            return None
        try:
            self.request({"truth": str(self._truth_path)})
        except LinkError:
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._rig.process.wait(1.0)  # of a process that is killed the socket closes first
            if self._rig.running:
                raise
            return None
        with np.load(self._truth_path) as stored:
            return {name: stored[name] for name in stored.files}

    def close(self) -> None:
        """End servo and rig."""
        super().close()
        self._rig.stop()
        shutil.rmtree(self._folder, ignore_errors=True)
