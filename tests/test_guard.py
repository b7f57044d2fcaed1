"""The last word before the wire: every reason to stop is reached, each limit from both sides, and nan never passes."""

import math

import numpy as np
import pytest

from stagectl import guard
from stagectl.signals import COMMAND, MEASUREMENT, MODE_TOLD, SETPOINT, STOP_TEXT, Stop
from stagectl.stop_text import stop_detail
from tests.stage import with_values

MS = 1_000_000
ENABLED = 0x1637  # voltage, remote, target reached: state bits say Operation enabled
CODES = {Stop[name[1:]] for name in vars(guard) if name[1:] in Stop.__members__} - {Stop.NONE}
"""What the guard can answer; all other codes come from the servo, which knows requests, ports and clocks."""


class Cycle:
    """A guard, a measurement and a setpoint that are well; each test spoils one thing."""

    def __init__(self, profile, has_drives: bool = True) -> None:
        self.guard = guard.init(profile, has_drives=has_drives)
        self.measurement = np.zeros(1, MEASUREMENT)
        self.setpoint = np.zeros(1, SETPOINT)
        self.macro_n = self.micro_n = 0.0
        self.set(cycle=1000, sequence=1000, samples_new=1, tpdos_new=3, t_ns=10**12 + MS // 2, sample_t_ns=10**12)
        self.set(lease_left_ns=MS, macro_statusword=ENABLED, micro_statusword=ENABLED)

    def set(self, **values) -> "Cycle":
        """Write fields of the measurement, of the setpoint (`setpoint_...`), or the forces asked."""
        for name, value in values.items():
            if name in ("macro_n", "micro_n"):
                setattr(self, name, value)
            elif name.startswith("setpoint_"):
                self.setpoint[name.removeprefix("setpoint_")] = value
            else:
                self.measurement[name] = value
        return self

    def stop(self) -> Stop:
        """Judge this cycle."""
        code = guard.step(self.guard[0], self.measurement[0], self.setpoint[0], self.macro_n, self.micro_n)
        return Stop(code)

    def next(self, **values) -> Stop:
        """Judge the cycle a period later."""
        m = self.measurement
        self.set(cycle=m["cycle"] + 1, sequence=m["cycle"] + 1, t_ns=m["t_ns"] + MS, sample_t_ns=m["sample_t_ns"] + MS)
        return self.set(**values).stop()


@pytest.fixture
def cycle(oled_profile) -> Cycle:
    return Cycle(oled_profile)


def test_a_stage_that_is_well_goes_on(cycle):
    assert cycle.stop() is Stop.NONE
    for _ in range(1000):
        assert cycle.next() is Stop.NONE


# The greatest that passes and the least that stops, in the values of oled-printer: travel +-0.45 m, 2000 and 180 N,
# 200 um following error, +-0.95 mm of stroke, 20 ms of age and overrun.
LIMITS = [
    ({"macro_n": 2000.0}, {"macro_n": 2000.0001}, Stop.FORCE),
    ({"macro_n": -2000.0}, {"macro_n": -2000.0001}, Stop.FORCE),
    ({"micro_n": 59.9}, {"micro_n": 180.0001}, Stop.FORCE),
    ({"micro_n": -180.0}, {"micro_n": -180.0001}, Stop.FORCE),
    ({"end_position_m": 199e-6}, {"end_position_m": 201e-6}, Stop.FOLLOWING_ERROR),
    ({"end_position_m": -199e-6}, {"end_position_m": -201e-6}, Stop.FOLLOWING_ERROR),
    ({"macro_position_m": -0.9499e-3}, {"macro_position_m": -0.9501e-3}, Stop.MICRO_STROKE),
    ({"macro_position_m": 0.9499e-3}, {"macro_position_m": 0.9501e-3}, Stop.MICRO_STROKE),
    ({"t_ns": 10**12 + 20 * MS}, {"t_ns": 10**12 + 20 * MS + 1}, Stop.SENSOR_AGE),
    # this cycle is half a period old: a sample may lie one period ahead of it
    ({"sample_t_ns": 10**12 + 3 * MS // 2}, {"sample_t_ns": 10**12 + 3 * MS // 2 + 1}, Stop.SAMPLE_AHEAD),
    ({"t_ns": 10**12 - MS}, {"t_ns": 10**12 - MS - 1}, Stop.SAMPLE_AHEAD),
    ({"overrun_ns": 20 * MS}, {"overrun_ns": 20 * MS + 1}, Stop.OVERRUN),
    ({"lease_left_ns": 1}, {"lease_left_ns": 0}, Stop.LEASE),
    ({"lease_left_ns": 1}, {"lease_left_ns": -MS}, Stop.LEASE),
    ({}, {"reference_lost": 1}, Stop.REFERENCE_LOST),
    ({}, {"emergency": 1 << 16 | 0x2310}, Stop.EMERGENCY),
    ({}, {"macro_position_m": math.nan}, Stop.MEASUREMENT_NOT_FINITE),
    ({}, {"end_position_m": math.nan}, Stop.MEASUREMENT_NOT_FINITE),
    ({}, {"macro_position_m": -math.inf}, Stop.MEASUREMENT_NOT_FINITE),
    ({}, {"end_position_m": math.inf}, Stop.MEASUREMENT_NOT_FINITE),
    ({}, {"macro_n": math.nan}, Stop.COMMAND_NOT_FINITE),
    ({}, {"micro_n": math.nan}, Stop.COMMAND_NOT_FINITE),
    ({}, {"macro_n": math.inf}, Stop.COMMAND_NOT_FINITE),
    ({}, {"micro_n": -math.inf}, Stop.COMMAND_NOT_FINITE),
    ({}, {"setpoint_position_m": math.nan}, Stop.FOLLOWING_ERROR),
    ({}, {"setpoint_velocity_m_per_s": math.nan}, Stop.VELOCITY),
    ({"end_position_m": 200e-6}, {"end_position_m": 200.001e-6}, Stop.FOLLOWING_ERROR),
    (
        {"end_position_m": 0.001 * 0.95, "setpoint_position_m": 0.001 * 0.95},
        {"end_position_m": 0.00095001, "setpoint_position_m": 0.00095001},
        Stop.MICRO_STROKE,
    ),
    (
        {"end_position_m": -0.001 * 0.95, "setpoint_position_m": -0.001 * 0.95},
        {"end_position_m": -0.00095001, "setpoint_position_m": -0.00095001},
        Stop.MICRO_STROKE,
    ),
    ({"setpoint_velocity_m_per_s": 0.5}, {"setpoint_velocity_m_per_s": 0.500001}, Stop.VELOCITY),
    ({"setpoint_velocity_m_per_s": -0.5}, {"setpoint_velocity_m_per_s": -0.500001}, Stop.VELOCITY),
]


@pytest.mark.parametrize(("good", "bad", "code"), LIMITS)
def test_each_limit_from_both_sides(oled_profile, good, bad, code):
    assert Cycle(oled_profile).set(**good).stop() is Stop.NONE
    assert Cycle(oled_profile).set(**bad).stop() is code


def test_a_sample_of_the_future_says_how_far_and_what_to_check(oled_profile):
    one = Cycle(oled_profile).set(sample_t_ns=10**12 + 4 * MS)
    assert one.stop() is Stop.SAMPLE_AHEAD
    nothing = np.zeros(1, COMMAND)
    said = stop_detail(Stop.SAMPLE_AHEAD, one.measurement[0], one.setpoint[0], nothing[0], one.guard[0], {}, "dsmc")
    assert "newest sample 1000 is 3.500 ms ahead of its cycle, limit 1 ms; check interferometer.rate_hz" in said


@pytest.mark.parametrize("is_braking", [False, True])
def test_lines_that_are_late_for_good_end_the_run(oled_profile, is_braking):
    """Each is younger than the limit of age. A line of the cycle before is no matter: the estimator takes it."""
    one = Cycle(oled_profile)
    for k in range(300):
        assert one.set(cycle=1001 + k, sequence=1000 + k).stop() is Stop.NONE
    for k in range(100):
        assert one.set(cycle=1302 + k, sequence=1300 + k).stop() is Stop.NONE
    assert one.set(cycle=1402, sequence=1401).stop() is Stop.NONE  # and the count begins anew
    for k in range(100):
        assert one.set(cycle=1403 + k, sequence=1401 + k).stop() is Stop.NONE
    one.guard["braking"] = float(is_braking)
    assert one.set(cycle=1503, sequence=1501).stop() is Stop.SENSOR_AGE
    said = stop_detail(
        Stop.SENSOR_AGE, one.measurement[0], one.setpoint[0], np.zeros(1, COMMAND)[0], one.guard[0], {}, "dsmc"
    )
    assert "lines were late in each of the last 101 cycles, limit 100" in said


def test_late_lines_are_counted_in_fifteen_cycles_at_least(oled_profile):
    one = Cycle(with_values(oled_profile, trip__sensor_age_s=0.5e-3))
    one.set(sample_t_ns=one.measurement["t_ns"])
    assert [one.set(cycle=1304 + k, sequence=1300 + k).stop() for k in range(16)] == [
        *[Stop.NONE] * 15,
        Stop.SENSOR_AGE,
    ]


@pytest.mark.parametrize("off_m", [0.199e-3, -0.199e-3])
def test_a_late_line_is_judged_where_the_reference_was_then(oled_profile, off_m):
    """2 ms at 0.1 m/s and 3 m/s^2 are 200 um less 6 um; without a new line there is nothing to judge."""
    moving = {"setpoint_velocity_m_per_s": 0.1, "setpoint_acceleration_m_per_s2": 3.0}
    late = {**moving, "cycle": 1002, "sequence": 1000, "setpoint_position_m": 0.0, "macro_position_m": -194e-6}
    assert Cycle(oled_profile).set(**late, end_position_m=-194e-6 + off_m).stop() is Stop.NONE
    further = {"end_position_m": -194e-6 + 1.02 * off_m}
    assert Cycle(oled_profile).set(**late, **further).stop() is Stop.FOLLOWING_ERROR
    assert Cycle(oled_profile).set(**late, **further, samples_new=0).stop() is Stop.NONE


def test_how_far_ahead_a_sample_may_lie_is_the_profiles_period(oled_profile):
    slow = with_values(oled_profile, cycle__rate_hz=500.0)
    assert Cycle(slow).set(sample_t_ns=10**12 + 5 * MS // 2).stop() is Stop.NONE
    assert Cycle(slow).set(sample_t_ns=10**12 + 5 * MS // 2 + 1).stop() is Stop.SAMPLE_AHEAD


@pytest.mark.parametrize("edge_m", [-0.4502, 0.4502])  # the travel, and the following error beyond it
def test_travel(oled_profile, edge_m):
    for share, code in ((0.99999, Stop.NONE), (1.0, Stop.NONE), (1.00001, Stop.TRAVEL)):
        at_m = edge_m * share
        one = Cycle(oled_profile).set(macro_position_m=at_m, end_position_m=at_m, setpoint_position_m=at_m)
        assert one.stop() is code


@pytest.mark.parametrize("bit", range(32))
def test_inputs_that_trip(oled_profile, bit):
    """0x60FD of CiA 402: negative limit, positive limit, interlock (STO); 16 = air pressure low; home (2) is none."""
    for axis in ("macro", "micro"):
        stop = Cycle(oled_profile).set(**{f"{axis}_digital_inputs": 1 << bit}).stop()
        assert stop is (Stop.DIGITAL_INPUT if bit in (0, 1, 3, 16) else Stop.NONE)


@pytest.mark.parametrize("axis", ["macro", "micro"])
@pytest.mark.parametrize("mode", [-128, -1, 0, 1, 6, 8, 9, 10, 11, 127])
def test_a_drive_that_told_another_mode_than_its_own_stops(oled_profile, axis, mode):
    """CiA 402: 10 is cyclic torque, 8 cyclic position, 6 homing, 0 none, below 0 the manufacturer's."""
    position = with_values(oled_profile, macro__mode="position")
    for profile, wanted in ((oled_profile, 10), (position, 8 if axis == "macro" else 10)):
        one = Cycle(profile).set(**{f"{axis}_mode_display": mode})
        assert one.stop() is Stop.NONE  # nothing was told yet
        other = "micro" if axis == "macro" else "macro"
        one.set(**{f"{other}_mode_display": one.guard[f"{other}_mode"][0]})
        assert one.set(modes_told=MODE_TOLD[other]).stop() is Stop.NONE  # the other's own word
        assert one.set(modes_told=3).stop() is (Stop.NONE if mode == wanted else Stop.DRIVE_MODE)


def test_another_mode_says_more_than_what_the_drive_answers_to_its_targets(cycle):
    cycle.set(modes_told=1, macro_mode_display=8, emergency=1 << 16 | 0x8611)
    assert cycle.stop() is Stop.DRIVE_MODE
    detail = stop_detail(
        Stop.DRIVE_MODE, cycle.measurement[0], None, None, cycle.guard[0], {"macro": 1, "micro": 2}, "dsmc"
    )
    assert detail.startswith("macro (node 1): mode of operation 0x6061 is 8, wanted 10; ")


@pytest.mark.parametrize("axis", ["macro", "micro"])
@pytest.mark.parametrize(
    ("statusword", "code"),
    [
        (0x0027, Stop.NONE),
        (0xFFB7, Stop.NONE),  # all that does not tell the state
        (0x0023, Stop.DRIVE_FAULT),  # switched on
        (0x0007, Stop.DRIVE_FAULT),  # quick stop active
        (0x000F, Stop.DRIVE_FAULT),  # fault reaction active
        (0x0008, Stop.DRIVE_FAULT),  # fault
        (0x0067, Stop.DRIVE_FAULT),  # switch on disabled, bit 6
        (0x0000, Stop.DRIVE_FAULT),
    ],
)
def test_statuswords(oled_profile, axis, statusword, code):
    assert Cycle(oled_profile).set(**{f"{axis}_statusword": statusword}).stop() is code


@pytest.mark.parametrize("heard", [0, 1, 2])
def test_a_drive_that_says_nothing(cycle, heard):
    """20 cycles of 1 ms may pass without a TPDO of either drive, not 21."""
    for _ in range(20):
        assert cycle.next(tpdos_new=heard) is Stop.NONE
    assert cycle.next(tpdos_new=heard) is Stop.LINK_SILENT


def test_a_word_from_the_drives_ends_the_silence(cycle):
    for k in range(200):
        assert cycle.next(tpdos_new=3 if k % 20 == 19 else 0) is Stop.NONE


@pytest.mark.parametrize(("axis", "allowed_n"), [("macro", 100.0), ("micro", 9.0)])
@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_a_drive_that_gives_another_force(oled_profile, axis, allowed_n, sign):
    """By more than 5 % of its greatest one from all that it was asked for in three cycles, in seven cycles."""
    one = Cycle(oled_profile)
    word = round(sign * 120.0 / oled_profile.axis(axis).torque_step_n)
    guard.ask(one.guard[0], *((word, 0) if axis == "macro" else (0, word)))
    told = f"{axis}_reported_force_n"
    for reported_n in (0.0, 120.0, 60.0, 120.0 + 0.99 * allowed_n, -0.99 * allowed_n):
        assert all(one.next(**{told: sign * reported_n}) is Stop.NONE for _ in range(50)), reported_n
    assert [one.next(**{told: sign * (120.0 + 1.01 * allowed_n)}) for _ in range(7)] == [
        *[Stop.NONE] * 6,
        Stop.FORCE_UNHEEDED,
    ]
    text = stop_detail(
        Stop.FORCE_UNHEEDED, one.measurement[0], None, None, one.guard[0], {"macro": 1, "micro": 2}, "dsmc"
    )
    assert text.startswith(f"{axis} (node {1 if axis == 'macro' else 2}) reports ")
    assert f"allowed {allowed_n:.1f} N beside; look for what delays frames" in text
    for _ in range(guard.ASKED_CYCLES):  # what it was asked for before is of no use
        guard.ask(one.guard[0], 0, 0)
    one.guard[f"{axis}_unheeded"] = 0.0
    assert after_many(7, **{told: sign * 120.0})(one) is Stop.FORCE_UNHEEDED


def test_a_force_that_is_wrong_now_and_then_is_none_that_goes_unheeded(cycle):
    """Five frames in a row whose bits turned over, and one in eleven for good."""
    for k in range(2000):
        wrong = k % 70 < 5 if k < 1000 else k % 11 == 0
        assert cycle.next(macro_reported_force_n=500.0 if wrong else 0.0) is Stop.NONE
    assert Stop.FORCE_UNHEEDED in [cycle.next(macro_reported_force_n=500.0 * (k % 9 == 0)) for k in range(2000)]


@pytest.mark.parametrize(("axis", "allowed_n"), [("macro", 100.0), ("micro", 9.0)])
def test_a_force_may_be_told_for_three_cycles(oled_profile, axis, allowed_n):
    one = Cycle(oled_profile)
    word = round(5.0 * allowed_n / oled_profile.axis(axis).torque_step_n)

    def ask(word: int) -> Stop:
        guard.ask(one.guard[0], *((word, 0) if axis == "macro" else (0, word)))
        one.guard[f"{axis}_unheeded"] = 0.0
        return after_many(7, **{f"{axis}_reported_force_n": 5.0 * allowed_n})(one)

    assert [ask(one_word) for one_word in (word, 0, 0, 0)] == [*[Stop.NONE] * 3, Stop.FORCE_UNHEEDED]


@pytest.mark.parametrize(("axis", "allowed_n"), [("macro", 100.0), ("micro", 9.0)])
def test_a_force_beside_what_was_asked_for_by_just_what_is_allowed(cycle, axis, allowed_n):
    assert after_many(50, **{f"{axis}_reported_force_n": allowed_n})(cycle) is Stop.NONE


def test_a_force_that_is_not_told_or_not_asked_for_is_not_judged(oled_profile, single_profile):
    wrong = {"macro_reported_force_n": 500.0, "micro_reported_force_n": 100.0}
    for told in ({"tpdos_new": 0}, {"command_lost": 1}):
        assert after_many(12, **wrong, **told)(Cycle(oled_profile)) is Stop.NONE
    for heard, axis in ((2, "macro"), (1, "micro")):
        told = {f"{axis}_reported_force_n": wrong[f"{axis}_reported_force_n"]}
        assert after_many(12, **told, tpdos_new=heard)(Cycle(oled_profile)) is Stop.NONE
    assert after_many(100, micro_reported_force_n=100.0)(Cycle(single_profile)) is Stop.NONE
    one = Cycle(with_values(oled_profile, macro__mode="position", macro__encoder_step_m=1e-6))
    assert after_many(100, macro_reported_force_n=500.0)(one) is Stop.NONE
    one = Cycle(with_values(oled_profile, trip__force_error_ratio=1.0))
    assert after_many(100, macro_reported_force_n=500.0)(one) is Stop.NONE


def test_commands_that_do_not_reach_the_bus(cycle):
    for _ in range(20):
        assert cycle.next(command_lost=1) is Stop.NONE
    assert cycle.next(command_lost=0) is Stop.NONE
    for _ in range(20):
        assert cycle.next(command_lost=1) is Stop.NONE
    assert cycle.next(command_lost=1) is Stop.COMMAND_LOST


def test_silence_is_counted_in_three_cycles_at_least(oled_profile):
    one = Cycle(with_values(oled_profile, trip__sensor_age_s=0.5e-3))
    assert [one.next(tpdos_new=0, sample_t_ns=one.measurement["t_ns"] + MS) for _ in range(4)] == [
        *[Stop.NONE] * 3,
        Stop.LINK_SILENT,
    ]


def test_lost_commands_are_counted_in_three_cycles_at_least(oled_profile):
    one = Cycle(with_values(oled_profile, trip__sensor_age_s=0.5e-3))
    assert [one.next(command_lost=1, sample_t_ns=one.measurement["t_ns"] + MS) for _ in range(4)] == [
        *[Stop.NONE] * 3,
        Stop.COMMAND_LOST,
    ]


def moving(profile, speed_m_per_s: float, start_m: float, cycles: int = 400) -> tuple[Stop, float]:
    """Move everything at one speed until the guard stops it; return its code and where that was."""
    one = Cycle(profile)
    at_m = start_m
    for _ in range(cycles):
        one.set(setpoint_velocity_m_per_s=speed_m_per_s, setpoint_position_m=at_m)
        stop = one.next(macro_position_m=at_m, end_position_m=at_m)
        if stop is not Stop.NONE:
            return stop, at_m
        at_m += speed_m_per_s * 1e-3
    return Stop.NONE, at_m


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_speed_limit(oled_profile, sign):
    assert moving(oled_profile, sign * 0.4999, -sign * 0.2)[0] is Stop.NONE
    stop, at_m = moving(oled_profile, sign * 0.5001, -sign * 0.2)
    assert stop is Stop.VELOCITY
    assert at_m == pytest.approx(-sign * 0.2, abs=0.002)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_speed_is_held_to_what_stops_before_the_end(oled_profile, sign):
    """From 0.3 m/s, 2 m/s^2 needs 22.5 mm: the last place is 0.45 - 0.0225 = 0.4275 m."""
    stop, at_m = moving(oled_profile, sign * 0.3, sign * 0.38)
    assert stop is Stop.VELOCITY
    assert sign * at_m == pytest.approx(0.4275, abs=0.0004)
    assert moving(oled_profile, -sign * 0.3, sign * 0.4499)[0] is Stop.NONE  # away from the end it may


def test_speed_is_the_guards_own(oled_profile):
    """A reference that stands and a macro that runs away: five differences make most of its speed."""
    one = Cycle(oled_profile)
    stops = [one.next(macro_position_m=0.9e-3 * (k % 2)) for k in range(10)]
    assert stops == [Stop.NONE] * 10  # noise of 0.9 m/s to and fro is no speed
    at_m, stops = 0.0, []
    one = Cycle(with_values(oled_profile, micro__stroke_m=(-1.0, 1.0)))
    while Stop.VELOCITY not in stops:
        stops.append(one.next(macro_position_m=at_m))
        at_m += 0.8e-3
    # 0.8 (1 - 0.8^n) passes 0.5 m/s at n = 5; the first cycle only starts the difference
    assert len(stops) == 6


def test_missed_cycles_are_no_speed(oled_profile):
    one = Cycle(oled_profile).set(setpoint_velocity_m_per_s=0.4)
    one.stop()
    at_m = 0.0
    for missed in (1, 1, 6, 1, 10, 3, 1):
        at_m += 0.4e-3 * missed
        m = one.measurement
        one.set(cycle=m["cycle"] + missed, sequence=m["cycle"] + missed, setpoint_position_m=at_m)
        assert one.set(macro_position_m=at_m, end_position_m=at_m).stop() is Stop.NONE
        assert one.guard["macro_velocity_m_per_s"][0] == pytest.approx(0.4, rel=1e-9)


def test_a_late_line_is_no_following_error(cycle):
    """At 0.5 m/s the position of the cycle before is 500 um behind; its age is watched by itself."""
    late = {"setpoint_position_m": 0.5e-3, "setpoint_velocity_m_per_s": 0.5}
    cycle.stop()
    assert cycle.next(samples_new=0, sequence=1000, **late) is Stop.NONE
    assert cycle.next(samples_new=1, sequence=1001, **late) is Stop.NONE  # a line came, of the cycle before
    assert cycle.next(samples_new=0, **late) is Stop.NONE  # a host that woke twice has nothing new to judge
    assert cycle.next(samples_new=1, **late) is Stop.FOLLOWING_ERROR


def test_a_late_line_makes_its_own_speed(cycle):
    """Its way counts over the time between its own sample and the one before, not over the cycles that passed."""
    cycle.stop()
    before = cycle.guard.copy()
    cycle.next(samples_new=0, sequence=1000, macro_position_m=5e-4)
    assert cycle.guard["macro_velocity_m_per_s"] == before["macro_velocity_m_per_s"]
    cycle.next(samples_new=1, sequence=1001, macro_position_m=2e-4)  # 0.2 mm in one cycle, a fifth of it taken
    assert cycle.guard["macro_velocity_m_per_s"][0] == pytest.approx(0.2 * 0.2, rel=1e-9)
    cycle.next(samples_new=1, macro_position_m=4e-4)  # 0.2 mm in the two cycles from sample 1001 to 1003
    assert cycle.guard["macro_velocity_m_per_s"][0] == pytest.approx(0.04 + 0.2 * (0.1 - 0.04), rel=1e-9)


def test_a_number_without_a_sample_is_no_speed(cycle):
    """A counter that goes on while no line came says nothing of where the macro is."""
    cycle.stop()
    cycle.next(samples_new=0, macro_position_m=5e-4)
    assert cycle.guard["macro_velocity_m_per_s"][0] == 0.0
    assert cycle.guard["macro_position_m"][0] == 0.0


def test_a_reference_that_is_nan_stops_without_a_new_sample_too(cycle):
    cycle.stop()
    assert cycle.next(samples_new=0, setpoint_position_m=math.nan) is Stop.FOLLOWING_ERROR


def test_while_the_drive_brakes_what_the_law_asks_for_heats_nothing(oled_profile):
    """Its force does not go out; a stop of its own would say why wrongly."""
    one = Cycle(with_values(oled_profile, macro__thermal_time_constant_s=0.01, micro__thermal_time_constant_s=0.01))
    one.guard["braking"] = 1.0
    one.set(macro_n=2500.0, micro_n=179.0)
    assert [one.next() for _ in range(50)] == [Stop.NONE] * 50
    assert one.guard["macro_heat_n2"][0] == one.guard["micro_heat_n2"][0] == 0.0


@pytest.mark.parametrize(
    ("axis", "force_n", "limit_n", "tau_s"), [("macro", 1400.0, 700.0, 6.0), ("micro", -90.0, 60.0, 2.0)]
)
def test_thermal_limit(oled_profile, axis, force_n, limit_n, tau_s):
    """The square of the force heats with one time constant: t = -tau ln(1 - (limit / force)^2)."""
    expected_s = -tau_s * math.log(1.0 - (limit_n / force_n) ** 2)
    cycle = Cycle(with_values(oled_profile, **{f"{axis}__thermal_time_constant_s": tau_s}))
    cycle.set(**{f"{axis}_n": force_n})
    cycles = 0
    while (stop := cycle.next()) is Stop.NONE:
        cycles += 1
        assert cycles < 60_000
    assert stop is Stop.THERMAL
    assert cycles * 1e-3 == pytest.approx(expected_s, rel=1e-3)


@pytest.mark.parametrize(("axis", "limit_n"), [("macro", 700.0), ("micro", 60.0)])
def test_heat_at_its_very_limit_may_stay(cycle, axis, limit_n):
    cycle.guard[f"{axis}_heat_n2"] = limit_n * limit_n
    assert cycle.set(**{f"{axis}_n": limit_n}).stop() is Stop.NONE
    assert cycle.next(**{f"{axis}_n": 1.01 * limit_n}) is Stop.THERMAL


def test_the_continuous_force_may_stay(oled_profile):
    """For ten time constants, of which there is nothing left to come."""
    quick = with_values(oled_profile, macro__thermal_time_constant_s=0.2, micro__thermal_time_constant_s=0.2)
    cycle = Cycle(quick).set(macro_n=699.9, micro_n=-59.9)
    assert all(cycle.next() is Stop.NONE for _ in range(2000))


def test_finiteness_comes_first(cycle):
    """A nan beside everything else that is wrong is still called what it is."""
    cycle.set(reference_lost=1, overrun_ns=10**12, emergency=1, macro_statusword=0, lease_left_ns=-1)
    assert cycle.set(micro_n=math.nan, macro_n=1e9).stop() is Stop.COMMAND_NOT_FINITE
    assert cycle.set(end_position_m=math.nan).stop() is Stop.MEASUREMENT_NOT_FINITE


LIMIT_NAMES = [
    name
    for name in guard.GUARD.names
    if name.endswith(("_m", "_n", "_ns", "_per_s2", "_limit_m_per_s")) and name != "macro_position_m"  # a state
]


@pytest.mark.parametrize("name", LIMIT_NAMES)
def test_a_limit_that_is_nan_stops(oled_profile, name):
    """Were a limit ever nan, nothing may pass it."""
    one = Cycle(oled_profile).set(setpoint_velocity_m_per_s=0.1)
    one.guard[name] = math.nan
    assert one.stop() is not Stop.NONE


def test_behind_the_value_seam_there_are_no_drives(oled_profile):
    one = Cycle(oled_profile, has_drives=False)
    one.set(
        macro_statusword=0,
        micro_statusword=0,
        tpdos_new=0,
        emergency=5,
        macro_digital_inputs=-1,
        modes_told=3,
        command_lost=1,
    )
    assert all(one.next() is Stop.NONE for _ in range(100))


def test_one_axis_has_no_micro_to_watch(single_profile):
    one = Cycle(single_profile).set(micro_statusword=0, modes_told=2, tpdos_new=1, micro_n=1e6, macro_position_m=0.1)
    one.set(end_position_m=0.1, setpoint_position_m=0.1)
    assert all(one.next() is Stop.NONE for _ in range(100))
    assert one.next(end_position_m=0.102, setpoint_position_m=0.102) is Stop.NONE  # no stroke
    assert one.next(macro_n=240.1) is Stop.FORCE
    assert one.next(macro_n=math.nan) is Stop.COMMAND_NOT_FINITE
    assert one.next(macro_n=0.0, tpdos_new=0) is Stop.NONE
    assert one.next(macro_statusword=0) is Stop.DRIVE_FAULT


BRAKING = [  # what the drive that brakes the macro makes meaningless, and what it does not
    ({"overrun_ns": 10**9}, Stop.OVERRUN, False),
    ({"lease_left_ns": 0}, Stop.LEASE, False),
    ({"emergency": 1}, Stop.EMERGENCY, False),
    ({"macro_digital_inputs": 1}, Stop.DIGITAL_INPUT, False),
    ({"macro_statusword": 0x07}, Stop.DRIVE_FAULT, False),
    ({"modes_told": 1, "macro_mode_display": 8}, Stop.DRIVE_MODE, False),
    ({"end_position_m": 3e-4}, Stop.FOLLOWING_ERROR, False),
    ({"macro_position_m": 0.46, "end_position_m": 0.46}, Stop.TRAVEL, False),
    ({"setpoint_velocity_m_per_s": 0.6}, Stop.VELOCITY, False),
    ({"micro_digital_inputs": 1 << 3}, Stop.DIGITAL_INPUT, True),
    ({"micro_statusword": 0x07}, Stop.DRIVE_FAULT, True),
    ({"modes_told": 2, "micro_mode_display": 0}, Stop.DRIVE_MODE, True),
    ({"end_position_m": 1e-3}, Stop.MICRO_STROKE, True),
    ({"reference_lost": 1}, Stop.REFERENCE_LOST, True),
    ({"sample_t_ns": 0}, Stop.SENSOR_AGE, True),
    ({"sample_t_ns": 10**13}, Stop.SAMPLE_AHEAD, True),
    ({"macro_n": math.nan}, Stop.COMMAND_NOT_FINITE, True),
    ({"micro_n": math.nan}, Stop.COMMAND_NOT_FINITE, True),
    ({"end_position_m": math.nan}, Stop.MEASUREMENT_NOT_FINITE, True),
    ({"micro_n": 181.0}, Stop.FORCE, True),
]


@pytest.mark.parametrize(("values", "code", "counts"), BRAKING)
def test_while_the_drive_brakes_the_macro_only_the_micro_is_judged(oled_profile, values, code, counts):
    one = Cycle(oled_profile)
    one.guard["braking"] = 1.0
    assert one.stop() is Stop.NONE
    assert one.set(**values).stop() is (code if counts else Stop.NONE)
    if not counts and code is not Stop.VELOCITY:  # a speed is taken over when the guard starts
        one.guard["braking"] = 0.0
        assert one.stop() is not Stop.NONE


@pytest.mark.parametrize(
    ("values", "code"),
    [({"tpdos_new": 1}, Stop.LINK_SILENT), ({"tpdos_new": 2}, Stop.NONE), ({"command_lost": 1}, Stop.COMMAND_LOST)],
)
def test_while_it_brakes_the_micros_drive_must_be_heard(oled_profile, values, code):
    one = Cycle(oled_profile)
    one.guard["braking"] = 1.0
    stops = [one.next(**values) for _ in range(21)]
    assert stops == [*[Stop.NONE] * 20, code]


def test_a_sync_that_did_not_go_out_has_no_answer(cycle):
    """Every second command lost and no answer to it: neither silence nor too many lost."""
    for k in range(200):
        lost = k % 2
        assert cycle.next(command_lost=lost, tpdos_new=0 if lost else 3) is Stop.NONE
    for _ in range(15):
        assert cycle.next(command_lost=1, tpdos_new=0) is Stop.NONE
    assert cycle.guard["macro_silence"][0] == cycle.guard["micro_silence"][0] == 0.0


def test_limits_are_the_profiles(oled_profile):
    g = guard.init(oled_profile, has_drives=True)[0]
    assert (g["travel_low_m"], g["travel_high_m"], g["velocity_limit_m_per_s"]) == (-0.4502, 0.4502, 0.5)
    assert (g["macro_force_limit_n"], g["micro_force_limit_n"], g["following_error_m"]) == (2000.0, 180.0, 200e-6)
    assert (g["stop_deceleration_m_per_s2"], g["sensor_age_ns"], g["overrun_ns"]) == (2.0, 20e6, 20e6)
    assert (g["macro_thermal_n"], g["micro_thermal_n"]) == (700.0, 60.0)


def test_every_stop_has_a_sentence():
    assert set(STOP_TEXT) == set(Stop)
    assert len(set(STOP_TEXT.values())) == len(Stop)


def after_many(count: int = 100, **values):
    """Return how a cycle ends that is repeated with these values until the guard stops it."""

    def judge(one: Cycle) -> Stop:
        for _ in range(count):
            if (stop := one.next(**values)) is not Stop.NONE:
                return stop
        return Stop.NONE

    return judge


WAYS = {
    Stop.TRAVEL: lambda one: one.set(macro_position_m=0.46, end_position_m=0.46).stop(),
    Stop.VELOCITY: lambda one: one.set(setpoint_velocity_m_per_s=0.6).stop(),
    Stop.FORCE: lambda one: one.set(macro_n=2001.0).stop(),
    Stop.FOLLOWING_ERROR: lambda one: one.set(end_position_m=3e-4).stop(),
    Stop.MICRO_STROKE: lambda one: one.set(macro_position_m=2e-3).stop(),
    Stop.SENSOR_AGE: lambda one: one.set(sample_t_ns=0).stop(),
    Stop.SAMPLE_AHEAD: lambda one: one.set(sample_t_ns=10**13).stop(),
    Stop.REFERENCE_LOST: lambda one: one.set(reference_lost=1).stop(),
    Stop.OVERRUN: lambda one: one.set(overrun_ns=10**9).stop(),
    Stop.THERMAL: after_many(5000, micro_n=180.0),
    Stop.LEASE: lambda one: one.set(lease_left_ns=0).stop(),
    Stop.COMMAND_NOT_FINITE: lambda one: one.set(macro_n=math.nan).stop(),
    Stop.MEASUREMENT_NOT_FINITE: lambda one: one.set(end_position_m=math.nan).stop(),
    Stop.DRIVE_FAULT: lambda one: one.set(macro_statusword=0x08).stop(),
    Stop.DRIVE_MODE: lambda one: one.set(modes_told=3, macro_mode_display=8, micro_mode_display=10).stop(),
    Stop.DIGITAL_INPUT: lambda one: one.set(macro_digital_inputs=1).stop(),
    Stop.EMERGENCY: lambda one: one.set(emergency=1).stop(),
    Stop.LINK_SILENT: after_many(tpdos_new=0),
    Stop.COMMAND_LOST: after_many(command_lost=1),
    Stop.FORCE_UNHEEDED: after_many(macro_reported_force_n=101.0),
}


@pytest.mark.parametrize("code", sorted(CODES))
def test_every_code_is_reached(oled_profile, code):
    assert WAYS[code](Cycle(oled_profile)) is code
