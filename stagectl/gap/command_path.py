"""What a drive and the effects of its command path make of held commands, exactly, on parts of sample intervals.

A command is held for a period and taken over some time after its sample, within a part of an interval. An effect run on
means over parts smears that step: a delay of 102 us came out as one of 38 us and a lag (measured on data that hold a
delay alone). So a linear effect is its step response, put at every step of the commands where it happens; one without
memory changes the commands themselves. Means over parts are tilted to what a step within a part moves. Pure.
"""

import functools
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from scipy.signal import lfilter

from stagectl import compose
from stagectl.compiled import compiled, inlined
from stagectl.effects import CATALOGUE, Effect
from stagectl.gap.interval_parts import PARTS_COUNT, with_early

_STEP_RATIO = 1.0 / 1024.0  # of a period: the grid of step responses
_RESPONSE_PERIODS = (16, 256)  # of a step response: the second where it has not faded within the first
_FADING_LAGS = 12.0
_FADED = 1e-6  # of the greatest part of a step response: all behind it is left out
_SAME_RATIO = 1e-9
_LAG = CATALOGUE["current_loop_lag"]

Acting = tuple[Effect, list[float]]
"""An effect of a command path, and its parameters in their order."""


def delayed(command: np.ndarray, latch_ratio: float, parts: int = PARTS_COUNT) -> np.ndarray:
    """Return a held command on parts of intervals, (n, parts): it takes over `latch_ratio` periods after its sample.

    Before the first command acts the first is taken.
    """
    now, before, rest = _held(command, latch_ratio)
    edges = np.arange(parts + 1) / parts
    late = np.clip((rest - edges[:-1]) * parts, 0.0, 1.0)  # share of a part in which the earlier still acts
    return _mixed(before, now, late)


@compiled
def _mixed(before: np.ndarray, now: np.ndarray, late: np.ndarray) -> np.ndarray:
    mixed = np.empty((now.size, late.size))
    for k in range(now.size):
        for part in range(late.size):
            mixed[k, part] = before[k] * late[part] + now[k] * (1.0 - late[part])
    return mixed


def _held(command: np.ndarray, latch_ratio: float) -> tuple[np.ndarray, np.ndarray, float]:
    """Return, by interval, the command that takes over, the one before, and when, as a share of the interval."""
    whole = int(np.floor(latch_ratio))
    return _later(command, whole), _later(command, whole + 1), latch_ratio - whole


@compiled
def _later(command: np.ndarray, count: int) -> np.ndarray:
    """Return commands so many intervals later; beyond both ends stands the nearest one."""
    later = np.empty(command.size)
    for k in range(command.size):
        later[k] = command[min(max(k - count, 0), command.size - 1)]
    return later


def driven(command: np.ndarray, latch_s: float, lag_s: float, period_s: float) -> tuple[np.ndarray, np.ndarray]:
    """Return what a drive makes of held commands: means over parts of intervals (n, parts), values at samples (n,).

    A command takes over `latch_s` after its sample and passes a first-order lag, exactly: with commands averaged over
    parts the current was off by a fiftieth of each step at the next sample, which looks like 40 us of delay.
    """
    now, before, rest = _held(command, latch_s / period_s)
    if not lag_s > 0.0:
        early = before + (now - before) * (1.0 - rest) ** 2
        return with_early(delayed(command, latch_s / period_s), early), np.where(rest > 0.0, before, now)
    starts, at_latch = _relaxing(now, before, rest, lag_s / period_s)
    edges = np.arange(PARTS_COUNT + 1) / PARTS_COUNT
    lag = lag_s / period_s
    turns = np.clip(rest, edges[:-1], edges[1:])
    earlier = np.array([_area(low, turn, 0.0, lag) for low, turn in zip(edges[:-1], turns, strict=True)])
    later = np.array([_area(turn, high, rest, lag) for turn, high in zip(turns, edges[1:], strict=True)])
    means = _relaxed(starts, before, at_latch, now, PARTS_COUNT * earlier, PARTS_COUNT * later)
    weights = np.array([_early_area(0.0, rest, 0.0, lag)]), np.array([_early_area(rest, 1.0, rest, lag)])
    return with_early(means, _relaxed(starts, before, at_latch, now, *weights)[:, 0]), starts


