"""Both axes in closed loop on the platform of (1)-(5): one compiled run for every case of sections 4 and 5.

The paper's macro law is "P_h": a gain on a position command, so an inner servo of stated bandwidth follows P_h d_r,
with the reference's acceleration fed forward for m1 and the back-EMF made up for. Laws see positions and velocities
as they are; where noise is given, positions with it, and velocities as their differences. Pure; knows neither cases
nor numbers of the paper.
"""

from dataclasses import dataclass

import numpy as np

from stagectl.compiled import compiled
from stagectl.paper import compensation, plant_as_printed, sliding_mode
from stagectl.paper.references import Reference
from stagectl.signals import Record

MICRO_RELATIVE = 0  # servo on d - d1, section 5.1
MICRO_PID = 1  # PID on d, volts
MICRO_SLIDING = 2

DECOUPLING_NONE = 0
DECOUPLING_PRINTED = 1  # (26) of U2
DECOUPLING_DYNAMIC = 2  # of U2 less back-EMF, and the spring
DECOUPLING_STATIC = 3  # the same with current drives

LOOP = np.dtype(
    [
        ("dt_s", "f8"),
        ("substeps", "f8"),
        ("macro_stiffness_per_s2", "f8"),
        ("macro_damping_per_s", "f8"),
        ("macro_feed_forward_ratio", "f8"),
        ("macro_gain_ratio", "f8"),  # P_h
        ("macro_feedback", "f8"),
        ("centre_m", "f8"),  # by which the macro leads the end in the middle of the gap
        ("decoupling", "f8"),
        ("micro_law", "f8"),
        ("micro_stiffness_per_s2", "f8"),
        ("micro_damping_per_s", "f8"),
        ("proportional_v_per_m", "f8"),
        ("integral_v_per_m_s", "f8"),
        ("derivative_v_s_per_m", "f8"),
        ("micro_integral_m_s", "f8"),
    ]
)

_COLUMNS_COUNT = 9  # of Run, without its reference


@dataclass(frozen=True, slots=True)
class Run:
    """What a run leaves, one element a control period, shapes (n,); inputs are V, or A with current drives."""

    reference: Reference
    macro_m: np.ndarray
    end_m: np.ndarray
    contact_n: np.ndarray
    macro_input: np.ndarray
    micro_input: np.ndarray
    sliding_m_per_s: np.ndarray
    bound_n: np.ndarray
    macro_current_a: np.ndarray
    micro_current_a: np.ndarray

    @property
    def t_s(self) -> np.ndarray:
        """Times of the samples."""
        return self.reference.t_s[: self.end_m.size]

    @property
    def error_m(self) -> np.ndarray:
        """End minus reference, e of (31)."""
        return self.end_m - self.reference.position_m[: self.end_m.size]

    @property
    def macro_error_m(self) -> np.ndarray:
        """Macro minus reference."""
        return self.macro_m - self.reference.position_m[: self.end_m.size]

    @property
    def is_whole(self) -> bool:
        """Tell whether the run came to its end: nothing left +-100 m."""
        return self.end_m.size == self.reference.position_m.size

    def after(self, start_s: float) -> slice:
        """Return the rows from a time on."""
        return slice(int(np.searchsorted(self.t_s, start_s)), None)


def init(dt_s: float, substeps: int, macro_bandwidth_hz: float = 8.0, macro_damping_ratio: float = 0.8) -> np.ndarray:
    """Make LOOP with the macro's servo fed forward, no decoupling, and the sliding mode on the micro."""
    loop = np.zeros(1, LOOP)
    w = 2.0 * np.pi * macro_bandwidth_hz
    loop["dt_s"], loop["substeps"] = dt_s, substeps
    loop["macro_stiffness_per_s2"], loop["macro_damping_per_s"] = w * w, 2.0 * macro_damping_ratio * w
    loop["macro_feed_forward_ratio"] = loop["macro_gain_ratio"] = 1.0
    loop["micro_law"] = MICRO_SLIDING
    return loop


@compiled
def _limited(value: float, limit: float) -> float:
    return min(max(value, -limit), limit)


@compiled
def _micro_input(
    loop: Record, law: Record, s: Record, q: Record, at: np.ndarray, relative: np.ndarray
) -> tuple[float, bool]:
    """Return the micro's input, and whether its supply limits it."""
    x1, v1, x, v = s.macro_position_m, s.macro_velocity_m_per_s, s.end_position_m, s.end_velocity_m_per_s
    if loop.micro_law == MICRO_PID:
        error = at[0] - x
        loop.micro_integral_m_s += error * loop.dt_s
        u = (
            loop.proportional_v_per_m * error
            + loop.integral_v_per_m_s * loop.micro_integral_m_s
            + loop.derivative_v_s_per_m * (at[1] - v)
        )
    else:
        if loop.micro_law == MICRO_SLIDING:
            contact_n = plant_as_printed.contact_force(x1, v1, x, v, q)
            force = sliding_mode.wanted_force(law, x1, v1, x, v, at[0], at[1], at[2], contact_n, q)
        else:
            wanted = relative[2] + loop.micro_stiffness_per_s2 * (relative[0] - (x - x1))
            wanted += loop.micro_damping_per_s * (relative[1] - (v - v1))
            force = q.micro_mass_kg * wanted
        if q.drive == plant_as_printed.DRIVE_CURRENT:
            u = force / q.micro_force_constant_n_per_a
        else:
            u = force * q.micro_resistance_ohm / q.micro_force_constant_n_per_a
            u += q.micro_back_emf_v_s_per_m * (v - v1)
    limit = q.micro_supply_v
    if q.drive == plant_as_printed.DRIVE_CURRENT:
        limit /= q.micro_resistance_ohm
    given = _limited(u, limit)
    return given, given != u


