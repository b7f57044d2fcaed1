"""Homing sets the zeros of a stage that stands, held by its drive; a drive that lets go of it stays without power."""

from typing import NamedTuple

import numpy as np
import pytest

from drivers import cia402
from sim_backend.drive_states import DriveState
from sim_backend.faults import Fault
from sim_backend.machine import load_machine
from stagectl.backend import BatchBackend
from stagectl.errors import DriveError, LinkError
from stagectl.profile import load_profile
from stagectl.record import read_run
from stagectl.requests import Phase
from stagectl.signals import Stop
from stagectl.supervisor import Supervisor
from tests.stage import with_values

MACRO = 1
PRESSURE = 0x1_0000


def on_a_slope(machine):
    """Copy a machine that cogging of 20 N pulls away from its index the hardest."""
    cogging = {"amplitude_n": 20.0, "phase_rad": np.pi / 2}
    effects = [{**row, **cogging} if row["name"] == "cogging" else row for row in map(dict, machine.effects)]
    assert any(row["name"] == "cogging" for row in effects)
    return with_values(machine, effects=effects)


def test_zeros_are_those_of_a_stage_that_stands(tmp_path, single_profile, single_machine):
    """Laser and encoder tell of instants a cycle apart: one that rolled was homed micrometres off."""
    backend = BatchBackend(on_a_slope(single_machine), seed=1)
    with Supervisor(single_profile, backend, tmp_path / "run") as stage:
        assert stage.home().finished
        truth = backend.rig.truth.arrays()
    rows = read_run(tmp_path / "run").rows
    zero_row = int(np.flatnonzero(rows["homing_id"])[0])
    after = rows[zero_row : zero_row + 20]
    true_m = np.interp(after["sample_t_ns"], truth["t_ns"], truth["macro_position_m"])
    assert np.abs(after["macro_position_m"] - true_m).max() < 0.2e-6
    assert after["run_phase"][0] == Phase.HOMED_DRIVE
    assert cia402.state_of(int(after["macro_statusword"][0])) is cia402.State.OPERATION_ENABLED


def test_the_micro_has_come_to_rest_on_its_spring(tmp_path):
    """It swung by 0.9 mm still when its zero was taken, and both edges were looked for beside where they are."""
    backend = BatchBackend(load_machine("kang-2023"), seed=1)
    zeroed = False

    def stop(rows):
        nonlocal zeroed
        if not zeroed and rows["homing_id"].any():
            zeroed = True
            stage.ask_to_stop()  # before the edges are touched: that takes 10 s

    with Supervisor(load_profile("kang-2023"), backend, tmp_path / "run", observe=stop) as stage:
        assert stage.home().stop is Stop.OPERATOR
        truth = backend.rig.truth.arrays()
    rows = read_run(tmp_path / "run").rows
    zero_t_ns = rows["sample_t_ns"][int(np.flatnonzero(rows["homing_id"])[0])]
    relative_m = truth["end_position_m"] - truth["macro_position_m"]
    assert np.abs(relative_m).max() > 1e-3
    assert abs(np.interp(zero_t_ns, truth["t_ns"], relative_m)) < 50e-6


def test_a_stop_is_heard_while_the_micro_swings(tmp_path):
    """It was heard up to 3 s later, with power, when the zeros had been taken."""
    backend = BatchBackend(load_machine("kang-2023"), seed=1)
    phases = set()

    def wish_for_rest(what, share):
        if Phase.HOMED_DRIVE in phases:
            stage.ask_to_stop()

    def see(rows):
        phases.update(map(Phase, rows["run_phase"]))

    with Supervisor(load_profile("kang-2023"), backend, tmp_path / "run", wish_for_rest, observe=see) as stage:
        assert stage.home().stop is Stop.OPERATOR
    rows = read_run(tmp_path / "run").rows
    assert not rows["homing_id"].any()
    assert 0 < np.count_nonzero(rows["run_phase"] == Phase.HOMED_DRIVE) <= 100  # five steps of 20 ms


def test_a_lease_shorter_than_the_wait_for_standstill_is_renewed_in_it(tmp_path, single_profile, single_machine):
    """Its servo was told of 0.1 s, and then of nothing for 0.2 s."""
    backend = BatchBackend(single_machine, seed=1)
    with Supervisor(single_profile, backend, tmp_path / "run", lease_left_s=lambda: 0.1) as stage:
        assert stage.home().finished


