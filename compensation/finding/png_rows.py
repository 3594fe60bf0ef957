"""Recorded PNG frames decoded for the fit: four times as fast as OpenCV, which takes more time for a frame than finding
its markers does.

A few rows at a time are inflated and their filters undone (PNG specification, 9.2), while they are in the processor's
nearest cache: of two strips side by side where the PNG has strips (recording/format/strips.py), and of those alone that
are wanted. Streams that are not of literals alone are inflated at once, by libdeflate. What is read, and what is
refused, is what recording/format/images.py reads and refuses, but for the checksum of all of a stream in strips: each
strip has a CRC.
"""

from __future__ import annotations

import deflate
import numpy as np
from numpy.typing import NDArray

from thermostand.compensation.finding import filters, literals
from thermostand.compensation.finding.filters import LEFT, undo_filters
from thermostand.compensation.finding.literals import (
    MOST_AT_ONCE,
    UNFIT,
    Bytes,
    Stream,
    Words,
    ended,
    flushed,
    inflate,
    inflate_two,
    next_byte,
    opened,
)
from thermostand.foundation.errors import SessionError
from thermostand.markers.compiled import compiled, digest, entry
from thermostand.recording.format.images import Header, ImageArray, StripPlaces, check_strip, pixel_data, strip_places

Mask = NDArray[np.bool_]
Places = NDArray[np.int64]

_ROWS = 4
_ADLER_BASE = 65521
_ADLER_BLOCK = 2048
"""So many bytes can be summed up, weighted by their places, in 32 bits."""
_TRAILER_BYTES = 4


def decode_rows(png: bytes, room: Bytes | None = None, wanted: Mask | None = None) -> ImageArray:
    """The grey image (height, width), uint8 or uint16; SessionError when it is not a whole, undamaged one.

    room: (height, bytes of a row) of a frame that is done with, for an image of its size: fresh memory for 5 MB costs a
    tenth of the time. wanted: (height,), the rows that must be right; of a PNG in strips the others may stay as they
    were in `room`, and are then not looked at for damage.
    """
    places = strip_places(png)
    if places is not None:
        pixels = _room(places.header, room)
        if decoded_strips(png, places, wanted, pixels):
            return _samples(pixels, places.header)
    header, compressed = pixel_data(png)
    sample_bytes = header.bit_depth // 8
    pixels = _room(header, room)
    if not decoded_at_once(compressed, sample_bytes, pixels):
        _decode_in_two(header, compressed, pixels)
    return _samples(pixels, header)


