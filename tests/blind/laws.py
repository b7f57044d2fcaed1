"""The generator's own force and sensor laws, each declared once with the range it is drawn from.

`p[0]` of every law is its amplitude: the law is linear in it, or nearly, and zero means absent. SI units throughout.
"""

import math
from dataclasses import dataclass, field

import numpy as np

from tests.blind.compiled import compiled

GRAVITY_M_PER_S2 = 9.80665
REFERENCE_LENGTH_M = 0.1  # lengths and speeds at which position and speed laws state their amplitude
REFERENCE_SPEED_M_PER_S = 0.1
REFERENCE_DEPTH_M = 1e-4
REFERENCE_FORCE_N = 100.0
PARAMETERS = 6  # widest law
MEMORIES = 4


@dataclass(frozen=True)
class Parameter:
    """One number of a law and the range it is drawn from.

    spread: "log" log-uniform, "uniform", "sign" log-uniform with a random sign, "phase" uniform in 0..2 pi and drawn
    again at each homing, "run_phase" the same for each run, "choice" one of the two ends, "or_zero" uniform or, half
    the time, zero. beyond: values where a foreign law may be that is drawn nowhere near.
    """

    name: str
    low: float
    high: float
    spread: str = "log"
    beyond: tuple = ()

    @property
    def middle(self):
        """Geometric mean of its range."""
        return math.sqrt(self.low * self.high)

    @property
    def is_phase(self):
        """Whether it is drawn again at each homing, or each run."""
        return "phase" in self.spread

    def drawn(self, rng):
        """One value."""
        low, high = self.low, self.high
        if self.spread == "log":
            return float(low * (high / low) ** rng.random())
        if self.spread == "sign":
            return float(low * (high / low) ** rng.random() * rng.choice((-1.0, 1.0)))
        if self.spread == "choice":
            return float(rng.choice((low, high)))
        if self.spread == "or_zero":
            value = float(rng.uniform(low, high))
            return value if rng.random() < 0.5 else 0.0
        return float(rng.uniform(low, high))

    def grid(self, count):
        """Values for a fit of a foreign law: the ends and what lies between."""
        low, high = self.low, self.high
        if self.spread in ("log",):
            return [low * (high / low) ** (i / max(count - 1, 1)) for i in range(count)]
        if self.spread == "sign":
            half = [low * (high / low) ** (i / max(count - 1, 1)) for i in range(count)]
            return [-value for value in half] + half
        if self.spread == "choice":
            return [low, high]
        if self.spread == "or_zero":
            return [0.0]
        if self.spread in ("phase", "run_phase"):
            return [0.0, 0.5 * math.pi]
        return [low + (high - low) * i / max(count - 1, 1) for i in range(count)] + list(self.beyond)


@dataclass(frozen=True)
class Law:
    """A law: its name, where it may act, its parameters (amplitude first) and which stages can have it."""

    name: str
    code: int
    acts_on: tuple
    parameters: tuple
    family: str  # force, friction, contact, actuator, sensor
    single_axis: bool = True  # a stage with one axis can have it
    signed: bool = False  # its amplitude may be negative
    outside: bool = False  # in no library
    both_axes: bool = False  # moves both axes at once
    grid_counts: tuple = field(default=())  # points for each parameter after the amplitude, in a foreign fit

    def code_at(self, acts_on):
        """Its code at a place: cubic stiffness between the stages is a law of the contact."""
        return BETWEEN_CUBIC if self.code == CUBIC and acts_on == "contact" else self.code

    @property
    def phase(self):
        """Its phase, None where it has none."""
        return next((parameter for parameter in self.parameters if parameter.is_phase), None)

    def vector(self, values):
        """Parameters as the compiled code takes them."""
        p = np.zeros(PARAMETERS)
        for i, parameter in enumerate(self.parameters):
            p[i] = values[parameter.name]
        return p


ENDS_OF_TRAVEL_M = (-0.5, 0.5)
"""Of a stage that states no travel, which is 1 m long then. A cable is anchored along it: within 0.1 m, where the stage
goes, an offset of 14 deviations seemed 6 from any cable, and half a metre away it is one."""
MACRO, MICRO = "macro_force", "micro_force"
EITHER_FORCE = (MACRO, MICRO)
EITHER_ACTUATOR = ("macro_actuator", "micro_actuator")
EITHER_COMMAND = ("macro_command", "micro_command")
EITHER_SENSOR = ("macro_sensor", "end_sensor")
P = Parameter

