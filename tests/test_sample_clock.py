"""The recovered sample instant against a simulated sensor clock; virtual time only."""

import numpy as np
import pytest

from drivers import sample_clock
from stagectl.compiled import compiled

BOOT_NS = 2_600_000_000_000_007  # a host that is up for a month: float64 has 0.5 ns there
PERIOD_NS = 1e6
TRANSPORT_NS = 150e3


@compiled
def play(state, sequences, arrivals_t_ns, sample_t_ns, fraction_ns, deviation_ns):
    for k in range(len(sequences)):
        sample_clock.step(state, sequences[k], arrivals_t_ns[k])
        sample_t_ns[k] = state[0].sample_t_ns
        fraction_ns[k] = state[0].sample_fraction_ns
        deviation_ns[k] = state[0].deviation_ns


def sensor(seed, count, *, rate_ppm=-20.0, delay_ns=60e3, grid_ns=0.0, drift_per_s=0.0):
    """True instants (float, from BOOT_NS) and arrivals (int64) of `count` samples."""
    rng = np.random.default_rng(seed)
    k = np.arange(count)
    t_s = k * PERIOD_NS * 1e-9
    true_ns = k * PERIOD_NS * (1.0 - rate_ppm * 1e-6) + rng.uniform(0.0, PERIOD_NS) + 0.5e9 * drift_per_s * t_s**2
    arrival_ns = true_ns + TRANSPORT_NS + rng.exponential(delay_ns, count)
    if grid_ns:
        phase_ns = rng.uniform(0.0, grid_ns)
        arrival_ns = np.ceil((arrival_ns - phase_ns) / grid_ns) * grid_ns + phase_ns
    return true_ns, np.round(np.maximum.accumulate(arrival_ns)).astype(np.int64) + BOOT_NS


def recover(state, sequences, arrivals_t_ns):
    """Recovered instants from BOOT_NS and their stated deviations, in ns."""
    count = len(sequences)
    whole, fraction, deviation = np.zeros(count, np.int64), np.zeros(count), np.zeros(count)
    play(state, sequences, arrivals_t_ns, whole, fraction, deviation)
    return (whole - BOOT_NS) + fraction, deviation


def errors_ns(seeds, count, window_s=60.0, **kind):
    errors, deviations = [], []
    for seed in range(seeds):
        true_ns, arrivals_t_ns = sensor(seed, count, **kind)
        state = sample_clock.init(PERIOD_NS, TRANSPORT_NS, window_s, grid_ns=kind.get("grid_ns", 0.0))
        recovered_ns, deviation_ns = recover(state, np.arange(count), arrivals_t_ns)
        errors.append((recovered_ns - true_ns)[2000:])
        deviations.append(deviation_ns[2000:])
    return np.array(errors), np.array(deviations)


def rms(values):
    return float(np.sqrt(np.mean(np.square(values))))


def test_line_transport():
    """The bar is 0.15 us; exponential delays of 60 us over 2 .. 10 s allow about 0.05 us."""
    errors, deviations = errors_ns(20, 10_000)
    assert 20.0 < rms(errors) < 80.0
    assert rms(errors[:, 0]) < 150.0  # already at 2 s
    assert abs(np.mean(errors)) < 15.0  # the least excess is corrected for
    assert 0.7 < rms(errors / deviations) < 1.4  # the stated uncertainty is the true one


def test_windows_in_turn_stay_as_good():
    errors, _ = errors_ns(4, 60_000, window_s=10.0)
    assert rms(errors[:, 18_000:]) < 30.0


def test_wandering_crystal_is_followed():
    """0.06 ppm a minute: a line of 20 s follows it, one of 120 s would not (about 1 us)."""
    errors, _ = errors_ns(4, 100_000, window_s=10.0, drift_per_s=1e-9)
    assert rms(errors) < 60.0
    errors, _ = errors_ns(4, 100_000, window_s=60.0, drift_per_s=1e-9)
    assert rms(errors) > 300.0


@pytest.mark.parametrize(("grid_ns", "below_ns"), [(125e3, 30e3), (16e6, 600e3)], ids=["usb-125us", "ftdi-16ms"])
def test_bundled_arrivals(grid_ns, below_ns):
    """Bundles hide the phase until it has swept their grid; the stated uncertainty must not hide that."""
    errors, deviations = errors_ns(6, 30_000, grid_ns=grid_ns)
    assert rms(errors) < below_ns
    assert rms(errors / deviations) < 2.5


def test_perfect_transport_is_recovered_to_the_rounding():
    true_ns, arrivals_t_ns = sensor(1, 5000, delay_ns=0.0)
    recovered_ns, _ = recover(sample_clock.init(PERIOD_NS, TRANSPORT_NS), np.arange(5000), arrivals_t_ns)
    assert np.abs(recovered_ns - true_ns)[100:].max() < 2.0


