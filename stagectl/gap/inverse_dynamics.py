"""The inverse dynamic model by weighted least squares: mass and friction of one axis, without any belief.

    F = M a + sum of laws along the measured motion,    laws linear in what is asked for

Positions are low-passed without phase and differentiated centrally; force and all columns are then decimated by the
same filter ("parallel filtering"). That is the recipe by which the parameters of EMPS were published (Janot, Gautier,
Brunot, Data set and reference models of EMPS, Workshop on Nonlinear System Identification Benchmarks 2019; Gautier,
Janot, Vandanjon, IEEE Trans. Control Systems Technology 21(2), 2013). It names nothing: residuals are coloured, and its
standard deviations hold for the structure that was asked for. `stagectl.gap.workflow` judges structures. Pure.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.signal import butter, decimate, sosfiltfilt

from stagectl.effects import CATALOGUE, Effect
from stagectl.errors import RequestError
from stagectl.gap.log import Log
from stagectl.gap.quantities import along_motion

CORNER_HZ = 100.0
DECIMATION = 10
FRICTION: Mapping[str, Mapping[str, float]] = {
    "viscous_friction": {},
    "coulomb_friction": {"smoothing_m_per_s": 1e-7},
    "offset": {},
}
"""The standard model of an axis with a ball screw: law, and the values of its parameters that are not solved for."""

MASS = "mass_kg"

_ORDER = 4
_BORDER_PERIODS = 5.0  # of the corner: what a filter without phase makes of either end of a recording
_LEAST_ROWS = 10  # a number that is solved for
_LEAST_INDEPENDENT = 1e-9  # squared singular value of columns of unit length
_PASSES = 3


@dataclass(frozen=True, slots=True)
class InverseDynamics:
    """What an inverse dynamic model of one axis came to; `values` and `sds` by name, "law.parameter" or "mass_kg"."""

    values: dict[str, float]
    sds: dict[str, float]
    left_n: tuple[float, ...]  # rms of force that the model leaves, one a recording
    left_ratio: float  # norm of what is left over norm of force, all recordings together
    rows: int


def fit_inverse_dynamics(
    logs: Sequence[Log],
    laws: Mapping[str, Mapping[str, float]] = FRICTION,
    *,
    corner_hz: float = CORNER_HZ,
    decimation: int = DECIMATION,
) -> InverseDynamics:
    """Solve the mass (without payload) and every linear parameter of `laws` from recordings of one axis.

    laws: effect names of the catalogue, each with the values of the parameters that it is not linear in.
    corner_hz: of the low-pass on positions. decimation: samples a row of the regression.
    Recordings weigh by what the model leaves of each. An offset or friction is one number for all recordings.
    Errors: RequestError for a law that has no place here or lacks a value, and for recordings too short, too slowly
    sampled, or that do not excite what is asked for.
    """
    if not logs:
        raise RequestError("an inverse dynamic model needs a recording; give one log at least")
    names = [MASS, *(f"{name}.{parameter}" for name in laws for parameter in _effect(name, laws[name]).linear)]
    blocks = [_rows(log, laws, corner_hz, decimation, len(names)) for log in logs]
    weights = np.ones(len(blocks))
    solution = np.zeros(len(names))
    covariance = np.zeros((len(names), len(names)))
    for _ in range(_PASSES):
        matrix = np.vstack([w * columns for w, (columns, _) in zip(weights, blocks, strict=True)])
        force = np.concatenate([w * force_n for w, (_, force_n) in zip(weights, blocks, strict=True)])
        solution, covariance = _solved(matrix, force, names)
        left_n = np.array([_rms(force_n - columns @ solution) for columns, force_n in blocks])
        weights = 1.0 / np.maximum(left_n, 1e-12)
    left = np.concatenate([force_n - columns @ solution for columns, force_n in blocks])
    whole = np.concatenate([force_n for _, force_n in blocks])
    return InverseDynamics(
        values=dict(zip(names, solution.tolist(), strict=True)),
        sds=dict(zip(names, np.sqrt(np.diag(covariance)).tolist(), strict=True)),
        left_n=tuple(left_n.tolist()),
        left_ratio=_rms(left) / _rms(whole),
        rows=left.size,
    )


def _effect(name: str, shape: Mapping[str, float]) -> Effect:
    """Look a law up, and check that it can be a column."""
    if name not in CATALOGUE:
        raise RequestError(f"no effect is called {name}; stagectl/effects has them all, by family")
    effect = CATALOGUE[name]
    if not {"macro_force", "macro_actuator"} & set(effect.places) or not effect.linear:
        raise RequestError(f"{name} is no force of one axis that is linear in a parameter; leave it to `stagectl gap`")
    lacking = [p for p in effect.parameters if p not in effect.linear and p not in shape]
    if lacking:
        raise RequestError(f"{name}: {', '.join(lacking)} is not solved for; give its value")
    return effect


def _rows(
    log: Log, laws: Mapping[str, Mapping[str, float]], corner_hz: float, decimation: int, size: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return (columns, force) of one recording at the decimated rate, shapes (rows, size) and (rows,)."""
    h = log.period_s
    if not 0.0 < corner_hz < 0.5 / h:
        raise RequestError(f"{log.name}: corner_hz is {corner_hz:g} Hz, between 0 and {0.5 / h:g} Hz can be; lower it")
    border = round(_BORDER_PERIODS / (corner_hz * h))
    if log.samples_count < 2 * border + _LEAST_ROWS * size * decimation:
        raise RequestError(
            f"{log.name}: {log.samples_count} samples, {2 * border + _LEAST_ROWS * size * decimation} are needed for "
            f"{size} parameters at a decimation of {decimation}; record longer, or lower it"
        )
    position_m = np.asarray(sosfiltfilt(butter(_ORDER, 2.0 * corner_hz * h, output="sos"), log.macro_position_m))
    velocity = np.gradient(position_m, h)
    acceleration = np.gradient(velocity, h)
    known = {
        "position_m": position_m,
        "velocity_m_per_s": velocity,
        "acceleration_m_per_s2": acceleration,
        "motor_force_n": log.macro_command_n,
        "t_s": log.start_s + log.times_s,
        "dt_s": np.full(log.samples_count, h),
    }
    columns = [acceleration]
    for name, shape in laws.items():
        effect = _effect(name, shape)
        unknown = [quantity for quantity in effect.quantities if quantity not in known]
        if unknown:
            raise RequestError(f"{name} depends on {', '.join(unknown)}, which one axis' position and force lack")
        for parameter in effect.linear:
            at = dict.fromkeys(effect.linear, 0.0) | dict(shape) | {parameter: 1.0}
            arguments = [known[quantity][:, None] for quantity in effect.quantities]
            columns.append(-along_motion(effect, arguments, [at[p] for p in effect.parameters])[:, 0])
    inner = slice(border, log.samples_count - border)
    force_n = np.interp(log.times_s, log.times_s[log.valid], log.macro_command_n[log.valid])
    table = np.column_stack([*columns, force_n - log.macro_payload_kg * acceleration])[inner]
    thinned = np.asarray(decimate(table, decimation, axis=0)) if decimation > 1 else table
    kept = _whole(log.valid[inner], decimation)
    return thinned[kept, :-1], thinned[kept, -1]


