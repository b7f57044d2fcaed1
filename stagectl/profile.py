"""A profile: what is believed of a machine. One class a table, every number bounded, relations checked.

To add a key, add a line with its bounds (`within`, `above`, `whole`) to the table's class; a default makes it optional.
"""

import os
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, ValidationInfo, model_validator

from stagectl import toml_file
from stagectl.effect_file import EffectFile
from stagectl.effect_table import EffectTable, without_micro
from stagectl.errors import ProfileError
from stagectl.interferometer_profile import Interferometer, carries_end
from stagectl.toml_file import (
    NO_BLANKS,
    Document,
    Flag,
    Problem,
    Table,
    above,
    missing,
    problem_if,
    refuse,
    whole,
    within,
)

PROFILES_FOLDER = Path(__file__).resolve().parent.parent / "profiles"
SYSTEM_FOLDER = Path("/etc/stagectl")

TORQUE_WORD_LIMIT = 32767  # 0x6071 is an int16 in 0.1 % of the rated torque
SERVO_NODE_ID = 0x7E  # heartbeat of the servo, which the drives watch
TOUCH_FORCE_LIMIT_N = 5.0  # homing presses no harder
_BUS_SHARE = 0.8  # of the bus, worst case: SDO, EMCY and heartbeats need room too

Name = Annotated[str, Field(pattern=r"^[a-z0-9][a-z0-9_-]{0,63}$")]
EdsName = Annotated[str, Field(pattern=rf"^{NO_BLANKS}\.eds$")]
Length = Annotated[float, within(-100.0, 100.0)]
Mass = Annotated[float, above(0.0, 1e5)]
Force = Annotated[float, above(0.0, 1e6)]
Stiffness = Annotated[float, above(0.0, 1e9)]
Bandwidth = Annotated[float, above(0.0, 1e4)]
NodeId = Annotated[int, whole(1, SERVO_NODE_ID - 1)]
Unsigned32 = Annotated[int, whole(0, 2**32 - 1)]
AxisName = Literal["macro", "micro"]


class Cycle(Table):
    """When a cycle starts and when its force acts."""

    rate_hz: Annotated[float, within(10.0, 10e3)]
    phase_s: Annotated[float, within(0.0, 0.1)]
    actuation_delay_s: Annotated[float, above(0.0, 0.1)]
    predicted_samples_count: Annotated[int, whole(0, 10)] = 3

    @property
    def period_s(self) -> float:
        """Return the nominal length of a cycle."""
        return 1.0 / self.rate_hz

    @model_validator(mode="after")
    def _check_order(self) -> "Cycle":
        """Sample, start of the cycle, force: in that order and within one period each."""
        period_s, phase_s, delay_s = self.period_s, self.phase_s, self.actuation_delay_s
        period = f"one period ({period_s:g} s)"
        refuse(
            [
                problem_if(not phase_s < period_s, "phase_s", phase_s, f"must be below {period}", "lower it"),
                problem_if(
                    not phase_s < delay_s,
                    "actuation_delay_s",
                    delay_s,
                    f"the force acts after the cycle starts, at phase_s = {phase_s:g}",
                    "raise it or lower phase_s",
                ),
                problem_if(
                    not delay_s - phase_s <= period_s,
                    "actuation_delay_s",
                    delay_s,
                    f"the command must leave within {period} of the cycle's start at phase_s = {phase_s:g}",
                    "lower it or lower rate_hz",
                ),
            ]
        )
        return self


class Trip(Table):
    """How long something may be wrong before the stage stops."""

    sensor_age_s: Annotated[float, above(0.0, 1.0)]
    overrun_s: Annotated[float, above(0.0, 1.0)]
    heartbeat_s: Annotated[float, within(0.002, 5.0)]
    rpdo_deadline_s: Annotated[float, within(0.001, 1.0)]
    supervisor_silence_s: Annotated[float, within(0.05, 10.0)]
    lease_s: Annotated[float, within(0.05, 60.0)]
    force_error_ratio: Annotated[float, within(0.005, 1.0)] = 0.05  # of a drive's greatest force; 1 where it tells none


