"""What a name's ending means: the unit of every quantity that crosses a boundary.

Pure; imports nothing.
"""

_SYMBOLS = {
    "_n_s_per_m": "N s/m",
    "_n_per_sqrt_s": "N/sqrt(s)",
    "_n_per_m": "N/m",
    "_n_per_m3": "N/m^3",
    "_n_s2_per_m2": "N s^2/m^2",
    "_n_per_a": "N/A",
    "_v_s_per_m": "V s/m",
    "_m_per_s2": "m/s^2",
    "_m_per_s3": "m/s^3",
    "_m_per_s": "m/s",
    "_rad_per_s": "rad/s",
    "_bit_per_s": "bit/s",
    "_counts_per_m": "counts/m",
    "_per_m": "1/m",
    "_per_s": "1/s",
    "_percent": "%",
    "_ratio": "1",
    "_count": "1",
    "_ppm": "1e-6",
    "_hz": "Hz",
    "_kg": "kg",
    "_ns": "ns",
    "_rad": "rad",
    "_ohm": "ohm",
    "_degc": "degC",
    "_pa": "Pa",
    "_k": "K",
    "_m": "m",
    "_s": "s",
    "_n": "N",
    "_a": "A",
    "_v": "V",
    "_h": "H",
}


def unit_of(name: str) -> str | None:
    """Return the unit that a name's ending states ("1" for plain numbers), None where it states none."""
    for ending, symbol in _SYMBOLS.items():
        if name.endswith(ending):
            return symbol
    return None
