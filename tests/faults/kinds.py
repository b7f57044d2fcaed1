"""What can go wrong, drawn from a seed: the fault, how soon it must be noticed, and whether the stage may go on.

Numbers of detection are those of the profile and of the drives' own watches; nothing here asks the controller.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from sim_backend.drive_states import Order, order_of
from sim_backend.faults import Fault
from tests.faults.draws import between, one_of
from tests.faults.nonsense import Nonsense, nonsense

MACRO, MICRO = 1, 2  # node ids
SYNC, MACRO_TPDO, MICRO_TPDO, MACRO_RPDO, MICRO_RPDO = 0x080, 0x181, 0x182, 0x201, 0x202
MASTER_HEARTBEAT = 0x77E
EMCYS = (0x081, 0x082)
CYCLIC = (SYNC, MACRO_TPDO, MICRO_TPDO, MACRO_RPDO, MICRO_RPDO)
TPDOS, RPDOS = (MACRO_TPDO, MICRO_TPDO), (MACRO_RPDO, MICRO_RPDO)

CYCLE_S = 1e-3
SILENCE_S = 0.021  # 20 cycles without process data, RPDO or SYNC, and the one that notices
REPEATS_S = 0.014  # 12 samples that repeat one, and two cycles
AT_ONCE_S = 0.003  # a line on its way, the cycle that reads it, one more
_HEARTBEAT_S = 0.265  # trip.heartbeat_s, a heartbeat's own period, and two looks of the supervisor
_MASTER_HEARTBEAT_S = 0.205
_SUPERVISOR_S = 0.5 + 2 * CYCLE_S
_LEASE_S = 2.0  # what a lease lasts that nobody renews
JOG_HOLD_S = 0.3  # for how long a word of a jog's operator holds
FRAME_S = 130e-6  # eight bytes at 1 Mbit/s
NEVER_S = float("inf")
_ENABLE_OPERATION = 0x000F  # the controlword of a drive that follows

MOVING = ("accelerating", "constant speed", "decelerating")
PHASES = ("at rest", *MOVING, "jogging", "identifying", "homing", "stopping")


@dataclass(frozen=True)
class Drawn:
    """One fault as it was drawn."""

    text: str
    faults: tuple[Fault, ...] = ()
    act: Callable[[Any], None] | None = None  # on a scene, for what no rig can do: host, client, disk
    must_stop: bool = True
    may_stop: bool = True
    detection_s: float = NEVER_S  # NEVER_S: from the instant that the controller says it noticed
    lasts_s: float = 0.0
    without_power: tuple[int, ...] = ()  # nodes that can't brake
    deaf: tuple[int, ...] = ()  # nodes that hear no command: their own watch stops them
    told_late_s: float = 0.0  # by which what the macro's drive is told comes late: its stop, too
    kicked_s: float = 0.0  # for which the macro's drive is told a force that is not the law's,
    kicked_words: int = 0  # by how many 0.1 % of its rated one
    open_loop: bool = False  # the drive keeps its last force until the fault is noticed
    silent: bool = False  # the operator says nothing more: a jog ends by its own hold, before the lease does
    encoder_m: float = 0.0  # by which the drive's own encoder is off for a while: it holds on that
    swings: bool = False  # the end, with nothing that holds it: the macro's drive feels that while it settles
    obstacle_m: float | None = None  # how far away one lies on both sides; by how much it pushes back is not judged
    by_lasers: bool = False  # of what only a law goes by: while the drive homes by itself it must stop nothing
    nonsense: Nonsense | None = None  # what the profile is edited to; it is read when the stage has no power


Draw = Callable[[np.random.Generator, str], Drawn]


def grave(rng: np.random.Generator) -> bool:
    """Draw whether a fault is one that must stop the stage, as often as one that may go by."""
    return bool(rng.random() < 0.5)


def _lost(rng: np.random.Generator, ids: tuple[int, ...], low_s: float, detection_s: float, what: str) -> Drawn:
    can_id, duration_s = one_of(rng, ids), between(rng, low_s, 0.6)
    fault = Fault("drop_frame", can_id=can_id, duration_s=duration_s)
    must = duration_s > detection_s + 0.01
    return Drawn(
        f"{what} 0x{can_id:03X} lost for {duration_s * 1e3:.0f} ms",
        (fault,),
        must_stop=must,
        detection_s=detection_s if must else NEVER_S,
        lasts_s=duration_s,
    )


def frames_lost(rng: np.random.Generator, phase: str) -> Drawn:
    return _lost(rng, CYCLIC, 2e-3, SILENCE_S, "frame")


def few_frames_lost(rng: np.random.Generator, phase: str) -> Drawn:
    can_id, count = one_of(rng, (*CYCLIC, *EMCYS)), int(rng.integers(1, 4))
    if can_id in EMCYS:  # no drive sends one without trouble; its statusword is all that says so then
        node_id = can_id & 0x7F
        lost = Fault("drop_frame", can_id=can_id, duration_s=0.3)
        trouble = Fault("emergency", at_s=CYCLE_S, node_id=node_id, code=0x2310)
        text = f"EMCY 0x2310 of node {node_id} lost"
        return Drawn(text, (lost, trouble), detection_s=AT_ONCE_S + CYCLE_S, lasts_s=0.3)
    fault = Fault("drop_frame", can_id=can_id, count=count, duration_s=0.3)
    return Drawn(f"{count} frames 0x{can_id:03X} lost", (fault,), must_stop=False, lasts_s=0.3)


def frames_late(rng: np.random.Generator, phase: str) -> Drawn:
    can_id, delay_s, duration_s = one_of(rng, CYCLIC), between(rng, 3e-4, 8e-3), between(rng, 0.01, 0.3)
    fault = Fault("delay_frame", can_id=can_id, delay_s=delay_s, duration_s=duration_s)
    text = f"frame 0x{can_id:03X} late by {delay_s * 1e3:.1f} ms for {duration_s * 1e3:.0f} ms"
    told_late_s = delay_s if can_id == MACRO_RPDO else 0.0
    return Drawn(text, (fault,), must_stop=False, lasts_s=duration_s, told_late_s=told_late_s)


def frames_reordered(rng: np.random.Generator, phase: str) -> Drawn:
    """By one to three frames' time: an RPDO comes behind its SYNC, a TPDO behind the other's."""
    can_id, delay_s, duration_s = one_of(rng, (*TPDOS, *RPDOS)), between(rng, 1e-4, 3e-4), between(rng, 0.01, 0.5)
    fault = Fault("delay_frame", can_id=can_id, delay_s=delay_s, duration_s=duration_s)
    text = f"frame 0x{can_id:03X} behind its followers for {duration_s * 1e3:.0f} ms"
    return Drawn(text, (fault,), must_stop=False, lasts_s=duration_s)


def frames_doubled(rng: np.random.Generator, phase: str) -> Drawn:
    can_id, duration_s = one_of(rng, CYCLIC), between(rng, 0.01, 0.5)
    fault = Fault("duplicate_frame", can_id=can_id, duration_s=duration_s)
    return Drawn(
        f"frame 0x{can_id:03X} doubled for {duration_s * 1e3:.0f} ms", (fault,), must_stop=False, lasts_s=duration_s
    )


def frames_corrupted(rng: np.random.Generator, phase: str) -> Drawn:
    """Bits turn over behind the bus's own check: a gateway, a driver's bug.

    Where they make another order of a controlword, the drive obeys: it stops, or its power is gone.
    """
    can_id, count = one_of(rng, (*TPDOS, *RPDOS)), int(rng.integers(1, 6))
    bits = sum(1 << int(k) for k in rng.choice(32, size=int(rng.integers(1, 4)), replace=False))
    fault = Fault("corrupt_frame", can_id=can_id, bits=bits, count=count, duration_s=0.1)
    text, node_id = f"{count} frames 0x{can_id:03X} with bits 0x{bits:08X}", can_id & 0x7F
    order = order_of(_ENABLE_OPERATION ^ bits & 0xFFFF) if can_id in RPDOS else Order.ENABLE_OPERATION
    if order == Order.ENABLE_OPERATION:
        words = bits >> 16 if can_id == MACRO_RPDO else 0
        return Drawn(text, (fault,), must_stop=False, lasts_s=0.1, kicked_s=count * CYCLE_S, kicked_words=words)
    return Drawn(
        text,
        (fault,),
        must_stop=phase != "homing",  # which gives a drive no power before it needs it
        detection_s=AT_ONCE_S,
        lasts_s=0.1,
        without_power=() if order == Order.QUICK_STOP else (node_id,),
    )


def frames_short(rng: np.random.Generator, phase: str) -> Drawn:
    can_id = one_of(rng, (*TPDOS, *RPDOS))
    length = int(rng.integers(0, 4))
    fault = Fault("short_frame", can_id=can_id, length_count=length, duration_s=0.05)
    deaf = (can_id & 0x7F,) if can_id in RPDOS else ()
    return Drawn(
        f"frame 0x{can_id:03X} of {length} bytes",
        (fault,),
        detection_s=SILENCE_S if MACRO in deaf else AT_ONCE_S,
        lasts_s=0.05,
        deaf=deaf,
    )


def bus_off(rng: np.random.Generator, phase: str) -> Drawn:
    duration_s = between(rng, 0.01, 0.8)
    fault = Fault("bus_off", duration_s=duration_s)
    return Drawn(f"bus-off for {duration_s * 1e3:.0f} ms", (fault,), detection_s=AT_ONCE_S, lasts_s=duration_s)


def bus_full(rng: np.random.Generator, phase: str) -> Drawn:
    """A node with a better id talks: nothing else gets through, and the queue refuses (ENOBUFS)."""
    count = round(between(rng, 30, 3000))
    duration_s = count * FRAME_S
    must = duration_s > 2.5 * SILENCE_S
    return Drawn(
        f"bus full for {duration_s * 1e3:.0f} ms",
        (Fault("flood", node_id=MACRO, can_id=0x001, count=count),),
        must_stop=must,
        detection_s=2 * SILENCE_S if must else NEVER_S,
        lasts_s=duration_s,
    )


def emergency(rng: np.random.Generator, phase: str) -> Drawn:
    node_id, code = one_of(rng, (MACRO, MICRO)), one_of(rng, (0x2310, 0x3210, 0x4210, 0x7305, 0x8611))
    fault = Fault("emergency", node_id=node_id, code=code)
    return Drawn(f"EMCY 0x{code:04X} of node {node_id}", (fault,), detection_s=AT_ONCE_S)


def statusword_stuck(rng: np.random.Generator, phase: str) -> Drawn:
    """Alone it says nothing wrong; where the drive fails meanwhile, its EMCY is all that says so."""
    must = grave(rng)
    node_id, duration_s = one_of(rng, (MACRO, MICRO)), between(rng, 0.05, 1.0)
    fault = Fault("stuck_statusword", node_id=node_id, duration_s=duration_s)
    text = f"statusword of node {node_id} stuck for {duration_s * 1e3:.0f} ms"
    if not must:
        return Drawn(text, (fault,), must_stop=False, lasts_s=duration_s)
    fails_s = CYCLE_S * int(rng.integers(1, 20))
    trouble = Fault("emergency", at_s=fails_s, node_id=node_id, code=0x2310)
    text += f", EMCY 0x2310 after {fails_s * 1e3:.0f} ms"
    return Drawn(text, (fault, trouble), detection_s=AT_ONCE_S + fails_s, lasts_s=duration_s)


def drive_reboot(rng: np.random.Generator, phase: str) -> Drawn:
    node_id, duration_s = one_of(rng, (MACRO, MICRO)), between(rng, 0.03, 1.0)
    fault = Fault("power_loss", node_id=node_id, duration_s=duration_s)
    text = f"node {node_id} dark for {duration_s * 1e3:.0f} ms, then boots"
    return Drawn(text, (fault,), detection_s=SILENCE_S, lasts_s=duration_s, without_power=(node_id,))


_CHANGES = (
    ("TPDO1 carries the inputs for the position", 0x1A00, 2, 0x60FD_0020),
    ("TPDO1 off", 0x1800, 1, 0xC000_0180),
    ("RPDO1 off", 0x1400, 1, 0x8000_0200),
    ("mode of operation: cyclic position", 0x6060, 0, 8),
)


def mapping_changed(rng: np.random.Generator, phase: str) -> Drawn:
    """Another master's tool configures a drive while it works.

    Another mode is told by the drive itself; a homing writes the mode, too.
    """
    what, index, subindex, value = one_of(rng, _CHANGES)
    node_id = MACRO if index in (0x1A00, 0x6060) else one_of(rng, (MACRO, MICRO))
    if index in (0x1400, 0x1800):
        value |= node_id
    fault = Fault("object_change", node_id=node_id, index=index, subindex=subindex, value=value)
    must = index != 0x6060 or phase != "homing"
    detection_s = (AT_ONCE_S if index == 0x6060 else SILENCE_S) if must else NEVER_S
    return Drawn(f"node {node_id}: {what}", (fault,), must_stop=must, detection_s=detection_s)


def drive_heartbeat_lost(rng: np.random.Generator, phase: str) -> Drawn:
    node_id, duration_s = one_of(rng, (MACRO, MICRO)), between(rng, 0.05, 1.0)
    must = duration_s > _HEARTBEAT_S + 0.1
    return Drawn(
        f"no heartbeat of node {node_id} for {duration_s * 1e3:.0f} ms",
        (Fault("heartbeat_silence", node_id=node_id, duration_s=duration_s),),
        must_stop=must,
        detection_s=_HEARTBEAT_S if must else NEVER_S,
        lasts_s=duration_s,
    )


def master_heartbeat_lost(rng: np.random.Generator, phase: str) -> Drawn:
    return _lost(rng, (MASTER_HEARTBEAT,), 0.05, _MASTER_HEARTBEAT_S, "heartbeat")


def encoder_glitch(rng: np.random.Generator, phase: str) -> Drawn:
    """Counts appear from nowhere; what is less than 50 um and a period's way is not told apart from jitter.

    In a homing the lasers have no zero yet that the encoder could be held against.
    """
    must, sign = grave(rng) and phase != "homing", one_of(rng, (-1.0, 1.0))
    offset_m = sign * (between(rng, 1.2e-3, 5e-3) if must else between(rng, 5e-6, 1.2e-3))
    duration_s = between(rng, 0.03, 0.5) if must else between(rng, 1e-3, 0.5)
    return Drawn(
        f"macro encoder off by {offset_m * 1e6:.0f} um for {duration_s * 1e3:.0f} ms",
        (Fault("encoder_jump", node_id=MACRO, offset_m=offset_m, duration_s=duration_s),),
        must_stop=must,
        detection_s=0.02 if must else NEVER_S,
        lasts_s=duration_s,
        encoder_m=abs(offset_m),
    )


def beam_break(rng: np.random.Generator, phase: str) -> Drawn:
    axis, duration_s = one_of(rng, ("macro", "end", "both")), between(rng, 2e-3, 0.8)
    fault = Fault("beam_loss", axis=axis, duration_s=duration_s)
    return Drawn(
        f"no beam on {axis} for {duration_s * 1e3:.0f} ms",
        (fault,),
        detection_s=AT_ONCE_S,
        lasts_s=duration_s,
        by_lasers=True,
    )


def sensor_silence(rng: np.random.Generator, phase: str) -> Drawn:
    must = grave(rng)
    duration_s = between(rng, SILENCE_S + 5e-3, 0.8) if must else between(rng, 1e-3, SILENCE_S + 5e-3)
    return Drawn(
        f"interferometer silent for {duration_s * 1e3:.0f} ms",
        (Fault("sensor_silence", duration_s=duration_s),),
        must_stop=must,
        detection_s=SILENCE_S + CYCLE_S if must else NEVER_S,
        lasts_s=duration_s,
        by_lasers=True,
    )


def sensor_garbage(rng: np.random.Generator, phase: str) -> Drawn:
    count = round(between(rng, 1, 4000))
    lines = int(rng.integers(0, 15))
    faults = [Fault("garbage", count=count, seed=int(rng.integers(1 << 30)))]
    faults += [Fault("half_line", at_s=k * CYCLE_S, length_count=int(rng.integers(0, 25))) for k in range(lines)]
    return Drawn(f"{count} bytes of garbage, {lines} half lines", tuple(faults), must_stop=False, lasts_s=0.1)


def sequence_gap(rng: np.random.Generator, phase: str) -> Drawn:
    count = round(between(rng, 2, 5000))
    fault = Fault("sequence_gap", count=count)
    return Drawn(f"{count} sequence numbers skipped", (fault,), detection_s=AT_ONCE_S, by_lasers=True)


def sensor_restart(rng: np.random.Generator, phase: str) -> Drawn:
    return Drawn("interferometer restarted", (Fault("sensor_restart"),), detection_s=AT_ONCE_S, by_lasers=True)


def counts_stuck(rng: np.random.Generator, phase: str) -> Drawn:
    duration_s = between(rng, 0.03, 0.8)
    fault = Fault("stuck_counts", duration_s=duration_s)
    told_by = {"homing": NEVER_S, "constant speed": 0.01}  # before a homing nothing is asked of a sensor; the encoder's
    detection_s = told_by.get(phase, REPEATS_S)
    must = detection_s != NEVER_S
    text = f"counts stuck for {duration_s * 1e3:.0f} ms"
    return Drawn(text, (fault,), must_stop=must, detection_s=detection_s, lasts_s=duration_s)


def clock_drift(rng: np.random.Generator, phase: str) -> Drawn:
    ppm, duration_s = between(rng, 5.0, 2e4) * one_of(rng, (-1.0, 1.0)), between(rng, 0.1, 1.0)
    fault = Fault("clock_drift", ppm=ppm, duration_s=duration_s)
    text = f"interferometer's clock {ppm:.0f} ppm off for {duration_s * 1e3:.0f} ms"
    return Drawn(text, (fault,), must_stop=False, lasts_s=duration_s)


def unplugged(rng: np.random.Generator, phase: str) -> Drawn:
    duration_s = between(rng, 5e-3, 0.8)
    fault = Fault("unplug", duration_s=duration_s)
    text = f"interferometer unplugged for {duration_s * 1e3:.0f} ms"
    return Drawn(text, (fault,), detection_s=AT_ONCE_S, lasts_s=duration_s)


_INPUTS = (("limit switch", MACRO, 0x2), ("pressure low", MACRO, 0x1_0000), ("STO", MICRO, 0x8), ("STO", MACRO, 0x8))


def input_trips(rng: np.random.Generator, phase: str) -> Drawn:
    what, node_id, bits = one_of(rng, _INPUTS)
    duration_s = between(rng, 0.1, 1.0)
    fault = Fault("input", node_id=node_id, bits=bits, duration_s=duration_s)
    return Drawn(
        f"{what} of node {node_id} for {duration_s * 1e3:.0f} ms",
        (fault,),
        detection_s=0.012,  # the event-driven TPDO's inhibit time
        lasts_s=duration_s,
        without_power=(node_id,) if bits == 0x8 else (),
    )


def edge_jump(rng: np.random.Generator, phase: str) -> Drawn:
    offset_m = rng.uniform(-120e-6, 400e-6)
    return Drawn(
        f"right edge of the joint moves by {offset_m * 1e6:.0f} um",
        (Fault("edge_jump", offset_m=float(offset_m)),),
        must_stop=False,
    )


def following_error(rng: np.random.Generator, phase: str) -> Drawn:
    """The micro's motor loses force, as with a winding that opens: the end falls behind its reference.

    With none left it shows where a motion gains speed or loses it. A law that fights for its force may keep up with
    a part of it, and a sweep may be about to turn or to end.
    """
    must = phase in ("accelerating", "decelerating") and bool(rng.random() < 0.75)
    ratio = 0.0 if must else between(rng, 0.01, 0.9)
    duration_s = between(rng, 1.0, 1.5) if must else between(rng, 0.05, 1.5)
    return Drawn(
        f"micro's motor at {ratio:.0%} of its force for {duration_s * 1e3:.0f} ms",
        (Fault("weak_motor", node_id=MICRO, force_ratio=ratio, duration_s=duration_s),),
        must_stop=must,
        lasts_s=duration_s,
        swings=True,
    )


def obstacle(rng: np.random.Generator, phase: str) -> Drawn:
    """Something lies in the way of the macro."""
    offset_m = between(rng, 1e-3, 60e-3)
    faults = tuple(Fault("obstacle", offset_m=side * offset_m, duration_s=1.5) for side in (-1.0, 1.0))
    return Drawn(f"obstacles {offset_m * 1e3:.0f} mm away", faults, must_stop=False, lasts_s=1.5, obstacle_m=offset_m)


def host_held_up(rng: np.random.Generator, phase: str) -> Drawn:
    must = grave(rng)
    duration_s = between(rng, SILENCE_S + 2e-3, 0.5) if must else between(rng, 5e-3, SILENCE_S + 2e-3)
    return Drawn(
        f"host held up for {duration_s * 1e3:.0f} ms",
        act=lambda scene: scene.hold_host_up(duration_s),
        must_stop=must,
        detection_s=SILENCE_S if must else NEVER_S,
        lasts_s=duration_s,
    )


def supervisor_hangs(rng: np.random.Generator, phase: str) -> Drawn:
    must = grave(rng)
    duration_s = float(rng.uniform(0.52, 1.2) if must else rng.uniform(0.05, 0.52))
    return Drawn(
        f"supervisor hangs for {duration_s * 1e3:.0f} ms",
        act=lambda scene: scene.hang_supervisor(duration_s),
        must_stop=must,
        detection_s=_SUPERVISOR_S if must else NEVER_S,
        lasts_s=duration_s,
    )


def servo_gone(rng: np.random.Generator, phase: str) -> Drawn:
    return Drawn("servo gone", act=lambda scene: scene.lose_servo(), detection_s=SILENCE_S, lasts_s=1.0)


def disk_full(rng: np.random.Generator, phase: str) -> Drawn:
    return Drawn("disk full", act=lambda scene: scene.fill_disk(), must_stop=False, lasts_s=1.0)


def client_vanishes(rng: np.random.Generator, phase: str) -> Drawn:
    return Drawn("client vanishes", act=lambda scene: scene.vanish(), detection_s=_LEASE_S + CYCLE_S, silent=True)


def second_operator(rng: np.random.Generator, phase: str) -> Drawn:
    return Drawn(
        "a second operator wants to move",
        act=lambda scene: scene.intrude(rng),
        must_stop=False,
        may_stop=False,
    )


def nonsense_profile(rng: np.random.Generator, phase: str) -> Drawn:
    edited = nonsense(rng, "oled-printer")
    return Drawn(
        f"profile edited to nonsense, read again: {edited.what}",
        act=lambda scene: scene.edit_profile(edited),
        must_stop=False,
        may_stop=False,
        nonsense=edited,
    )


KINDS: dict[str, Draw] = {
    "frames lost": frames_lost,
    "few frames lost": few_frames_lost,
    "frames late": frames_late,
    "frames reordered": frames_reordered,
    "frames doubled": frames_doubled,
    "frames corrupted": frames_corrupted,
    "frames short": frames_short,
    "bus-off and back": bus_off,
    "bus full (ENOBUFS)": bus_full,
    "EMCY": emergency,
    "statusword stuck": statusword_stuck,
    "drive reboot": drive_reboot,
    "mapping changed": mapping_changed,
    "drive's heartbeat lost": drive_heartbeat_lost,
    "master's heartbeat lost": master_heartbeat_lost,
    "encoder glitch": encoder_glitch,
    "beam break": beam_break,
    "interferometer silent": sensor_silence,
    "interferometer garbage": sensor_garbage,
    "sequence gap": sequence_gap,
    "interferometer restart": sensor_restart,
    "counts stuck": counts_stuck,
    "clock drift": clock_drift,
    "unplug and replug": unplugged,
    "input trips": input_trips,
    "backlash jump": edge_jump,
    "obstacle": obstacle,
    "host overrun": host_held_up,
    "supervisor hangs": supervisor_hangs,
    "servo gone": servo_gone,
    "disk full": disk_full,
    "client vanishes": client_vanishes,
    "two operators": second_operator,
    "nonsense profile": nonsense_profile,
    "following error": following_error,
}
"""Every kind, by the name that the tables use."""
