"""All hypotheses on recordings at one operating point: known parameters, effects, curves, ready to compete. Pure."""

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from stagectl.effects import CATALOGUE
from stagectl.gap import balance, curves, hypotheses, seeds
from stagectl.gap.crew import Crew, Serial
from stagectl.gap.evidence import Added, Evidence
from stagectl.gap.forces import Forces, scaled_forces
from stagectl.gap.grids import along_travel_m, free_shapes, grids_for
from stagectl.gap.hypotheses import DEVIATION_SD, Term, widest_amplitudes
from stagectl.gap.innovations import Noise
from stagectl.gap.judge import Judge
from stagectl.gap.noise import Explained
from stagectl.gap.normal_equations import Group, Sums, solve
from stagectl.gap.operating_point import Moved
from stagectl.gap.recording import Recording
from stagectl.gap.refinement import (
    Refiner,
    anchor_of,
    but_for_size,
    counts_at_size,
    gain_at_size,
    refined,
    searched_count,
    with_shape,
)

_EXCITED_GAIN = 1e-6
_SEED = 0  # of the noise that pitches stand out of


class Competition:
    """All hypotheses on recordings at one operating point, ready to compete."""

    def __init__(
        self,
        recordings: Sequence[Recording],
        training_count: int,
        *,
        nulls_count: int = 0,
        seed: int = 0,
        without: frozenset[str] = frozenset(),
        refused: frozenset[tuple[str, str]] = frozenset(),
        moved: tuple[Moved, ...] = (),
        kept: Sequence[Term] = (),
        noise: dict[str, Noise],
        crew: Crew | None = None,
    ):
        """Whiten, make the columns, sum. `moved` effects are part of the recordings already, `kept` terms start.

        Names of `without` and those `refused` at their places don't compete.
        """
        self._crew: Crew = crew or Serial()
        self._crew.here(lambda recording: balance.set_noise(recording, noise), recordings)
        self.moved = moved
        self.noise = noise
        self.evidence = evidence = Evidence(recordings, self._crew)
        self.parameters = hypotheses.parameter_terms(recordings[0])
        self.curves: list[Group] = []
        self._finer: list[Group] = []
        self.kept: list[Group] = []
        self._sds: list[float] = []
        library: list[Group] = []
        base = self._taken([term for term, _ in self.parameters], [(sd,) for _, sd in self.parameters])
        base += self._taken([hypotheses.deviation_term(*one) for one in moved], [(DEVIATION_SD,)] * len(moved))
        self.kept += self._taken(kept)
        known_sds = np.array(self._sds)
        taken = refused | {(effect.name, place) for effect, place, _ in moved}
        grids = grids_for(recordings)
        wrong = list(hypotheses.wrong_parameter_terms(recordings[0]))

        def searched(terms: Iterable[Term]) -> list[Group]:
            return self._taken([term for term in terms if term.name not in without and term.key not in taken])

        library += searched([*wrong, *hypotheses.effect_terms(recordings, grids)])
        self.curves += self._taken(list(curves.curve_terms(recordings)))
        library += searched(_periodic_terms(evidence, known_sds, np.array(self._sds)))
        evidence.finish(known_sds, nulls_count, seed)
        self._refiner: tuple[tuple[int, ...], Refiner] | None = None
        self.judge = Judge(evidence, training_count, base, library, self._refined, self._gains_at_size)
        self.judge.curves = self.curves
        self.judge.brought_near = self._brought_near
        self.judge.anchors_moved = self._anchors_moved
        stated = {term.name: sd for term, sd in self.parameters}
        self.judge.stated_sds = {term.name: stated[hypotheses.parts_of(term.name)[0]] for term in wrong}
        self.judge.modelled = self._modelled()
        axes = [recordings[0].belief(axis) for axis in recordings[0].axes]
        self.judge.scale_sd_ratio = max(
            float(np.hypot(b.mass_sd_kg / b.mass_kg, b.force_constant_sd_ratio)) for b in axes
        )
        self.judge.is_rough = any(level.white_force_n > 0.0 for level in noise.values())

    def _modelled(self) -> float:
        """Return what dry friction of the model explains: a law with a step is never as exact as the noise is small."""
        dry = {
            f"{row['name']} on {row['acts_on']}"
            for row in self.evidence.recordings[0].believed.effects
            if CATALOGUE[row["name"]].has_step
        }
        columns = [g.columns[0] for (t, _), g in zip(self.parameters, self.judge.base, strict=False) if t.name in dry]
        return float(sum(s.gram[c, c] for s in self.evidence.sums for c in columns))

    def _taken(self, terms: Sequence[Term], sds: Sequence[tuple[float, ...]] | None = None) -> list[Group]:
        """Take hypotheses in; without `sds` their amplitudes may be as large as their effects can be."""
        groups = []
        priors = [widest_amplitudes(term) for term in terms] if sds is None else sds
        for term, columns, prior in zip(terms, self.evidence.add_all(terms), priors, strict=True):
            self._sds += prior
            searched = 0
            if sds is None and term.name in CATALOGUE:
                searched = max(len(free_shapes(CATALOGUE[term.name])) - (0 if term.linear else 1), 0)
            places_count = self.evidence.places_count(term.scope)
            groups.append(Group(term.key, columns, term.scope, prior, term.bounds, searched, places_count))
        return groups

    def _beside(self, groups: Sequence[Group]) -> Refiner:
        """Return what searches beside some groups; the last one is kept, gains and shapes are asked of the same."""
        state = tuple(column for group in groups for column in group.columns)
        if self._refiner is None or self._refiner[0] != state:
            self._refiner = state, Refiner(self.evidence, groups)
        return self._refiner[1]

    def _refined(self, beside: Sequence[Group], groups: Sequence[Group]) -> list[Group]:
        """Return groups at their best shapes, as new columns; a group itself where nothing is to be searched."""
        asked = [self.term(group) for group in groups]
        longest_first = sorted(range(len(asked)), key=lambda k: -searched_count(asked[k]))
        found = self._crew.map(refined, (self.evidence, self._beside(beside)), [asked[k] for k in longest_first])
        outcomes = [one for _, one in sorted(zip(longest_first, found, strict=True), key=lambda pair: pair[0])]
        terms = [outcome[0] for outcome in outcomes if outcome is not None]
        columns = iter(self._crew.here(self.evidence.columns_of, terms))
        added = [
            Added(outcome[0], next(columns), widest_amplitudes(outcome[0]), max(group.searched, outcome[1]))
            for group, outcome in zip(groups, outcomes, strict=True)
            if outcome is not None
        ]
        appended = iter(self.evidence.append_all(added))
        return [group if outcome is None else next(appended) for group, outcome in zip(groups, outcomes, strict=True)]

    def _gains_at_size(self, beside: Sequence[Group], groups: Sequence[Group]) -> list[float]:
        """Return what groups gain at their size; what a grid has at several sizes is asked for once."""
        asked = {
            group.columns: but_for_size(self.term(group))
            for group in groups
            if counts_at_size(self.evidence, self.term(group))
        }
        if not asked:
            return [0.0] * len(groups)
        terms = {asked[group.columns]: self.term(group) for group in groups if group.columns in asked}
        gains = self._crew.map(gain_at_size, (self.evidence, self._beside(beside)), terms.values())
        found = dict(zip(terms, gains, strict=True))
        return [found[asked[group.columns]] if group.columns in asked else 0.0 for group in groups]

    def finer_curves(self) -> list[Group]:
        """Return the curves that are asked at the end only; made once."""
        if not self._finer:
            terms = list(curves.finer_curve_terms(self.evidence.recordings))
            columns = self._crew.here(self.evidence.columns_of, terms)
            added = [Added(term, one, widest_amplitudes(term), 0) for term, one in zip(terms, columns, strict=True)]
            self._finer = self.evidence.append_all(added)
        return self._finer

    def _brought_near(self, other: Group, group: Group) -> list[Group]:
        """Return a law at the shapes that may say what `group` says: its own, and that of the same law elsewhere."""
        term, named = self.term(other), self.term(group)
        found = [other]
        if term.name == named.name and term.linear == named.linear:
            size, shape = CATALOGUE[term.name].parameters[0], named.shape
            if size in shape:  # what one reads too much the other reads too little
                shape = shape | {size: float(np.copysign(shape[size], term.shape[size]))}
            found += self._appended([with_shape(term, shape)], other) if shape != term.shape else []
        return found

    def _anchors_moved(self, chosen: Sequence[Group], group: Group) -> list[Group]:
        """Return the constant forces by which others than `group` pull differently from elsewhere along the travel."""
        solution = solve([*self.judge.base, *chosen], self.evidence.sums)
        constants = {one.key[1]: one for one in self.judge.library if one.key[0] == "offset"}
        moved = []
        for other in chosen:
            term = self.term(other)
            name, constant = anchor_of(term), constants.get(term.acts_on)
            if other is not group and name is not None and constant is not None:
                stiffness_n_per_m = float(np.mean(solution.of(other)[0]))
                places_m = along_travel_m(self.evidence.recordings)
                pull_n = [stiffness_n_per_m * (place_m - term.shape[name]) for place_m in places_m]
                moved.append(replace(constant, bounds=((min(0.0, *pull_n), max(0.0, *pull_n)),)))
        return moved

    def _appended(self, terms: list[Term], like: Group) -> list[Group]:
        columns = self._crew.here(self.evidence.columns_of, terms)
        added = [Added(*one, like.prior_sds, like.searched) for one in zip(terms, columns, strict=True)]
        return self.evidence.append_all(added)

    def term(self, group: Group) -> Term:
        """Return what a group stands for."""
        return self.evidence.terms[group.columns[0]]

    @property
    def known_parameters(self) -> list[Group]:
        """Return the groups of known parameters."""
        return self.judge.base[: len(self.parameters)]

    def explained(self, chosen: Sequence[Group], added: Sequence[Group]) -> Explained:
        """Return what `added` adds in a recording, at its sizes beside known parameters and all of `chosen`.

        Solved without what is part of the operating point known parameters made up for it: a delay of 0.6 ms left
        innovations red, for which 0.5 N of force noise was taken.
        """
        solution = solve([*self.judge.base, *chosen], self.evidence.sums)
        values = {
            (column, scope): float(value)
            for (column, scope), value in zip(solution.slots, solution.values, strict=True)
        }
        terms = [(self.term(group), group) for group in added]

        def of(recording: Recording) -> Forces:
            scopes = ("", f"session {recording.log.session}", f"run {recording.log.name}")
            total = Forces()
            for term, group in terms:
                for column, forces in zip(group.columns, term.forces(recording), strict=True):
                    value = next((values[column, scope] for scope in scopes if (column, scope) in values), 0.0)
                    total = scaled_forces(forces, value, total)
            return total

        return of

    def not_excited(self) -> tuple[str, ...]:
        """Name the effects that would not show in these recordings at any size."""
        terms = {group.key: self.term(group) for group in self.judge.library}
        excited = {
            group.key
            for group in self.judge.library
            if any(_energy(group, s) > _EXCITED_GAIN * s.count for s in self.judge.training)
        }
        return tuple(sorted(f"{term.name} on {term.acts_on}" for key, term in terms.items() if key not in excited))


