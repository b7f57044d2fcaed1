"""What the workflow believes of a machine before it looks: masses, joint, effects, each with its uncertainty.

Made from a profile of ours, or from a file of the same manner for a machine that stagectl does not drive. Pure but for
`load_believed`.
"""

import math
import tomllib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from stagectl import toml_file
from stagectl.effect_file import EffectFile
from stagectl.effect_table import EffectTable, without_micro
from stagectl.errors import ProfileError
from stagectl.profile import Profile, search_folders
from stagectl.toml_file import Document, Table, above, refuse, within

FORCE_CONSTANT_SD_RATIO = 0.01
STIFFNESS_SD_RATIO = 0.02
DAMPING_SD_RATIO = 0.20
EFFECT_SD_RATIO = 0.20
LATCH_SD_S = 20e-6
CURRENT_LOOP_SD_S = 20e-6
"""Where a profile states no standard deviation."""


@dataclass(frozen=True, slots=True)
class Cascade:
    """Position P over velocity P on the measured position: u = kv (kp (r - x) - dx/dt), limited."""

    position_gain_per_s: float
    velocity_gain_n_s_per_m: float
    limit_n: float


@dataclass(frozen=True, slots=True)
class BelievedAxis:
    """One body and its motor."""

    mass_kg: float
    mass_sd_kg: float
    noise_m: float
    current_loop_s: float
    force_constant_n_per_a: float = 1.0
    force_constant_sd_ratio: float = FORCE_CONSTANT_SD_RATIO
    latch_s: float = 0.0  # sample instant -> the drive takes over the command of the same row
    latch_sd_s: float = LATCH_SD_S
    current_loop_sd_s: float = CURRENT_LOOP_SD_S
    current_noise_a: float | None = None  # of the drive's reported current; None: what it reports is not used
    force_limit_n: float = math.inf  # of its commands


@dataclass(frozen=True, slots=True)
class BelievedJoint:
    """What couples the bodies; stiffness and edges on x_b = macro minus end."""

    spring_n_per_m: float
    damping_n_s_per_m: float
    left_m: float
    right_m: float
    left_stiffness_n_per_m: float
    right_stiffness_n_per_m: float
    width_sd_m: float
    stiffness_sd_ratio: float = STIFFNESS_SD_RATIO
    damping_sd_ratio: float = DAMPING_SD_RATIO
    left_stiffness_sd_ratio: float = STIFFNESS_SD_RATIO
    right_stiffness_sd_ratio: float = STIFFNESS_SD_RATIO


@dataclass(frozen=True, slots=True)
class Believed:
    """A machine as the modeller has it."""

    name: str
    period_s: float
    macro: BelievedAxis
    micro: BelievedAxis | None = None
    joint: BelievedJoint | None = None
    effects: tuple[dict[str, Any], ...] = ()
    cascade: Cascade | None = None
    effect_sd_ratio: float = EFFECT_SD_RATIO
    effect_sd_ratios: dict[str, float] = field(default_factory=dict)  # by effect, where it is stated
    travel_m: float = 1.0
    own_effects: tuple[str, ...] = ()  # of the user's files
    effect_texts: tuple[tuple[str, str], ...] = ()  # of those files, name and text: what another process declares
    source: dict[str, Any] = field(default_factory=dict)
    path: str = ""  # of the file that it was taken from, with the hash of its bytes; "" where it was none
    sha256: str = ""


class CycleTable(Table):
    """The sampling of a machine that something else drives."""

    rate_hz: Annotated[float, within(10.0, 20e3)]
    latch_s: Annotated[float, within(-0.01, 0.1)]  # sample instant -> the drive takes over the command of the same row
    latch_sd_s: Annotated[float, above(0.0, 0.01)] = LATCH_SD_S


class BodyTable(Table):
    """Its one body."""

    mass_kg: Annotated[float, above(0.0, 1e5)]
    mass_sd_kg: Annotated[float, above(0.0, 1e4)]
    travel_m: Annotated[float, above(0.0, 100.0)]
    current_loop_s: Annotated[float, within(0.0, 0.1)] = 0.0


class SensorTable(Table):
    """Its position sensor."""

    noise_m: Annotated[float, above(0.0, 1e-2)]


class LoopTable(Table):
    """Its controller."""

    law: Literal["cascade"]
    position_gain_per_s: Annotated[float, above(0.0, 1e6)]
    velocity_gain_n_s_per_m: Annotated[float, above(0.0, 1e9)]
    limit_n: Annotated[float, above(0.0, 1e7)]


