"""Everything that can go wrong at speed: a clear reason, a stage at rest, every row kept, an exact replay."""

import contextlib
import math
import re
from dataclasses import dataclass

import can
import numpy as np
import pytest

from drivers import cia402
from drivers.wire import Inbox
from sim_backend.faults import Fault
from stagectl import servo_process
from stagectl.backend import BatchBackend
from stagectl.errors import DriveError, LinkError, RecordError, RequestError, TimingError
from stagectl.outcome import BacklashEstimate
from stagectl.profile import Identity
from stagectl.record import read_run
from stagectl.replay import replay
from stagectl.requests import Mode, Phase
from stagectl.row import SENSOR_BYTES_COUNT
from stagectl.signals import SETPOINT, STOP_TEXT, Stop
from stagectl.supervisor import Supervisor
from tests.small_disk import small_disk
from tests.stage import with_values
from tests.struck_stage import REST_M_PER_S, SEED, SPEED_M_PER_S, Stage, Strike, home_by_truth, inject, struck

MACRO, MICRO = 1, 2  # node ids
MACRO_TPDO, MICRO_TPDO, MICRO_RPDO, SYNC = 0x181, 0x182, 0x202, 0x080
EVERY_FRAME = (SYNC, 0x081, 0x082, 0x181, 0x182, 0x201, 0x202, 0x281, 0x282)
POSITIVE_LIMIT, STO, PRESSURE = 0x2, 0x8, 0x1_0000
ENCODER_FAULT = 0x7305
HARD_STOP_M = 1e-3


# ---- what does not stop a run -----------------------------------------------------------------------------------


def hold_the_host_up(duration_s: float) -> Strike:
    """Let the world go on while no cycle runs."""

    def strike(stage, backend):
        backend.wire.advance_to(backend.wire.t_ns + round(duration_s * 1e9))

    return strike


def test_small_disturbances_go_on_and_are_counted(tmp_path, oled_profile, oled_machine):
    """Garbage, a half frame, three missing samples, late and doubled frames, a lost RPDO and SYNC, a slow host."""
    faults = (
        Fault("garbage", count=60),
        Fault("garbage", at_s=0.02, count=600),  # more than one row holds
        Fault("half_line", at_s=0.04, length_count=12),
        Fault("sensor_silence", at_s=0.06, duration_s=0.003),
        Fault("duplicate_frame", at_s=0.08, can_id=MACRO_TPDO, duration_s=0.01),
        Fault("delay_frame", at_s=0.10, can_id=MACRO_TPDO, delay_s=1.5e-3, duration_s=0.01),
        Fault("drop_frame", at_s=0.12, can_id=MICRO_RPDO, count=1),
        Fault("drop_frame", at_s=0.14, can_id=SYNC, count=1),
    )

    def strike(stage, backend):
        hold_the_host_up(0.010)(stage, backend)
        inject(*faults)(stage, backend)

    seen = struck(tmp_path / "run", oled_profile, oled_machine, strike)
    assert seen.outcome.stop is Stop.FINISHED
    rows = seen.run.rows
    assert rows["samples_lost"][-1] == 1 + 3
    assert rows["cycles_missed"][-1] == 9
    end = seen.run.manifest["end"]
    assert (end["lost_samples"], end["discarded_bytes"], end["missed_cycles"]) == (4, 60 + 600 + 12, 9)
    assert rows["sensor_bytes_count"].max() == SENSOR_BYTES_COUNT
    assert rows.size == seen.rows_written
    assert np.abs(seen.relative_m).max() < 0.4e-3
    assert seen.replays() == ""


# ---- what does ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Case:
    """One fault at speed and how the run must end."""

    strike: Strike
    stop: Stop
    text: str  # a pattern: what, where, value, limit
    guided: bool = False  # the micro must stay off its hard stops
    profile: dict | None = None


def drop(*can_ids: int) -> Strike:
    """Lose frames for 0.3 s; the run must not go on afterwards."""
    return inject(*(Fault("drop_frame", can_id=can_id, duration_s=0.3) for can_id in can_ids))


def flood(stage, backend):
    """Another node talks without end, with a better id than anybody's."""
    for _ in range(600):
        backend.wire.bus.submit(1, backend.wire.t_ns, 0x001, bytes(8))


def fall_silent(stage, backend):
    """The supervisor publishes nothing for a while."""
    stage.link.pass_time(0.8)


def let_the_lease_go(stage, backend):
    """Renew the lease no more."""
    stage._holds_lease = False


def jump(stage, backend):
    """The reference leaps by a millimetre."""
    stage.link.segments["position_m"][:] += 1e-3


def leave_the_stroke(stage, backend):
    """The reference sends the micro against its stops, at its leisure: the following error stays small."""
    rows = stage.link.segments
    left = slice(int(stage.status()["segment_left_rows"]) * -1 + stage._segment_free, stage._segment_free)
    count = rows[left].size
    rows["relative_position_m"][left] = np.linspace(0.0, -3e-3, count)


def believe_nan(stage, backend):
    """A belief without a number reaches the law."""
    stage._belief["micro_mass_kg"] = math.nan
    decoder = backend.servo.decoder
    stage._publish_update(decoder.macro_zero_counts, decoder.end_zero_counts)


def lose_the_reference(stage, backend):
    """The setpoints are nan from here on."""
    stage.link.segments["position_m"][:] = math.nan


