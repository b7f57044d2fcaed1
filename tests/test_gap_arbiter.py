"""The closed loop that judges what was found: with what was refitted it is the machine that has those values."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from stagectl.gap import arbiter
from stagectl.gap.believed import load_believed
from stagectl.gap.log import Log

_PROFILE = Path(__file__).parent.parent / "profiles" / "observed" / "emps.toml"
_VISCOUS = [{"name": "viscous_friction", "acts_on": "macro_force", "damping_n_s_per_m": 203.5}]


@pytest.mark.parametrize(
    ("name", "error", "changed"),
    [
        ("macro_mass_kg", 0.05, {"mass_kg": 95.11 * 1.05}),
        ("macro_latch_s", 0.3e-3, {"latch_s": 0.3e-3}),
        ("macro_current_loop_s", 0.4e-3, {"current_loop_s": 0.4e-3}),
    ],
)
def test_what_was_refitted_is_simulated(name, error, changed):
    believed = load_believed(_PROFILE)
    other = dataclasses.replace(believed, macro=dataclasses.replace(believed.macro, **changed))
    log = _swing()
    found = arbiter.simulate(believed, _VISCOUS, log, {name: error})
    assert found.command_n == pytest.approx(arbiter.simulate(other, _VISCOUS, log).command_n, abs=1e-6)
    assert not np.allclose(found.command_n, arbiter.simulate(believed, _VISCOUS, log).command_n, atol=1e-2)


def test_stronger_motor_is_asked_for_less():
    believed, log = load_believed(_PROFILE), _swing()
    weak, strong = (arbiter.simulate(believed, _VISCOUS, log, {"macro_force_constant": e}) for e in (0.0, 0.25))
    moving = slice(500, None)
    ratio = np.sum(strong.command_n[moving] ** 2) / np.sum(weak.command_n[moving] ** 2)
    assert ratio == pytest.approx(0.8**2, rel=0.05)


def _swing() -> Log:
    """One second of a reference that swings by 20 mm; what was measured along it is not asked for."""
    count = 2000
    reference_m = 0.02 * (1.0 - np.cos(2.0 * np.pi * 1.5 * 1e-3 * np.arange(count)))
    nothing = np.zeros(count)
    return Log("run", 1e-3, nothing, nothing, np.ones(count, bool), "1", reference_m=reference_m)
