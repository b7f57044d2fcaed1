"""When a sample was taken, on the host's clock, from the times at which its line became readable.

    arrival[k] = a + (period + b) k + transport + delay[k],    delay[k] >= 0

The sensor's clock is a straight line of unknown offset a and rate b; nothing arrives early, so the line lies below
every arrival. Only the lower convex hull of (k, arrival) can touch it, about 2 ln N points. With exponential delays of
mean mu the likelihood of a line below all N points is proportional to exp(N height / mu), height being the line's at
the mean abscissa: its maximum is the hull edge under the mean (a linear program), which lies late by the least excess.
The estimate is the mean of that likelihood instead: over a in closed form, over b a sum of exponentials per hull edge.
It is unbiased, of least variance (Pitman 1939), and gives its own uncertainty. mu is the mean excess over the edge.

Two windows run, one half a turn behind the other, so that the line follows a wandering crystal: the older counts, and
starts anew when it is two windows long.

Times are integers; all arithmetic is on differences to the window's first arrival. Knows no bytes and no clock.
"""

import math

import numpy as np

from stagectl.compiled import compiled

HULL = 64
"""Vertices kept per window; N random delays make about 2 ln N (20 for 60 s at 1 kHz)."""

_JUDGE_AFTER = 500
"""Samples in the window before an arrival can be called impossible."""
_EARLY_IN_A_ROW = 50
_LATE_IN_A_ROW = 1000
_FAST_SHARE = 0.005
"""Of a period: an arrival so much earlier than the line allows is a new lowest one. Delays can't be below nothing, so
behind the first few hundred there is none, but for a constant part that changed, and a clock that is fast."""
_FAST_COUNT, _FAST_FADES = 5.0, 0.005
"""Of them, and by how much each other arrival lessens the count: 0.3 % fast makes one of 20 arrivals such a one."""
_CALM_IN_A_ROW = 100
"""Arrivals without one before a clock that was fast is taken up anew. Kept on, its line was bent within the tolerance:
0.8 % for 0.27 s had it 2 ms off 6 s later, and a loop that went by it rang at full force."""
_LATE_MEANS = 8.0
"""Excess in mean delays that is an outlier of the host, not of the transport."""

CLOCK = np.dtype(
    [
        ("period_ns", "f8"),  # nominal
        ("transport_ns", "f8"),  # constant part of the way
        ("window_ns", "f8"),
        ("tolerance_ns", "f8"),  # |rate error| allowed, per sample
        ("grid_ns", "f8"),  # spacing of the arrivals where the transport bundles them, else 0
        ("samples", "i8"),  # used since init; 0 = no line yet
        ("sequence", "i8"),  # newest
        ("sample_t_ns", "i8"),  # its instant: whole ns ...
        ("sample_fraction_ns", "f8"),  # ... and the rest, within -0.5 .. 0.5
        ("slope_ns", "f8"),  # period minus nominal period
        ("delay_ns", "f8"),  # mean excess delay
        ("deviation_ns", "f8"),  # standard deviation of the instant
        ("rate_at_limit", "i8"),  # 1: the best rate is outside the tolerance; wrong rate_hz or the wrong sensor
        ("restarts", "i8"),  # sequence went back, or the clock jumped
        ("early", "i8"),  # arrivals left out: before their sample could be there
        ("late", "i8"),  # arrivals left out of the mean delay
        ("early_in_a_row", "i8"),
        ("late_in_a_row", "i8"),
        ("fast", "f8"),  # arrivals that were each the lowest, less a share of the others
        ("was_fast", "i8"),  # there were too many of them: the line is bent
        ("calm_in_a_row", "i8"),  # arrivals since the last of them
        ("active", "i8"),  # window that counts
        ("origin_sequence", "i8", (2,)),
        ("origin_t_ns", "i8", (2,)),
        ("count", "f8", (2,)),
        ("sum_x", "f8", (2,)),
        ("sum_y", "f8", (2,)),
        ("size", "i8", (2,)),
        ("hull_x", "f8", (2, HULL)),
        ("hull_y", "f8", (2, HULL)),
    ]
)
"""State of one sensor's clock."""


def init(
    nominal_period_ns: float,
    transport_ns: float,
    window_s: float = 20.0,
    tolerance_ppm: float = 200.0,
    grid_ns: float = 0.0,
) -> np.ndarray:
    """State before the first sample. The line in use is window_s to 2 window_s long once that much was seen."""
    state = np.zeros(1, CLOCK)
    state["period_ns"] = nominal_period_ns
    state["transport_ns"] = transport_ns
    state["window_ns"] = window_s * 1e9
    state["tolerance_ns"] = tolerance_ppm * 1e-6 * nominal_period_ns
    state["grid_ns"] = grid_ns
    return state


@compiled
def _start_window(state: np.ndarray, w: int, sequence: int, arrival_t_ns: int) -> None:
    s = state[0]
    s.origin_sequence[w] = sequence
    s.origin_t_ns[w] = arrival_t_ns
    s.count[w] = 0.0
    s.sum_x[w] = 0.0
    s.sum_y[w] = 0.0
    s.size[w] = 0


