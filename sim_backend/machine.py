"""A machine: what the software rig is. One class a table, every number bounded; never read by the controller.

Independent of profiles: what is believed and what is true are two files and two sets of classes.
"""

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, ValidationInfo, model_validator

from stagectl import toml_file
from stagectl.effect_file import EffectFile
from stagectl.effect_table import EffectTable, without_micro
from stagectl.errors import ProfileError
from stagectl.toml_file import NO_BLANKS, Document, Problem, Table, above, missing, problem_if, refuse, whole, within

MACHINES_FOLDER = Path(__file__).resolve().parent / "machines"
EDS_FOLDER = Path(__file__).resolve().parent.parent / "profiles"

AxisName = Literal["macro", "micro"]
EdsName = Annotated[str, Field(pattern=rf"^{NO_BLANKS}\.eds$")]
Length = Annotated[float, within(-100.0, 100.0)]
Stiffness = Annotated[float, above(0.0, 1e10)]
Damping = Annotated[float, within(0.0, 1e7)]
NodeId = Annotated[int, whole(1, 127)]


class Winding(Table):
    """How warm its current makes a motor's winding; first order, above the air's temperature."""

    rise_at_rated_current_k: Annotated[float, within(0.0, 1e3)]
    time_constant_s: Annotated[float, within(0.1, 1e5)]


class Motor(Table):
    """A motor with its drive, as far as both axes are alike."""

    mass_kg: Annotated[float, above(0.0, 1e5)]
    force_constant_n_per_a: Annotated[float, above(0.0, 1e5)]
    back_emf_v_s_per_m: Annotated[float, within(0.0, 1e5)]
    resistance_ohm: Annotated[float, above(0.0, 1e4)]
    inductance_h: Annotated[float, above(0.0, 10.0)]
    supply_v: Annotated[float, above(0.0, 2e3)]
    current_limit_a: Annotated[float, above(0.0, 1e4)]
    rated_current_a: Annotated[float, above(0.0, 1e3)]
    rated_force_n: Annotated[float, above(0.0, 1e5)] | None = None  # the drive's name plate; None = the EDS's value
    current_loop_s: Annotated[float, within(1e-6, 0.02)]
    force_noise_n: Annotated[float, within(0.0, 1e3)] = 0.0  # rms, held for a millisecond
    has_rpdo_deadline: bool = True  # false = the drive lacks 0x1400:05, as many do
    winding: Winding | None = None  # None = the drive has no 0x2010, the winding's temperature
    stop_stiffness_n_per_m: Stiffness
    stop_damping_n_s_per_m: Damping

    def _motor_problems(self) -> list[Problem | None]:
        rated_a, limit_a = self.rated_current_a, self.current_limit_a
        drop_v = limit_a * self.resistance_ohm
        return [
            problem_if(
                not rated_a <= limit_a,
                "rated_current_a",
                rated_a,
                f"is above current_limit_a = {limit_a:g}",
                "lower it or raise the limit",
            ),
            problem_if(
                not drop_v <= self.supply_v,
                "current_limit_a",
                limit_a,
                f"the winding alone takes {drop_v:g} V of supply_v = {self.supply_v:g}",
                "lower it or raise the supply",
            ),
        ]


class MacroMotor(Motor):
    """The linear motor, its encoder and its hard stops."""

    node_id: NodeId = 1
    eds: EdsName = "stagectl-linear-motor.eds"
    base_spring_n_per_m: Annotated[float, within(0.0, 1e8)] = 0.0
    encoder_step_m: Annotated[float, within(1e-12, 1e-3)]
    encoder_offset_m: Length
    index_position_m: Length
    index_pitch_m: Annotated[float, above(0.0, 10.0)] | None = None  # of further index marks
    commissioned_load_kg: Annotated[float, within(0.0, 1e5)] = 0.0  # what its drive was told that moves with it
    travel_m: tuple[Length, Length]

    @model_validator(mode="after")
    def _check_motor(self) -> "MacroMotor":
        """Currents, order of the travel, an index mark that can be found."""
        low_m, high_m = self.travel_m
        reachable = low_m < self.index_position_m < high_m
        limit = f"must be inside travel_m = {list(self.travel_m)}, or homing never finds it"
        refuse(
            [
                *self._motor_problems(),
                _order_problem("travel_m", self.travel_m),
                problem_if(
                    low_m < high_m and not reachable, "index_position_m", self.index_position_m, limit, "move it"
                ),
            ]
        )
        return self


