"""The `[interferometer]` table of a profile: one class a wire format, chosen by the key `format`.

Counts per wavelength include the optics: counts over a displacement by one wavelength. Knows no bytes.
"""

from typing import Annotated, Literal

from pydantic import Field, model_validator

from stagectl.toml_file import NO_BLANKS, Flag, Problem, Table, above, missing, problem_if, refuse, whole, within

_TYPE_BYTES = {"u8": 1, "i8": 1, "u16": 2, "i16": 2, "u32": 4, "i32": 4, "u64": 8, "i64": 8, "f32": 4, "f64": 8}
_CHECKSUM_BYTES = {"none": 0, "sum8": 1, "xor8": 1, "crc16-ccitt": 2}
_BITS_PER_BYTE_8N1 = 10
_MICRO_EPSILON_VALUE_BYTES = 3
_WIRE_SHARE = 0.8  # of a serial line: what is used above it queues after every hiccup

CountsPerWavelength = Annotated[float, within(0.01, 1e9)]
Mask = Annotated[int, whole(0, 2**64 - 1)]
Limit = Annotated[int, whole(-(2**63), 2**64 - 1)]
Role = Literal["sequence", "macro", "end", "status", "check", "ignore"]
_STATUS_KEYS = ("valid_mask", "valid_value", "macro_mask", "end_mask")


class FrameField(Table):
    """One value in a frame."""

    name: Annotated[str, Field(pattern=r"^[a-z][a-z0-9_]*$")]
    role: Role
    modulus: Annotated[int, whole(2, 2**64)] | None = None  # where a sequence wraps earlier than its type
    counts_per_wavelength: CountsPerWavelength | None = None
    valid_mask: Mask | None = None  # status: (value & mask) == valid_value makes both axes valid
    valid_value: Mask | None = None
    macro_mask: Mask | None = None  # status: these bits speak for the macro alone
    end_mask: Mask | None = None
    minimum: Limit | None = None  # check: outside these it is no frame
    maximum: Limit | None = None
    invalid_from: Limit | None = None  # macro, end: values from here on are error codes

    @model_validator(mode="after")
    def _check_role(self) -> "FrameField":
        """Positions need a scale, a status what good looks like; no key may stand where nothing reads it."""
        readers = {
            "modulus": ("sequence",),
            "counts_per_wavelength": ("macro", "end"),
            "invalid_from": ("macro", "end"),
            "minimum": ("check",),
            "maximum": ("check",),
        } | dict.fromkeys(_STATUS_KEYS, ("status",))
        problems: list[Problem | None] = []
        for key, roles in readers.items():
            value = getattr(self, key)
            limit = f"is read of the role {' and '.join(roles)} only, this is {self.role}"
            wrong = value is not None and self.role not in roles
            problems.append(problem_if(wrong, key, value, limit, "remove it, or correct role"))
        if self.role in ("macro", "end") and self.counts_per_wavelength is None:
            problems.append(missing("counts_per_wavelength"))
        if self.role == "status":
            problems += self._status_problems()
        refuse(problems)
        return self

    def _status_problems(self) -> list[Problem | None]:
        mask = (self.valid_mask or 0) | (self.macro_mask or 0) | (self.end_mask or 0)
        good = self.valid_value or 0
        limit = f"has bits outside the masks ({mask}), so no sample would be valid"
        return [
            missing("valid_mask") if mask == 0 else None,
            missing("valid_value") if self.valid_value is None else None,
            problem_if(mask != 0 and bool(good & ~mask), "valid_value", good, limit, "correct one of them"),
        ]


class ByteField(FrameField):
    """A value at a byte offset."""

    offset: Annotated[int, whole(0, 4095)]
    type: Literal["u8", "i8", "u16", "i16", "u32", "i32", "u64", "i64", "f32", "f64"]


class ColumnField(FrameField):
    """A number in a column of a line."""

    index: Annotated[int, whole(0, 255)]
    type: Literal["int", "float"] = "int"


class ValueField(FrameField):
    """A value in a block of tagged bytes."""

    index: Annotated[int, whole(0, 31)]


