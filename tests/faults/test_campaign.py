"""The campaign in short: a few seeds of it, and judges that see what they are there for."""

from dataclasses import replace

import numpy as np
import pytest

from bench.service_batch import RUNS
from tests.faults import campaign
from tests.faults.judge import (
    BACK,
    BEGUN,
    COURSE,
    LIMP,
    LOST,
    NONSENSE,
    STANDSTILL,
    STRANGER,
    STRUCK,
    TRAVEL,
    Record,
    judge,
)
from tests.faults.kinds import KINDS, MACRO, MICRO, PHASES, SILENCE_S, Drawn
from tests.faults.limp import shorted_way_m
from tests.faults.mechanics import mechanics_of
from tests.faults.nonsense import nonsense
from tests.faults.scene import PROFILE, Facts
from tests.faults.witness import ENABLED

SEEDS = (8, 12, 46, 162, 183, 230, 13095)
"""46: a macro position that stands still while the macro moves. 162: an obstacle that was pressed for a second is gone.
183: a stop in an identification sent the macro off. 230: a macro that swung back was taken for one that stands.
13095: a bit that turned over took the macro's power while it moved.
"""
_STOPPED = 5  # QUICK_STOP_ACTIVE


@pytest.mark.parametrize("seed", SEEDS)
def test_a_seed_of_the_campaign(seed, tmp_path):
    result = campaign.run(seed, tmp_path / "run")
    assert result.verdict is not None
    assert result.verdict.violations == (), result.line


def test_every_kind_is_drawn_and_a_seed_is_the_same_run_again():
    drawn = [campaign.drawn(seed) for seed in range(len(KINDS))]
    assert [kind for kind, *_ in drawn] == list(KINDS)
    assert [one[2].text for one in drawn] == [campaign.drawn(seed)[2].text for seed in range(len(KINDS))]


@pytest.mark.parametrize(
    ("bits", "without_power"), [(0x1, True), (0x2, True), (0x4, False), (0x6, True), (0x8, True), (0x30080, False)]
)
def test_a_controlword_that_asks_for_no_power_takes_it(bits, without_power):
    """CiA 402: bit 2 alone is a quick stop; bits 0, 1 and 3 are enable voltage, switch on, enable operation."""
    kind = list(KINDS).index("frames corrupted")
    drawn = [campaign.drawn(seed)[2] for seed in range(kind, 15000, len(KINDS))]
    to_drives = [one for one in drawn if one.faults[0].can_id in (0x201, 0x202)]
    of_bits = [one for one in to_drives if one.faults[0].bits & 0xF == bits & 0xF]
    assert of_bits
    for one in of_bits:
        assert one.without_power == ((one.faults[0].can_id & 0x7F,) if without_power else ())


def rest_after(ramp_m_per_s2: float, noticed_s: float = 0.02) -> tuple[Facts, Record]:
    """Make the log of a macro at 0.4 m/s that a fault at 1 s stops, as it should be: 1 kHz, 2 s."""
    t_s = np.arange(2000) * 1e-3
    speed = 0.4 - ramp_m_per_s2 * (t_s - 1.0 - noticed_s).clip(min=0.0)
    velocity = speed.clip(min=0.0)
    states = np.full((2000, 2), ENABLED)
    states[t_s > 1.0 + noticed_s] = _STOPPED
    position = np.cumsum(velocity) * 1e-3
    seen = {
        "t_ns": (t_s * 1e9).astype(np.int64),
        "macro_velocity_m_per_s": velocity,
        "macro_position_m": position,
        "end_velocity_m_per_s": velocity.copy(),
        "end_position_m": position + 70e-6,
        "micro_force_n": np.zeros(2000),
        "states": states,
    }
    facts = Facts(
        fault_t_ns=1_000_000_000,
        judged_until_t_ns=1_900_000_000,
        begun_t_ns=500_000_000,
        phase="constant speed",
        fault_kind="LINK_SILENT",
        seen=seen,
        sync_t_ns=seen["t_ns"] + 400_000,
    )
    record = Record([])
    noticed = seen["t_ns"] >= round(1e9 * (1.0 + noticed_s))
    record.columns = {
        "t_ns": seen["t_ns"],
        "run_phase": np.where(noticed, 6, 4),
        "stop": np.where(noticed, 18, 0),
        "setpoint_position_m": position + 70e-6 - 12e-3,  # its zero is its own
        "setpoint_velocity_m_per_s": velocity.copy(),
    }
    return facts, record


