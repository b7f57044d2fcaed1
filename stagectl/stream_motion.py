"""Following set-points that a client sends ahead: what the servo has always ends at rest, whatever comes or doesn't."""

import math

import numpy as np

from stagectl.motion import Motion
from stagectl.outcome import Outcome
from stagectl.requests import Phase
from stagectl.signals import SETPOINT, Stop
from stagectl.streaming import SetpointBuffer
from stagectl.trajectory import MotionState

_PART_S = 1.0  # handed to the servo at a time
_REFILL_S = 0.7  # left before the way to rest begins: time for more
_MARGIN_S = 0.1  # five of the supervisor's steps: later than that, more could not be taken in time
_BEGIN_TIMEOUT_S = 5.0


class StreamMotion(Motion):
    """A stage that can follow a stream."""

    def follow_stream(self, buffer: SetpointBuffer) -> Outcome:
        """Follow set-points until the last one, or until none came in time: then the stage brakes, STARVED."""
        name, first_row, dt_s = "following set-points", self.recorder.rows_count, 1.0 / self.profile.cycle.rate_hz
        self._centre(self.status())
        until_t_ns = self.link.now_t_ns() + round(_BEGIN_TIMEOUT_S * 1e9)
        state = MotionState(float(self.status()["setpoint_position_m"]))
        number, under_way, reference_count = self._segment_number, np.zeros(0, SETPOINT), 0
        pending: tuple[int, int, np.ndarray, int] | None = None  # number, row, rows, how many of them are reference
        begun = False
        while True:
            status = self.pump()
            if status["phase"] != Phase.TRACKING:
                buffer.close("the stage was stopped")
                status = self._wait(lambda s: s["phase"] == Phase.STOPPED, 20.0, "coming to rest")
                return self._outcome(name, Stop(int(status["stop"])), first_row)
            self._progress(name, 0.0)
            if not begun:
                if buffer.ready:
                    rows, tail, state = buffer.next_rows(_PART_S, state)
                    under_way, reference_count, begun = np.concatenate([rows, tail]), rows.size, True
                    number = self._begin_segment(under_way, name)
                elif self.link.now_t_ns() > until_t_ns:
                    return self._starved(buffer, name, first_row, f"too few to begin with in {_BEGIN_TIMEOUT_S:g} s")
                continue
            if pending is not None and status["segment_number"] == pending[0]:
                (number, _, under_way, reference_count), pending = pending, None
            if status["segment_number"] != number:  # not begun yet
                continue
            left_rows = max(int(status["segment_left_rows"]), 0)
            done_rows = under_way.size - left_rows
            if pending is not None:
                if left_rows == 0 and pending[1] < under_way.size:  # it came too late, and was not taken
                    return self._starved(buffer, name, first_row, "the host was late")
                continue
            if left_rows == 0:
                if buffer.ended:
                    buffer.close("the stream is over")
                    return self._outcome(name, Stop.FINISHED, first_row)
                return self._starved(buffer, name, first_row, f"none behind number {buffer.next_number - 1}")
            ahead_s = (reference_count - done_rows) * dt_s
            if ahead_s < _MARGIN_S and not buffer.ended:
                buffer.close(f"none was there {_MARGIN_S:g} s before it was needed, and the stage braked")
            elif ahead_s < _REFILL_S and buffer.ahead_s > 0.0:
                rows, tail, state = buffer.next_rows(_PART_S, state)
                joined = np.concatenate([rows, tail])
                asked = self._begin_segment(joined, name, at_row=reference_count)
                pending = asked, reference_count, joined, rows.size

    def _starved(self, buffer: SetpointBuffer, name: str, first_row: int, why: str) -> Outcome:
        buffer.close(f"{why}, and the stage braked")
        self._event("starved", text=why)
        remedy = f"{why}; send them {math.ceil(10 * _REFILL_S) / 10:g} s ahead or more"
        return Outcome(name, Stop.STARVED, first_row, self.recorder.rows_count - first_row, None, remedy)