class MicroMotor(Motor):
    """The voice coil, its connection to the macro and its hard stops; the stroke is end minus macro."""

    node_id: NodeId = 2
    eds: EdsName = "stagectl-voice-coil.eds"
    spring_n_per_m: Annotated[float, within(0.0, 1e8)]
    damping_n_s_per_m: Damping
    encoder_step_m: Annotated[float, within(1e-12, 1e-3)] | None = None
    encoder_offset_m: Length | None = None
    index_position_m: Length | None = None
    stroke_m: tuple[Length, Length]

    @model_validator(mode="after")
    def _check_motor(self) -> "MicroMotor":
        """Currents and order of the stroke."""
        refuse([*self._motor_problems(), _order_problem("stroke_m", self.stroke_m)])
        return self


class Joint(Table):
    """The true backlash, on x_b = macro minus end."""

    left_m: Annotated[float, within(0.0, 1.0)]
    right_m: Annotated[float, within(0.0, 1.0)]
    left_stiffness_n_per_m: Stiffness
    right_stiffness_n_per_m: Stiffness


class Sensor(Table):
    """The interferometer as it is: what it writes, how well, and how late."""

    format: Literal["syncfixed", "umd2", "micro-epsilon"] = "syncfixed"
    rate_hz: Annotated[float, within(10.0, 100e3)] = 1000.0
    baud_bit_per_s: Annotated[float, within(9600.0, 12e6)] = 921_600.0
    counts_per_wavelength: Annotated[float, within(0.01, 1e9)] = 2048.0
    noise_m: Annotated[float, within(0.0, 1e-3)]
    clock_ppm: Annotated[float, within(-1000.0, 1000.0)]
    transport_s: Annotated[float, within(0.0, 0.1)]
    transport_jitter_s: Annotated[float, within(0.0, 0.1)]
    transport: Literal["line", "usb-125us", "ftdi-16ms"]
    interpolation_speed_m_per_s: Annotated[float, above(0.0, 10.0)] | None = None  # whole counts above it

    @model_validator(mode="after")
    def _check_interpolation(self) -> "Sensor":
        """Only the uMD2's fraction of a count depends on speed."""
        speed = self.interpolation_speed_m_per_s
        wrong = speed is not None and self.format != "umd2"
        limit = f"is known of the format umd2 only, not of {self.format}"
        refuse([problem_if(wrong, "interpolation_speed_m_per_s", speed, limit, "remove it or correct format")])
        return self


class TrueAir(Table):
    """Laser and air on the day of the rig."""

    wavelength_vacuum_m: Annotated[float, within(300e-9, 1690e-9)]
    temperature_degc: Annotated[float, within(-40.0, 100.0)] = 20.0
    pressure_pa: Annotated[float, within(10e3, 140e3)] = 101_325.0
    relative_humidity_percent: Annotated[float, within(0.0, 100.0)] = 50.0
    co2_ppm: Annotated[float, within(0.0, 2000.0)] = 450.0


class Start(Table):
    """Where the machine stands when the rig starts."""

    macro_position_m: Length
    relative_position_m: Length = 0.0