class Can(Table):
    """The bus; `channel` is an interface's name, or a socket's path for the hub."""

    interface: Literal["socketcan", "hub", "stagectl-hub", "virtual"]
    channel: Annotated[str, Field(pattern=rf"^{NO_BLANKS}$")]
    bitrate_bit_per_s: Annotated[float, within(10e3, 1e6)] = 1e6


class Identity(Table):
    """What 0x1018 of the drive must say; what is left out may be anything."""

    vendor_id: Unsigned32
    product_code: Unsigned32
    revision_number: Unsigned32 | None = None
    serial_number: Unsigned32 | None = None


class Homing(Table):
    """The drive's own homing on its encoder."""

    method: Annotated[int, whole(1, 37)]
    speed_m_per_s: Annotated[float, above(0.0, 1.0)]
    acceleration_m_per_s2: Annotated[float, above(0.0, 100.0)]
    timeout_s: Annotated[float, within(1.0, 3600.0)]


class Temperature(Table):
    """The drive's object that holds a temperature, of winding or power stage: each vendor has its own.

    Above `warning_degc` it is said, and nothing else happens: a drive protects itself.
    """

    index: Annotated[int, whole(0x2000, 0x9FFF)]
    subindex: Annotated[int, whole(0, 254)] = 0
    degc_per_count: Annotated[float, above(0.0, 10.0)]
    warning_degc: Annotated[float, within(-40.0, 300.0)] | None = None


class Axis(Table):
    """A drive and its motor, as far as both axes are alike."""

    node_id: NodeId
    eds: EdsName
    identity: Identity
    mass_kg: Mass
    mass_sd_kg: Annotated[float, within(0.0, 1e4)]
    rated_force_n: Force
    rated_current_a: Annotated[float, above(0.0, 1e3)]
    force_limit_n: Force
    thermal_force_n: Force
    thermal_time_constant_s: Annotated[float, within(0.1, 1e5)]
    current_loop_s: Annotated[float, within(1e-6, 0.02)]
    force_noise_n: Annotated[float, within(0.0, 10.0)] = 0.0  # rms of a cycle; the observer's gains, and Ms, follow it
    stop: Literal["ramp", "short", "coast"]
    temperature: Temperature | None = None

    @property
    def torque_step_n(self) -> float:
        """Return the force of one count of the torque word."""
        return 1e-3 * self.rated_force_n

    def _axis_problems(self) -> list[Problem | None]:
        limit_n, rated_n, thermal_n = self.force_limit_n, self.rated_force_n, self.thermal_force_n
        top_n = rated_n * TORQUE_WORD_LIMIT / 1000
        word = f"the torque word (int16, 0.1 % of rated_force_n = {rated_n:g}) ends at {top_n:g} N"
        return [
            problem_if(not limit_n <= top_n, "force_limit_n", limit_n, word, "lower it or correct rated_force_n"),
            problem_if(
                not thermal_n <= limit_n,
                "thermal_force_n",
                thermal_n,
                f"is above force_limit_n = {limit_n:g} and would never trip",
                "lower it",
            ),
            problem_if(
                not self.mass_sd_kg < self.mass_kg,
                "mass_sd_kg",
                self.mass_sd_kg,
                f"must be below mass_kg = {self.mass_kg:g}",
                "give one standard deviation of the mass",
            ),
        ]


class MacroAxis(Axis):
    """The linear motor."""

    mode: Literal["position", "torque"] = "position"
    encoder_step_m: Annotated[float, within(1e-12, 1e-3)]
    travel_m: tuple[Length, Length]
    velocity_limit_m_per_s: Annotated[float, above(0.0, 20.0)]
    acceleration_limit_m_per_s2: Annotated[float, above(0.0, 200.0)]
    stop_deceleration_m_per_s2: Annotated[float, above(0.0, 200.0)]  # what `stop` brings about, at least
    standstill: Literal["hold", "off"] = "hold"
    homing: Homing

    @model_validator(mode="after")
    def _check_axis(self) -> "MacroAxis":
        """Torque word, order of the travel, room to stop in it."""
        low_m, high_m = self.travel_m
        speed, deceleration = self.velocity_limit_m_per_s, self.stop_deceleration_m_per_s2
        stopping_m = 0.5 * speed * speed / deceleration
        homing = self.homing.speed_m_per_s
        remedy = f"lower it or raise stop_deceleration_m_per_s2 = {deceleration:g}"
        refuse(
            [
                *self._axis_problems(),
                _order_problem("travel_m", self.travel_m),
                problem_if(
                    low_m < high_m and not low_m < 0.0 < high_m,
                    "travel_m",
                    list(self.travel_m),
                    "must hold 0, the index of the encoder, where homing ends",
                    "measure it from there",
                ),
                problem_if(
                    low_m < high_m and not stopping_m < high_m - low_m,
                    "velocity_limit_m_per_s",
                    speed,
                    f"stopping from it takes {stopping_m:g} m, the whole travel is {high_m - low_m:g} m",
                    remedy,
                ),
                problem_if(
                    not homing <= speed,
                    "homing.speed_m_per_s",
                    homing,
                    f"is above velocity_limit_m_per_s = {speed:g}",
                    "lower it",
                ),
            ]
        )
        return self


