"""What amplitudes are uncertain by where laws are only nearly right: how their scores scatter from stretch to stretch.

    V = A^-1 (n / (n - 1) sum_s g_s g_s' + P) A^-1,   g_s = sum of x (z - x'v) over one stretch

x are columns, z innovations in units of the noise, v the amplitudes, A = sum x x' + P the normal matrix with its priors
P, n the number of stretches. Where noise is all that is left V is A^-1; where laws are not exact it is what an inexact
model is uncertain by (Huber 1967, White 1982; by stretches: Liang, Zeger 1986). A scale of all forces that one payload
told to 0.27 % was 1.7 % off, and a level that a bristle's damping was missing from 0.6 % at a stated 0.3 %. Pure.
"""

from collections.abc import Sequence

import numpy as np

from stagectl.gap.evidence import INNOVATIONS, Evidence
from stagectl.gap.normal_equations import Scatter, Solution, active_slots, covers

_STRETCHES_S = (0.25, 1.0, 4.0)
"""What is missing may last as long as a reversal or as long as a move."""

INEXACT_RATIO = 3e-4
"""Deviation of any size, as a share of it, by which laws and motion are not exact everywhere alike, which no scatter
tells: a vibration of 179 million squares was 2e-4 off in five runs together, at a stated 7e-5."""

_LEAST_STRETCHES = 4
"""Fewer tell nothing of their scatter."""


def scattered(evidence: Evidence, solution: Solution, fixed: Sequence[int] = ()) -> tuple[Scatter, ...]:
    """Return how a solution's amplitudes scatter between stretches, one for each length of them.

    fixed: columns that stand beside the amplitudes at 1.
    """
    precision = np.diag(active_slots(solution.groups, evidence.sums)[1])
    found = []
    for stretch_s in _STRETCHES_S:
        each = [_scores(evidence, k, solution, fixed, stretch_s) for k in range(len(evidence.sums))]
        scores, normals = (np.concatenate(one) for one in zip(*each, strict=True))
        count = scores.shape[0]
        if count >= _LEAST_STRETCHES:
            spread = count / (count - 1.0) * scores.T @ scores + precision
            of_noise = solution.covariance @ normals @ solution.covariance
            found.append(Scatter(solution.covariance @ spread @ solution.covariance, of_noise))
    return tuple(found)


def _scores(
    evidence: Evidence, recording: int, solution: Solution, fixed: Sequence[int], stretch_s: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return what the stretches of one recording say of the amplitudes, channels summed.

    Their scores, shape (stretches, amplitudes), and their normal matrices.
    """
    origin, log = evidence.origins[recording], evidence.recordings[recording].log
    stretches = max(round(log.samples_count * log.period_s / stretch_s), 1)
    here = np.array([k for k, (_, scope) in enumerate(solution.slots) if covers(scope, origin)], dtype=int)
    total = np.zeros((stretches, len(solution.slots)))
    normals = np.zeros((stretches, len(solution.slots), len(solution.slots)))
    for channel in evidence.channels[recording]:
        present, rows = channel.of([solution.slots[k][0] for k in here])
        if rows is None:
            continue
        _, beside = channel.of(fixed)
        left = channel.rows[INNOVATIONS] - solution.values[here[present]] @ rows
        left = left if beside is None else left - beside.sum(axis=0)
        own = np.ix_(here[present], here[present])
        for number, (part, rest) in enumerate(
            zip(np.array_split(rows, stretches, axis=1), np.array_split(left, stretches), strict=True)
        ):
            total[number, here[present]] += part @ rest
            normals[number][own] += part @ part.T
    return total, normals
