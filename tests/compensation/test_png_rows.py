"""PNG frames decoded for the fit are the frames, whatever filter their rows have, and damaged ones are refused."""

import struct
import zlib

import cv2
import numpy as np
import pytest

from compensation.finding import png_rows
from compensation.finding.png_rows import decode_rows
from foundation.errors import SessionError
from recording.format.images import decode_png, encode_png

FILTERS = {
    "none": cv2.IMWRITE_PNG_FILTER_NONE,
    "left": cv2.IMWRITE_PNG_FILTER_SUB,
    "above": cv2.IMWRITE_PNG_FILTER_UP,
    "average": cv2.IMWRITE_PNG_FILTER_AVG,
    "paeth": cv2.IMWRITE_PNG_FILTER_PAETH,
    "all": cv2.IMWRITE_PNG_ALL_FILTERS,
}
GREATEST = {"uint8": 255, "uint16": 65535}


def image(dtype: str, shape: tuple[int, int] = (61, 83)) -> np.ndarray:
    """Smooth, with noise, and with everything from black to white."""
    rng = np.random.default_rng(2)
    ramp = np.linspace(0, 1, shape[0] * shape[1]).reshape(shape) ** 2 + rng.normal(0, 0.05, shape)
    return np.round(np.clip(ramp, 0, 1) * GREATEST[dtype]).astype(dtype)


@pytest.mark.parametrize("dtype", GREATEST)
@pytest.mark.parametrize("name", FILTERS)
def test_every_filter_is_undone(name: str, dtype: str):
    done, data = cv2.imencode(".png", image(dtype), [cv2.IMWRITE_PNG_FILTER, FILTERS[name]])
    assert done
    decoded = decode_rows(data.tobytes())
    assert decoded.dtype.name == dtype
    assert np.array_equal(decoded, image(dtype))


@pytest.mark.parametrize("dtype", GREATEST)
def test_what_the_recorder_writes_is_read_as_its_reader_reads_it(dtype: str):
    for windows in (None, np.array([[5, 6, 20, 30]], np.int32)):
        png = encode_png(image(dtype), windows)
        assert np.array_equal(decode_rows(png), decode_png(png)[0])
    assert np.array_equal(decode_rows(encode_png(image(dtype, (1, 1)))), image(dtype, (1, 1)))


def rewritten(filtered: bytes) -> bytes:
    """The PNG of the image with other filtered rows, checksums right."""
    png = encode_png(image("uint8"))
    compressed = zlib.compress(filtered)
    chunk = b"IDAT" + compressed
    tail = struct.pack(">I", zlib.crc32(chunk)) + b"\0\0\0\0IEND\xaeB\x60\x82"
    return png[:33] + struct.pack(">I", len(compressed)) + chunk + tail


def test_damaged_pixels_are_refused():
    rows = b"".join(b"\0" + bytes(row) for row in image("uint8"))
    assert np.array_equal(decode_rows(rewritten(rows)), image("uint8"))
    for wrong in (rows[:-1], rows + b"\0", b""):
        with pytest.raises(SessionError, match="a recorded image cannot be decoded"):
            decode_rows(rewritten(wrong))
    with pytest.raises(SessionError, match="a row has an unknown filter"):
        decode_rows(rewritten(b"\5" + rows[1:]))
    png = encode_png(image("uint8"))
    with pytest.raises(SessionError, match="a checksum is wrong"):
        decode_rows(png[:60] + bytes([png[60] ^ 1]) + png[61:])
    with pytest.raises(SessionError, match="not a PNG"):
        decode_rows(b"GIF89a")


def only_literals(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing is left to the general decoder."""

    def refuse(*_: object) -> None:
        raise AssertionError("the stream is not read as one of literals")

    monkeypatch.setattr(png_rows, "_decode_in_two", refuse)


def huffman_only(filtered: bytes) -> bytes:
    """The filtered rows as a stream of literals."""
    compressor = zlib.compressobj(1, zlib.DEFLATED, 15, 8, zlib.Z_HUFFMAN_ONLY)
    return compressor.compress(filtered) + compressor.flush()


@pytest.mark.parametrize("shape", [(1, 1), (3, 2), (61, 83), (130, 400)])
def test_the_recorders_frames_are_read_as_literals(shape: tuple[int, int], monkeypatch: pytest.MonkeyPatch):
    only_literals(monkeypatch)
    for dtype in GREATEST:
        assert np.array_equal(decode_rows(encode_png(image(dtype, shape))), image(dtype, shape))


def test_codes_of_every_length_are_read(monkeypatch: pytest.MonkeyPatch):
    only_literals(monkeypatch)
    often = np.repeat(np.arange(20), [int(1.75**k) for k in range(20)])  # codes of 1 to 15 bits
    values = np.random.default_rng(5).permutation(often).astype(np.uint8)
    pixels = values[: len(values) // 200 * 200].reshape(-1, 200)
    rows = b"".join(b"\0" + bytes(row) for row in pixels)
    for stream in (huffman_only(rows), fixed(rows)):
        room = np.empty_like(pixels)
        assert png_rows.decoded_at_once(stream, 1, room)
        assert np.array_equal(room, pixels)


def fixed(data: bytes) -> bytes:
    """One block with the fixed codes (RFC 1951, 3.2.6), literals only."""
    bits = [1, 1, 0]
    for value in data:
        code, length = (0x30 + value, 8) if value < 144 else (0x190 + value - 144, 9)
        bits += [code >> place & 1 for place in reversed(range(length))]
    bits += [0] * 7
    body = np.packbits(bits, bitorder="little").tobytes()
    return b"\x78\x01" + body + struct.pack(">I", zlib.adler32(data))


def test_a_stream_that_is_damaged_is_read_as_the_general_decoder_reads_it():
    """One byte changed, or the end cut off, with every checksum of the PNG right."""
    rows = b"".join(b"\3" + bytes(row) for row in image("uint8"))
    whole = huffman_only(rows)
    rng = np.random.default_rng(1)
    for place in range(0, len(whole), 7):
        damaged = bytearray(whole)
        damaged[place] ^= 1 << int(rng.integers(8))
        for stream in (bytes(damaged), whole[:place]):
            room = np.empty(image("uint8").shape, np.uint8)
            if png_rows.decoded_at_once(stream, 1, room):
                assert zlib.decompress(stream) == rows  # a bit of padding


def test_memory_of_a_frame_that_is_done_with_is_used_again():
    first = np.asarray(decode_rows(encode_png(image("uint8"))), np.uint8)
    other = 255 - image("uint8")
    assert decode_rows(encode_png(other), first) is first
    assert np.array_equal(first, other)
    assert decode_rows(encode_png(image("uint8", (5, 7))), first) is not first
