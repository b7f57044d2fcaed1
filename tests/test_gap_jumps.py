"""Laws that jump where a body turns round: as means over the parts of intervals in which it does."""

from dataclasses import replace

import numpy as np
import pytest

from stagectl.effects import CATALOGUE
from stagectl.gap.jumps import jumps_at, with_jumps
from stagectl.gap.quantities import along_motion

H, PARTS, LEVEL_N = 1e-3, 4, 3.0
PART_S = H / PARTS


def _turned(turn_s: float, before: float, behind: float) -> tuple[np.ndarray, np.ndarray]:
    """Return (velocity, acceleration) in the middles of parts of three intervals of a body that turns at `turn_s`."""
    edges_s = np.arange(3 * PARTS + 1) * PART_S - turn_s
    speeds = np.where(edges_s < 0.0, before, behind) * edges_s
    middle, acceleration = 0.5 * (speeds[1:] + speeds[:-1]), np.diff(speeds) / PART_S
    return middle.reshape(3, PARTS), acceleration.reshape(3, PARTS)


@pytest.mark.parametrize("share", [0.0, 0.1, 0.5, 0.93])
@pytest.mark.parametrize(("before", "behind"), [(-1.4, -1.4), (-1.5, -1.1), (0.8, 0.5)])
def test_a_friction_is_its_mean_over_the_part_in_which_a_body_turns(share, before, behind):
    """The friction that jumps is a part of what slows the body down: 5 N of 40 behind a reversal."""
    friction = CATALOGUE["coulomb_friction"]
    turn_s = (5 + share) * PART_S
    velocity, acceleration = _turned(turn_s, before, behind)
    parameters = [LEVEL_N, 1e-9]
    there_n = along_motion(friction, [velocity], parameters)
    found_n = with_jumps(friction, [velocity], acceleration, parameters, there_n, H).ravel()
    ahead = np.where(np.arange(3 * PARTS) < 5, 1.0, -1.0) * LEVEL_N  # of a body that comes from below
    ahead[5] = LEVEL_N * (2.0 * share - 1.0)
    assert found_n == pytest.approx(-np.sign(-before) * ahead, abs=1e-6)


def test_what_else_a_law_asks_for_stays_as_it_is_there():
    """A friction that grows along the way, by the place of each part."""
    friction = CATALOGUE["position_dependent_friction"]
    velocity, acceleration = _turned(5.25 * PART_S, -1.4, -1.4)
    place_m = np.linspace(0.1, 0.2, velocity.size).reshape(velocity.shape)
    known = {"position_m": place_m, "velocity_m_per_s": velocity}
    shape = {"level_n": 1.0, "slope_n_per_m": 5.0, "ends_m": 0.0, "smoothing_m_per_s": 1e-9}
    arguments, parameters = [known[name] for name in friction.quantities], [shape[name] for name in friction.parameters]
    there_n = along_motion(friction, arguments, parameters)
    found_n = with_jumps(friction, arguments, acceleration, parameters, there_n, H)
    level_n = np.abs(there_n)
    assert found_n[1, 1] == pytest.approx(level_n[1, 1] * 0.5, rel=1e-6)  # forwards for a quarter of the part
    untouched = np.ones_like(there_n, bool)
    untouched[1, 1] = False
    assert np.array_equal(found_n[untouched], there_n[untouched])


def test_a_body_that_does_not_turn_round_feels_what_it_did():
    friction = CATALOGUE["coulomb_friction"]
    velocity, acceleration = _turned(-5.0 * PART_S, 0.7, 0.7)
    there_n = along_motion(friction, [velocity], [LEVEL_N, 1e-9])
    assert np.array_equal(with_jumps(friction, [velocity], acceleration, [LEVEL_N, 1e-9], there_n, H), there_n)


def test_a_body_that_begins_to_move_turns_where_its_part_says():
    """Nothing slowed it down before: warnings are errors."""
    friction = CATALOGUE["coulomb_friction"]
    velocity, acceleration = np.full((1, PARTS), -1e-9), np.array([[0.0, 1.0, 1.0, 1.0]])
    there_n = along_motion(friction, [velocity], [LEVEL_N, 1e-12])
    found_n = with_jumps(friction, [velocity], acceleration, [LEVEL_N, 1e-12], there_n, H)
    assert found_n[0, 0] == there_n[0, 0]
    assert np.all(np.abs(found_n[0, 1:]) < 1e-3 * LEVEL_N)  # as long to one side as to the other


def test_a_law_of_a_user_may_jump_with_something_else():
    """With how fast the joint closes, or with a memory: either has no velocity of one body to turn round with."""
    friction = CATALOGUE["coulomb_friction"]
    assert jumps_at(friction, "macro_force")
    assert not jumps_at(friction, "joint")
    assert not jumps_at(replace(friction, quantities=("relative_velocity_m_per_s",)), "macro_force")
    assert not jumps_at(replace(friction, memory=1), "macro_force")
    assert not jumps_at(CATALOGUE["viscous_friction"], "macro_force")