class MicroAxis(Axis):
    """The voice coil and its connection to the macro; the stroke is end minus macro."""

    stroke_m: tuple[Length, Length]
    encoder_step_m: Annotated[float, within(1e-12, 1e-3)] | None = None
    spring_n_per_m: Annotated[float, within(0.0, 1e8)]
    damping_n_s_per_m: Annotated[float, within(0.0, 1e6)]

    @model_validator(mode="after")
    def _check_axis(self) -> "MicroAxis":
        """Torque word, order of the stroke, an encoder where the drive shall ramp."""
        low_m, high_m = self.stroke_m
        no_ramp = self.stop == "ramp" and self.encoder_step_m is None
        remedy = "set stop to short or coast, or add encoder_step_m"
        refuse(
            [
                *self._axis_problems(),
                _order_problem("stroke_m", self.stroke_m),
                problem_if(
                    low_m < high_m and not low_m < 0.0 < high_m,
                    "stroke_m",
                    list(self.stroke_m),
                    "must hold 0, where the spring rests",
                    "measure it from there",
                ),
                problem_if(no_ramp, "stop", "ramp", "a drive without an encoder can't ramp down", remedy),
            ]
        )
        return self


class Backlash(Table):
    """The joint, on x_b = macro minus end."""

    left_m: Annotated[float, within(0.0, 1.0)]
    right_m: Annotated[float, within(0.0, 1.0)]
    left_stiffness_n_per_m: Stiffness
    right_stiffness_n_per_m: Stiffness
    width_sd_m: Annotated[float, within(0.0, 1.0)]
    touch_force_n: Annotated[float, above(0.0, TOUCH_FORCE_LIMIT_N)]
    force_sd_ratio: Annotated[float, within(0.0, 1.0)] = 0.1  # of what the contact makes, its damping mostly
    filter_s: Annotated[float, within(1e-3, 1.0)] | None = None  # of the identification; None: the noise's own

    @model_validator(mode="after")
    def _check_width(self) -> "Backlash":
        """A joint without a gap has nothing to identify."""
        width_m = self.left_m + self.right_m
        limit = "left_m + right_m must be above 0"
        refuse([problem_if(not width_m > 0.0, "right_m", self.right_m, limit, "give the width of the gap")])
        return self


class Wear(Table):
    """How the joint's wear is followed while the stage works, and what of it may be believed by itself."""

    width_change_limit_m: Annotated[float, above(0.0, 1.0)] = 50e-6
    stiffness_change_limit_ratio: Annotated[float, within(0.01, 10.0)] = 0.3
    trusted_sd_m: Annotated[float, above(0.0, 1.0)] = 0.5e-6
    edge_drift_m_per_sqrt_s: Annotated[float, within(0.0, 1e-3)] = 0.0  # that the estimator allows for
    probe_every_s: Annotated[float, within(10.0, 1e8)] | None = None  # without it nothing is touched unasked
    compensate: Flag = False


class Air(Table):
    """Laser and air: what the index of air is computed from."""

    wavelength_vacuum_m: Annotated[float, within(300e-9, 1690e-9)]
    temperature_degc: Annotated[float, within(-40.0, 100.0)] = 20.0
    pressure_pa: Annotated[float, within(10e3, 140e3)] = 101_325.0
    relative_humidity_percent: Annotated[float, within(0.0, 100.0)] = 50.0
    co2_ppm: Annotated[float, within(0.0, 2000.0)] = 450.0