@pytest.mark.parametrize("cause", ["pressure", "lease"])
def test_a_drive_that_lets_go_after_its_homing_gets_no_power_again(cause, tmp_path, single_profile, single_machine):
    """It would search its index a second time."""
    backend = BatchBackend(on_a_slope(single_machine), seed=1)
    homed = False

    def strike(rows):
        nonlocal homed
        if not homed and Phase.HOMED_DRIVE in rows["run_phase"]:
            homed = True
            if cause == "pressure":
                fault = Fault("input", node_id=MACRO, bits=PRESSURE, duration_s=0.02)
                backend.rig.inject(fault, backend.wire.t_ns)

    def lease_left_s() -> float:
        return 0.0 if homed and cause == "lease" else np.inf

    with Supervisor(single_profile, backend, tmp_path / "run", observe=strike, lease_left_s=lease_left_s) as stage:
        outcome = stage.home()
        stage.pump(0.5)
    assert outcome.stop in ((Stop.EMERGENCY, Stop.DIGITAL_INPUT) if cause == "pressure" else (Stop.LEASE,))
    rows = read_run(tmp_path / "run").rows
    held = np.flatnonzero(rows["run_phase"] == Phase.HOMED_DRIVE)
    states = [cia402.state_of(int(word)) for word in rows["macro_statusword"]]
    powered = np.array([state is cia402.State.OPERATION_ENABLED for state in states])
    assert powered[held[0]]
    assert not powered[held[-1] + 5 :].any()
    assert not rows["homing_id"].any()
    assert np.ptp(rows["macro_encoder_m"][held[0] :]) < 0.5e-3  # it stays there, and is not sent off again


def test_a_drive_that_lets_go_in_its_search_gets_no_power_again(tmp_path, single_profile, single_machine):
    """Somebody else disables its voltage for a moment, or its power stage drops out without a word of why."""
    backend = BatchBackend(single_machine, seed=1)
    struck = False

    def strike(rows):
        nonlocal struck
        moves = np.abs(np.diff(rows["macro_encoder_m"])) > 1e-5
        if not struck and Phase.HOMING_DRIVE in rows["run_phase"] and moves.any():
            struck = True
            fault = Fault("object_change", node_id=MACRO, index=cia402.CONTROLWORD, subindex=0, value=0)
            backend.rig.inject(fault, backend.wire.t_ns)

    with Supervisor(single_profile, backend, tmp_path / "run", observe=strike) as stage:
        outcome = stage.home()
        stage.pump(0.5)
    assert struck
    assert outcome.stop is Stop.DRIVE_FAULT
    rows = read_run(tmp_path / "run").rows
    states = [cia402.state_of(int(word)) for word in rows["macro_statusword"]]
    powered = np.array([state is cia402.State.OPERATION_ENABLED for state in states])
    searched = np.flatnonzero(powered)
    assert np.ptp(searched) + 1 == searched.size  # once
    assert not rows["homing_id"].any()


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_an_index_on_the_other_side_is_found(side, tmp_path, single_profile, single_machine):
    """A drive that gives its search up has said so itself: it is asked to look on the other side."""
    machine = with_values(single_machine, start__macro_position_m=side * 0.05)
    with Supervisor(single_profile, BatchBackend(machine, seed=1), tmp_path / "run") as stage:
        assert stage.home().finished
    turned = [event for event in read_run(tmp_path / "run").events if event["event"] == "homing_turned"]
    assert len(turned) == (1 if side < 0.0 else 0)


def dark_at(there, tmp_path, profile, machine):
    """A stage whose macro's drive loses its power for good as soon as `there` holds of the newest rows."""
    backend = BatchBackend(machine, seed=1)
    struck = False

    def strike(rows):
        nonlocal struck
        if not struck and there(rows):
            struck = True
            backend.rig.inject(Fault("power_loss", node_id=MACRO, duration_s=1e3), backend.wire.t_ns)

    return Supervisor(profile, backend, tmp_path / "run", observe=strike)


@pytest.mark.parametrize("phase", [Phase.HOMING_DRIVE, Phase.HOMED_DRIVE])
def test_a_drive_that_goes_dark_in_its_homing_is_named(phase, tmp_path, single_profile, single_machine):
    """It was told as a stop that the operator had asked for, or as a macro that does not hold still."""
    machine = on_a_slope(single_machine)
    with dark_at(lambda rows: phase in rows["run_phase"], tmp_path, single_profile, machine) as stage:
        outcome = stage.home()
        with pytest.raises(LinkError, match=rf"node {MACRO}.*check the drive's power"):
            stage.home()
    assert outcome.stop is Stop.LINK_SILENT  # 180 ms before its heartbeat is missed
    assert outcome.detail.startswith(f"macro (node {MACRO}): nothing for 21 cycles, limit 20; ")
    assert outcome.detail.endswith("; the macro was not seen to stand within 5 s: keep clear of it")
    assert not read_run(tmp_path / "run").rows["homing_id"].any()


