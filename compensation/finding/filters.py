"""The filters of a PNG's rows undone (PNG specification, 9.2)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from thermostand.markers.compiled import compiled

Bytes = NDArray[np.uint8]

_NONE, LEFT, _ABOVE, _AVERAGE, _PAETH = range(5)
_TOGETHER = 4


@compiled
def undo_filters(filtered: Bytes, sample_bytes: int, above: Bytes, pixels: Bytes) -> bool:
    """filtered (height, 1 + width): a filter byte, then the row; above (width,): the pixels over the first one, which
    go into `pixels` (height, width). False when a filter is none of the five."""
    height = len(pixels)
    y = 0
    while y < height:
        if sample_bytes == 1 and y + _TOGETHER <= height and _all_average(filtered, y):
            _undo_four_averages(filtered[y : y + _TOGETHER, 1:], above, pixels[y : y + _TOGETHER])
            y += _TOGETHER
        elif _undo_one(filtered[y, 0], filtered[y, 1:], sample_bytes, above, pixels[y]):
            y += 1
        else:
            return False
        above = pixels[y - 1]
    return True


@compiled
def _all_average(filtered: Bytes, y: int) -> bool:
    return (
        filtered[y, 0] == _AVERAGE
        and filtered[y + 1, 0] == _AVERAGE
        and filtered[y + 2, 0] == _AVERAGE
        and filtered[y + 3, 0] == _AVERAGE
    )


@compiled
def _undo_four_averages(source: Bytes, above: Bytes, out: Bytes) -> None:
    """Four rows, each a pixel behind the one over it: the chain from pixel to pixel decides the time of a row, and four
    of them go on at once."""
    width = len(above)
    a = b = c = d = np.int32(0)  # the pixels just done, of the first to the fourth row
    for x in range(width + _TOGETHER - 1):
        if 3 <= x < width:
            d = (np.int32(source[3, x - 3]) + ((d + c) >> 1)) & 255
            c = (np.int32(source[2, x - 2]) + ((c + b) >> 1)) & 255
            b = (np.int32(source[1, x - 1]) + ((b + a) >> 1)) & 255
            a = (np.int32(source[0, x]) + ((a + above[x]) >> 1)) & 255
            out[3, x - 3] = d
            out[2, x - 2] = c
            out[1, x - 1] = b
            out[0, x] = a
        else:
            if 0 <= x - 3 < width:
                d = (np.int32(source[3, x - 3]) + ((d + c) >> 1)) & 255
                out[3, x - 3] = d
            if 0 <= x - 2 < width:
                c = (np.int32(source[2, x - 2]) + ((c + b) >> 1)) & 255
                out[2, x - 2] = c
            if 0 <= x - 1 < width:
                b = (np.int32(source[1, x - 1]) + ((b + a) >> 1)) & 255
                out[1, x - 1] = b
            if x < width:
                a = (np.int32(source[0, x]) + ((a + above[x]) >> 1)) & 255
                out[0, x] = a


@compiled
def _undo_one(kind: int, source: Bytes, sample_bytes: int, above: Bytes, out: Bytes) -> bool:
    """One row, False when its filter is unknown."""
    width = len(out)
    if kind == _NONE:
        for x in range(width):
            out[x] = source[x]
    elif kind == LEFT:
        for x in range(min(sample_bytes, width)):
            out[x] = source[x]
        for x in range(sample_bytes, width):
            out[x] = (np.int32(source[x]) + out[x - sample_bytes]) & 255
    elif kind == _ABOVE:
        for x in range(width):
            out[x] = (np.int32(source[x]) + above[x]) & 255
    elif kind == _AVERAGE and sample_bytes == 1:
        left = np.int32(0)  # in a register
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
    return True
