"""Draws a case from a seed: machine, belief, runs, hidden effects, and the recorded columns."""

import math
from dataclasses import dataclass, field

import numpy as np

from tests.blind import laws, machine, moves
from tests.blind.machine import BASE, CONTROL, SAMPLE_S, B, C

KINDS = {"null": 0.22, "single": 0.42, "multi": 0.17, "outside": 0.11, "parameter": 0.08}
COLOURED_RMS_N = 0.05
COLOURED_CORNER_HZ = 1.5
SENSOR_QUANTUM_M = 1e-10
WAVELENGTH_M = 632.8e-9
FOLLOWING_LIMIT_M = 2e-3  # a worse loop is drawn again

# half widths of the uniform error of each belief: relative, or in the unit of the value
RELATIVE_ERROR = {
    "macro_mass_kg": 0.01,
    "micro_mass_kg": 0.01,
    "macro_force_constant_n_per_a": 0.01,
    "micro_force_constant_n_per_a": 0.01,
    "spring_stiffness_n_per_m": 0.02,
    "spring_damping_n_s_per_m": 0.2,
    "left_contact_stiffness_n_per_m": 0.02,
    "right_contact_stiffness_n_per_m": 0.02,
    "contact_damping_n_s_per_m": 0.2,
    "macro_damping_n_s_per_m": 0.2,
    "macro_current_lag_s": 0.1,
    "micro_current_lag_s": 0.1,
}
ABSOLUTE_ERROR = {
    "left_edge_m": 0.5e-6,
    "right_edge_m": 0.5e-6,
    "macro_command_delay_s": 10e-6,
    "micro_command_delay_s": 10e-6,
}
SINGLE_BASE = (
    "macro_mass_kg",
    "macro_force_constant_n_per_a",
    "macro_damping_n_s_per_m",
    "macro_command_delay_s",
    "macro_current_lag_s",
)
PAIR_BASE = tuple(name for name in BASE if name not in ("macro_damping_n_s_per_m", "micro_reaction"))

# parameter errors: name, acts_on -> the beliefs that are wrong together
PARAMETER_ERRORS = {
    ("mass_error", "macro_force"): ("macro_mass_kg",),
    ("mass_error", "micro_force"): ("micro_mass_kg",),
    ("force_constant_error", "macro_actuator"): ("macro_force_constant_n_per_a",),
    ("force_constant_error", "micro_actuator"): ("micro_force_constant_n_per_a",),
    ("spring_stiffness_error", "contact"): ("spring_stiffness_n_per_m",),
    ("contact_stiffness_error", "contact"): ("left_contact_stiffness_n_per_m", "right_contact_stiffness_n_per_m"),
    ("backlash_width", "contact"): ("left_edge_m", "right_edge_m"),
}


@dataclass
class Effect:
    """A hidden effect: its law, where it acts, its values; phases are lists, one a homing or a run."""

    law: laws.Law
    acts_on: str
    values: dict

    @property
    def place(self):
        """0 macro, 1 end stage."""
        return 1 if self.acts_on in ("micro_force", "micro_actuator", "micro_command", "end_sensor") else 0

    def vector(self, run):
        """Parameters in a run, as the compiled code takes them."""
        return self.law.vector(self.values_in(run))

    def values_in(self, run):
        """Parameters in a run, by name."""
        values = dict(self.values)
        for parameter in self.law.parameters:
            if parameter.spread == "phase":
                values[parameter.name] = self.values[parameter.name][run.homing]
            elif parameter.spread == "run_phase":
                values[parameter.name] = self.values[parameter.name][run.number]
        return values

    def scaled(self, factor):
        """The same effect with its amplitude times `factor`."""
        first = self.law.parameters[0].name
        return Effect(self.law, self.acts_on, self.values | {first: self.values[first] * factor})