LAWS = (
    Law("viscous_friction", 1, EITHER_FORCE, (P("coefficient_n_s_per_m", 0.3, 15.0),), "force", single_axis=False),
    Law(
        "asymmetric_viscous_friction",
        2,
        EITHER_FORCE,
        (P("coefficient_n_s_per_m", 1.0, 20.0), P("asymmetry", 0.3, 0.8, "sign")),
        "force",
        grid_counts=(3,),
    ),
    Law("coulomb_friction", 3, EITHER_FORCE, (P("level_n", 0.05, 5.0),), "friction"),
    Law(
        "asymmetric_coulomb_friction",
        4,
        EITHER_FORCE,
        (P("level_n", 0.1, 5.0), P("asymmetry", 0.2, 0.7, "sign")),
        "friction",
        grid_counts=(3,),
    ),
    Law("offset", 5, EITHER_FORCE, (P("force_n", 0.05, 3.0, "sign"),), "force", signed=True),
    Law(
        "stribeck_friction",
        6,
        EITHER_FORCE,
        (P("level_n", 0.1, 5.0), P("breakaway_ratio", 1.3, 2.5), P("velocity_m_per_s", 0.5e-3, 20e-3)),
        "friction",
        grid_counts=(2, 4),
    ),
    Law(
        "sublinear_friction",
        7,
        EITHER_FORCE,
        (P("force_at_100_mm_per_s_n", 0.2, 8.0), P("exponent", 0.3, 0.7, "uniform")),
        "friction",
        grid_counts=(4,),
    ),
    Law(
        "dahl_friction",
        8,
        EITHER_FORCE,
        (P("level_n", 0.1, 5.0), P("distance_m", 1e-6, 30e-6)),
        "force",
        grid_counts=(5,),
    ),
    Law(
        "lugre_friction",
        9,
        EITHER_FORCE,
        (
            P("level_n", 0.1, 5.0),
            P("breakaway_ratio", 1.2, 2.0),
            P("velocity_m_per_s", 0.5e-3, 10e-3),
            P("distance_m", 1e-6, 20e-6),
            P("bristle_damping_s", 0.2e-3, 1e-3),
        ),
        "force",
        grid_counts=(2, 2, 3, 1),
    ),
    Law("load_dependent_friction", 10, EITHER_FORCE, (P("coefficient", 0.005, 0.1),), "friction"),
    Law("quadratic_drag", 11, EITHER_FORCE, (P("coefficient_n_s2_per_m2", 2.0, 60.0),), "force"),
    Law(
        "cogging",
        12,
        (MACRO,),
        (
            P("amplitude_n", 0.1, 6.0),
            P("pitch_m", 10e-3, 60e-3),
            P("phase_rad", 0.0, 2 * math.pi, "phase"),
            P("second_harmonic", 0.1, 0.4, "or_zero"),
        ),
        "force",
        signed=True,
        grid_counts=(8, 1, 1),
    ),
    Law(
        "current_ripple",
        13,
        ("macro_actuator",),
        (
            P("relative", 0.005, 0.08),
            P("pitch_m", 10e-3, 60e-3),
            P("phase_rad", 0.0, 2 * math.pi, "phase"),
        ),
        "actuator",
        signed=True,
        grid_counts=(8, 1),
    ),
    Law("force_constant_saturation", 14, EITHER_ACTUATOR, (P("loss_at_100_n", 0.01, 0.15),), "actuator"),
    Law(
        "cable_spring",
        16,
        (MACRO,),
        (P("stiffness_n_per_m", 0.5, 50.0), P("anchor_m", -0.1, 0.1, "uniform", ENDS_OF_TRAVEL_M)),
        "force",
        signed=True,
        grid_counts=(3,),
    ),
    Law(
        "cable_hysteresis",
        17,
        (MACRO,),
        (P("level_n", 0.1, 4.0), P("distance_m", 2e-3, 30e-3)),
        "force",
        grid_counts=(5,),
    ),
    Law("tilt", 18, (MACRO,), (P("angle_rad", 0.03e-3, 2e-3, "sign"),), "force", signed=True, both_axes=True),
    Law("linear_stiffness", 19, (MACRO,), (P("stiffness_n_per_m", 0.5, 50.0),), "force", signed=True),
    Law("cubic_stiffness", 20, (MACRO, "contact"), (P("force_at_reference_n", 0.003, 5.0),), "force", signed=True),
    Law(
        "position_dependent_friction",
        21,
        EITHER_FORCE,
        (P("level_n", 0.1, 4.0), P("slope_per_100_mm", 0.3, 0.9, "sign")),
        "friction",
        grid_counts=(3,),
    ),
    Law("backlash_centre", 22, ("contact",), (P("shift_m", 4e-6, 30e-6, "sign"),), "contact", False, True),
    Law("backlash_wear", 23, ("contact",), (P("rate_m_per_s", 0.03e-6, 2e-6),), "contact", False),
    Law("contact_damping", 24, ("contact",), (P("damping_n_s_per_m", 20.0, 300.0),), "contact", False),
    Law("soft_contact", 25, ("contact",), (P("knee_m", 3e-6, 60e-6),), "contact", False),
    Law(
        "contact_hysteresis",
        26,
        ("contact",),
        (P("loss", 0.02, 0.3), P("turn_m", 1e-6, 10e-6)),
        "contact",
        False,
        grid_counts=(3,),
    ),
    Law("micro_reaction", 27, (MACRO,), (P("fraction", 0.3, 1.0, "uniform"),), "force", False),
    Law(
        "flexible_mode",
        28,
        EITHER_FORCE,
        (P("mass_fraction", 0.01, 0.15), P("frequency_hz", 15.0, 90.0), P("damping_ratio", 0.01, 0.05)),
        "force",
        grid_counts=(8, 1),
    ),
    Law(
        "base_vibration",
        29,
        (MACRO,),
        (
            P("acceleration_m_per_s2", 0.3e-3, 20e-3),
            P("frequency_hz", 4.0, 60.0),
            P("phase_rad", 0.0, 2 * math.pi, "run_phase"),
        ),
        "force",
        signed=True,
        both_axes=True,
        grid_counts=(8, 1),
    ),
    Law("current_loop_lag", 30, EITHER_ACTUATOR, (P("lag_s", 0.03e-3, 0.6e-3),), "actuator"),
    Law("command_delay", 31, EITHER_COMMAND, (P("delay_s", 0.03e-3, 0.8e-3),), "actuator"),
    Law("amplifier_dead_band", 32, EITHER_ACTUATOR, (P("current_a", 0.002, 0.05),), "actuator"),
    Law("sensor_delay", 33, EITHER_SENSOR, (P("delay_s", 0.05e-3, 0.8e-3),), "sensor"),
    Law("sensor_lag", 34, EITHER_SENSOR, (P("lag_s", 0.05e-3, 0.8e-3),), "sensor"),
    Law("scale_error", 35, EITHER_SENSOR, (P("relative", 20e-6, 2000e-6, "sign"),), "sensor", False, True),
    Law(
        "cyclic_error",
        36,
        EITHER_SENSOR,
        (
            P("amplitude_m", 2e-9, 30e-9),
            P("period_m", 158.2e-9, 316.4e-9, "choice"),
            P("phase_rad", 0.0, 2 * math.pi, "phase"),
        ),
        "sensor",
        signed=True,
        grid_counts=(2, 1),
    ),
    Law(
        "thermal_drift",
        37,
        EITHER_SENSOR,
        (P("total_m", 0.05e-6, 20e-6, "sign"), P("time_constant_s", 20.0, 300.0)),
        "sensor",
        False,
        True,
        grid_counts=(3,),
    ),
    Law("abbe_error", 38, EITHER_SENSOR, (P("error_at_100_mm_m", 0.2e-6, 30e-6, "sign"),), "sensor", False, True),
    Law("clock_skew", 39, EITHER_SENSOR, (P("relative", 2e-6, 100e-6),), "sensor"),
    # ---- outside every library ----
    Law(
        "friction_since_reversal",
        101,
        EITHER_FORCE,
        (P("level_n", 0.3, 6.0), P("time_constant_s", 0.2, 3.0)),
        "friction",
        outside=True,
    ),
    Law(
        "force_periodic_in_root_of_position",
        102,
        (MACRO,),
        (P("amplitude_n", 0.2, 6.0), P("root_pitch", 0.02, 0.08), P("start_m", -0.4, -0.3, "uniform")),
        "force",
        outside=True,
    ),
    Law(
        "one_way_spring",
        103,
        (MACRO,),
        (P("stiffness_n_per_m", 3.0, 80.0), P("direction", -1.0, 1.0, "choice")),
        "force",
        outside=True,
    ),
    Law(
        "spring_with_a_dead_zone",
        104,
        (MACRO,),
        (P("stiffness_n_per_m", 10.0, 300.0), P("place_m", -0.04, 0.04, "uniform"), P("half_width_m", 0.01, 0.04)),
        "force",
        outside=True,
    ),
    Law("force_by_the_sign_of_acceleration", 105, EITHER_FORCE, (P("level_n", 0.2, 4.0),), "force", outside=True),
    Law(
        "force_periodic_in_velocity",
        106,
        EITHER_FORCE,
        (P("amplitude_n", 0.3, 5.0), P("velocity_m_per_s", 0.02, 0.08)),
        "force",
        outside=True,
    ),
    Law(
        "ringing_after_reversal",
        107,
        EITHER_FORCE,
        (P("amplitude_n", 0.5, 8.0), P("time_constant_s", 0.1, 0.8), P("frequency_hz", 1.5, 9.0)),
        "force",
        outside=True,
    ),
    Law(
        "sine_in_time_scaled_by_speed",
        108,
        (MACRO,),
        (P("force_at_100_mm_per_s_n", 0.3, 6.0), P("frequency_hz", 0.7, 6.0)),
        "force",
        outside=True,
    ),
    Law(
        "spring_to_the_last_reversal",
        109,
        (MACRO,),
        (P("force_n", 0.3, 5.0), P("length_m", 0.01, 0.06)),
        "force",
        outside=True,
    ),
    Law(
        "bumps_in_the_guide",
        110,
        (MACRO,),
        (P("force_n", 0.5, 8.0), P("spacing_m", 0.03, 0.08), P("width_m", 0.002, 0.006)),
        "force",
        outside=True,
    ),
)
BY_NAME = {law.name: law for law in LAWS}
BY_CODE = {law.code: law for law in LAWS}
LIBRARY = tuple(law for law in LAWS if not law.outside)
OUTSIDE = tuple(law for law in LAWS if law.outside)

