"""What laws of motion have to know of a stage: its profile as a file, the rig's machine; no code of the controller."""

import tomllib
from dataclasses import dataclass
from functools import cache

import numpy as np

from sim_backend import drive_servo
from sim_backend.machine import Machine, load_machine
from stagectl.profile import PROFILES_FOLDER
from tests.faults.kinds import CYCLE_S

_PLAN_SHARE, _PLAN_RAMP_SHARE, _JERK_TIME_S = 0.9, 0.5, 0.1  # what moves are planned with
_TOUCH_N = 5.0  # no joint is pressed harder
REST_M_PER_S = 1e-3
STANDSTILL_M = 20e-6  # a drive that holds on its encoder gives way so far when a force changes
SETTLING_M = 200e-6  # how far its position loop may go until it stands


@dataclass(frozen=True)
class Mechanics:
    """A stage as its judges need it; SI."""

    machine: Machine
    ramp_m_per_s2: float  # the drive's, 0x6085
    law_ramp_m_per_s2: float  # of a stop that the operator asked for: the law brakes, half as hard
    plan_m_per_s2: float  # what its moves are planned with
    plan_m_per_s3: float
    speed_limit_m_per_s: float  # the guard's
    force_limit_n: float  # of the macro's drive, 0x6072
    rated_force_n: float  # of the macro's drive, 0x6076
    travel_m: tuple[float, float]  # in which the guard wants to be able to stop it
    error_limit_m: float  # of the end, at which the guard stops a motion

    def _of(self, name: str) -> list[dict]:
        return [row for row in self.machine.effects if row["name"] == name]

    @property
    def drift_m_per_s2(self) -> float:
        """By how much a macro's acceleration changes on its way while its drive's force stays."""
        change_n = 2.0 * sum(row["amplitude_n"] for row in self._of("cogging"))
        micro = self.machine.micro
        if micro is not None:
            change_n += _TOUCH_N + 2.0 * micro.spring_n_per_m * max(micro.stroke_m)
        return change_n / self.machine.macro.mass_kg

    @property
    def drive_gives_m(self) -> float:
        """How far the macro's drive gives way under its greatest force while it holds on its encoder: F / (m w^2).

        m is the mass that the drive was told.
        """
        drive = drive_servo.parameters(self.machine.macro)[0]
        told_kg = drive["mass_per_constant"] * self.machine.macro.force_constant_n_per_a
        return float(self.force_limit_n / (told_kg * drive["bandwidth_rad_per_s"] ** 2))

    def struck_m(self, relative_m_per_s: float) -> float:
        """How far the macro's drive gives way when the end strikes its stop so fast: speed by the drive's bandwidth."""
        macro, micro = self.machine.macro, self.machine.micro
        if micro is None:
            return 0.0
        gained_m_per_s = 2.0 * micro.mass_kg / (micro.mass_kg + macro.mass_kg) * relative_m_per_s
        return float(gained_m_per_s / drive_servo.parameters(macro)[0]["bandwidth_rad_per_s"])

    @property
    def kick_m_per_s(self) -> float:
        """How much faster the macro gets by its greatest force in a cycle, as one frame that is not the law's asks."""
        return self.force_limit_n / self.machine.macro.mass_kg * CYCLE_S

    def kicked(self, words: int, kicked_s: float) -> tuple[float, float]:
        """Return how fast the macro gets, and from rest how far it goes, by a force that its drive is told so wrongly.

        `words`: by how many 0.1 % of its rated force. A sample and a command on it is taken back, then a ramp's way.
        """
        force_n = min(words * 1e-3 * self.rated_force_n, self.force_limit_n)
        v = force_n / self.machine.macro.mass_kg * kicked_s
        return v, v * (0.5 * kicked_s + 2.0 * CYCLE_S) + v * v / (2.0 * self.ramp_m_per_s2)

    def coasting_m_per_s(self, position_m: float, velocity_m_per_s: float) -> float:
        """Return how fast a macro may get that loses its power there: the guard's limit, and what it rolls down."""
        low_m, high_m = self.travel_m
        left_m = high_m - position_m if velocity_m_per_s > 0.0 else position_m - low_m
        guarded = min(self.speed_limit_m_per_s, np.sqrt(2.0 * self.ramp_m_per_s2 * max(left_m, 0.0)))
        first_m, last_m = self.machine.macro.travel_m
        work_j = sum(row["amplitude_n"] * row["pitch_m"] / np.pi for row in self._of("cogging"))
        work_j += sum(abs(row["force_n"]) * (last_m - first_m) for row in self._of("offset"))
        for row in self._of("cable_spring"):
            furthest_m = max(abs(first_m - row["anchor_m"]), abs(last_m - row["anchor_m"]))
            work_j += 0.5 * row["stiffness_n_per_m"] * furthest_m**2
        return float(np.sqrt(guarded**2 + 2.0 * work_j / self.machine.macro.mass_kg))


@cache
def mechanics_of(name: str) -> Mechanics:
    """Return the mechanics of a shipped profile and the machine of its name."""
    profile = tomllib.loads((PROFILES_FOLDER / f"{name}.toml").read_text())
    macro, stray_m = profile["macro"], profile["control"]["error_limit_m"]
    ramp = macro["stop_deceleration_m_per_s2"]
    plan = _PLAN_SHARE * min(macro["acceleration_limit_m_per_s2"], _PLAN_RAMP_SHARE * ramp)
    low_m, high_m = macro["travel_m"]
    return Mechanics(
        load_machine(name),
        ramp,
        _PLAN_RAMP_SHARE * ramp,
        plan,
        plan / _JERK_TIME_S,
        macro["velocity_limit_m_per_s"],
        macro["force_limit_n"],
        macro["rated_force_n"],
        (low_m - stray_m, high_m + stray_m),
        stray_m,
    )