CASES = {
    "end beam": Case(inject(Fault("beam_loss", axis="end")), Stop.REFERENCE_LOST, "no beam on end"),
    "macro beam": Case(inject(Fault("beam_loss", axis="macro")), Stop.REFERENCE_LOST, "no beam on macro"),
    "stuck counts": Case(
        inject(Fault("stuck_counts")), Stop.REFERENCE_LOST, r"macro counts are stuck: .* moved \d+ um .* limit 50 um"
    ),
    "sensor restart": Case(inject(Fault("sensor_restart")), Stop.REFERENCE_LOST, "restarted: its numbers went back"),
    "sequence gap": Case(
        inject(Fault("sequence_gap", count=2)), Stop.REFERENCE_LOST, r"jumped ahead by 2: sample \d+ came 1\.\d ms"
    ),
    "silence": Case(
        inject(Fault("sensor_silence")), Stop.SENSOR_AGE, r"newest sample \d+ is 20\.\d ms old, limit 20 ms; check"
    ),
    "noise instead of lines": Case(
        inject(*(Fault("half_line", at_s=0.001 * k, length_count=20) for k in range(40))),
        Stop.SENSOR_AGE,
        r"newest sample \d+ is 20\.\d ms old",
    ),
    "unplugged": Case(inject(Fault("unplug")), Stop.LINK_LOST, r"port is gone \(unplugged\); plug it in, then home"),
    "CAN silent": Case(
        drop(*EVERY_FRAME), Stop.LINK_SILENT, r"macro \(node 1\): nothing for 21 cycles, limit 20; micro \(node 2\)"
    ),
    "macro silent": Case(drop(MACRO_TPDO), Stop.LINK_SILENT, r"macro \(node 1\): nothing for 21 cycles", guided=True),
    "micro silent": Case(drop(MICRO_TPDO), Stop.LINK_SILENT, r"micro \(node 2\): nothing for 21 cycles, limit 20;"),
    "SYNC lost": Case(drop(SYNC), Stop.EMERGENCY, r"node \d: EMCY 0x8700 synchronisation lost"),
    "bus-off": Case(inject(Fault("bus_off", duration_s=0.3)), Stop.LINK_LOST, "bus-off: check cable"),
    "short PDO": Case(
        inject(Fault("short_frame", can_id=MACRO_TPDO, length_count=4, duration_s=0.3)),
        Stop.LINK_LOST,
        r"macro \(node 1\): PDO of 4 bytes, .* needs 8; .* arm again",
    ),
    "short EMCY": Case(
        inject(
            Fault("short_frame", can_id=0x082, length_count=1),
            Fault("emergency", node_id=MICRO, code=ENCODER_FAULT),
        ),
        Stop.LINK_LOST,
        "emergency message of 1 bytes",
    ),
    "micro EMCY": Case(
        inject(Fault("emergency", node_id=MICRO, code=ENCODER_FAULT)), Stop.EMERGENCY, "node 2: EMCY 0x7305 encoder 1"
    ),
    "limit switch": Case(
        inject(Fault("input", node_id=MACRO, bits=POSITIVE_LIMIT)),
        Stop.DIGITAL_INPUT,
        r"macro \(node 1\): positive limit switch \(0x60FD = 0x2\); .* the macro off .* by hand in negative direction",
        guided=True,
    ),
    "pressure": Case(
        inject(Fault("input", node_id=MACRO, bits=PRESSURE)), Stop.DIGITAL_INPUT, "pressure low", guided=True
    ),
    "STO of the micro": Case(inject(Fault("input", node_id=MICRO, bits=STO)), Stop.DIGITAL_INPUT, r"micro .*: STO"),
    "heartbeat": Case(
        inject(Fault("heartbeat_silence", node_id=MACRO)),
        Stop.HEARTBEAT_LOST,
        r"macro \(node 1\): \d+ ms ago, limit 200 ms",
        guided=True,
    ),
    "full queue": Case(flood, Stop.COMMAND_LOST, r"\d+ frames were refused so far"),
    "host held up": Case(hold_the_host_up(0.03), Stop.OVERRUN, r"began 29\.\d ms late, limit 20 ms"),
    "supervisor silent": Case(fall_silent, Stop.SUPERVISOR_SILENT, r"for 0\.50\d s, limit 0\.5 s", guided=True),
    "lease": Case(let_the_lease_go, Stop.LEASE, r"it ended \d+\.\d ms ago", guided=True),
    "nan": Case(believe_nan, Stop.COMMAND_NOT_FINITE, "dsmc asked nan N of the macro, nan N of the micro"),
    "nan in position mode": Case(  # where a target that is nan has no integer that could be sent
        lose_the_reference,
        Stop.FOLLOWING_ERROR,
        "end nan um from its",
        guided=True,
        profile={"macro__mode": "position"},
    ),
    "following error": Case(
        jump, Stop.FOLLOWING_ERROR, r"end -1000\.\d um from its reference at 0\.\d+ m, limit 200 um", guided=True
    ),
    "micro stroke": Case(
        leave_the_stroke, Stop.MICRO_STROKE, r"end minus macro -?0\.95\d* mm, allowed -0\.95 .. 0\.95"
    ),
    "too fast for the way left": Case(
        inject(),
        Stop.VELOCITY,
        r"macro at 0\.0\d+ m with 0\.\d+ m/s would come to rest at 0\.0[67]\d+ m, "
        r"travel and following error end at 0\.0702 m",
        guided=True,
        profile={"macro__travel_m": (-0.05, 0.07)},
    ),
}


@pytest.mark.parametrize("name", CASES)
def test_a_fault_at_speed_ends_the_run_and_the_stage_rests(name, tmp_path, oled_profile, oled_machine):
    """The reason with its numbers, the macro at rest, no drive left enabled, every row kept, every row replayed."""
    case = CASES[name]
    seen = struck(tmp_path / "run", with_values(oled_profile, **(case.profile or {})), oled_machine, case.strike)
    assert seen.outcome.stop is case.stop, seen.outcome.text
    assert re.search(case.text, seen.outcome.detail), seen.outcome.detail
    assert seen.outcome.text.startswith(STOP_TEXT[case.stop])
    assert seen.rest_velocity_m_per_s < REST_M_PER_S
    assert "OPERATION_ENABLED" not in seen.drive_states
    if case.guided:
        assert np.abs(seen.relative_m).max() < 0.5 * HARD_STOP_M
    rows = seen.run.rows
    assert rows.size == seen.rows_written
    assert not seen.run.truncated
    assert seen.run.manifest["end"]["stop"] == case.stop.name
    assert case.stop.name in [event.get("stop") for event in seen.run.events]
    assert not np.isin(rows["run_phase"][-200:], (Phase.TRACKING, Phase.ENABLING)).any()  # nothing came back by itself
    assert seen.replays() == ""