@compiled
def _restart(state: np.ndarray, sequence: int, arrival_t_ns: int) -> None:
    s = state[0]
    s.samples = 0
    s.active = 0
    s.early_in_a_row = 0
    s.late_in_a_row = 0
    s.fast = 0.0
    s.was_fast = 0
    s.slope_ns = 0.0
    _start_window(state, 0, sequence, arrival_t_ns)
    s.size[1] = -1  # not running yet


@compiled
def _add(state: np.ndarray, w: int, x: float, y: float, counts: bool) -> None:
    """Put a point on the right end of a window's lower hull."""
    s = state[0]
    if counts:
        s.count[w] += 1.0
        s.sum_x[w] += x
        s.sum_y[w] += y
    hull_x = s.hull_x[w]
    hull_y = s.hull_y[w]
    m = s.size[w]
    while m >= 2 and (hull_y[m - 1] - hull_y[m - 2]) * (x - hull_x[m - 2]) >= (y - hull_y[m - 2]) * (
        hull_x[m - 1] - hull_x[m - 2]
    ):
        m -= 1
    if m == HULL:
        # Only a clock that speeds up without any noise gets here; the flattest corner says least.
        flattest = 1
        least = math.inf
        for i in range(1, HULL - 1):
            area = (hull_x[i] - hull_x[i - 1]) * (hull_y[i + 1] - hull_y[i])
            area -= (hull_x[i + 1] - hull_x[i]) * (hull_y[i] - hull_y[i - 1])
            if area < least:
                least = area
                flattest = i
        for i in range(flattest, HULL - 1):
            hull_x[i] = hull_x[i + 1]
            hull_y[i] = hull_y[i + 1]
        m -= 1
    hull_x[m] = x
    hull_y[m] = y
    s.size[w] = m + 1


@compiled
def _solve(state: np.ndarray, w: int, x: float) -> float:
    """Write slope, delay and deviation; return the line's height at x, in ns after the window's own zero."""
    s = state[0]
    hull_x = s.hull_x[w]
    hull_y = s.hull_y[w]
    m = s.size[w]
    n = s.count[w]
    mean_x = s.sum_x[w] / n
    tolerance = s.tolerance_ns
    # The linear program: the edge under the mean abscissa, its rate within the tolerance.
    j = 0
    best = 0.0
    s.rate_at_limit = 0
    if m > 1:
        while j < m - 2 and hull_x[j + 1] < mean_x:
            j += 1
        best = (hull_y[j + 1] - hull_y[j]) / (hull_x[j + 1] - hull_x[j])
        if not -tolerance <= best <= tolerance:
            best = tolerance if best > 0.0 else -tolerance
            s.rate_at_limit = 1
    height = hull_y[0] - best * hull_x[0]
    for i in range(1, m):
        height = min(height, hull_y[i] - best * hull_x[i])
    here = height + best * x
    delay = max((s.sum_y[w] - n * (height + best * mean_x)) / max(n - 2.0, 1.0), 1.0)
    rate = n / delay
    # Moments of the likelihood over b, edge by edge: on each the exponent is linear in b.
    low = -tolerance
    weight = 0.0
    first = 0.0
    second = 0.0
    slope = 0.0
    top = height + best * mean_x
    for i in range(m):
        high = tolerance
        if i < m - 1:
            high = min((hull_y[i + 1] - hull_y[i]) / (hull_x[i + 1] - hull_x[i]), tolerance)
        if high <= low:
            continue
        c = rate * (mean_x - hull_x[i])
        g = rate * (hull_y[i] + low * (mean_x - hull_x[i]) - top)
        width = high - low
        u = c * width
        if max(g, g + u) > -40.0:
            if abs(u) < 1e-3:
                e = math.exp(g)
                i0 = e * width * (1.0 + u / 2.0 + u * u / 6.0)
                i1 = e * width * width * (0.5 + u / 3.0 + u * u / 8.0)
                i2 = e * width * width * width * (1.0 / 3.0 + u / 4.0 + u * u / 10.0)
            else:
                e0 = math.exp(g)
                e1 = math.exp(g + u)
                i0 = (e1 - e0) / c
                i1 = (width * e1 - i0) / c
                i2 = (width * width * e1 - 2.0 * i1) / c
            p = hull_y[i] + low * (x - hull_x[i]) - here
            q = x - hull_x[i]
            weight += i0
            first += p * i0 + q * i1
            second += p * p * i0 + 2.0 * p * q * i1 + q * q * i2
            slope += low * i0 + i1
        low = high
        if low >= tolerance:
            break
    s.delay_ns = delay
    if not weight > 0.0:
        s.slope_ns = best
        s.deviation_ns = 1.0 / rate
        return here - 1.0 / rate
    mean = first / weight
    s.slope_ns = slope / weight
    variance = max(second / weight - mean * mean, 0.0) + 1.0 / (rate * rate)
    if s.grid_ns > 0.0:
        # Bundled arrivals touch the line only when the sample's phase has swept the grid.
        swept = abs(s.slope_ns) * (x - hull_x[0]) / min(s.grid_ns, s.period_ns)
        variance += min(s.grid_ns, s.period_ns) ** 2 / 12.0 / max(swept * swept, 1.0)
    s.deviation_ns = math.sqrt(variance)
    return here + mean - 1.0 / rate


