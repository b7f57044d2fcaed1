"""Frame lengths against hand-derived ones, arbitration against a hand-drawn time line."""

import numpy as np
import pytest

from sim_backend.bus_load import BusModel, frame_bits
from stagectl.errors import LinkError


def test_sync_is_51_bits():
    # 0 00010000000 0 0 0 0000 + CRC-15 of it: 47 bits and 4 stuffed ones (canopen reference, table 4).
    assert frame_bits(0x080, b"") == 51


def test_the_all_zero_frame_is_53_bits():
    # id 0, DLC 0: 19 zeros, and the CRC of zeros is zero: 34 zeros, a stuff bit after every fifth: 34 + 6 + 13.
    assert frame_bits(0x000, b"") == 53


def _stuffed(can_id: int, payload: bytes) -> int:
    """Count stuff bits by the letter of ISO 11898-1, on a list of bits."""
    bits = [0, *(int(c) for c in f"{can_id:011b}"), 0, 0, 0, *(int(c) for c in f"{len(payload):04b}")]
    bits += [int(c) for byte in payload for c in f"{byte:08b}"]
    remainder = bits + [0] * 15
    generator = [1, 1, 0, 0, 0, 1, 0, 1, 1, 0, 0, 1, 1, 0, 0, 1]  # x15+x14+x10+x8+x7+x4+x3+1
    for k in range(len(bits)):
        if remainder[k]:
            for j, g in enumerate(generator):
                remainder[k + j] ^= g
    bits += remainder[-15:]
    sent: list[int] = []
    for bit in bits:
        sent.append(bit)
        if len(sent) >= 5 and len(set(sent[-5:])) == 1 and _run(sent) == 5:
            sent.append(1 - bit)
    return len(sent) - len(bits)


def _run(sent: list[int]) -> int:
    count = 1
    while count < len(sent) and sent[-1 - count] == sent[-1]:
        count += 1
    return count


def test_lengths_of_random_frames_agree_with_the_slow_model_and_the_reference_table():
    generator = np.random.default_rng(1)
    lengths = []
    for _ in range(300):
        payload = generator.bytes(8)
        can_id = int(generator.integers(0, 0x800))
        bits = frame_bits(can_id, payload)
        assert bits == 111 + _stuffed(can_id, payload)
        lengths.append(bits)
    assert 114.0 < np.mean(lengths) < 116.5  # table 4: mean 115
    assert max(lengths) <= 135


def test_four_byte_frames_lie_between_the_table_limits():
    assert 79 <= frame_bits(0x201, bytes.fromhex("0f00d204")) <= 95


def test_too_long_frames_are_refused():
    with pytest.raises(LinkError, match="8 bytes"):
        frame_bits(0x80, bytes(9))


def test_lowest_id_goes_first_and_nothing_is_preempted():
    bus = BusModel(3)
    bus.submit(0, 1000, 0x201, bytes(4))
    bus.submit(1, 2000, 0x181, bytes(8))
    bus.submit(2, 2000, 0x080, b"")
    long_bits, middle_bits = frame_bits(0x201, bytes(4)), frame_bits(0x181, bytes(8))
    first = 1000 + 1000 * (long_bits - 3)
    assert bus.deliver()[:3] == (first, 0, 0x201)  # began alone, is not interrupted
    second = first + 3000 + 1000 * 48
    assert bus.deliver()[:3] == (second, 2, 0x080)
    assert bus.deliver()[:3] == (second + 3000 + 1000 * (middle_bits - 3), 1, 0x181)
    assert bus.busy_ns == 1000 * (long_bits + 51 + middle_bits)
    assert bus.next_delivery_t_ns() is None


def test_frames_of_one_station_keep_their_order():
    bus = BusModel(1)
    bus.submit(0, 0, 0x202, bytes(4))
    bus.submit(0, 0, 0x080, b"")
    assert bus.deliver()[2] == 0x202
    assert bus.deliver()[2] == 0x080


def test_a_later_submission_does_not_enter_an_arbitration_that_is_over():
    bus = BusModel(2)
    bus.submit(0, 0, 0x300, b"")
    assert bus.next_delivery_t_ns() is not None
    bus.submit(1, 10_000, 0x080, b"")
    assert bus.deliver()[2] == 0x300
