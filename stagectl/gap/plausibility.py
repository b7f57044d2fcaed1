"""Whether recordings and a belief belong together at all: asked before anything is searched, so that no wrong column,
unit or profile comes out as a missing effect.

In a band in which the stage accelerates, inertia force and modelled forces must be the same thing up to what effects
add; factors and shares are compared, so nothing depends on how large the missing effect is. Limits were set on 190
bodies in recordings: `tests/blind` (development seeds 20 to 43), EMPS, rig runs; none of those is refused. Pure.
"""

import functools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.signal import butter, sosfiltfilt

from stagectl.effects import CATALOGUE
from stagectl.errors import RequestError
from stagectl.gap import balance, residual
from stagectl.gap.believed import Believed
from stagectl.gap.effect_forces import effect_forces, known_forces
from stagectl.gap.forces import Forces
from stagectl.gap.log import STILL_M, Log, constant_columns
from stagectl.gap.noise import is_low_passed
from stagectl.gap.recording import Recording

_BAND_HZ = (0.2, 30.0)
_REACTION = (-0.1, 1.1)  # share of the micro's force that pushes the macro back, with room
_AS_WELL_RATIO = (
    1e-3  # of the squares of all inertia force: an explanation that leaves no more than that more is as good
)
_PUSHED_RATIO = 3.0  # of what the best factor leaves: beside a cogging of 4 N, a mass of 45 % more left half of what a
# push of the micro did that was there, and the set was refused
_SATURATIONS = np.geomspace(0.05, 1.0, 25)  # of the largest force: where iron that hears no more of it is looked for
_EDGE_S = 0.3
_BLOCK_S = 0.25  # for the error of a factor; what is left is correlated for less
_ACCELERATING_M_PER_S2 = 0.02  # rms; 0.01 to 0.7 in the recordings looked at
_LEAST_EXPLAINED_RATIO = 0.05  # 0.64 and more; 0.13 beside a hidden spring that does most of the work
_TELLING_RATIO = 0.4  # of what forces explain, from which on their factor tells of units: 0.64 and more, whatever the
# unit. 0.17 beside bristles that hold the end of 0.02 m/s^2 with three times its force: 0.06 of what they could make it
_FACTOR_LIMITS = 1.0 / 30.0, 3.0  # of one recording: 0.7 to 1.05, 0.28 beside such bristles; units make it 1e-3 or less
_FACTOR_OTHER = 1.4  # of a machine's whole accelerating mass: less is what a hidden effect can do (half the micro's
# force that nobody said to push the macro back looks like 30 %)
_FACTOR_SDS = 20.0  # of all recordings together, in what is stated of mass and force constant
_FACTOR_SIGMAS = 6.0
_SWAP_RATIO = 0.25  # of the squares that are left, each axis's in its own inertia force's
_GOOD_RATIO = 0.02  # of the squares of the inertia force
_SAME_RATIO = 0.5  # of the samples
_NEAR = 3.0  # of a unit's factor: what follows velocity and position takes its share
_SMOOTH_RATIO = 0.1
_EDGE_SLACK_M = 5e-6

_UNITS = (
    (1e3, "positions in mm, or forces in kN"),
    (1e6, "positions in um"),
    (1e9, "positions in nm"),
    (1e-3, "forces in mN"),
    (-1.0, "a sign: of the position or of the command"),
)
"""Inertia force over modelled force, and the unit that makes it so."""


@dataclass(frozen=True, slots=True)
class _Balance:
    """One body in one recording, in the band: inertia force against modelled forces."""

    run: str
    axis: str
    accelerating: bool
    factor: float  # inertia force = factor x modelled forces + what follows velocity, its sign and position
    factor_sd: float
    explained_ratio: float
    weight: float
    left_ratio: float  # square of inertia force minus modelled forces, in that of the inertia force


def check(believed: Believed, training: Sequence[Log], held: Sequence[Log]) -> tuple[str, ...]:
    """Refuse recordings that can't be what the belief is of; RequestError says what to look at.

    Returns what is worth knowing of those that can.
    """
    remarks = check_logs(believed, training, held)
    return remarks + check_recordings(believed, [balance.recording_of(log, believed) for log in [*training, *held]])


def check_logs(believed: Believed, training: Sequence[Log], held: Sequence[Log]) -> tuple[str, ...]:
    """Refuse what can be seen in the columns alone; errors and values as of `check`."""
    logs = [*training, *held]
    remarks: list[str] = []
    for log in logs:
        _check_columns(log)
        if believed.micro is None and log.end_position_m is not None:
            remarks.append(f"{log.name}: end_position_m is not used; profile {believed.name} has one axis")
    _check_different(training, held)
    _check_moving(training, "training")
    if held:
        _check_moving(held, "held-out")
    return tuple(remarks)


