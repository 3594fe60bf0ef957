"""Recorded PNG frames decoded for the fit: twice as fast as OpenCV, which takes more time for a frame than finding its
markers does.

The pixels are inflated at once by libdeflate and the rows' filters undone in machine code (PNG specification, 9.2).
What is read, and what is refused, is what recording/format/images.py reads and refuses.
"""

from __future__ import annotations

from typing import cast

import deflate
import numpy as np
from numpy.typing import NDArray

from foundation.errors import SessionError
from markers.compiled import entry
from recording.format.images import ImageArray, pixel_data

_NONE, _LEFT, _ABOVE, _AVERAGE, _PAETH = range(5)


def decode_rows(png: bytes) -> ImageArray:
    """The grey image (height, width), uint8 or uint16; SessionError when it is not a whole, undamaged one."""
    header, compressed = pixel_data(png)
    sample_bytes = header.bit_depth // 8
    try:
        inflated = deflate.zlib_decompress(compressed, header.inflated_bytes)
    except deflate.DeflateError as error:
        raise SessionError(f"a recorded image cannot be decoded ({error})") from error
    row_bytes = 1 + header.width_px * sample_bytes
    if len(inflated) != header.height_px * row_bytes:
        raise SessionError("a recorded image cannot be decoded: its compressed pixels are damaged or too few")
    filtered = np.frombuffer(inflated, np.uint8).reshape(header.height_px, row_bytes)
    pixels = np.empty((header.height_px, header.width_px * sample_bytes), np.uint8)
    if not _undo_filters(filtered, sample_bytes, pixels):
        raise SessionError("a recorded image cannot be decoded: a row has an unknown filter")
    if sample_bytes == 1:
        return pixels
    return cast(NDArray[np.uint16], pixels.view(">u2").astype(np.uint16))


@entry
def _undo_filters(filtered: NDArray[np.uint8], sample_bytes: int, pixels: NDArray[np.uint8]) -> bool:
    """filtered (height, 1 + width): a filter byte, then the row. False when a filter is none of the five."""
    height, width = pixels.shape
    above = np.zeros(width, np.uint8)
    for y in range(height):
        kind, source, out = filtered[y, 0], filtered[y, 1:], pixels[y]
        if kind == _NONE:
            out[:] = source
        elif kind == _LEFT:
            out[:sample_bytes] = source[:sample_bytes]
            for x in range(sample_bytes, width):
                out[x] = (np.int32(source[x]) + out[x - sample_bytes]) & 255
        elif kind == _ABOVE:
            for x in range(width):
                out[x] = (np.int32(source[x]) + above[x]) & 255
        elif kind == _AVERAGE and sample_bytes == 1:
            left = np.int32(0)  # in a register: the chain from pixel to pixel decides the time
            for x in range(width):
                left = (np.int32(source[x]) + ((left + above[x]) >> 1)) & 255
                out[x] = left
        elif kind == _AVERAGE:
            for x in range(width):
                left = np.int32(out[x - sample_bytes]) if x >= sample_bytes else np.int32(0)
                out[x] = (np.int32(source[x]) + ((left + above[x]) >> 1)) & 255
        elif kind == _PAETH:
            for x in range(width):
                left = np.int32(out[x - sample_bytes]) if x >= sample_bytes else np.int32(0)
                corner = np.int32(above[x - sample_bytes]) if x >= sample_bytes else np.int32(0)
                over = np.int32(above[x])
                to_left, to_over, to_corner = abs(over - corner), abs(left - corner), abs(left + over - 2 * corner)
                nearest = over if to_over <= to_corner else corner
                if to_left <= to_over and to_left <= to_corner:
                    nearest = left
                out[x] = (np.int32(source[x]) + nearest) & 255
        else:
            return False
        above = out
    return True