@dataclass
class Run:
    """One recording: how it was made and, once simulated, what it shows."""

    number: int
    recipe: str
    homing: int
    payload_kg: float
    control: np.ndarray
    reference: np.ndarray
    relative: np.ndarray
    coloured: np.ndarray
    noise: np.ndarray
    current_noise: np.ndarray
    start_s: float
    samples: np.ndarray = field(default_factory=lambda: np.zeros((0, 8)))
    cells: np.ndarray = field(default_factory=lambda: np.zeros((0, 8)))
    marks: np.ndarray = field(default_factory=lambda: np.zeros((0, 8)))
    errors: np.ndarray = field(default_factory=lambda: np.zeros((0, 8)))

    @property
    def readings(self):
        """(n, 2) recorded positions in m."""
        return np.round(self.samples[:, 0:2] / SENSOR_QUANTUM_M) * SENSOR_QUANTUM_M


@dataclass
class Case:
    """A drawn set: everything true of it, what the modeller believes, its runs."""

    seed: int
    kind: str
    single: bool
    base: np.ndarray
    belief: dict
    uncertainty: dict
    effects: list
    parameter_errors: dict
    runs: list
    sensor_noise_m: tuple
    current_noise_a: tuple
    current_quantum_a: tuple
    command_in_amperes: bool

    @property
    def base_names(self):
        """Base parameters that the modeller knows with an uncertainty."""
        return SINGLE_BASE if self.single else PAIR_BASE


def coloured_force(rng, n):
    """A force in N with power spectrum 1 / (1 + (f / 1.5 Hz)^4) and 0.05 N rms: (n + 1,)."""
    length = 2 * (n + 1)  # twice as long, so that its end doesn't meet its start
    frequency = np.fft.rfftfreq(length, SAMPLE_S)
    power = coloured_power(frequency)
    parts = rng.standard_normal((2, len(frequency)))
    spectrum = np.sqrt(0.5 * power * length) * (parts[0] + 1j * parts[1])
    spectrum[0] = math.sqrt(power[0] * length) * parts[0, 0]
    return np.fft.irfft(spectrum, length)[: n + 1]


def coloured_power(frequency_hz):
    """Variance density of the coloured force in units in which white noise of variance s2 has density s2, in N^2."""
    one_sided = COLOURED_RMS_N**2 / (COLOURED_CORNER_HZ * math.pi / (2.0 * math.sqrt(2.0)))
    return one_sided / (2.0 * SAMPLE_S) / (1.0 + (frequency_hz / COLOURED_CORNER_HZ) ** 4)


def drawn_base(rng, single):
    """True base parameters."""
    base = np.zeros(len(BASE))
    put = {
        "macro_mass_kg": rng.uniform(60, 80),
        "micro_mass_kg": rng.uniform(35, 45),
        "macro_force_constant_n_per_a": rng.uniform(80, 120),
        "micro_force_constant_n_per_a": rng.uniform(25, 35),
        "spring_stiffness_n_per_m": rng.uniform(300, 700),
        "spring_damping_n_s_per_m": rng.uniform(3, 8),
        "left_contact_stiffness_n_per_m": 13.2e3 * rng.uniform(0.9, 1.1),
        "right_contact_stiffness_n_per_m": 9.87e3 * rng.uniform(0.9, 1.1),
        "left_edge_m": 25.4e-6 * rng.uniform(0.9, 1.1),
        "right_edge_m": 176e-6 * rng.uniform(0.9, 1.1),
        "contact_damping_n_s_per_m": rng.uniform(60, 140),
        "macro_damping_n_s_per_m": 0.0,
        "macro_command_delay_s": rng.uniform(0.55e-3, 0.59e-3),
        "micro_command_delay_s": rng.uniform(0.55e-3, 0.59e-3),
        "macro_current_lag_s": rng.uniform(0.13e-3, 0.17e-3),
        "micro_current_lag_s": rng.uniform(0.13e-3, 0.17e-3),
        "micro_reaction": 1.0,
    }
    if single:
        put |= {"macro_mass_kg": rng.uniform(30, 110), "macro_damping_n_s_per_m": rng.uniform(10, 60)}
        put |= {"micro_reaction": 0.0}
    for name, value in put.items():
        base[B[name]] = value
    return base


