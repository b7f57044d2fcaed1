"""The whole loop as a linear system about rest on the reference: tick, hold, delay and machine, cycle by cycle.

No law, observer or plant is written a second time: the compiled tick and the compiled plant are run for one cycle
from states that differ a little, and central differences are their matrices. Both are piecewise linear there (in the
gap, or in contact on one side), so differences of any size give the same; y(e) of DSMC counts by its slope at e = 0.
Where the reference has jerk the mass that is found on the way is a state more, and what has been fed of it
(`stagectl.fed_forward`).
Inputs and outputs are named and in SI units. What the two ends of a broken loop give is `stagectl.margins`' matter.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from types import ModuleType
from typing import TYPE_CHECKING, Any

import numpy as np

from stagectl import adaptive_filter, compose, estimator, notch, plant
from stagectl.effects import CATALOGUE
from stagectl.errors import RequestError
from stagectl.laws.reference import gap_centre
from stagectl.signals import SETPOINT
from stagectl.tick import LAWS, Controller, controller

if TYPE_CHECKING:
    from stagectl.profile import Profile

GAP, LEFT, RIGHT = 0, -1, 1
"""Where the joint is: in its gap, or touching on the left (x_b < -b_l) or on the right (x_b > b_r)."""

ON_THE_WAY = tuple(adaptive_filter.stiffening(samples) for samples in (*range(1, 17), 20, 24))
"""Observers from soft to stiff, 1, 2, 3 ... samples after a force has struck at rest: their loops count as well."""

_AXES = ("macro", "micro")
_BODY_STATES = (
    *("macro_position_m", "macro_velocity_m_per_s", "macro_acceleration_m_per_s2", "macro_current_a"),
    *("end_position_m", "end_velocity_m_per_s", "end_acceleration_m_per_s2", "micro_current_a"),
)
_MODEL_STATES = (*_BODY_STATES, "macro_disturbance_n", "micro_disturbance_n")
_ESTIMATOR_STATES = ("macro_word", "micro_word", "macro_word_before", "micro_word_before")
_FED_STATES = ("fed_m", "fed_m_per_s", "fed_n")  # of `mass_fed`; like the mass, only a jerk makes something of them
_PENETRATION_M = 1e-6  # deep enough that no small difference leaves the contact
_FINE_RATIO = 1e-11  # of the step of a torque word: rounding vanishes
_STEPS = (  # a difference by the unit that a name ends in; the first that fits
    ("_m_per_s2", 1e-3),
    ("_m_per_s", 1e-6),
    ("_m_s", 1e-12),
    ("_kg", 1e-3),
    ("_n", 1e-3),
    ("_a", 1e-4),
    ("_m", 1e-9),
)
_STEP_A = 1e-4  # of a torque word, in what it makes
_MEMORY_STEP = 1e-7  # of what effects remember, whatever it is


@dataclass(frozen=True, slots=True, eq=False)
class Body:
    """What the forces push: a compiled plant, its parameters, its effects and the longest substep, s; never changed."""

    module: ModuleType
    parameters: np.ndarray
    effects: list[dict[str, Any]]
    longest_substep_s: float = 50e-6


def believed_body(profile: "Profile") -> Body:
    """Return the machine that a profile believes in."""
    effects = [dict(row) for row in profile.effects]
    return Body(compose.plant_module(effects), estimator.belief(profile), effects)


def machine_body(machine: Any) -> Body:
    """Return a machine (attributes named as in a machine file), without its force noise."""
    effects = [dict(row) for row in machine.effects]
    parameters = plant.parameters(machine)
    parameters["draws_noise"] = 0.0
    return Body(compose.plant_module(effects), parameters, effects)


@dataclass(frozen=True, slots=True)
class LinearSystem:
    """x' = A x + B u, y = C x + D u from one sample to the next; shapes (n, n), (n, inputs), (outputs, n)."""

    period_s: float
    a: np.ndarray
    b: np.ndarray
    c: np.ndarray
    d: np.ndarray
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]

    def poles(self) -> np.ndarray:
        """Return the eigenvalues of A; the loop is stable where all lie within the unit circle."""
        return np.linalg.eigvals(self.a)

    def is_stable(self) -> bool:
        """Tell whether every pole lies within the unit circle."""
        return bool(np.max(np.abs(self.poles())) < 1.0)

    def response(self, frequency_hz: np.ndarray, source: str, outcome: str) -> np.ndarray:
        """Return the complex response of an output to an input, shape of `frequency_hz`, below half the rate."""
        b, d = self.b[:, self.inputs.index(source)], self.d[self.outputs.index(outcome), self.inputs.index(source)]
        c = self.c[self.outputs.index(outcome)]
        z = np.exp(2j * np.pi * np.asarray(frequency_hz, float) * self.period_s)
        pencil = np.tile(-self.a.astype(complex), (*z.shape, 1, 1))
        np.einsum("...ii->...i", pencil)[...] += z[..., None]
        solved = np.linalg.solve(pencil, np.broadcast_to(b[:, None], (*z.shape, b.size, 1)))
        return solved[..., 0] @ c + d


