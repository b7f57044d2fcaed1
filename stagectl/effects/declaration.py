"""What an effect is, and how one is declared: a function whose argument names are its declaration.

Names that are quantities (`QUANTITIES_OF`) are what the effect depends on, every other argument is a parameter, and
every name ends in its unit. The same text compiles for the tick and runs in analysis. Pure; knows no bus and no clock.

An effect with memory takes `memory` as its last argument: a float64 slice of the length that the decorator states,
zero at the start, read and written in place. It is advanced by `dt_s` with a step that is exact or implicit, so
that it is stable for any `dt_s`, and returns its mean over the step. With `dt_s` = 0 it returns its present value
and leaves its memory alone.
"""

import inspect
from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from stagectl.compiled import compiled
from stagectl.units import unit_of

QUANTITIES = (
    "position_m",  # of the axis that the effect acts on
    "velocity_m_per_s",
    "acceleration_m_per_s2",  # of the substep before: a force that needs the acceleration it causes would be a loop
    "mass_kg",  # of the axis
    "relative_position_m",  # end minus macro
    "relative_velocity_m_per_s",
    "current_a",  # of the axis' motor
    "motor_force_n",  # force that the axis' current should make
    "micro_motor_force_n",  # the voice coil's force, whichever axis the effect acts on
    "t_s",  # since the start of the run
    "dt_s",  # by which a memory is advanced; 0 = not at all
)
"""What a force or actuator effect may depend on."""

JOINT_QUANTITIES = ("position_m", "velocity_m_per_s", "t_s", "dt_s")
"""What a joint effect may depend on; position is end minus macro, velocity its rate."""

CONTACT_QUANTITIES = (
    "penetration_m",  # overlap of the joint's two parts, > 0 in contact
    "penetration_velocity_m_per_s",
    "contact_stiffness_n_per_m",  # of the side that touches
    "contact_side_ratio",  # +1 right (macro ahead of the end), -1 left
    "t_s",
    "dt_s",
)
"""What a contact effect may depend on."""

EDGE_QUANTITIES = ("contact_side_ratio", "t_s")
"""What the place of an edge of the gap may depend on."""

COMMAND_QUANTITIES = (
    "command_a",
    "current_loop_s",  # lag of the axis' current loop as it is stated; only for effects with a memory
    "t_s",
    "dt_s",
)
"""What an effect on the way of the current command may depend on; time is that of the substep's start."""

SENSOR_QUANTITIES = ("position_m", "velocity_m_per_s", "acceleration_m_per_s2", "t_s", "dt_s")
"""What a sensor effect may depend on: true motion of the axis at the sample; `dt_s` since the sample before."""

QUANTITIES_OF: dict[str, tuple[str, ...]] = {
    "macro_force": QUANTITIES,  # N, positive in the direction of positive position
    "micro_force": QUANTITIES,
    "joint": JOINT_QUANTITIES,  # N on the end, the opposite on the macro
    "contact": CONTACT_QUANTITIES,  # N that push the two parts of the joint apart; the sum never pulls
    "contact_edge": EDGE_QUANTITIES,  # m by which an edge lies further out
    "macro_actuator": QUANTITIES,  # N added to what the current should make
    "micro_actuator": QUANTITIES,
    "macro_command": COMMAND_QUANTITIES,  # A added to the commanded current, before the current loop
    "micro_command": COMMAND_QUANTITIES,
    "macro_sensor": SENSOR_QUANTITIES,  # m added to the reading
    "end_sensor": SENSOR_QUANTITIES,
}
"""Every place at which an effect may act, and what it may depend on there."""

PLACES = tuple(QUANTITIES_OF)
"""Where an effect may act."""

TAGS = ("structural", "session", "run")
"""How long a parameter lives: as long as the machine, until the next homing or power-up, for one run."""


class Trait(StrEnum):
    """What a search for missing effects has to know of a law, and its text can't say."""

    BASE = "base"  # what the base does: felt by everything that stands on it
    KNOWN_PARAMETER = "known parameter"  # says the same as a parameter of the machine that is wrong
    TIME_SHIFT = "time shift"  # readings of instants that are further and further off: more than a Taylor series holds
    LATE_READING = "late reading"  # a reading of an earlier instant: two such laws differ in what rounds the motion
    FIRST_ORDER = "first order"  # moves a reading by so little that no force feels it
    SWINGS = "swings"  # a share of the mass on a spring, driven by what all other forces make of the axis
    PLACED = "placed"  # acts about a place, and none is simpler than another: as plain as the same law about zero


MOTIONS = ("low speed", "strokes", "acceleration", "holds", "contact", "time")
"""Kinds of motion on which an effect may show best: `stagectl.gap.next_move` has the moves of each."""

_ALL_QUANTITIES = frozenset(name for names in QUANTITIES_OF.values() for name in names)
_MEMORY = "memory"


