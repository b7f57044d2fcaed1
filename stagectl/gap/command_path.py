"""What a drive and the effects of its command path make of held commands, exactly, on parts of sample intervals.

A command is held for a period and taken over some time after its sample, within a part of an interval. An effect run on
means over parts smears that step: a delay of 102 us came out as one of 38 us and a lag (measured on data that hold a
delay alone). So a linear effect is its step response, put at every step of the commands where it happens; one without
memory changes the commands themselves. Pure.
"""

import numpy as np
from scipy.signal import lfilter

from stagectl import compose
from stagectl.compiled import compiled
from stagectl.effects import CATALOGUE, Effect

PARTS_COUNT = 4
"""Parts of a sample interval: friction on whole milliseconds left 57 times its noise, on quarters 8 (prototype)."""

_STEP_RATIO = 1.0 / 1024.0  # of a period: the grid of step responses
_RESPONSE_PERIODS = (16, 256)  # of a step response: the second where it has not faded within the first
_FADING_LAGS = 12.0
_FADED = 1e-6  # of the greatest part of a step response: all behind it is left out
_SAME_RATIO = 1e-9
_LAG = CATALOGUE["current_loop_lag"]


def delayed(command: np.ndarray, latch_ratio: float, parts: int = PARTS_COUNT) -> np.ndarray:
    """Return a held command on parts of intervals, (n, parts): it takes over `latch_ratio` periods after its sample.

    Before the first command acts the first is taken.
    """
    now, before, rest = _held(command, latch_ratio)
    edges = np.arange(parts + 1) / parts
    late = np.clip((rest - edges[:-1]) * parts, 0.0, 1.0)  # share of a part in which the earlier still acts
    return before[:, None] * late[None, :] + now[:, None] * (1.0 - late)[None, :]


def _held(command: np.ndarray, latch_ratio: float) -> tuple[np.ndarray, np.ndarray, float]:
    """Return, by interval, the command that takes over, the one before, and when, as a share of the interval."""
    whole = int(np.floor(latch_ratio))
    index = np.arange(command.size) - whole
    last = command.size - 1
    return command[np.clip(index, 0, last)], command[np.clip(index - 1, 0, last)], latch_ratio - whole


def driven(command: np.ndarray, latch_s: float, lag_s: float, period_s: float) -> tuple[np.ndarray, np.ndarray]:
    """Return what a drive makes of held commands: means over parts of intervals (n, parts), values at samples (n,).

    A command takes over `latch_s` after its sample and passes a first-order lag, exactly: with commands averaged over
    parts the current was off by a fiftieth of each step at the next sample, which looks like 40 us of delay.
    """
    now, before, rest = _held(command, latch_s / period_s)
    if not lag_s > 0.0:
        held = delayed(command, latch_s / period_s)
        return held, np.where(rest > 0.0, before, now)
    latch, whole = np.exp(-rest * period_s / lag_s), np.exp(-period_s / lag_s)
    after = np.exp(-(1.0 - rest) * period_s / lag_s)
    gained = now * (1.0 - after) + before * (after - whole)
    ends = np.asarray(lfilter([1.0], [1.0, -whole], gained, zi=[whole * command[0]])[0])
    starts = np.concatenate([command[:1], ends[:-1]])
    at_latch = before + (starts - before) * latch
    edges = np.arange(PARTS_COUNT + 1) / PARTS_COUNT
    lag = lag_s / period_s
    turns = np.clip(rest, edges[:-1], edges[1:])
    earlier = np.array([_area(low, turn, 0.0, lag) for low, turn in zip(edges[:-1], turns, strict=True)])
    later = np.array([_area(turn, high, rest, lag) for turn, high in zip(turns, edges[1:], strict=True)])
    return _relaxed(starts, before, at_latch, now, PARTS_COUNT * earlier, PARTS_COUNT * later), starts


def _area(low: float, high: float, origin: float, lag: float) -> tuple[float, float]:
    """Integrate goal + (start - goal) exp(-(s - origin) / lag) from low to high: (what goal counts, start - goal)."""
    if not high > low:
        return 0.0, 0.0
    return high - low, lag * (np.exp(-(low - origin) / lag) - np.exp(-(high - origin) / lag))


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
    columns = np.column_stack([known[name].ravel() for name in effect.quantities])
    out = compose.along_one_machine(effect)(columns, np.array([*parameters, 0.0]), np.zeros(max(effect.memory, 1)))
    return np.asarray(out).reshape(command.shape)


def _step_response(effect: Effect, parameters: list[float], lag_s: float, period_s: float, height: float) -> np.ndarray:
    """Return what an effect adds to a step of its command, means over steps of a fine grid."""
    out = np.zeros(1)
    for periods in _RESPONSE_PERIODS:
        command = np.full((round(periods / _STEP_RATIO) + 1, 1), height)
        command[0] = 0.0  # an effect may take the first command that it sees for one that was always there
        out = _run(effect, parameters, command, lag_s, _STEP_RATIO * period_s)[1:, 0]
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
    at_samples = np.interp(np.arange(periods) * period_s - latch_s, grid_s[1:], after, left=0.0, right=0.0)
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
