"""Zeros and joint of a stage: homing, touching both edges, identifying the backlash, believing what was found."""

import math
from dataclasses import replace

import numpy as np

from drivers import cia402
from stagectl import edge_search, touch_sweep
from stagectl.errors import DriveError, LinkError, RequestError
from stagectl.outcome import BacklashEstimate, Outcome
from stagectl.requests import Mode, Phase
from stagectl.session import WATCHED_ONLY
from stagectl.signals import Stop, stop_sentence
from stagectl.stream_motion import StreamMotion
from stagectl.touch_sweep import IDENTIFY_HZ, IDENTIFY_SHARE, KNOWN_OF_JOINT, TOUCH_HZ, TOUCH_S, TOUCH_SHARE

_INDEX_METHODS = (33, 34)  # on the index mark: searched in negative, in positive direction
_STANDSTILL_WINDOW_S = 0.2
_STANDSTILL_M = 20e-6  # in that time: 0.1 um in a cycle of 1 ms
_STANDSTILL_TIMEOUT_S = 3.0


class Homing(StreamMotion):
    """A stage that can be homed and identified."""

    def home(self) -> Outcome:
        """Home the macro by its drive, set its laser, touch both edges, set the end's laser, centre."""
        first_row = self.recorder.rows_count
        try:
            stop = self._home_drive() or self._await_standstill()
            if stop is not Stop.NONE:
                return self._outcome("home", stop, first_row)
            macro_zero, end_zero = self._take_zeros()
        finally:
            self._request(mode=int(Mode.IDLE))
        self._leave_homing()
        estimate = None
        if self.profile.micro is not None:
            held = self.armed()
            if not held.finished:
                return held
            outcome = self._touch()
            estimate = outcome.backlash
            if not outcome.finished or estimate is None:
                return self._outcome("home", outcome.stop, first_row)
            estimate = self.take_backlash(estimate)
        self._event("homing", number=self._homing_id, macro_zero_counts=macro_zero, end_zero_counts=end_zero)
        return self._outcome("home", Stop.FINISHED, first_row, estimate)

    def _take_zeros(self) -> tuple[float, float]:
        """Set the lasers' zeros by the encoder while the macro's drive holds; returns them, in counts."""
        status = self.status()
        macro_scale, end_scale = self._scales()
        macro_zero = float(status["macro_counts"]) - float(status["macro_encoder_m"]) / macro_scale
        # At rest without power the micro's spring stands at its middle: end = macro, until the edges say better.
        end_zero = float(status["end_counts"]) - float(status["macro_encoder_m"]) / end_scale
        self._homing_id += 1
        self._publish_update(macro_zero, end_zero)
        return macro_zero, end_zero

    def _await_standstill(self) -> Stop:
        """Wait until the lasers see the stage stand: they and the encoder tell of instants a cycle apart.

        The macro must, held by its drive; the micro swings on its spring, and is waited for as long as that pays.
        Returns what ended the hold, NONE where it stands. DriveError where the macro moves on.
        """
        window_rows = round(_STANDSTILL_WINDOW_S * self.profile.cycle.rate_hz)
        give_up_t_ns = self.link.now_t_ns() + round(_STANDSTILL_TIMEOUT_S * 1e9)
        status = self._await_sensor()
        while status["phase"] != Phase.STOPPED:
            window_over_t_ns = self.link.now_t_ns() + round(_STANDSTILL_WINDOW_S * 1e9)
            # In steps: a lease may be shorter than the window, and a stop is heard in it.
            self._wait(
                lambda _, over_t_ns=window_over_t_ns: self._asked_to_stop or self.link.now_t_ns() >= over_t_ns,
                _STANDSTILL_TIMEOUT_S,
                "waiting for standstill",
            )
            status = self._await_sensor()
            if status["phase"] != Phase.HOMED_DRIVE:  # something stops it: why is known when it is over
                continue
            if self._asked_to_stop:  # the macro stands, and has power
                self._request(mode=int(Mode.STOP), stop=int(Stop.NONE))
                continue
            rows = self.link.rows.read_last(window_rows)
            # From the least to the greatest: where a swing turns round, it is as far after a while as before.
            macro_m, end_m = (float(np.ptp(rows[f"{axis}_position_m"])) for axis in ("macro", "end"))
            over = self.link.now_t_ns() > give_up_t_ns
            if macro_m <= _STANDSTILL_M and (over or end_m <= _STANDSTILL_M):
                return Stop.NONE
            if over:
                raise DriveError(
                    f"homing: the macro still moves by {macro_m * 1e6:.0f} um in {_STANDSTILL_WINDOW_S:g} s, limit "
                    f"{_STANDSTILL_M * 1e6:g} um, {_STANDSTILL_TIMEOUT_S:g} s after its drive found the index; check "
                    "that the drive's position loop holds there, then home again"
                )
        return Stop(int(status["stop"]))

    def _touch(self) -> Outcome:
        """Sweep until both edges have been pressed; what was believed of the joint is kept where they were not."""
        believed = self.believed_backlash()
        met_both = False
        try:
            outcome = self._sweep_until_met()
            met_both = outcome.finished
            return outcome
        finally:
            if not met_both:
                for name, value in believed.items():  # published with the zeros of the next homing
                    self._belief[name] = value

    def _sweep_until_met(self) -> Outcome:
        """Sweep until both edges were pressed in one sweep, by what `stagectl.edge_search` makes of each before."""
        joint, own = self._joint(), touch_sweep.joint_of(self.profile)
        search = edge_search.init(self.profile, joint)
        if joint.left_m + joint.right_m > own.left_m + own.right_m:
            # A sweep of a worn gap's width whose zero is off by half of it would press one edge with more than it may.
            self._believe(edge_search.Gap(own.left_m + own.right_m))
        found, sweeps_count, missed_count = None, 0, self._missed_cycles_count()
        while True:
            joint = self._joint()
            outcome = self.sweep(TOUCH_SHARE, TOUCH_HZ, TOUCH_S, "touching both edges")
            sweeps_count += 1
            estimate = outcome.backlash
            if not outcome.finished or estimate is None:
                return outcome
            if found is not None:
                return outcome if estimate.identifiable else found
            if estimate.identifiable:
                if search.wider_count == 0:
                    return outcome
                # An edge that a wider sweep has just reached was pressed less than it may be: 1.5 um off with 0.9 N.
                found = replace(outcome, backlash=self.take_backlash(estimate))
                continue
            wider_count = search.wider_count
            try:
                # The link keeps the newest 16 s: of a longer sweep, two swings and more.
                gap = edge_search.step(search, joint, estimate, self.link.rows.read_last(outcome.rows))
            except RequestError as error:
                raise DriveError(
                    f"homing: not both edges of the joint were touched in {sweeps_count} sweeps at {TOUCH_SHARE:.0%} "
                    f"of backlash.touch_force_n, the widest for a gap of {(joint.left_m + joint.right_m) * 1e3:.3g} mm "
                    f"({error}), with {self._missed_cycles_count() - missed_count} missed cycles; check "
                    "backlash.left_m and right_m, micro.stroke_m and the voice coil, and where cycles were missed the "
                    "host"
                ) from error
            if gap is None:
                continue
            if search.wider_count > wider_count:
                self._event("joint_wider", met=gap.known, pressed_n=search.pressed_n, width_m=gap.width_m)
            self._believe(gap)

    def _joint(self) -> touch_sweep.Joint:
        return touch_sweep.joint_of(self.profile, self.believed_backlash())

    def _believe(self, gap: edge_search.Gap) -> None:
        """Believe a gap that nobody has measured whole."""
        joint = self.believed_backlash()
        known, edge_m = gap.known, gap.edge_m
        if known is None:
            known, edge_m = "right", joint["right_m"] + 0.5 * (gap.width_m - joint["left_m"] - joint["right_m"])
        other = "left" if known == "right" else "right"
        joint |= {f"{known}_m": edge_m, f"{other}_m": gap.width_m - edge_m}
        sds = {name: math.inf for name in BacklashEstimate.__dataclass_fields__ if "_sd" in name}
        self.take_backlash(BacklashEstimate(**joint, **sds))

    def _missed_cycles_count(self) -> int:
        return int(self.status()["missed_cycles"])

    def _scales(self) -> tuple[float, float]:
        from drivers.wire import WireDecoder

        decoder = WireDecoder(self.profile, self.mappings)
        ratio = decoder.air_index / float(self.status()["air_index_ratio"])  # the index in use follows the air
        return decoder.macro_m_per_count * ratio, decoder.end_m_per_count * ratio

    def _homing_method(self) -> int:
        """Return the profile's method; where the index was found before, search towards it (CiA 402, 33 and 34)."""
        method = self.profile.macro.homing.method
        if self._homing_id == 0 or method not in _INDEX_METHODS:
            return method
        return _INDEX_METHODS[1] if float(self.status()["macro_encoder_m"]) < 0.0 else _INDEX_METHODS[0]

    def _home_drive(self) -> Stop:
        """Let the macro's drive find its index, and hold there; where there is none on the one side, on the other.

        A stage that was connected anew does not know on which side of the index it stands.
        """
        if not self.backend.may_move:  # before anything is written to a drive
            raise RequestError(WATCHED_ONLY)
        method = self._homing_method()
        stop = self._search(method)
        if stop is not Stop.HOMING_GIVEN_UP or method not in _INDEX_METHODS or self._failed(self.status()):
            return stop
        other = _INDEX_METHODS[1 - _INDEX_METHODS.index(method)]
        self._event("homing_turned", method=method, other=other, text=self.detail)
        return self.acknowledge() or self._search(other)

    def _search(self, method: int) -> Stop:
        """Let the macro's drive home by a method of CiA 402."""
        homing, node = self.profile.macro.homing, self.profile.macro.node_id
        step_m = self.profile.macro.encoder_step_m
        self.disarm()
        self._demand_agreed()
        if self._heartbeats.missing:
            return Stop.HEARTBEAT_LOST
        master = self.master
        self._write_mode("macro", cia402.MODE_HOMING)
        master.write(node, cia402.HOMING_METHOD, 0, method)
        master.write(node, cia402.HOMING_SPEEDS, 1, round(homing.speed_m_per_s / step_m))
        master.write(node, cia402.HOMING_SPEEDS, 2, round(homing.speed_m_per_s / step_m))
        master.write(node, cia402.HOMING_ACCELERATION, 0, round(homing.acceleration_m_per_s2 / step_m))
        self._demand_mode("macro", cia402.MODE_HOMING)
        if self._stopped_meanwhile("homing the macro"):
            return Stop.OPERATOR
        self._holds_lease = True
        self._reason = ""
        self.pump()
        self._request(mode=int(Mode.HOME_DRIVE), stop=int(Stop.NONE))
        self.pump()
        status = self._wait(lambda s: s["phase"] == Phase.HOMED_DRIVE, homing.timeout_s, "homing the macro")
        return Stop(int(status["stop"]))

    def _leave_homing(self) -> None:
        """Wait until the macro's drive has let go; enabling gives it back the mode that the servo works in.

        LinkError where a drive is not heard of any more.
        """
        off = cia402.State.SWITCH_ON_DISABLED
        self._wait(
            lambda s: bool(self._heartbeats.missing) or cia402.state_of(int(s["macro_statusword"])) is off,
            5.0,
            "resting",
        )
        if self._heartbeats.missing:
            raise LinkError(f"homing: {stop_sentence(Stop.HEARTBEAT_LOST, self._heartbeats.detail(self._node_ids))}")

    def take_backlash(self, estimate: BacklashEstimate) -> BacklashEstimate:
        """Believe an identified backlash; the end's zero moves so that the gap's centre is where the profile has it.

        Returns the estimate in the zeros that hold from now on. RequestError where it is none.
        """
        _refuse_no_joint(estimate)
        status = self.status()
        macro_scale, end_scale = self._scales()
        before_m = float(status["end_counts"]) * end_scale - float(status["end_position_m"])
        centre_m = 0.5 * (float(self._belief["right_m"][0]) - float(self._belief["left_m"][0]))
        # x_b = macro - end must grow by (centre - identified centre): the end's positions shrink by it
        end_zero = (before_m + (centre_m - estimate.centre_m)) / end_scale
        macro_zero = float(status["macro_counts"]) - float(status["macro_position_m"]) / macro_scale
        half_m = 0.5 * estimate.width_m
        estimate = replace(estimate, left_m=half_m - centre_m, right_m=half_m + centre_m)
        for name in KNOWN_OF_JOINT:
            self._belief[name] = getattr(estimate, name)
        self._publish_update(macro_zero, end_zero)
        return estimate

    def replace_backlash(self, estimate: BacklashEstimate) -> None:
        """Believe what wear has made of the joint; zeros stay, the stage does not move, the estimator begins anew.

        A recorded event. RequestError where it is none, an edge is not above 0, or a motion is under way.
        """
        _refuse_no_joint(estimate)
        if not (estimate.left_m > 0.0 and estimate.right_m > 0.0):
            raise RequestError(
                f"backlash from {-estimate.left_m:g} to {estimate.right_m:g} m: zero must be between its edges; the "
                "end's zero has moved: look at the end's interferometer, then home"
            )
        status = self.status()
        if status["phase"] != Phase.TRACKING or status["segment_left_rows"] > 0:
            raise RequestError("a backlash is replaced between moves only; wait until the stage holds")
        before = {name: float(self._belief[name][0]) for name in KNOWN_OF_JOINT}
        for name in KNOWN_OF_JOINT:
            self._belief[name] = getattr(estimate, name)
        self._event(
            "backlash_replaced", before=before, after={name: float(self._belief[name][0]) for name in KNOWN_OF_JOINT}
        )
        macro_scale, end_scale = self._scales()
        macro_zero = float(status["macro_counts"]) - float(status["macro_position_m"]) / macro_scale
        end_zero = float(status["end_counts"]) - float(status["end_position_m"]) / end_scale
        self._publish_update(macro_zero, end_zero)

    def believed_backlash(self) -> dict[str, float]:
        """Return what the compensation believes of the joint: edges and stiffness."""
        return {name: float(self._belief[name][0]) for name in KNOWN_OF_JOINT}

    def probe(self) -> Outcome:
        """Touch both edges with `TOUCH_SHARE` of the touch force (5 N at most), only where the profile permits it."""
        if self.profile.wear.probe_every_s is None:
            raise RequestError(
                f"profile {self.profile.name} permits no touch probe; give wear.probe_every_s, or identify instead"
            )
        return self.sweep(TOUCH_SHARE, TOUCH_HZ, TOUCH_S, "touching both edges")

    def sweep(
        self, force_share: float, usual_hz: float, duration_s: float, name: str, asked_hz: float | None = None
    ) -> Outcome:
        """Let the micro meet both edges, as `stagectl.touch_sweep` has it for the joint that is believed now."""
        if self.profile.micro is None or self.profile.backlash is None:
            raise RequestError(f"{name}: this stage has no micro; there is no backlash to identify")
        status = self.status()
        self._centre(status)
        believed = self.believed_backlash()
        centre_m = float(status["setpoint_position_m"])
        planned = touch_sweep.planned(self.profile, force_share, usual_hz, duration_s, asked_hz, believed, centre_m)
        return self.follow(planned.setpoints, name)

    def identify(self, frequency_hz: float | None = None, duration_s: float = 20.0) -> Outcome:
        """Identify the backlash from a sweep over both contacts; without a frequency, one that suits the joint."""
        return self.sweep(IDENTIFY_SHARE, IDENTIFY_HZ, duration_s, "identifying the backlash", frequency_hz)


def _refuse_no_joint(estimate: BacklashEstimate) -> None:
    if not touch_sweep.could_be({name: getattr(estimate, name) for name in KNOWN_OF_JOINT}):
        stiffnesses = (estimate.left_stiffness_n_per_m, estimate.right_stiffness_n_per_m)
        raise RequestError(
            f"backlash of {estimate.width_m:g} m about {estimate.centre_m:g} m with {stiffnesses} N/m: every value "
            "must be finite, width and stiffness above 0; identify again, touching both edges"
        )
