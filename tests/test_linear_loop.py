"""The loop as a linear system: against closed forms, and against a sine put on the micro's force at the value seam."""

import math

import numpy as np
import pytest

from sim_backend.machine import load_machine
from stagectl import batch, margins
from stagectl.adaptive_filter import at_rest, in_motion
from stagectl.errors import RequestError
from stagectl.linear_loop import (
    GAP,
    LEFT,
    RIGHT,
    Body,
    Linearised,
    LinearSystem,
    _body_map,
    _Map,
    believed_body,
    linearise,
    machine_body,
)
from stagectl.profile import load_profile
from stagectl.signals import SETPOINT
from tests.stage import Bench, simulated, true_error_m, with_values
from tests.stage_loop import Loop

PLACES = {"gap": GAP, "left": LEFT, "right": RIGHT}


def body_of(bench: Bench, longest_s: float = 5e-6) -> Body:
    return Body(bench.module, bench.parameters, bench.effects, longest_s)


# ---- the plant, against closed forms ----------------------------------------------------------------------------


def test_a_held_force_moves_a_free_mass_by_the_book():
    """Double integrator behind a current loop of time constant tau, command latched after a part of the cycle."""
    tau, mass, k, h, latch = 0.15e-3, 40.0, 10.0, 1e-3, 0.4e-3
    cycle = _body_map(body_of(Bench()), GAP, ("macro", "micro"), latch, h)
    names = ["x1", "v1", "a1", "i1", "x", "v", "a", "i", "e1", "e"]
    held_s = h - latch
    speed = k / mass * (held_s - tau * (1.0 - math.exp(-held_s / tau)))
    way = k / mass * (held_s**2 / 2.0 - tau * held_s + tau**2 * (1.0 - math.exp(-held_s / tau)))
    after = cycle.by_input[:, 3]  # amperes of the micro after the latch
    assert after[names.index("v")] == pytest.approx(speed, rel=1e-4)
    assert after[names.index("x")] == pytest.approx(way, rel=1e-3)
    assert after[names.index("i")] == pytest.approx(1.0 - math.exp(-held_s / tau), rel=1e-9)
    assert cycle.by_state[names.index("x"), names.index("v")] == pytest.approx(h, rel=1e-9)
    assert cycle.by_input[names.index("x"), 5] == pytest.approx(h * h / (2.0 * mass), rel=1e-6)  # a force on the end
    assert np.all(cycle.by_state[:4, 4:8] == 0.0)  # free masses: the end moves no macro


def test_contact_is_the_spring_between_the_masses():
    bench = Bench(
        values={"left_m": 1e-4, "right_m": 2e-4, "left_stiffness_n_per_m": 5e3, "right_stiffness_n_per_m": 1e4}
    )
    for place, stiffness in ((GAP, 0.0), (LEFT, 5e3), (RIGHT, 1e4)):
        cycle = _body_map(body_of(bench), place, ("macro", "micro"), 0.0, 1e-3)
        w2 = stiffness * (1.0 / 70.0 + 1.0 / 40.0)
        apart = cycle.by_state[0, 0] - cycle.by_state[4, 0]
        assert apart == pytest.approx(math.cos(math.sqrt(w2) * 1e-3), abs=1e-7)


@pytest.mark.parametrize("law", ["dsmc", "pid"])
def test_in_contact_the_reference_is_where_the_stage_is(law):
    """7.5 mm beside it the macro would be at its limit, and its integral would stand still: a pole at 1."""
    profile = load_profile("kang-2023")
    gap, left, right = (linearise(profile, law, believed_body(profile), place) for place in (GAP, LEFT, RIGHT))
    in_gap = margins.margins(gap)
    for one in (left, right):
        found = margins.margins(one)
        assert found.is_stable
        assert found.sensitivity_peak_ratio == pytest.approx(in_gap.sensitivity_peak_ratio, rel=0.02)
        assert found.crossover_hz == pytest.approx(in_gap.crossover_hz, rel=0.01)


# ---- margins, of a loop that has closed forms ---------------------------------------------------------------------