def _relaxing(now: np.ndarray, before: np.ndarray, rest: float, lag: float) -> tuple[np.ndarray, np.ndarray]:
    """Return what a lag (in periods) makes of held commands: at samples, and where each takes over, both (n,)."""
    whole, after = np.exp(-1.0 / lag), np.exp(-(1.0 - rest) / lag)
    gained = now * (1.0 - after) + before * (after - whole)
    ends = np.asarray(lfilter([1.0], [1.0, -whole], gained, zi=[whole * before[0]])[0])
    starts = np.concatenate([before[:1], ends[:-1]])
    return starts, before + (starts - before) * np.exp(-rest / lag)


def driven_later(command: np.ndarray, latch_s: float, lag_s: float, period_s: float, late_s: np.ndarray) -> np.ndarray:
    """Return means over parts of intervals, (n, parts), of what a drive makes when all comes `late_s` (edges,) later.

    late_s: at the n * parts + 1 edges of parts. Exactly: on a line between latches a part of 0.25 ms apart, behind a
    loop of 0.1 ms, a clock that runs 5 ppm fast seemed to make its drive 44 us slower.
    """
    now, before, rest = _held(command, latch_s / period_s)
    lag = max(lag_s / period_s, 0.0)
    starts, at_latch = _relaxing(now, before, rest, lag) if lag > 0.0 else (before, now)
    there = np.arange(now.size * PARTS_COUNT + 1) / PARTS_COUNT - late_s / period_s
    held = _Held(starts, before, at_latch, now, rest, lag)
    return with_early(_between(there, held).reshape(-1, PARTS_COUNT), _early_between(there[::PARTS_COUNT], held))


class _Held(NamedTuple):
    """What goes towards the earlier of two held commands, then towards the one that takes over, in every interval."""

    starts: np.ndarray  # value at the sample, shape (n,)
    before: np.ndarray  # the earlier command, shape (n,)
    at_latch: np.ndarray  # value where the later one takes over, shape (n,)
    now: np.ndarray  # the later command, shape (n,)
    rest: float  # when it takes over, in intervals
    lag: float  # of the way to each, in intervals


@compiled
def _between(edges: np.ndarray, held: _Held) -> np.ndarray:
    """Return means between edges (in periods) of what relaxes towards held commands; its ends are held."""
    n = held.now.size
    impulse = np.zeros(n + 1)
    for k in range(n):
        impulse[k + 1] = impulse[k] + _impulses(1.0, k, held)[0]
    means = np.empty(edges.size - 1)
    earlier = 0.0
    for j in range(edges.size):
        inside = min(max(edges[j], 0.0), float(n))
        k = min(int(inside), n - 1)
        reached = impulse[k] + _impulses(inside - k, k, held)[0]
        reached += (edges[j] - inside) * (held.starts[0] if edges[j] < inside else held.now[n - 1])
        if j > 0:
            means[j - 1] = (reached - earlier) / (edges[j] - edges[j - 1])
        earlier = reached
    return means


@inlined
def _impulses(until: float, k: int, held: _Held) -> tuple[float, float]:
    """Integrate it over one interval, from its sample on: once, and twice."""
    before, now, lag = held.before[k], held.now[k], held.lag
    early, late = min(until, held.rest), max(until - held.rest, 0.0)
    once = before * early + now * late
    twice = before * early * (until - 0.5 * early) + 0.5 * now * late**2
    if lag > 0.0:
        way, faded = (held.starts[k] - before) * lag, np.expm1(-early / lag)
        once -= way * faded
        twice += way * (early - (until - early - lag) * faded)
        way, faded = (held.at_latch[k] - now) * lag, np.expm1(-late / lag)
        once -= way * faded
        twice += way * (late + lag * faded)
    return once, twice


