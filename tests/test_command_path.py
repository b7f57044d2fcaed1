"""What drives and effects of the command path make of held commands, against closed forms."""

import numpy as np
import pytest

from stagectl.effects import CATALOGUE
from stagectl.gap.command_path import PARTS_COUNT, changed_by, driven

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
def test_a_lag_before_the_current_loop_by_partial_fractions(latch_s, lag_s, constant_s):
    """Two first-order lags a and b in a row answer a step as (a A - b B) / (a - b), A and B the answers of each."""
    slow, fast = (driven(COMMAND, latch_s, lag, PERIOD_S) for lag in (constant_s, lag_s))
    both = [(constant_s * a - lag_s * b) / (constant_s - lag_s) for a, b in zip(slow, fast, strict=True)]
    wanted = [row - b for row, b in zip(both, fast, strict=True)]
    found = changed_by(CATALOGUE["current_loop_lag"], [constant_s], COMMAND, latch_s, lag_s, PERIOD_S)
    assert near([part[100:] for part in found], [part[100:] for part in wanted], 1e-3)


def test_a_dead_band_changes_the_commands_themselves():
    commands = np.where(np.abs(COMMAND) < 2.0, 0.0, COMMAND - np.sign(COMMAND) * 2.0)
    before = driven(COMMAND, 0.57e-3, 0.15e-3, PERIOD_S)
    wanted = [a - b for a, b in zip(driven(commands, 0.57e-3, 0.15e-3, PERIOD_S), before, strict=True)]
    found = changed_by(CATALOGUE["amplifier_dead_band"], [2.0], COMMAND, 0.57e-3, 0.15e-3, PERIOD_S)
    assert near(found, wanted, 1e-12)