def integrator(gain_per_s: float, delay_s: float) -> Linearised:
    """L = k T z^-1 / (z - 1) with whole delays: an integrator that is sampled, held and fed back late."""

    class Fed(Linearised):
        def _together(self, connected, extra_delay_s):
            count = round((self.delay_s + extra_delay_s) / self.period_s)
            a = np.eye(1 + count, k=-1)
            a[0] = 0.0
            a[0, 0] = 1.0
            command = np.zeros((1 + count, 1))
            asked = np.zeros((1, 1 + count))
            asked[0, -1] = -gain_per_s * self.period_s
            command[0, 0] = 1.0
            if connected == self.axes:
                a = a + command @ asked
            return LinearSystem(
                self.period_s, a, command, asked, np.zeros((1, 1)), ("micro_command_n",), ("micro_force_asked_n",)
            )

    nothing = _Map(*(np.zeros((0, 0)) for _ in range(4)))
    one = np.ones(1)
    return Fed(1e-3, delay_s, ("macro", "micro"), nothing, (), one, one, Body(math, one, []), GAP)


def test_margins_of_a_late_integrator_are_by_the_book():
    """L = 0.2 z^-1 / (z - 1): |L| = 1 at 2 sin(w T / 2) = 0.2, phase -(pi / 2 + 1.5 w T)."""
    loop = integrator(200.0, 1e-3)
    found = margins.margins(loop)
    angle = 2.0 * math.asin(0.1)
    assert found.is_stable
    assert found.crossover_hz == pytest.approx(angle / (2e-3 * math.pi), rel=1e-3)
    assert found.phase_margin_rad == pytest.approx(math.pi / 2.0 - 1.5 * angle, rel=1e-3)
    assert found.gain_margin_ratio == pytest.approx(5.0, rel=1e-3)  # z^2 - z + k is critical at k = 1
    frequency_hz = np.linspace(1.0, 499.0, 20000)
    z = np.exp(2e-3j * np.pi * frequency_hz)
    peak = np.max(1.0 / np.abs(1.0 + 0.2 / (z * (z - 1.0))))
    assert found.sensitivity_peak_ratio == pytest.approx(peak, rel=1e-4)
    assert not margins.margins(integrator(1100.0, 1e-3)).is_stable


@pytest.mark.parametrize("law", ["dsmc", "pid"])
def test_poles_leave_the_unit_circle_at_the_delay_margin(law):
    profile, machine = load_profile("oled-printer"), load_machine("oled-printer")
    loop = linearise(profile, law, machine_body(machine))
    margin_s = margins.margins(loop).delay_margin_s
    assert 0.5e-3 < margin_s < 4e-3
    assert loop.closed(margin_s - 20e-6).is_stable()
    assert not loop.closed(margin_s + 20e-6).is_stable()


def kept(estimator, observer) -> None:
    """Bring an observer to where it is and let no innovation move it from there."""
    observer(estimator)
    if observer is at_rest:
        estimator["filter_walk"] = estimator["filter_rest_walk"]


@pytest.mark.parametrize("observer", [at_rest, in_motion])
@pytest.mark.parametrize("law", ["dsmc", "pid"])
def test_at_the_gain_margin_the_value_seam_begins_to_ring(law, observer):
    """A motor that is stronger by the margin and 5 % makes noise grow; at 5 % less than the margin it does not."""
    profile, machine = load_profile("oled-printer"), load_machine("oled-printer")
    ratio = margins.margins(linearise(profile, law, machine_body(machine), observer=observer)).gain_margin_ratio
    peaks_m = []
    for share in (0.95, 1.05):
        constant = machine.micro.force_constant_n_per_a * ratio * share
        simulation = simulated(profile, with_values(machine, micro__force_constant_n_per_a=constant), law)
        kept(simulation.controller.estimator, observer)
        recording = batch.run(simulation, np.zeros(3000, SETPOINT))
        stopped = recording.commands["stop"][-1] != 0
        peaks_m.append(math.inf if stopped else np.max(np.abs(true_error_m(recording)[2000:])))
    assert peaks_m[0] < 200e-9
    assert peaks_m[1] > 10.0 * peaks_m[0]


# ---- the whole loop, against the value seam ----------------------------------------------------------------------