class ObservedMachine(Document):
    """A machine that is only looked at: one axis, no bus."""

    name: Annotated[str, Field(pattern=r"^[a-z0-9][a-z0-9-]*$")]
    cycle: CycleTable
    macro: BodyTable
    sensor: SensorTable
    loop: LoopTable | None = None
    effect_sd_ratio: Annotated[float, above(0.0, 100.0)] = EFFECT_SD_RATIO
    effect_files: tuple[EffectFile, ...] = ()  # before the effects that they declare
    effects: tuple[EffectTable, ...] = ()

    @model_validator(mode="after")
    def _check_effects(self) -> "ObservedMachine":
        """Effects of a second axis have no place here."""
        refuse(without_micro(self.effects))
        return self


def load_believed(name: str | Path) -> Believed:
    """Load a profile, or the file of an observed machine; ProfileError where it is neither."""
    path = toml_file.find(name, search_folders(), "profile")
    try:
        content = path.read_bytes()
    except OSError as error:
        raise ProfileError(f"{path}: can't be read ({error.strerror}); check path and permissions") from error
    document = document_of(content, path)
    if isinstance(document, ObservedMachine):
        return believed_of_observed(document)
    return believed_of_profile(document)


def document_of(content: bytes, path: Path) -> Profile | ObservedMachine:
    """Read what stands in `path`, or is about to, as what it is: only a profile has a bus. Errors: ProfileError."""
    try:
        driven = "can" in tomllib.loads(content.decode())
    except (ValueError, RecursionError):
        driven = True  # whose reader says what is wrong
    return toml_file.read_content(Profile if driven else ObservedMachine, content, path)


def believed_of_observed(machine: ObservedMachine) -> Believed:
    """Take the belief out of an observed machine's file."""
    body = machine.macro
    cascade = None
    if machine.loop is not None:
        loop = machine.loop
        cascade = Cascade(loop.position_gain_per_s, loop.velocity_gain_n_s_per_m, loop.limit_n)
    return Believed(
        name=machine.name,
        period_s=1.0 / machine.cycle.rate_hz,
        macro=BelievedAxis(
            body.mass_kg,
            body.mass_sd_kg,
            machine.sensor.noise_m,
            body.current_loop_s,
            latch_s=machine.cycle.latch_s,
            latch_sd_s=machine.cycle.latch_sd_s,
            force_limit_n=math.inf if machine.loop is None else machine.loop.limit_n,
        ),
        effects=tuple(dict(row) for row in machine.effects),
        cascade=cascade,
        effect_sd_ratio=machine.effect_sd_ratio,
        travel_m=body.travel_m,
        own_effects=tuple(name for file in machine.effect_files for name in file.names),
        effect_texts=tuple((Path(file.file).name, file.text) for file in machine.effect_files),
        path=str(machine.source_path or ""),
        sha256=machine.sha256,
    )


def believed_of_profile(profile: Profile) -> Believed:
    """Take the belief out of a profile."""
    noise_m = profile.interferometer.noise_m
    macro = BelievedAxis(
        profile.macro.mass_kg,
        profile.macro.mass_sd_kg,
        noise_m,
        profile.macro.current_loop_s,
        profile.macro.rated_force_n / profile.macro.rated_current_a,
        latch_s=profile.cycle.actuation_delay_s,
        force_limit_n=profile.macro.force_limit_n,
    )
    micro = joint = None
    if profile.micro is not None and profile.backlash is not None:
        micro = BelievedAxis(
            profile.micro.mass_kg,
            profile.micro.mass_sd_kg,
            noise_m,
            profile.micro.current_loop_s,
            profile.micro.rated_force_n / profile.micro.rated_current_a,
            latch_s=profile.cycle.actuation_delay_s,
            force_limit_n=profile.micro.force_limit_n,
        )
        backlash = profile.backlash
        joint = BelievedJoint(
            profile.micro.spring_n_per_m,
            profile.micro.damping_n_s_per_m,
            backlash.left_m,
            backlash.right_m,
            backlash.left_stiffness_n_per_m,
            backlash.right_stiffness_n_per_m,
            backlash.width_sd_m,
        )
    return Believed(
        name=profile.name,
        period_s=1.0 / profile.cycle.rate_hz,
        macro=macro,
        micro=micro,
        joint=joint,
        effects=tuple(dict(row) for row in profile.effects),
        travel_m=profile.macro.travel_m[1] - profile.macro.travel_m[0],
        own_effects=tuple(name for file in profile.effect_files for name in file.names),
        effect_texts=tuple((Path(file.file).name, file.text) for file in profile.effect_files),
        path=str(profile.source_path or ""),
        sha256=profile.sha256,
    )