class Record(Table):
    """What the service keeps of a session, and what it does where the disk takes no more."""

    when: Literal["armed", "always"] = "armed"
    flight_s: Annotated[float, within(1.0, 600.0)] = 30.0
    run_length_s: Annotated[float, within(10.0, 86400.0)] = 3600.0
    on_full_disk: Literal["stop", "go_on"] = "stop"
    size_limit_bytes: Annotated[int, whole(10**6, 10**15)] = 100_000_000_000
    age_limit_s: Annotated[float, within(60.0, 1e10)] = 30 * 86400.0


class Control(Table):
    """Which law, how fast, and how large an error may be; ratios count in 2 pi times the bandwidth."""

    law: Literal["dsmc", "pid"]
    macro_bandwidth_hz: Bandwidth
    micro_bandwidth_hz: Bandwidth = 30.0
    error_limit_m: Annotated[float, above(0.0, 1.0)]
    park_error_m: Annotated[float, above(0.0, 1.0)] = 100e-6
    pid_bandwidth_hz: Bandwidth = 50.0
    macro_damping_ratio: Annotated[float, within(0.1, 5.0)] = 0.8
    macro_feed_forward_ratio: Annotated[float, within(0.0, 1.0)] = 1.0
    eta_ratio: Annotated[float, within(0.0, 100.0)] = 1.0
    gamma_ratio: Annotated[float, within(0.0, 100.0)] = 0.1
    sliding_ratio: Annotated[float, within(0.0, 100.0)] = 1.0
    phi_m: Annotated[float, above(0.0, 1.0)] = 20e-6
    adaptation_per_s: Annotated[float, within(0.0, 1e4)] = 1.0
    adaptation_scale_m_per_s: Annotated[float, above(0.0, 10.0)] = 100e-6
    leak_per_s: Annotated[float, above(0.0, 1e4)] = 2.0
    adaptive_gain_ceiling_ratio: Annotated[float, within(0.0, 10.0)] = 0.5
    macro_drift_n_per_sqrt_s: Annotated[float, above(0.0, 1e5)] = 5.0
    micro_drift_n_per_sqrt_s: Annotated[float, above(0.0, 1e5)] = 0.2
    rest_drift_ratio: Annotated[float, within(1e-3, 1.0)] = 1.0  # of the drift, where the end's innovations are noise
    travel_drift_n_per_sqrt_m: Annotated[float, within(0.0, 1e5)] = 0.0  # of the end's unknown force, by its way
    notch_frequency_hz: Annotated[float, within(0.0, 1e4)] = 0.0  # of the observer; 0 = none
    notch_damping_ratio: Annotated[float, within(0.01, 2.0)] = 0.3  # how wide
    notch_depth_ratio: Annotated[float, within(0.0, 1.0)] = 0.1  # what is left in the middle

    @model_validator(mode="after")
    def _check_law(self) -> "Control":
        """The sliding surface must be damped: eta >= 2 sqrt(gamma)."""
        least = 2.0 * self.gamma_ratio**0.5
        refuse(
            [
                problem_if(
                    not self.eta_ratio >= least * (1.0 - 1e-9),
                    "eta_ratio",
                    self.eta_ratio,
                    f"must be at least 2 sqrt(gamma_ratio) = {least:g}, or the sliding surface rings",
                    "raise it or lower gamma_ratio",
                ),
            ]
        )
        return self