@compiled
def _early_between(edges: np.ndarray, held: _Held) -> np.ndarray:
    """Return means that are weighted towards the start between edges (in periods) of the same."""
    n = held.now.size
    early = np.empty(edges.size - 1)
    for j in range(early.size):
        begin, end = edges[j], edges[j + 1]
        ahead = min(end, 0.0)
        total = held.starts[0] * (end - 0.5 * (begin + ahead)) * (ahead - begin) if begin < 0.0 else 0.0
        total += 0.5 * held.now[n - 1] * (end - max(begin, float(n))) ** 2 if end > n else 0.0
        inside, until = min(max(begin, 0.0), float(n)), min(max(end, 0.0), float(n))
        for k in range(int(inside), min(int(until), n - 1) + 1):
            low, high = max(inside - k, 0.0), min(until - k, 1.0)
            (at_low, twice_at_low), (at_high, twice_at_high) = _impulses(low, k, held), _impulses(high, k, held)
            total += (end - k - high) * (at_high - at_low)
            total += twice_at_high - twice_at_low - (high - low) * at_low
        early[j] = 2.0 * total / (end - begin) ** 2
    return early


def at_delays(made: Callable[[float], np.ndarray], latch_s: float, late_s: np.ndarray, period_s: float) -> np.ndarray:
    """Return `made` of a latch that is later by what each interval has, on that interval.

    Between latches at the parts' borders on a straight line: exact for a step, not for what rises in less than a part.
    """
    part_s = period_s / PARTS_COUNT
    at = (latch_s + late_s) / part_s
    low = np.floor(at).astype(int)
    share = at - low
    out = np.zeros((late_s.size, PARTS_COUNT))
    for node in range(int(low.min()), int(low.max()) + 2):
        weight = np.where(low == node, 1.0 - share, 0.0) + np.where(low + 1 == node, share, 0.0)
        here = weight > 0.0
        if np.any(here):
            out[here] += weight[here, None] * made(node * part_s)[here]
    return out


def _area(low: float, high: float, origin: float, lag: float) -> tuple[float, float]:
    """Integrate goal + (start - goal) exp(-(s - origin) / lag) from low to high: (what goal counts, start - goal)."""
    if not high > low:
        return 0.0, 0.0
    return high - low, lag * (np.exp(-(low - origin) / lag) - np.exp(-(high - origin) / lag))


def _early_area(low: float, high: float, origin: float, lag: float) -> tuple[float, float]:
    """Integrate 2 (1 - s) times the same."""
    from_low, from_high = np.exp(-(low - origin) / lag), np.exp(-(high - origin) / lag)
    way = lag * ((1.0 - low - lag) * from_low - (1.0 - high - lag) * from_high)
    return (1.0 - low) ** 2 - (1.0 - high) ** 2, 2.0 * way


@compiled
def _relaxed(
    starts: np.ndarray,
    before: np.ndarray,
    at_latch: np.ndarray,
    now: np.ndarray,
    earlier: np.ndarray,
    later: np.ndarray,
) -> np.ndarray:
    """Return means over parts, (n, parts), of what goes towards the earlier command, then towards the one that is now.

    earlier, later: by part, what the goal counts and what the way to it.
    """
    means = np.empty((now.size, earlier.shape[0]))
    for k in range(now.size):
        for part in range(earlier.shape[0]):
            means[k, part] = (
                before[k] * earlier[part, 0] + (starts[k] - before[k]) * earlier[part, 1]
                + now[k] * later[part, 0] + (at_latch[k] - now[k]) * later[part, 1]
            )  # fmt: skip
    return means


