"""The ablation table: every part is really off, alone, and its absence is seen where it should be."""

import numpy as np
import pytest

from bench import ablation
from bench.ablation import PARTS, measured
from stagectl.followed import controller_of

SEED = (1,)
SEEDS = (1, 2, 3, 4, 5)


@pytest.fixture(scope="module")
def whole(oled_profile, oled_machine):
    return measured(PARTS[0], oled_profile, oled_machine, SEED)


def part(name: str) -> ablation.Part:
    return next(one for one in PARTS if one.name.startswith(name))


def test_without_contact_prediction_only_the_contact_suffers(whole, oled_profile, oled_machine):
    found = measured(part("no contact"), oled_profile, oled_machine, SEED)
    assert (found.hold_m, found.peak_m) == (whole.hold_m, whole.peak_m)
    assert found.contact_peak_m > 3.0 * whole.contact_peak_m


def test_an_observer_fed_with_what_was_asked_holds_worse(whole, oled_profile, oled_machine):
    found = measured(part("asked force fed"), oled_profile, oled_machine, SEED)
    assert found.hold_m > 1.15 * whole.hold_m


def test_without_the_unknown_force_the_end_strays_in_motion(whole, oled_profile, oled_machine):
    assert measured(part("no unknown force"), oled_profile, oled_machine, SEED).peak_m > 2.0 * whole.peak_m


@pytest.fixture(scope="module")
def whole_by_seed(oled_profile, oled_machine):
    return [measured(PARTS[0], oled_profile, oled_machine, (seed,)) for seed in SEEDS]


@pytest.mark.parametrize(
    ("name", "times"),
    # Over seeds 1 to 12 single seeds have 2.0 to 1.5 without the mass, 1.32 to 1.01 without the integral, whose median
    # is 1.15; beside an integral that is ten times too weak it is 1.04.
    [("no sliding part", 2.0), ("no mass found", 1.4), ("no integral", 1.08)],
)
def test_parts_of_the_law_earn_their_place_in_motion(whole_by_seed, oled_profile, oled_machine, name, times):
    without = [measured(part(name), oled_profile, oled_machine, (seed,)) for seed in SEEDS]
    ratios = [one.peak_m / as_is.peak_m for one, as_is in zip(without, whole_by_seed, strict=True)]
    assert np.median(ratios) > times


def test_without_a_doubt_of_the_contact_only_the_contact_changes(whole, oled_profile, oled_machine):
    found = measured(part("no doubt of the contact"), oled_profile, oled_machine, SEED)
    assert (found.hold_m, found.peak_m) == (whole.hold_m, whole.peak_m)
    assert found.contact_peak_m != whole.contact_peak_m


def test_every_part_changes_a_state_of_its_own(oled_profile):
    """No two switches are the same, and none does nothing."""
    fresh = controller_of(oled_profile, "dsmc").snapshot()
    seen = set()
    for one in PARTS[1:]:
        controller = controller_of(oled_profile, "dsmc")
        one.off(controller, oled_profile)
        changed = frozenset(
            (name, field)
            for name, value in controller.snapshot().items()
            for field in (value.dtype.names or ("",))
            if not np.array_equal(
                value[field] if field else value, fresh[name][field] if field else fresh[name], equal_nan=True
            )
        )
        assert one.behind_cycle or changed
        assert (changed, one.behind_cycle) not in seen
        seen.add((changed, one.behind_cycle))


def test_a_part_that_the_stage_can_t_do_without_is_said_not_shown(whole, oled_profile, oled_machine):
    """The guard ends it: no number that looks good."""
    pushed = ablation.Part(
        "against itself", lambda controller, profile: controller.law.__setitem__("eta_per_s", -500.0)
    )
    found = measured(pushed, oled_profile, oled_machine, SEED)
    assert np.isnan(found.peak_m)
    assert "seed 1: " in found.reason
