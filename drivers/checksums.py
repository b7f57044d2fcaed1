"""Checksums of serial frames.

Pure.
"""

import binascii
from collections.abc import Callable
from functools import reduce


def _sum8(data: bytes) -> int:
    return sum(data) & 0xFF


def _xor8(data: bytes) -> int:
    return reduce(int.__xor__, data, 0)


def _crc16_ccitt(data: bytes) -> int:
    # crc_hqx is the polynomial 0x1021, most significant bit first, not reflected; the start value is ours.
    return binascii.crc_hqx(data, 0xFFFF)


CHECKSUMS: dict[str, tuple[int, Callable[[bytes], int]]] = {
    "sum8": (1, _sum8),
    "xor8": (1, _xor8),
    "crc16-ccitt": (2, _crc16_ccitt),
}
"""Name -> bytes on the wire, function over all bytes before them."""
