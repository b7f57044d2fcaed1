"""Run one effect along a recording: the law's own compiled text, in time order, so that a memory is what it was.

Pure.
"""

from collections.abc import Callable, Sequence
from functools import cache

import numpy as np

from stagectl import compose
from stagectl.effects import CATALOGUE, Effect


def evaluated(effect: Effect, arguments: Sequence[np.ndarray], parameters: Sequence[float]) -> np.ndarray:
    """Return the effect's output for arrays of its quantities (all of one shape), shape kept."""
    shape = arguments[0].shape
    flat = [np.ascontiguousarray(np.broadcast_to(a, shape), dtype=float).ravel() for a in arguments]
    out = np.zeros(flat[0].size)
    _runner(effect.name)(*flat, np.array([*parameters, 0.0], dtype=float), np.zeros(max(effect.memory, 1)), out)
    return out.reshape(shape)


@cache
def _runner(name: str) -> Callable[..., None]:
    """Generate the loop over one effect."""
    effect = CATALOGUE[name]
    quantities = [f"{quantity}_" for quantity in effect.quantities]
    values = [f"{quantity}[k]" for quantity in quantities] + [f"p[{k}]" for k in range(len(effect.parameters))]
    if effect.memory:
        values.append("memory")
    source = "\n".join(
        [
            f'"""Generated: {name} along a recording."""',
            "from stagectl.compiled import compiled",
            "from stagectl.effects import CATALOGUE",
            "",
            f"law = CATALOGUE[{name!r}].compiled_law",
            "",
            "",
            "@compiled",
            f"def run({', '.join(quantities)}, p, memory, out):",
            "    for k in range(out.size):",
            f"        out[k] = law({', '.join(values)})",
            "",
        ]
    )
    return compose.generated_module(f"along_{name}", source).run
