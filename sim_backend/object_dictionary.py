"""The object dictionary of a rig drive: a vendor's EDS file with the rig's own identity.

The rig shares EDS files with the drivers, never a codec, so a wrong scale can't cancel itself out.
"""

from pathlib import Path
from typing import Any

import canopen
from canopen.objectdictionary import ODRecord, ODVariable, datatypes

from stagectl.errors import ProfileError

RIG_VENDOR_ID = 0x5254  # "RT": no hardware shows it, so a rig can't be taken for a machine

SIGNED_TYPES = datatypes.SIGNED_TYPES
NUMBER_TYPES = datatypes.UNSIGNED_TYPES + datatypes.SIGNED_TYPES


def key(index: int, subindex: int = 0) -> int:
    """Join index and subindex of an object into one number."""
    return index << 8 | subindex


def load(path: str | Path, node_id: int, axis: Any) -> canopen.ObjectDictionary:
    """Read an EDS file and make it a rig drive's: vendor id, name plate of its motor, encoder step.

    `axis` is a [macro] or [micro] table; `rated_force_n` (the name plate, not the true constant) may be missing:
    then the EDS file's 0x6076 stands. Without `has_rpdo_deadline` the drive lacks 0x1400:05 that its EDS file has,
    without `winding` the temperature of one, 0x2010.
    """
    if not Path(path).is_file():
        raise ProfileError(f"{path}: the rig's EDS file is missing; give the path of an existing EDS file")
    dictionary = canopen.import_od(str(path), node_id=node_id)
    rated_force_n = getattr(axis, "rated_force_n", None)
    step_m = getattr(axis, "encoder_step_m", None)
    _set_default(dictionary, path, 0x1018, 1, RIG_VENDOR_ID)
    _set_default(dictionary, path, 0x6075, 0, round(1000.0 * axis.rated_current_a))
    if rated_force_n is not None:
        _set_default(dictionary, path, 0x6076, 0, round(1000.0 * rated_force_n))
    if step_m is not None and 0x608F in dictionary:
        _set_default(dictionary, path, 0x608F, 1, round(1.0 / step_m))
        _set_default(dictionary, path, 0x608F, 2, 1)
    if not getattr(axis, "has_rpdo_deadline", True):
        _set_default(dictionary, path, 0x1400, 0, 3)
        communication = dictionary[0x1400]
        if isinstance(communication, ODRecord):
            del communication[5]
    if getattr(axis, "winding", None) is None and 0x2010 in dictionary:
        del dictionary[0x2010]
    return dictionary


def _set_default(dictionary: canopen.ObjectDictionary, path: str | Path, index: int, subindex: int, value: int) -> None:
    variable = dictionary.get_variable(index, subindex)
    if variable is None:
        raise ProfileError(f"{path}: the EDS file lacks 0x{index:04X}:{subindex:02X}; the rig's drives need it, add it")
    variable.default = value


def numbers(dictionary: canopen.ObjectDictionary) -> dict[int, int]:
    """Return the default of every integer object, by `key`."""
    values: dict[int, int] = {}
    for index, entry in dictionary.items():
        for variable in [entry] if isinstance(entry, ODVariable) else entry.values():
            if variable.data_type in NUMBER_TYPES:
                default = variable.default if variable.value is None else variable.value
                values[key(index, variable.subindex)] = int(default or 0)
    return values
