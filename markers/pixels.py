"""The pixels along a marker's outline: gathered once, then looked at in every step of the fit.

They lie in three regions. CORE: near enough to the outline to know about it. GROUND and DISC: further out and further
in, where only the levels are seen; they cost a tenth of the others and keep the levels from being guessed.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from markers.compiled import compiled
from markers.noise import Image

Float = NDArray[np.float64]
Columns = NDArray[np.int64]
Bytes = NDArray[np.uint8]
"""An image (height, width, 1 or 2 bytes of a pixel, the low one first)."""

CORE, GROUND, DISC = range(3)
U, V, VALUE, SHARE, RESIDUAL, RISE = range(6)
"""Rows of `Pixels.table`: column and row in the image, px; value, DN; weight, 1 unless a refit doubts the pixel; then
what the model writes: residual over its standard deviation, and how it changes per px that the outline moves."""

CLIPPED_PART = 0.25
_PARTS = np.array([GROUND, CORE, CORE, DISC, -1, DISC, CORE, CORE, GROUND])
"""The regions that a row goes through, from left to right; -1 is within all of them."""


class Pixels(NamedTuple):
    """table: (3 regions, 6 rows, capacity). counts: (3,) pixels in each region."""

    table: NDArray[np.float64]
    counts: NDArray[np.int64]


class Limits(NamedTuple):
    """Values of F round an outline: disc from `disc` to `core_in`, core to `core_out`, ground to `ground`."""

    disc: float
    core_in: float
    core_out: float
    ground: float


class Gathered(NamedTuple):
    """seen: pixels of the band in the image, -1 when there are more than there is room for; burnt: saturated ones
    among them; cut: the band leaves the image."""

    seen: int
    burnt: int
    cut: bool


def bytes_of(image: Image) -> Bytes:
    """The image for `gather`: one type for the compiler, whatever the image's depth and whether or not the caller may
    write it. A copy only of an image that is not contiguous, or of a machine whose high bytes come first."""
    low_first = np.ascontiguousarray(image, image.dtype.newbyteorder("<"))
    view = low_first.view(np.uint8).reshape(*image.shape, image.itemsize)
    view.flags.writeable = False
    return view


def empty_pixels(capacity: int) -> Pixels:
    """Room for `capacity` pixels in each region."""
    return Pixels(np.empty((3, 6, capacity)), np.zeros(3, np.int64))


@compiled
def gather(
    image: Bytes, centre: Float, shape: Float, scale: float, limits: Limits, ceiling: int, pixels: Pixels
) -> Gathered:
    """Fill `pixels` from the image, row by row, with those whose F lies in `limits`; `shape` is m11, m12, m22.

    Saturated ones get the share 0 (glare), unless they are a quarter of the ground or of the disc: then the picture
    is overexposed, and clipping shifts the outline but not the centre.
    """
    height, width, _ = image.shape
    count = pixels.counts
    count[:] = 0
    seen, cut = 0, False
    burnt, side = np.zeros(2, np.int64), np.zeros(2, np.int64)
    reach = limits.ground * scale * math.sqrt(shape[0] / (shape[0] * shape[2] - shape[1] * shape[1]))
    ends = np.empty(len(_PARTS) + 1, np.int64)
    for row in range(math.ceil(centre[1] - reach), math.floor(centre[1] + reach) + 1):
        _set_ends(ends, centre[0], shape, scale, (row - centre[1]) / scale, limits)
        if ends[0] < ends[-1] and (row < 0 or row >= height or ends[0] < 0 or ends[-1] > width):
            cut = True
        if row < 0 or row >= height:
            continue
        for part in range(len(_PARTS)):
            begin, end, region = max(ends[part], 0), min(ends[part + 1], width), _PARTS[part]
            if begin >= end or region < 0:
                continue
            if count[region] + end - begin > pixels.table.shape[2]:
                return Gathered(-1, -1, cut)
            outside = 1 if part < 2 or part > 6 else 0
            seen += end - begin
            side[outside] += end - begin
            burnt[outside] += _copy_run(image, row, begin, end, ceiling, pixels.table[region], int(count[region]))
            count[region] += end - begin
    if burnt[0] + burnt[1] > 0:
        clipped = burnt[0] > CLIPPED_PART * side[0], burnt[1] > CLIPPED_PART * side[1]
        _set_burnt_aside(pixels, centre, shape, scale, ceiling, clipped)
    return Gathered(seen, burnt[0] + burnt[1], cut)


@compiled
def _set_ends(ends: Columns, cx: float, shape: Float, scale: float, y: float, limits: Limits) -> None:
    """Where the parts of a row at height y begin, and the last one ends: into the ellipses, one inside the other, and
    out of them again. A part is empty where the row misses its ellipse."""
    begin, end = -(1 << 40), 1 << 40
    for i, F in enumerate((limits.ground, limits.core_out, 1.0, limits.core_in, limits.disc)):
        first, last = _columns(cx, shape, scale, y, F)
        if first > last:
            first, last = end, end
        begin, end = min(max(first, begin), end), max(min(last + 1, end), begin)
        ends[i], ends[len(_PARTS) - i] = begin, end


@compiled
def _copy_run(image: Bytes, row: int, begin: int, end: int, ceiling: int, table: Float, slot: int) -> int:
    """Write the pixels of a row into the table from `slot` on; how many of them are saturated."""
    burnt, two_bytes, at = 0, image.shape[2] == 2, np.uint64(slot)
    for column in range(np.uint64(begin), np.uint64(end)):  # unsigned: an index that may be negative is looked at twice
        value = np.int64(image[row, column, 0])
        if two_bytes:
            value |= np.int64(image[row, column, 1]) << 8
        table[U, at] = column
        table[V, at] = row
        table[VALUE, at] = value
        table[SHARE, at] = 1.0
        at += np.uint64(1)
        burnt += value >= ceiling
    return int(burnt)


@compiled
def _columns(cx: float, shape: Float, scale: float, y: float, F: float) -> tuple[int, int]:
    """First and last column of the ellipse F at height y; none, from far right to far left, above and below it."""
    root = (shape[1] * y) ** 2 - shape[0] * (shape[2] * y * y - F * F)
    if root <= 0 or F <= 0:
        return 1 << 40, -(1 << 40)
    half = math.sqrt(root)
    left, right = (-shape[1] * y - half) / shape[0], (-shape[1] * y + half) / shape[0]
    return math.ceil(cx + scale * left), math.floor(cx + scale * right)


@compiled
def _set_burnt_aside(
    pixels: Pixels, centre: Float, shape: Float, scale: float, ceiling: int, clipped: tuple[bool, bool]
) -> None:
    """Give saturated pixels the share 0, but for those on a side of the outline that is `clipped`."""
    for region in range(3):
        table = pixels.table[region]
        for slot in range(pixels.counts[region]):
            x, y = (table[U, slot] - centre[0]) / scale, (table[V, slot] - centre[1]) / scale
            outside = 1 if shape[0] * x * x + 2 * shape[1] * x * y + shape[2] * y * y > 1 else 0
            if table[VALUE, slot] >= ceiling and not clipped[outside]:
                table[SHARE, slot] = 0.0