def unstopped(phase: str) -> tuple[Facts, Record]:
    """Make the log of what no fault stopped: 0.4 m/s, to rest by the plan's 0.9 m/s^2, or a stage that holds.

    Its end is reached at 1.5 s; 1 kHz, 2 s.
    """
    facts, record = rest_after(2.0)
    t_s = facts.seen["t_ns"] * 1e-9
    speed = np.zeros(2000) if phase == "at rest" else (0.4 - 0.9 * (t_s - 1.05).clip(min=0.0)).clip(min=0.0)
    position = np.cumsum(speed) * 1e-3
    facts.seen |= {
        "macro_velocity_m_per_s": speed,
        "macro_position_m": position,
        "end_velocity_m_per_s": speed.copy(),
        "end_position_m": position + 70e-6,
    }
    facts.seen["states"][:] = ENABLED
    record.columns |= {
        "run_phase": np.full(2000, 4),
        "stop": np.zeros(2000, np.int64),
        "setpoint_position_m": position + 70e-6 - 12e-3,
        "setpoint_velocity_m_per_s": speed.copy(),
    }
    facts.phase, facts.fault_kind, facts.planned_m_per_s = phase, "", 0.4
    facts.unasked = [(1_900_000_000, 1_990_000_000)]
    if phase == "constant speed":
        facts.target_m = float(position[-1] + 70e-6 - 12e-3)
    if phase == "jogging":
        facts.said_t_ns = 700_000_000
    return facts, record


FAULT = Drawn("frames lost", detection_s=SILENCE_S, lasts_s=0.3)


def bars_missed(facts: Facts, record: Record, drawn: Drawn = FAULT) -> set[str]:
    return {bar for bar, _ in judge(drawn, facts, record).violations}


def test_a_stop_as_it_should_be_misses_no_bar():
    facts, record = rest_after(2.0)
    verdict = judge(FAULT, facts, record)
    assert verdict.violations == ()
    assert verdict.travel_m == pytest.approx(0.4 * 0.02 + 0.4**2 / 4.0, abs=1e-3)
    assert verdict.bound_m == pytest.approx(0.4 * 0.022 + 0.4**2 / 4.0, rel=0.05)


def test_judges_see_a_stop_that_is_too_late_or_too_gentle():
    assert bars_missed(*rest_after(1.6)) == {TRAVEL}
    assert bars_missed(*rest_after(2.0, noticed_s=0.06)) == {TRAVEL}


@pytest.mark.parametrize(("told_late_s", "missed"), [(5e-3, set()), (0.0, {TRAVEL, BEGUN})])
def test_a_drive_whose_commands_come_late_stops_when_it_is_told(told_late_s, missed):
    """Until then it may do what it was told before, and nothing else."""
    facts, record = rest_after(2.0, noticed_s=0.025)
    told = facts.seen["t_ns"] >= 1_020_000_000
    record.columns |= {"run_phase": np.where(told, 6, 4), "stop": np.where(told, 29, 0)}
    late = Drawn("frames late", lasts_s=0.1, told_late_s=told_late_s)
    facts.planned_m_per_s = 0.4
    assert bars_missed(facts, record, late) == missed
    facts.seen["macro_velocity_m_per_s"][1022] = 0.45
    assert bars_missed(facts, record, late) == missed | {TRAVEL}


def test_judges_see_a_drive_that_goes_on_after_detection():
    facts, record = rest_after(2.0)
    facts.seen["states"][1000:1040] = ENABLED
    assert BEGUN in bars_missed(facts, record)


def test_an_end_that_swings_gives_the_macro_its_blow_and_no_more():
    swings = replace(FAULT, swings=True, lasts_s=0.5)
    given_m = mechanics_of(PROFILE).struck_m(0.2)
    assert given_m == pytest.approx(2.0 * 39.6 / (39.6 + 70.7) * 0.2 / (2.0 * np.pi * 20.0), rel=1e-3)
    for way_m, missed in ((0.9 * given_m, set()), (5e-3, {TRAVEL, STANDSTILL})):
        facts, record = rest_after(2.0)
        facts.seen["end_velocity_m_per_s"][1250] += 0.2
        facts.seen["macro_position_m"][1300:1400] += way_m * np.sin(np.linspace(0.0, np.pi, 100))
        assert bars_missed(facts, record, swings) == missed