def answered(
    profile, machine, law: str, relative_m: float, frequency_hz: float, observer=in_motion, late_s: float = 0.0
):
    """Put a sine on the micro's command: what the law asks for at that frequency, over the sine; its adaptive gain."""
    force_n = 0.2
    simulation = simulated(profile, machine, law, relative_m=relative_m)
    kept(simulation.controller.estimator, observer)
    simulation.devices["period_s"] = simulation.controller.estimator["period_s"]
    simulation.devices["latch_delay_s"] += late_s
    loop = Loop(simulation)
    hold = np.zeros(1, SETPOINT)
    hold["relative_position_m"] = relative_m
    rest, count = 1000, 2000
    asked, gains = np.zeros(count), np.zeros(count)
    for k in range(rest + count):
        loop.cycle(hold[0], added_micro_n=force_n * math.cos(2e-3 * math.pi * frequency_hz * k))
        if k >= rest:
            asked[k - rest] = simulation.controller.command["micro_force_asked_n"][0]
            gains[k - rest] = simulation.controller.law["adaptive_gain_ratio"][0]
    assert loop.stop == 0
    turn = np.exp(-2e-3j * np.pi * frequency_hz * np.arange(rest, rest + count))
    return complex(2.0 * np.mean(asked * turn) / force_n), float(np.mean(gains))


@pytest.mark.parametrize("observer", [at_rest, in_motion])
@pytest.mark.parametrize("law", ["dsmc", "pid"])
@pytest.mark.parametrize(("place", "relative_m"), [("gap", 0.0), ("right", -170e-6), ("left", 170e-6)])
def test_an_injected_sine_is_answered_as_computed(law, place, relative_m, observer):
    """Noise, rounding of torque words and all: within 3 % at and around the peak of the sensitivity."""
    profile, machine = load_profile("oled-printer"), load_machine("oled-printer")
    for frequency_hz in (20.0, 50.0, 90.0):
        measured, gain = answered(profile, machine, law, relative_m, frequency_hz, observer)
        closed = linearise(profile, law, machine_body(machine), PLACES[place], gain, observer).closed()
        computed = closed.response(np.array([frequency_hz]), "micro_command_n", "micro_force_asked_n")[0]
        assert abs(measured - computed) < 0.03 * abs(computed), (frequency_hz, measured, computed)


@pytest.mark.parametrize("observer", [at_rest, in_motion])
def test_it_is_answered_as_computed_at_one_cycle_of_delay_as_well(observer):
    """Where control is judged, around the peak of its sensitivity."""
    profile = with_values(load_profile("oled-printer"), cycle__actuation_delay_s=1e-3)
    machine = load_machine("oled-printer")
    for frequency_hz in (30.0, 46.0, 70.0):
        measured, gain = answered(profile, machine, "dsmc", 0.0, frequency_hz, observer)
        closed = linearise(profile, "dsmc", machine_body(machine), GAP, gain, observer).closed()
        computed = closed.response(np.array([frequency_hz]), "micro_command_n", "micro_force_asked_n")[0]
        assert abs(measured - computed) < 0.03 * abs(computed), (frequency_hz, measured, computed)


@pytest.mark.parametrize("law", ["dsmc", "pid"])
def test_commands_that_come_later_than_believed_are_answered_as_computed(law):
    profile, machine = load_profile("oled-printer"), load_machine("oled-printer")
    measured, gain = answered(profile, machine, law, 0.0, 50.0, late_s=0.3e-3)
    loop = linearise(profile, law, machine_body(machine), GAP, gain)
    for late_s, is_near in ((0.3e-3, True), (0.0, False)):
        found = loop.closed(late_s).response(np.array([50.0]), "micro_command_n", "micro_force_asked_n")[0]
        assert (abs(measured - found) < 0.03 * abs(found)) == is_near


def test_a_loop_that_the_drive_closes_is_refused():
    profile = load_profile("oled-printer")
    other = with_values(profile, macro__mode="position")
    with pytest.raises(RequestError, match="torque"):
        linearise(other, "dsmc", believed_body(profile))


def test_a_dead_time_is_refused_with_what_to_do():
    profile = load_profile("oled-printer")
    late = {"name": "command_delay", "acts_on": "micro_command", "delay_s": 1e-3}
    with pytest.raises(RequestError, match="actuation_delay_s"):
        linearise(profile, "dsmc", Body(believed_body(profile).module, believed_body(profile).parameters, [late]))


@pytest.mark.parametrize("law", ["dsmc", "pid"])
def test_a_stage_without_a_micro_has_a_loop_too(law):
    profile = load_profile("single-axis")
    loop = linearise(profile, law, believed_body(profile))
    assert loop.precise_axis == "macro"
    assert margins.margins(loop).is_stable
    with pytest.raises(RequestError, match="no joint"):
        linearise(profile, law, believed_body(profile), RIGHT)