def _periodic_terms(evidence: Evidence, known_sds: np.ndarray, all_sds: np.ndarray) -> list[Term]:
    """Make terms of pitches and frequencies that stand out.

    Of what all other hypotheses (`all_sds`) leave, above its neighbours; pitches also of what known parameters alone
    leave, above noise: laws and curves together have a part of every pitch that is not much shorter than the way. And
    frequencies that are lines in that: what a shaking base does, the motor counteracts, so that to a command that is
    late it is no stranger. A vibration of 0.3 million squares was no peak in what all hypotheses left.
    """
    recordings = evidence.recordings
    random = np.random.default_rng(_SEED)
    found: list[Term] = []
    for place, axis in enumerate(recordings[0].axes):
        left, unknown = (
            evidence.crew.here(
                lambda k, place=place, axis=axis, sds=sds: seeds.force_signal(
                    recordings[k], axis, evidence.rest(k, place, sds)
                ),
                range(len(recordings)),
            )
            for sds in (all_sds, known_sds)
        )
        noise = seeds.of_noise(recordings, axis, random)
        pitches = seeds.pitches_m(recordings, axis, left) + seeds.pitches_m(recordings, axis, unknown, noise)
        left_driven, unknown_driven, *noise_driven = (
            seeds.in_step_with_motor(recordings, axis, signals) for signals in (left, unknown, *noise)
        )
        driven = seeds.pitches_m(recordings, axis, left_driven)
        driven += seeds.pitches_m(recordings, axis, unknown_driven, noise_driven)
        frequencies = seeds.frequencies_hz(recordings, axis, left)
        frequencies += seeds.frequencies_hz(recordings, axis, unknown, seeds.LINE_RATIO)
        found += hypotheses.periodic_terms(recordings, axis, pitches, driven, frequencies)
    return found


def _energy(group: Group, s: Sums) -> float:
    return float(max(s.gram[c, c] for c in group.columns))
