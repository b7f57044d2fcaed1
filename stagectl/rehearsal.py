"""The cycle before, decoded once more on copies just before the next is due, so that caches are warm when it counts.

A processor that slept for most of a millisecond has nothing in its caches: a line took 29 us to decode where the same
code takes 6 us awake, and 118 us from readable to SYNC where it takes 84 us behind a rehearsal (medians of lines that
came late, the same host, minutes apart). Nothing of a rehearsal reaches the stage, the row or a replay.
"""

from typing import TYPE_CHECKING

import numpy as np

from drivers.cia402 import ENABLE_OPERATION
from drivers.wire import Inbox, WireDecoder, WireEncoder
from stagectl.fields import fields
from stagectl.signals import MEASUREMENT

if TYPE_CHECKING:
    from stagectl.profile import Profile


class Rehearsal:
    """A decoder of its own, one cycle behind the servo's."""

    def __init__(self, profile: "Profile", decoder: WireDecoder, encoder: WireEncoder):
        """Make the copies; `encoder` has no memory and is shared."""
        self._decoder = WireDecoder(profile, decoder.mappings)
        self._encoder = encoder
        self._seen = fields(np.zeros(1, MEASUREMENT))
        self._inbox = Inbox()

    def keep(self, inbox: Inbox) -> None:
        """Remember what this cycle received."""
        kept = self._inbox
        kept.t_ns, kept.sync_t_ns = inbox.t_ns, inbox.sync_t_ns
        kept.sensor_bytes, kept.sensor_arrival_t_ns = inbox.sensor_bytes, inbox.sensor_arrival_t_ns
        kept.first_bytes_count, kept.first_arrival_t_ns = inbox.first_bytes_count, inbox.first_arrival_t_ns
        kept.macro_tpdo, kept.micro_tpdo = inbox.macro_tpdo, inbox.micro_tpdo

    def step(self) -> None:
        """Decode what is kept, and encode frames that go nowhere."""
        self._decoder.decode(self._inbox, self._seen)
        self._seen.store()
        self._encoder.micro(ENABLE_OPERATION, 0)
        self._encoder.macro(ENABLE_OPERATION, 0, 0.0)
        self._inbox.clear()