@dataclass(frozen=True, slots=True)
class _Map:
    """One cycle of a part: next states and outputs, by states and inputs."""

    by_state: np.ndarray
    by_input: np.ndarray
    out_by_state: np.ndarray
    out_by_input: np.ndarray


@dataclass(frozen=True, slots=True)
class Linearised:
    """A controller in front of a body, each linearised by itself; `closed` and `broken` put them together."""

    period_s: float
    delay_s: float  # sample instant -> a command acts
    axes: tuple[str, ...]
    tick: _Map
    tick_states: tuple[str, ...]
    amperes_per_n: np.ndarray  # of an asked force, one an axis
    words_per_n: np.ndarray
    body: Body
    place: int

    @property
    def precise_axis(self) -> str:
        """The axis that carries the end, whose command the loop is broken at."""
        return self.axes[-1]

    def closed(self, extra_delay_s: float = 0.0) -> LinearSystem:
        """Return the closed loop; commands act `extra_delay_s` later than the controller believes."""
        return self._together(self.axes, extra_delay_s)

    def broken(self, extra_delay_s: float = 0.0) -> LinearSystem:
        """Return the loop broken at the precise axis' command: `..._command_n` alone reaches the body there.

        The observer goes on feeling what the law asks for: it belongs to the controller.
        """
        return self._together(self.axes[:-1], extra_delay_s)

    def loop_gain(self, frequency_hz: np.ndarray) -> np.ndarray:
        """Return L of the broken loop: what the law answers to a force command, sign turned; -1 is critical."""
        axis = self.precise_axis
        return -self.broken().response(frequency_hz, f"{axis}_command_n", f"{axis}_force_asked_n")

    def _together(self, connected: Sequence[str], extra_delay_s: float) -> LinearSystem:
        axes, period_s = self.axes, self.period_s
        delay_s = self.delay_s + extra_delay_s
        whole = int(np.floor(delay_s / period_s + 1e-9))
        body = _body_map(self.body, self.place, axes, max(delay_s - whole * period_s, 0.0), period_s)
        n_axes, n_body, n_tick = len(axes), body.by_state.shape[0], self.tick.by_state.shape[0]
        n_sent = n_axes * (whole + 1)
        n = n_body + n_sent + n_tick
        inputs = [f"{axis}_{what}" for what in ("command_n", "rounding_n", "force_n") for axis in axes]
        inputs += [f"{name}_noise_m" for name in _seen(axes)]
        outputs = ["end_position_m", "end_mean_m", "macro_position_m", *(f"{axis}_force_asked_n" for axis in axes)]
        m = n + len(inputs)
        take = np.eye(m)  # every signal is a row over states and inputs
        xb, sent, xt = take[:n_body], take[n_body : n_body + n_sent].reshape(whole + 1, n_axes, m), take[n - n_tick : n]
        command, rounding, force, noise = (take[n + k * n_axes : n + (k + 1) * n_axes] for k in range(4))
        measured = body.out_by_state[: len(axes)] @ xb + noise
        asked_n = self.tick.out_by_state @ xt + self.tick.out_by_input @ measured
        is_connected = np.array([axis in connected for axis in axes], float)[:, None]
        new_a = self.amperes_per_n[:, None] * (is_connected * (asked_n + rounding) + command)
        held_a = [new_a, *sent]  # of this tick, of the tick before, ...
        felt = np.vstack([held_a[whole + 1], held_a[whole], force])
        next_xb = body.by_state @ xb + body.by_input @ felt
        next_xt = self.tick.by_state @ xt + self.tick.by_input @ measured
        for k, axis in enumerate(axes):
            next_xt[self.tick_states.index(f"{axis}_word")] += self.words_per_n[k] * rounding[k]
        mean = body.out_by_state[-1:] @ xb + body.out_by_input[-1:] @ felt
        names = [name for name in _BODY_STATES if _of_axes(name, axes)]
        end, macro = xb[[names.index(f"{_seen(axes)[-1]}_position_m")]], xb[[names.index("macro_position_m")]]
        new = np.vstack([next_xb, *held_a[: whole + 1], next_xt])
        seen = np.vstack([end, mean, macro, asked_n])
        return LinearSystem(period_s, new[:, :n], new[:, n:], seen[:, :n], seen[:, n:], tuple(inputs), tuple(outputs))