def test_on_a_host_that_keeps_no_time_cycles_are_counted_by_sync():
    facts, record = rest_after(2.0)
    facts.seen["states"][1000:1040] = ENABLED
    facts.is_host_time = True
    noticed_t_ns = record.noticed_t_ns(facts.fault_t_ns)
    held_up = (facts.sync_t_ns > noticed_t_ns) & (facts.sync_t_ns < 1_040_000_000)
    assert BEGUN in bars_missed(facts, record)
    facts.sync_t_ns = facts.sync_t_ns[~held_up]
    assert judge(FAULT, facts, record).begun_cycles <= 1.0


def test_judges_see_a_stage_that_moves_again():
    facts, record = rest_after(2.0)
    facts.seen["macro_position_m"][1600:] += 30e-6
    assert bars_missed(facts, record) == {STANDSTILL}
    facts, record = rest_after(2.0)
    facts.seen["states"][1700:1705, 1] = ENABLED
    assert bars_missed(facts, record) == {STANDSTILL}


def test_a_macro_that_stood_all_the_time_that_was_seen_of_it_stood_still():
    """A fault of the service itself, which closes that world, and the rig with it, before the servo hears of it."""
    facts, record = rest_after(2.0)
    facts.judged_until_t_ns = 1_015_000_000
    facts.seen["macro_velocity_m_per_s"][:] = 0.0
    facts.seen["macro_position_m"][:] = 0.2
    assert bars_missed(facts, record) == {STANDSTILL}  # 15 ms are no standstill
    facts.judged_until_t_ns = 1_220_000_000
    record.columns["stop"][:], record.columns["run_phase"][:] = 0, 3
    facts.seen["states"][:] = ENABLED
    assert bars_missed(facts, record) == set()
    facts.seen["macro_velocity_m_per_s"][1100] = 2e-3
    assert bars_missed(facts, record) == {STANDSTILL}


def test_judges_see_an_axis_that_is_let_go_of_before_it_rests():
    facts, record = rest_after(2.0)
    velocity = facts.seen["macro_velocity_m_per_s"]
    coasts = np.arange(2000) > np.flatnonzero(velocity > 3e-3)[-1]
    facts.seen["states"][coasts] = 1
    velocity[coasts] = 3e-3
    facts.seen["macro_position_m"] = np.cumsum(velocity) * 1e-3
    assert bars_missed(facts, record) == {TRAVEL, STANDSTILL}


def test_a_drive_lets_go_of_what_stood_a_cycle_before():
    for speed_m_per_s, missed in ((0.9e-3, set()), (1.5e-3, {TRAVEL, STANDSTILL})):
        facts, record = rest_after(2.0)
        facts.seen["macro_velocity_m_per_s"][1219] = speed_m_per_s
        facts.seen["macro_velocity_m_per_s"][1220:] = np.linspace(1.2e-3, 0.05, 780)  # its power went: it rolls
        facts.seen["macro_position_m"][:] = np.cumsum(facts.seen["macro_velocity_m_per_s"]) * 1e-3
        facts.seen["states"][1220:] = 1
        assert bars_missed(facts, record) == missed


@pytest.mark.parametrize(("speed_m_per_s", "missed"), [(0.0, set()), (3e-3, {STANDSTILL})])
def test_a_macro_that_a_homing_had_let_go_of_rolls_and_was_at_rest_then(speed_m_per_s, missed):
    """Between the drive's homing and the law's power it has none; counts that are stuck are noticed there."""
    stuck = Drawn("counts stuck", detection_s=np.inf, lasts_s=0.6)
    facts, record = rest_after(2.0, noticed_s=0.35)
    facts.phase, facts.fault_kind = "homing", "REFERENCE_LOST"
    rolls = np.arange(2000) >= 1300
    facts.seen["states"][:] = ENABLED
    facts.seen["states"][rolls] = 1
    velocity = np.where(rolls, speed_m_per_s + 20e-6 * (np.arange(2000) - 1300), 0.0)
    velocity[1290:1300] = speed_m_per_s
    facts.seen |= {"macro_velocity_m_per_s": velocity, "macro_position_m": 0.2 + np.cumsum(velocity) * 1e-3}
    record.columns["run_phase"] = np.select([np.arange(2000) >= 1350, rolls], [7, 0], 3)
    assert bars_missed(facts, record, stuck) == missed
    facts.seen["states"][1500:1510] = ENABLED
    assert bars_missed(facts, record, stuck) == missed | {STANDSTILL}