def _room(header: Header, room: Bytes | None) -> Bytes:
    shape = (header.height_px, header.width_px * header.bit_depth // 8)
    return room if room is not None and room.shape == shape else np.empty(shape, np.uint8)


def _samples(pixels: Bytes, header: Header) -> ImageArray:
    if header.bit_depth == 8:
        return pixels
    return pixels.view(">u2").astype(np.uint16)


def decoded_strips(png: bytes, places: StripPlaces, wanted: Mask | None, pixels: Bytes) -> bool:
    """Whether the strips with wanted rows, or all, are of literals and where they should be; their pixels are then
    written. SessionError when a checksum is wrong."""
    which = np.arange(len(places.begins))
    if wanted is not None and len(wanted) == len(pixels):
        which = np.flatnonzero(np.logical_or.reduceat(wanted, which * places.rows))
    begins, ends = places.begins[which], places.ends[which]
    for begin, end in zip(begins.tolist(), ends.tolist(), strict=True):
        if not check_strip(png, begin, end):
            return False
    words = np.frombuffer(png, np.uint64, len(png) // 8)
    return _decode_strips(words, 8 * begins, 8 * ends, which, places.rows, places.header.bit_depth // 8, pixels)


def decoded_at_once(compressed: bytes, sample_bytes: int, pixels: Bytes) -> bool:
    """Whether the stream is a whole one of literals; the pixels are then written."""
    size = len(compressed)
    if size < 2 + _TRAILER_BYTES or not _is_plain(compressed[0], compressed[1]):
        return False
    words = np.zeros(size // 8 + 3, np.uint64)
    words.view(np.uint8)[:size] = np.frombuffer(compressed, np.uint8)
    end, adler = _decode(words, 8 * (size - _TRAILER_BYTES), sample_bytes, pixels)
    return end == size - _TRAILER_BYTES and adler == int.from_bytes(compressed[end : end + _TRAILER_BYTES], "big")


def _is_plain(method: int, flags: int) -> bool:
    """Whether these are the two bytes before a deflate stream without a dictionary (RFC 1950, 2.2)."""
    return method & 0x0F == 8 and method >> 4 <= 7 and not flags & 0x20 and (method << 8 | flags) % 31 == 0


def _decode_in_two(header: Header, compressed: bytes, pixels: Bytes) -> None:
    try:
        inflated = deflate.zlib_decompress(compressed, header.inflated_bytes)
    except deflate.DeflateError as error:
        raise SessionError(f"a recorded image cannot be decoded ({error})") from error
    row_bytes = 1 + pixels.shape[1]
    if len(inflated) != header.height_px * row_bytes:
        raise SessionError("a recorded image cannot be decoded: its compressed pixels are damaged or too few")
    filtered = np.frombuffer(inflated, np.uint8).reshape(header.height_px, row_bytes)
    if not _undo(filtered, header.bit_depth // 8, pixels):
        raise SessionError("a recorded image cannot be decoded: a row has an unknown filter")


def _compiled(sources: str):
    @entry
    def decode(words: Words, end_bit: int, sample_bytes: int, pixels: Bytes) -> tuple[int, int]:
        """Inflate a zlib stream and undo the filters; where its checksum is, UNFIT for a stream or a filter that is
        not read here, and the checksum of what was inflated."""
        _ = sources
        stream, sums = opened(words, 16, end_bit), np.array([1, 0])
        if not _decode_part(stream, sample_bytes, pixels, False, sums) or not ended(stream):
            return UNFIT, 0
        return next_byte(stream), sums[1] << 16 | sums[0]

    @entry
    def decode_strips(
        words: Words, begins: Places, ends: Places, which: Places, rows: int, sample_bytes: int, pixels: Bytes
    ) -> bool:
        """Inflate the strips numbered `which`, which lie between these bits, and undo their filters; False for one that
        is not read here."""
        _ = sources
        height, number = len(pixels), len(which)
        done = 0
        while done < number:
            first = which[done] * rows
            stream, strip = opened(words, begins[done], ends[done]), pixels[first : first + rows]
            two = done + 1 < number and (which[done + 1] + 1) * rows <= height
            if two:
                beside = which[done + 1] * rows
                other, strip_beside = opened(words, begins[done + 1], ends[done + 1]), pixels[beside : beside + rows]
                if not _decode_two(stream, other, sample_bytes, strip, strip_beside) or not flushed(other):
                    return False
            elif not _decode_part(stream, sample_bytes, strip, True, np.array([1, 0])):
                return False
            if not flushed(stream):
                return False
            done += 1 + two
        return True

    @entry
    def undo(filtered: Bytes, sample_bytes: int, pixels: Bytes) -> bool:
        """filtered (height, 1 + width): a filter byte, then the row. False when a filter is none of the five."""
        _ = sources
        return undo_filters(filtered, sample_bytes, np.zeros(pixels.shape[1], np.uint8), pixels)

    return decode, decode_strips, undo


@compiled
def _decode_part(stream: Stream, sample_bytes: int, pixels: Bytes, is_strip: bool, sums: Places) -> bool:
    """Write the rows that a stream begins with; False when it cannot be read here. is_strip: the first row must need
    none above. sums (2,): those of Adler-32, continued unless it is a strip."""
    height, width = pixels.shape
    strip = np.empty(_ROWS * (1 + width) + MOST_AT_ONCE, np.uint8)
    above = np.zeros(width, np.uint8)
    row, beyond = 0, 0
    while row < height:
        rows = 1 if is_strip and row == 0 else min(_ROWS, height - row)
        size = rows * (1 + width)
        done = inflate(stream, strip, beyond, size)
        if done < size or (is_strip and row == 0 and strip[0] > LEFT):
            return False
        if not is_strip:
            sums[0], sums[1] = _adler(strip, size, sums[0], sums[1])
        if not undo_filters(strip[:size].reshape(rows, 1 + width), sample_bytes, above, pixels[row : row + rows]):
            return False
        row += rows
        above = pixels[row - 1]
        beyond = done - size
        for k in range(beyond):
            strip[k] = strip[size + k]
    return beyond == 0


@compiled
def _decode_two(one: Stream, other: Stream, sample_bytes: int, pixels: Bytes, beside: Bytes) -> bool:
    """The same for two strips of as many rows."""
    height, width = pixels.shape
    strips, begins = np.empty((2, _ROWS * (1 + width) + MOST_AT_ONCE), np.uint8), np.zeros(2, np.int64)
    above = above_beside = np.zeros(width, np.uint8)
    row = 0
    while row < height:
        rows = 1 if row == 0 else min(_ROWS, height - row)
        size = rows * (1 + width)
        if not inflate_two(one, other, strips, begins, size):
            return False
        if row == 0 and max(strips[0, 0], strips[1, 0]) > LEFT:
            return False
        first, second = strips[0, :size].reshape(rows, 1 + width), strips[1, :size].reshape(rows, 1 + width)
        if not undo_filters(first, sample_bytes, above, pixels[row : row + rows]):
            return False
        if not undo_filters(second, sample_bytes, above_beside, beside[row : row + rows]):
            return False
        row += rows
        above, above_beside = pixels[row - 1], beside[row - 1]
        for lane in range(2):
            begins[lane] -= size
            for k in range(begins[lane]):
                strips[lane, k] = strips[lane, size + k]
    return max(begins[0], begins[1]) == 0


@compiled
def _adler(data: Bytes, size: int, low: int, high: int) -> tuple[int, int]:
    """The two sums of Adler-32 (RFC 1950, 9) after `size` bytes more."""
    for begin in range(0, size, _ADLER_BLOCK):
        number = min(_ADLER_BLOCK, size - begin)
        plain, weighted = np.int32(0), np.int32(0)
        block = data[begin : begin + number]
        for k in range(number):
            value = np.int32(block[k])
            plain = np.int32(plain + value)
            weighted = np.int32(weighted + np.int32(value * np.int32(number - k)))
        high = (high + number * low + int(weighted)) % _ADLER_BASE
        low = (low + int(plain)) % _ADLER_BASE
    return low, high


_decode, _decode_strips, _undo = _compiled(digest(filters, literals))
