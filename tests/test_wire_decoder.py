"""The decoder: when its bytes are taken changes nothing."""

import numpy as np
import pytest

from drivers.wire import Inbox, WireDecoder
from sim_backend.batch import BatchWire
from sim_backend.machine import load_machine
from sim_backend.rig import Rig
from stagectl.fields import fields
from stagectl.profile import load_profile
from stagectl.signals import MEASUREMENT, new

MS = 1_000_000


def _measurements(name: str, taken_early: bool) -> tuple[np.ndarray, np.ndarray]:
    """Listen for 0.6 s, two lines a cycle, each taken at once or both at its end; measurements and clock."""
    wire = BatchWire(Rig(load_machine(name), seed=3))
    decoder = WireDecoder(load_profile(name), {})
    measured, inbox = new(MEASUREMENT), Inbox()
    seen = fields(measured)
    rows = np.zeros(300, MEASUREMENT)
    for number in range(rows.size):
        inbox.clear()
        due_t_ns = wire.t_ns + 2 * MS
        while (line_t_ns := wire.next_line_t_ns()) <= due_t_ns:
            wire.advance_to(line_t_ns)
            inbox.add_sensor_bytes(wire.serial.read(), wire.serial.arrival_t_ns)
            if taken_early:
                decoder.take_bytes(inbox)
        wire.advance_to(due_t_ns)
        inbox.t_ns = wire.t_ns
        assert decoder.decode(inbox, seen) == ""
        seen.store()
        rows[number] = measured[0]
    wire.close()
    return rows, decoder.clock


@pytest.mark.parametrize("name", ["oled-printer", "oled-printer-umd2"])
def test_bytes_taken_before_the_cycle_is_due_give_the_same_measurements(name):
    early, late = _measurements(name, True), _measurements(name, False)
    assert early[0]["samples_new"].sum() > 590
    assert np.array_equal(early[0], late[0])
    assert np.array_equal(early[1], late[1])