def linearise(
    profile: "Profile",
    law: str,
    body: Body,
    place: int = GAP,
    adaptive_gain_ratio: float = 0.0,
    observer: Callable[[np.ndarray], None] = adaptive_filter.in_motion,
    jerk_m_per_s3: float = 0.0,
) -> Linearised:
    """Linearise a profile's controller about e = 0 with this adaptive gain, and a body at the same place.

    `observer` brings it to where it is judged: as a force leaves it, or `adaptive_filter.at_rest`. The reference is at
    rest when the command acts, or passes through it with this jerk, which lasts.

    RequestError where the macro's drive closes its own loop, or an effect's dead time has no small differences.
    """
    one = controller(profile, law, has_drives=False)
    if one.estimator["position_mode"][0] != 0.0:
        raise RequestError("macro.mode = 'position': the loop that the drive closes is not known here; use 'torque'")
    _refuse_dead_times([*body.effects, *profile.effects])
    axes = _AXES if profile.micro is not None else _AXES[:1]
    if place != GAP and len(axes) == 1:
        raise RequestError(f"profile {profile.name}: this stage has no micro and no joint that could touch")
    for axis in axes:
        one.estimator[f"{axis}_amperes_per_word"] *= _FINE_RATIO
    one.law["adaptive_gain_ratio"] = adaptive_gain_ratio
    observer(one.estimator)
    one.setpoint[...] = np.zeros(1, SETPOINT)
    delay_s = float(one.estimator["actuation_delay_s"][0] + one.estimator["lead_s"][0])
    one.setpoint["jerk_m_per_s3"] = jerk_m_per_s3
    one.setpoint["acceleration_m_per_s2"] = -jerk_m_per_s3 * delay_s  # at rest when the command acts: e = 0
    one.setpoint["velocity_m_per_s"] = 0.5 * jerk_m_per_s3 * delay_s**2
    one.setpoint["position_m"] = -jerk_m_per_s3 * delay_s**3 / 6.0
    amperes_per_n = np.array([1.0 / float(one.belief[f"{axis}_force_constant_n_per_a"][0]) for axis in axes])
    amperes_per_word = np.array([float(one.estimator[f"{axis}_amperes_per_word"][0]) for axis in axes])
    tick, states = _tick_map(one, LAWS[law].LINEAR_STATES, axes, place, _memory_count(profile.effects))
    return Linearised(
        period_s=float(one.estimator["period_s"][0]),
        delay_s=profile.cycle.actuation_delay_s,
        axes=axes,
        tick=tick,
        tick_states=states,
        amperes_per_n=amperes_per_n,
        words_per_n=amperes_per_n / amperes_per_word,
        body=body,
        place=place,
    )


def _seen(axes: Sequence[str]) -> tuple[str, ...]:
    """Return what the sensors see: the macro alone, or the macro and the end."""
    return ("macro", "end")[: len(axes)]


def _of_axes(name: str, axes: Sequence[str]) -> bool:
    return len(axes) == 2 or name.startswith("macro")


def _memory_count(effects: Sequence[Any]) -> int:
    return sum(CATALOGUE[row["name"]].memory for row in effects)


