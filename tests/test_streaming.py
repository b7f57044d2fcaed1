"""Set-points from a client: one smooth reference whatever the blocks, and refusals that say number, value and limit."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stagectl.errors import RequestError
from stagectl.streaming import AHEAD_LEAST_S, AHEAD_MOST_S, Room, SetpointBuffer
from stagectl.trajectory import Limits, MotionState

DT_S, PERIOD_S = 1e-3, 0.01
ROOM = Room((-0.45, 0.45), Limits(0.4, 0.9, 9.0), 2.0)
REST = MotionState(0.0)


def swing(count=300):
    """A soft to and fro of 20 mm from rest to rest."""
    t = np.arange(count) / (count - 1)
    return list(0.01 * (1.0 - np.cos(2.0 * np.pi * t)) * np.sin(np.pi * t) ** 2)


def new():
    return SetpointBuffer(0.0, PERIOD_S, ROOM, DT_S)


def emptied(buffer):
    rows, state = [], REST
    while buffer.ahead_s > 0.0:
        taken, _, state = buffer.next_rows(0.2, state)
        rows.append(taken)
    return np.concatenate(rows), state


@given(st.lists(st.integers(1, 60), min_size=1, max_size=8))
def test_the_reference_is_the_same_however_the_set_points_are_cut(sizes):
    positions = swing()
    whole, cut = new(), new()
    whole.take(0, positions, last=True)
    at = 0
    for size in sizes:
        if at + size >= len(positions):
            break
        cut.take(at, positions[at : at + size])
        at += size
    cut.take(at, positions[at:], last=True)
    expected, got = emptied(whole)[0], emptied(cut)[0]
    assert expected.size == (len(positions) - 1) * 10
    for name in ("position_m", "velocity_m_per_s", "acceleration_m_per_s2", "jerk_m_per_s3"):
        np.testing.assert_allclose(got[name], expected[name], atol=1e-9, rtol=0.0)


def test_the_reference_goes_through_every_set_point_and_its_derivatives_are_its_own():
    positions = swing()
    buffer = new()
    buffer.take(0, positions, last=True)
    rows, state = emptied(buffer)
    np.testing.assert_allclose(rows["position_m"][9::10], positions[1:], atol=1e-15)
    middle = 0.5 * (rows["velocity_m_per_s"][1:] + rows["velocity_m_per_s"][:-1])
    np.testing.assert_allclose(np.diff(rows["position_m"]), middle * DT_S, atol=1e-9)
    assert abs(state.velocity_m_per_s) < 1e-3


def test_behind_every_part_there_is_a_way_to_rest():
    buffer = new()
    buffer.take(0, swing())
    state = REST
    while buffer.ahead_s > 0.0:
        rows, tail, state = buffer.next_rows(0.13, state)
        if tail.size:
            assert tail["velocity_m_per_s"][-1] == 0.0
            step_m = tail["position_m"][0] - rows["position_m"][-1]
            assert step_m == pytest.approx(state.velocity_m_per_s * DT_S, abs=2e-6)


def begun(count=100):
    buffer = new()
    buffer.take(0, swing()[:count])
    return buffer


def test_out_of_order_and_doubled_blocks():
    buffer = begun()
    with pytest.raises(RequestError, match="set-point 101 is out of order: 100 must come next; send from there on"):
        buffer.take(101, [0.0])
    with pytest.raises(RequestError, match="set-point 50 is out of order"):
        buffer.take(50, swing()[50:60])
    buffer.take(100, swing()[100:110])
    ahead_s = buffer.ahead_s
    buffer.take(100, swing()[100:110])  # the same again: its answer was lost
    assert (buffer.next_number, buffer.ahead_s) == (110, ahead_s)


@pytest.mark.parametrize(
    ("block", "text"),
    [
        ([0.0, float("nan")], "set-point 101 is nan; every one must be a finite number"),
        ([float("inf")], "set-point 100 is inf"),
        ([0.1] * 5, r"set-point 99: on the way there acceleration_m_per_s2 is .*, beyond 0.9 m/s\^2: send a smoother"),
    ],
)
def test_a_bad_block_is_refused_whole_and_the_stream_goes_on(block, text):
    buffer = begun()
    ahead_s = buffer.ahead_s
    with pytest.raises(RequestError, match=text):
        buffer.take(100, block)
    assert (buffer.next_number, buffer.ahead_s) == (100, ahead_s)
    buffer.take(100, swing()[100:])


def test_limits_are_named():
    for shape, text in (
        (lambda t: 0.14 * t**3, r"set-point \d+: on the way there velocity_m_per_s is 0.40\d*, beyond 0.4 m/s: send"),
        (lambda t: 2.0 * t**3, r"set-point \d+: on the way there acceleration_m_per_s2 is 0.9\d*, beyond 0.9 m/s\^2"),
    ):
        buffer = new()
        with pytest.raises(RequestError, match=text):
            buffer.take(0, [float(shape(i * PERIOD_S)) for i in range(200)])
    buffer = SetpointBuffer(0.4, PERIOD_S, ROOM, DT_S)
    with pytest.raises(
        RequestError, match=r"set-point \d+: .* beyond the travel \[-0.45, 0.45\] m: go slower near its end"
    ):
        buffer.take(0, [0.4 + 0.1 * (i * PERIOD_S) ** 3 / (1.0 + (i * PERIOD_S) ** 2) for i in range(200)])
    with pytest.raises(RequestError, match=r"set-point 0 is 0.1 m and the stage holds at 0 m"):
        new().take(0, [0.1])
    with pytest.raises(
        RequestError, match=r"period_s is 0.0015: .* whole number of cycles of 0.001 s apart; give 0.002"
    ):
        SetpointBuffer(0.0, 0.0015, ROOM, DT_S)


def test_a_stream_that_could_stop_hard_but_not_brake_gently_before_the_end_is_refused():
    times_s = [i * PERIOD_S for i in range(200)]
    # to 0.1 m/s within 0.3 s, on to 5 mm before the end: 2.5 mm for the drive's ramp, 10 mm for the jerk-limited brake
    ways = [0.1 * (t**2 / 0.6 if t < 0.3 else t - 0.15) for t in times_s]
    positions = [0.4 + way for way in ways if way < 0.0445]
    with pytest.raises(
        RequestError, match=r"set-point \d+: braking from there ends at 0.45\d* m, beyond the travel .*: go slower"
    ):
        SetpointBuffer(0.4, PERIOD_S, ROOM, DT_S).take(0, positions)


def test_the_buffer_is_bounded():
    buffer = new()
    most = buffer.room_count
    assert most == round(AHEAD_MOST_S / PERIOD_S)
    with pytest.raises(RequestError, match=rf"are {most + 1}, and {most} have room .* send the others later"):
        buffer.take(0, [0.0] * (most + 1))
    buffer.take(0, [0.0] * most)
    assert buffer.room_count <= 2
    buffer.next_rows(1.0, REST)
    assert buffer.room_count == pytest.approx(100, abs=2)


def test_what_comes_after_the_end_is_late():
    buffer = begun()
    assert buffer.ready
    assert buffer.ahead_s > AHEAD_LEAST_S
    buffer.close("none was there")
    assert not buffer.ended
    with pytest.raises(RequestError, match="set-point 100 comes too late: none was there; begin again with number 0"):
        buffer.take(100, [0.0])
    ended = new()
    ended.take(0, swing(), last=True)
    with pytest.raises(RequestError, match="299 was said to be the last one"):
        ended.take(300, [0.0])
    ended.close("stopped")
    assert not ended.ended  # its last set-points were never followed