VISCOUS, ASYMMETRIC_VISCOUS, COULOMB, ASYMMETRIC_COULOMB, OFFSET, STRIBECK, SUBLINEAR = 1, 2, 3, 4, 5, 6, 7
DAHL, LUGRE, LOAD_DEPENDENT, QUADRATIC, COGGING, RIPPLE, SATURATION = 8, 9, 10, 11, 12, 13, 14
CABLE_SPRING, CABLE_HYSTERESIS, TILT, LINEAR_STIFFNESS, CUBIC, POSITION_FRICTION = 16, 17, 18, 19, 20, 21
CENTRE, WEAR, CONTACT_DAMPING, SOFT, CONTACT_HYSTERESIS, REACTION, FLEXIBLE, VIBRATION = 22, 23, 24, 25, 26, 27, 28, 29
LAG, DELAY, DEAD_BAND, SENSOR_DELAY, SENSOR_LAG, SCALE, CYCLIC, DRIFT, ABBE, SKEW = (
    30,
    31,
    32,
    33,
    34,
    35,
    36,
    37,
    38,
    39,
)
BETWEEN_CUBIC = 40
SINCE_REVERSAL, ROOT_PERIODIC, ONE_WAY, DEAD_ZONE, ACCELERATION_SIGN = 101, 102, 103, 104, 105
VELOCITY_PERIODIC, RINGING, SPEED_SINE, LAST_REVERSAL, BUMPS = 106, 107, 108, 109, 110


