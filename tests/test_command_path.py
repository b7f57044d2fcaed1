"""What drives and effects of the command path make of held commands, against closed forms."""

import dataclasses

import numpy as np
import pytest

from stagectl.effects import CATALOGUE
from stagectl.gap import balance
from stagectl.gap.believed import Believed, BelievedAxis
from stagectl.gap.command_path import behind, changed_by, driven, driven_later
from stagectl.gap.effect_forces import known_forces
from stagectl.gap.hypotheses import deviation_term, parameter_terms
from stagectl.gap.innovations import Noise
from stagectl.gap.interval_parts import PARTS_COUNT
from stagectl.gap.log import Log
from stagectl.gap.operating_point import operating_point

PERIOD_S = 1e-3
COMMAND = np.cumsum(np.random.default_rng(3).standard_normal(400))
DRIVES = [(0.57e-3, 0.15e-3), (0.57e-3, 0.0), (1.2e-3, 0.3e-3), (-0.4e-3, 0.1e-3)]


STEP = np.abs(np.diff(COMMAND)).max()


def near(found, wanted, ratio):
    """Tell whether means over parts and values at samples both agree, the ends of the recording left out."""
    inner = slice(30, -30)
    return all(np.abs(one[inner] - other[inner]).max() < ratio * STEP for one, other in zip(found, wanted, strict=True))


@pytest.mark.parametrize(("latch_s", "lag_s"), DRIVES)
@pytest.mark.parametrize("delay_s", [38e-6, 102e-6, 0.8e-3, 2.3e-3])
def test_a_delay_is_a_command_that_is_taken_over_later(latch_s, lag_s, delay_s):
    now = driven(COMMAND, latch_s, lag_s, PERIOD_S)
    later = driven(COMMAND, latch_s + delay_s, lag_s, PERIOD_S)
    wanted = [after - before for after, before in zip(later, now, strict=True)]
    found = changed_by(CATALOGUE["command_delay"], [delay_s], COMMAND, latch_s, lag_s, PERIOD_S)
    assert found[0].shape == (COMMAND.size, PARTS_COUNT)
    assert near(found, wanted, 1e-3)


@pytest.mark.parametrize(("latch_s", "lag_s"), [drive for drive in DRIVES if drive[1] > 0.0])
@pytest.mark.parametrize("constant_s", [0.2e-3, 2e-3, 20e-3])
def test_a_slower_current_loop_is_one_lag_as_long_as_both(latch_s, lag_s, constant_s):
    both, stated = (driven(COMMAND, latch_s, lag, PERIOD_S) for lag in (lag_s + constant_s, lag_s))
    wanted = [row - b for row, b in zip(both, stated, strict=True)]
    found = changed_by(CATALOGUE["current_loop_lag"], [constant_s], COMMAND, latch_s, lag_s, PERIOD_S)
    assert near([part[100:] for part in found], [part[100:] for part in wanted], 1e-3)


@pytest.mark.parametrize(("latch_s", "lag_s"), [drive for drive in DRIVES if drive[1] > 0.0])
@pytest.mark.parametrize("constant_s", [0.2e-3, 2e-3, 20e-3])
def test_a_lag_behind_the_current_loop_by_partial_fractions(latch_s, lag_s, constant_s):
    """Two first-order lags a and b in a row answer a step as (a A - b B) / (a - b), A and B the answers of each."""
    slow, fast = (driven(COMMAND, latch_s, lag, PERIOD_S) for lag in (constant_s, lag_s))
    both = [(constant_s * a - lag_s * b) / (constant_s - lag_s) for a, b in zip(slow, fast, strict=True)]
    wanted = [row - b for row, b in zip(both, fast, strict=True)]
    found = behind(constant_s, COMMAND, latch_s, lag_s, PERIOD_S)
    assert near([part[100:] for part in found], [part[100:] for part in wanted], 1e-3)


@pytest.mark.parametrize(("latch_s", "lag_s"), DRIVES)
@pytest.mark.parametrize("late_s", [0.0, 97e-6, 1.3e-3])
def test_what_comes_later_by_as_much_is_a_later_latch(latch_s, lag_s, late_s):
    edges = COMMAND.size * PARTS_COUNT + 1
    found = driven_later(COMMAND, latch_s, lag_s, PERIOD_S, np.full(edges, late_s))
    wanted, _ = driven(COMMAND, latch_s + late_s, lag_s, PERIOD_S)
    assert np.abs(found - wanted)[30:-30].max() < 1e-9 * STEP


def test_a_dead_band_changes_the_commands_themselves():
    commands = np.where(np.abs(COMMAND) < 2.0, 0.0, COMMAND - np.sign(COMMAND) * 2.0)
    before = driven(COMMAND, 0.57e-3, 0.15e-3, PERIOD_S)
    wanted = [a - b for a, b in zip(driven(commands, 0.57e-3, 0.15e-3, PERIOD_S), before, strict=True)]
    found = changed_by(CATALOGUE["amplifier_dead_band"], [2.0], COMMAND, 0.57e-3, 0.15e-3, PERIOD_S)
    assert near(found, wanted, 1e-12)