def check_recordings(believed: Believed, recordings: Sequence[Recording]) -> tuple[str, ...]:
    """Refuse motions that the forces beside them don't make; errors and values as of `check`."""
    for recording in recordings:
        _check_reference(recording)
    balances = [_balance(recording, axis) for recording in recordings for axis in recording.axes]
    _check_swapped(believed, recordings, balances)
    for one in balances:
        _check_one(believed, one)
    for axis in recordings[0].axes:
        _check_all(believed, recordings[0], axis, [b for b in balances if b.axis == axis and b.accelerating])
    return tuple(
        f"{recording.log.name}: positions of the {axis} were low-passed before they were stored, their sensor's noise "
        "is gone; what is fast can't be judged there and may seem to be a drive that is late: record them as read"
        for recording in recordings
        for axis in recording.axes
        if is_low_passed(recording, axis)
    )


def _check_columns(log: Log) -> None:
    dead = constant_columns(log)
    if dead:
        raise RequestError(f"{log.name}: {', '.join(dead)} never changes; swapped or dead columns? Map them again")


def _check_different(training: Sequence[Log], held: Sequence[Log]) -> None:
    """Refuse one recording given twice, under whatever name: it would confirm itself."""
    logs = [*training, *held]
    samples = [np.unique(log.macro_position_m + 1j * log.macro_command_n) for log in logs]
    for k, one in enumerate(logs):
        for number, other in enumerate(logs[:k]):
            if _shared_ratio(samples[k], samples[number]) > _SAME_RATIO:
                sides = "training and holdout" if number < len(training) <= k else "one side"
                raise RequestError(
                    f"{one.name} and {other.name} hold the same samples, both given as {sides}; a recording can't "
                    "confirm itself: give each once, and record another to hold out"
                )


def _shared_ratio(one: np.ndarray, other: np.ndarray) -> float:
    """Return how many of the samples of the shorter of two recordings stand in the other as well."""
    return np.intersect1d(one, other, assume_unique=True).size / min(one.size, other.size)


def _check_moving(logs: Sequence[Log], side: str) -> None:
    spans_m = [
        max(float(np.ptp(x)) for x in (log.macro_position_m, log.end_position_m) if x is not None) for log in logs
    ]
    if not max(spans_m) > STILL_M:
        raise RequestError(
            f"the {side} recordings move by {max(spans_m) * 1e6:.2g} um at most, {STILL_M * 1e6:.0f} um are needed: no "
            "force that depends on motion is excited; record a move"
        )


def _check_reference(recording: Recording) -> None:
    """Refuse a position without the sensor's noise beside a reference that has it."""
    log = recording.log
    stated_m = recording.belief("macro").noise_m
    if log.reference_m is None:
        return
    position_m, reference_m = _noise_m(log.macro_position_m), _noise_m(log.reference_m)
    if position_m < _SMOOTH_RATIO * stated_m and reference_m > max(0.5 * stated_m, position_m / _SMOOTH_RATIO):
        raise RequestError(
            f"{log.name}: setpoint_position_m has {reference_m * 1e9:.2g} nm of noise and macro_position_m "
            f"{position_m * 1e9:.2g} nm, the sensor's is {stated_m * 1e9:.2g} nm; are the two swapped?"
        )


def _noise_m(position_m: np.ndarray) -> float:
    """Return the white noise of a position from its fourth differences, in which motion is nothing."""
    return float(np.sqrt(np.median(np.diff(position_m, 4) ** 2) / 0.455 / 70.0))


def in_band(values: np.ndarray, period_s: float) -> np.ndarray:
    """Return values in the band that is compared, mirrored at either end, without both ends.

    Turned round about their first value, as is usual, they would jump by twice the sensor's noise in it: 10 N of force
    that rang for two seconds, and good recordings were refused as exchanged columns.
    """
    edge = round(_EDGE_S / period_s)
    return np.asarray(sosfiltfilt(_band_pass(period_s), values, padtype="even"))[edge:-edge]


@functools.cache
def _band_pass(period_s: float) -> np.ndarray:
    high_hz = min(_BAND_HZ[1], 0.2 / period_s)
    band = np.array([_BAND_HZ[0], high_hz]) * 2.0 * period_s
    return np.asarray(butter(4, band, btype="band", output="sos"))