def _whole(valid: np.ndarray, decimation: int) -> np.ndarray:
    """Tell which decimated rows have no missing sample within one row to either side."""
    missing = np.convolve(~valid, np.ones(2 * decimation + 1), "same") > 0.5
    return ~missing[::decimation]


def _solved(matrix: np.ndarray, force: np.ndarray, names: list[str]) -> tuple[np.ndarray, np.ndarray]:
    """Return (least-squares solution, its covariance) of columns that are told apart."""
    length = np.linalg.norm(matrix, axis=0)
    dead = [name for name, size in zip(names, length, strict=True) if not size > 0.0]
    if dead:
        raise RequestError(f"these recordings do not excite {', '.join(dead)}; leave it out, or record others")
    _, singular, turned = np.linalg.svd(matrix / length, full_matrices=False)
    if not singular[-1] ** 2 > _LEAST_INDEPENDENT:
        alike = [name for name, share in zip(names, np.abs(turned[-1]), strict=True) if share > 0.1]
        raise RequestError(f"these recordings can't tell {', '.join(alike)} apart; leave one out, or record others")
    solution = np.linalg.lstsq(matrix / length, force, rcond=None)[0] / length
    left = force - matrix @ solution
    inverse = (turned.T / singular**2) @ turned / np.outer(length, length)
    return solution, inverse * float(left @ left) / max(force.size - solution.size, 1)


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values * values)))
