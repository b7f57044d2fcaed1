"""One tick: integers on the wire, nan that stops, states that replay, late samples, and its cost."""

import math

import numpy as np
import pytest

from stagectl import tick, trajectory
from stagectl.signals import MEASUREMENT, SETPOINT, Stop
from tests.stage import followed, simulated, with_values
from tests.stage_loop import Loop

LAWS = tuple(tick.LAWS)


def standing(profile, machine, law: str, cycles: int = 50, **values) -> Loop:
    """Return a loop that has held the stage at rest for some cycles."""
    loop = Loop(simulated(with_values(profile, **values) if values else profile, machine, law))
    hold = np.zeros(1, SETPOINT)
    for _ in range(cycles):
        loop.cycle(hold[0])
    assert loop.stop == 0
    return loop


@pytest.mark.parametrize("law", LAWS)
def test_words_are_the_nearest_integers_of_what_was_asked(oled_profile, oled_machine, law):
    """0.1 % of 500 N and of 60 N a step; the force that is believed is that of the integer.

    What rounding leaves over goes into the next word: after any number of cycles at most half a step is owed.
    """
    loop = Loop(simulated(oled_profile, oled_machine, law))
    signs = set()
    owed = {"macro": 0.0, "micro": 0.0}
    for setpoint in trajectory.trapezoid(0.05, 0.2, dwell_s=0.1, lead_s=0.1).setpoints:
        loop.cycle(setpoint)
        c = loop.simulation.controller.command[0]
        for axis, step_n in (("macro", 0.5), ("micro", 0.06)):
            word, asked_n = int(c[f"{axis}_word"]), float(c[f"{axis}_force_asked_n"])
            assert c[f"{axis}_force_n"] == pytest.approx(word * step_n, rel=1e-12)
            owed[axis] += math.floor(16.0 * asked_n / step_n + 0.5) / 16.0 - word  # it counts in sixteenths
            assert abs(owed[axis]) <= 0.5
            signs.add((axis, np.sign(word)))
        carried = {axis: loop.simulation.controller.estimator[f"{axis}_carried_word"][0] for axis in owed}
        assert carried == owed
        assert loop.simulation.controller.estimator["micro_word"][0] == c["micro_word"]
        assert loop.simulation.controller.estimator["macro_word"][0] == c["macro_word"]
    assert {("macro", 1.0), ("macro", -1.0), ("micro", 1.0), ("micro", -1.0)} <= signs


@pytest.mark.parametrize("law", LAWS)
def test_what_is_owed_carries_no_word_beyond_the_limit(oled_profile, oled_machine, law):
    """At its limit of 180 N the micro is sent 3000 words, whatever rounding has left over before."""
    loop = Loop(simulated(oled_profile, oled_machine, law))
    hold = np.zeros(1, SETPOINT)
    for _ in range(20):
        loop.cycle(hold[0])
    loop.simulation.controller.estimator["micro_carried_word"] = 0.5
    hold["acceleration_m_per_s2"] = 10.0
    loop.cycle(hold[0])
    assert loop.simulation.controller.command["micro_force_asked_n"][0] == 180.0
    assert loop.simulation.controller.command["micro_word"][0] == 3000


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("name", [name for name in MEASUREMENT.names if MEASUREMENT[name].kind == "f"])
def test_a_measurement_of_nan_stops_or_is_not_used(oled_profile, oled_machine, law, name):
    loop = standing(oled_profile, oled_machine, law)
    controller, hold = loop.simulation.controller, np.zeros(1, SETPOINT)
    twin = standing(oled_profile, oled_machine, law)
    loop.cycle(hold[0], **{name: math.nan})
    twin.cycle(hold[0])
    command = controller.command[0]
    if name in ("macro_position_m", "end_position_m"):
        assert command["stop"] == Stop.MEASUREMENT_NOT_FINITE
        assert (command["macro_word"], command["micro_word"]) == (0, 0)
        assert (command["macro_force_n"], command["micro_force_n"]) == (0.0, 0.0)
    else:  # the drives' own encoders and forces decide nothing in torque mode
        assert command.tobytes() == twin.simulation.controller.command[0].tobytes()


def test_a_stop_sends_no_force(oled_profile, oled_machine):
    loop = standing(oled_profile, oled_machine, "dsmc")
    accelerate = np.zeros(1, SETPOINT)
    accelerate["acceleration_m_per_s2"] = 1.0
    loop.cycle(accelerate[0], reference_lost=1)
    command = loop.simulation.controller.command[0]
    assert command["stop"] == Stop.REFERENCE_LOST
    assert command["micro_force_asked_n"] > 30.0  # what was asked stays on record
    assert (command["macro_word"], command["micro_word"]) == (0, 0)