@pytest.mark.parametrize(
    ("phase", "given_at", "missed"),
    [("homing", 1010, set()), ("homing", 1060, {STANDSTILL}), ("stopping", 1010, {STANDSTILL})],
)
def test_a_homing_gives_power_until_its_fault_has_to_be_noticed(phase, given_at, missed):
    """However late it is noticed: a macro that told nothing was waited for for 2 s, while the micro had power."""
    facts, record = rest_after(2.0, noticed_s=0.1)
    facts.phase = phase
    for name in ("macro_velocity_m_per_s", "end_velocity_m_per_s", "macro_position_m", "end_position_m"):
        facts.seen[name][:] = 0.0
    facts.seen["states"][:] = 1
    facts.seen["states"][given_at:1100, 1] = ENABLED
    assert bars_missed(facts, record) == missed


def test_judges_see_a_drive_that_creeps_on_before_it_stands():
    """What it does in the 0.2 s behind |v| < 1 mm/s is travel, and no more than a loop that settles."""
    facts, record = rest_after(2.0)
    facts.seen["macro_position_m"][1350:] += 3e-3
    assert bars_missed(facts, record) == {TRAVEL, STANDSTILL}


def test_judges_see_a_macro_that_coasts_faster_than_the_guard_lets_it_be():
    """0.5 m/s where the way is long; 1 cm before the end of travel no more than what 2 m/s^2 can stop: 0.2 m/s."""
    dark = replace(FAULT, without_power=(MACRO,))
    facts, record = rest_after(0.0, noticed_s=0.9)
    facts.seen["macro_position_m"] += 0.0135 - facts.seen["macro_position_m"][1000]
    facts.seen["states"][1000:] = 1
    assert STRUCK not in bars_missed(facts, record, dark)
    facts.seen["macro_velocity_m_per_s"][1300] = 0.53  # and what magnets and cables give it: 0.51
    assert STRUCK in bars_missed(facts, record, dark)
    facts.seen["macro_velocity_m_per_s"][1300] = 0.4
    facts.seen["macro_position_m"] += 0.44 - facts.seen["macro_position_m"][1000]
    assert STRUCK in bars_missed(facts, record, dark)


def test_judges_see_a_micro_whose_winding_was_left_open():
    """Beside a macro that its ramp stops from 0.4 m/s: shorted, the way that the rig's own motion has."""
    dark = replace(FAULT, without_power=(MICRO,))
    machine = mechanics_of("oled-printer").machine
    facts, record = rest_after(2.0)
    shorted_m, open_m = (shorted_way_m(machine, facts.seen, 1000, 1600, shorted=how) for how in (True, False))
    assert 1.1 * shorted_m < open_m
    macro_m, end_m = (facts.seen[f"{axis}_position_m"] for axis in ("macro", "end"))
    end_m[1200] = macro_m[1200] - shorted_m
    assert bars_missed(facts, record, dark) == set()
    end_m[1200] = macro_m[1200] - open_m
    assert bars_missed(facts, record, dark) == {LIMP}


PUSHED = replace(FAULT, obstacle_m=20e-3, lasts_s=0.3)


def test_an_obstacle_pushes_back_and_the_stop_s_own_end_is_all_that_it_comes_back_to():
    facts, record = rest_after(2.0)
    position = facts.seen["macro_position_m"]
    ended_m = position[-1]
    position[1250:1300] = ended_m - 4e-3  # against the wall, until it is gone at 1.3 s
    assert bars_missed(facts, record) == {STANDSTILL}
    assert bars_missed(facts, record, PUSHED) == set()
    position[1300:] = ended_m + 4e-3
    assert bars_missed(facts, record, PUSHED) == {TRAVEL}
    position[1300:] = ended_m
    position[1850:] += 30e-6
    assert bars_missed(facts, record, PUSHED) == {STANDSTILL}