def _refuse_dead_times(effects: Sequence[Any]) -> None:
    if any(row["name"] == "command_delay" for row in effects):
        raise RequestError(
            "effect command_delay: its memory holds instants, which have no small differences; "
            "take it out and add its delay_s to cycle.actuation_delay_s"
        )


def _set_place(state: np.ndarray, parameters: np.ndarray, place: int) -> None:
    """Put macro and end to rest, the end at 0, in the middle of the gap or just in contact."""
    q = parameters[0]
    if not (q["has_micro"] != 0.0 and np.isfinite(q["right_m"]) and np.isfinite(q["left_m"])):
        return
    x_b = {GAP: 0.5 * (q["right_m"] - q["left_m"]), RIGHT: q["right_m"] + _PENETRATION_M}
    state["macro_position_m"] = x_b.get(place, -q["left_m"] - _PENETRATION_M)


class _Slots:
    """Numbers in structured arrays, as one vector: read it, write it, and how far each is moved for a difference."""

    def __init__(self, places: Sequence[tuple[np.ndarray, str]], memory: np.ndarray) -> None:
        self._places = [array[name] for array, name in places]
        self._memory = memory
        self.names = (*(name for _, name in places), *(f"memory {k}" for k in range(memory.size)))

    def read(self) -> np.ndarray:
        return np.concatenate([[place.item() for place in self._places], self._memory])

    def write(self, values: np.ndarray) -> None:
        for place, value in zip(self._places, values, strict=False):
            place[0] = value
        self._memory[:] = values[len(self._places) :]


def _step_of(name: str) -> float:
    return next((step for ending, step in _STEPS if name.endswith(ending)), _MEMORY_STEP)


def _differences(run: Any, at: np.ndarray, steps: np.ndarray) -> np.ndarray:
    """Return d run / d at by central differences, shape (results, at.size)."""
    columns = []
    for k, step in enumerate(steps):
        move = np.zeros(at.size)
        move[k] = step
        columns.append((run(at + move) - run(at - move)) / (2.0 * step))
    return np.column_stack(columns)


def _split(jacobian: np.ndarray, n_states: int) -> _Map:
    return _Map(
        jacobian[:n_states, :n_states],
        jacobian[:n_states, n_states:],
        jacobian[n_states:, :n_states],
        jacobian[n_states:, n_states:],
    )


def _tick_map(
    one: Controller, law_states: Sequence[str], axes: Sequence[str], place: int, memory_count: int
) -> tuple[_Map, tuple[str, ...]]:
    """Return the tick's map (states, measured positions) -> (states, asked forces), and the names of its states."""
    _set_place(one.model, one.belief, place)
    one.estimator["started"] = 1.0
    for name in ("started", "macro_started"):
        if name in (one.law.dtype.names or ()):
            one.law[name] = 1.0
    for name in ("carried_acceleration_m_per_s2", "sampled_acceleration_m_per_s2"):
        before_s = float(one.estimator["period_s"][0])
        one.estimator[name] = one.setpoint["acceleration_m_per_s2"] - before_s * one.setpoint["jerk_m_per_s3"]
    if len(axes) == 2:
        # The reference is where the stage is: 7.5 mm beside it the macro's force is at its limit, and stays there.
        x_b = one.model["macro_position_m"] - one.model["end_position_m"]
        one.setpoint["relative_position_m"] = float(gap_centre(one.belief[0])) - x_b
    one.measurement["cycle"] = one.measurement["sequence"] = one.measurement["samples_new"] = 1
    one.measurement["lease_left_ns"] = 1_000_000_000
    places = [(one.model, name) for name in _MODEL_STATES if _of_axes(name, axes)]
    places += [(one.estimator, name) for name in _ESTIMATOR_STATES if _of_axes(name, axes)]
    if one.setpoint["jerk_m_per_s3"][0] != 0.0:
        fed = one.estimator["mass_fed"].view([(name, "f8") for name in _FED_STATES])[0]
        places += [(one.estimator, "mass_error_kg"), *((fed, name) for name in _FED_STATES)]
    places += [(one.estimator, name) for name in notch.LINEAR_STATES]
    places += [(one.law, name) for name in law_states if len(axes) == 2 or not name.startswith("macro_")]
    slots = _Slots(places, one.model["memory"][0, :memory_count])
    before_contact = one.snapshot()
    one.step()
    contact_n = float(one.model["contact_force_n"][0])
    one.restore(before_contact)
    one.estimator["sampled_contact_n"] = contact_n  # a contact that stands still is no change of one
    back_to_rest = one.returner(one.snapshot())
    measured = [f"{name}_position_m" for name in _seen(axes)]
    n = len(slots.names)
    words = {f"{axis}_word": float(one.estimator[f"{axis}_amperes_per_word"][0]) for axis in axes}
    words |= {f"{name}_before": value for name, value in words.items()}

    def run(values: np.ndarray) -> np.ndarray:
        back_to_rest()
        slots.write(values[:n])
        for name, value in zip(measured, values[n:], strict=True):
            one.measurement[name] = value
        if len(axes) == 1:  # the macro carries the end
            one.measurement["end_position_m"] = one.measurement["macro_position_m"]
        one.step()
        if one.command["stop"][0] != 0:
            raise RequestError(f"the guard stops at rest on the reference: stop {int(one.command['stop'][0])}")
        return np.concatenate([slots.read(), [float(one.command[f"{axis}_force_asked_n"][0]) for axis in axes]])

    at = np.concatenate([slots.read(), [float(one.model[name][0]) for name in measured]])
    steps = [_STEP_A / words[name] if name in words else _step_of(name) for name in (*slots.names, *measured)]
    jacobian = _differences(run, at, np.array(steps))
    back_to_rest()
    return _split(jacobian, n), slots.names