def test_a_micro_that_can_be_trusted_stops_gently_whatever_braked_the_macro(tmp_path, oled_profile, oled_machine):
    """The macro's drive reports a fault and ramps down by itself; only then it loses its power, and may drift."""
    strike = inject(Fault("emergency", node_id=MACRO, code=ENCODER_FAULT))
    seen = struck(tmp_path / "run", oled_profile, oled_machine, strike)
    assert seen.outcome.stop is Stop.EMERGENCY
    assert "node 1: EMCY 0x7305 encoder 1" in seen.outcome.detail
    after = seen.truth["t_ns"] >= seen.struck_t_ns
    assert np.abs(seen.truth["macro_velocity_m_per_s"][after]).min() < REST_M_PER_S
    assert np.abs(seen.relative_m).max() < 0.5 * HARD_STOP_M
    assert [event["code"] for event in seen.run.events if event["event"] == "emergency"] == [ENCODER_FAULT]
    assert seen.replays() == ""


def test_an_axis_without_torque_is_said_to_coast(tmp_path, oled_profile, oled_machine):
    """After STO nothing brakes the macro: the micro stays on it as long as it can, and the text warns."""
    seen = struck(tmp_path / "run", oled_profile, oled_machine, inject(Fault("input", node_id=MACRO, bits=STO)))
    assert seen.outcome.stop is Stop.DIGITAL_INPUT
    assert re.search(r"macro \(node 1\): STO .* was not seen to stand within 5 s: keep clear", seen.outcome.detail)
    assert np.abs(seen.relative_m[:1500]).max() < 0.5 * HARD_STOP_M
    assert seen.replays() == ""


def test_a_stage_that_swings_keeps_its_power_until_it_rests(tmp_path, oled_profile, oled_machine):
    """An end that its motor can't hold, and a law that fights for it: macro let go of at 4 mm/s when only the
    reference was looked at.
    """

    def strike(stage, backend):
        inject(Fault("weak_motor", at_s=0.06, node_id=MICRO, force_ratio=0.45, duration_s=1.0))(stage, backend)
        let_the_lease_go(stage, backend)

    seen = struck(tmp_path / "run", oled_profile, oled_machine, strike)
    assert seen.outcome.stop is Stop.LEASE
    stopping = seen.run.rows[seen.run.rows["run_phase"] == Phase.STOPPING]
    reference_rests_t_ns = stopping["t_ns"][np.flatnonzero(stopping["setpoint_velocity_m_per_s"] != 0.0)[-1]]
    let_go = np.searchsorted(seen.truth["t_ns"], stopping["t_ns"][-1])
    swings = slice(np.searchsorted(seen.truth["t_ns"], reference_rests_t_ns + 50_000_000), let_go)
    speed = np.abs(seen.truth["macro_velocity_m_per_s"])
    assert speed[swings].max() > 2.0 * REST_M_PER_S
    assert speed[let_go - 50 : let_go + 1].max() < REST_M_PER_S
    assert seen.replays() == ""


def test_a_second_fault_during_a_guided_stop_is_told_too(tmp_path, oled_profile, oled_machine):
    def strike(stage, backend):
        jump(stage, backend)
        inject(Fault("beam_loss", at_s=0.03, axis="end"))(stage, backend)

    seen = struck(tmp_path / "run", oled_profile, oled_machine, strike)
    assert seen.outcome.stop is Stop.FOLLOWING_ERROR
    assert seen.outcome.detail.endswith("; then no beam on end")
    assert seen.rest_velocity_m_per_s < REST_M_PER_S
    assert {Phase.GUIDED_STOP, Phase.QUICK_STOP} <= set(seen.run.rows["run_phase"])
    assert seen.replays() == ""


def test_a_law_that_asks_for_too_much_is_cut_off(tmp_path, oled_profile, oled_machine):
    """A law whose own limit is gone; what was put into its memory is in no record, so the replay ends there."""

    def strike(stage, backend):
        law = backend.servo.tracker.active.law
        law["precision_force_limit_n"], law["error_integral_m_s"] = 1e6, 1.0

    seen = struck(tmp_path / "run", oled_profile, oled_machine, strike)
    assert seen.outcome.stop is Stop.FORCE
    assert re.search(r"asked -1000000\.0 N of the micro, limit 180 N", seen.outcome.detail)
    assert seen.rest_velocity_m_per_s < REST_M_PER_S
    row = seen.first_stop_row
    assert seen.run.rows["micro_word"][row] == 0
    assert seen.replays(row) == ""


def test_one_axis_stops_when_its_sensor_falls_silent(tmp_path, single_profile, single_machine):
    one = Stage(tmp_path / "run", single_profile, single_machine)
    with one:
        assert one.stage.enable() is Stop.NONE
        inject(Fault("sensor_silence", at_s=0.35))(one.stage, one.backend)
        outcome = one.stage.move(float(one.stage.status()["setpoint_position_m"]) + 0.05)
        assert outcome.stop is Stop.SENSOR_AGE
        assert abs(one.plant["macro_velocity_m_per_s"]) < REST_M_PER_S
    assert replay(tmp_path / "run").exact