def test_speeding_clock_without_noise_keeps_memory_bounded():
    """Every arrival is a hull vertex here."""
    true_ns, arrivals_t_ns = sensor(1, 5000, delay_ns=0.0, drift_per_s=1e-6)
    recovered_ns, _ = recover(sample_clock.init(PERIOD_NS, TRANSPORT_NS), np.arange(5000), arrivals_t_ns)
    assert np.abs(recovered_ns - true_ns)[100:].max() < 20e3


def test_gaps_do_no_harm():
    true_ns, arrivals_t_ns = sensor(3, 12_000)
    kept = np.random.default_rng(0).random(12_000) > 0.3
    kept[5000:7000] = False
    recovered_ns, _ = recover(sample_clock.init(PERIOD_NS, TRANSPORT_NS), np.flatnonzero(kept), arrivals_t_ns[kept])
    assert rms((recovered_ns - true_ns[kept])[2000:]) < 150.0


@pytest.mark.parametrize("before", [1, 2, 400, 12_000])
@pytest.mark.parametrize("lost", [39_000, 41_000, 200_000])
def test_a_gap_of_minutes_early_in_a_session_is_gone_over(before, lost):
    """Two windows long, and the second window not running yet."""
    true_ns, arrivals_t_ns = sensor(11, before + lost + 4000)
    kept = np.r_[0:before, before + lost : true_ns.size]
    state = sample_clock.init(PERIOD_NS, TRANSPORT_NS)
    recovered_ns, deviation_ns = recover(state, kept, arrivals_t_ns[kept])
    assert np.all(np.isfinite(recovered_ns))
    assert np.all(np.isfinite(deviation_ns))
    assert rms((recovered_ns - true_ns[kept])[-2000:]) < 200.0


@pytest.mark.parametrize("seed", range(20))
def test_whatever_arrives_the_instant_is_a_number(seed):
    """Gaps, restarts, bursts, silence and bundles of any length."""
    rng = np.random.default_rng(seed)
    for _ in range(50):
        count = int(rng.integers(2, 600))
        steps = np.ones(count, np.int64)
        odd = rng.random(count) < rng.choice([0.0, 0.01, 0.3])
        steps[odd] = (10.0 ** rng.uniform(0.0, rng.choice([3.0, 6.0, 9.0]), odd.sum())).astype(np.int64)
        steps[rng.random(count) < rng.choice([0.0, 0.01])] *= -1
        sequences = np.maximum(np.cumsum(steps), 0)
        waits_ns = [rng.exponential(PERIOD_NS, count), steps * PERIOD_NS, 10.0 ** rng.uniform(0.0, 12.0, count)]
        bundle_ns = rng.choice([1.0, 1e9])
        arrivals_ns = np.floor(np.maximum.accumulate(np.cumsum(waits_ns[rng.integers(3)])) / bundle_ns) * bundle_ns
        state = sample_clock.init(PERIOD_NS, TRANSPORT_NS, rng.choice([0.2, 20.0]), grid_ns=rng.choice([0.0, 1e6]))
        recovered_ns, deviation_ns = recover(state, sequences, arrivals_ns.astype(np.int64) + BOOT_NS)
        assert np.all(np.isfinite(recovered_ns))
        assert np.all(deviation_ns > 0.0)
        assert np.isfinite(state["slope_ns"][0])
        assert np.isfinite(state["delay_ns"][0])


def test_restart_of_the_sequence_starts_anew():
    true_ns, arrivals_t_ns = sensor(4, 8000)
    sequences = np.concatenate([np.arange(900_000, 904_000), np.arange(4000)])
    shifted = arrivals_t_ns + np.where(sequences < 900_000, 437_211, 0)  # the device comes back at another phase
    state = sample_clock.init(PERIOD_NS, TRANSPORT_NS)
    recovered_ns, _ = recover(state, sequences, shifted)
    assert state["restarts"][0] == 1
    assert rms((recovered_ns - true_ns)[6500:] - 437_211) < 200.0


def test_wrong_sequence_number_does_not_poison_the_envelope():
    true_ns, arrivals_t_ns = sensor(5, 6000)
    sequences = np.arange(6000)
    sequences[3000] = 3500  # believed by mistake: the sample would have come half a second early
    state = sample_clock.init(PERIOD_NS, TRANSPORT_NS)
    recovered_ns, _ = recover(state, sequences, arrivals_t_ns)
    assert state["early"][0] == 1
    assert state["restarts"][0] == 0
    good = np.arange(6000) != 3000
    assert rms((recovered_ns - true_ns)[good][2000:]) < 150.0


@pytest.mark.parametrize("jump_ns", [-5_000_000, 5_000_000])
def test_clock_that_jumps_is_found_again(jump_ns):
    true_ns, arrivals_t_ns = sensor(6, 8000)
    arrivals_t_ns[4000:] += jump_ns
    true_ns[4000:] += jump_ns
    state = sample_clock.init(PERIOD_NS, TRANSPORT_NS)
    recovered_ns, _ = recover(state, np.arange(8000), arrivals_t_ns)
    assert state["restarts"][0] == 1
    assert rms((recovered_ns - true_ns)[7500:]) < 300.0


