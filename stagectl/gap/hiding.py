"""What `stagectl gap demo` hides in the rig: one effect that the profile does not have, drawn by a seed. Pure."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import tomlkit

_DRAWN: dict[bool, tuple[tuple[str, str, dict[str, tuple[float, float]]], ...]] = {
    True: (("coulomb_friction", "micro_force", {"level_n": (0.3, 0.6), "smoothing_m_per_s": (1e-4, 1e-4)}),),
    False: (
        ("coulomb_friction", "macro_force", {"level_n": (2.0, 6.0), "smoothing_m_per_s": (1e-4, 1e-4)}),
        (
            "cogging",
            "macro_force",
            {"amplitude_n": (1.0, 4.0), "pitch_m": (0.016, 0.032), "phase_rad": (-np.pi, np.pi)},
        ),
    ),
}
"""By whether the stage has a micro: name, place, range of each parameter. On the end itself, where the error shows;
with more than 0.6 N there homing no longer finds the edges of the joint."""


def drawn(seed: int, has_micro: bool) -> dict[str, Any]:
    """Draw one hidden effect as an `[[effects]]` table."""
    random = np.random.default_rng([seed, 3])
    choices = _DRAWN[has_micro]
    name, place, ranges = choices[int(random.integers(len(choices)))]
    values = {key: float(f"{random.uniform(low, high):.4g}") for key, (low, high) in ranges.items()}
    return {"name": name, "acts_on": place, **values}


def with_hidden(machine_text: str, known: Sequence[tuple[str, str]], hidden: dict[str, Any]) -> str:
    """Return a machine's text with the effects that the profile knows, by name and place, and the hidden one."""
    document = tomlkit.parse(machine_text)
    rows = [row for row in document.get("effects", []) if (row["name"], row["acts_on"]) in known]
    effects = tomlkit.aot()
    for row in [*rows, hidden]:
        table = tomlkit.table()
        table.update(row)
        effects.append(table)
    document.pop("effects", None)
    document.append("effects", effects)
    return tomlkit.dumps(document)