@compiled
def _turn(mem, v, x, dt):
    """mem: [direction, time since the last reversal, place of it]; a reversal needs 0.2 mm/s the other way."""
    if dt > 0.0:
        mem[1] += dt
        if abs(v) > 2e-4 and v * mem[0] <= 0.0:
            mem[0], mem[1], mem[2] = math.copysign(1.0, v), 0.0, x


@compiled
def smooth_force(code, p, mem, dt, t, x, v, other, mass):
    """Force in N on an axis at x, v; `other`: the other axis's drive force.

    `dt` > 0 advances the law's memory by that time, 0 leaves it.
    """
    if code == VISCOUS:
        return -p[0] * v
    if code == ASYMMETRIC_VISCOUS:
        return -p[0] * v * (1.0 + p[1]) if v > 0.0 else -p[0] * v * (1.0 - p[1])
    if code == OFFSET:
        return p[0]
    if code in (DAHL, CABLE_HYSTERESIS):
        s = 1.0 if v > 0.0 else -1.0
        old = mem[0]
        new = s + (old - s) * math.exp(-abs(v) * dt / p[1])
        if dt > 0.0:
            mem[0] = new
        return -p[0] * 0.5 * (old + new)
    if code == LUGRE:
        g = 1.0 + (p[1] - 1.0) * math.exp(-((v / p[2]) ** 2))  # over the Coulomb level
        rate = abs(v) / (p[3] * g)
        rest = g if v > 0.0 else -g
        old = mem[0]
        new = rest + (old - rest) * math.exp(-rate * dt)
        mean = old
        if dt > 0.0:
            mean = rest + (old - rest) * (-math.expm1(-rate * dt)) / (rate * dt) if rate * dt > 1e-9 else old
            mem[0] = new
        # z in units of distance: z' = v - |v| z / g
        return -p[0] * (mean + p[4] * (v / p[3] - rate * mean))
    if code == QUADRATIC:
        return -p[0] * v * abs(v)
    if code == COGGING:
        w = 2.0 * math.pi * x / p[1] + p[2]
        return p[0] * (math.sin(w) + p[3] * math.sin(2.0 * w))
    if code == CABLE_SPRING:
        return -p[0] * (x - p[1])
    if code == TILT:
        return mass * GRAVITY_M_PER_S2 * math.sin(p[0])
    if code == LINEAR_STIFFNESS:
        return -p[0] * x
    if code == CUBIC:
        q = x / REFERENCE_LENGTH_M
        return -p[0] * q * q * q
    if code == REACTION:
        return -p[0] * other
    if code == FLEXIBLE:
        w = 2.0 * math.pi * p[1]
        attached = p[0] * mass
        stretch, speed = mem[0] - x, mem[1] - v
        if dt > 0.0:
            # exact for a body that moves on at constant speed
            d, wd = p[2] * w, w * math.sqrt(1.0 - p[2] * p[2])
            e = math.exp(-d * dt)
            c, s = math.cos(wd * dt), math.sin(wd * dt)
            q = e * (stretch * c + (speed + d * stretch) / wd * s)
            qd = e * (speed * c - (d * speed + w * w * stretch) / wd * s)
            # mem belongs to the middle of a step, where x is: the force is that of before it moves on
            mem[0], mem[1] = x + v * dt + q, v + qd
        return attached * (w * w * stretch + 2.0 * p[2] * w * speed)
    if code == VIBRATION:
        return -mass * p[0] * math.sin(2.0 * math.pi * p[1] * t + p[2])
    if code == ROOT_PERIODIC:
        return p[0] * math.sin(2.0 * math.pi * math.sqrt(abs(x - p[2])) / p[1])
    if code == ONE_WAY:
        return -p[0] * x if v * p[1] > 0.0 else 0.0
    if code == DEAD_ZONE:
        depth = abs(x - p[1]) - p[2]
        return -p[0] * math.copysign(depth, x - p[1]) if depth > 0.0 else 0.0
    if code == ACCELERATION_SIGN:
        # speed through two lags of 20 ms gives a smooth acceleration
        if dt > 0.0:
            mem[0] += (v - mem[0]) * dt / 0.02
            mem[1] += ((v - mem[0]) / 0.02 - mem[1]) * dt / 0.02
        return -p[0] * math.tanh(mem[1] / 0.02)
    if code == VELOCITY_PERIODIC:
        return -p[0] * math.sin(2.0 * math.pi * v / p[1])
    if code == RINGING:
        _turn(mem, v, x, dt)
        if mem[0] == 0.0:
            return 0.0
        return -p[0] * mem[0] * math.exp(-mem[1] / p[1]) * math.sin(2.0 * math.pi * p[2] * mem[1])
    if code == SPEED_SINE:
        return p[0] * abs(v) / REFERENCE_SPEED_M_PER_S * math.sin(2.0 * math.pi * p[1] * t)
    if code == LAST_REVERSAL:
        _turn(mem, v, x, dt)
        if mem[0] == 0.0:
            return 0.0
        far = (x - mem[2]) / p[1]
        return -p[0] * far * math.exp(-abs(far))
    if code == BUMPS:
        near = x - p[1] * math.floor(x / p[1] + 0.5)
        return -p[0] * near / p[2] * math.exp(0.5 - 0.5 * (near / p[2]) ** 2)
    return 0.0