@pytest.mark.parametrize(("obstacle_m", "missed"), [(3e-3, set()), (20e-3, {TRAVEL})])
def test_what_had_struck_an_obstacle_when_its_stop_began_is_thrown_back(obstacle_m, missed):
    """Where none was struck, what goes that way goes forward."""
    facts, record = rest_after(2.0)
    position, velocity = facts.seen["macro_position_m"], facts.seen["macro_velocity_m_per_s"]
    back_m_per_s = np.where(np.arange(2000) < 1020, 0.05, 0.2)
    thrown = slice(1010, 1200)
    position[thrown] = position[1009] - 1e-3 * np.cumsum(back_m_per_s[thrown])
    velocity[thrown] = -back_m_per_s[thrown]
    position[1200:], velocity[1200:] = position[1199], 0.0
    noticed = replace(PUSHED, detection_s=float("inf"), obstacle_m=obstacle_m)
    assert bars_missed(facts, record, noticed) == missed


def test_what_a_plan_may_gain_counts_only_where_speed_was_gained():
    """0.3 s until it is noticed: at constant speed the plan's 0.9 m/s^2 is no excuse for another 70 mm."""
    facts, record = rest_after(2.0, noticed_s=0.3)
    slow = replace(FAULT, detection_s=0.3)
    verdict = judge(slow, facts, record)
    assert verdict.bound_m == pytest.approx(0.4 * 0.301 + 0.4**2 / 4.0, rel=0.01)
    assert TRAVEL not in {bar for bar, _ in verdict.violations}


@pytest.mark.parametrize(("turns_at_m", "missed"), [(0.501, set()), (0.45, {TRAVEL})])
def test_a_macro_without_power_comes_back_only_from_a_stop_that_it_struck(turns_at_m, missed):
    facts, record = rest_after(2.0)
    dark = replace(FAULT, without_power=(MACRO,))
    facts.seen["states"][1000:, 0] = 1
    t_s, begin_m = facts.seen["t_ns"] * 1e-9, facts.seen["macro_position_m"][1000]
    there_m = begin_m + 0.4 * (t_s - 1.0).clip(min=0.0)
    comes_back = there_m >= turns_at_m
    position = np.where(comes_back, 2.0 * turns_at_m - there_m, there_m)[1000:]
    facts.seen["macro_position_m"][1000:] = facts.seen["end_position_m"][1000:] = position
    facts.seen["macro_velocity_m_per_s"][1000:] = np.where(comes_back, -0.4, 0.4)[1000:]
    assert bars_missed(facts, record, dark) == missed


def test_a_deaf_drive_has_until_its_own_watch_and_no_longer():
    for after_s, missed in ((0.02, set()), (0.03, {BEGUN})):
        facts, record = rest_after(2.0, noticed_s=after_s)
        record.columns["stop"][1002:] = 18
        record.columns["run_phase"][1002:] = 6
        fault = replace(FAULT, detection_s=0.04)
        assert bars_missed(facts, record, fault) == {BEGUN}
        assert bars_missed(facts, record, replace(fault, deaf=(MACRO,))) == missed


@pytest.mark.parametrize("more", [{}, {"swings": True}, {"obstacle_m": 20e-3}], ids=["", "swings", "obstacle"])
def test_a_drift_without_power_is_measured_and_no_command(more):
    """Also where the fault is not over before the power is."""
    facts, record = rest_after(2.0)
    facts.seen["states"][1500:] = 1
    facts.seen["macro_position_m"][1600:] += 30e-6
    verdict = judge(replace(FAULT, lasts_s=0.8, **more), facts, record)
    assert verdict.violations == ()
    assert verdict.drift_m == pytest.approx(30e-6)


def test_judges_see_cycles_without_a_row():
    facts, record = rest_after(2.0)
    record.columns = {name: np.delete(values, slice(1200, 1203)) for name, values in record.columns.items()}
    verdict = judge(FAULT, facts, record)
    assert {bar for bar, _ in verdict.violations} == {LOST}
    assert verdict.cycles_lost == 3


def test_rows_without_a_sync_hide_none_that_is_lost():
    facts, record = rest_after(2.0)
    facts.sync_t_ns = np.delete(facts.sync_t_ns, slice(1100, 1150))  # bus-off: rows go on
    record.columns = {name: np.delete(values, slice(1200, 1203)) for name, values in record.columns.items()}
    assert judge(FAULT, facts, record).cycles_lost == 3