@pytest.mark.parametrize("law", LAWS)
def test_states_and_inputs_determine_every_command(oled_profile, oled_machine, law):
    """Snapshot, measurements, setpoints: the same commands to the last bit, from another controller."""
    loop = Loop(simulated(oled_profile, oled_machine, law))
    rows = trajectory.sweep(350e-6, 1.0, 3.0).setpoints
    inputs, outputs = [], []
    for k, setpoint in enumerate(rows):
        if k == 700:
            snapshot = loop.simulation.controller.snapshot()
        loop.cycle(setpoint, fresh=k % 17 != 3, lost=k % 211 == 5)
        if k >= 700:
            c = loop.simulation.controller
            inputs.append((c.measurement.copy(), c.setpoint.copy()))
            outputs.append(b"".join(getattr(c, name).tobytes() for name in c.STATES))
            # what was lost is in the next measurement, as the servo writes it
            inputs[-1][0]["command_lost"] = int((k - 1) % 211 == 5)
    other = tick.controller(oled_profile, law, has_drives=False)
    other.restore(snapshot)
    for (measurement, setpoint), expected in zip(inputs, outputs, strict=True):
        other.measurement[...], other.setpoint[...] = measurement, setpoint
        other.step()
        assert b"".join(getattr(other, name).tobytes() for name in other.STATES) == expected


def test_a_snapshot_is_a_copy(oled_profile):
    one = tick.controller(oled_profile, "dsmc", has_drives=False)
    snapshot = one.snapshot()
    one.estimator["cycle"] = 12.0
    one.effects[0] = 99.0
    assert snapshot["estimator"]["cycle"][0] == 0.0
    assert snapshot["effects"][0] == 5.0
    kept = one.estimator
    one.restore(snapshot)
    assert one.estimator is kept  # others share it
    assert kept["cycle"][0] == 0.0
    assert one.effects[0] == 5.0


def test_the_same_cycle_again_changes_no_estimate(oled_profile, oled_machine):
    """A host that wakes twice in one sensor period: the observer has already taken that sample."""
    loop = standing(oled_profile, oled_machine, "dsmc")
    controller = loop.simulation.controller
    before = controller.model.copy(), controller.backlash.copy()
    controller.step()
    assert controller.model.tobytes() == before[0].tobytes()
    assert controller.backlash.tobytes() == before[1].tobytes()


def test_an_age_beyond_the_limit_stops(oled_profile, oled_machine):
    """20 ms: with lines that are used 0.575 ms old, 19 may stay away; the stage is held by prediction meanwhile."""
    loop = standing(oled_profile, oled_machine, "dsmc")
    hold = np.zeros(1, SETPOINT)
    for _ in range(19):
        loop.cycle(hold[0], silent=True)
        assert loop.stop == 0
        assert abs(loop.true_end_m) < 1e-6
    loop.cycle(hold[0], silent=True)
    assert loop.stop == Stop.SENSOR_AGE


@pytest.mark.parametrize(("law", "kind"), [("dsmc", "dsmc"), ("pid", "pid")])
def test_a_law_has_its_own_module(oled_profile, law, kind):
    controller = tick.controller(oled_profile, law, has_drives=True)
    assert controller.law_name == law
    assert controller.module.law.__name__ == f"stagectl.laws.{kind}"
    assert controller.guard["has_drives"][0] == 1.0


def test_profiles_of_one_structure_share_their_ticks(oled_profile):
    heavier = with_values(oled_profile, macro__mass_kg=90.0)
    one = tick.controller(oled_profile, "dsmc", has_drives=False)
    other = tick.controller(heavier, "dsmc", has_drives=False)
    assert one.module is other.module
    assert one.belief["macro_mass_kg"][0] != other.belief["macro_mass_kg"][0]