def _balance(recording: Recording, axis: str) -> _Balance:
    h, motion = recording.log.period_s, recording.motion(axis)
    inertia_n, force_n = _both_sides_n(recording, axis)
    velocity = motion.velocity_m_per_s.mean(axis=1)
    beside = [velocity, np.sign(velocity), motion.position_m.mean(axis=1)]
    columns = np.column_stack([force_n, *(in_band(values, h) for values in beside)])
    scale = np.sqrt(np.mean(columns**2, axis=0)) + 1e-300
    normal = np.linalg.pinv((columns / scale).T @ (columns / scale), rcond=1e-10)
    solved = normal @ ((columns / scale).T @ inertia_n)
    rest = inertia_n - columns / scale @ solved
    block = round(_BLOCK_S / h)
    count = rest.size // block
    scores = np.einsum("ijk,ij->ik", (columns / scale)[: count * block].reshape(count, block, -1),
                       rest[: count * block].reshape(count, block))  # fmt: skip
    covariance = normal @ (scores.T @ scores) @ normal
    whole = float(np.mean(inertia_n**2))
    least = float(np.mean(rest**2))
    others = [(_pushed_rest_n(recording, axis, columns, inertia_n), _PUSHED_RATIO)]
    if solved[0] / scale[0] < 1.0 / _FACTOR_OTHER:
        others.append((_saturated_rest_n(recording, axis, columns, inertia_n), 1.0))
    for left, ratio in others:
        if left is not None and np.mean(left**2) < max(ratio * least, np.mean(rest**2) + _AS_WELL_RATIO * whole):
            rest, solved[0] = left, scale[0]
    return _Balance(
        run=recording.log.name,
        axis=axis,
        accelerating=bool(np.sqrt(whole) / recording.mass_kg(axis) > _ACCELERATING_M_PER_S2),
        factor=float(solved[0] / scale[0]),
        factor_sd=float(np.sqrt(covariance[0, 0]) / scale[0]),
        explained_ratio=1.0 - float(np.mean(rest**2)) / max(whole, 1e-300),
        weight=1.0 / max(float(normal[0, 0]) / scale[0] ** 2, 1e-300),
        left_ratio=_left_ratio(inertia_n, force_n),
    )


def _both_sides_n(recording: Recording, axis: str) -> tuple[np.ndarray, np.ndarray]:
    """Return what moves a body as it did, and what is believed to act on it, in the band that is compared."""
    h = recording.log.period_s
    raw_n = residual.missing_force_n(recording, axis, Forces())
    left_n = residual.missing_force_n(recording, axis, known_forces(recording))
    return in_band(raw_n, h), in_band(raw_n - left_n, h)


def _left_ratio(inertia_n: np.ndarray, force_n: np.ndarray) -> float:
    return float(np.mean((inertia_n - force_n) ** 2)) / max(float(np.mean(inertia_n**2)), 1e-300)


def _pushed_rest_n(recording: Recording, axis: str, columns: np.ndarray, inertia_n: np.ndarray) -> np.ndarray | None:
    """Return what is left where the micro pushes the macro back and the forces are right; None where it can't.

    While both move together that looks like a macro as heavy as both: a missing effect, and no other machine.
    """
    if axis != "macro" or recording.micro_motor_n is None:
        return None
    back_n = -in_band(recording.micro_motor_n.mean(axis=1), recording.log.period_s)
    beside = np.column_stack([back_n, columns[:, 1:]])
    unit = np.sqrt(np.mean(beside**2, axis=0)) + 1e-300
    shares = np.linalg.lstsq(beside / unit, inertia_n - columns[:, 0], rcond=1e-10)[0]
    if not _REACTION[0] <= shares[0] / unit[0] + recording.reaction_ratio <= _REACTION[1]:
        return None
    return inertia_n - columns[:, 0] - beside / unit @ shares


def _saturated_rest_n(recording: Recording, axis: str, columns: np.ndarray, inertia_n: np.ndarray) -> np.ndarray:
    """Return what is left where the motor's iron saturates and the forces are right, where it does so best.

    A motor asked for 400 N that gives 107 N looks like a machine of twice the mass: a missing effect, and no other one.
    """
    saturation, place = CATALOGUE["force_constant_saturation"], f"{axis}_actuator"
    raw_n = residual.missing_force_n(recording, axis, Forces())
    largest_n = float(np.max(np.abs(recording.felt_n[axis])))
    unit = np.sqrt(np.mean(columns[:, 1:] ** 2, axis=0)) + 1e-300

    def rest_n(saturation_n: float) -> np.ndarray:
        lost = effect_forces(recording, saturation, place, [saturation_n])
        lost_n = in_band(raw_n - residual.missing_force_n(recording, axis, lost), recording.log.period_s)
        left_n = inertia_n - columns[:, 0] - lost_n
        return left_n - columns[:, 1:] / unit @ np.linalg.lstsq(columns[:, 1:] / unit, left_n, rcond=1e-10)[0]

    return min((rest_n(ratio * largest_n) for ratio in _SATURATIONS), key=lambda rest: float(np.mean(rest**2)))


