"""The observer: its gains against an independent solution, its prediction against the machine it believes in."""

import numpy as np
import pytest
import scipy.linalg

from stagectl import adaptive_filter, batch, estimator, trajectory
from stagectl.signals import MEASUREMENT, SETPOINT
from tests.stage import believed, centre_m, simulated, with_values
from tests.stage_loop import Loop


def riccati_gains(mass_kg, period_s, noise_m, drift_n_per_sqrt_s):
    """Solve the same filter by scipy: exact covariance of the integrated random walk (Van Loan 1978), measured gain."""
    a = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0 / mass_kg], [0.0, 0.0, 0.0]])
    w = np.zeros((3, 3))
    w[2, 2] = drift_n_per_sqrt_s**2
    big = scipy.linalg.expm(np.block([[-a, w], [np.zeros((3, 3)), a.T]]) * period_s)
    step = big[3:, 3:].T
    noise = step @ big[:3, 3:]
    noise = 0.5 * (noise + noise.T)
    c = np.array([[1.0, 0.0, 0.0]])
    p = scipy.linalg.solve_discrete_are(step.T, c.T, noise, np.array([[noise_m**2]]))
    return (p @ c.T / (c @ p @ c.T + noise_m**2))[:, 0]


@pytest.mark.parametrize(
    ("mass_kg", "noise_m", "drift"), [(70.0, 5e-9, 5.0), (40.0, 5e-9, 0.2), (40.0, 100e-9, 0.2), (12.0, 23e-9, 5.0)]
)
def test_gains_solve_the_riccati_equation(mass_kg, noise_m, drift):
    ours = adaptive_filter.steady_gains(1e-3, mass_kg, noise_m, drift)
    np.testing.assert_allclose(ours, riccati_gains(mass_kg, 1e-3, noise_m, drift), rtol=1e-4)


def test_gains_are_of_a_stable_filter_and_follow_the_noise():
    quiet = adaptive_filter.steady_gains(1e-3, 40.0, 5e-9, 0.2)
    loud = adaptive_filter.steady_gains(1e-3, 40.0, 100e-9, 0.2)
    assert np.all(quiet > loud)
    assert np.all(loud > 0.0)
    assert quiet[0] < 1.0
    h, m = 1e-3, 40.0
    step = np.array([[1.0, h, h * h / (2 * m)], [0.0, 1.0, h / m], [0.0, 0.0, 1.0]])
    for gains in (quiet, loud):
        error = (np.eye(3) - np.outer(gains, [1.0, 0.0, 0.0])) @ step
        assert max(abs(np.linalg.eigvals(error))) < 1.0


def test_belief_is_the_profiles(oled_profile):
    q = estimator.belief(oled_profile)[0]
    assert (q["macro_mass_kg"], q["micro_mass_kg"]) == (70.0, 40.0)
    assert (q["macro_force_constant_n_per_a"], q["micro_force_constant_n_per_a"]) == (100.0, 30.0)
    assert (q["macro_current_limit_a"], q["micro_current_limit_a"]) == (20.0, 6.0)
    assert (q["left_m"], q["right_m"]) == (25.4e-6, 176e-6)
    assert (q["draws_noise"], q["has_micro"], q["spring_n_per_m"], q["damping_n_s_per_m"]) == (0.0, 1.0, 500.0, 5.0)


def moves(name: str) -> np.ndarray:
    if name == "sweep":  # through both contacts, where prediction is hardest
        return trajectory.sweep(350e-6, 1.0, 4.0).setpoints
    return trajectory.trapezoid(0.2, 0.2, dwell_s=0.5).setpoints


@pytest.mark.parametrize("name", ["sweep", "trapezoid"])
def test_a_true_belief_fed_the_words_sent_is_exact(oled_profile, oled_machine, name):
    """No rounding of a force, no instant and no substep may differ between observer and machine."""
    simulation = simulated(oled_profile, oled_machine, "dsmc")
    believed(simulation)
    contact = worst_m = 0.0
    for setpoint in moves(name).reshape(-1, 1):
        truth = batch.run(simulation, setpoint).truth[0]
        model = simulation.controller.model[0]
        worst_m = max(worst_m, abs(model["end_position_m"] - truth["end_position_m"]))
        worst_m = max(worst_m, abs(model["macro_position_m"] - truth["macro_position_m"]))
        contact += truth["contact_force_n"] != 0.0
    assert worst_m < 1e-12
    assert (contact > 1000.0) == (name == "sweep")