class SyncFixedFrame(Table):
    """Sync bytes, fields at fixed offsets, checksum over everything before it."""

    sync: Annotated[str, Field(pattern=r"^([0-9a-f]{2}){1,16}$")]
    length: Annotated[int, whole(3, 4096)]
    endian: Literal["little", "big"] = "little"
    checksum: Literal["none", "sum8", "xor8", "crc16-ccitt"]
    fields: tuple[ByteField, ...]

    @model_validator(mode="after")
    def _check_layout(self) -> "SyncFixedFrame":
        """No two things may share a byte."""
        problems = _role_problems(self.fields)
        end = self.length - _CHECKSUM_BYTES[self.checksum]
        owner = {byte: "sync" for byte in range(len(self.sync) // 2)}
        for number, field in enumerate(self.fields):
            last = field.offset + _TYPE_BYTES[field.type]
            key = f"fields[{number}].offset"
            limit = f"{field.name} ends at byte {last}, and length = {self.length} with its checksum leaves {end}"
            problems.append(problem_if(not last <= end, key, field.offset, limit, "correct offset, type or length"))
            taken = [owner[byte] for byte in range(field.offset, last) if byte in owner]
            limit = f"{field.name} shares bytes with {taken[0] if taken else ''}"
            problems.append(problem_if(bool(taken), key, field.offset, limit, "correct one offset"))
            owner |= {byte: field.name for byte in range(field.offset, last)}
        refuse(problems)
        return self


class LineFrame(Table):
    """One line of text a sample."""

    delimiter: Annotated[str, Field(min_length=1, max_length=4)] = "\r\n"
    separator: Annotated[str, Field(min_length=1, max_length=4)] = " "
    columns_count: Annotated[int, whole(1, 256)]
    ignore_prefix: Annotated[str, Field(min_length=1, max_length=16)] | None = None
    fields: tuple[ColumnField, ...]

    @model_validator(mode="after")
    def _check_layout(self) -> "LineFrame":
        """Every field must be in the line."""
        problems = _role_problems(self.fields) + _index_problems(self.fields, self.columns_count, "columns_count")
        alike = self.delimiter == self.separator
        limit = "is the separator as well"
        problems.append(problem_if(alike, "delimiter", self.delimiter, limit, "correct one of them"))
        refuse(problems)
        return self


class FlagbitsFrame(Table):
    """Bytes whose high bits say which part of a value they carry; a block of values a sample."""

    tag_bits: Annotated[int, whole(1, 4)] = 2
    tags: tuple[Annotated[int, whole(0, 15)], ...] = (0, 1, 2)
    more_tag: Annotated[int, whole(0, 15)] = 3
    order: Literal["lsb_first", "msb_first"] = "lsb_first"
    values_count: Annotated[int, whole(1, 32)]
    fields: tuple[ValueField, ...]

    @model_validator(mode="after")
    def _check_layout(self) -> "FlagbitsFrame":
        """Tags must fit into their bits, and the one that ends a value must be like no other."""
        problems = _role_problems(self.fields) + _index_problems(self.fields, self.values_count, "values_count")
        top = 2**self.tag_bits - 1
        limit = f"must be at most {top} with tag_bits = {self.tag_bits}"
        problems += [problem_if(not tag <= top, "tags", tag, limit, "correct one of them") for tag in self.tags]
        problems.append(problem_if(not self.more_tag <= top, "more_tag", self.more_tag, limit, "correct one of them"))
        alike = self.more_tag in self.tags or self.tags[-1:] in [(tag,) for tag in self.tags[:-1]]
        limit = "the last tag and more_tag must be like no other"
        problems.append(problem_if(alike, "tags", list(self.tags), limit, "correct one of them"))
        problems.append(problem_if(not self.tags, "tags", [], "is empty", "give one tag a byte of a value"))
        refuse(problems)
        return self


class Umd2Frame(Table):
    """A line of 8 or 16 integers of a uMD0, uMD1 or uMD2; axis 0 = there is none."""

    columns_count: Literal[8, 16]
    macro_axis: Annotated[int, whole(1, 3)] = 1
    end_axis: Annotated[int, whole(0, 3)] = 0
    phase_bits: Literal[8, 16] = 16
    homodyne: Flag = False  # homodyne firmware has no sign of a lost beam at all
    velocity_check: Flag | None = None
    counts_per_wavelength: CountsPerWavelength

    @model_validator(mode="after")
    def _check_axes(self) -> "Umd2Frame":
        """Axes must differ and be in the line: 8 columns carry axis 1 only."""
        problems: list[Problem | None] = []
        for key in ("macro_axis", "end_axis"):
            axis = getattr(self, key)
            wrong = axis > 1 and self.columns_count == 8
            limit = "a line of 8 columns carries axis 1 only"
            problems.append(problem_if(wrong, key, axis, limit, "set columns_count = 16"))
        alike = self.macro_axis == self.end_axis
        problems.append(problem_if(alike, "end_axis", self.end_axis, "is macro_axis as well", "correct one of them"))
        refuse(problems)
        return self


class MicroEpsilonFrame(Table):
    """The values of a block in output order; the counter is the only loss detector that the format has."""

    values: tuple[Literal["macro", "end", "counter", "ignore"], ...]
    counter_modulus: Annotated[int, whole(2, 2**18)] = 2**18
    counts_per_wavelength: CountsPerWavelength

    @model_validator(mode="after")
    def _check_values(self) -> "MicroEpsilonFrame":
        """Macro and counter once each, the end at most once."""
        shown = list(self.values)
        problems: list[Problem | None] = []
        for value, least in (("macro", 1), ("counter", 1), ("end", 0)):
            wrong = not least <= self.values.count(value) <= 1
            limit = f"must name {value} {'once' if least else 'at most once'}"
            problems.append(problem_if(wrong, "values", shown, limit, "name the values in output order"))
        problems.append(problem_if(len(shown) > 32, "values", shown, "has at most 32 values", "remove some"))
        refuse(problems)
        return self


class InterferometerTable(Table):
    """What all formats share."""

    port: Annotated[str, Field(pattern=rf"^/{NO_BLANKS}$")]
    rate_hz: Annotated[float, within(10.0, 100e3)]
    noise_m: Annotated[float, above(0.0, 1e-5)]
    jitter_s: Annotated[float, within(0.0, 1e-4)] = 0.0  # rms of a sample's instant; at a speed it is noise as well
    transport_s: Annotated[float, within(0.0, 0.1)]  # constant part of the way from sample to readable line
    baud_bit_per_s: Annotated[float, within(9600.0, 12e6)]
    incremental: Flag = True
    jump_limit_m: Annotated[float, above(0.0, 0.1)]
    encoder_disagreement_m: Annotated[float, above(0.0, 0.01)]
    interpolation_speed_m_per_s: Annotated[float, above(0.0, 10.0)] | None = None  # whole counts above it

    def _refuse_slow_line(self, frame_bytes: int) -> None:
        needed = frame_bytes * _BITS_PER_BYTE_8N1 * self.rate_hz
        limit = f"{frame_bytes} bytes at {self.rate_hz:g} Hz take {needed:g} bit/s, {_WIRE_SHARE:.0%} of it are allowed"
        wrong = not needed <= _WIRE_SHARE * self.baud_bit_per_s
        refuse([problem_if(wrong, "baud_bit_per_s", self.baud_bit_per_s, limit, "raise it or lower rate_hz")])


class SyncFixedInterferometer(InterferometerTable):
    """A generic binary frame."""

    format: Literal["syncfixed"]
    frame: SyncFixedFrame

    @model_validator(mode="after")
    def _check_line(self) -> "SyncFixedInterferometer":
        """The frames must fit on the serial line."""
        self._refuse_slow_line(self.frame.length)
        return self


class LineInterferometer(InterferometerTable):
    """A generic text line."""

    format: Literal["line"]
    frame: LineFrame


class FlagbitsInterferometer(InterferometerTable):
    """A generic stream of tagged bytes."""

    format: Literal["flagbits"]
    frame: FlagbitsFrame

    @model_validator(mode="after")
    def _check_line(self) -> "FlagbitsInterferometer":
        """The blocks must fit on the serial line."""
        self._refuse_slow_line(len(self.frame.tags) * self.frame.values_count)
        return self


class Umd2Interferometer(InterferometerTable):
    """Micro Measurement Display: ASCII lines over USB, so the baud rate paces nothing."""

    format: Literal["umd2"]
    frame: Umd2Frame


class MicroEpsilonInterferometer(InterferometerTable):
    """Micro-Epsilon RS422: blocks of 18-bit values in three tagged bytes each; absolute, so not incremental."""

    format: Literal["micro-epsilon"]
    frame: MicroEpsilonFrame
    incremental: Flag = False

    @model_validator(mode="after")
    def _check_line(self) -> "MicroEpsilonInterferometer":
        """The blocks must fit on the serial line."""
        self._refuse_slow_line(_MICRO_EPSILON_VALUE_BYTES * len(self.frame.values))
        return self


Interferometer = Annotated[
    SyncFixedInterferometer
    | LineInterferometer
    | FlagbitsInterferometer
    | Umd2Interferometer
    | MicroEpsilonInterferometer,
    Field(discriminator="format"),
]


def carries_end(frame: Table) -> bool:
    """Return whether the micro's absolute position is in the frames."""
    if isinstance(frame, Umd2Frame):
        return frame.end_axis != 0
    if isinstance(frame, MicroEpsilonFrame):
        return "end" in frame.values
    if isinstance(frame, SyncFixedFrame | LineFrame | FlagbitsFrame):
        return any(field.role == "end" for field in frame.fields)
    return False


def _role_problems(fields: tuple[FrameField, ...]) -> list[Problem | None]:
    """Every frame has a sequence number and the macro's position, and no name or role twice."""
    roles = [field.role for field in fields]
    names = [field.name for field in fields]
    problems: list[Problem | None] = [
        problem_if(role not in roles, "fields", names, f"none has the role {role}", "add that field")
        for role in ("sequence", "macro")
    ]
    for number, field in enumerate(fields):
        twice = field.role not in ("check", "ignore") and field.role in roles[:number]
        again = f"is the role of {names[roles.index(field.role)]} already"
        problems.append(problem_if(twice, f"fields[{number}].role", field.role, again, "keep one of them"))
        twice = field.name in names[:number]
        problems.append(problem_if(twice, f"fields[{number}].name", field.name, "is used twice", "rename one"))
    return problems


def _index_problems(fields: tuple[ColumnField, ...] | tuple[ValueField, ...], count: int, key: str) -> list:
    problems: list[Problem | None] = []
    for number, field in enumerate(fields):
        place = f"fields[{number}].index"
        limit = f"{field.name} must be below {key} = {count}"
        problems.append(problem_if(not field.index < count, place, field.index, limit, "correct one of them"))
        twice = field.index in [other.index for other in fields[:number]]
        problems.append(problem_if(twice, place, field.index, "is used by another field", "correct one of them"))
    return problems