class Profile(Document):
    """A whole profile file."""

    name: Name
    cycle: Cycle
    trip: Trip
    can: Can
    macro: MacroAxis
    micro: MicroAxis | None = None
    backlash: Backlash | None = None
    interferometer: Interferometer
    air: Air
    control: Control
    record: Record = Record()
    wear: Wear = Wear()
    effect_files: tuple[EffectFile, ...] = ()  # before the effects that they declare
    effects: tuple[EffectTable, ...] = ()

    def axis(self, axis: AxisName) -> Axis:
        """Return the table of one axis; ProfileError where the stage has no such axis."""
        table = {"macro": self.macro, "micro": self.micro}.get(axis)
        if table is None:
            raise ProfileError(f"profile {self.name}: there is no axis {axis!r}; it has {', '.join(self.axes)}")
        return table

    @property
    def axes(self) -> tuple[AxisName, ...]:
        """Return the axes that this stage has."""
        return ("macro",) if self.micro is None else ("macro", "micro")

    def motion_force_n(self, axis: AxisName) -> float:
        """Return what the profile's motion asks of one drive at most: what it moves, accelerated or braked.

        The macro carries the micro; the micro moves itself, at rest against the macro.
        """
        macro = self.macro
        moved_kg = self.axis(axis).mass_kg
        if axis == "macro" and self.micro is not None:
            moved_kg += self.micro.mass_kg
        braked_m_per_s2 = macro.stop_deceleration_m_per_s2 if macro.stop == "ramp" else 0.0
        return moved_kg * max(macro.acceleration_limit_m_per_s2, braked_m_per_s2)

    @property
    def limp_deceleration_m_per_s2(self) -> float | None:
        """Return the hardest braking of the macro at which a limp micro keeps off its stops; None without a micro.

        Work of the braking from the middle of the gap to the stop = energy of contact and spring there. Damping, and
        a shorted winding, only make it milder; the worse of both directions counts.
        """
        micro, joint = self.micro, self.backlash
        if micro is None or joint is None:
            return None
        middle_m = 0.5 * (joint.left_m - joint.right_m)  # end minus macro; the spring rests at 0
        sides = (
            (micro.stroke_m[1], middle_m, joint.left_m, joint.left_stiffness_n_per_m),
            (-micro.stroke_m[0], -middle_m, joint.right_m, joint.right_stiffness_n_per_m),
        )
        return min(
            (
                stiffness_n_per_m * max(stop_m - edge_m, 0.0) ** 2
                + micro.spring_n_per_m * (stop_m * stop_m - begin_m * begin_m)
            )
            / (2.0 * micro.mass_kg * (stop_m - begin_m))
            for stop_m, begin_m, edge_m, stiffness_n_per_m in sides
        )

    def with_force_limits(self, limits_n: dict[AxisName, float]) -> "Profile":
        """Return the profile with force limits of some axes lowered to what their drives allow."""
        update: dict[str, Axis] = {}
        for name, limit_n in limits_n.items():
            axis = self.axis(name)
            if limit_n < axis.force_limit_n:
                lowered = {"force_limit_n": limit_n, "thermal_force_n": min(axis.thermal_force_n, limit_n)}
                update[name] = axis.model_copy(update=lowered)
        return self.model_copy(update=update) if update else self

    def eds_path(self, axis: AxisName) -> Path:
        """Return the EDS file of one axis: beside the profile, else where profiles are looked for."""
        name = self.axis(axis).eds
        path = _eds_path(name, self.source_path)
        if path is None:
            raise ProfileError(f"profile {self.name}: {axis}.eds = {name!r} is gone; put it beside the profile")
        return path

    @property
    def worst_bus_load_ratio(self) -> float:
        """Return the share of the bus that cyclic frames take when every stuff bit is needed."""
        bits = self.command_frames_bits + len(self.axes) * frame_bits(8)
        return bits * self.cycle.rate_hz / self.can.bitrate_bit_per_s

    @property
    def command_frames_bits(self) -> int:
        """Return the longest that SYNC and the RPDOs of one cycle can be."""
        by_position = self.macro.mode == "position"
        return frame_bits(0) + sum(frame_bits(8 if axis == "macro" and by_position else 4) for axis in self.axes)

    @model_validator(mode="after")
    def _check_relations(self, info: ValidationInfo) -> "Profile":
        """Check what spans several tables."""
        context = info.context if isinstance(info.context, dict) else {}
        refuse(
            [
                *self._axes_problems(context.get("path")),
                *self._joint_problems(),
                *self._force_problems(),
                *self._timing_problems(),
                *self._sensor_problems(),
                *self._control_problems(),
            ]
        )
        return self

    def _axes_problems(self, path: Path | None) -> list[Problem | None]:
        problems: list[Problem | None] = []
        if self.micro is not None:
            same = self.micro.node_id == self.macro.node_id
            limit = "is macro.node_id as well, and a CANopen node id belongs to one drive"
            problems.append(problem_if(same, "micro.node_id", self.micro.node_id, limit, "give each drive its own"))
            if self.backlash is None:
                problems.append(missing("backlash", "[micro] and [backlash] belong together"))
        else:
            if self.backlash is not None:
                problems.append(missing("micro", "[micro] and [backlash] belong together"))
            problems += without_micro(self.effects)
        for axis in self.axes:
            name = self.axis(axis).eds
            looked = ", ".join(str(folder) for folder in _eds_folders(path))
            limit = f"there is no such file in {looked}"
            remedy = "put the drive's EDS beside the profile, or correct the name"
            problems.append(problem_if(_eds_path(name, path) is None, f"{axis}.eds", name, limit, remedy))
        return problems

    def _joint_problems(self) -> list[Problem | None]:
        """The micro must reach both edges of the gap, pressed by the homing, inside its stroke."""
        if self.micro is None or self.backlash is None:
            return []
        low_m, high_m = self.micro.stroke_m
        joint = self.backlash
        # end minus macro is -x_b: the right edge of the joint is at the lower end of the stroke
        low_need_m = -(joint.right_m + joint.touch_force_n / joint.right_stiffness_n_per_m)
        high_need_m = joint.left_m + joint.touch_force_n / joint.left_stiffness_n_per_m
        limit = f"must reach from below {low_need_m:g} to above {high_need_m:g} m to touch both edges of [backlash]"
        wrong = not (low_m < low_need_m and high_need_m < high_m)
        return [problem_if(wrong, "micro.stroke_m", [low_m, high_m], limit, "widen it, or correct backlash")]

    def _force_problems(self) -> list[Problem | None]:
        carried_kg = self.macro.mass_kg + (self.micro.mass_kg if self.micro is not None else 0.0)
        problems: list[Problem | None] = []
        for key in ("acceleration_limit_m_per_s2", "stop_deceleration_m_per_s2"):
            value = getattr(self.macro, key)
            limit = f"moving {carried_kg:g} kg so takes {carried_kg * value:g} N, above force_limit_n"
            limit += f" = {self.macro.force_limit_n:g}"
            wrong = not carried_kg * value <= self.macro.force_limit_n
            wrong = wrong and (key == "acceleration_limit_m_per_s2" or self.macro.stop == "ramp")
            problems.append(problem_if(wrong, f"macro.{key}", value, limit, "lower it or correct the force limit"))
        return problems

    def _timing_problems(self) -> list[Problem | None]:
        cycle, trip, period_s = self.cycle, self.trip, self.cycle.period_s
        bridged_s = (cycle.predicted_samples_count + 1) * period_s
        load = self.worst_bus_load_ratio
        age = f"must be above {bridged_s:g} s: cycle.predicted_samples_count = {cycle.predicted_samples_count}"
        deadline = f"must be at least two cycles ({2 * period_s:g} s), or every late frame trips the drives"
        bus = f"its frames may take {load:.0%} of {self.can.bitrate_bit_per_s:g} bit/s, {_BUS_SHARE:.0%} are allowed"
        return [
            problem_if(not trip.sensor_age_s > bridged_s, "trip.sensor_age_s", trip.sensor_age_s, age, "raise it"),
            problem_if(
                not trip.overrun_s >= period_s,
                "trip.overrun_s",
                trip.overrun_s,
                f"must be at least one cycle ({period_s:g} s)",
                "raise it",
            ),
            problem_if(
                not trip.rpdo_deadline_s >= 2 * period_s,
                "trip.rpdo_deadline_s",
                trip.rpdo_deadline_s,
                deadline,
                "raise it",
            ),
            problem_if(
                not load <= _BUS_SHARE, "cycle.rate_hz", cycle.rate_hz, bus, "lower it or raise can.bitrate_bit_per_s"
            ),
        ]

    def _sensor_problems(self) -> list[Problem | None]:
        sensor, cycle, macro = self.interferometer, self.cycle, self.macro
        ratio = sensor.rate_hz / cycle.rate_hz
        whole_ratio = ratio >= 1.0 - 1e-9 and abs(ratio - round(ratio)) < 1e-9
        fastest_m = macro.velocity_limit_m_per_s / sensor.rate_hz
        problems = [
            problem_if(
                not whole_ratio,
                "interferometer.rate_hz",
                sensor.rate_hz,
                f"must be cycle.rate_hz = {cycle.rate_hz:g} or a whole multiple of it: the sensor is the clock",
                "correct one of them",
            ),
            problem_if(
                not sensor.transport_s <= cycle.phase_s,
                "cycle.phase_s",
                cycle.phase_s,
                f"no line is in before interferometer.transport_s = {sensor.transport_s:g}",
                "raise it",
            ),
            problem_if(
                not sensor.jump_limit_m > fastest_m,
                "interferometer.jump_limit_m",
                sensor.jump_limit_m,
                f"macro.velocity_limit_m_per_s alone moves {fastest_m:g} m in a sample",
                "raise it",
            ),
            problem_if(
                not sensor.encoder_disagreement_m > macro.encoder_step_m,
                "interferometer.encoder_disagreement_m",
                sensor.encoder_disagreement_m,
                f"must be above one step of the encoder ({macro.encoder_step_m:g} m)",
                "raise it",
            ),
        ]
        if self.micro is not None and not carries_end(sensor.frame):
            limit = "there is a [micro], and the stream carries no position of the end"
            problems.append(Problem("interferometer.format", sensor.format, limit, "add the end to the stream"))
        if self.micro is None and carries_end(sensor.frame):
            limit = "the stream carries an end, and there is no [micro]"
            problems.append(Problem("interferometer.format", sensor.format, limit, "name one position, the macro's"))
        return problems

    def _control_problems(self) -> list[Problem | None]:
        fastest_hz = self.cycle.rate_hz / 5.0
        park_m, trip_m = self.control.park_error_m, self.control.error_limit_m
        limit = f"is above control.error_limit_m = {trip_m:g}: the run would stop before the micro parks"
        late = self.micro is not None and not park_m <= trip_m
        problems = [problem_if(late, "control.park_error_m", park_m, limit, "lower it")]
        for key in ("macro_bandwidth_hz", "micro_bandwidth_hz", "pid_bandwidth_hz"):
            value = getattr(self.control, key)
            limit = f"must be at most a fifth of cycle.rate_hz, {fastest_hz:g} Hz"
            problems.append(problem_if(not value <= fastest_hz, f"control.{key}", value, limit, "lower it"))
        notch_hz, limit = (
            self.control.notch_frequency_hz,
            f"must be below half of cycle.rate_hz, {fastest_hz * 2.5:g} Hz",
        )
        problems.append(
            problem_if(not notch_hz < 2.5 * fastest_hz, "control.notch_frequency_hz", notch_hz, limit, "lower it")
        )
        return problems


