"""The real stage loop walked over its table: any request and any fault in any state, on the rig in virtual time.

`test_states.py` walks the table alone. Here the loop is held to the table, with the rig as the witness: its drives' own
states, its true motion, and the rows that the servo wrote.

The file takes 20 to 23 s of CPU on a busy machine: 4 s to begin, 6 s for the eight walks, 9 s for the one that takes
every transition.
"""

import contextlib
import shutil
import tempfile
from dataclasses import replace
from datetime import datetime
from pathlib import Path

import numpy as np
from hypothesis import Phase, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, rule

from sim_backend.faults import Fault
from stagectl.errors import LinkError, RequestError
from stagectl.profile import PROFILES_FOLDER
from stagectl.requests import Phase as ServoPhase
from stagectl.service import messages
from stagectl.service.desk import Busy, Ending, Unfit
from stagectl.service.lease import LeaseRefused
from stagectl.service.remembered import Remembered
from stagectl.service.states import TRANSITIONS, Event, State
from stagectl.signals import Stop
from tests.faults.scene import PROFILE
from tests.faults.witness import ENABLED, seen_of
from tests.service.test_stage_loop import ENCODER_FAULT, Bench
from tests.struck_stage import home_by_truth
from tests.toml_text import changed

FAST_HOMING = {"macro.homing.speed_m_per_s": 0.1, "macro.homing.acceleration_m_per_s2": 0.5}
REFUSALS = {kind.__name__ for kind in (RequestError, LeaseRefused, Busy, Unfit, Ending)}
FAULT_KINDS = {stop.name for stop in Stop} | {
    "SERVICE_LOST",
    "ProfileError",
    "LinkError",
    "DriveError",
    "TimingError",
    "RecordError",
}
MAY_MOVE = (State.MOVING, State.IDENTIFYING, State.STOPPING)
BRAKES = (State.ARMING, State.FAULT)  # what drifted without power, and what stops by itself
MAY_ENABLE = (State.ARMING, State.MOVING)  # a homing begins without power
STILL_M_PER_S = 5e-3  # true speed of the macro
LEASE_S = 30.0
UNPROVOKED = {
    (
        State.MOVING,
        Event.RESTED,
    ): "a motion refused half way, or ended without power and without a stop: no request and "
    "no fault of the rig was found that does it; each stop is heard first, and shown as stopping",
}
"""What no walk here was seen to take, and why."""
STEPS_LIMIT = 500

REQUESTS = {
    "arm": messages.Arm(),
    "home": messages.Home(),
    "move": messages.Move(target_m=0.06),
    "move back": messages.Move(target_m=-0.06),
    "move outside": messages.Move(target_m=50.0),
    "jog": messages.JogBy(distance_m=-0.01),
    "jog outside": messages.JogBy(distance_m=0.8),
    "identify": messages.Identify(duration_s=2.0),
    "reread": messages.Home(),  # no field of it is read
}
STRIKES = {
    "emergency": (Fault("emergency", node_id=1, code=ENCODER_FAULT),),
    "drive reboots": (Fault("power_loss", node_id=1, duration_s=0.1),),
    "beam breaks": (Fault("beam_loss", axis="both", duration_s=0.2),),
    "interferometer unplugged": (Fault("unplug", duration_s=0.2),),
    "statusword stuck": (Fault("stuck_statusword", node_id=1, duration_s=4.0),),
    "something in the way": tuple(Fault("obstacle", offset_m=side * 2e-3, duration_s=1.0) for side in (-1.0, 1.0)),
}