# ---- the run's disk, and the person at the keyboard --------------------------------------------------------------


def arm_and_move(one: Stage, strike: Strike) -> None:
    """Open, arm, move, strike; whatever that raises leaves a closed stage."""
    with one:
        assert one.arm() is Stop.NONE
        one.move(strike)


def speed_when_stopped(one: Stage, run) -> float:
    """Return the macro's true speed when the servo said that it stands; without power it may drift afterwards."""
    stopped_t_ns = run.rows["t_ns"][run.rows["run_phase"] == Phase.STOPPED][0]
    truth = one.backend.truth()
    return abs(truth["macro_velocity_m_per_s"][np.searchsorted(truth["t_ns"], stopped_t_ns)])


def test_a_full_disk_stops_the_stage_and_leaves_a_readable_run(tmp_path, oled_profile, oled_machine):
    """What was written stays, what comes until the stage rests still fits, and the error says what to do."""
    with small_disk(tmp_path / "disk", 24 << 20) as disk:
        filler = disk / "filler"

        def strike(stage, backend):
            stage.recorder.flush()
            with filler.open("wb") as file, contextlib.suppress(OSError):
                while True:
                    file.write(bytes(1 << 16))

        one = Stage(disk / "run", oled_profile, oled_machine)
        with pytest.raises(RecordError, match=r"No space left .* held in memory; end the run, free space"):
            arm_and_move(one, strike)
        run = read_run(disk / "run")
        assert speed_when_stopped(one, run) < REST_M_PER_S
        assert "OPERATION_ENABLED" not in one.drive_states
        assert run.rows.size == one.backend.servo.ring.written_count
        assert run.manifest["end"]["stop"] == "RECORD_LOST"
        assert replay(disk / "run").exact


def test_ctrl_c_brings_the_stage_to_rest_and_closes_the_run(tmp_path, oled_profile, oled_machine):
    def strike(stage, backend):
        raise KeyboardInterrupt

    one = Stage(tmp_path / "run", oled_profile, oled_machine)
    with pytest.raises(KeyboardInterrupt):
        arm_and_move(one, strike)
    run = read_run(tmp_path / "run")
    assert speed_when_stopped(one, run) < REST_M_PER_S
    assert one.drive_states == ("SWITCH_ON_DISABLED", "SWITCH_ON_DISABLED")
    assert run.rows.size == one.backend.servo.ring.written_count
    assert not run.truncated
    assert replay(tmp_path / "run").exact


def test_closing_takes_the_power_away_even_after_a_fault(tmp_path, oled_profile, oled_machine):
    one = Stage(tmp_path / "run", oled_profile, oled_machine)
    with one:
        one.arm()
        assert one.move(jump).stop is Stop.FOLLOWING_ERROR
        assert one.drive_states == ("QUICK_STOP_ACTIVE", "SWITCH_ON_DISABLED")  # held until somebody decides
    assert one.drive_states == ("SWITCH_ON_DISABLED", "SWITCH_ON_DISABLED")


# ---- arming --------------------------------------------------------------------------------------------------------


def test_a_lost_reference_needs_a_homing(tmp_path, oled_profile, oled_machine):
    """Acknowledging is not enough, and nothing is powered before somebody has homed."""
    one = Stage(tmp_path / "run", oled_profile, oled_machine)
    with one:
        one.arm()
        assert one.move(inject(Fault("beam_loss", axis="end", duration_s=0.2))).stop is Stop.REFERENCE_LOST
        assert one.stage.acknowledge() is Stop.NONE
        one.stage.pump(0.5)
        assert one.drive_states == ("SWITCH_ON_DISABLED", "SWITCH_ON_DISABLED")
        powered_before = one.backend.servo.ring.written_count
        assert one.stage.enable() is Stop.REFERENCE_LOST
        assert one.stage.detail == "no beam on end"
        one.stage.acknowledge()
        assert one.stage.home().finished
        assert one.arm() is Stop.NONE
        assert one.move().finished
    run = read_run(tmp_path / "run")
    refused = run.rows[powered_before : powered_before + 40]
    assert not np.isin(refused["run_phase"], (Phase.ENABLING, Phase.TRACKING)).any()
    assert replay(tmp_path / "run").exact


@pytest.mark.parametrize("at_s", [0.0, 0.015], ids=["before", "as it gets power"])
@pytest.mark.parametrize(("can_id", "axis"), [(MACRO_TPDO, "macro"), (MICRO_TPDO, "micro")])
def test_a_drive_that_sends_nothing_gets_no_power(at_s, can_id, axis, tmp_path, oled_profile, oled_machine):
    """The other one had power for the 2 s that an arming may take, and the silent one was told to be off."""
    one = Stage(tmp_path / "run", oled_profile, oled_machine)
    with one:
        one.backend.rig.inject(Fault("drop_frame", at_s=at_s, can_id=can_id, duration_s=5.0), one.backend.wire.t_ns)
        asked_row = one.backend.servo.ring.written_count
        assert one.stage.enable() is Stop.LINK_SILENT
        assert re.match(rf"{axis} \(node [12]\): nothing for \d+ cycles, limit 20; ", one.stage.detail)
    rows = read_run(tmp_path / "run").rows[asked_row:]
    powered = rows["run_phase"] == Phase.ENABLING
    assert powered.any() == (at_s > 0.0)
    assert np.count_nonzero(powered) <= 21