def load_profile(name_or_path: str | Path) -> Profile:
    """Load a profile by path, or by name from `search_folders()`; ProfileError lists everything that is wrong."""
    return toml_file.read(Profile, toml_file.find(name_or_path, search_folders(), "profile"))


def profile_from_effective(values: dict[str, Any], place: str) -> Profile:
    """Make a profile again from `Profile.effective()`, as a run's manifest holds it; `place` names it in errors."""
    return toml_file.check(Profile, values, place)


def list_profiles() -> list[str]:
    """Return the names of all profiles that a bare name can mean."""
    return toml_file.names_in(search_folders())


def search_folders() -> list[Path]:
    """Return the folders where a bare name is looked for, first one first."""
    own = os.environ.get("STAGECTL_PROFILES")
    return [PROFILES_FOLDER, *([Path(own)] if own else []), SYSTEM_FOLDER]


def _order_problem(key: str, ends: tuple[float, float]) -> Problem | None:
    wrong = not ends[0] < ends[1]
    return problem_if(wrong, key, list(ends), "lower end must be below the upper", "swap them")


def _eds_folders(profile_path: Path | None) -> list[Path]:
    beside = [profile_path.parent] if profile_path is not None else []
    return list(dict.fromkeys(beside + search_folders()))


def _eds_path(name: str, profile_path: Path | None) -> Path | None:
    paths = [folder / name for folder in _eds_folders(profile_path)]
    return next((path for path in paths if path.is_file()), None)


def frame_bits(data_bytes: int) -> int:
    """Return the longest a classic CAN frame can be: all stuff bits and the space after it (ISO 11898-1)."""
    stuffed = 34 + 8 * data_bytes
    return stuffed + (stuffed - 1) // 4 + 13
