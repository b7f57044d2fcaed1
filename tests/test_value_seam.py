"""The value seam: the compiled loop against one in Python, its sensor and its clock, its repeatability."""

import numpy as np
import pytest

from stagectl import batch, trajectory
from stagectl.errors import RequestError
from stagectl.signals import SETPOINT, Stop
from tests.stage import followed, rms, simulated, true_error_m, with_values
from tests.stage_loop import Loop

MOVE = trajectory.trapezoid(0.05, 0.2, dwell_s=0.2, lead_s=0.2).setpoints
COUNT_M = 632.991e-9 / 2048.0


@pytest.mark.parametrize("law", ["dsmc", "pid"])
def test_the_compiled_loop_is_the_loop_in_python(oled_profile, oled_machine, law):
    """Two hands on the same tick and plant, late lines included: equal to the last bit, so that neither is special."""
    late = np.random.default_rng(9).random(MOVE.size) < 0.05
    late[0] = False
    recording = batch.run(simulated(oled_profile, oled_machine, law), MOVE, late)
    assert recording.commands.size == MOVE.size
    loop = Loop(simulated(oled_profile, oled_machine, law))
    for k, setpoint in enumerate(MOVE):
        loop.cycle(setpoint, fresh=not late[k])
        c = loop.simulation.controller
        assert c.measurement[0].tobytes() == recording.measurements[k].tobytes()
        assert c.command[0].tobytes() == recording.commands[k].tobytes()
        assert loop.true_end_m == recording.truth["end_position_m"][k]
        assert loop.true_macro_m == recording.truth["macro_position_m"][k]


def test_a_run_repeats_and_a_seed_changes_it(oled_profile, oled_machine):
    runs = [followed(oled_profile, oled_machine, "dsmc", MOVE, seed=seed) for seed in (1, 1, 2)]
    for name in ("measurements", "commands", "truth", "backlash"):
        assert getattr(runs[0], name).tobytes() == getattr(runs[1], name).tobytes()
    difference_m = runs[0].truth["end_position_m"] - runs[2].truth["end_position_m"]
    assert 2e-9 < rms(difference_m) < 20e-9


def test_a_run_goes_on_from_where_it_stands(oled_profile, oled_machine):
    whole = batch.run(simulated(oled_profile, oled_machine, "dsmc"), MOVE)
    parts = simulated(oled_profile, oled_machine, "dsmc")
    first, second = batch.run(parts, MOVE[:300]), batch.run(parts, MOVE[300:])
    for name in ("measurements", "commands", "truth"):
        joined = np.concatenate([getattr(first, name), getattr(second, name)])
        assert joined.tobytes() == getattr(whole, name).tobytes()


def test_a_stop_ends_the_run_with_its_row(oled_profile, oled_machine):
    """The most interesting cycle is the last: it is recorded, and carries no force."""
    setpoints = np.zeros(500, SETPOINT)
    setpoints["position_m"][200:] = 1e-3  # a step that no stage follows
    recording = batch.run(simulated(oled_profile, oled_machine, "dsmc"), setpoints)
    assert recording.commands.size == recording.measurements.size == recording.truth.size == 201
    assert recording.setpoints.size == recording.backlash.shape[0] == 201
    assert recording.commands["stop"][-1] == Stop.FOLLOWING_ERROR
    assert not np.any(recording.commands["stop"][:-1])
    assert recording.commands["micro_word"][-1] == recording.commands["macro_word"][-1] == 0


def test_samples_come_at_the_sensors_clock(oled_profile, oled_machine):
    """20 ppm fast: its milliseconds are 20 ns short."""
    recording = batch.run(simulated(oled_profile, oled_machine, "dsmc"), MOVE)
    np.testing.assert_allclose(recording.truth["t_s"], np.arange(MOVE.size) * 1e-3 / (1.0 + 20e-6), rtol=1e-14)
    m = recording.measurements
    np.testing.assert_array_equal(m["cycle"], np.arange(MOVE.size))
    np.testing.assert_array_equal(m["sequence"], m["cycle"])
    assert np.all(np.abs(m["t_ns"] - m["sample_t_ns"] - 575_000) <= 1)


def test_the_sensor_counts_and_is_noisy(oled_profile, oled_machine):
    recording = followed(oled_profile, oled_machine, "dsmc", np.zeros(10_000, SETPOINT))
    for axis in ("macro", "end"):
        measured_m, true_m = recording.measurements[f"{axis}_position_m"], recording.truth[f"{axis}_position_m"]
        counts = measured_m / COUNT_M
        assert np.max(np.abs(counts - np.round(counts))) < 1e-6
        noise_m = measured_m - true_m
        assert np.std(noise_m) == pytest.approx(5e-9, rel=0.05)
        assert abs(np.mean(noise_m)) < 4.0 * 5e-9 / 100.0
        assert abs(np.corrcoef(noise_m[1:], noise_m[:-1])[0, 1]) < 0.05


def test_without_noise_it_is_half_a_count_off_at_most(oled_profile, oled_machine):
    machine = with_values(oled_machine, interferometer__noise_m=0.0)
    recording = followed(oled_profile, machine, "dsmc", MOVE)
    error_m = recording.measurements["end_position_m"] - recording.truth["end_position_m"]
    assert 0.4 * COUNT_M < np.max(np.abs(error_m)) <= 0.5 * COUNT_M * (1.0 + 1e-6)