@compiled
def step(state: np.ndarray, sequence: int, arrival_t_ns: int) -> None:
    """Take a sample's number and the time at which it became readable; a number that goes back starts anew."""
    s = state[0]
    if s.samples == 0:
        _restart(state, sequence, arrival_t_ns)
    elif sequence == s.sequence:
        return
    elif sequence < s.sequence:
        s.restarts += 1
        _restart(state, sequence, arrival_t_ns)

    # Where the newest line expects this arrival at the earliest.
    counts = True
    if s.count[s.active] >= _JUDGE_AFTER:
        expected = (sequence - s.sequence) * (s.period_ns + s.slope_ns) + s.sample_fraction_ns + s.transport_ns
        excess = (arrival_t_ns - s.sample_t_ns) - expected
        if excess < -0.5 * s.period_ns:
            # A wrong sequence number would poison the envelope; a clock that jumped stays away.
            s.early += 1
            s.early_in_a_row += 1
            s.calm_in_a_row = 0
            if s.early_in_a_row < _EARLY_IN_A_ROW:
                return
            s.restarts += 1
            _restart(state, sequence, arrival_t_ns)
        elif excess > max(_LATE_MEANS * s.delay_ns, 0.5 * s.period_ns):
            s.late += 1
            s.late_in_a_row += 1
            s.early_in_a_row = 0
            counts = False
            if s.late_in_a_row >= _LATE_IN_A_ROW:
                s.restarts += 1
                _restart(state, sequence, arrival_t_ns)
                counts = True
        else:
            s.early_in_a_row = 0
            s.late_in_a_row = 0
            is_lowest = excess < -_FAST_SHARE * s.period_ns
            s.fast = s.fast + 1.0 if is_lowest else max(s.fast - _FAST_FADES, 0.0)
            s.was_fast = 1 if s.fast > _FAST_COUNT else s.was_fast
            s.calm_in_a_row = 0 if is_lowest else s.calm_in_a_row + 1
            if s.was_fast and s.calm_in_a_row >= _CALM_IN_A_ROW:
                s.restarts += 1
                _restart(state, sequence, arrival_t_ns)

    for w in range(2):
        if s.size[w] < 0:
            if (sequence - s.origin_sequence[0]) * s.period_ns < s.window_ns:
                continue
            _start_window(state, w, sequence, arrival_t_ns)
        x = float(sequence - s.origin_sequence[w])
        if x * s.period_ns >= 2.0 * s.window_ns:
            # Behind a gap this long early in a session the other does not run yet: then this one counts, begun anew.
            s.active = 1 - w if s.size[1 - w] > 0 else w
            _start_window(state, w, sequence, arrival_t_ns)
            x = 0.0
        y = float(arrival_t_ns - s.origin_t_ns[w]) - x * s.period_ns - s.transport_ns
        _add(state, w, x, y, counts or s.count[w] == 0.0)

    w = s.active
    x = float(sequence - s.origin_sequence[w])
    offset = x * s.period_ns + _solve(state, w, x)
    whole = np.int64(math.floor(offset + 0.5))
    s.sequence = sequence
    s.sample_t_ns = s.origin_t_ns[w] + whole
    s.sample_fraction_ns = offset - whole
    s.samples += 1


@compiled
def sample_t_ns(state: np.ndarray, sequence: int) -> int:
    """Instant of sample `sequence` on the host's clock, int64 ns; also of one to come. Needs one sample."""
    s = state[0]
    ahead = (sequence - s.sequence) * (s.period_ns + s.slope_ns) + s.sample_fraction_ns
    return s.sample_t_ns + np.int64(math.floor(ahead + 0.5))


@compiled
def sample_age_ns(state: np.ndarray, sequence: int, t_ns: int) -> float:
    """t_ns minus the instant of sample `sequence`, float64 with its part of a nanosecond."""
    s = state[0]
    return float(t_ns - s.sample_t_ns) - (sequence - s.sequence) * (s.period_ns + s.slope_ns) - s.sample_fraction_ns


@compiled
def sample_at(state: np.ndarray, sequence: int, t_ns: int) -> tuple[int, float]:
    """(sample_t_ns, sample_age_ns) in one call: calling compiled code costs a cycle more than what it does."""
    return sample_t_ns(state, sequence), sample_age_ns(state, sequence, t_ns)


@compiled
def clock_rate_ppm(state: np.ndarray) -> float:
    """How much the sensor's samples come too fast against the host's clock, in ppm (slow is negative)."""
    s = state[0]
    return (s.period_ns / (s.period_ns + s.slope_ns) - 1.0) * 1e6


@compiled
def uncertainty_s(state: np.ndarray) -> float:
    """Standard deviation of the newest sample's instant, in s; infinite before the first sample.

    Holds for delays that fall freely; where arrivals are bundled `grid_ns` must say so.
    """
    s = state[0]
    if s.samples == 0:
        return np.inf
    return s.deviation_ns * 1e-9
