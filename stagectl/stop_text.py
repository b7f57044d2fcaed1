"""What a stop has to say in numbers: where, the value, its limit, and what to do; `STOP_TEXT` has the plain sentence.

Runs once, when a run ends. Pure; knows no bus and no clock.
"""

import math
from typing import Any

from drivers import cia402
from stagectl.guard import (
    ASKED_CYCLES,
    NEGATIVE_LIMIT,
    POSITIVE_LIMIT,
    PRESSURE_LOW,
    SAFE_TORQUE_OFF,
    UNHEEDED_CYCLES,
)
from stagectl.signals import MODE_TOLD, Stop

_AWAY = {NEGATIVE_LIMIT: "positive", POSITIVE_LIMIT: "negative"}
"""The direction that leads off a switch; none where both are pressed."""

_INPUTS = {
    NEGATIVE_LIMIT: "negative limit switch",
    POSITIVE_LIMIT: "positive limit switch",
    SAFE_TORQUE_OFF: "STO",
    PRESSURE_LOW: "pressure low",
}


def stop_detail(stop: Stop, m: Any, now: Any, command: Any, g: Any, node_ids: dict[str, int], law: str) -> str:
    """Say why `stop` came, from MEASUREMENT, SETPOINT, COMMAND and GUARD of that cycle; empty where nothing is known.

    `node_ids` by axis, macro first; `law` is the name of the law that ran.
    """
    text = _OF_MOTION.get(stop)
    if text is not None:
        return text(m, now, g)
    if stop is Stop.FORCE:
        return _force(command, g)
    if stop is Stop.COMMAND_NOT_FINITE:
        asked = f"{command['macro_force_asked_n']:g} N of the macro, {command['micro_force_asked_n']:g} N of the micro"
        return f"{law} asked {asked}; look for nan in the belief and the setpoints of this run"
    if stop is Stop.DRIVE_MODE:
        return mode_detail(m, {axis: int(g[f"{axis}_mode"]) for axis in node_ids}, node_ids)
    if stop in _REMEDIES or stop is Stop.EMERGENCY:
        return _drives(stop, m, g, node_ids)
    return ""


def _travel(m: Any, now: Any, g: Any) -> str:
    return (
        f"macro at {m['macro_position_m']:.5f} m, travel and following error allow {g['travel_low_m']:g} .. "
        f"{g['travel_high_m']:g} m; home it, its drive brings it back, or move it back by hand"
    )


def _velocity(m: Any, now: Any, g: Any) -> str:
    v, x = float(g["macro_velocity_m_per_s"]), float(m["macro_position_m"])
    if not abs(v) <= g["velocity_limit_m_per_s"]:
        return f"macro at {v:.4f} m/s, limit {g['velocity_limit_m_per_s']:g} m/s; ask for a slower motion"
    rest_m = x + 0.5 * v * abs(v) / float(g["stop_deceleration_m_per_s2"])
    end_m = g["travel_high_m"] if v > 0.0 else g["travel_low_m"]
    return (
        f"macro at {x:.5f} m with {v:.4f} m/s would come to rest at {rest_m:.5f} m, "
        f"travel and following error end at {end_m:g} m; "
        "slow down before the end"
    )


def _following(m: Any, now: Any, g: Any) -> str:
    error_um = (float(m["end_position_m"]) - float(now["position_m"])) * 1e6
    return (
        f"end {error_um:.1f} um from its reference at {now['position_m']:.5f} m, "
        f"limit {g['following_error_m'] * 1e6:g} um; look for what holds the stage, or ask for a gentler motion"
    )


def _stroke(m: Any, now: Any, g: Any) -> str:
    relative_mm = (float(m["end_position_m"]) - float(m["macro_position_m"])) * 1e3
    allowed = f"{g['stroke_low_m'] * 1e3:g} .. {g['stroke_high_m'] * 1e3:g} mm"
    return f"end minus macro {relative_mm:.4f} mm, allowed {allowed}; home, and look for a force between the axes"


def _age(m: Any, now: Any, g: Any) -> str:
    age_ms = (int(m["t_ns"]) - int(m["sample_t_ns"])) * 1e-6
    if not g["late_cycles"] <= g["late_limit"]:
        return (
            f"lines were late in each of the last {g['late_cycles']:.0f} cycles, limit {g['late_limit']:.0f}; the "
            f"newest is {age_ms:.1f} ms old: check interferometer.rate_hz and transport_s, and what delays its lines"
        )
    return (
        f"newest sample {m['sequence']} is {age_ms:.1f} ms old, limit {g['sensor_age_ns'] * 1e-6:g} ms; "
        "check beams, the interferometer and its cable"
    )


def _ahead(m: Any, now: Any, g: Any) -> str:
    ahead_ms = (int(m["sample_t_ns"]) - int(m["t_ns"])) * 1e-6
    return (
        f"newest sample {m['sequence']} is {ahead_ms:.3f} ms ahead of its cycle, "
        f"limit {g['sensor_ahead_ns'] * 1e-6:g} ms; check interferometer.rate_hz and transport_s, and the host's clock"
    )


