"""Recorded PNG frames decoded for the fit: four times as fast as OpenCV, which takes more time for a frame than finding
its markers does.

A few rows at a time are inflated and their filters undone (PNG specification, 9.2), while they are in the processor's
nearest cache. Streams that are not of literals alone are inflated at once, by libdeflate. What is read, and what is
refused, is what recording/format/images.py reads and refuses.
"""

from __future__ import annotations

from typing import cast

import deflate
import numpy as np
from numpy.typing import NDArray

from compensation.finding import filters, literals
from compensation.finding.filters import undo_filters
from compensation.finding.literals import MOST_AT_ONCE, UNFIT, Bytes, Words, ended, inflate, next_byte, opened
from foundation.errors import SessionError
from markers.compiled import compiled, digest, entry
from recording.format.images import Header, ImageArray, pixel_data

_ROWS = 4
_ADLER_BASE = 65521
_ADLER_BLOCK = 2048
"""So many bytes can be summed up, weighted by their places, in 32 bits."""
_TRAILER_BYTES = 4


def decode_rows(png: bytes, room: Bytes | None = None) -> ImageArray:
    """The grey image (height, width), uint8 or uint16; SessionError when it is not a whole, undamaged one.

    room: (height, bytes of a row) of a frame that is done with, for an image of its size: fresh memory for 5 MB costs a
    tenth of the time.
    """
    header, compressed = pixel_data(png)
    sample_bytes = header.bit_depth // 8
    shape = (header.height_px, header.width_px * sample_bytes)
    pixels = room if room is not None and room.shape == shape else np.empty(shape, np.uint8)
    if not decoded_at_once(compressed, sample_bytes, pixels):
        _decode_in_two(header, compressed, pixels)
    if sample_bytes == 1:
        return pixels
    return cast(NDArray[np.uint16], pixels.view(">u2").astype(np.uint16))


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
        height, width = pixels.shape
        stream = opened(words, 16, end_bit)
        strip = np.empty(_ROWS * (1 + width) + MOST_AT_ONCE, np.uint8)
        above = np.zeros(width, np.uint8)
        low, high = 1, 0
        beyond = 0
        for row in range(0, height, _ROWS):
            rows = min(_ROWS, height - row)
            size = rows * (1 + width)
            done = inflate(stream, strip, beyond, size)
            if done < size:
                return UNFIT, 0
            low, high = _adler(strip, size, low, high)
            if not undo_filters(strip[:size].reshape(rows, 1 + width), sample_bytes, above, pixels[row : row + rows]):
                return UNFIT, 0
            above = pixels[row + rows - 1]
            beyond = done - size
            for k in range(beyond):
                strip[k] = strip[size + k]
        if beyond > 0 or not ended(stream):
            return UNFIT, 0
        return next_byte(stream), high << 16 | low

    @entry
    def undo(filtered: Bytes, sample_bytes: int, pixels: Bytes) -> bool:
        """filtered (height, 1 + width): a filter byte, then the row. False when a filter is none of the five."""
        _ = sources
        return undo_filters(filtered, sample_bytes, np.zeros(pixels.shape[1], np.uint8), pixels)

    return decode, undo


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


_decode, _undo = _compiled(digest(filters, literals))