def test_a_drive_that_goes_dark_as_it_lets_go_is_named(tmp_path, single_profile, single_machine):
    """It was a wait of 5 s that had not ended: for a statusword that nobody sent any more."""
    with dark_at(lambda rows: rows["homing_id"].any(), tmp_path, single_profile, single_machine) as stage:
        with pytest.raises(LinkError, match=rf"^homing: .*heartbeat: the last of macro \(node {MACRO}\): "):
            stage.home()
        assert not stage.status()["stop"]


def once_held(backend, after_ns, strike):
    """What a supervisor observes: so long after the index is held first, `strike` is called with that time."""
    held_t_ns: list[int] = []
    struck_t_ns: list[int] = []

    def observe(rows):
        held_t_ns.extend(rows["t_ns"][rows["run_phase"] == Phase.HOMED_DRIVE])
        if not struck_t_ns and held_t_ns and backend.wire.t_ns - held_t_ns[0] > after_ns:
            struck_t_ns.append(backend.wire.t_ns)
            strike(struck_t_ns[0])

    return observe, struck_t_ns


@pytest.mark.parametrize("tells", [True, False], ids=["the drive tells", "its word is lost"])
def test_a_drive_that_is_sent_off_its_index_is_stopped(tells, tmp_path, single_profile, single_machine):
    """Another master changes the mode of the drive that holds, and it makes for a target that nobody gave."""
    backend = BatchBackend(single_machine, seed=1)
    step_m = single_profile.macro.encoder_step_m

    def strike(t_ns):
        if not tells:
            backend.rig.inject(Fault("drop_frame", can_id=0x280 + MACRO, duration_s=1e3), t_ns)
        for index, value in ((cia402.TARGET_POSITION, round(0.002 / step_m)), (cia402.MODES_OF_OPERATION, 8)):
            fault = Fault("object_change", node_id=MACRO, index=index, subindex=0, value=value)
            backend.rig.inject(fault, t_ns)

    observe, struck_t_ns = once_held(backend, 100_000_000, strike)
    with Supervisor(single_profile, backend, tmp_path / "run", observe=observe) as stage:
        outcome = stage.home()
        truth = backend.rig.truth.arrays()
    if tells:
        assert outcome.stop is Stop.DRIVE_MODE
        assert outcome.detail.startswith(f"macro (node {MACRO}): mode of operation 0x6061 is 8, wanted 6; ")
    else:
        assert outcome.stop is Stop.FOLLOWING_ERROR
        assert "its mode say" in outcome.detail
    away = truth["t_ns"] > struck_t_ns[0]
    fastest_m_per_s = np.abs(truth["macro_velocity_m_per_s"][away]).max()
    assert (0.0 if tells else 0.01) < fastest_m_per_s < (0.06 if tells else 0.12)
    assert np.ptp(truth["macro_position_m"][away]) < (0.5e-3 if tells else 1.5e-3)  # of the 2 mm that it was sent
    assert not read_run(tmp_path / "run").rows["homing_id"].any()


def jumped_while_held(backend, tmp_path, profile, for_s, *more):
    """Home with an encoder that jumps by 0.59 mm while the index is held, and other faults then: what was seen."""

    def strike(t_ns):
        for fault in (Fault("encoder_jump", node_id=MACRO, offset_m=-590e-6, duration_s=for_s), *more):
            backend.rig.inject(fault, t_ns)

    observe, struck_t_ns = once_held(backend, 60_000_000, strike)
    with Supervisor(profile, backend, tmp_path / "run", observe=observe) as stage:
        outcome = stage.home()
        stage.pump(1.0)
        truth = backend.rig.truth.arrays()
    assert not read_run(tmp_path / "run").rows["homing_id"].any()
    behind = truth["t_ns"] > struck_t_ns[0]
    return outcome, truth["macro_position_m"][behind], truth["macro_drive_state"][behind]


@pytest.mark.parametrize("for_s", [0.317, 1e3], ids=["and comes back", "for good"])
def test_an_encoder_that_jumps_under_a_held_index_is_no_reason_to_ramp_down(
    for_s, tmp_path, oled_profile, oled_machine
):
    """Its drive goes with it, by that and its loop's overshoot; stopped at once it made 7.7 mm of a jump of 0.6 mm."""
    backend = BatchBackend(oled_machine, seed=1)
    outcome, position_m, state = jumped_while_held(backend, tmp_path, oled_profile, for_s)
    assert outcome.stop is Stop.ENCODER_LOST
    assert outcome.detail.startswith("it jumped while the drive held its index on it; ")
    held_m = position_m[state != DriveState.SWITCH_ON_DISABLED]
    assert 0.5e-3 < np.abs(held_m - held_m[0]).max() < 1.2 * 590e-6