@compiled
def _macro_input(loop: Record, decoupler: Record, s: Record, q: Record, at: np.ndarray, micro: float) -> float:
    """Return the macro's input; `micro` is that of the voice coil."""
    x1, v1, x, v = s.macro_position_m, s.macro_velocity_m_per_s, s.end_position_m, s.end_velocity_m_per_s
    seen, rate = x1, v1
    if loop.macro_feedback == compensation.FEEDBACK_PRINTED:
        in_gap = -q.left_m <= x1 - x <= q.right_m
        seen += compensation.compensation(x1, x, in_gap)
        rate += compensation.compensation(v1, v, in_gap)
    gain = loop.macro_gain_ratio
    wanted = loop.macro_stiffness_per_s2 * (gain * at[0] + loop.centre_m - seen)
    wanted += loop.macro_damping_per_s * (gain * at[1] - rate)
    wanted += loop.macro_feed_forward_ratio * at[2]
    force = q.macro_mass_kg * wanted
    limit = q.macro_supply_v
    if q.drive == plant_as_printed.DRIVE_CURRENT:
        u = force / q.macro_force_constant_n_per_a
        limit /= q.macro_resistance_ohm
        if loop.decoupling == DECOUPLING_STATIC:
            reaction_n = q.micro_force_constant_n_per_a * micro - q.spring_n_per_m * (x - x1)
            u += reaction_n / q.macro_force_constant_n_per_a
    else:
        u = force * q.macro_resistance_ohm / q.macro_force_constant_n_per_a + q.macro_back_emf_v_s_per_m * v1
        if loop.decoupling == DECOUPLING_PRINTED:
            u += compensation.filtered(decoupler, micro)
        elif loop.decoupling == DECOUPLING_DYNAMIC:
            u += compensation.filtered(decoupler, micro - q.micro_back_emf_v_s_per_m * (v - v1))
            u -= q.macro_resistance_ohm / q.macro_force_constant_n_per_a * q.spring_n_per_m * (x - x1)
    return _limited(u, limit)


@compiled
def _sense(seen: Record, s: Record, noise_m: np.ndarray, k: int, dt_s: float) -> None:
    """Write what the laws see at sample `k` into positions and velocities of `seen`."""
    macro_m, end_m = s.macro_position_m, s.end_position_m
    seen.macro_velocity_m_per_s, seen.end_velocity_m_per_s = s.macro_velocity_m_per_s, s.end_velocity_m_per_s
    if noise_m.shape[0] > 0:
        macro_m += noise_m[k, 0]
        end_m += noise_m[k, 1]
        if k > 0:
            seen.macro_velocity_m_per_s = (macro_m - seen.macro_position_m) / dt_s
            seen.end_velocity_m_per_s = (end_m - seen.end_position_m) / dt_s
    seen.macro_position_m, seen.end_position_m = macro_m, end_m


@compiled
def _run(
    state: np.ndarray,
    parameters: np.ndarray,
    loops: np.ndarray,
    laws: np.ndarray,
    decouplers: np.ndarray,
    reference: np.ndarray,
    relative: np.ndarray,
    noise_m: np.ndarray,
    out: np.ndarray,
) -> int:
    """Fill a row a control period; returns the rows up to which nothing left +-100 m."""
    s, q, loop, law, decoupler = state[0], parameters[0], loops[0], laws[0], decouplers[0]
    substeps = int(loop.substeps)
    sensed = state.copy()
    seen = sensed[0]
    for k in range(reference.shape[0]):
        _sense(seen, s, noise_m, k, loop.dt_s)
        micro, saturated = _micro_input(loop, law, seen, q, reference[k], relative[k])
        macro = _macro_input(loop, decoupler, seen, q, reference[k], micro)
        out[k, 0], out[k, 1], out[k, 2] = s.macro_position_m, s.end_position_m, s.contact_force_n
        out[k, 3], out[k, 4] = macro, micro
        out[k, 5], out[k, 6], out[k, 7] = law.sliding_variable_m_per_s, law.bound_n, s.macro_current_a
        out[k, 8] = s.micro_current_a
        if not abs(s.end_position_m) + abs(s.macro_position_m) < 100.0:
            return k
        if loop.micro_law == MICRO_SLIDING:
            sliding_mode.adapt(law, saturated, loop.dt_s)
        plant_as_printed.advance(s, q, macro, micro, loop.dt_s / substeps, substeps)
    return reference.shape[0]


def run(
    plant: np.ndarray,
    loop: np.ndarray,
    reference: Reference,
    *,
    law: np.ndarray | None = None,
    decoupler: np.ndarray | None = None,
    relative: Reference | None = None,
    state: np.ndarray | None = None,
    noise_m: np.ndarray | None = None,
) -> Run:
    """Follow a reference; the stage begins on it (`state` else). `law` and `loop` are left as the last row has them.

    `noise_m`, shape (n, 2): what the sensors of macro and end add to each sample.
    """
    if state is None:
        state = plant_as_printed.init(float(reference.position_m[0]), float(reference.velocity_m_per_s[0]))
    law = sliding_mode.init() if law is None else law
    decoupler = np.zeros(1, compensation.FILTER) if decoupler is None else decoupler
    at = np.ascontiguousarray(reference.columns())
    beside = np.zeros_like(at) if relative is None else np.ascontiguousarray(relative.columns())
    out = np.zeros((at.shape[0], _COLUMNS_COUNT))
    noise_m = np.zeros((0, 2)) if noise_m is None else np.ascontiguousarray(noise_m)
    done = _run(state, plant, loop, law, decoupler, at, beside, noise_m, out)
    return Run(reference, *(out[:done, k] for k in range(_COLUMNS_COUNT)))
