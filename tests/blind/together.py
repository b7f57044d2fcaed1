"""How near several laws together come to a hidden one, where each of them alone is many deviations away.

A tilt is an offset on each body, an offset of the macro a tilt and a cable on the micro that is anchored far away. A
sensor that lags by 476 us is one that is late, but for 17.7 deviations, and beside a damped mode above the band but for
1.5. Nobody who has such laws together can say that the hidden one is another.
"""

import functools
import math

import numpy as np
from scipy import optimize

from tests.blind import detection, laws
from tests.blind.draw import PARAMETER_ERRORS

PASSES = 4
STARTS_COUNT = 12
BEYOND = 10.0
"""So many times beyond what is drawn of a law it is followed: a mode of 145 Hz is a mode, too."""
FIRST_STEP = 0.1  # of a logarithm
ROUNDS_COUNT = 40  # for each number that is followed
TOLERANCE_D = 1e-2
KEPT_COUNT = 1000


def distance(case, named):
    """Distance d of the one hidden effect from laws together; infinite where one of them has no law here.

    named: (name, acts_on, values) of laws of the library or of wrong parameters; `values` are the parameters that are
    told of it, near which is looked as well. A law has any amount of what its force is linear in (its amplitude, an
    anchor, an asymmetry); its other parameters are followed from the best point of its grid to where they come nearest.
    """
    evidence, signal = _seen(case)
    members = [_member(evidence, name, acts_on, case.effects) for name, acts_on, _ in named]
    if not all(members):
        return math.inf
    rest = _rest(evidence, signal, members)
    nearest = min((_settled(rest, members, start) for start in _starts(rest, members)), key=rest, default=[])
    told = [member.told(point, values) for member, point, (*_, values) in zip(members, nearest, named, strict=True)]
    return min(_followed(rest, members, start)[0] for start in (nearest, told))


def distance_of_two(case, first, stands):
    """Distance d of the one hidden effect from a law and the one that comes nearest beside it, followed together.

    first: (name, acts_on) of the law; stands(name, acts_on) tells which others there are.
    """
    evidence, signal = _seen(case)
    member = _member(evidence, *first, case.effects)
    rest = _rest(evidence, signal, [member])
    alone, (point,) = _followed(rest, [member], [min(member.points, key=lambda one: rest([one]))])
    evidence.set_nuisance(member.columns(point))
    beside = {key: d for key, d in evidence.distances(signal, case.effects).items() if key != first and stands(*key)}
    second = min(beside, key=beside.get)
    return min(alone, beside[second], distance(case, [(*first, {}), (*second, {})]))


def _seen(case):
    """What is seen of a case, below where laws are told apart, and of its one hidden effect."""
    evidence = detection.Evidence(case, case.runs).narrowed(detection.SEPARATION_BAND_HZ)
    return evidence, evidence.effect_column(0)


def _rest(evidence, signal, members):
    """What points of some laws leave of a signal; a law without a point is not there."""

    def rest(points):
        present = [(member, point) for member, point in zip(members, points, strict=True) if point is not None]
        return evidence.rest_after(
            signal, [column for member, point in present for column in member.columns(point)], True
        )

    return rest


class Member:
    """One law among others: where to begin, which of its parameters are followed, and what it changes."""

    def __init__(self, points, followed, columns):
        """`points`: values by name; `followed`: parameters; `columns` gives those of the linear parts at values."""
        self.points, self.followed = list({tuple(point.items()): point for point in points}.values()), followed
        self._columns = functools.lru_cache(KEPT_COUNT)(lambda items: columns(dict(items)))

    def columns(self, point):
        """What it changes at a point, a column for each of its linear parts."""
        return self._columns(tuple(point.items()))

    def told(self, point, values):
        """The point with the values that are told in the place of its own, where they have its sign."""
        names = [
            parameter.name
            for parameter in self.followed
            if point[parameter.name] * values.get(parameter.name, 0.0) > 0.0
        ]
        return point | {name: values[name] for name in names}


def _member(evidence, name, acts_on, hints):
    """A law as a member; None where it has no law here."""
    if (name, acts_on) in PARAMETER_ERRORS:
        known = all(parameter in evidence.names for parameter in PARAMETER_ERRORS[name, acts_on])
        return Member([{}], [], lambda _: [evidence.parameter_column((name, acts_on))]) if known else None
    law = laws.BY_NAME.get(name)
    points = [] if law is None or law.outside else evidence.points(law, hints)
    if not points:
        return None
    first, *shapes = law.parameters
    followed = [first] if law.name in detection.NONLINEAR else []
    if evidence.turns_with_size(law):
        followed = [first]
        sizes = [share * first.middle for share in (detection.SLOPE_SHARE, *detection.SIZE_STARTS)]
        sizes += [-size for size in sizes] if law.signed else []
        points = [point | {first.name: size} for point in points for size in sizes]
    if len(shapes) == 1 and shapes[0].name in detection.SHAPE_FACTORS and law.phase is None:
        # a mixture of two values of a linear factor is every other one; of two pitches or speeds it is none of the law
        ends = [{shapes[0].name: end} for end in (shapes[0].low, shapes[0].high)]
        return Member(
            [point | ends[0] for point in points],
            followed,
            lambda values: [column for end in ends for column in evidence.law_columns(law, acts_on, values | end)],
        )
    followed += [shape for shape in shapes if shape.spread in ("log", "uniform") and shape.low > 0.0]
    return Member(points, followed, lambda values: evidence.law_columns(law, acts_on, values))


def _starts(rest, members):
    """Yield points of the laws: the best ones of each law alone, beside the best of each other one."""
    ranked = []
    for place, member in enumerate(members):
        others = [None] * len(members)
        ranked.append(sorted(member.points, key=lambda one: rest([*others[:place], one, *others[place + 1 :]])))
    for place, order in enumerate(ranked):
        for one in order[: max(1, STARTS_COUNT // len(members))]:
            yield [one if other == place else best[0] for other, best in enumerate(ranked)]


def _settled(rest, members, start):
    """Points of the grids, from a start on, where no other point of one law comes nearer."""
    points = list(start)
    for _ in range(PASSES):
        before = rest(points)
        for place, member in enumerate(members):
            points[place] = min(member.points, key=lambda one: rest([*points[:place], one, *points[place + 1 :]]))
        if rest(points) >= before:
            break
    return points


def _followed(rest, members, start):
    """(distance, points) where the followed parameters, from a start on, come nearest."""
    places = [(place, parameter) for place, member in enumerate(members) for parameter in member.followed]
    if not places:
        return rest(start), start
    first = [start[place][parameter.name] for place, parameter in places]

    def moved(logs):
        points = [dict(point) for point in start]
        for (place, parameter), own, log in zip(places, first, logs, strict=True):
            points[place][parameter.name] = math.copysign(math.exp(log), own)
        return points

    bounds = [(math.log(p.low / BEYOND), math.log(p.high * BEYOND)) for _, p in places]
    begin = np.clip(np.log(np.abs(first)), *np.transpose(bounds))
    simplex = np.vstack([begin, begin + FIRST_STEP * np.eye(len(begin))])
    rounds = {"maxfev": ROUNDS_COUNT * len(begin), "xatol": FIRST_STEP * 1e-3, "fatol": TOLERANCE_D}
    near = optimize.minimize(
        lambda logs: rest(moved(logs)),
        begin,
        method="Nelder-Mead",
        bounds=bounds,
        options={"initial_simplex": simplex, **rounds},
    )
    return float(near.fun), moved(near.x)