def believed(rng, base, names):
    """(values, standard deviations) of a modeller: uniform errors, their own standard deviations stated."""
    values, uncertainty = {}, {}
    for name in names:
        true = base[B[name]]
        half = RELATIVE_ERROR[name] * true if name in RELATIVE_ERROR else ABSOLUTE_ERROR[name]
        values[name] = float(true + half * rng.uniform(-1, 1))
        uncertainty[name] = float(half / math.sqrt(3.0))
    return values, uncertainty


def controller(rng, belief, single, payload_kg, tuning):
    """Gains from what is believed, times a run's tuning."""
    c = np.zeros(len(CONTROL))
    macro_hz, micro_hz = tuning[0], tuning[1]
    m1 = belief["macro_mass_kg"] + (payload_kg if single else 0.0)
    c[C["macro_position_gain_per_s"]] = 2 * math.pi * macro_hz / 4
    c[C["macro_velocity_gain_n_s_per_m"]] = m1 * 2 * math.pi * macro_hz
    c[C["macro_integral_gain_per_s"]] = 2 * math.pi * macro_hz / 8
    c[C["macro_velocity_filter_hz"]] = 200.0
    c[C["macro_acceleration_feedforward_kg"]] = m1
    c[C["macro_velocity_feedforward_n_s_per_m"]] = belief.get("macro_damping_n_s_per_m", 0.0)
    c[C["macro_force_limit_n"]] = 400.0
    c[C["macro_force_constant_n_per_a"]] = belief["macro_force_constant_n_per_a"]
    c[C["micro_force_constant_n_per_a"]] = 1.0
    if not single:
        m2 = belief["micro_mass_kg"] + payload_kg
        c[C["micro_position_gain_per_s"]] = 2 * math.pi * micro_hz / 4
        c[C["micro_velocity_gain_n_s_per_m"]] = m2 * 2 * math.pi * micro_hz
        c[C["micro_integral_gain_per_s"]] = 2 * math.pi * micro_hz / 8
        c[C["micro_velocity_filter_hz"]] = 300.0
        c[C["micro_acceleration_feedforward_kg"]] = m2
        c[C["spring_feedforward_n_per_m"]] = belief["spring_stiffness_n_per_m"]
        c[C["micro_force_limit_n"]] = 180.0
        c[C["reaction_decoupling"]] = belief["micro_reaction"]
        c[C["micro_force_constant_n_per_a"]] = belief["micro_force_constant_n_per_a"]
    return c


def drawn_effect(rng, law, acts_on, homings, runs):
    """An effect with its values drawn from the law's ranges."""
    values = {}
    for parameter in law.parameters:
        if parameter.spread == "phase":
            values[parameter.name] = [float(rng.uniform(0, 2 * math.pi)) for _ in range(homings)]
        elif parameter.spread == "run_phase":
            values[parameter.name] = [float(rng.uniform(0, 2 * math.pi)) for _ in range(runs)]
        else:
            values[parameter.name] = parameter.drawn(rng)
    if law.name == "cubic_stiffness":  # between the stages it acts over 100 um, where the spring has 0.05 N
        low, top = (0.003, 0.1) if acts_on == "contact" else (0.05, 5.0)
        values["force_at_reference_n"] = float(low * (top / low) ** rng.random())
    return Effect(law, acts_on, values)


def exclusive(effect):
    """What two effects of one set may not share: a dry friction, an actuator's law, a sensor, the contact law."""
    if effect.law.family == "friction" or effect.law.name in ("dahl_friction", "lugre_friction"):
        return "friction", effect.place
    if effect.law.family in ("actuator", "sensor"):
        return effect.law.family, effect.place
    if effect.acts_on == "contact":
        return ("contact",)
    return effect.law.name, effect.acts_on