@pytest.mark.parametrize(("gone", "count"), [(slice(1180, 2000), 40), (slice(0, 520), 20)])
def test_judges_see_a_run_without_its_end_or_its_begin(gone, count):
    """The macro comes to rest at 1.22 s; the motion began at 0.5 s."""
    facts, record = rest_after(2.0)
    record.columns = {name: np.delete(values, gone) for name, values in record.columns.items()}
    verdict = judge(FAULT, facts, record)
    assert {bar for bar, _ in verdict.violations} == {LOST}
    assert verdict.cycles_lost == pytest.approx(count, abs=2)


def test_a_drive_that_is_enabled_again_is_seen_without_a_fault_too():
    facts, record = rest_after(2.0)
    facts.seen["states"][1700:1705, 1] = ENABLED
    stopping = replace(facts, fault_kind="", phase="stopping")
    assert STANDSTILL in bars_missed(stopping, record)


def test_judges_see_what_should_not_have_happened():
    facts, record = rest_after(2.0)
    assert bars_missed(facts, record, replace(FAULT, may_stop=False)) == {COURSE}
    assert bars_missed(replace(facts, fault_kind=""), record) == {COURSE}
    assert bars_missed(replace(facts, accepted=["move"]), record) == {STRANGER}
    edited = replace(FAULT, nonsense=nonsense(np.random.default_rng(0), "oled-printer"))
    assert bars_missed(facts, record, edited) == {NONSENSE}  # nobody said that it was read
    assert bars_missed(replace(facts, reread=["read again"]), record, edited) == {NONSENSE}
    clear = replace(edited, nonsense=replace(edited.nonsense, named=()))
    refused = replace(facts, reread=["kept as it was: /a/mine.toml: mass_kg is missing; add it"])
    assert bars_missed(refused, record, clear) == set()
    assert bars_missed(replace(refused, opened_anew=True), record, clear) == {NONSENSE}
    assert bars_missed(replace(facts, trouble="not homed"), record) == {BACK}


GOES_BY = Drawn("frames doubled", must_stop=False, lasts_s=0.1)


@pytest.mark.parametrize("phase", ["at rest", "constant speed", "jogging", "identifying"])
def test_a_motion_that_nothing_stopped_misses_no_bar_where_it_is_the_one_that_was_asked_for(phase):
    assert judge(GOES_BY, *unstopped(phase)).violations == ()


def test_a_stage_that_holds_is_seen_to_move_without_a_fault_too():
    facts, record = unstopped("at rest")
    facts.seen["macro_position_m"][1200:] += 30e-6
    assert bars_missed(facts, record, GOES_BY) == {STANDSTILL}
    facts, record = unstopped("at rest")
    for name in ("macro_position_m", "end_position_m"):
        facts.seen[name][1200:] += 0.1
    facts.seen["macro_velocity_m_per_s"][1150:1200] = 2.0
    assert bars_missed(facts, record, GOES_BY) == {STANDSTILL, TRAVEL}


@pytest.mark.parametrize(("moved_m", "missed"), [(190e-6, set()), (210e-6, {STANDSTILL})])
def test_an_end_that_its_motor_cannot_hold_moves_its_macro_by_the_error_limit_at_most(moved_m, missed):
    facts, record = unstopped("at rest")
    facts.seen["macro_position_m"][1200:1500] += moved_m
    assert bars_missed(facts, record, replace(GOES_BY, swings=True)) == missed


@pytest.mark.parametrize(
    ("moved_m", "words", "missed"),
    [(270e-6, 8192, set()), (310e-6, 8192, {STANDSTILL}), (21e-6, 64, set()), (30e-6, 64, {STANDSTILL})],
)
def test_a_macro_at_rest_is_thrown_by_a_force_that_a_frame_told_its_drive_wrongly(moved_m, words, missed):
    """2 kN on 70.7 kg for 1 ms: 28 mm/s; 71 um until they are taken back, 200 um by the ramp; 32 N: 1.2 um in all."""
    facts, record = unstopped("at rest")
    facts.seen["macro_position_m"][1001:1030] += moved_m
    assert bars_missed(facts, record, replace(GOES_BY, kicked_words=words, kicked_s=1e-3)) == missed