class Machine(Document):
    """A whole machine file."""

    name: Annotated[str, Field(pattern=r"^[a-z0-9][a-z0-9_-]{0,63}$")]
    macro: MacroMotor
    micro: MicroMotor | None = None
    backlash: Joint | None = None
    interferometer: Sensor
    air: TrueAir
    start: Start
    effect_files: tuple[EffectFile, ...] = ()  # before the effects that they declare
    effects: tuple[EffectTable, ...] = ()

    @property
    def axes(self) -> tuple[AxisName, ...]:
        """Return the axes that this stage has."""
        return ("macro",) if self.micro is None else ("macro", "micro")

    def eds_path(self, axis: AxisName) -> Path:
        """Return the EDS file of one axis' drive: beside the machine, else beside the profiles."""
        table = {"macro": self.macro, "micro": self.micro}.get(axis)
        if table is None:
            raise ProfileError(f"machine {self.name}: there is no axis {axis!r}; it has {', '.join(self.axes)}")
        path = _eds_path(table.eds, self.source_path)
        if path is None:
            raise ProfileError(f"machine {self.name}: {axis}.eds = {table.eds!r} is gone; put it beside the machine")
        return path

    @model_validator(mode="after")
    def _check_relations(self, info: ValidationInfo) -> "Machine":
        """Check what spans several tables."""
        context = info.context if isinstance(info.context, dict) else {}
        refuse([*self._axes_problems(context.get("path")), *self._joint_problems(), *self._start_problems()])
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
        for axis, table in (("macro", self.macro), ("micro", self.micro)):
            if table is not None:
                wrong = _eds_path(table.eds, path) is None
                limit = f"there is no such file in {', '.join(str(folder) for folder in _eds_folders(path))}"
                problems.append(problem_if(wrong, f"{axis}.eds", table.eds, limit, "correct the name"))
        return problems

    def _joint_problems(self) -> list[Problem | None]:
        """Both edges of the gap must lie inside the hard stops; end minus macro is -x_b."""
        if self.micro is None or self.backlash is None:
            return []
        low_m, high_m = self.micro.stroke_m
        left_m, right_m = self.backlash.left_m, self.backlash.right_m
        limit = f"must reach from below {-right_m:g} to above {left_m:g} m, or the joint never touches"
        wrong = not (low_m < -right_m and left_m < high_m)
        return [problem_if(wrong, "micro.stroke_m", [low_m, high_m], limit, "widen it, or correct backlash")]

    def _start_problems(self) -> list[Problem | None]:
        start_m, (low_m, high_m) = self.start.macro_position_m, self.macro.travel_m
        limit = f"must be inside macro.travel_m = [{low_m:g}, {high_m:g}]"
        problems = [problem_if(not low_m < start_m < high_m, "start.macro_position_m", start_m, limit, "move it")]
        if self.micro is not None:
            start_m, (low_m, high_m) = self.start.relative_position_m, self.micro.stroke_m
            limit = f"must be inside micro.stroke_m = [{low_m:g}, {high_m:g}]"
            wrong = not low_m < start_m < high_m
            problems.append(problem_if(wrong, "start.relative_position_m", start_m, limit, "move it"))
        return problems


def load_machine(name_or_path: str | Path) -> Machine:
    """Load a machine by path, or by name from `sim_backend/machines`; ProfileError lists everything that is wrong."""
    return toml_file.read(Machine, toml_file.find(name_or_path, [MACHINES_FOLDER], "machine"))


def machine_path_for(profile_name: str) -> Path:
    """Return the machine file that plays a profile; ProfileError where there is none."""
    if profile_name not in list_machines():
        raise ProfileError(
            f"profile {profile_name}: the rig has no machine of that name to play it; it has "
            f"{', '.join(list_machines())}. Give the profile the name of the one that it describes, or use the hardware"
        )
    return MACHINES_FOLDER / f"{profile_name}.toml"


def list_machines() -> list[str]:
    """Return the names of all machines that the rig can be."""
    return toml_file.names_in([MACHINES_FOLDER])


def _order_problem(key: str, ends: tuple[float, float]) -> Problem | None:
    wrong = not ends[0] < ends[1]
    return problem_if(wrong, key, list(ends), "lower end must be below the upper", "swap them")


def _eds_folders(machine_path: Path | None) -> list[Path]:
    beside = [machine_path.parent] if machine_path is not None else []
    return list(dict.fromkeys([*beside, EDS_FOLDER]))


def _eds_path(name: str, machine_path: Path | None) -> Path | None:
    paths = [folder / name for folder in _eds_folders(machine_path)]
    return next((path for path in paths if path.is_file()), None)