def are_one(effect, other):
    """Whether two effects may not stand beside each other: they share what is exclusive, or are one law together.

    An asymmetric Coulomb friction and a constant force are one of other levels, moving and at rest: motions differ by
    0.05 nm at most, by rounding.
    """
    if exclusive(effect) == exclusive(other):
        return True
    names = {effect.law.name, other.law.name}
    return names == {"asymmetric_coulomb_friction", "offset"} and effect.place == other.place


def choices(single, outside):
    """Laws and places that a stage can have, each law equally likely."""
    pool = laws.OUTSIDE if outside else laws.LIBRARY
    result = []
    for law in pool:
        if single and not law.single_axis:
            continue
        places = [place for place in law.acts_on if not (single and place.startswith(("micro", "end", "contact")))]
        if single and law.name in ("scale_error", "abbe_error", "thermal_drift"):
            continue  # one sensor alone: nothing to hold it against
        if places:
            result.append((law, places))
    return result


def drawn_effects(rng, kind, single, homings, runs):
    """The hidden effects of a set of this kind."""
    if kind in ("null", "parameter"):
        return []
    count = 1 if kind in ("single", "outside") else (2 if rng.random() < 0.7 else 3)
    pool = choices(single, kind == "outside")
    effects = []
    while len(effects) < count:
        law, places = pool[rng.integers(len(pool))]
        effect = drawn_effect(rng, law, str(rng.choice(places)), homings, runs)
        if not any(are_one(effect, other) for other in effects):
            effects.append(effect)
    return effects


def simulate(case, effects=None):
    """Runs of the case with these effects (its own where None): fresh Run objects, the same noise."""
    effects = case.effects if effects is None else effects
    codes = np.array([effect.law.code_at(effect.acts_on) for effect in effects], dtype=np.int64)
    places = np.array([effect.place for effect in effects], dtype=np.int64)
    result = []
    for run in case.runs:
        p = np.array([effect.vector(run) for effect in effects]).reshape(len(effects), laws.PARAMETERS)
        out = machine.simulate(
            case.base,
            run.payload_kg,
            case.single,
            run.control,
            run.reference,
            run.relative,
            run.coloured,
            run.noise,
            run.start_s,
            codes,
            places,
            p,
        )
        result.append(Run(**{**vars(run), "samples": out[0], "cells": out[1], "marks": out[2], "errors": out[3]}))
    return result


def follows(runs):
    """Whether every run stays with its reference."""
    for run in runs:
        miss = run.samples[:, 0] - (run.reference[:, 0] - run.relative[:, 0])
        if not np.abs(miss).max() < FOLLOWING_LIMIT_M:
            return False
        if np.any(run.samples[:, 1]) and not np.abs(run.samples[:, 1] - run.reference[:, 0]).max() < FOLLOWING_LIMIT_M:
            return False
    return True


def drawn_recipes(rng, single):
    """3 to 5 different recipes; two of three sets of a macro-micro stage touch both stops."""
    count = int(rng.integers(3, 6))
    names = [name for name in moves.RECIPES if name != "two_sided_contact"]
    touching = not single and rng.random() < 0.67
    recipes = [str(name) for name in rng.choice(names, count - touching, replace=False)]
    return recipes + ["two_sided_contact"] * touching


def draw(seed, kind=None, duration_s=20.0):
    """The case of a seed, simulated. The same seed, kind and duration give the same case, bit for bit."""
    rng = np.random.default_rng([seed, 20230])
    drawn = str(rng.choice(list(KINDS), p=list(KINDS.values())))
    kind = kind or drawn
    if kind not in KINDS:
        raise ValueError(f"kind {kind!r} is none of {', '.join(KINDS)}")
    for _ in range(40):
        case = _drawn_case(rng, seed, kind, duration_s)
        for _ in range(4):
            case.runs = simulate(case)
            if follows(case.runs):
                return case
            case.effects = [effect.scaled(0.5) for effect in case.effects]
    raise RuntimeError(f"seed {seed}: no stable loop in 40 draws")