@dataclass(frozen=True, slots=True)
class Effect:
    """One declared law."""

    name: str
    law: Callable[..., float]
    compiled_law: Callable[..., float]
    quantities: tuple[str, ...]
    parameters: tuple[str, ...]
    places: tuple[str, ...]
    bounds: dict[str, tuple[float, float]]
    symptom: str
    reference: str
    memory: int  # floats
    linear: tuple[str, ...]  # parameters that the output is linear in, all of them together
    tags: dict[str, str]  # of every parameter, one of TAGS
    traits: frozenset[Trait]
    searched: tuple[str, ...]  # shape parameters for which no grid is fine enough
    shown_by: str  # one of MOTIONS, "" where it is none of them in particular
    origin: str = ""  # hash of the text that it comes from, where that is a user's own

    @property
    def summary(self) -> str:
        """First line of the law's docstring."""
        return (inspect.getdoc(self.law) or "").splitlines()[0]

    @property
    def has_step(self) -> bool:
        """Whether it jumps where a velocity changes its sign; the smoothing stands for the sign."""
        return "smoothing_m_per_s" in self.parameters

    @property
    def period(self) -> str:
        """The parameter with which it repeats: a pitch over position, a frequency over time; "" where it does not."""
        if "pitch_m" in self.parameters:
            return "pitch_m"
        repeats = "t_s" in self.quantities and "phase_rad" in self.parameters and self.shape == ("frequency_hz",)
        return "frequency_hz" if repeats else ""

    @property
    def shape(self) -> tuple[str, ...]:
        """The parameters that no solving finds: those that it is not linear in, but for phases."""
        return tuple(n for n in self.parameters if n not in self.linear and not n.endswith("phase_rad"))


CATALOGUE: dict[str, Effect] = {}
"""All declared effects by name."""


def effect(
    *,
    places: tuple[str, ...],
    symptom: str,
    reference: str,
    memory: int = 0,
    linear: tuple[str, ...] = (),
    session: tuple[str, ...] = (),
    run: tuple[str, ...] = (),
    traits: tuple[str, ...] = (),
    searched: tuple[str, ...] = (),
    shown_by: str = "",
    **bounds: tuple[float, float],
):
    """Declare the decorated function as an effect; wrong declarations raise TypeError at import.

    `memory`: length of its memory. `linear`: parameters that it is linear in. `session`, `run`: parameters that last
    until the next homing, or for one run only; all others are structural. `traits`, `searched`, `shown_by`: for
    `stagectl gap`; see Trait, Effect and MOTIONS.
    """

    def declare(law: Callable[..., float]) -> Callable[..., float]:
        name = law.__name__
        arguments = tuple(inspect.signature(law).parameters)
        problem = _memory_problem(arguments, places, memory)
        if arguments and arguments[-1] == _MEMORY:
            arguments = arguments[:-1]
        quantities = tuple(argument for argument in arguments if argument in _ALL_QUANTITIES)
        parameters = tuple(argument for argument in arguments if argument not in _ALL_QUANTITIES)
        problem = problem or _place_problem(quantities, places)
        if name in CATALOGUE:
            problem = "is declared twice"
        elif arguments != quantities + parameters:
            problem = f"quantities come before parameters, got {arguments}"
        elif not inspect.getdoc(law):
            problem = "no docstring; its first line is the summary in reports"
        elif set(bounds) != set(parameters):
            problem = f"bounds {sorted(bounds)} do not match parameters {sorted(parameters)}"
        elif wrong := [key for key, (low, high) in bounds.items() if not -np.inf < low < high < np.inf]:
            problem = f"bounds of {wrong[0]} are no range: {bounds[wrong[0]]}"
        elif nameless := [argument for argument in arguments if unit_of(argument) is None]:
            problem = f"argument {nameless[0]} states no unit"
        elif strange := [key for key in (*linear, *session, *run) if key not in parameters]:
            problem = f"{strange[0]} is tagged or linear, and is no parameter; there are {parameters}"
        elif strange := [key for key in searched if key not in parameters]:
            problem = f"{strange[0]} is searched, and is no parameter; there are {parameters}"
        elif solved := [key for key in searched if key in linear]:
            problem = f"{solved[0]} is linear, so it is solved for and not searched"
        elif strange := [trait for trait in traits if trait not in list(Trait)]:
            problem = f"unknown trait {strange[0]!r}; choose from {[str(trait) for trait in Trait]}"
        elif shown_by and shown_by not in MOTIONS:
            problem = f"is shown by an unknown motion {shown_by!r}; choose from {MOTIONS}"
        elif both := [key for key in session if key in run]:
            problem = f"{both[0]} can't last for a session and for a run"
        if problem:
            raise TypeError(f"effect {name} {problem}" if problem[:2] == "is" else f"effect {name}: {problem}")
        tags = {key: "session" if key in session else "run" if key in run else "structural" for key in parameters}
        CATALOGUE[name] = Effect(
            name, law, compiled(law), quantities, parameters, places, dict(bounds), symptom, reference,
            memory, linear, tags, frozenset(map(Trait, traits)), searched, shown_by,
        )  # fmt: skip
        return law

    return declare


def _memory_problem(arguments: tuple[str, ...], places: tuple[str, ...], memory: int) -> str:
    takes = arguments[-1:] == (_MEMORY,)
    if takes != (memory > 0):
        return f"memory = {memory} in the decorator, and the law {'takes' if takes else 'does not take'} a memory"
    if takes and "dt_s" not in arguments:
        return "a law with memory advances it by dt_s"
    if not takes and "current_loop_s" in arguments:
        return "what depends on the current loop's lag is no law without memory"
    if takes and "contact_edge" in places:
        return "the place of an edge has no memory: both edges are asked in every substep"
    return ""


def _place_problem(quantities: tuple[str, ...], places: tuple[str, ...]) -> str:
    for place in places:
        if place not in QUANTITIES_OF:
            return f"unknown place {place}; choose from {PLACES}"
        if strange := [name for name in quantities if name not in QUANTITIES_OF[place]]:
            return f"{strange[0]} is not known at {place}; there a law may depend on {QUANTITIES_OF[place]}"
    return "" if places else "no place to act at"