@pytest.mark.parametrize("offset_m", [-4.5e-3, 4.5e-3])
def test_a_stage_whose_encoder_lies_stops_by_its_lasers(offset_m, tmp_path, oled_profile, oled_machine):
    """The drive's own stop ramps down on that encoder: it took a macro of 0.4 m/s to 0.7 and 55 mm too far."""
    jump = Fault("encoder_jump", node_id=MACRO, offset_m=offset_m, duration_s=0.06)
    one = struck(tmp_path / "run", oled_profile, oled_machine, inject(jump))
    assert one.outcome.stop is Stop.ENCODER_LOST
    assert "which jumped, differ by 4" in one.outcome.detail
    rows, after = one.run.rows, one.truth["t_ns"] >= one.struck_t_ns
    assert set(rows["run_phase"][rows["stop"] > 0]) <= {Phase.STOPPING}
    speed = np.abs(one.truth["macro_velocity_m_per_s"][after])
    assert speed.max() < 1.01 * SPEED_M_PER_S
    ramp_m = SPEED_M_PER_S**2 / (2.0 * oled_profile.macro.stop_deceleration_m_per_s2)
    way_m = np.abs(one.truth["macro_position_m"][after] - one.truth["macro_position_m"][after][0]).max()
    assert way_m < SPEED_M_PER_S * 0.008 + ramp_m + 1e-4
    at_rest_t_ns = rows["t_ns"][np.flatnonzero(rows["run_phase"] == Phase.STOPPED)[0]]
    assert np.interp(at_rest_t_ns, one.truth["t_ns"][after], speed) < REST_M_PER_S
    assert one.drive_states == ("SWITCH_ON_DISABLED", "SWITCH_ON_DISABLED")  # none that holds by it
    assert one.replays() == ""


def test_an_encoder_that_lied_needs_a_homing(tmp_path, oled_profile, oled_machine):
    one = Stage(tmp_path / "run", oled_profile, oled_machine)
    with one:
        one.arm()
        jump = Fault("encoder_jump", node_id=MACRO, offset_m=3e-3, duration_s=0.05)
        assert one.move(inject(jump)).stop is Stop.ENCODER_LOST
        assert one.stage.acknowledge() is Stop.NONE
        assert one.stage.status()["reference_lost"]
        assert one.stage.enable() is Stop.ENCODER_LOST
        assert "the drive's encoder, which jumped, differ by 3" in one.stage.detail
        one.stage.acknowledge()
        assert one.stage.home().finished
        assert one.arm() is Stop.NONE
        assert one.move().finished


def test_a_drive_in_fault_is_reset_by_an_acknowledgement_and_by_nothing_else(tmp_path, oled_profile, oled_machine):
    """Both drives in fault at once; enabling is refused before, works after, and never happens by itself."""
    both = inject(*(Fault("emergency", node_id=node_id, code=ENCODER_FAULT) for node_id in (MACRO, MICRO)))
    one = Stage(tmp_path / "run", oled_profile, oled_machine)
    with one:
        one.arm()
        assert one.move(both).stop is Stop.EMERGENCY
        one.stage.pump(1.0)
        assert one.drive_states == ("FAULT", "FAULT")
        assert one.stage.enable() is Stop.EMERGENCY
        assert one.drive_states == ("FAULT", "FAULT")
        assert one.stage.acknowledge() is Stop.NONE
        one.stage.pump(0.5)
        assert one.drive_states == ("SWITCH_ON_DISABLED", "SWITCH_ON_DISABLED")
        assert one.stage.status()["phase"] == Phase.IDLE
        assert one.arm() is Stop.NONE
        assert one.move().finished
    assert replay(tmp_path / "run").exact


@pytest.mark.parametrize(("bits", "away"), [(0x1, "in positive direction"), (0x3, "clear the cause")])
def test_a_pressed_limit_switch_refuses_power(bits, away, tmp_path, oled_profile, oled_machine):
    """Whoever powers the stage there does so without knowing which way is free: the switch is left by hand."""
    one = Stage(tmp_path / "run", oled_profile, oled_machine)
    with one:
        inject(Fault("input", node_id=MACRO, bits=bits, duration_s=0.2))(one.stage, one.backend)
        one.stage.pump(0.05)
        assert one.stage.enable() is Stop.DIGITAL_INPUT
        assert re.search(rf"macro \(node 1\): negative limit switch.*{away}", one.stage.detail)
        assert one.drive_states == ("SWITCH_ON_DISABLED", "SWITCH_ON_DISABLED")
        one.stage.pump(0.3)
        assert one.stage.acknowledge() is Stop.NONE
        assert one.stage.enable() is Stop.NONE


def test_an_open_interlock_refuses_power(tmp_path, oled_profile, oled_machine):
    one = Stage(tmp_path / "run", oled_profile, oled_machine)
    with one:
        inject(Fault("input", node_id=MACRO, bits=PRESSURE, duration_s=0.2))(one.stage, one.backend)
        one.stage.pump(0.05)
        assert one.stage.enable() is Stop.DIGITAL_INPUT
        assert "pressure low" in one.stage.detail
        assert one.stage.home().stop is Stop.DIGITAL_INPUT
        one.stage.pump(0.3)
        assert one.stage.enable() is Stop.DIGITAL_INPUT  # the cause is gone, the fault is not acknowledged
        assert one.stage.acknowledge() is Stop.NONE
        assert one.stage.enable() is Stop.NONE


def test_a_failed_port_stops_every_further_try(tmp_path, oled_profile, oled_machine):
    """A port that came back is not used again: arm anew."""
    one = Stage(tmp_path / "run", oled_profile, oled_machine)
    with one:
        inject(Fault("unplug", duration_s=0.1))(one.stage, one.backend)
        one.stage.pump(0.3)
        assert one.stage.enable() is Stop.LINK_LOST
        assert one.stage.acknowledge() is Stop.LINK_LOST
        assert "unplugged" in one.stage.detail
        assert one.drive_states == ("SWITCH_ON_DISABLED", "SWITCH_ON_DISABLED")


