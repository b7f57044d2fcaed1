"""What can't be told apart: for every set, recordings that lack rank, and what gives it back."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import norm

from bench import emps
from sim_backend.machine import load_machine
from stagectl.gap import balance, hypotheses
from stagectl.gap.alias_sets import ENCODER, GAP_SENSOR, alias_sets
from stagectl.gap.balance import recording_of, set_noise
from stagectl.gap.believed import Believed, believed_of_profile
from stagectl.gap.identifiability import AliasSet, not_separable, separations, separations_of, splitting
from stagectl.gap.judge import ALIAS_GAIN
from stagectl.gap.log import Log, read_log
from stagectl.gap.moves import Move, library, room_of
from stagectl.gap.noise import slow_noise
from stagectl.gap.planned import planned_log
from stagectl.profile import load_profile
from stagectl.value_seam_run import simulate

SHARP_M_PER_S = 1e-4
PAYLOAD_KG = 6.0

SCALE = "common scale of all forces and masses"
DELAYS = "sensor delay against actuator delay"
CONSTANTS = "offset, tilt, amplifier offset, asymmetric Coulomb friction"
CABLE = "cable against spring of the base"
LOOP = "cable that gives way against spring of the base"
MODE = "flexible mode far above the band, delay, mass"
PERIODIC = "cogging against ripple of the force constant"
REACTION = "reaction of the micro's drive against mass of the macro"
DRIFT = "which of two sensors drifts"
ZERO = "centre of the backlash against zero of the relative position"

LATE_MACRO, LATE_END = "sensor_delay on macro_sensor", "sensor_delay on end_sensor"
OFFSET, TILT = "offset on macro_force", "gravity_tilt on macro_force"
AMPLIFIER = "amplifier offset on macro_command"
UNEVEN = "asymmetric_coulomb_friction on macro_force"


class Bench:
    """A believed machine and its moves."""

    def __init__(self, name: str):
        self.profile = load_profile(name)
        self.believed = believed_of_profile(self.profile)
        self.moves: dict[str, Move] = {move.name: move for move in library(room_of(self.profile))}

    def log(self, move: str, believed: Believed | None = None) -> Log:
        """A recording of a move: the machine is what is believed, its sensors have the noise that is stated."""
        believed = believed or self.believed
        log = planned_log(self.moves[move].trajectory, believed)
        random = np.random.default_rng(5)
        noise = [believed.macro.noise_m * random.standard_normal(log.samples_count) for _ in range(2)]
        end_m = None if log.end_position_m is None else log.end_position_m + noise[1]
        return replace(log, name=move, macro_position_m=log.macro_position_m + noise[0], end_position_m=end_m)

    def carrying(self, move: str, payload_kg: float, believed: Believed | None = None) -> Log:
        """The same of a single axis with a mass on it that everybody knows."""
        believed = believed or self.believed
        macro = replace(believed.macro, mass_kg=believed.macro.mass_kg + payload_kg)
        log = self.log(move, replace(believed, macro=macro))
        return replace(log, name=f"{move}, loaded", session="loaded", macro_payload_kg=payload_kg)

    def judged(self, name: str, *logs: Log, believed: Believed | None = None, **asked):
        recordings = [self.recording(log, believed) for log in logs]
        (one,) = separations(recordings, [set_of(recordings, name)], **asked)
        return one

    def recording(self, log: Log, believed: Believed | None = None):
        found = recording_of(log, believed or self.believed)
        set_noise(found, slow_noise(found.believed, found))
        return found


def set_of(recordings, name: str) -> AliasSet:
    return next(one for one in alias_sets(recordings) if one.name == name)


def sharp(believed: Believed) -> Believed:
    """Real friction turns round within a tenth of a millimetre a second."""
    rows = [
        row | ({"smoothing_m_per_s": SHARP_M_PER_S} if "smoothing_m_per_s" in row else {}) for row in believed.effects
    ]
    return replace(believed, effects=tuple(rows))


def with_currents(log: Log, believed: Believed) -> tuple[Log, Believed]:
    """What the drives report, to 1 mA."""

    def reported(axis, command_n):
        noisy = replace(axis, current_noise_a=1e-3)
        held_n = np.concatenate([command_n[:1], command_n[:-1]])
        return noisy, held_n / axis.force_constant_n_per_a

    macro, current_a = reported(believed.macro, log.macro_command_n)
    log, believed = replace(log, macro_current_a=current_a), replace(believed, macro=macro)
    if believed.micro is not None:
        micro, current_a = reported(believed.micro, log.micro_command_n)
        log, believed = replace(log, micro_current_a=current_a), replace(believed, micro=micro)
    return log, believed


@pytest.fixture(scope="module")
def axis():
    return Bench("single-axis")


@pytest.fixture(scope="module")
def stage():
    return Bench("oled-printer")


@pytest.fixture(scope="module")
def touched(stage, tmp_path_factory) -> Log:
    """The micro swung over both edges of the simulated machine, whose control keeps the macro."""
    folder = tmp_path_factory.mktemp("touched")
    swing = stage.moves["sweep over both edges"].trajectory.setpoints
    simulate(stage.profile, load_machine("oled-printer"), swing, "sweep", stage.profile.control.law, folder, 3)
    return read_log(folder, stage.believed.period_s, stage.believed)


def test_a_common_scale_shows_with_a_known_added_mass_only(axis):
    bare = axis.log("fast stroke")
    scale = axis.judged(SCALE, bare, axis.log("sine 1 Hz"))
    assert scale.rank == scale.columns - 1
    (together,) = scale.inseparable
    assert {"macro_mass_kg", "macro_force_constant"} <= set(together)
    assert scale.remedies == ("a known added mass",)
    assert axis.judged(SCALE, bare, axis.carrying("fast stroke", PAYLOAD_KG)).whole


def test_late_sensors_and_late_motors_are_told_by_reported_currents(axis, stage):
    """Moves of every kind, reversals under friction among them, leave the sum; the currents are the motors' alone."""
    moves = ("fast stroke", "slow reversals", "sine 3 Hz")
    logs = [axis.log(name) for name in moves]
    late = axis.judged(DELAYS, *logs)
    assert late.inseparable == ((LATE_MACRO, "macro_latch_s"),)
    assert late.remedies == ("reported currents",)
    told = [with_currents(log, axis.believed) for log in logs]
    assert axis.judged(DELAYS, *(log for log, _ in told), believed=told[0][1]).whole