def test_a_wrong_belief_is_not(oled_profile, oled_machine):
    """The test before this one can fail: half a count of force or a per cent of mass shows hundreds of times over."""
    wrong = with_values(oled_profile, micro__mass_kg=40.4)
    simulation = simulated(wrong, oled_machine, "dsmc")
    believed(simulation)
    simulation.parameters["micro_mass_kg"] = 40.0
    innovations = []
    for setpoint in moves("trapezoid").reshape(-1, 1):
        batch.run(simulation, setpoint)
        innovations.append(abs(float(simulation.controller.estimator["end_innovation_m"][0])))
    assert max(innovations) > 0.5e-9


def loop_of(profile, machine, law="dsmc") -> Loop:
    loop = Loop(simulated(profile, machine, law))
    believed(loop.simulation)
    return loop


@pytest.mark.parametrize("gap", [1, 3, 9])
@pytest.mark.parametrize("comes", ["late", "never"])
def test_missing_samples_are_predicted(oled_profile, oled_machine, gap, comes):
    """Lines that stay away leave the observer on its own; one that comes late corrects it at its own instant."""
    loop = loop_of(oled_profile, oled_machine)
    rows = moves("sweep")[:1500]
    for k, setpoint in enumerate(rows):
        missing = k >= 50 and k % 20 < gap
        loop.cycle(setpoint, fresh=not missing, silent=missing and comes == "never")
        x = loop.simulation.controller.estimator[0]
        behind = 1 if comes == "late" else k % 20 + 1
        assert x["predicted_samples"] == (behind if missing else 0)
        assert x["end_seen_m"] == pytest.approx(loop.true_end_m, abs=2e-12)
        assert x["macro_seen_m"] == pytest.approx(loop.true_macro_m, abs=1e-12)
    assert loop.stop == 0


def test_prediction_of_a_real_machine_drifts_slowly(oled_profile, oled_machine):
    """Ten lines missing at 0.1 m/s on a machine 1 % off: within 30 nm of the truth, and never exact."""
    simulation = simulated(oled_profile, oled_machine, "dsmc")
    loop = Loop(simulation)
    rows = trajectory.trapezoid(0.2, 0.1, dwell_s=0.5).setpoints
    errors = []
    for k, setpoint in enumerate(rows[:2600]):
        loop.cycle(setpoint, fresh=not 2200 <= k < 2210)
        if 2200 <= k < 2210:
            errors.append(abs(float(simulation.controller.estimator["end_seen_m"][0]) - loop.true_end_m))
    assert loop.stop == 0
    assert 0.5e-9 < max(errors) < 30e-9


def test_the_sample_that_waited_through_a_skipped_cycle_corrects_at_its_own_instant(oled_profile, oled_machine):
    """Both lines lie in the port behind it; the first one, 1 um off, is seen to have been read."""
    hold, ends_m = np.zeros(1, SETPOINT), []
    for is_read in (True, False):
        loop = Loop(simulated(oled_profile, oled_machine, "dsmc"))
        for _ in range(50):
            loop.cycle(hold[0])
        skipped = int(loop.simulation.controller.measurement["cycle"][0]) + 1
        loop.skip()
        state = loop.simulation.state[0]
        waiting = {
            "samples_new": 2,
            "earlier_sequence": skipped,
            "macro_earlier_m": float(state["macro_position_m"]),
            "end_earlier_m": float(state["end_position_m"]) + 1e-6,
        }
        loop.cycle(hold[0], **(waiting if is_read else {}))
        ends_m.append(float(loop.simulation.controller.model["end_position_m"][0]))
    assert 0.1e-6 < ends_m[0] - ends_m[1] < 1e-6