def test_a_host_that_was_slow_before_arming_does_not_hinder_it(tmp_path, oled_profile, oled_machine):
    """Drives without power that missed SYNC say so; that is recorded, and no reason against arming."""
    one = Stage(tmp_path / "run", oled_profile, oled_machine)
    with one:
        drop(SYNC)(one.stage, one.backend)
        one.stage.pump(0.5)
        assert one.stage.enable() is Stop.NONE
    run = read_run(tmp_path / "run")
    assert {event["code"] for event in run.events if event["event"] == "emergency"} == {0x8700}
    assert replay(tmp_path / "run").exact


def test_a_missing_heartbeat_refuses_to_enable(tmp_path, oled_profile, oled_machine):
    one = Stage(tmp_path / "run", oled_profile, oled_machine)
    with one:
        inject(Fault("heartbeat_silence", node_id=MICRO, duration_s=0.5))(one.stage, one.backend)
        one.stage.pump(0.3)
        one.stage.pump()
        assert one.stage.enable() is Stop.HEARTBEAT_LOST
        one.stage.pump(0.4)
        one.stage.pump()
        assert one.stage.enable() is Stop.NONE
    said = [event["event"] for event in read_run(tmp_path / "run").events]
    assert said.count("heartbeat_lost") == said.count("heartbeat_back") == 1


def test_a_stage_outside_its_travel_is_not_moved(tmp_path, oled_profile, oled_machine):
    profile = with_values(oled_profile, macro__travel_m=(-0.4, 0.005))
    one = Stage(tmp_path / "run", profile, oled_machine)
    with one:
        assert one.stage.enable() is Stop.TRAVEL
        said = r"macro at 0\.01\d+ m, travel and following error allow -0\.4002 \.\. 0\.0052 m; home it"
        assert re.search(said, one.stage.detail)
    assert replay(tmp_path / "run").exact


def test_a_belief_that_is_none_is_refused(tmp_path, oled_profile, oled_machine):
    one = Stage(tmp_path / "run", oled_profile, oled_machine)
    with one, pytest.raises(RequestError, match=r"must be finite, width and stiffness above 0"):
        one.stage.take_backlash(BacklashEstimate(2e-5, math.nan, 1e-8, 1e-8, 1e4, 1e4, 1.0, 1.0))


def test_setpoints_that_are_none_are_refused(tmp_path, oled_profile, oled_machine):
    one = Stage(tmp_path / "run", oled_profile, oled_machine)
    setpoints = np.zeros(10, SETPOINT)
    setpoints["velocity_m_per_s"][7] = math.inf
    with one:
        one.arm()
        setpoints["position_m"] = one.stage.status()["setpoint_position_m"]
        with pytest.raises(RequestError, match=r"leap: setpoint 7 has velocity_m_per_s = inf; every value must be"):
            one.stage.follow(setpoints, "leap")


def arm(profile, backend, folder) -> None:
    """Configure the drives and let go again."""
    with Supervisor(profile, backend, folder):
        pass


def as_hardware(machine) -> BatchBackend:
    """The rig behind a backend that demands the profile's own identity of every node, as hardware does."""
    backend = BatchBackend(machine, seed=SEED)
    backend.vendor_id = None
    return backend


def with_identity(profile, **numbers):
    """Copy a profile that names the rig's drives as its own; `numbers` are of the micro's drive."""
    rig = {"vendor_id": 0x5254}
    macro = Identity(**rig, product_code=0x10001)
    return with_values(
        profile, macro__identity=macro, micro__identity=Identity(**{**rig, "product_code": 0x10002, **numbers})
    )


def test_every_identity_number_of_the_profile_is_compared(tmp_path, oled_profile, oled_machine):
    profile = with_identity(oled_profile, revision_number=0x10000, serial_number=1)
    backend = as_hardware(oled_machine)
    arm(profile, backend, tmp_path / "run")
    assert backend.servo is not None  # no servo is started before every drive is armed


@pytest.mark.parametrize(
    ("number", "pattern"),
    [
        ("product_code", r"node 2: 0x1018:02 product code: wanted 0x7, read 0x10002; swap the node ids"),
        ("revision_number", r"node 2: 0x1018:03 revision number: wanted 0x7, read 0x10000; load the firmware"),
        ("serial_number", r"node 2: 0x1018:04 serial number: wanted 0x7, read 0x1; this is another unit"),
    ],
)
def test_another_unit_than_the_profile_names_is_not_armed(number, pattern, tmp_path, oled_profile, oled_machine):
    with pytest.raises(DriveError, match=pattern):
        arm(with_identity(oled_profile, **{number: 7}), as_hardware(oled_machine), tmp_path / "run")


def test_the_rig_plays_whatever_unit_a_profile_names(tmp_path, oled_profile, oled_machine):
    backend = BatchBackend(oled_machine, seed=SEED)
    arm(with_identity(oled_profile, vendor_id=0x539, serial_number=7), backend, tmp_path / "run")
    assert backend.servo is not None


GENTLE = {"trip__heartbeat_s": 0.01, "macro__acceleration_limit_m_per_s2": 2.0}
"""What drives without an RPDO deadline leave of oled-printer: the voice coil needs 80 N of the 140 N of their cap."""


def without_deadline(machine):
    """Copy a machine whose drives lack 0x1400:05."""
    return with_values(machine, macro__has_rpdo_deadline=False, micro__has_rpdo_deadline=False)


