"""How near several laws together come to a hidden one, where each of them alone is many deviations away.

A tilt is an offset on each body, an offset of the macro a tilt and a cable on the micro that is anchored far away. Such
laws together are the hidden law to the last bit, and nobody who has them can say that it is another one.
"""

import itertools
import math

from scipy import optimize

from tests.blind import detection, laws
from tests.blind.draw import PARAMETER_ERRORS

PASSES = 4
STARTS_COUNT = 12


def distance(case, keys):
    """Distance d of the one hidden effect from the laws of `keys` together; infinite where one of them has no law here.

    keys: (name, acts_on) of laws of the library or of wrong parameters. Each law is at a point of its grid; of what its
    force is linear in (an anchor, an asymmetry) it has any amount, and where its column turns with its size it has the
    size that comes nearest.
    """
    whole = detection.Evidence(case, case.runs)
    evidence = whole.narrowed(detection.SEPARATION_BAND_HZ)
    del whole
    signal = evidence.effect_column(0)
    points = [_points(evidence, *key, case.effects) for key in keys]
    if not all(points):
        return math.inf

    def rest(chosen):
        return evidence.rest_after(signal, [column for one in chosen for column in one.columns], True)

    nearest = rest([])
    for chosen in _starts(rest, points):
        for _ in range(PASSES):
            before = rest(chosen)
            for place, choices in enumerate(points):
                chosen[place] = min(choices, key=lambda one: rest([*chosen[:place], one, *chosen[place + 1 :]]))
            if rest(chosen) >= before:
                break
        nearest = min(nearest, rest(_at_best_sizes(rest, chosen)))
    return nearest


class Point:
    """One law at one point of its grid, at a size where its column turns with that."""

    def __init__(self, columns, at_size=None, size=0.0):
        """`at_size` gives the column of a size; None where columns grow with the size alone."""
        self.columns, self.at_size, self.size = columns, at_size, size


def _points(evidence, name, acts_on, hints):
    """A law at every point of its grid, and pairs of those where a factor is linear; none where it has no law here."""
    if (name, acts_on) in PARAMETER_ERRORS:
        known = all(parameter in evidence.names for parameter in PARAMETER_ERRORS[name, acts_on])
        return [Point([evidence.parameter_column((name, acts_on))])] if known else []
    law = laws.BY_NAME.get(name)
    if law is None or law.outside:
        return []
    found = []
    for _, _, signed, columns, sized in evidence.grid(law, acts_on, hints):
        if sized is None:
            found.append(Point(columns))
            continue
        at_size, middle = sized
        sizes = [share * middle for share in (detection.SLOPE_SHARE, *detection.SIZE_STARTS)]
        sizes += [-size for size in sizes] if signed else []
        found += [Point([at_size(size)], at_size, size) for size in sizes]
    shapes = law.parameters[1:]
    if shapes and all(p.name in detection.SHAPE_FACTORS and "phase" not in p.spread for p in shapes):
        # a mixture of two values of a linear factor is every other one; of two pitches or speeds it is none of the law
        pairs = itertools.combinations(found, 2)
        found += [Point([*one.columns, *other.columns]) for one, other in pairs]
    return found


def _starts(rest, points):
    """Yield lists of a point a law: the best ones of each law alone, beside the best of each other one."""
    ranked = [sorted(choices, key=lambda one: rest([one])) for choices in points]
    for place, order in enumerate(ranked):
        for one in order[: max(1, STARTS_COUNT // len(points))]:
            yield [one if other == place else best[0] for other, best in enumerate(ranked)]


def _at_best_sizes(rest, chosen):
    """The same laws at the sizes that come nearest, one after the other."""
    found = list(chosen)
    for place, one in enumerate(chosen):
        if one.at_size is None:
            continue

        def beside(log_size, place=place, one=one):
            size = math.copysign(math.exp(log_size), one.size)
            found[place] = Point([one.at_size(size)], one.at_size, size)
            return rest(found)

        middle, reach = math.log(abs(one.size)), math.log(detection.SIZE_REACH)
        bounds = (middle - reach, middle + reach)
        best = optimize.minimize_scalar(
            beside, bounds=bounds, method="bounded", options={"xatol": detection.SIZE_TOLERANCE, "maxiter": 20}
        )
        beside(best.x)
    return found
