"""Faults as data: what breaks, when, for how long. The rig and its wires carry them out.

Instants are seconds since the rig's start; `at_s` of a fault handed to a running rig counts from that moment.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields
from typing import Any

from stagectl.errors import ProfileError

BUS_KINDS = ("drop_frame", "delay_frame", "duplicate_frame", "short_frame", "corrupt_frame", "bus_off")
DRIVE_KINDS = (
    "emergency",
    "heartbeat_silence",
    "input",
    "stuck_statusword",
    "power_loss",  # it is dark as long as this lasts, then boots
    "object_change",  # somebody else writes an object
    "encoder_jump",
    "flood",  # it talks without end
)
SENSOR_KINDS = (
    "beam_loss",
    "stuck_counts",
    "garbage",
    "half_line",
    "sequence_gap",
    "sensor_restart",
    "sensor_silence",
    "unplug",
    "clock_drift",
)
MACHINE_KINDS = ("edge_jump", "obstacle", "weak_motor")
KINDS = BUS_KINDS + DRIVE_KINDS + SENSOR_KINDS + MACHINE_KINDS

_NEEDS = {
    "drop_frame": ("can_id",),
    "delay_frame": ("can_id", "delay_s"),
    "duplicate_frame": ("can_id",),
    "short_frame": ("can_id", "length_count"),
    "corrupt_frame": ("can_id", "bits"),
    "emergency": ("node_id", "code"),
    "heartbeat_silence": ("node_id",),
    "input": ("node_id", "bits"),
    "stuck_statusword": ("node_id",),
    "power_loss": ("node_id",),
    "object_change": ("node_id", "index", "subindex", "value"),
    "encoder_jump": ("node_id", "offset_m"),
    "flood": ("node_id", "can_id", "count"),
    "beam_loss": ("axis",),
    "garbage": ("count",),
    "half_line": ("length_count",),
    "sequence_gap": ("count",),
    "clock_drift": ("ppm",),
    "edge_jump": ("offset_m",),
    "obstacle": ("offset_m",),
    "weak_motor": ("node_id", "force_ratio"),
}
_FOREVER_S = 1e9


@dataclass(frozen=True, slots=True)
class Fault:
    """One fault; which fields it needs depends on its kind."""

    kind: str
    at_s: float = 0.0
    duration_s: float = _FOREVER_S  # of those that last
    count: int | None = None  # frames of the bus kinds (None = all while it lasts), bytes of garbage, numbers skipped
    can_id: int | None = None
    node_id: int | None = None
    delay_s: float | None = None
    length_count: int | None = None  # bytes that are left
    code: int | None = None
    bits: int | None = None  # of 0x60FD, or those of a payload (little-endian) that turn over
    index: int | None = None  # of an object
    subindex: int | None = None
    value: int | None = None
    offset_m: float | None = None  # of encoder or right edge; of an obstacle, from where the macro is
    force_ratio: float | None = None  # of what a motor gave before
    ppm: float | None = None
    seed: int | None = None  # of the bytes of garbage; None = letters, none of which belongs to a line
    axis: str | None = None  # macro | end | both


def fault_of(table: Mapping[str, Any]) -> Fault:
    """Make a Fault from a table (TOML, JSON); ProfileError names what is wrong with it."""
    known = {field.name for field in fields(Fault)}
    unknown = sorted(set(table) - known)
    kind = table.get("kind")
    if kind not in KINDS:
        raise ProfileError(f"fault.kind = {kind!r} is unknown; choose from {', '.join(KINDS)}")
    if unknown:
        raise ProfileError(
            f"fault {kind}: {unknown[0]} is not a key of a fault; choose from {', '.join(sorted(known))}"
        )
    for name in _NEEDS.get(str(kind), ()):
        if table.get(name) is None:
            raise ProfileError(f"fault {kind}: {name} is missing; add it")
    fault = Fault(**table)
    for name in ("at_s", "duration_s", "delay_s"):
        value = getattr(fault, name)
        if value is not None and not 0.0 <= value <= _FOREVER_S:
            raise ProfileError(f"fault {kind}: {name} = {value} is outside 0 .. {_FOREVER_S:g} s; correct it")
    if kind == "beam_loss" and fault.axis not in ("macro", "end", "both"):
        raise ProfileError(f"fault beam_loss: axis = {fault.axis!r}; choose macro, end or both")
    return fault


class FaultSchedule:
    """Beginnings and ends of faults, in the order of their instants."""

    def __init__(self, faults: Iterable[Fault] = (), start_t_ns: int = 0) -> None:
        self._steps: list[tuple[int, int, bool, Fault]] = []  # instant, number, begins, fault
        self._number = 0
        for fault in faults:
            self.add(fault, start_t_ns)

    def add(self, fault: Fault, origin_t_ns: int) -> None:
        """Plan a fault; its `at_s` counts from `origin_t_ns`."""
        begin_t_ns = origin_t_ns + round(1e9 * fault.at_s)
        self._number += 1
        self._steps.append((begin_t_ns, self._number, True, fault))
        if fault.duration_s < _FOREVER_S:
            end_t_ns = begin_t_ns + round(1e9 * fault.duration_s)
            self._steps.append((end_t_ns, self._number, False, fault))
        self._steps.sort(key=lambda step: (step[0], step[1], not step[2]))

    @property
    def next_t_ns(self) -> int | None:
        """Instant of the next beginning or end, None when nothing is left."""
        return self._steps[0][0] if self._steps else None

    def due(self, t_ns: int) -> list[tuple[bool, Fault]]:
        """Take what begins (True) or ends (False) up to `t_ns`."""
        taken = []
        while self._steps and self._steps[0][0] <= t_ns:
            _, _, begins, fault = self._steps.pop(0)
            taken.append((begins, fault))
        return taken


class WireFaults:
    """What the bus does to frames while bus faults last."""

    def __init__(self) -> None:
        self._active: list[Fault] = []
        self.is_clean = True  # frames pass untouched
        self.struck_count = 0  # frames that did not
        self._left: dict[int, int] = {}  # frames that a counted fault still takes, by id of the fault object

    @property
    def is_bus_off(self) -> bool:
        """Tell that nothing can be sent or received."""
        return any(fault.kind == "bus_off" for fault in self._active)

    def change(self, begins: bool, fault: Fault) -> None:
        """Begin or end a bus fault."""
        if begins:
            self._active.append(fault)
            if fault.count is not None:
                self._left[id(fault)] = fault.count
        elif fault in self._active:
            self._active.remove(fault)
        self.is_clean = not self._active

    def passed(self, can_id: int, payload: bytes) -> list[tuple[int, bytes]]:
        """Return what becomes of a frame: (delay in ns, payload) of each copy that arrives."""
        copies = [(0, payload)]
        for fault in list(self._active):
            if fault.kind == "bus_off":
                self.struck_count += 1
                return []
            if fault.can_id != can_id:
                continue
            if fault.count is not None:
                left = self._left.get(id(fault), 0)
                if left <= 0:
                    continue
                self._left[id(fault)] = left - 1
            self.struck_count += 1
            if fault.kind == "drop_frame":
                return []
            if fault.kind == "delay_frame":
                copies = [(delay_ns + round(1e9 * (fault.delay_s or 0.0)), data) for delay_ns, data in copies]
            elif fault.kind == "duplicate_frame":
                copies = copies + copies
            elif fault.kind == "short_frame":
                copies = [(delay_ns, data[: fault.length_count]) for delay_ns, data in copies]
            elif fault.kind == "corrupt_frame":
                copies = [(delay_ns, _turned_over(data, fault.bits or 0)) for delay_ns, data in copies]
        return copies


def _turned_over(payload: bytes, bits: int) -> bytes:
    """Invert bits of a payload, the first byte's lowest first."""
    mask = (1 << 8 * len(payload)) - 1
    return ((int.from_bytes(payload, "little") ^ bits) & mask).to_bytes(len(payload), "little")
