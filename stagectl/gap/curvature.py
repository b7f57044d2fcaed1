"""What amplitudes are known to when the shapes beside them are not: the curvature of the score over both.

A search solves for amplitudes at given shapes. A share of the mass that swings is uncertain by what its frequency and
its damping are, too, and a ripple by what its pitch is. Where a search ends the score is, to second order, that of all
amplitudes together with the slopes of what was found over every shape that was searched (Gauss-Newton). Pure.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from stagectl.effects import CATALOGUE
from stagectl.gap.competition import Competition
from stagectl.gap.effect_forces import effect_forces
from stagectl.gap.forces import Forces, scaled_forces
from stagectl.gap.grids import free_shapes
from stagectl.gap.hypotheses import Term, widest_amplitudes
from stagectl.gap.normal_equations import Group, Scatter, Solution, solve
from stagectl.gap.operating_point import Moved
from stagectl.gap.quantities import in_order
from stagectl.gap.recording import Recording
from stagectl.gap.refinement import reach_of, with_shape
from stagectl.gap.scatter import scattered

_STEP_RATIO = 1e-4
"""Share of the range of a search that a slope is taken over."""

_MOST_PASSES = 4
_LEAST_GAIN = 0.1
"""Squares of the noise that a step towards better shapes has to gain for another one."""

_SIZED = (0.5, 1.5)
"""Share of itself within which an effect was taken at its size; else its column is a slope already."""


@dataclass(frozen=True, slots=True)
class _Slope:
    """Slope of what one effect does over one of its shapes: what changes over `step` of it."""

    key: tuple[str, str]
    shape: str
    step: float
    group: Group
    sizes: Group | None  # whose size the shape is


def at_best_shapes(search: Competition, chosen: Sequence[Group]) -> tuple[list[Group], Solution]:
    """Return groups at the shapes that are best for all of them together, and their amplitudes.

    The deviations of the amplitudes hold those of every shape that was searched.
    """
    found = list(chosen)
    slopes = _slopes(search, found)
    for _ in range(_MOST_PASSES if slopes else 0):
        tried = _stepped(search, found, slopes)
        if not search.judge.gain(tried) > search.judge.gain(found) + _LEAST_GAIN:
            break
        found = tried
        slopes = _slopes(search, found)
    return found, _with_slopes(search, found, slopes)


def _slopes(search: Competition, chosen: Sequence[Group]) -> list[_Slope]:
    solution = solve([*search.judge.base, *chosen], search.evidence.sums)
    values = {slot: float(value) for slot, value in zip(solution.slots, solution.values, strict=True)}
    found: list[_Slope] = []

    def add(
        term: Term,
        name: str,
        bounds: tuple[float, float],
        step: float,
        sizes: Group | None,
        forces: Callable[[Recording], list[Forces]],
    ) -> None:
        scope = "structural" if sizes is None else sizes.scope
        slope = Term(term.name, term.acts_on, {}, (name,), forces, scope, linear=False)
        prior = ((bounds[1] - bounds[0]) / step,)
        group = search.evidence.append(slope, search.evidence.columns_of(slope), prior, 0)
        found.append(_Slope(term.key, name, step, group, sizes))

    for group in chosen:
        term = search.term(group)
        if term.acts_on == "parameter":
            continue
        effect = CATALOGUE[term.name]
        size = effect.parameters[0]
        is_sized = not term.linear and all(
            _SIZED[0] < value < _SIZED[1] for (column, _), value in values.items() if column == group.columns[0]
        )
        names = [name for name in free_shapes(effect) if name in term.shape and (is_sized or name != size)]
        for name in dict.fromkeys([size, *names] if is_sized else names):
            low, high = reach_of(search.evidence.recordings, term, name, _STEP_RATIO)
            if high > low:
                ends = with_shape(term, {name: low}), with_shape(term, {name: high})
                own = {
                    (group.columns.index(column), scope): value
                    for (column, scope), value in values.items()
                    if column in group.columns
                }
                sizes = group if is_sized and name == size else None
                forces = partial(_changed, ends, own, 1.0 if is_sized else None)
                add(term, name, effect.bounds[name], high - low, sizes, forces)
    for effect, place, shape in search.moved:
        for name in free_shapes(effect):
            if name != effect.parameters[0]:
                step = _STEP_RATIO * abs(shape[name])
                forces = partial(_moved_on, (effect, place, shape), name, step)
                term = Term(effect.name, place, dict(shape), (name,), forces)
                add(term, name, effect.bounds[name], step, None, forces)
    return found


def _changed(
    ends: tuple[Term, Term], values: dict[tuple[int, str], float], share: float | None, r: Recording
) -> list[Forces]:
    """Return what an effect changes by between two shapes, at the amplitudes of a recording."""
    scopes = ("", f"session {r.log.session}", f"run {r.log.name}")
    total = Forces()
    for sign, term in zip((-1.0, 1.0), ends, strict=True):
        for k, forces in enumerate(term.forces(r)):
            value = share or next((values[k, scope] for scope in scopes if (k, scope) in values), 0.0)
            total = scaled_forces(forces, sign * value, total)
    return [total]


def _moved_on(moved: Moved, name: str, step: float, r: Recording) -> list[Forces]:
    """Return the same of an effect that is part of the operating point."""
    effect, place, shape = moved
    total = Forces()
    for sign in (-1.0, 1.0):
        there = {**shape, name: shape[name] + 0.5 * sign * step}
        total = scaled_forces(effect_forces(r, effect, place, in_order(effect, there)), sign, total)
    return [total]


def _jointly(
    search: Competition, chosen: Sequence[Group], slopes: Sequence[_Slope]
) -> tuple[Solution, tuple[int, ...]]:
    """Solve amplitudes together with steps of all shapes; what was taken at its size stays as large as it is.

    Returns the columns of the latter, too.
    """
    sized = [slope.sizes for slope in slopes if slope.sizes is not None]
    free = [group for group in chosen if not any(group is other for other in sized)]
    fixed = tuple(column for group in sized for column in group.columns)
    groups = [*search.judge.base, *free, *(slope.group for slope in slopes)]
    return solve(groups, search.evidence.sums, fixed), fixed


def _stepped(search: Competition, chosen: Sequence[Group], slopes: Sequence[_Slope]) -> list[Group]:
    """Return groups at the shapes that their slopes ask for."""
    solution, _ = _jointly(search, chosen, slopes)
    found = []
    for group in chosen:
        term = search.term(group)
        shape = {}
        for slope in slopes:
            if slope.key == term.key and slope.shape in term.shape:
                low, high = reach_of(search.evidence.recordings, term, slope.shape, 1.0)
                there = term.shape[slope.shape] + slope.step * float(np.mean(solution.of(slope.group)[0]))
                shape[slope.shape] = float(np.clip(there, low, high))
        if shape:
            term = with_shape(term, shape)
            columns = search.evidence.columns_of(term)
            group = search.evidence.append(term, columns, widest_amplitudes(term), group.searched)
        found.append(group)
    return found


def _with_slopes(search: Competition, chosen: Sequence[Group], slopes: Sequence[_Slope]) -> Solution:
    """Return the amplitudes of groups with the covariances that they have beside the slopes."""
    plain = solve([*search.judge.base, *chosen], search.evidence.sums)
    joint, fixed = _jointly(search, chosen, slopes)
    at = {slot: k for k, slot in enumerate(joint.slots)}
    ratios = {slot: 1.0 for slot in plain.slots}
    for slope in slopes:
        if slope.sizes is not None:
            size = search.term(slope.sizes).shape[slope.shape]
            for column, scope in plain.slots:
                if column == slope.sizes.columns[0]:
                    at[column, scope] = at[slope.group.columns[0], scope]
                    ratios[column, scope] = slope.step / size
    places = [at[slot] for slot in plain.slots]
    weights = np.array([ratios[slot] for slot in plain.slots])

    def of_plain(covariances: np.ndarray) -> np.ndarray:
        return covariances[..., places, :][..., places] * np.outer(weights, weights)

    spread = tuple(
        Scatter(of_plain(one.covariance), of_plain(one.of_noise)) for one in scattered(search.evidence, joint, fixed)
    )
    return replace(plain, covariance=of_plain(joint.covariance), scattered=spread)