class Walked:
    """A loop whose every transition, row and true sample is held to the table; the lease's clock is the rig's."""

    def __init__(self, folder, remembered=None):
        path = folder / f"{PROFILE}.toml"
        path.write_text(changed(PROFILES_FOLDER / f"{PROFILE}.toml", FAST_HOMING))
        for eds in PROFILES_FOLDER.glob("*.eds"):
            shutil.copy(eds, folder)
        self.bench = Bench(folder, str(path), remembered=remembered)
        self.loop, self.desk, self.log = self.bench.loop, self.bench.desk, self.bench.log
        self.loop.settings = replace(self.bench.settings, machine=PROFILE)
        self.seen: set[tuple[State, Event]] = set()
        self.faults: list[messages.Fault] = []
        self.refused: set[str] = set()  # keys of what was never taken over
        self._told = State.OFF  # by the log
        self._entered_fault = False
        self._begun: dict[str, tuple] = {}  # what held as a command began, by its key
        self._refusing: tuple | None = None  # what has to hold when the refusal of a command is public
        self._acts: list[list] = []  # publications to wait for, and what is done then
        self._backend = None
        self._begin_world()
        self._say, self._publish, self._observe = self.log.say, self.desk.publish, self.loop._observe
        self.log.say, self.desk.publish, self.loop._observe = self._heard, self._published, self._observed

    def _begin_world(self):
        self._t_ns, self._judged_t_ns, self._was_enabled, self._last_row = 0, 0, False, None
        self._from_t_ns, self._states, self._rows = [-1], [State.OFF], []

    @property
    def state(self):
        return self.loop._state

    @property
    def holds(self):
        """The state, and where the stage is commanded to be."""
        stage = self.loop._stage
        return self.state, None if stage is None else float(stage.status()["setpoint_position_m"])

    # ---- what the loop says ------------------------------------------------------------------------------------

    def _heard(self, event, text="", **fields):
        entry = self._say(event, text, **fields)
        if event == "state":
            self._transition(State(fields["before"]), Event(fields["because"]), State(fields["state"]))
        elif event == "fault":
            if not self._entered_fault:
                self._transition(State.FAULT, Event.TRIPPED, State.FAULT)
            self._entered_fault = False
            self._judge_fault(self.loop._fault)
        elif event == "command":
            assert fields["key"] not in self.refused
            self._begun[fields["key"]] = self.holds
        elif event == "command_failed" and fields["kind"] in REFUSALS and not self.desk.stop_asked:
            self._refusing = self._begun.get(fields["key"], self.holds)
        return entry

    def _transition(self, begin, because, end):
        assert begin is self._told, f"{end} because of {because} from {begin}, last told was {self._told}"
        assert TRANSITIONS.get((begin, because)) is end, f"{begin} became {end} because of {because}"
        if because in (Event.ARM, Event.HOME, Event.MOVE, Event.IDENTIFY):
            assert self.desk.lease_left_s() > 0.0, f"{because} in {begin} without a lease"
        self.seen.add((begin, because))
        self._told, self._entered_fault = end, end is State.FAULT and begin is not State.FAULT
        if because is Event.CONNECTED:
            self.judge()
            self._backend = self.loop._stage.backend
            self._begin_world()
        self._follow_time()
        self._from_t_ns.append(self._t_ns)
        self._states.append(end)

    def _judge_fault(self, fault):
        assert not self.faults or fault.number > self.faults[-1].number
        assert all((fault.what, fault.values, fault.remedy)), fault
        assert fault.kind in FAULT_KINDS, fault
        assert fault.state in list(State), fault
        assert datetime.fromisoformat(fault.at).tzinfo is not None
        self.faults.append(fault)

    def _follow_time(self):
        if self.loop._stage is not None and not self.loop._opening:
            t_ns = self.loop._stage.backend.wire.t_ns
            self.bench.now_s += 1e-9 * max(t_ns - self._t_ns, 0)
            self._t_ns = t_ns

    def _published(self, status, state):
        self._publish(status, state)
        self._follow_time()
        assert (status.state, state) == (self._told.value, self._told), "clients see what the log was not told"
        assert (status.fault is None) is (state is not State.FAULT), status
        if status.fault is not None:
            assert status.fault == self.faults[-1]
        if self._refusing is not None:
            held, self._refusing = self._refusing, None
            assert self.holds == held, f"a refused command led from {held} to {self.holds}"
        for act in self._acts:
            act[0] -= 1
        due = [act for act in self._acts if act[0] <= 0]
        self._acts = [act for act in self._acts if act[0] > 0]
        for _, act in due:
            act()

    def _observed(self, rows):
        self._rows.append(rows.copy())
        self._observe(rows)

    # ---- what the rig says -------------------------------------------------------------------------------------

    def _state_at(self, t_ns):
        """Return the states that the loop was in at these instants, as numbers of `State`'s order."""
        order = list(State)
        numbers = np.array([order.index(state) for state in self._states])
        return numbers[np.searchsorted(self._from_t_ns, t_ns, side="right") - 1]

    def judge(self):
        """Hold what the rig and the servo's rows show since the last time to the states that the loop was in then."""
        if self._backend is None:
            return
        truth = seen_of(self._backend.truth())
        new = truth["t_ns"] > self._judged_t_ns
        t_ns = truth["t_ns"][new]
        if t_ns.size:
            self._judge_truth(t_ns, truth["states"][new], truth["macro_velocity_m_per_s"][new])
            self._judged_t_ns = t_ns[-1]
        if self._rows:
            rows, self._rows = np.concatenate(self._rows), []
            self._judge_rows(rows)

    def _judge_truth(self, t_ns, drives, velocity_m_per_s):
        states = self._state_at(t_ns)
        enabled = (drives == ENABLED).any(axis=1)
        rises = enabled & ~np.concatenate([[self._was_enabled], enabled[:-1]])
        self._was_enabled = bool(enabled[-1])
        self._none(t_ns, states, rises & ~among(states, MAY_ENABLE), "power came on")
        self._none(t_ns, states, enabled & among(states, (State.OFF, State.IDLE)), "power is on")
        powered = drives[:, 0] == ENABLED  # a macro without power drifts as the cables pull it
        moves = powered & (np.abs(velocity_m_per_s) > STILL_M_PER_S)
        self._none(t_ns, states, enabled & ~moves & among(states, (State.FAULT,)), "power is on at rest")
        self._none(t_ns, states, moves & ~among(states, (*MAY_MOVE, *BRAKES)), "the macro moves")

    def _judge_rows(self, rows):
        states = self._state_at(rows["t_ns"])
        moving = (rows["setpoint_velocity_m_per_s"] != 0.0) | (rows["setpoint_relative_velocity_m_per_s"] != 0.0)
        commanded = moving & (rows["run_phase"] == ServoPhase.TRACKING)  # in its stop the reference follows the stage
        before = np.concatenate([[bool(self._last_row)], commanded[:-1]])
        self._last_row = bool(commanded[-1])
        self._none(rows["t_ns"], states, commanded & ~among(states, MAY_MOVE), "the reference moves")
        begins = commanded & ~before
        self._none(rows["t_ns"], states, begins & ~(rows["lease_left_ns"] > 0), "a motion begins without a lease")

    def _none(self, t_ns, states, wrong, what):
        found = np.flatnonzero(wrong)
        if found.size:
            first = found[0]
            told = [(state.value, round(1e-9 * at, 4)) for state, at in zip(self._states, self._from_t_ns, strict=True)]
            raise AssertionError(
                f"{what} in {list(State)[states[first]]} at {1e-9 * t_ns[first]:.4f} s, {found.size} samples until "
                f"{1e-9 * t_ns[found[-1]]:.4f} s; the loop was {told[-8:]}"
            )

    # ---- what clients and the world do -------------------------------------------------------------------------

    def ask(self, name):
        """Submit a command; None where the desk refuses it, which changes nothing."""
        body = REQUESTS[name]
        return self._submit(name.split()[0], body)

    def acknowledge(self, ahead=0):
        """Acknowledge the newest fault, or one that there is not."""
        number = self.faults[-1].number if self.faults else 1
        return self._submit("acknowledge", messages.Acknowledge(number=number + ahead))

    def _submit(self, name, body):
        before, key = self.holds, f"k{self.bench.keys + 1}"
        try:
            return self.bench.begin(name, body)
        except RequestError:
            self.refused.add(key)
            assert self.desk.command(key) is None
            assert self.holds == before
            return None

    def hold_a_key(self):
        """Jog for 0.3 s."""
        with contextlib.suppress(RequestError):
            self.bench.keys += 1
            key = self.desk.begin_jog(messages.BeginJog(), f"k{self.bench.keys}", self.bench.token).key
            self.desk.jog_at(key, messages.JogAt(velocity_m_per_s=0.05), self.bench.token)

    def take(self):
        """Take the lease where it is free, or renew it."""
        with contextlib.suppress(RequestError):
            if self.desk.lease_left_s() > 0.0:
                self.desk.renew_lease(self.bench.token)
            else:
                self.bench.take()

    def lapse(self):
        """Nobody renews the lease."""
        self.bench.now_s += LEASE_S + 1.0

    def give_back(self):
        """End the lease."""
        with contextlib.suppress(RequestError):
            self.desk.give_lease_back(self.bench.token)

    def stop(self):
        """Ask for rest."""
        self.desk.ask_to_stop("the walk")

    def strike(self, name):
        """Have the rig do what a drive, a cable or a sensor may."""
        if self.loop._stage is not None and not self.loop._opening:
            self.bench.inject(*STRIKES[name])

    def lose_servo(self):
        """Have no cycle run any more, as after `kill -9` of the servo."""

        def gone(duration_s):
            raise LinkError("the servo process ended with -9; the drives stop the stage by themselves")

        link = self.loop._stage.link
        link.pass_time, link.close = gone, lambda: None

    def home_by_truth(self):
        """Hold a stage that rests as homed: ten seconds of touching less."""
        if self.state is State.IDLE and not self.loop._homed:
            home_by_truth(self.loop._stage, self.loop._stage.backend.rig.plant_state())
            self.loop._homed = True

    def later(self, count, act):
        """Have something done behind so many publications: in the middle of a command, where one is under way."""
        self._acts.append([count, act])

    # ---- time ----------------------------------------------------------------------------------------------------

    def step(self, count=1):
        """Let the loop do so many things."""
        for _ in range(count):
            self.loop.step()
        self.judge()

    def until(self, *states):
        """Step until the loop is in one of these states; fails after many steps."""
        for _ in range(STEPS_LIMIT):
            is_public = self.desk._state is self.state and self.desk._waiting is None
            if self.state in states and is_public and not self.desk.stop_asked:
                self.judge()
                return
            self.loop.step()
        raise AssertionError(f"still {self.state}, not {states}: {self.bench.status}")

    def do(self, name):
        """Ask, and see it carried out; returns the command."""
        self.take()
        key = self.ask(name) if name != "acknowledge" else self.acknowledge()
        assert key is not None, f"{name} was refused in {self.state}: {self.bench.status.lease}"
        for _ in range(STEPS_LIMIT):
            if self._over(key):
                break
            self.loop.step()
        self.judge()
        assert self._over(key), self.desk.command(key)
        return self.desk.command(key)

    def _over(self, key):
        return self.desk.command(key).state in ("done", "failed")

    def recover(self):
        """Leave the stage armed: acknowledge, home, arm."""
        for _ in range(4):
            self._acts.clear()
            self.until(State.IDLE, State.ARMED, State.FAULT)
            if self.state is State.FAULT:
                self.step(60)  # what struck is over
                self.do("acknowledge")
                continue
            if self.state is State.IDLE:
                self.home_by_truth()
                self.do("arm")
            if self.state is State.ARMED:
                return
        raise AssertionError(self.bench.status)

    def end(self):
        """End the service."""
        self._acts.clear()
        self.loop.leave()
        self.loop.run()
        self.judge()
        assert self.state in (State.OFF, State.FAULT)