def test_drives_without_rpdo_deadline_are_armed_with_less_torque(tmp_path, oled_profile, oled_machine):
    """385.5 N and 140.2 N instead of 2000 N and 180 N: drives, laws and guard go by them, and so does the replay."""
    one = Stage(tmp_path / "run", with_values(oled_profile, **GENTLE), without_deadline(oled_machine))
    with one:
        assert [node.objects[0x6072 << 8] for node in one.backend.rig.nodes] == [771, 2337]
        said = list(one.stage.remarks)
        tracker = one.backend.servo.tracker
        for axis, law_limit, limit_n in (
            ("macro", "macro_force_limit_n", 385.5),
            ("micro", "precision_force_limit_n", 140.22),
        ):
            assert getattr(one.stage.profile, axis).force_limit_n == pytest.approx(limit_n)
            assert tracker.active.guard[f"{axis}_force_limit_n"][0] == pytest.approx(limit_n)
            assert tracker.active.law[law_limit][0] == pytest.approx(limit_n)
        assert one.arm() is Stop.NONE
        assert one.move().finished
    assert len(said) == 2
    assert all("no RPDO deadline (0x1400:05): a dead servo is noticed by its heartbeat after 11 ms" in t for t in said)
    run = read_run(tmp_path / "run")
    assert [event["text"] for event in run.events if event["event"] == "remark"] == said
    assert np.abs(run.rows["micro_word"]).max() <= 2337
    assert replay(tmp_path / "run").exact


def test_a_law_does_not_ask_beyond_the_cap(tmp_path, oled_profile, oled_machine):
    """A millisecond of an absurd error drives the law to its limit: what it asks ends at the cap, not at 180 N."""

    def strike(stage, backend):
        backend.servo.tracker.active.law["error_integral_m_s"] = 1.0

    machine = without_deadline(oled_machine)
    seen = struck(tmp_path / "run", with_values(oled_profile, **GENTLE), machine, strike)
    asked_n = np.abs(seen.run.rows["micro_force_asked_n"]).max()
    assert asked_n == pytest.approx(140.22)
    assert np.abs(seen.run.rows["micro_word"]).max() == 2337


def test_a_profile_whose_motion_the_cap_forbids_is_not_armed(tmp_path, oled_profile, oled_machine):
    pattern = (
        r"node 1 has no RPDO deadline .* after 201 ms, so its torque may be 1\.16 N at most .* takes 440 N; "
        r"shorten trip\.heartbeat_s to 0\.009 s"
    )
    with pytest.raises(DriveError, match=pattern):
        arm(oled_profile, BatchBackend(without_deadline(oled_machine), seed=SEED), tmp_path / "run")


def test_no_drive_gets_power_without_a_lease(tmp_path, oled_profile, oled_machine):
    """Not even for the cycles in which it is enabled."""
    one = Stage(tmp_path / "run", oled_profile, oled_machine)
    with one:
        one.stage._request(mode=int(Mode.TRACK))
        one.stage.pump(0.5)
        assert Stop(int(one.stage.status()["stop"])) is Stop.LEASE
        assert one.stage.detail.startswith("there was none when the drives were to get power")
        assert one.drive_states == ("SWITCH_ON_DISABLED", "SWITCH_ON_DISABLED")
        one.stage.acknowledge()
        assert one.arm() is Stop.NONE
    phases = read_run(tmp_path / "run").rows["run_phase"]
    assert phases[np.flatnonzero(phases == Phase.ENABLING)[0] - 1] == Phase.IDLE
    assert Phase.STOPPED in phases[: np.flatnonzero(phases == Phase.ENABLING)[0]]


def test_a_servo_that_hangs_in_a_jog_is_noticed(tmp_path, oled_profile, oled_machine, monkeypatch):
    """A jog has no end of its own, and what the servo said last is a stage that moves; the drives have stopped it."""
    one = Stage(tmp_path / "run", oled_profile, oled_machine)
    wire, asked = one.backend.wire, []

    def wanted():
        asked.append(wire.t_ns)
        assert len(asked) < 150
        if len(asked) == 50:
            monkeypatch.setattr(one.backend.servo, "cycle", lambda: wire.advance_to(wire.t_ns + 1_000_000))
        return 0.1

    one.__enter__()
    assert one.arm() is Stop.NONE
    with pytest.raises(TimingError, match=r"no cycle for 1\.5 s"):
        one.stage.jog(wanted)
    assert abs(one.plant["macro_velocity_m_per_s"]) < REST_M_PER_S
    with pytest.raises(TimingError, match=r"no cycle for 1\.5 s"):
        one.stage.close()
    assert read_run(tmp_path / "run").rows.size == one.backend.servo.ring.written_count


def killed_at_speed(folder, profile, machine, wait_s: float) -> Stage:
    """Move, then let nobody of ours live: no cycle, no SDO; `wait_s` pass on the rig."""

    class Killed(Exception):
        pass

    def strike(stage, backend):
        raise Killed

    one = Stage(folder, profile, machine)
    one.__enter__()
    assert one.arm() is Stop.NONE
    with pytest.raises(Killed):
        one.move(strike)
    one.stage.recorder.abandon()
    one.backend.wire.advance_to(one.backend.wire.t_ns + round(wait_s * 1e9))
    return one


def test_a_stage_whose_processes_were_killed_is_armed_again(tmp_path, oled_profile, oled_machine):
    """The macro's drive stands in QUICK_STOP_ACTIVE for good; arming takes it out of that, and says so."""
    left = killed_at_speed(tmp_path / "killed", oled_profile, oled_machine, 1.0)
    assert left.drive_states == ("QUICK_STOP_ACTIVE", "SWITCH_ON_DISABLED")
    backend = BatchBackend(oled_machine, seed=SEED, rig=left.backend.rig)
    with Supervisor(oled_profile, backend, tmp_path / "run") as stage:
        assert left.drive_states == ("SWITCH_ON_DISABLED", "SWITCH_ON_DISABLED")
        assert stage.remarks == [
            "node 1 stood in QUICK_STOP_ACTIVE, as a run that was killed leaves it; its power was taken away "
            "(0x6040 = 0), it shows SWITCH_ON_DISABLED"
        ]
        home_by_truth(stage, left.plant)
        assert stage.enable() is Stop.NONE
    assert replay(tmp_path / "run").exact