@lru_cache(maxsize=64)  # a search of gains asks for the same body again and again
def _body_map(body: Body, place: int, axes: tuple[str, ...], before_s: float, period_s: float) -> _Map:
    """Return a body's map over a cycle: amperes until `before_s`, amperes after, forces -> what is seen, end's mean."""
    state = np.zeros(1, plant.PLANT_STATE)
    parameters = body.parameters.copy()
    parameters["draws_noise"] = 0.0
    effects = compose.effect_parameters(body.effects)
    _set_place(state, parameters, place)
    places = [(state, name) for name in _BODY_STATES if _of_axes(name, axes)]
    slots = _Slots(places, state["memory"][0, : _memory_count(body.effects)])
    rest = state.copy()
    n, n_axes = len(slots.names), len(axes)

    def run(values: np.ndarray) -> np.ndarray:
        state[...] = rest
        slots.write(values[:n])
        before, after, force = values[n + 2 :].reshape(3, n_axes)
        for axis, force_n in zip(axes, force, strict=True):
            state[f"{axis}_disturbance_n"] = force_n
        for until_s, amperes in ((before_s, before), (period_s, after)):
            held = (*amperes, 0.0)[:2]
            body.module.advance(
                state, parameters, effects, until_s, body.longest_substep_s, held[0], held[1],
                plant.BRIDGE_CURRENT, plant.BRIDGE_CURRENT,
            )  # fmt: skip
        mean_m = float(state["end_position_integral_m_s"][0]) / period_s
        errors_m = body.module.sense(state, parameters, effects, period_s)
        return np.concatenate([slots.read(), errors_m, [mean_m]])

    at = np.concatenate([slots.read(), np.zeros(2 + 3 * n_axes)])
    steps = [_step_of(name) for name in slots.names] + [1.0, 1.0] + [1e-4] * (2 * n_axes) + [1e-3] * n_axes
    return _with_errors(_split(_differences(run, at, np.array(steps)), n + 2), slots.names, axes)


def _with_errors(cycle: _Map, names: Sequence[str], axes: Sequence[str]) -> _Map:
    """Put what the sensors see before the outputs: positions, and their errors, which are states of a body's map."""
    n = cycle.by_state.shape[0]
    seen = np.zeros((len(axes), n))
    for k, name in enumerate(_seen(axes)):
        seen[k, list(names).index(f"{name}_position_m")] = 1.0
        seen[k, len(names) + k] = 1.0
    return _Map(
        cycle.by_state,
        cycle.by_input,
        np.vstack([seen, cycle.out_by_state]),
        np.vstack([np.zeros((len(axes), cycle.by_input.shape[1])), cycle.out_by_input]),
    )
