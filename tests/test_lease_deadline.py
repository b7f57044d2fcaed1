"""The lease behind the desk: how long the session gives it, and that the servo stops at its end, to the nanosecond.

A stage in virtual time. Edges are asked of the servo between two of its cycles.
"""

import itertools
import math
import re

import pytest

from drivers import cia402
from stagectl.backend import BatchBackend
from stagectl.record import read_run
from stagectl.requests import Mode, Phase
from stagectl.servo import Servo
from stagectl.signals import Stop
from stagectl.supervisor import Supervisor
from tests.stage import with_values
from tests.struck_stage import SEED, home_by_truth

ON, OFF = cia402.State.OPERATION_ENABLED, cia402.State.SWITCH_ON_DISABLED
STOPPED = cia402.State.QUICK_STOP_ACTIVE
MS = 1_000_000
LONGEST_S = 3.0  # of the profile here
RENEW = "renew it as long as the stage moves"


class Leased:
    """A stage whose lease is as long as a test says."""

    def __init__(self, folder, profile, machine):
        self.left_s = math.inf
        self.backend = BatchBackend(machine, seed=SEED)
        profile = with_values(profile, trip__lease_s=LONGEST_S)
        self.stage = Supervisor(profile, self.backend, folder, lease_left_s=lambda: self.left_s)
        self.folder = folder

    def __enter__(self):
        self.stage.__enter__()
        home_by_truth(self.stage, self.backend.rig.plant_state())
        return self

    def __exit__(self, *error):
        self.stage.__exit__(*error)

    @property
    def servo(self) -> Servo:
        assert self.backend.servo is not None
        return self.backend.servo

    def given_ns(self):
        """Let a moment pass; return how long the lease was that it began with."""
        now_ns = self.stage.link.now_t_ns()
        self.stage.pump()
        return self.servo._asked.lease_until_t_ns - now_ns

    def left_ns(self, left_ns):
        """Say how much the servo sees left of its lease; returns an instant at which its supervisor lives."""
        self.servo._seen.lease_left_ns = left_ns
        self.servo._seen.store()
        return self.servo._counter_t_ns + 1

    def in_phase(self, phase, mode=Mode.TRACK):
        """Set the servo back into a phase of which nothing is told yet."""
        self.servo.phase, self.servo.stop, self.servo.text = phase, Stop.NONE, ""
        self.servo._asked.mode = int(mode)


@pytest.fixture
def one(tmp_path, single_profile, single_machine):
    with Leased(tmp_path / "run", single_profile, single_machine) as leased:
        yield leased


@pytest.fixture
def armed(one):
    assert one.stage.enable() is Stop.NONE
    yield one
    one.in_phase(Phase.STOPPED)  # whatever a test made of it: it is brought to rest here
    one.left_s = math.inf


# ---- the session -----------------------------------------------------------------------------------------------------


def test_the_servo_s_lease_is_what_is_left_and_no_longer_than_the_profile_has_it(one):
    assert one.given_ns() == 0  # nothing has power: it needs none
    assert one.stage.enable() is Stop.NONE
    for left_s, given_ns in ((math.inf, 3_000_000_000), (2.5, 2_500_000_000), (0.25, 250_000_000), (-1.0, 0)):
        one.left_s = left_s
        assert one.given_ns() == given_ns
    one.left_s = math.inf


def test_a_stage_without_power_has_no_lease_any_more(one):
    assert one.stage.enable() is Stop.NONE
    assert one.stage.disarm() is Stop.OPERATOR
    assert one.given_ns() == 0


def test_a_homing_has_a_lease_and_needs_it(one):
    assert one.stage.home().finished
    assert one.given_ns() == 3_000_000_000
    assert one.stage.disarm() is Stop.NONE
    one.left_s = 0.0
    assert one.stage.home().stop is Stop.LEASE


# ---- the servo -------------------------------------------------------------------------------------------------------


def test_a_lease_that_nobody_renews_ends_in_the_next_cycle_and_the_stage_comes_to_rest_by_its_law(one):
    assert one.stage.enable() is Stop.NONE
    one.left_s = 0.02
    one.stage.pump(0.1)
    assert (one.servo.stop, one.servo.phase) == (Stop.LEASE, Phase.STOPPING)
    assert re.fullmatch(rf"it ended (0\.\d|1\.0) ms ago; {RENEW}", one.servo.text)
    one.stage.pump(0.5)
    assert (one.servo.stop, one.servo.phase) == (Stop.LEASE, Phase.STOPPED)
    one.stage.close()
    rows = read_run(one.folder).rows
    phases = [Phase(int(phase)) for phase, _ in itertools.groupby(rows["run_phase"])]
    assert phases[-3:] == [Phase.TRACKING, Phase.STOPPING, Phase.STOPPED]