def test_two_axes_have_one_delay_in_common(stage, touched):
    """Joint, contact and reaction tell the axes' delays from one another, and never all sensors from all motors."""
    log = stage.log("fast stroke")
    late = stage.judged(DELAYS, log, touched)
    assert late.rank == 3
    assert late.inseparable == ((LATE_MACRO, "macro_latch_s", LATE_END, "micro_latch_s"),)
    known, believed = with_currents(log, stage.believed)
    assert stage.judged(DELAYS, known, believed=believed).whole


def test_a_late_reading_is_what_it_does_to_the_forces(stage):
    """In a smooth move the delay as an error of the reading, as the search has it, is the same column."""
    recording = stage.recording(stage.log("sine 3 Hz"))
    for place in ("macro_sensor", "end_sensor"):
        late = next(m for m in set_of([recording], DELAYS).members if m.name.endswith(place))
        read = hypotheses.term_of(hypotheses.CATALOGUE["sensor_delay"], place, late.term.shape)
        mine, other = (
            np.concatenate([part for part in balance.column(recording, term.forces(recording)[0]) if part is not None])
            for term in (late.term, read)
        )
        assert np.linalg.norm(mine - other) < 0.06 * np.linalg.norm(mine)


def test_constant_forces_part_one_by_one(axis):
    believed = sharp(axis.believed)
    everything = (OFFSET, TILT, AMPLIFIER, UNEVEN)
    stroke, slow = axis.log("fast stroke", believed), axis.log("slow reversals", believed)
    alike = axis.judged(CONSTANTS, stroke, believed=believed)
    assert (alike.rank, alike.inseparable) == (1, (everything,))
    alike = axis.judged(CONSTANTS, stroke, slow, believed=believed)
    assert (alike.rank, alike.inseparable) == (2, (everything[:3],))
    assert alike.remedies == ("reported currents", "a known added mass")
    told, noisy = with_currents(slow, believed)
    alike = axis.judged(CONSTANTS, stroke, told, believed=noisy)
    assert (alike.rank, alike.inseparable) == (3, ((OFFSET, TILT),))
    assert axis.judged(CONSTANTS, told, axis.carrying("slow stroke", PAYLOAD_KG, believed), believed=noisy).whole


def test_tilt_is_felt_by_both_axes(stage):
    log = stage.log("fast stroke")
    alike = stage.judged(CONSTANTS, log)
    assert alike.inseparable == ((OFFSET, AMPLIFIER),)
    assert alike.remedies == ("reported currents",)
    told, noisy = with_currents(log, stage.believed)
    assert stage.judged(CONSTANTS, told, believed=noisy).whole


def test_a_cable_has_to_be_unhooked(axis):
    logs = [axis.log(name) for name in ("slow stroke", "fast stroke", "holds at several places")]
    alike = axis.judged(CABLE, *logs)
    assert (alike.rank, alike.remedies) == (1, ("the cable unhooked",))
    loose = {"cable_spring on macro_force": ["fast stroke", "slow stroke"]}
    assert axis.judged(CABLE, *logs, absent=loose).whole


def test_a_cable_that_gives_way_needs_a_long_stroke(stage):
    """Creep goes 10 mm one way, the cable slips after 20."""
    short = stage.judged(LOOP, stage.log("creep"))
    assert short.inseparable == (("cable_hysteresis on macro_force", "linear_stiffness on macro_force"),)
    assert stage.judged(LOOP, stage.log("slow stroke")).whole


def test_a_stiff_mode_is_a_mass_at_one_frequency(stage):
    swing = stage.judged(MODE, stage.log("sine 3 Hz"))
    assert swing.inseparable == (("flexible_mode on macro_force", "macro_mass_kg"),)
    assert stage.judged(MODE, stage.log("fast stroke")).whole


