"""`stagectl jog --keys`: hold an arrow key to move; a key let go, or a terminal that is gone, ends the motion."""

import math
import os
import select
import sys
import termios
import time
import tty
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from rich.markup import escape

from stagectl.client import Client
from stagectl.commands.answer import ENDED_EARLY, EXIT_CODES, Answer, Voice
from stagectl.commands.remote import answered, connected, leased, prepared, refuse_other
from stagectl.errors import JogOver, LinkError, RequestError
from stagectl.service import messages

FIRST_HOLD_S = 0.6
"""Of a key pressed anew: keyboards repeat after half a second."""

NEXT_HOLD_S = 0.2
_STEP_S, _LOOK_S = 0.05, 0.5
_HOLDS = ("armed", "moving")
_RIGHT, _LEFT = (b"\x1b[C", b"\x1bOC", b"l", b"d"), (b"\x1b[D", b"\x1bOD", b"h", b"a")
_FASTER, _SLOWER, _LEAVE = (b"\x1b[A", b"\x1bOA", b"+"), (b"\x1b[B", b"\x1bOB", b"-"), (b"q", b"\x04")

_KNOWN = (*_RIGHT, *_LEFT, *_FASTER, *_SLOWER, *_LEAVE)


class Hand:
    """What the keys want: a direction for as long as a key is held, and a speed."""

    def __init__(self, speed_m_per_s: float, top_m_per_s: float):
        """Nothing is held yet."""
        self.speed_m_per_s, self._top_m_per_s = min(speed_m_per_s, top_m_per_s), top_m_per_s
        self._direction = 0.0
        self._until_s = -math.inf
        self.leaves = False

    def press(self, keys: bytes, now_s: float) -> None:
        """Take what came from the terminal; anything unknown lets go."""
        while keys:
            key = next((one for one in _KNOWN if keys.startswith(one)), keys[:1])
            keys = keys[len(key) :]
            if key in _RIGHT or key in _LEFT:
                direction = 1.0 if key in _RIGHT else -1.0
                goes_on = direction == self._direction and now_s < self._until_s
                self._direction, self._until_s = direction, now_s + (NEXT_HOLD_S if goes_on else FIRST_HOLD_S)
            elif key in _FASTER or key in _SLOWER:
                self.speed_m_per_s = min(self.speed_m_per_s * (2.0 if key in _FASTER else 0.5), self._top_m_per_s)
            else:
                self.leaves = self.leaves or key in _LEAVE
                self.let_go()

    def let_go(self) -> None:
        """Hold no key."""
        self._direction, self._until_s = 0.0, -math.inf

    def wanted_m_per_s(self, now_s: float) -> float:
        """Return the velocity that the keys want now."""
        return self._direction * self.speed_m_per_s if now_s < self._until_s else 0.0


def jog(
    voice: Voice,
    socket: Path | None,
    token: str | None,
    profile: str | None,
    backend: str,
    speed_m_per_s: float,
) -> Answer:
    """Home where it is needed, arm, and follow the keys until q."""
    if not sys.stdin.isatty():
        raise RequestError("--keys needs a terminal to read keys from; give --distance-m instead")
    with connected(socket) as stage, leased(voice, stage, token):
        status = stage.status()
        refuse_other(status, profile, backend)
        voice.note(status.banner)
        failed = prepared(voice, stage, status, "jog")
        if failed is not None:
            return answered(failed, stage.status())
        limits = stage.status().limits
        top_m_per_s = math.inf if limits is None else limits.jog_velocity_m_per_s
        voice.note("hold left or right to move, up and down double and halve the speed, space lets go, q ends")
        with _bare_keys(sys.stdin.fileno()) as fileno:
            ended = _follow_keys(voice, stage, Hand(speed_m_per_s, top_m_per_s), fileno)
        found = ended or stage.status()
    data = {"end_position_m": found.positions.end_position_m, "state": found.state}
    if ended is None:
        return Answer(data, ["let go"])
    fault = ended.fault
    text = f"the stage is {ended.state}" if fault is None else f"{fault.kind}: {fault.values}; {fault.remedy}"
    is_link = fault is not None and fault.kind in ("LINK_LOST", "LinkError")
    return Answer(data, [f"[red]ended early[/]: {escape(text)}"], EXIT_CODES[LinkError] if is_link else ENDED_EARLY)


def _follow_keys(voice: Voice, stage: Client, hand: Hand, fileno: int) -> messages.Status | None:
    """Follow the keys until they leave; returns how the stage stands where it took no more before."""
    key, was_moving, look_s = "", False, 0.0
    while not hand.leaves:
        voice.check()
        if select.select([fileno], [], [], _STEP_S)[0]:
            keys = os.read(fileno, 256)
            if not keys:
                return None
            hand.press(keys, time.monotonic())
        asked_s = time.monotonic()
        wanted = hand.wanted_m_per_s(asked_s)
        if wanted == 0.0 and not was_moving and asked_s >= look_s:  # by nothing else it is heard that it holds no more
            look_s = asked_s + _LOOK_S
            found = stage.status()
            if found.state not in _HOLDS:
                return found
        if wanted != 0.0 or (was_moving and key):
            key = _jogged(stage, key, wanted)
            if not key and (found := stage.status()).state not in _HOLDS:
                return found
        was_moving = wanted != 0.0
        if time.monotonic() - asked_s > NEXT_HOLD_S:
            let_go_meanwhile(hand, fileno)
    return None


def let_go_meanwhile(hand: Hand, fileno: int) -> None:
    """Take what was typed while a request was under way, and hold none of it: it may have been let go of long since."""
    while select.select([fileno], [], [], 0.0)[0] and (keys := os.read(fileno, 256)):
        hand.press(keys, time.monotonic())
    hand.let_go()


def _jogged(stage: Client, key: str, wanted_m_per_s: float) -> str:
    """Begin a jog, or go on with it; returns its key, empty where it is over or the stage holds no more.

    Beginning may take its time: what the keys want is looked at again before a velocity is said.
    """
    try:
        return stage.jog_at(key, wanted_m_per_s).key if key else stage.begin_jog().key
    except JogOver:
        return ""
    except RequestError:
        give_up_s = time.monotonic() + _LOOK_S
        while stage.status().state in _HOLDS:  # somebody stops it, and that shows soon, or it is something else
            if time.monotonic() > give_up_s:
                raise
            time.sleep(_STEP_S)
        return ""


@contextmanager
def _bare_keys(fileno: int) -> Iterator[int]:
    """Have every key come at once and unseen; the terminal is as before afterwards."""
    before = termios.tcgetattr(fileno)
    try:
        tty.setcbreak(fileno)
        yield fileno
    finally:
        termios.tcsetattr(fileno, termios.TCSADRAIN, before)