@pytest.mark.parametrize(("off_ppm", "begins", "lasts"), [(7633.0, 6000, 272), (3000.0, 18_000, 600)])
def test_a_clock_that_was_fast_for_a_while_is_found_again(off_ppm, begins, lasts):
    """The corner that it leaves bends the line by less than crystals differ: 2 ms off 6 s later."""
    count = begins + 8000
    true_ns, arrivals_t_ns = sensor(10, count)
    gained_ns = np.cumsum(np.where((np.arange(count) >= begins) & (np.arange(count) < begins + lasts), off_ppm, 0.0))
    state = sample_clock.init(PERIOD_NS, TRANSPORT_NS)
    recovered_ns, _ = recover(state, np.arange(count), arrivals_t_ns - np.round(gained_ns).astype(np.int64))
    error_ns = recovered_ns - (true_ns - gained_ns)
    assert np.abs(error_ns[begins:]).max() < 0.35 * PERIOD_NS
    assert np.abs(error_ns[begins + lasts + 1000 :]).max() < 0.01 * PERIOD_NS
    assert state["restarts"][0] == 1


@pytest.mark.parametrize("grid_ns", [0.0, 125e3, 250e3])
@pytest.mark.parametrize("rate_ppm", [-150.0, -20.0, 5.0, 60.0])
def test_a_clock_that_keeps_its_rate_is_not_begun_anew(grid_ns, rate_ppm):
    """Also where a transport of which nobody said so bundles its lines: all are late by up to a bundle for seconds."""
    for seed in range(3):
        _, arrivals_t_ns = sensor(seed, 30_000, rate_ppm=rate_ppm, grid_ns=grid_ns)
        state = sample_clock.init(PERIOD_NS, TRANSPORT_NS)
        recover(state, np.arange(30_000), arrivals_t_ns)
        assert state["restarts"][0] == 0


def test_hiccups_of_the_host_do_no_harm():
    """20 lines that wait 8 ms for the host, ten times."""
    true_ns, arrivals_t_ns = sensor(7, 10_000)
    for first in range(500, 10_000, 950):
        arrivals_t_ns[first : first + 8] = arrivals_t_ns[first + 8]
    state = sample_clock.init(PERIOD_NS, TRANSPORT_NS)
    recovered_ns, _ = recover(state, np.arange(10_000), arrivals_t_ns)
    assert rms((recovered_ns - true_ns)[2000:]) < 150.0
    assert state["restarts"][0] == 0


def test_rate_age_and_coming_samples():
    true_ns, arrivals_t_ns = sensor(8, 10_000, rate_ppm=35.0)
    state = sample_clock.init(PERIOD_NS, TRANSPORT_NS)
    assert sample_clock.uncertainty_s(state) == np.inf
    recover(state, np.arange(10_000), arrivals_t_ns)
    assert sample_clock.clock_rate_ppm(state) == pytest.approx(35.0, abs=0.05)
    assert 1e-9 < sample_clock.uncertainty_s(state) < 1e-7
    coming = sample_clock.sample_t_ns(state, 10_500)
    expected = true_ns[-1] + 501 * PERIOD_NS * (1 - 35e-6)
    assert isinstance(coming, int)
    assert coming - BOOT_NS == pytest.approx(expected, abs=200.0)
    assert sample_clock.sample_age_ns(state, 10_500, coming) == pytest.approx(0.0, abs=0.5)
    assert sample_clock.sample_age_ns(state, 9_999, coming) == pytest.approx(501 * PERIOD_NS * (1 - 35e-6), abs=1.0)


def test_wrong_nominal_rate_is_said():
    _, arrivals_t_ns = sensor(9, 5000, rate_ppm=1000.0)
    state = sample_clock.init(PERIOD_NS, TRANSPORT_NS)
    recover(state, np.arange(5000), arrivals_t_ns)
    assert state["rate_at_limit"][0] == 1


def test_first_sample_is_the_arrival_less_the_transport():
    state = sample_clock.init(PERIOD_NS, TRANSPORT_NS)
    sample_clock.step(state, 77, BOOT_NS)
    # Of one delay nothing is known but that it is not negative.
    assert BOOT_NS - 150_002 <= sample_clock.sample_t_ns(state, 77) <= BOOT_NS - 150_000


def test_same_bytes_same_bits():
    _, arrivals_t_ns = sensor(10, 4000)
    first, second = sample_clock.init(PERIOD_NS, TRANSPORT_NS), sample_clock.init(PERIOD_NS, TRANSPORT_NS)
    recover(first, np.arange(2000), arrivals_t_ns[:2000])
    second[:] = first  # a value is a copy: a replay begins here
    recover(first, np.arange(2000, 4000), arrivals_t_ns[2000:])
    recover(second, np.arange(2000, 4000), arrivals_t_ns[2000:])
    assert first.tobytes() == second.tobytes()