def test_interpolation_is_lost_at_speed(oled_profile, oled_machine):
    """The uMD2 divides its 79 nm counts only below 10 um/s."""
    machine = with_values(
        oled_machine,
        interferometer__counts_per_wavelength=8.0,
        interferometer__interpolation_speed_m_per_s=10e-6,
        interferometer__noise_m=0.0,
    )
    recording = followed(oled_profile, machine, "dsmc", MOVE)
    error_m = recording.measurements["end_position_m"] - recording.truth["end_position_m"]
    moves = np.abs(MOVE["velocity_m_per_s"]) > 1e-3
    assert 35e-9 < np.max(np.abs(error_m[moves])) <= 39.6e-9
    assert np.max(np.abs(error_m[-100:])) < 1e-12


def test_a_run_has_its_own_zero(oled_profile, oled_machine):
    """Zeros are subtracted from measured and from true positions alike: nothing else may change."""
    plain = batch.run(simulated(oled_profile, oled_machine, "dsmc"), MOVE)
    shifted = simulated(oled_profile, oled_machine, "dsmc")
    zero_m = 1000 * COUNT_M
    for name in ("macro_zero_m", "end_zero_m"):
        shifted.devices[name] = zero_m
    shifted.state["macro_position_m"] += zero_m
    shifted.state["end_position_m"] += zero_m
    recording = batch.run(shifted, MOVE)
    assert recording.commands["stop"][-1] == 0
    # cogging and cable are felt 0.3 mm further on; what is left is noise through other roundings
    assert rms(true_error_m(recording) - true_error_m(plain)) < 5e-9
    mean_difference_m = recording.truth["end_mean_m"] - recording.truth["end_position_m"]
    np.testing.assert_allclose(mean_difference_m, plain.truth["end_mean_m"] - plain.truth["end_position_m"], atol=5e-9)


def test_the_mean_is_of_the_period_before_the_sample(oled_profile, oled_machine):
    """On a motion as slow as this, Hermite's rule gives it from positions alone: mean of two and their speeds' part."""
    recording = followed(oled_profile, oled_machine, "dsmc", MOVE)
    end_m = recording.truth["end_position_m"]
    period_s = 1e-3 / (1.0 + 20e-6)
    speed = np.gradient(end_m, period_s)
    rule_m = 0.5 * (end_m[1:] + end_m[:-1]) + period_s * (speed[:-1] - speed[1:]) / 12.0
    np.testing.assert_allclose(recording.truth["end_mean_m"][1:], rule_m, atol=1e-9)
    assert np.max(np.abs(recording.truth["end_mean_m"] - end_m)) > 50e-6  # 0.2 m/s x half a millisecond


def test_the_first_mean_of_all_is_the_position(oled_profile, oled_machine):
    truth = batch.run(simulated(oled_profile, oled_machine, "dsmc", at_m=0.02), MOVE[:1]).truth
    assert truth["end_mean_m"][0] == truth["end_position_m"][0] == 0.02


def test_late_lines_cost_little(oled_profile, oled_machine):
    """One line in twenty comes a cycle late, as over the wire; prediction fills its place."""
    late = np.random.default_rng(5).random(MOVE.size) < 0.05
    late[0] = False
    errors = []
    for which in (late, np.zeros(MOVE.size, np.bool_)):
        recording = batch.run(simulated(oled_profile, oled_machine, "dsmc"), MOVE, which)
        assert recording.commands["stop"][-1] == 0
        m = recording.measurements
        assert np.array_equal(m["sequence"] != m["cycle"], which)
        errors.append(rms(true_error_m(recording)[100:]))
    assert 0.8 < errors[0] / errors[1] < 1.5


def test_a_sample_before_its_instant_sees_the_stage_where_it_was(oled_profile, oled_machine):
    simulation = simulated(oled_profile, oled_machine, "dsmc")
    instants_s = batch.instants(simulation, MOVE.size)
    k = int(np.argmax(np.abs(MOVE["velocity_m_per_s"])))
    instants_s[k, 0] -= 20e-6
    early = batch.run(simulation, MOVE, instants_s=instants_s).truth
    due = batch.run(simulated(oled_profile, oled_machine, "dsmc"), MOVE).truth
    moved_m = early["end_position_m"][k] - due["end_position_m"][k]
    assert moved_m == pytest.approx(-20e-6 * MOVE["velocity_m_per_s"][k], rel=1e-3)


@pytest.mark.parametrize(("column", "early_s", "which"), [(0, 0.9e-3, "next sample"), (1, 0.6e-3, "its SYNC")])
def test_a_machine_has_no_way_back(oled_profile, oled_machine, column, early_s, which):
    simulation = simulated(oled_profile, oled_machine, "dsmc")
    instants_s = batch.instants(simulation, MOVE.size)
    instants_s[7, column] -= early_s
    with pytest.raises(RequestError, match=rf"cycle [67]: .*{which}"):
        batch.run(simulation, MOVE, instants_s=instants_s)
    instants_s[7, column] = np.nan
    with pytest.raises(RequestError, match="cycle"):
        batch.run(simulation, MOVE, instants_s=instants_s)


def test_position_mode_needs_a_drive(oled_profile, oled_machine):
    with pytest.raises(RequestError, match="position"):
        simulated(with_values(oled_profile, macro__mode="position"), oled_machine, "dsmc")


@pytest.mark.parametrize("law", ["dsmc", "pid"])
def test_lines_that_always_come_late_still_close_the_loop(oled_profile, oled_machine, law):
    """Every line comes a cycle late: each corrects the observer at its own instant, and the stage follows."""
    late = np.ones(MOVE.size, np.bool_)
    late[:20] = False
    recording = batch.run(simulated(oled_profile, oled_machine, law), MOVE, late)
    assert recording.commands.size == MOVE.size
    assert np.max(np.abs(true_error_m(recording))) < 2e-6