@pytest.mark.parametrize("phase", ["constant speed", "jogging", "identifying"])
def test_a_motion_that_leaves_its_reference_is_seen_without_a_fault_too(phase):
    """The guard's limit is 200 um; 3 ms of 0.4 m/s until it can have noticed."""
    for off_m, missed in ((1.3e-3, set()), (1.5e-3, {TRAVEL})):
        facts, record = unstopped(phase)
        facts.seen["end_position_m"][1100:1200] += off_m
        assert bars_missed(facts, record, GOES_BY) == missed


def test_a_reference_that_runs_away_with_the_stage_is_seen_by_its_speed_and_by_its_end():
    facts, record = unstopped("constant speed")
    facts.seen["macro_velocity_m_per_s"][1100:1200] = 0.45
    assert bars_missed(facts, record, GOES_BY) == {TRAVEL}
    facts, record = unstopped("constant speed")
    facts.target_m = (facts.target_m or 0.0) - 30e-6
    assert bars_missed(facts, record, GOES_BY) == {TRAVEL}
    facts, record = unstopped("identifying")
    facts.seen["macro_velocity_m_per_s"][1895:] = 0.1
    assert bars_missed(facts, record, GOES_BY) == {STANDSTILL}


def test_a_jog_that_nobody_holds_any_more_is_seen_to_go_on():
    """0.3 s of hold and 0.17 s that its plan looks ahead, from 0.4 m/s: 297 mm with its way to stop."""
    facts, record = unstopped("jogging")
    facts.said_t_ns = 400_000_000
    assert bars_missed(facts, record, GOES_BY) == {TRAVEL}


def test_a_stop_that_the_operator_asked_for_is_one_without_a_fault_too():
    """Half of the drive's ramp, by the law, and its power is taken 0.1 s after its rest; 25 ms until it begins."""
    for asked_s, missed in ((1.04, set()), (1.0, {TRAVEL})):
        facts, record = unstopped("stopping")
        t_s = facts.seen["t_ns"] * 1e-9
        speed = (0.4 - 1.0 * (t_s - 1.05).clip(min=0.0)).clip(min=0.0)
        facts.seen["macro_velocity_m_per_s"], facts.seen["macro_position_m"] = speed, np.cumsum(speed) * 1e-3
        facts.seen["states"][int(np.flatnonzero(speed < 5e-4)[0]) + 100 :] = 1
        facts.stop_asked_t_ns = round(1e9 * asked_s)
        assert bars_missed(facts, record, GOES_BY) == missed
        facts.seen["states"][1300:] = 1  # let go of at 0.15 m/s
        assert STANDSTILL in bars_missed(facts, record, GOES_BY)


def test_until_a_fault_is_noticed_that_need_not_be_the_motion_is_the_one_that_was_asked_for():
    facts, record = rest_after(2.0, noticed_s=0.2)
    facts.planned_m_per_s = 0.4
    may = replace(FAULT, detection_s=float("inf"), must_stop=False)
    assert bars_missed(facts, record, may) == set()
    facts.seen["end_position_m"][1050:1150] += 2e-3
    assert bars_missed(facts, record, may) == {TRAVEL}


@pytest.mark.parametrize("axis", [0, 1])
def test_an_acknowledgement_that_gives_power_or_moves_the_stage_is_seen(axis):
    facts, record = rest_after(2.0)
    facts.unasked = [(1_900_000_000, 1_990_000_000)]
    assert bars_missed(facts, record) == set()
    facts.seen["states"][1950:, axis] = ENABLED
    assert bars_missed(facts, record) == {STANDSTILL}
    facts, record = rest_after(2.0)
    facts.unasked = [(1_900_000_000, 1_990_000_000)]
    facts.seen["macro_position_m"][1950:] += 30e-6
    assert bars_missed(facts, record) == {STANDSTILL}


def test_a_jog_whose_operator_has_vanished_is_judged_by_its_own_hold_and_not_by_the_lease():
    facts, record = unstopped("jogging")
    t_s = facts.seen["t_ns"] * 1e-9
    gone = Drawn("client vanishes", detection_s=0.8, silent=True)
    for ends_s, missed in ((1.4, set()), (1.6, {TRAVEL})):
        speed = (0.2 - 0.9 * (t_s - ends_s).clip(min=0.0)).clip(min=0.0)
        facts.seen["macro_velocity_m_per_s"], facts.seen["macro_position_m"] = speed, np.cumsum(speed) * 1e-3
        facts.seen["states"][1800:] = _STOPPED
        record.columns["run_phase"][1800:], record.columns["stop"][1800:] = 6, 18
        left = replace(facts, fault_kind="LEASE", planned_m_per_s=0.2)
        assert bars_missed(left, record, gone) == missed