def made_by(
    acting: Sequence[Acting],
    command_n: np.ndarray,
    constant_n_per_a: float,
    latch_s: float,
    lag_s: float,
    period_s: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Return what a drive with effects of its command path makes of commands, N, as `driven` has it."""
    changed_n, others = at_once(acting, command_n, constant_n_per_a, period_s)
    means_n, at_samples_n = driven(changed_n, latch_s, lag_s, period_s)
    for effect, parameters in others:
        added_a, at_a = changed_by(effect, parameters, command_n / constant_n_per_a, latch_s, lag_s, period_s)
        means_n, at_samples_n = means_n + constant_n_per_a * added_a, at_samples_n + constant_n_per_a * at_a
    return means_n, at_samples_n


def at_once(
    acting: Sequence[Acting], command_n: np.ndarray, constant_n_per_a: float, period_s: float
) -> tuple[np.ndarray, list[Acting]]:
    """Return commands with what effects without memory make of them, and the other effects."""
    changed_n, others = command_n, []
    for effect, parameters in acting:
        if effect.memory:
            others.append((effect, parameters))
        else:
            added_a = _run(effect, parameters, (command_n / constant_n_per_a)[:, None], 0.0, period_s)[:, 0]
            changed_n = changed_n + constant_n_per_a * added_a
    return changed_n, others


def changed_by(
    effect: Effect, parameters: list[float], command: np.ndarray, latch_s: float, lag_s: float, period_s: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return what an effect adds to a drive's answer to held commands: means over parts (n, parts), at samples (n,).

    Effects that are neither linear nor without memory are run on means over parts of intervals.
    """
    if not effect.memory:
        return driven(_run(effect, parameters, command[:, None], lag_s, period_s)[:, 0], latch_s, lag_s, period_s)
    response = _step_response(effect, parameters, lag_s, period_s, 1.0)
    doubled = _step_response(effect, parameters, lag_s, period_s, 2.0)
    if doubled.size == response.size and np.allclose(doubled, 2.0 * response, rtol=_SAME_RATIO, atol=_SAME_RATIO):
        return _stepped(response, command, latch_s, lag_s, period_s)
    fine = _run(effect, parameters, delayed(command, latch_s / period_s), lag_s, period_s)
    return lagged(fine, lag_s, period_s)


def behind(
    more_s: float, command: np.ndarray, latch_s: float, lag_s: float, period_s: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return what one more lag behind a drive adds to its answer to held commands, as `changed_by` has it."""
    response = _step_response(_LAG, [more_s], 0.0, period_s, 1.0)
    return _stepped(response, command, latch_s, lag_s, period_s)


def _run(effect: Effect, parameters: list[float], command: np.ndarray, lag_s: float, period_s: float) -> np.ndarray:
    """Run an effect along held commands on equal parts of intervals, shape (n, parts); shape kept."""
    parts = command.shape[1]
    dt_s = period_s / parts
    times_s = (np.arange(command.size) * dt_s).reshape(command.shape)
    known = {"command_a": command, "t_s": times_s, "dt_s": np.full(command.shape, dt_s)}
    known["current_loop_s"] = np.full(command.shape, lag_s)
    columns = tuple(np.require(known[name], np.float64, ["C", "W"]).ravel() for name in effect.quantities)
    out = compose.along_one_machine(effect)(columns, np.array([*parameters, 0.0]), np.zeros(max(effect.memory, 1)))
    return np.asarray(out).reshape(command.shape)


def _step_response(effect: Effect, parameters: list[float], lag_s: float, period_s: float, height: float) -> np.ndarray:
    """Return what an effect adds to a step of its command, means over steps of a fine grid; not to be written to."""
    return _response(effect.name, effect.origin, tuple(parameters), lag_s, period_s, height)


@functools.lru_cache(maxsize=64)
def _response(
    name: str,
    _origin: str,  # a user's law may have another text the next time
    parameters: tuple[float, ...],
    lag_s: float,
    period_s: float,
    height: float,
) -> np.ndarray:
    """Make it: all recordings of one machine ask for the same."""
    out = np.zeros(1)
    for periods in _RESPONSE_PERIODS:
        command = np.full((round(periods / _STEP_RATIO) + 1, 1), height)
        command[0] = 0.0  # an effect may take the first command that it sees for one that was always there
        out = _run(CATALOGUE[name], list(parameters), command, lag_s, _STEP_RATIO * period_s)[1:, 0]
        there = np.flatnonzero(np.abs(out) > _FADED * np.max(np.abs(out)))
        if not there.size:
            return out[:1]
        if there[-1] + 1 < out.size:
            return out[: there[-1] + 2]
    return out


def _stepped(
    response: np.ndarray, command: np.ndarray, latch_s: float, lag_s: float, period_s: float
) -> tuple[np.ndarray, np.ndarray]:
    """Sum step responses, each passed through the current loop and begun where its command is taken over."""
    dt_s = _STEP_RATIO * period_s
    early = max(-int(np.floor(latch_s / period_s)), 0)  # periods by which a command acts before its own sample
    latch_s += early * period_s
    fading = np.concatenate([response, np.zeros(int(np.ceil(_FADING_LAGS * lag_s / dt_s)))])
    decay = float(np.exp(-dt_s / lag_s)) if lag_s > 0.0 else 0.0
    after = np.asarray(lfilter([1.0 - decay], [1.0, -decay], fading))
    # of a first-order lag: the area of what goes in, less what is still to come out
    area_s = np.concatenate([[0.0], np.cumsum(fading) * dt_s - lag_s * after])
    grid_s = np.arange(area_s.size) * dt_s
    periods = int(np.ceil((latch_s + grid_s[-1]) / period_s)) + 1
    edges_s = np.arange(periods * PARTS_COUNT + 1) * period_s / PARTS_COUNT - latch_s
    areas = np.interp(edges_s, grid_s, area_s, left=0.0, right=float(area_s[-1]))
    kernel = np.diff(areas).reshape(periods, PARTS_COUNT) * (PARTS_COUNT / period_s)
    grid_s, area_s = np.append(grid_s, edges_s[-1] + dt_s), np.append(area_s, area_s[-1])
    twice_s2 = np.concatenate([[0.0], np.cumsum(0.5 * (area_s[1:] + area_s[:-1]) * np.diff(grid_s))])
    twice_s2 = np.interp(edges_s[::PARTS_COUNT], grid_s, twice_s2, left=0.0)
    kernel = with_early(kernel, 2.0 * (np.diff(twice_s2) / period_s - areas[:-1:PARTS_COUNT]) / period_s)
    at_samples = np.interp(np.arange(periods) * period_s - latch_s, grid_s[1:-1], after, left=0.0, right=0.0)
    steps = np.diff(command[np.minimum(np.arange(command.size) + early, command.size - 1)], prepend=command[0])
    means = np.stack([np.convolve(steps, kernel[:, part])[: command.size] for part in range(PARTS_COUNT)], axis=1)
    return means, np.convolve(steps, at_samples)[: command.size]


def lagged(fine: np.ndarray, lag_s: float, period_s: float) -> tuple[np.ndarray, np.ndarray]:
    """Pass held values on parts through a first-order lag: means over parts (n, parts), values at samples (n,)."""
    dt_s = period_s / fine.shape[1]
    flat = fine.ravel()
    decay = float(np.exp(-dt_s / lag_s)) if lag_s > 0.0 else 0.0
    ends = lfilter([1.0 - decay], [1.0, -decay], flat, zi=[decay * flat[0]])[0]
    starts = np.concatenate([[flat[0]], ends[:-1]]).reshape(fine.shape)
    if lag_s <= 0.0:
        return fine, starts[:, 0]
    mean_share = -float(np.expm1(-dt_s / lag_s)) * lag_s / dt_s
    return fine + (starts - fine) * mean_share, starts[:, 0]