def _overrun(m: Any, now: Any, g: Any) -> str:
    return (
        f"cycle {m['cycle']} began {m['overrun_ns'] * 1e-6:.1f} ms late, limit {g['overrun_ns'] * 1e-6:g} ms; "
        "free the host of other work, or use a real-time kernel"
    )


def _thermal(m: Any, now: Any, g: Any) -> str:
    axis = "macro" if not g["macro_heat_n2"] <= g["macro_thermal_n"] ** 2 else "micro"
    rms_n = math.sqrt(max(float(g[f"{axis}_heat_n2"]), 0.0))
    return f"{axis} at {rms_n:.1f} N rms, limit {g[f'{axis}_thermal_n']:g} N; let it cool, ask for less acceleration"


def _not_finite(m: Any, now: Any, g: Any) -> str:
    return f"macro at {m['macro_position_m']:g} m, end at {m['end_position_m']:g} m; home again"


_OF_MOTION = {
    Stop.TRAVEL: _travel,
    Stop.VELOCITY: _velocity,
    Stop.FOLLOWING_ERROR: _following,
    Stop.MICRO_STROKE: _stroke,
    Stop.SENSOR_AGE: _age,
    Stop.SAMPLE_AHEAD: _ahead,
    Stop.OVERRUN: _overrun,
    Stop.THERMAL: _thermal,
    Stop.MEASUREMENT_NOT_FINITE: _not_finite,
}


def _force(command: Any, g: Any) -> str:
    beyond: list[str] = []
    for axis in ("macro", "micro"):
        asked_n, limit_n = float(command[f"{axis}_force_asked_n"]), float(g[f"{axis}_force_limit_n"])
        if limit_n > 0.0 and not abs(asked_n) <= limit_n:
            beyond.append(f"{asked_n:.1f} N of the {axis}, limit {limit_n:g} N")
    return f"asked {' and '.join(beyond)}; ask for less acceleration, or correct the law's bandwidth and the effects"


def _drives(stop: Stop, m: Any, g: Any, node_ids: dict[str, int]) -> str:
    if stop is Stop.EMERGENCY:
        return emergency_detail(int(m["emergency"]))
    said: list[str] = []
    remedy = _REMEDIES[stop]
    for axis, node_id in node_ids.items():
        name = f"{axis} (node {node_id})"
        word = int(m[f"{axis}_statusword"])
        state = cia402.state_of(word)
        if stop is Stop.DIGITAL_INPUT:
            bits = int(m[f"{axis}_digital_inputs"])
            tripped = [text for bit, text in _INPUTS.items() if bits & bit]
            if tripped:
                said.append(f"{name}: {', '.join(tripped)} (0x60FD = 0x{bits:X})")
            away = _AWAY.get(bits & (NEGATIVE_LIMIT | POSITIVE_LIMIT))
            if away is not None:
                remedy = f"take the power away, move the {axis} off the switch by hand in {away} direction, acknowledge"
        elif stop is Stop.LINK_SILENT:
            cycles, limit = int(g[f"{axis}_silence"]), int(g["silent_cycles"])
            if cycles > limit:
                said.append(f"{name}: nothing for {cycles} cycles, limit {limit}")
        elif stop is Stop.FORCE_UNHEEDED:
            if g[f"{axis}_unheeded"] > UNHEEDED_CYCLES:
                asked_n, reported_n = g[f"{axis}_asked_n"], m[f"{axis}_reported_force_n"]
                asked = f"{min(asked_n):.1f} .. {max(asked_n):.1f} N in the last {ASKED_CYCLES} cycles"
                said.append(
                    f"{name} reports {reported_n:.1f} N, asked were {asked}, allowed {g[f'{axis}_off_n']:.1f} N beside"
                )
        elif state is not cia402.State.OPERATION_ENABLED:
            said.append(f"{name} is in {state.name}, statusword 0x{word:04X}")
    return f"{'; '.join(said)}; {remedy}" if said else remedy


_REMEDIES = {
    Stop.DIGITAL_INPUT: "clear the cause, then acknowledge",
    Stop.LINK_SILENT: "check the drive's power and the CAN cable",
    Stop.DRIVE_FAULT: "read the drive, then acknowledge",
    Stop.FORCE_UNHEEDED: "look for what delays frames, who else commands the drive, and a limit in the drive itself; "
    "one that tells its force late or not at all needs another trip.force_error_ratio",
}


def mode_detail(m: Any, wanted: dict[str, int], node_ids: dict[str, int]) -> str:
    """Say which drive shows another mode of operation than the one `wanted` of its axis; empty where none does."""
    said: list[str] = []
    for axis, mode in wanted.items():
        shown = int(m[f"{axis}_mode_display"])
        if int(m["modes_told"]) & MODE_TOLD[axis] and shown != mode:
            said.append(f"{axis} (node {node_ids[axis]}): mode of operation 0x6061 is {shown}, wanted {mode}")
    return f"{'; '.join(said)}; see who else on the bus writes 0x6060, then acknowledge" if said else ""


def emergency_detail(emergency: int) -> str:
    """Say what MEASUREMENT.emergency (node id << 16 | error code) means."""
    node_id, code = emergency >> 16, emergency & 0xFFFF
    return f"node {node_id}: EMCY 0x{code:04X} {cia402.emergency_text(code)}; read the drive, then acknowledge"