@pytest.mark.parametrize(("left_ns", "phase"), [(1, Phase.TRACKING), (0, Phase.STOPPING), (-2_500_000, Phase.STOPPING)])
def test_the_last_nanosecond_of_a_lease(armed, left_ns, phase):
    servo = armed.servo
    assert servo._advance_phase(armed.left_ns(left_ns)) == (ON, ON)
    assert servo.phase is phase
    assert servo.stop is (Stop.NONE if left_ns > 0 else Stop.LEASE)
    assert servo.text == ("" if left_ns > 0 else f"it ended {-left_ns * 1e-6:.1f} ms ago; {RENEW}")


def test_a_lease_that_lasts_is_recorded_as_it_is_and_none_is_needed_to_come_to_rest(armed):
    """The guard stops where none is left: of a stage that comes to rest it must see one."""
    servo, seen = armed.servo, armed.servo._seen

    def recorded_ns():
        seen.load()
        return seen.lease_left_ns

    servo._advance_phase(armed.left_ns(1))
    assert recorded_ns() == 1
    for phase in (Phase.TRACKING, Phase.STOPPING):
        for left_ns, then_ns in ((0, MS), (-5 * MS, MS), (MS - 1, MS), (5 * MS, 5 * MS)):
            armed.in_phase(phase, Mode.STOP)
            servo._advance_phase(armed.left_ns(left_ns))
            assert recorded_ns() == then_ns


def test_a_lease_keeps_no_stage_in_motion_that_must_rest(armed):
    """The supervisor is silent, the encoder lies, rest was asked for: each by itself, under a lease that lasts."""
    servo = armed.servo
    silent_t_ns = armed.left_ns(MS) + servo._silence_ns
    servo._advance_phase(silent_t_ns - 1)
    assert servo.phase is Phase.TRACKING
    servo._advance_phase(silent_t_ns)
    assert (servo.phase, servo.stop) == (Phase.STOPPING, Stop.SUPERVISOR_SILENT)
    armed.in_phase(Phase.TRACKING, Mode.STOP)
    servo._advance_phase(armed.left_ns(MS))
    assert (servo.phase, servo.stop) == (Phase.STOPPING, Stop.OPERATOR)
    armed.in_phase(Phase.TRACKING)
    servo.decoder.encoder_text = "the encoder lies"
    servo._advance_phase(armed.left_ns(MS))
    servo.decoder.encoder_text = ""
    assert (servo.phase, servo.stop) == (Phase.STOPPING, Stop.ENCODER_LOST)


@pytest.mark.parametrize("phase", [Phase.IDLE, Phase.ENABLING])
def test_no_drive_gets_power_without_a_lease(armed, phase):
    servo = armed.servo
    for left_ns in (0, -1):
        armed.in_phase(phase)
        assert servo._advance_phase(armed.left_ns(left_ns)) == (OFF, OFF)
        assert (servo.phase, servo.stop) == (Phase.STOPPED, Stop.LEASE)
        assert servo.text == f"there was none when the drives were to get power; {RENEW}"
    armed.in_phase(phase)
    servo._advance_phase(armed.left_ns(1))
    assert servo.phase in (Phase.ENABLING, Phase.TRACKING)
    armed.in_phase(Phase.IDLE, Mode.IDLE)
    assert servo._advance_phase(armed.left_ns(MS)) == (OFF, OFF)


def test_a_homing_ends_with_its_lease(armed):
    servo = armed.servo
    macro_state = cia402.state_of(servo._seen.macro_statusword)
    servo._seen.macro_mode_display = cia402.MODE_HOMING  # as the supervisor has it before it asks for a homing

    def homing(left_ns, mode=Mode.HOME_DRIVE, silent=False):
        armed.in_phase(Phase.HOMING_DRIVE, mode)
        servo._searches = False
        targets = servo._homing(mode, macro_state, silent, armed.left_ns(left_ns))
        return targets, servo.phase, servo.stop, servo.text

    ended = (STOPPED, OFF), Phase.QUICK_STOP
    assert homing(1) == ((ON, OFF), Phase.HOMING_DRIVE, Stop.NONE, "")
    assert homing(0) == homing(-1) == (*ended, Stop.LEASE, "")
    assert homing(1, silent=True) == (*ended, Stop.SUPERVISOR_SILENT, "")
    assert homing(1, mode=Mode.STOP) == (*ended, Stop.OPERATOR, "")