@compiled
def friction_level(code, p, mem, dt, x, v, drive, direction):
    """Level in N (>= 0) of a dry friction for motion in `direction` (+1, -1); at rest it holds up to this level."""
    if code == COULOMB:
        return p[0]
    if code == ASYMMETRIC_COULOMB:
        return p[0] * (1.0 + p[1] * direction)
    if code == STRIBECK:
        return p[0] * (1.0 + (p[1] - 1.0) * math.exp(-((v / p[2]) ** 2)))
    if code == SUBLINEAR:
        return p[0] * (abs(v) / REFERENCE_SPEED_M_PER_S) ** p[1]
    if code == LOAD_DEPENDENT:
        return p[0] * abs(drive)
    if code == POSITION_FRICTION:
        return p[0] * max(0.0, 1.0 + p[1] * x / REFERENCE_LENGTH_M)
    if code == SINCE_REVERSAL:
        _turn(mem, v, x, dt)
        return p[0] * (-math.expm1(-mem[1] / p[1]))
    return 0.0


@compiled
def is_friction(code):
    """Dry friction: set-valued at rest."""
    return 3 <= code <= 4 or 6 <= code <= 7 or code == 10 or code == 21 or code == 101


@compiled
def is_contact(code):
    """Acts between the stages."""
    return 22 <= code <= 26 or code == 40


