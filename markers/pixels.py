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
Bytes = NDArray[np.uint8]
"""An image (height, width, 1 or 2 bytes of a pixel, the low one first)."""

CORE, GROUND, DISC = range(3)
U, V, VALUE, SHARE, RESIDUAL, RISE = range(6)
"""Rows of `Pixels.table`: column and row in the image, px; value, DN; weight, 1 unless a refit doubts the pixel; then
what the model writes: residual over its standard deviation, and how it changes per px that the outline moves."""

CLIPPED_PART = 0.25


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
    levels = (limits.core_out**2, 1.0, limits.core_in**2)
    reach = limits.ground * scale * math.sqrt(shape[0] / (shape[0] * shape[2] - shape[1] * shape[1]))
    for row in range(math.ceil(centre[1] - reach), math.floor(centre[1] + reach) + 1):
        y = (row - centre[1]) / scale
        first, last = _columns(centre[0], shape, scale, y, limits.ground)
        hole_first, hole_last = _columns(centre[0], shape, scale, y, limits.disc)
        if hole_first > hole_last:
            hole_first, hole_last = last + 1, last
        if first <= last and (row < 0 or row >= height or first < 0 or last >= width):
            cut = True
        if row < 0 or row >= height:
            continue
        for begin, end in ((first, min(last, hole_first - 1)), (max(first, hole_last + 1), last)):
            begin, end = max(begin, 0), min(end, width - 1) + 1
            while begin < end:
                depth = _depth(begin, centre[0], shape, scale, y, levels)
                behind = begin + 1
                while behind < end and _depth(behind, centre[0], shape, scale, y, levels) == depth:
                    behind += 1
                region = GROUND if depth == 0 else DISC if depth == 3 else CORE
                if count[region] + behind - begin > pixels.table.shape[2]:
                    return Gathered(-1, -1, cut)
                outside = 1 if depth < 2 else 0
                seen += behind - begin
                side[outside] += behind - begin
                burnt[outside] += _copy_run(image, row, begin, behind, ceiling, pixels.table[region], count[region])
                count[region] += behind - begin
                begin = behind
    if burnt[0] + burnt[1] > 0:
        clipped = burnt[0] > CLIPPED_PART * side[0], burnt[1] > CLIPPED_PART * side[1]
        _set_burnt_aside(pixels, centre, shape, scale, ceiling, clipped)
    return Gathered(seen, burnt[0] + burnt[1], cut)


@compiled
def _depth(column: int, cx: float, shape: Float, scale: float, y: float, levels: tuple[float, float, float]) -> int:
    """How many of the levels, F squared, a pixel is inside of."""
    x = (column - cx) / scale
    q = shape[0] * x * x + 2 * shape[1] * x * y + shape[2] * y * y
    return (q <= levels[0]) + (q <= levels[1]) + (q <= levels[2])


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