def test_a_fault_that_never_struck_shows_nothing():
    facts, record = unstopped("at rest")
    facts.struck = False
    assert bars_missed(facts, record, GOES_BY) == {COURSE}


def test_the_seeded_part_has_those_that_must_stop_of_kinds_that_may_go_by():
    drawn = [campaign.drawn(seed) for seed in range(RUNS)]
    either = ("statusword stuck", "encoder glitch", "interferometer silent", "host overrun", "supervisor hangs")
    assert {kind for kind, _, fault, _ in drawn if kind in either and fault.must_stop} == set(either)
    assert {phase for kind, phase, *_ in drawn if kind == "obstacle"} >= {"constant speed"}
    assert "jogging" in {phase for kind, phase, *_ in drawn if kind == "client vanishes"}
    many = [campaign.drawn(seed) for seed in range(900)]
    for one in either:
        musts = [fault.must_stop for kind, _, fault, _ in many if kind == one]
        assert 0.25 < sum(musts) / len(musts) < 0.75
    phases = [phase for kind, phase, *_ in many if kind == "obstacle"]
    assert set(phases) == set(PHASES)
    fallen_behind = [fault.must_stop for kind, _, fault, _ in many if kind == "following error"]
    assert sum(fallen_behind) >= 5
    vanished = [phase for kind, phase, *_ in many if kind == "client vanishes"]
    assert sum(phase == "jogging" for phase in vanished) >= 0.5 * len(vanished)


def test_a_drive_goes_with_its_own_encoder_and_no_further():
    lies = replace(FAULT, encoder_m=1e-3)
    for off_m, missed in ((1.1e-3, set()), (1.5e-3, {STANDSTILL})):
        facts, record = rest_after(2.0)
        facts.seen["macro_position_m"][1600:] += off_m
        assert bars_missed(facts, record) == {STANDSTILL}
        assert bars_missed(facts, record, lies) == missed


def test_what_only_a_law_needs_need_not_stop_a_drive_that_homes_by_itself():
    silent, macro_deaf, micro_deaf = (
        replace(FAULT, by_lasers=True),
        replace(FAULT, deaf=(MACRO,)),
        replace(FAULT, deaf=(MICRO,)),
    )
    for powered, drawn, missed in (
        (False, silent, set()),
        (True, silent, {COURSE}),
        (False, micro_deaf, set()),
        (True, micro_deaf, {COURSE}),
        (False, macro_deaf, {COURSE}),
        (False, FAULT, {COURSE}),
    ):
        facts, record = unstopped("at rest")
        facts.phase = "homing"
        facts.seen["states"][:, 1] = 1
        facts.seen["states"][1310 if powered else 1330 :, 1] = ENABLED  # while they fail, or not: 0.3 s, 21 ms
        assert bars_missed(facts, record, drawn) == missed


def test_what_throws_a_macro_back_behind_a_stop_counts_from_its_power_on():
    facts, record = unstopped("stopping")
    facts.stop_asked_t_ns = 1_040_000_000
    velocity, off = facts.seen["macro_velocity_m_per_s"], 1900
    facts.seen["states"][off:] = 1
    velocity[off:] = 0.012
    assert bars_missed(facts, record, GOES_BY) == {TRAVEL}  # by the plan's ramp it goes further than a stop may
    velocity[off - 1] = 0.012
    assert bars_missed(facts, record, GOES_BY) == {TRAVEL, STANDSTILL}


def test_while_nobody_sees_it_magnets_may_change_what_moves_a_stage():
    """0.17 m/s^2 for 0.3 s: 51 mm/s, 7.6 mm."""
    blind = replace(GOES_BY, lasts_s=0.3, open_loop=True)
    for gained_m_per_s, off_m, missed in ((0.07, 7e-3, set()), (0.1, 0.0, {TRAVEL}), (0.0, 9.5e-3, {TRAVEL})):
        facts, record = unstopped("identifying")
        facts.seen["macro_velocity_m_per_s"][1000:1040] += gained_m_per_s
        facts.seen["end_position_m"][1000:1300] += off_m
        assert bars_missed(facts, record, blind) == missed
        assert bars_missed(facts, record, GOES_BY) == {TRAVEL}