@compiled
def contact_force(code, p, mem, dt, t, r, speed, contact):
    """Force in N of the stops on the macro (its opposite on the end stage).

    contact: [left stiffness, right stiffness, left edge, right edge, damping], edges as positive lengths. A spring and
    a damper in parallel while the stops touch; never pulls.
    """
    left, right = contact[2], contact[3]
    damping = contact[4]
    if code == CENTRE:
        left, right = left - p[0], right + p[0]
    elif code == WEAR:
        left, right = left + 0.5 * p[0] * t, right + 0.5 * p[0] * t
    elif code == CONTACT_DAMPING:
        damping += p[0]
    depth, side, stiffness = 0.0, 0.0, 0.0
    if r > right:
        depth, side, stiffness = r - right, 1.0, contact[1]
    elif r < -left:
        depth, side, stiffness = -left - r, -1.0, contact[0]
    inward = side * speed
    if code == CONTACT_HYSTERESIS and dt > 0.0:
        if depth > 0.0 and inward != 0.0:
            s = 1.0 if inward > 0.0 else -1.0
            mem[0] = s + (mem[0] - s) * math.exp(-abs(inward) * dt / p[1])
        elif depth == 0.0:
            mem[0] = 1.0
    between = 0.0
    if code == BETWEEN_CUBIC:
        between = p[0] * (r / REFERENCE_DEPTH_M) ** 3
    if depth == 0.0:
        return between
    spring = stiffness * depth
    if code == SOFT:
        spring = stiffness * depth * depth / (2.0 * p[0]) if depth < p[0] else stiffness * (depth - 0.5 * p[0])
    elif code == CONTACT_HYSTERESIS:
        spring *= 1.0 + p[0] * mem[0]
    return between + side * max(0.0, spring + damping * inward)


@compiled
def thrust(code, p, constant, current, x):
    """Drive force in N of a current in A."""
    force = constant * current
    if code == RIPPLE:
        force *= 1.0 + p[0] * math.sin(2.0 * math.pi * x / p[1] + p[2])
    elif code == SATURATION:
        peak = REFERENCE_FORCE_N / math.sqrt(3.0 * p[0])  # beyond it more current would bring less force: iron does not
        force = min(max(force, -peak), peak)
        force *= 1.0 - p[0] * (force / REFERENCE_FORCE_N) ** 2
    return force


@compiled
def dead_zone(width, asked):
    """A command in A through a dead zone: nothing below `width`, less by `width` above."""
    if asked > width:
        return asked - width
    if asked < -width:
        return asked + width
    return 0.0


@compiled
def reading_error(code, p, t, x):
    """What a sensor adds to a position x in m: the laws without memory."""
    if code == SCALE:
        return p[0] * x
    if code == CYCLIC:
        return p[0] * math.sin(2.0 * math.pi * x / p[1] + p[2])
    if code == DRIFT:
        return p[0] * (-math.expm1(-t / p[1]))
    if code == ABBE:
        return p[0] * (x / REFERENCE_LENGTH_M) ** 2
    return 0.0