def test_a_servo_without_a_supervisor_brings_the_stage_to_rest_and_takes_the_power_away(
    tmp_path, oled_profile, oled_machine
):
    """Nobody is there who could: whoever comes next may be a person with a hand at the stage."""
    left = killed_at_speed(tmp_path / "killed", oled_profile, oled_machine, 0.0)
    assert left.drive_states == ("OPERATION_ENABLED", "OPERATION_ENABLED")
    servo = left.backend.servo
    nobodys_pid = 0
    assert servo_process._run(servo, nobodys_pid)
    assert servo.stop is Stop.SUPERVISOR_SILENT
    assert left.drive_states == ("SWITCH_ON_DISABLED", "SWITCH_ON_DISABLED")
    assert abs(left.plant["macro_velocity_m_per_s"]) < REST_M_PER_S


def test_a_stage_that_is_still_braking_is_not_let_go(tmp_path, oled_profile, oled_machine):
    """0.05 s after the kill, 0.02 s of them undetected: from 0.2 m/s at 2 m/s^2 some 0.1 m/s are left."""
    left = killed_at_speed(tmp_path / "killed", oled_profile, oled_machine, 0.05)
    backend = BatchBackend(oled_machine, seed=SEED, rig=left.backend.rig)
    with pytest.raises(DriveError, match=r"node 1: .* shows QUICK_STOP_ACTIVE, .* moves at 0\.0\d+ m/s by its encoder"):
        arm(oled_profile, backend, tmp_path / "run")
    assert left.drive_states[0] == "QUICK_STOP_ACTIVE"


def test_a_fault_of_a_former_run_stays_until_it_is_acknowledged(tmp_path, oled_profile, oled_machine):
    backend = BatchBackend(oled_machine, seed=SEED, faults=(Fault("emergency", node_id=MACRO, code=ENCODER_FAULT),))
    backend.wire.advance_to(backend.wire.t_ns + 100_000_000)
    with Supervisor(oled_profile, backend, tmp_path / "run") as stage:
        assert stage.enable() is not Stop.NONE
        assert backend.rig.nodes[0].drive.state.name == "FAULT"
        assert stage.acknowledge() is Stop.NONE
        assert backend.rig.nodes[0].drive.state.name == "SWITCH_ON_DISABLED"


def test_drives_of_another_world_are_not_armed(tmp_path, oled_profile, oled_machine):
    backend = BatchBackend(oled_machine, seed=SEED)
    backend.vendor_id = None  # as hardware: the profile's own vendor
    with pytest.raises(DriveError, match=r"node 1: 0x1018:01 vendor id: wanted 0x539, read 0x5254; .* correct"):
        arm(oled_profile, backend, tmp_path / "run")


class ForgetfulBus(can.BusABC):
    """A bus on which one drive stores something else than it was told: the value of one SDO download is changed."""

    def __init__(self, bus: can.BusABC, command: bytes, value: bytes) -> None:
        super().__init__(channel="forgetful")
        self.channel_info = "forgetful"
        self._inner, self._command, self._value = bus, command, value

    def attach(self, on_frame) -> None:
        self._inner.attach(on_frame)

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        data = bytes(msg.data)
        if data.startswith(self._command):
            data = self._command + self._value
        self._inner.send(can.Message(arbitration_id=msg.arbitration_id, is_extended_id=False, data=data), timeout)

    def shutdown(self) -> None:
        super().shutdown()
        self._inner.shutdown()


def test_a_mapping_that_differs_is_not_armed(tmp_path, oled_profile, oled_machine):
    """TPDO1's second entry, 0x6064 with 32 bits, is stored as 0x60FD: both exist, only reading back tells."""
    backend = BatchBackend(oled_machine, seed=SEED)
    told = bytes([0x23, 0x00, 0x1A, 0x02])  # SDO download of four bytes to 0x1A00:02
    stored = bytes([0x20, 0x00, 0xFD, 0x60])
    bus = ForgetfulBus(backend.network_bus(), told, stored)
    backend.network_bus = lambda: bus
    pattern = r"node 1: 0x1A00:02 mapped object 2: wrote \d+ \(0x60640020\), read \d+ \(0x60FD0020\)"
    with pytest.raises(DriveError, match=pattern):
        arm(oled_profile, backend, tmp_path / "run")


@pytest.mark.parametrize(
    ("fault", "pattern"),
    [
        (Fault("sensor_silence"), r"no steady valid samples within 5 s: nothing came; check its power and cable"),
        (Fault("beam_loss", axis="both"), r"\d+ bytes came in the last second, no valid sample; check beams"),
        (Fault("unplug"), r"port is gone \(unplugged\)"),
    ],
    ids=lambda value: value.kind if isinstance(value, Fault) else "",
)
def test_an_interferometer_that_says_nothing_is_not_armed(fault, pattern, tmp_path, oled_profile, oled_machine):
    backend = BatchBackend(oled_machine, seed=SEED, faults=(fault,))
    with pytest.raises(LinkError, match=pattern), Supervisor(oled_profile, backend, tmp_path / "run"):
        pass
    assert not read_run(tmp_path / "run").truncated


# ---- small parts ---------------------------------------------------------------------------------------------------


def test_an_emergency_is_not_hidden_by_its_own_reset():
    """Both arrive in one cycle: the loop must still see that there was one."""
    inbox = Inbox()
    raised, reset = bytes([0x05, 0x73, 0x01, 0, 0, 0, 0, 0]), bytes(8)
    inbox.take("macro_emcy", raised)
    inbox.take("macro_emcy", reset)
    assert cia402.decode_emergency(inbox.macro_emcy)[0] == ENCODER_FAULT
    inbox.clear()
    inbox.take("macro_emcy", reset)
    assert inbox.macro_emcy == reset