def _check_swapped(believed: Believed, recordings: Sequence[Recording], balances: Sequence[_Balance]) -> None:
    """Refuse a recording that makes far more sense with two columns exchanged, or one turned round."""
    for recording in recordings:
        _check_gap_side(recording)
        own = [b for b in balances if b.run == recording.log.name]
        if all(b.left_ratio < _GOOD_RATIO for b in own):
            continue  # columns that are not what they are called leave more
        left = sum(b.left_ratio for b in own)
        for text, log in _variants(recording.log):
            other = balance.recording_of(log, believed)
            if sum(_left_ratio(*_both_sides_n(other, axis)) for axis in other.axes) < _SWAP_RATIO * left:
                raise RequestError(f"{log.name}: forces and motion agree far better with {text}; map the columns again")


def _check_gap_side(recording: Recording) -> None:
    """Refuse bodies that stand outside their gap, and inside it the other way round: so little force tells nothing."""
    log, joint = recording.log, recording.believed.joint
    if joint is None or recording.end is None or log.end_position_m is None:
        return
    apart_m = float(np.median(log.macro_position_m - log.end_position_m))
    slack_m = _EDGE_SLACK_M + 3.0 * joint.width_sd_m
    outside = not -joint.left_m - slack_m <= apart_m <= joint.right_m + slack_m
    if outside and -joint.left_m < -apart_m < joint.right_m:
        raise RequestError(
            f"{log.name}: macro minus end stands at {apart_m * 1e6:.0f} um, the gap reaches from "
            f"{-joint.left_m * 1e6:.0f} to {joint.right_m * 1e6:.0f} um; are macro_position_m and end_position_m "
            "swapped, or their zeros not those of the joint?"
        )


def _variants(log: Log) -> list[tuple[str, Log]]:
    found = [("the sign of macro_force_n turned", replace(log, macro_command_n=-log.macro_command_n))]
    end_m, micro_n = log.end_position_m, log.micro_command_n
    if end_m is not None and micro_n is not None:
        found += [
            (
                "macro_position_m and end_position_m exchanged",
                replace(log, macro_position_m=end_m, end_position_m=log.macro_position_m),
            ),
            (
                "macro_force_n and micro_force_n exchanged",
                replace(log, macro_command_n=micro_n, micro_command_n=log.macro_command_n),
            ),
            ("the sign of micro_force_n turned", replace(log, micro_command_n=-micro_n)),
        ]
    return found


def _check_one(believed: Believed, one: _Balance) -> None:
    """Refuse a recording whose motion is not what its forces make."""
    if not one.accelerating:
        return
    certain = one.explained_ratio > _TELLING_RATIO and abs(one.factor - 1.0) > _FACTOR_SIGMAS * one.factor_sd
    if certain and not _FACTOR_LIMITS[0] < one.factor < _FACTOR_LIMITS[1]:
        raise RequestError(
            f"{one.run}: the {one.axis} accelerates {one.factor:.3g} times as much as its forces can make it"
            f"{_unit_hint(one.factor)}; check units and columns of the import, and that {believed.name} is this "
            "machine's profile"
        )
    if not one.explained_ratio > _LEAST_EXPLAINED_RATIO:
        raise RequestError(
            f"{one.run}: the known forces explain {max(one.explained_ratio, 0.0):.0%} of the {one.axis}'s "
            f"acceleration, at least {_LEAST_EXPLAINED_RATIO:.0%} are needed; check that its columns are what they are "
            f"called, and that {believed.name} is this machine's profile"
        )


def _check_all(believed: Believed, recording: Recording, axis: str, balances: Sequence[_Balance]) -> None:
    """Refuse a profile whose mass the recordings contradict grossly, all together."""
    if not balances:
        return
    weights = np.array([b.weight for b in balances])
    weights = weights / weights.sum()
    factor = float(weights @ np.array([b.factor for b in balances]))
    sd = float(np.sqrt(weights**2 @ np.array([b.factor_sd**2 for b in balances])))
    belief = recording.belief(axis)
    stated = float(np.hypot(belief.mass_sd_kg / belief.mass_kg, belief.force_constant_sd_ratio))
    far = not 1.0 / _FACTOR_OTHER < factor < _FACTOR_OTHER
    if far and abs(factor - 1.0) > max(_FACTOR_SDS * stated, _FACTOR_SIGMAS * sd):
        raise RequestError(
            f"profile {believed.name}: the {axis} moves as if it had {belief.mass_kg / factor:.3g} kg, believed are "
            f"{belief.mass_kg:.3g} kg, {abs(factor - 1.0) / stated:.0f} stated standard deviations of mass and force "
            f"constant away (limit {_FACTOR_SDS:.0f}){_unit_hint(factor)}; is this the profile of another machine, or "
            "the unit of a force column wrong?"
        )


def _unit_hint(factor: float) -> str:
    for ratio, text in _UNITS:
        if 1.0 / _NEAR < factor / ratio < _NEAR:
            return f" ({text}?)"
    return ""
