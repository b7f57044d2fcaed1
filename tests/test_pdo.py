"""The PDO codec against golden frames that were worked out by hand from CiA 301 (little endian, first
mapped object in the lowest bytes) and CiA 402 (objects, widths, signs)."""

import pickle

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.pdo import Codec, Entry, entry_of
from stagectl.errors import LinkError, RequestError

RPDO_TORQUE = (0x60400010, 0x60710010)
RPDO_POSITION = (0x60400010, 0x607A0020, 0x60B20010)
TPDO_ACTUAL = (0x60410010, 0x60640020, 0x60770010)
TPDO_INPUTS = (0x60FD0020,)


def test_torque_command():
    # controlword 0x000F -> 0F 00. Torque -123: 0x10000 - 123 = 65413 = 0xFF85 -> 85 FF.
    assert Codec.from_mapping(RPDO_TORQUE).encode(0x000F, -123) == bytes.fromhex("0F 00 85 FF")


def test_torque_command_at_its_limits():
    # 32767 = 0x7FFF -> FF 7F; -32768 = 0x8000 -> 00 80.
    codec = Codec.from_mapping(RPDO_TORQUE)
    assert codec.encode(0x0006, 32767) == bytes.fromhex("06 00 FF 7F")
    assert codec.encode(0xFFFF, -32768) == bytes.fromhex("FF FF 00 80")


def test_position_command():
    # 0x001F -> 1F 00. -1 000 000 counts: 2^32 - 1 000 000 = 4 293 967 296 = 0xFFF0BDC0 -> C0 BD F0 FF.
    # Torque offset 250 = 0x00FA -> FA 00.
    payload = Codec.from_mapping(RPDO_POSITION).encode(0x001F, -1_000_000, 250)
    assert payload == bytes.fromhex("1F 00 C0 BD F0 FF FA 00")


def test_actual_values():
    # 37 16 -> 0x1637 = 5687. 15 CD 5B 07 -> 0x075BCD15 = 123 456 789. 9C FF -> 0xFF9C = 65436 - 65536 = -100.
    codec = Codec.from_mapping(TPDO_ACTUAL)
    assert codec.names == ("statusword", "position", "torque")
    assert codec.decode(bytes.fromhex("37 16 15 CD 5B 07 9C FF")) == (0x1637, 123_456_789, -100)


def test_actual_values_most_negative():
    # 00 00 00 80 -> 0x80000000 - 2^32 = -2 147 483 648; 00 80 -> -32768; the statusword has no sign: FF FF -> 65535.
    payload = bytes.fromhex("FF FF 00 00 00 80 00 80")
    assert Codec.from_mapping(TPDO_ACTUAL).decode(payload) == (65535, -2_147_483_648, -32768)


def test_digital_inputs():
    # Bits 0 (negative limit), 3 (interlock), 16 (air pressure): 1 + 8 + 0x10000 -> 09 00 01 00; no sign.
    codec = Codec.from_mapping(TPDO_INPUTS)
    assert codec.decode(bytes.fromhex("09 00 01 00")) == (0x0001_0009,)
    assert codec.decode(bytes.fromhex("00 00 00 80")) == (0x8000_0000,)


def test_modes_are_signed_bytes():
    # Mode -1 (vendor) = FF; 10 = 0A.
    codec = Codec.from_mapping((0x60600008, 0x60610008))
    assert codec.names == ("mode", "mode_display")
    assert codec.encode(10, -1) == bytes.fromhex("0A FF")


def test_mapping_word_layout():
    # CiA 301: index << 16 | sub-index << 8 | bits.
    assert entry_of(0x60640020) == Entry(0x6064, 0, 32, True)
    assert Entry(0x6071, 0, 16, True).word == 0x60710010
    assert entry_of(0x20310208) == Entry(0x2031, 2, 8, False)
    assert entry_of(0x20310208).name == "object_2031_02"


def test_slot_names_and_places():
    codec = Codec.from_mapping(RPDO_POSITION)
    assert codec.names == ("controlword", "target_position", "torque_offset")
    assert codec.slot("torque_offset") == 2
    with pytest.raises(LinkError, match="not 'torque'"):
        codec.slot("torque")


@pytest.mark.parametrize("length", range(8))
def test_short_payload_is_refused_whole(length):
    with pytest.raises(LinkError, match=f"PDO of {length} bytes.*needs 8"):
        Codec.from_mapping(TPDO_ACTUAL).decode(bytes(length))


def test_longer_payload_gives_the_mapped_bytes():
    assert Codec.from_mapping(TPDO_INPUTS).decode(bytes.fromhex("01 00 00 00 FF FF FF FF")) == (1,)


@pytest.mark.parametrize("bits", [1, 7, 12, 24, 0])
def test_unaligned_map_is_refused(bits):
    with pytest.raises(LinkError, match=rf"0x6041:00 has {bits} bits"):
        Codec((Entry(0x6041, 0, bits, False),))


def test_map_longer_than_a_frame_is_refused():
    with pytest.raises(LinkError, match="needs 10 bytes"):
        Codec.from_mapping((0x60410010, 0x60640020, 0x60770010, 0x60400010))


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ((15, 32768), "target_torque = 32768 is outside -32768 .. 32767"),
        ((15, -32769), "target_torque = -32769 is outside -32768 .. 32767"),
        ((-1, 0), "controlword = -1 is outside 0 .. 65535"),
        ((15, 1.5), "target_torque = 1.5 is not a whole number"),
        ((15, float("nan")), "target_torque = nan is not a whole number"),
        ((15,), "needs 2 values"),
    ],
)
def test_encode_refuses_what_does_not_fit(values, words):
    with pytest.raises(RequestError, match=words):
        Codec.from_mapping(RPDO_TORQUE).encode(*values)


def test_codec_crosses_to_another_process():
    codec = pickle.loads(pickle.dumps(Codec.from_mapping(RPDO_TORQUE)))
    assert codec == Codec.from_mapping(RPDO_TORQUE)
    assert codec.encode(0x000F, -123) == bytes.fromhex("0F 00 85 FF")


@given(st.integers(0, 0xFFFF), st.integers(-(2**31), 2**31 - 1), st.integers(-(2**15), 2**15 - 1))
def test_every_value_that_fits_survives(statusword, position, torque):
    codec = Codec.from_mapping(TPDO_ACTUAL)
    assert codec.decode(codec.encode(statusword, position, torque)) == (statusword, position, torque)