def _drawn_case(rng, seed, kind, duration_s):
    single = bool(rng.random() < 0.2)
    n = round(duration_s / SAMPLE_S)
    base = drawn_base(rng, single)
    recipes = drawn_recipes(rng, single)
    homings = int(rng.integers(1, 3))
    effects = drawn_effects(rng, kind, single, homings, len(recipes))
    names = SINGLE_BASE if single else PAIR_BASE
    belief, uncertainty = believed(rng, base, names)
    # Absent from the model where the effect itself is hidden, and in some other sets absent from machine and model, so
    # that a zero tells nothing.
    hidden = [effect.law.name for effect in effects]
    if "micro_reaction" in hidden or rng.random() < 0.15:
        base[B["micro_reaction"]] = 0.0
    belief["micro_reaction"] = float(base[B["micro_reaction"]])
    uncertainty["micro_reaction"] = 0.0
    if not single and ("contact_damping" in hidden or rng.random() < 0.15):
        base[B["contact_damping_n_s_per_m"]] = belief["contact_damping_n_s_per_m"] = 0.0
        uncertainty["contact_damping_n_s_per_m"] = 0.0
    wrong = _wrong_parameters(rng, belief, uncertainty, single) if kind == "parameter" else {}
    sensor_noise = tuple(float(1e-9 * 30.0 ** rng.random()) for _ in range(2))
    current_noise = (float(rng.uniform(2e-3, 15e-3)), float(rng.uniform(1e-3, 8e-3)))
    quantum = (float(rng.choice((1e-3, 5e-3))), float(rng.choice((0.5e-3, 2e-3))))
    payload_set = rng.random() < 0.4
    tuning_set = rng.random() < 0.5
    tuning = np.array([rng.uniform(14, 24), rng.uniform(35, 60)])
    runs = []
    for number, recipe in enumerate(recipes):
        payload = float(np.round(rng.uniform(1, 8), 2)) if payload_set and rng.random() < 0.5 else 0.0
        factor = rng.uniform(0.6, 1.1) if tuning_set and rng.random() < 0.6 else 1.0
        reference, relative = moves.run_paths(recipe, rng, n, single, belief_edge(belief, 0), belief_edge(belief, 1))
        coloured = np.column_stack([coloured_force(rng, n), coloured_force(rng, n)])
        noise = rng.standard_normal((n, 2)) * np.array(sensor_noise)
        if single:
            coloured[:, 1], noise[:, 1] = 0.0, 0.0
        runs.append(
            Run(
                number,
                recipe,
                0 if number < (len(recipes) + 1) // 2 else homings - 1,
                payload,
                controller(rng, belief, single, payload, tuning * factor),
                reference,
                relative,
                np.ascontiguousarray(coloured),
                noise,
                rng.standard_normal((n, 2)) * np.array(current_noise),
                number * (duration_s + 10.0),
            )
        )
    return Case(
        seed,
        kind,
        single,
        base,
        belief,
        uncertainty,
        effects,
        wrong,
        runs,
        sensor_noise,
        current_noise,
        quantum,
        bool(rng.random() < 0.25),
    )


def belief_edge(belief, side):
    """A believed edge in m; 0 on a single axis."""
    return belief.get(("left_edge_m", "right_edge_m")[side], 0.0)


def _wrong_parameters(rng, belief, uncertainty, single):
    """Moves one or two beliefs 5 to 14 stated standard deviations; {(name, acts_on): error of belief in sd}."""
    pool = [key for key, names in PARAMETER_ERRORS.items() if all(name in belief for name in names)]
    wrong = {}
    for index in rng.permutation(len(pool))[: 1 if rng.random() < 0.75 else 2]:
        key = pool[index]
        size = float(rng.uniform(5.0, 14.0) * rng.choice((-1.0, 1.0)))
        for name in PARAMETER_ERRORS[key]:
            belief[name] += size * uncertainty[name]
        wrong[key] = size
    return wrong