def among(states, some):
    """Tell which numbers of `State`'s order are of one of some states."""
    order = list(State)
    return np.isin(states, [order.index(state) for state in some])


class StageWalk(RuleBasedStateMachine):
    """Anything asked, and anything that breaks, in any state: at once, or in the middle of what is under way."""

    whens = st.one_of(st.just(0), st.integers(1, 40))

    def __init__(self):
        super().__init__()
        self.folder = tempfile.TemporaryDirectory(ignore_cleanup_errors=True)  # pruning may just look through it
        self.walked = Walked(Path(self.folder.name))
        self.walked.until(State.IDLE)
        self.walked.home_by_truth()
        self.walked.take()

    def _at(self, when, act):
        if when:
            self.walked.later(when, act)
        else:
            act()
        self.walked.step()

    @rule(when=whens, name=st.sampled_from([name for name in REQUESTS if name != "home"]))
    def a_client_asks(self, when, name):
        self._at(when, lambda: self.walked.ask(name))

    @rule(name=st.sampled_from(["move", "move back", "jog", "identify"]))
    def a_client_moves(self, name):
        self.walked.take()
        self._at(0, lambda: self.walked.ask(name))

    @rule(name=st.sampled_from([name for name in REQUESTS if "outside" not in name]))
    def nobody_holds_the_lease(self, name):
        self.walked.lapse()
        assert self.walked.ask(name) is None
        self._at(0, self.walked.hold_a_key)

    @rule(stop=st.integers(1, 30))
    def a_homing_is_stopped(self, stop):  # a whole one takes 5 s of CPU
        self.walked.later(stop, self.walked.stop)
        self._at(0, lambda: self.walked.ask("home"))

    @rule(when=whens, ahead=st.sampled_from([0, 0, 1]))
    def a_client_acknowledges(self, when, ahead):
        self._at(when, lambda: self.walked.acknowledge(ahead))

    @rule(when=whens, what=st.sampled_from(["stop", "take", "lapse", "give_back", "hold_a_key"]))
    def a_client_does(self, when, what):
        self._at(when, getattr(self.walked, what))

    @rule(when=whens, name=st.sampled_from(sorted(STRIKES)))
    def something_breaks(self, when, name):
        self._at(when, lambda: self.walked.strike(name))

    @rule(count=st.integers(1, 15))
    def time_passes(self, count):
        self.walked.step(count)

    @rule()
    def an_operator_finds_the_way_back(self):
        self.walked.recover()

    @invariant()
    def the_rig_saw_nothing_else(self):
        self.walked.judge()

    def teardown(self):
        try:
            self.walked.end()
        finally:
            self.folder.cleanup()