LATCH_S, LAG_S, DELAY_S, CONSTANT_N_PER_A = 0.57e-3, 0.15e-3, 0.35e-3, 100.0
AXIS = Believed(
    "axis",
    PERIOD_S,
    BelievedAxis(
        40.0, 0.4, 5e-9, LAG_S, force_constant_n_per_a=CONSTANT_N_PER_A, latch_s=LATCH_S, latch_sd_s=6e-6,
        current_loop_sd_s=8e-6, current_noise_a=0.005,
    ),
)  # fmt: skip


@pytest.fixture(scope="module")
def under_a_delay():
    """A drive that takes commands over 0.35 ms later than believed: as believed, and with that delay known."""
    current_a = driven(COMMAND, LATCH_S + DELAY_S, LAG_S, PERIOD_S)[1] / CONSTANT_N_PER_A
    position_m = 1e-4 * np.sin(np.arange(COMMAND.size) / 20.0)
    log = Log("run", PERIOD_S, position_m, COMMAND, np.ones(COMMAND.size, bool), "1", macro_current_a=current_a)
    believed = balance.recording_of(log, AXIS)
    return believed, operating_point(believed, [(CATALOGUE["command_delay"], "macro_command", {"delay_s": DELAY_S})])


def test_a_delay_that_is_known_is_in_the_currents_that_a_drive_should_report(under_a_delay):
    noise = {"macro": Noise(5e-9, 0.05, 8.0, 0.0)}
    left = []
    for recording in under_a_delay:
        balance.set_noise(recording, noise)
        left.append(np.abs(balance.observed(recording)[-1][30:-30]).max())
    assert left[0] > 1.0
    assert left[1] < 1e-3 * left[0]


@pytest.mark.parametrize("order", [1, -1])
def test_what_is_known_of_a_drive_is_felt_as_late_as_its_body_is_read(order):
    """Left where it was beside a clock of 16 ppm, a dead band of 45 mA drew a flexible mode and a current ripple."""
    width_a = 0.02
    log = Log("run", PERIOD_S, 1e-4 * np.sin(np.arange(COMMAND.size) / 20.0), COMMAND, np.ones(COMMAND.size, bool), "1")
    moved = [
        (CATALOGUE["amplifier_dead_band"], "macro_command", {"half_width_a": width_a}),
        (CATALOGUE["sensor_delay"], "macro_sensor", {"delay_s": DELAY_S}),
    ]
    there = operating_point(balance.recording_of(log, AXIS), moved[::order])
    width_n = width_a * CONSTANT_N_PER_A
    less = np.sign(COMMAND) * np.minimum(np.abs(COMMAND), width_n)
    wanted, _ = driven(COMMAND - less, LATCH_S + DELAY_S, LAG_S, PERIOD_S)
    assert np.abs(there.felt_n["macro"] - wanted)[30:-30].max() < 1e-9 * STEP
    assert np.abs(known_forces(there).macro_n - wanted)[30:-30].max() < 1e-9 * STEP


def test_beside_a_delay_that_is_known_the_latch_is_the_same_column(under_a_delay):
    """A latch is uncertain where the commands then are: elsewhere 6 us that nobody knows seemed known to 1 us."""
    _, there = under_a_delay
    latch = next(term for term, _ in parameter_terms(there) if term.name == "macro_latch_s").forces(there)[0]
    term = deviation_term(CATALOGUE["command_delay"], "macro_command", {"delay_s": DELAY_S})
    delay = term.forces(there)[0]
    for one, other in ((latch.macro_n, delay.macro_n), (latch.macro_current_a, delay.macro_current_a)):
        inner, wanted = one[30:-30], other[30:-30] / DELAY_S
        assert np.linalg.norm(inner - wanted) < 0.05 * np.linalg.norm(wanted)


def test_a_latch_that_is_hardly_known_is_asked_for_as_far_as_it_may_well_be():
    axis = dataclasses.replace(AXIS.macro, latch_s=0.0, latch_sd_s=0.5e-3, current_loop_s=0.0)
    log = Log("run", PERIOD_S, np.zeros(COMMAND.size), COMMAND, np.ones(COMMAND.size, bool), "1")
    recording = balance.recording_of(log, dataclasses.replace(AXIS, macro=axis))
    latch = next(term for term, _ in parameter_terms(recording) if term.name == "macro_latch_s").forces(recording)[0]
    later, now = (driven(COMMAND, latch_s, 0.0, PERIOD_S)[0] for latch_s in (0.25e-3, 0.0))
    assert latch.macro_n * 0.25e-3 == pytest.approx(later - now, abs=1e-9)