def test_missed_cycles_are_caught_up(oled_profile, oled_machine):
    """The drives hold their last words while the host sleeps; the observer does as they do."""
    loop = loop_of(oled_profile, oled_machine)
    for k, setpoint in enumerate(moves("trapezoid")[:1600]):
        if k in (1200, 1300, 1301, 1302, 1400):
            loop.skip()
        else:
            loop.cycle(setpoint)
            model = loop.simulation.controller.model[0]
            assert model["end_position_m"] == pytest.approx(loop.true_end_m, abs=2e-12)
            assert model["macro_position_m"] == pytest.approx(loop.true_macro_m, abs=1e-12)
    assert loop.stop == 0


def test_a_command_that_was_lost_was_not_felt(oled_profile, oled_machine):
    """Where the words did not reach the bus, the observer goes on with those before."""
    loop = loop_of(oled_profile, oled_machine)
    for k, setpoint in enumerate(moves("trapezoid")[:1600]):
        loop.cycle(setpoint, lost=k in (1200, 1250, 1251))
        model = loop.simulation.controller.model[0]
        assert model["end_position_m"] == pytest.approx(loop.true_end_m, abs=2e-12)
    assert loop.stop == 0


def test_an_unknown_force_is_found_with_its_sign(oled_profile, oled_machine):
    """A cable of 100 N/m that pulls from 40 mm ahead: +4 N on the macro, nothing on the micro."""
    simulation = simulated(oled_profile, oled_machine, "dsmc")
    believed(simulation)
    simulation.effects[5], simulation.effects[6] = 100.0, 0.04 + centre_m(oled_profile)
    batch.run(simulation, np.zeros(2000, SETPOINT))
    model = simulation.controller.model[0]
    assert model["macro_disturbance_n"] == pytest.approx(4.0, rel=2e-3)
    assert abs(model["micro_disturbance_n"]) < 0.05


def test_one_axis_observes_its_end_as_its_macro(single_profile, single_machine):
    simulation = simulated(single_profile, single_machine, "dsmc")
    batch.run(simulation, trajectory.sine(0.02, 3.0, 5.0).setpoints[:2000])
    model, x = simulation.controller.model[0], simulation.controller.estimator[0]
    assert model["end_position_m"] == model["macro_position_m"]
    assert model["end_velocity_m_per_s"] == model["macro_velocity_m_per_s"] != 0.0
    assert x["macro_position_gain_ratio"] == x["end_innovation_m"] == 0.0
    assert abs(x["macro_innovation_m"]) < 100e-9


def test_the_first_sample_places_the_belief(oled_profile, oled_machine):
    simulation = simulated(oled_profile, oled_machine, "dsmc", at_m=0.123)
    loop = Loop(simulation)
    hold = np.zeros(1, SETPOINT)
    hold["position_m"] = 0.123
    loop.cycle(hold[0], fresh=False)
    assert simulation.controller.estimator["started"][0] == 0.0
    command = simulation.controller.command[0]
    assert (command["macro_force_asked_n"], command["micro_force_asked_n"], command["stop"]) == (0.0, 0.0, 0)
    loop.cycle(hold[0])
    loop.cycle(hold[0])
    model = simulation.controller.model[0]
    assert simulation.controller.estimator["started"][0] == 1.0
    # two free milliseconds on a tilted cable and some cogging: a micrometre
    assert model["end_position_m"] == pytest.approx(0.123, abs=2e-6)
    assert model["macro_position_m"] == pytest.approx(0.123 + 75.3e-6, abs=2e-6)
    assert abs(command["macro_force_asked_n"]) < 50.0
    assert 0.0 < abs(command["micro_force_asked_n"]) < 5.0


def test_a_fresh_start_remembers_nothing(oled_profile):
    """What effects remembered belongs to the motion before."""
    model, e, m = estimator.init_model(), estimator.init(oled_profile), np.zeros(1, MEASUREMENT)
    model["memory"] = 0.7
    m["end_position_m"] = 0.1
    estimator.start(e[0], model[0], m[0])
    assert model["end_position_m"][0] == 0.1
    assert not np.any(model["memory"])
