"""What is left of recordings under everything that is known, as coloured noise: an autoregression a channel. Pure."""

from collections.abc import Sequence

import numpy as np
from scipy.linalg import solve_toeplitz
from scipy.signal import lfilter

from stagectl.gap import balance
from stagectl.gap.hypotheses import Term
from stagectl.gap.predicted_columns import stacked_columns
from stagectl.gap.recording import Recording

_AR_ORDER = 12


def filters_of(
    blocks: Sequence[tuple[Recording, np.ndarray, np.ndarray]], prior: np.ndarray, terms: Sequence[Term]
) -> dict[str, tuple[np.ndarray, float]]:
    """Fit an autoregression a channel (Yule-Walker) to what effects and aliases together leave of all recordings.

    What only a wrong name leaves is no noise: taken for noise it would hide the right one.
    """
    wide = []
    for recording, _, d in blocks:
        more = [forces for term in terms for forces in term.forces(recording)]
        wide.append(np.column_stack([d, stacked_columns(recording, more)]) if more else d)
    precision = np.concatenate([prior, np.zeros(wide[0].shape[1] - prior.size)])
    normal = sum((d.T @ d for d in wide), np.diag(precision))
    scale = np.sqrt(np.maximum(np.diag(normal), 1e-300))
    normal = normal / np.outer(scale, scale) + 1e-9 * np.eye(scale.size)
    right = sum((d.T @ z for (_, z, _), d in zip(blocks, wide, strict=True)), np.zeros(scale.size))
    values = np.linalg.solve(normal, right / scale) / scale
    rests = [(recording, z - d @ values) for (recording, z, _), d in zip(blocks, wide, strict=True)]
    sums: dict[str, np.ndarray] = {}
    counts: dict[str, float] = {}
    for recording, rest in rests:
        start = 0
        for name, size in balance.channels(recording):
            part = rest[start : start + size]
            start += size
            if size <= _AR_ORDER:
                continue
            covariance = np.array([part[: size - k] @ part[k:] for k in range(_AR_ORDER + 1)])
            sums[name] = sums.get(name, 0.0) + covariance
            counts[name] = counts.get(name, 0.0) + size
    found = {}
    for name, total in sums.items():
        covariance = total / counts[name]
        covariance[0] *= 1.0 + 1e-9
        coefficients = solve_toeplitz(covariance[:-1], covariance[1:])
        left = float(covariance[0] - coefficients @ covariance[1:])
        found[name] = (coefficients, float(np.sqrt(max(left, 1e-300))))
    return found


def whitened_rest(recording: Recording, values: np.ndarray, filters: dict[str, tuple[np.ndarray, float]]) -> np.ndarray:
    """Pass columns through each channel's filter, shape kept but for what it takes to start."""
    start, parts = 0, []
    for name, size in balance.channels(recording):
        part = values[start : start + size]
        start += size
        if size <= _AR_ORDER:
            continue
        coefficients, sd = filters[name]
        done = np.asarray(lfilter(np.concatenate([[1.0], -coefficients]), [1.0], part, axis=0))
        parts.append(done[_AR_ORDER:] / sd)
    return np.concatenate(parts)