def test_the_drives_target_is_where_the_reference_will_be(oled_profile):
    """Position mode: a target latched by the SYNC is reached one period later: 0.575 ms + 1 ms after the sample."""
    profile = with_values(oled_profile, macro__mode="position")
    one = tick.controller(profile, "dsmc", has_drives=False)
    for name, value in (("cycle", 1), ("sequence", 1), ("samples_new", 1), ("lease_left_ns", 1)):
        one.measurement[name] = value
    one.measurement["macro_position_m"] = 75.3e-6
    one.setpoint["velocity_m_per_s"], one.setpoint["acceleration_m_per_s2"] = 0.1, 1.0
    one.step()
    ahead_s = 1.575e-3
    expected_m = 75.3e-6 + 0.1 * ahead_s + 0.5 * ahead_s**2
    assert one.command["macro_target_m"][0] == pytest.approx(expected_m, abs=1e-12)
    # and its feed-forward is the force of the motion alone: the drive closes the loop
    mass_n = 70.0 * 1.0
    reaction_n = float(one.command["micro_force_asked_n"][0])
    assert one.command["macro_force_asked_n"][0] == pytest.approx(mass_n + reaction_n, abs=2.0)


WEAK = -0.05


def weak(model, *axes: str):
    """Copy a profile or machine whose motors make 5 % less force than their current should."""
    errors = ({"name": "force_constant_error", "acts_on": f"{axis}_actuator", "error_ratio": WEAK} for axis in axes)
    return with_values(model, effects=(*model.effects, *errors))


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_what_a_weak_motor_is_asked_for_keeps_within_the_limit(oled_profile, oled_machine, law, sign):
    """Both axes at their limits, 180 N and 300 N: asked F / (1 - 0.05) of a force cut too late would be 5 % beyond."""
    profile = with_values(weak(oled_profile, "macro", "micro"), macro__force_limit_n=300.0)
    loop = standing(profile, weak(oled_machine, "macro", "micro"), law)
    accelerate = np.zeros(1, SETPOINT)
    accelerate["acceleration_m_per_s2"] = sign * 20.0
    loop.cycle(accelerate[0])
    command = loop.simulation.controller.command[0]
    assert command["stop"] == Stop.NONE
    assert command["micro_force_asked_n"] == sign * 180.0
    assert command["macro_force_asked_n"] == sign * 300.0


@pytest.mark.parametrize("error", [-0.2, WEAK, 0.05, 0.2])
def test_a_force_constant_error_is_undone_exactly(oled_profile, oled_machine, error):
    """F / (1 + e), not F (1 - e): at -5 % that would be 0.25 % short."""
    effect = {"name": "force_constant_error", "acts_on": "micro_actuator", "error_ratio": error}
    profile, machine = (with_values(one, effects=(*one.effects, effect)) for one in (oled_profile, oled_machine))
    loop = Loop(simulated(profile, machine, "dsmc"))
    largest_n = 0.0
    for setpoint in trajectory.trapezoid(0.05, 0.2, dwell_s=0.1, lead_s=0.1).setpoints:
        loop.cycle(setpoint)
        assert loop.stop == 0
        wanted_n = float(loop.simulation.controller.law["last_force_n"][0])
        asked_n = float(loop.simulation.controller.command["micro_force_asked_n"][0])
        assert asked_n * (1.0 + error) == pytest.approx(wanted_n, rel=1e-12, abs=1e-12)
        largest_n = max(largest_n, abs(wanted_n))
    assert largest_n > 30.0


@pytest.mark.parametrize("law", LAWS)
def test_without_an_actuator_effect_the_law_has_the_last_word(oled_profile, oled_machine, law):
    """To the last bit: what is asked is what the law answered, and at the limit the limit."""
    loop = standing(oled_profile, oled_machine, law)
    accelerate = np.zeros(1, SETPOINT)
    for acceleration in (0.3, 20.0):
        accelerate["acceleration_m_per_s2"] = acceleration
        loop.cycle(accelerate[0])
        if law == "dsmc":
            controller = loop.simulation.controller
            assert controller.command["micro_force_asked_n"][0] == controller.law["last_force_n"][0]
    assert loop.simulation.controller.command["micro_force_asked_n"][0] == 180.0


def test_a_saturated_law_on_weak_motors_ends_its_run(oled_profile, oled_machine):
    """Over the value seam: 1 m/s^2 takes 40 N, a weak motor more than 41 N, which is the limit."""
    profile = with_values(weak(oled_profile, "micro"), micro__force_limit_n=41.0)
    rows = trajectory.trapezoid(0.2, 0.2, dwell_s=0.2, lead_s=0.2).setpoints
    recording = followed(profile, weak(oled_machine, "micro"), "dsmc", rows)
    asked_n = np.abs(recording.commands["micro_force_asked_n"])
    assert recording.commands["stop"][-1] == Stop.NONE
    assert recording.commands.size == rows.size
    assert np.max(asked_n) == 41.0
    assert np.count_nonzero(asked_n == 41.0) > 10