def test_ripple_needs_a_force_that_changes(axis):
    """One way at constant speed the motor's force is friction's alone."""
    there = axis.log("slow stroke")
    speed = np.gradient(there.macro_position_m, there.period_s)
    steady = np.flatnonzero(np.abs(speed - speed.max()) < 1e-3)
    first, last = int(steady[0]) + 200, int(steady[0]) + 4000
    cut = replace(
        there, macro_position_m=there.macro_position_m[first:last], macro_command_n=there.macro_command_n[first:last],
        valid=there.valid[first:last], reference_m=None,
    )  # fmt: skip
    one_way = axis.judged(PERIODIC, cut)
    assert one_way.rank == 2
    assert set(one_way.inseparable[0]) == {"cogging on macro_force", "current_ripple on macro_actuator"}
    assert one_way.remedies == ("sine 0.3 Hz", "fast stroke")
    assert axis.judged(PERIODIC, cut, axis.log("sine 0.3 Hz")).whole


def test_reaction_shows_where_the_bodies_move_apart(stage, touched):
    together = stage.judged(REACTION, stage.log("fast stroke"), stage.log("sine 1 Hz"))
    assert together.inseparable == (("micro_reaction on macro_force", "macro_mass_kg"),)
    assert together.remedies == ("sweep over both edges",)
    assert stage.judged(REACTION, stage.log("fast stroke"), touched).whole


@pytest.mark.parametrize(
    ("name", "signal", "together"),
    [
        (DRIFT, ENCODER, ("thermal_drift on macro_sensor", "thermal_drift on end_sensor")),
        (ZERO, GAP_SENSOR, ("backlash_centre_shift on contact_edge", "zero of the relative position on end_sensor")),
    ],
)
def test_a_third_position_tells_what_two_cant(stage, touched, name, signal, together):
    both = stage.judged(name, touched, stage.log("fast stroke"))
    assert (both.rank, both.inseparable, both.remedies) == (1, (together,), (signal,))
    assert stage.judged(name, touched, signals=(signal,)).whole
    (other,) = {ENCODER, GAP_SENSOR} - {signal}
    assert stage.judged(name, touched, signals=(other,)).whole == (name == ZERO and other == GAP_SENSOR)


def test_remedies_that_are_stated_are_the_ones_that_split(axis, stage):
    for bench, name, move in ((stage, MODE, "sine 3 Hz"), (stage, LOOP, "creep"), (axis, DELAYS, "fast stroke")):
        recordings = [bench.recording(bench.log(move))]
        one = set_of(recordings, name)
        stated = {r.name for r in one.remedies}
        tried = [bench.moves[n] for n in ("slow reversals", "slow stroke", "middle stroke", "fast stroke")]
        assert stated <= set(splitting(recordings, one, tried))


def test_what_is_not_excited_is_no_alias(stage):
    """Off the edges no force knows where they are, and nothing is said to look like them."""
    off = stage.judged(ZERO, stage.log("slow stroke"))
    assert off.rank == 0
    assert off.inseparable == off.remedies == ()
    assert len(off.not_excited) == 2


def test_a_report_lists_what_runs_leave_open(stage, touched):
    recordings = [stage.recording(log) for log in (stage.log("fast stroke"), touched)]
    left = {one.name: one for one in not_separable(recordings)}
    assert {SCALE, DELAYS, CONSTANTS, CABLE, DRIFT, ZERO} == set(left)
    assert left[DRIFT].text == (
        "which of two sensors drifts: thermal_drift on macro_sensor / thermal_drift on end_sensor. "
        "splits: encoder of the macro's drive"
    )
    assert left[DRIFT].power == pytest.approx(0.05, abs=0.01)
    named = {one.name: one for one in separations_of(stage.believed, [stage.log("fast stroke"), touched])}
    assert named[REACTION].whole


def test_the_limit_is_power_nine_tenths():
    """At 5 % false alarms, one-sided."""
    assert norm.cdf(np.sqrt(ALIAS_GAIN) - norm.ppf(0.95)) == pytest.approx(0.9, abs=2e-3)


def test_every_set_stands_on_its_page(stage):
    page = Path("docs/what-cannot-be-told-apart.md").read_text()
    for one in alias_sets([stage.recording(stage.log("fast stroke"))]):
        assert one.name in page
        assert one.why in page
        for remedy in one.remedies:
            assert remedy.name in page


@pytest.mark.skipif(emps.folder() is None, reason="STAGECTL_DATA names no folder with emps/DATA_EMPS.mat")
def test_on_emps_the_constant_forces_are_one_set():
    folder = emps.folder()
    assert folder is not None
    believed, training, held = emps.read(folder)
    named = {one.name: one for one in separations_of(believed, [*training, *held])}
    assert named[CONSTANTS].inseparable == ((OFFSET, TILT, AMPLIFIER, UNEVEN),)
    assert named[DELAYS].inseparable == ((LATE_MACRO, "macro_latch_s"),)
