"""From counts to metres.

Pure. Every position is made of the whole count, never by adding up differences.
"""

from collections.abc import Mapping, Sequence
from typing import Any

from drivers.frame_spec import wrong


def metres_per_count(wavelength_vacuum_m: float, air_index: float, counts_per_wavelength: float) -> float:
    """lambda_vacuum / (n counts_per_wavelength): displacement of one count, in m.

    `counts_per_wavelength` counts a displacement of one wavelength and so holds the optics' factor already.
    """
    return wavelength_vacuum_m / (air_index * counts_per_wavelength)


def counts_per_wavelength(counts_per_cycle: float, passes_count: float) -> float:
    """2 m c: counts over a displacement of one wavelength; m = 1 retroreflector, 2 plane mirror, 4 high resolution."""
    return 2.0 * passes_count * counts_per_cycle


def position_m(counts: float, zero_counts: float, metres_per_count_m: float) -> float:
    """(counts - zero) x metres per count."""
    return (counts - zero_counts) * metres_per_count_m


def counts_per_wavelength_of(interferometer: Mapping[str, Any]) -> tuple[float, float]:
    """Counts per wavelength of macro and end as the profile's [interferometer.frame] gives them, per field or once."""
    table: Mapping[str, Any] = interferometer.get("frame") or {}
    both: Any = table.get("counts_per_wavelength")
    found: dict[str, Any] = {"macro": both, "end": both}
    rows: Sequence[Mapping[str, Any]] = table.get("fields") or ()
    for field in rows:
        if field.get("role") in found and field.get("counts_per_wavelength") is not None:
            found[field["role"]] = field["counts_per_wavelength"]
    macro = found["macro"] if found["macro"] is not None else found["end"]
    end = found["end"] if found["end"] is not None else macro
    for value in (macro, end):
        if isinstance(value, bool) or not isinstance(value, int | float) or not 1e-3 <= value <= 1e12:
            remedy = "counts over a displacement of one wavelength, e.g. 2048.0"
            raise wrong("frame.counts_per_wavelength", value, "must be a number within 1e-3 .. 1e12", remedy)
    return float(macro), float(end)
