"""PNG frames decoded for the fit are the frames, whatever filter their rows have, and damaged ones are refused."""

import struct
import zlib

import cv2
import numpy as np
import pytest

from tests.recording.test_strips import with_index
from thermostand.compensation.finding import png_rows
from thermostand.compensation.finding.png_rows import decode_rows
from thermostand.foundation.errors import SessionError
from thermostand.recording.format.images import check_strip, decode_png, encode_png, strip_places

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


STRIPED = image("uint8", (110, 83))
ROWS = 33
"""Of a strip of so narrow an image: there are four."""


def wanted(*rows: int) -> np.ndarray:
    chosen = np.zeros(len(STRIPED), bool)
    chosen[list(rows)] = True
    return chosen


@pytest.mark.parametrize("dtype", GREATEST)
@pytest.mark.parametrize("rows", [(0,), (50, 51), (109,), (32, 33, 98), ()])
def test_only_the_strips_of_wanted_rows_are_decoded(rows: tuple[int, ...], dtype: str, monkeypatch: pytest.MonkeyPatch):
    only_literals(monkeypatch)
    pixels = image(dtype, STRIPED.shape)
    strips = {row // ROWS for row in rows}
    room = np.full((110, 83 * pixels.itemsize), 7, np.uint8)
    decode_rows(encode_png(pixels), room, wanted(*rows))
    expected = pixels.astype(pixels.dtype.newbyteorder(">")).view(np.uint8)
    for strip in range(4):
        found = room[strip * ROWS : (strip + 1) * ROWS]
        assert np.array_equal(found, expected[strip * ROWS : (strip + 1) * ROWS] if strip in strips else 7 + 0 * found)


def strip_of(png: bytes, number: int) -> tuple[int, int]:
    places = strip_places(png)
    assert places is not None
    assert places.rows == ROWS
    return int(places.begins[number]), int(places.ends[number])


def test_a_damaged_strip_is_reported_where_it_is_wanted():
    png = encode_png(STRIPED)
    begin, end = strip_of(png, 1)
    damaged = png[: begin + 20] + bytes([png[begin + 20] ^ 4]) + png[begin + 21 :]
    assert np.array_equal(decode_rows(damaged, None, wanted(10, 70))[:ROWS], STRIPED[:ROWS])
    for rows in (wanted(40), None):
        with pytest.raises(SessionError, match="a checksum is wrong"):
            decode_rows(damaged, None, rows)
    assert check_strip(png, begin, end)
    assert not check_strip(png, begin, end - 1)


def test_a_strip_that_is_not_one_is_read_as_all_of_the_image():
    """A first row that needs the one above, a stream that goes on in the next strip, codes of another kind: right
    pixels or an error, whatever the index says."""
    rows = b"".join(b"\2" + bytes(row) for row in np.diff(STRIPED, axis=0, prepend=np.uint8(0)))
    compressors = [zlib.compressobj(1, zlib.DEFLATED, -15, 9, strategy) for strategy in (2, 0)]
    for compressor, flush in zip(compressors, (zlib.Z_FULL_FLUSH, zlib.Z_SYNC_FLUSH), strict=True):
        parts = [compressor.compress(rows[first : first + ROWS * 84]) + compressor.flush(flush) for first in cuts()]
        ends = b"\x03\0" + struct.pack(">I", zlib.adler32(rows))
        chunks = [b"IDAT" + body for body in (b"\x78\x01", *parts, ends)]
        index = b"roWS" + struct.pack(">6I", ROWS, 4, *map(len, parts))
        png = encode_png(STRIPED)[:33] + b"".join(
            struct.pack(">I", len(chunk) - 4) + chunk + struct.pack(">I", zlib.crc32(chunk))
            for chunk in (index, *chunks, b"IEND")
        )
        assert strip_places(png) is not None
        assert np.array_equal(decode_rows(png, None, wanted(40)), STRIPED)


def cuts() -> range:
    return range(0, 110 * 84, ROWS * 84)


def test_an_index_that_is_wrong_never_makes_wrong_pixels():
    png = encode_png(STRIPED)
    begin = png.index(b"roWS") + 4
    right = png[begin : begin + 24]
    rng = np.random.default_rng(4)
    for _ in range(200):
        index = bytearray(right)
        for place in rng.integers(0, 24, rng.integers(1, 4)):
            index[place] = rng.integers(0, 256)
        other = with_index(png, bytes(index[: rng.integers(20, 25)]))
        assert np.array_equal(decode_rows(other), STRIPED)
        assert np.array_equal(decode_rows(other, None, wanted(70))[66:99], STRIPED[66:99])