def test_a_drive_that_lets_go_while_a_jump_is_waited_out_gets_no_power_again(tmp_path, oled_profile, oled_machine):
    """It would be walked up with the start of a homing set, and search its index once more."""
    backend = BatchBackend(oled_machine, seed=1)
    turned = Fault("corrupt_frame", at_s=0.05, can_id=0x200 + MACRO, bits=0x2, count=1, duration_s=0.1)
    outcome, _, state = jumped_while_held(backend, tmp_path, oled_profile, 1e3, turned)
    assert outcome.stop is Stop.DRIVE_FAULT
    off = np.flatnonzero(state == DriveState.SWITCH_ON_DISABLED)
    assert not (state[off[0] :] == DriveState.OPERATION_ENABLED).any()


PATIENT = {"trip__sensor_age_s": 0.3, "trip__overrun_s": 0.3, "trip__rpdo_deadline_s": 0.1}


def touched_by_a_late_host(folder, late_for_s):
    """Home where the host is away for 12 ms in every 200 ms of touching, from its first cycle on."""
    backend, began_t_ns, rows_count = BatchBackend(load_machine("oled-printer"), seed=1), [], 0

    def hold_up(rows):
        nonlocal rows_count
        if not rows["homing_id"].any() or rows["run_phase"][-1] != Phase.TRACKING:
            return
        began_t_ns.append(backend.wire.t_ns)
        rows_count += rows.size
        if rows_count >= 200 and backend.wire.t_ns - began_t_ns[0] < 1e9 * late_for_s:
            rows_count = 0
            backend.wire.advance_to(backend.wire.t_ns + 12_000_000)

    profile = with_values(load_profile("oled-printer"), **PATIENT)
    with Supervisor(profile, backend, folder, observe=hold_up) as stage:
        return stage.home(), 1e-9 * (backend.wire.t_ns - began_t_ns[0])


def test_a_sweep_that_the_host_spoilt_is_swept_again(tmp_path):
    """Neither edge was learnt, though both were met: that is no joint out of reach."""
    home, took_s = touched_by_a_late_host(tmp_path / "once", 6.0)
    assert home.finished
    machine = load_machine("oled-printer").backlash
    assert home.backlash is not None
    assert machine is not None
    assert home.backlash.width_m == pytest.approx(machine.left_m + machine.right_m, abs=4.0 * home.backlash.left_sd_m)
    assert took_s > 12.0
    with pytest.raises(DriveError, match=r"in 4 sweeps at .* with [1-9]\d+ missed cycles; .* the host"):
        touched_by_a_late_host(tmp_path / "always", 100.0)


# ---- a joint that has worn wider than the profile says ----


class Touched(NamedTuple):
    """What a homing touched, by the rig's own log from where its zeros were taken."""

    greatest_force_n: float
    low_m: float  # macro minus end
    high_m: float


def worn(machine, side, by_m):
    """Copy a machine whose joint is wider on one side."""
    edge_m = getattr(machine.backlash, f"{side}_m") + by_m
    return with_values(machine, **{f"backlash__{side}_m": edge_m})


def touched(folder, backend, first_id=1) -> Touched:
    """Look at what happened since a homing took its zeros: the search of the index before shakes the joint as well."""
    rows, truth = read_run(folder).rows, backend.rig.truth.arrays()
    later = truth["t_ns"] > rows["sample_t_ns"][np.flatnonzero(rows["homing_id"] >= first_id)[0]]
    relative_m = (truth["macro_position_m"] - truth["end_position_m"])[later]
    return Touched(np.abs(truth["contact_force_n"][later]).max(), relative_m.min(), relative_m.max())


