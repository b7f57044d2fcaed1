"""How well the instants of the sensor's samples are recovered from the arrivals of its lines."""

import numpy as np

from drivers.wire import Inbox, WireDecoder
from sim_backend.batch import BatchWire
from sim_backend.machine import Machine
from sim_backend.rig import Rig
from stagectl.fields import fields
from stagectl.profile import Profile
from stagectl.signals import MEASUREMENT, new

FROM_S = 2.0
"""The window grows; before this much of it an instant is not judged."""


def errors_s(profile: Profile, machine: Machine, seed: int, duration_s: float) -> np.ndarray:
    """Listen to the rig's sensor over the wire in batch, drives asleep; return every error from `FROM_S` on, in s."""
    rig = Rig(machine, seed=seed)
    wire = BatchWire(rig)
    decoder = WireDecoder(profile, {})
    measured, inbox = fields(new(MEASUREMENT)), Inbox()
    end_t_ns = wire.t_ns + round(duration_s * 1e9)
    sequences, instants = [], []
    while wire.t_ns < end_t_ns:
        wire.advance_to(wire.next_line_t_ns())
        inbox.clear()
        inbox.t_ns = wire.t_ns
        inbox.add_sensor_bytes(wire.serial.read(), wire.serial.arrival_t_ns)
        decoder.decode(inbox, measured)
        sequences.append(measured.sequence)
        instants.append(measured.sample_t_ns)
    wire.close()
    truth = rig.truth.arrays()
    true_t_ns = truth["t_ns"][np.searchsorted(truth["sequence"], sequences)]
    judged = true_t_ns >= rig.start_t_ns + round(FROM_S * 1e9)
    return (np.array(instants) - true_t_ns)[judged] * 1e-9