TestStageWalk = StageWalk.TestCase
TestStageWalk.settings = settings(
    max_examples=8,
    stateful_step_count=15,
    derandomize=True,
    database=None,
    deadline=None,
    phases=(Phase.generate,),  # to shrink a failure takes minutes
)


def test_one_walk_takes_every_transition_of_the_table(tmp_path):
    w = Walked(tmp_path, Remembered(powered_since="2026-01-01T00:00:00.000+00:00", backend="batch"))
    w.loop.recall_fault()  # off -> fault
    w.do("acknowledge")  # fault -> off
    w.until(State.IDLE)  # off -> idle
    w.home_by_truth()
    w.take()
    w.lapse()
    assert not [name for name in REQUESTS if w.ask(name) is not None]
    w.loop._stage._demand_agreed = w.stop  # while the drives are read
    assert w.do("arm").stop == "OPERATOR"  # idle -> arming -> stopping -> idle
    del w.loop._stage._demand_agreed
    w.until(State.IDLE)
    w.later(10, w.stop)
    assert w.do("home").stop == "OPERATOR"  # idle -> moving -> stopping
    w.recover()  # idle -> arming -> armed
    w.later(10, w.stop)
    assert w.do("home").stop == "OPERATOR"  # armed -> moving
    w.recover()
    assert w.do("move").stop == "FINISHED"  # moving -> armed
    assert w.do("identify").stop == "FINISHED"  # armed -> identifying -> armed
    w.later(3, w.stop)
    assert w.do("identify").stop == "OPERATOR"  # identifying -> stopping
    w.recover()
    w.later(3, lambda: w.strike("beam breaks"))
    assert w.do("identify").stop == "REFERENCE_LOST"  # identifying -> stopping -> fault
    w.recover()  # fault -> idle
    w.later(10, lambda: w.strike("something in the way"))
    assert w.do("move back").stop == "MICRO_STROKE"  # moving -> stopping -> fault
    w.recover()
    for name in ("identify", "move back"):
        w.later(10, w.lose_servo)
        assert w.do(name).error.kind == "LinkError"  # identifying, moving -> fault
        w.recover()
    w.strike("emergency")
    w.until(State.FAULT)  # armed -> stopping -> fault
    w.stop()
    w.step(2)
    assert w.state is State.FAULT  # a stop takes the power, and acknowledges nothing
    w.strike("statusword stuck")
    w.step()
    assert w.do("acknowledge").state == "failed"  # fault -> fault
    w.recover()
    w.stop()
    w.until(State.IDLE)
    w.strike("emergency")
    w.step()
    assert w.do("arm").stop == "EMERGENCY"  # arming -> fault
    w.recover()
    w.take()
    key = w.ask("move")
    w.lapse()
    w.until(State.FAULT)  # armed -> stopping
    assert w.desk.command(key).error.kind == "LeaseRefused"
    w.recover()
    w.lose_servo()
    w.until(State.FAULT)  # armed -> fault
    w.do("acknowledge")
    w.until(State.IDLE)
    assert w.do("reread").state == "done"  # idle -> off
    w.until(State.IDLE)
    w.strike("interferometer unplugged")
    w.until(State.FAULT)  # idle -> fault
    w.end()
    assert set(TRANSITIONS) - w.seen == set(UNPROVOKED), "as UNPROVOKED lists them, no more and no fewer"
    assert {begin for begin, _ in w.seen} == set(State)
