"""The XIMC codec: one table for encoder and decoder, every frame whole, byte by byte and with trailing bytes."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from thermostand.drivers.framing.ximc import ERROR_SIZES, XimcDamage, XimcFrame, crc16, decode, encode, frame_size

# letters, payload, bytes on the wire; the longer ones as libximc 3.1.1 sent them: it fills reserved bytes with 0xCC.
CASES = [
    ("gets", b"", b"gets"),
    ("home", b"", b"home"),
    ("errd", b"", b"errd"),
    ("gser", bytes.fromhex("34120000"), b"gser" + bytes.fromhex("34120000ae11")),
    ("move", bytes.fromhex("900100009cffcccccccccccc"), b"move" + bytes.fromhex("900100009cffcccccccccccc0eaf")),
    ("movr", bytes.fromhex("640000003200cccccccccccc"), b"movr" + bytes.fromhex("640000003200cccccccccccc3c66")),
    (
        "smov",
        bytes.fromhex("8813000000204e204ee80300000000cccccccccccccccccc"),
        b"smov" + bytes.fromhex("8813000000204e204ee80300000000cccccccccccccccccc761b"),
    ),
    (
        "shom",
        bytes.fromhex("b80b000000f401000000f401000000007201cccccccccccccccccc"),
        b"shom" + bytes.fromhex("b80b000000f401000000f401000000007201cccccccccccccccccc9713"),
    ),
]
SIZES = ERROR_SIZES | {letters: len(payload) for letters, payload, _ in CASES}

LETTERS = st.text("abcdefghijklmnopqrstuvwxyz", min_size=4, max_size=4)


def decode_in_pieces(wire: bytes, sizes: dict[str, int]) -> XimcFrame | None:
    kept = b""
    for position in range(len(wire)):
        frame, kept = decode(kept + wire[position : position + 1], sizes)
        if frame is not None:
            return frame if position == len(wire) - 1 else None
    return None


def test_crc_has_the_check_value_of_crc_16_modbus() -> None:
    assert crc16(b"123456789") == 0x4B37
    assert crc16(b"") == 0xFFFF


@pytest.mark.parametrize(("letters", "payload", "wire"), CASES)
def test_a_frame_encodes_and_decodes_whole_in_pieces_and_with_trailing_bytes(
    letters: str, payload: bytes, wire: bytes
) -> None:
    frame = XimcFrame(letters, payload)
    assert encode(letters, payload) == wire
    assert len(wire) == frame_size(len(payload))
    assert decode(wire, SIZES) == (frame, b"")
    assert decode(wire + b"next", SIZES) == (frame, b"next")
    assert decode(b"\0\0\0" + wire, SIZES) == (frame, b"")
    assert decode_in_pieces(wire, SIZES) == frame
    assert decode_in_pieces(b"\0" + wire, SIZES) == frame


@given(LETTERS, st.binary(max_size=210), st.integers(0, 70), st.binary(max_size=9))
def test_any_frame_comes_back_as_it_went(letters: str, payload: bytes, zeros: int, after: bytes) -> None:
    wire = bytes(zeros) + encode(letters, payload) + after
    assert decode(wire, {letters: len(payload)}) == (XimcFrame(letters, payload), after)


@given(LETTERS, st.binary(min_size=1, max_size=60), st.data())
def test_one_flipped_bit_behind_the_letters_is_always_seen(letters: str, payload: bytes, data: st.DataObject) -> None:
    wire = bytearray(encode(letters, payload))
    bit = data.draw(st.integers(8 * 4, 8 * len(wire) - 1))
    wire[bit // 8] ^= 1 << bit % 8
    frame, rest = decode(bytes(wire), {letters: len(payload)})
    assert frame is not None
    assert frame.damage is XimcDamage.CRC
    assert rest == b""


def test_unknown_letters_are_reported_and_the_rest_is_left() -> None:
    assert decode(b"xyzwgets", SIZES) == (XimcFrame("xyzw", damage=XimcDamage.LETTERS), b"gets")
    assert decode(b"\xff\xfe12gets", SIZES) == (XimcFrame("\xff\xfe12", damage=XimcDamage.LETTERS), b"gets")


def test_an_incomplete_frame_is_kept_without_its_leading_zeros() -> None:
    assert decode(b"\0\0gse", SIZES) == (None, b"gse")
    assert decode(b"gser\0\0\0", SIZES) == (None, b"gser\0\0\0")
    assert decode(b"\0\0", SIZES) == (None, b"")
    assert decode(b"", SIZES) == (None, b"")


@pytest.mark.parametrize("letters", ["", "get", "getss", "GETS", "get1", "gét "])
def test_wrong_letters_are_a_mistake_of_the_caller(letters: str) -> None:
    with pytest.raises(ValueError, match="four lower-case letters"):
        encode(letters)