@pytest.mark.parametrize("side", ["left", "right"])
@pytest.mark.parametrize("by_m", [150e-6, 235e-6, 400e-6])
def test_a_joint_that_has_worn_is_homed_and_its_width_is_told(side, by_m, tmp_path, oled_profile, oled_machine):
    """A gap wider than believed by more than a sweep presses was out of reach on its other side, for ever."""
    machine = worn(oled_machine, side, by_m)
    backend = BatchBackend(machine, seed=1)
    with Supervisor(oled_profile, backend, tmp_path / "run") as stage:
        home = stage.home()
        believed = stage.believed_backlash()
        status = stage.status()
    assert home.finished
    assert home.backlash is not None
    found, true_m = home.backlash, machine.backlash.left_m + machine.backlash.right_m
    assert found.width_m == pytest.approx(true_m, abs=4.0 * np.hypot(found.left_sd_m, found.right_sd_m))
    assert np.hypot(found.left_sd_m, found.right_sd_m) < 0.32e-6  # both edges were pressed in full
    assert believed["left_m"] + believed["right_m"] == found.width_m
    assert found.centre_m == pytest.approx(0.5 * (oled_profile.backlash.right_m - oled_profile.backlash.left_m))
    assert abs(status["setpoint_relative_position_m"]) < 0.5 * true_m
    assert touched(tmp_path / "run", backend).greatest_force_n < oled_profile.backlash.touch_force_n
    assert any(event["event"] == "joint_wider" for event in read_run(tmp_path / "run").events)


def test_a_worn_joint_is_homed_again_as_gently(tmp_path, oled_profile, oled_machine):
    """Its micro had come to rest beside an edge: a sweep of the width that was found pressed it with 5.6 N."""
    backend = BatchBackend(worn(oled_machine, "left", 400e-6), seed=1)
    with Supervisor(oled_profile, backend, tmp_path / "run") as stage:
        first = stage.home()
        stage.disarm()
        stage.pump(40.0)
        second = stage.home()
    assert first.finished
    assert second.finished
    assert first.backlash is not None
    assert second.backlash is not None
    tolerance_m = 4.0 * np.hypot(first.backlash.left_sd_m, second.backlash.left_sd_m)
    assert second.backlash.width_m == pytest.approx(first.backlash.width_m, abs=tolerance_m)
    assert touched(tmp_path / "run", backend, 2).greatest_force_n < oled_profile.backlash.touch_force_n
    rows = read_run(tmp_path / "run").rows
    first_count, second_count = (np.unique(rows["segment_number"][rows["homing_id"] == k]).size for k in (1, 2))
    assert second_count < first_count  # from the first edge on it goes by the width that was found


@pytest.mark.parametrize("side", ["left", "right"])
def test_a_joint_that_is_out_of_reach_is_an_error_that_says_how_far_was_looked(
    side, tmp_path, oled_profile, oled_machine
):
    machine = worn(oled_machine, side, 1.2e-3)
    backend = BatchBackend(machine, seed=1)
    with Supervisor(oled_profile, backend, tmp_path / "run") as stage:
        with pytest.raises(DriveError, match=r"the widest for a gap of 0\.(686|929) mm \(.*micro\.stroke_m\)"):
            stage.home()
        assert not stage.status()["stop"]
        assert stage.status()["phase"] == Phase.TRACKING
        believed = stage.believed_backlash()
    assert (believed["left_m"], believed["right_m"]) == (oled_profile.backlash.left_m, oled_profile.backlash.right_m)
    seen = touched(tmp_path / "run", backend)
    assert seen.greatest_force_n < oled_profile.backlash.touch_force_n
    low_m, high_m = machine.micro.stroke_m
    assert low_m < -seen.high_m
    assert -seen.low_m < high_m


def test_a_stop_in_a_wider_sweep_leaves_what_was_believed(tmp_path, oled_profile, oled_machine):
    backend = BatchBackend(worn(oled_machine, "left", 400e-6), seed=1)

    def stop_when_wider(what, share):
        if what == "touching both edges" and stage.believed_backlash()["left_m"] > 2.0 * oled_profile.backlash.left_m:
            stage.ask_to_stop()

    with Supervisor(oled_profile, backend, tmp_path / "run", stop_when_wider) as stage:
        assert stage.home().stop is Stop.OPERATOR
        believed = stage.believed_backlash()
    assert (believed["left_m"], believed["right_m"]) == (oled_profile.backlash.left_m, oled_profile.backlash.right_m)


def test_an_edge_that_answers_and_can_not_be_told_is_pressed_no_harder(tmp_path):
    """The damped joint of kang-2023, 4.5 mm wider: five sweeps more pressed it with 11 N."""
    profile, machine = load_profile("kang-2023"), worn(load_machine("kang-2023"), "right", 4.5e-3)
    backend = BatchBackend(machine, seed=1)
    assert profile.backlash is not None
    with (
        Supervisor(profile, backend, tmp_path / "run") as stage,
        pytest.raises(DriveError, match=r"what answered there with .* N could not be identified"),
    ):
        stage.home()
    assert touched(tmp_path / "run", backend).greatest_force_n < 1.25 * profile.backlash.touch_force_n
