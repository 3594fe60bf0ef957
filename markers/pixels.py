"""The pixels along a marker's outline: gathered once, then looked at in every step of the fit.

They lie in three regions. CORE: near enough to the outline to know about it. GROUND and DISC: further out and further
in, where only the levels are seen; they cost a tenth of the others and keep the levels from being guessed.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from thermostand.markers.jit import compile_part
from thermostand.markers.noise import Image, find_full_scale_DN

Float = NDArray[np.float64]
Columns = NDArray[np.int64]
Single = NDArray[np.float32]
Bytes = NDArray[np.uint8]
Mask = NDArray[np.bool_]

CORE, GROUND, DISC = range(3)
U, V, VALUE, SHARE, RESIDUAL, RISE = range(6)
"""Rows of `Pixels.table`: column and row in the image, px from the origin; value, DN; weight, 1 unless a refit lowers
it; then what the model writes: residual over its standard deviation, and how it changes per px that the outline
moves."""

# Round number; nothing was measured.
CLIPPED_PART = 0.25
_ROWS = 6
_PARTS = np.array([GROUND, CORE, DISC, -1, DISC, CORE, GROUND])
"""The regions that a row goes through, from left to right; -1 is within all of them."""
_AT_ONCE = 8
"""Pixels of a row are copied so many at a time, some beyond the end of a run, which the next run is written over."""


class Pixels(NamedTuple):
    """table: (3 regions, 6 rows, capacity). counts: (3,) pixels in each region. origin: (2,) column and row that places
    are relative to, near the marker's centre: single numbers hold no fractions of thousands."""

    table: Single
    counts: NDArray[np.int64]
    origin: NDArray[np.int64]


class Limits(NamedTuple):
    """Values of F round an outline: disc from `disc` to `core_in`, core to `core_out`, ground to `ground`."""

    disc: float
    core_in: float
    core_out: float
    ground: float


class Gathered(NamedTuple):
    """seen: pixels of the band in the image, -1 when there are more than fit; burnt: saturated ones
    among them; cut: the band leaves the image."""

    seen: int
    burnt: int
    cut: bool


class Run(NamedTuple):
    """Pixels of a row that follow each other. first: byte of the image where they begin, of `size` each. x, y: place of
    the first one, from the origin."""

    first: int
    size: int
    length: int
    x: int
    y: int


class Picture(NamedTuple):
    """A grey image as the fit sees it. samples: (height, width, 1 or 2 bytes of a pixel, the low one first).
    full_scale_DN: the largest value a pixel can have. rows: (height,), those that are there. missed: (1,), set when
    another one was looked for, so that the results do not count."""

    samples: Bytes
    full_scale_DN: int
    rows: Mask
    missed: Mask

    @property
    def shape(self) -> tuple[int, int]:
        """Height and width."""
        return self.samples.shape[0], self.samples.shape[1]

    def values_DN(self, row: Columns, column: Columns) -> Columns:
        """The pixels there."""
        self.missed[0] |= not self.rows[row].all()
        height, width, size = self.samples.shape
        pixels = self.samples.reshape(height * width * size).view(f"<u{size}")
        return pixels[row * width + column].astype(np.int64)


def make_picture(image: Image, rows: Mask | None = None) -> Picture:
    """The image for `gather`: one type for the compiler, whatever the image's depth and whether or not the caller may
    write it. A copy only of an image that is not contiguous, or of a machine whose high bytes come first. rows:
    (height,), those of the image that are there, which must be of 8 bit then: other depths are seen by all pixels."""
    low_first = np.ascontiguousarray(image, image.dtype.newbyteorder("<"))
    view = low_first.view(np.uint8).reshape(*image.shape, image.itemsize)
    view.flags.writeable = False
    has_row = np.ones(len(image), np.bool_) if rows is None else rows
    return Picture(view, find_full_scale_DN(image), has_row, np.zeros(1, np.bool_))


def allocate_pixels(capacity: int) -> Pixels:
    """Allocate the arrays for `capacity` pixels in each region."""
    return Pixels(np.empty((3, _ROWS, capacity + _AT_ONCE), np.float32), np.zeros(3, np.int64), np.zeros(2, np.int64))


@compile_part
def gather(image: Picture, ellipse: Float, scale: float, limits: Limits, ceiling: int, pixels: Pixels) -> Gathered:
    """Fill `pixels` from the image, row by row, with those whose F lies in `limits`; `ellipse` (5,) is cx, cy, m11,
    m12, m22.

    Saturated ones get the share 0 (glare), unless they are a quarter of the ground or of the disc: then the picture
    is overexposed, and clipping shifts the outline but not the centre.
    """
    samples, rows, missed, centre, shape = image.samples, image.rows, image.missed, ellipse[:2], ellipse[2:5]
    height, width, size = samples.shape
    most, table = pixels.table.shape[2], pixels.table.reshape(pixels.table.size)
    count = pixels.counts
    count[:] = 0
    seen, cut, flat = 0, False, samples.reshape(samples.size)
    pixels.origin[0], pixels.origin[1] = round(centre[0]), round(centre[1])
    reach = limits.ground * scale * math.sqrt(shape[0] / (shape[0] * shape[2] - shape[1] * shape[1]))
    ends = np.empty(len(_PARTS) + 1, np.int64)
    for row in range(math.ceil(centre[1] - reach), math.floor(centre[1] + reach) + 1):
        _set_ends(ends, centre[0], shape, scale, (row - centre[1]) / scale, limits)
        if ends[0] < ends[-1] and (row < 0 or row >= height or ends[0] < 0 or ends[-1] > width):
            cut = True
        if row < 0 or row >= height:
            continue
        if not rows[row]:
            missed[0] = True
            continue
        for part in range(len(_PARTS)):
            begin, end, region = max(ends[part], 0), min(ends[part + 1], width), _PARTS[part]
            if begin >= end or region < 0:
                continue
            if count[region] + end - begin + _AT_ONCE > pixels.table.shape[2]:
                return Gathered(-1, -1, cut)
            seen += end - begin
            first, slot = (row * width + begin) * size, region * _ROWS * most + count[region]
            x, y = begin - pixels.origin[0], row - pixels.origin[1]
            _copy_run(flat, Run(first, size, end - begin, x, y), table, slot, most)
            count[region] += end - begin
    burnt = 0
    for region in range(3):
        burnt += _share_all(pixels.table[region], int(count[region]), np.float32(ceiling))
    if burnt > 0:
        _mask_saturated(pixels, centre, shape, scale, ceiling)
    return Gathered(seen, burnt, cut)


@compile_part
def _set_ends(ends: Columns, cx: float, shape: Float, scale: float, y: float, limits: Limits) -> None:
    """Set where the parts of a row at height y begin, and the last one ends: into the ellipses, one inside the other,
    and out of them again. A part is empty where the row misses its ellipse."""
    begin, end = -(1 << 40), 1 << 40
    for i, F in enumerate((limits.ground, limits.core_out, limits.core_in, limits.disc)):
        first, last = _find_columns(cx, shape, scale, y, F)
        if first > last:
            first, last = end, end
        begin, end = min(max(first, begin), end), max(min(last + 1, end), begin)
        ends[i], ends[len(_PARTS) - i] = begin, end


@compile_part
def _copy_run(flat: Bytes, run: Run, table: Single, slot: int, most: int) -> None:
    """Write the pixels of a run of the image's bytes into the table from `slot` on, and up to 7 more behind them.

    Both are one long row: slices of tables would be counted as in use, and released, for every run.
    """
    first, size = run.first, run.size
    whole = (run.length + _AT_ONCE - 1) // _AT_ONCE * _AT_ONCE
    count = np.uint64(min(whole, (len(flat) - first) // size))  # unsigned: not looked at for being negative
    u, v, values = np.uint64(slot + U * most), np.uint64(slot + V * most), np.uint64(slot + VALUE * most)
    byte, column, row = np.uint64(first), np.float32(run.x), np.float32(run.y)
    for k in range(count):
        table[u + k] = column + np.float32(np.int32(k))
    for k in range(count):
        table[v + k] = row
    if size == 1:
        for k in range(count):
            table[values + k] = np.float32(np.int32(flat[byte + k]))
    else:
        for k in range(count):
            low, high = np.int32(flat[byte + k + k]), np.int32(flat[byte + k + k + np.uint64(1)])
            table[values + k] = np.float32(low | high << np.int32(8))


@compile_part
def _share_all(table: Single, count: int, ceiling: np.float32) -> int:
    """Give all pixels of a region the share 1; how many of them are saturated."""
    burnt = 0
    for slot in range(np.uint64(count)):
        table[SHARE, slot] = np.float32(1)
        burnt += table[VALUE, slot] >= ceiling
    return burnt


@compile_part
def _find_columns(cx: float, shape: Float, scale: float, y: float, F: float) -> tuple[int, int]:
    """First and last column of the ellipse F at height y; none, from far right to far left, above and below it."""
    root = (shape[1] * y) ** 2 - shape[0] * (shape[2] * y * y - F * F)
    if root <= 0 or F <= 0:
        return 1 << 40, -(1 << 40)
    half = math.sqrt(root)
    left, right = (-shape[1] * y - half) / shape[0], (-shape[1] * y + half) / shape[0]
    return math.ceil(cx + scale * left), math.floor(cx + scale * right)


@compile_part
def _mask_saturated(pixels: Pixels, centre: Float, shape: Float, scale: float, ceiling: int) -> None:
    """Give saturated pixels the share 0, but for those on a side of the outline a quarter of which is saturated."""
    burnt, side = np.zeros(2, np.int64), np.zeros(2, np.int64)
    cx, cy = centre[0] - pixels.origin[0], centre[1] - pixels.origin[1]
    for is_counting in (True, False):
        for region in range(3):
            table = pixels.table[region]
            for slot in range(pixels.counts[region]):
                x, y = (table[U, slot] - cx) / scale, (table[V, slot] - cy) / scale
                outside = 1 if shape[0] * x * x + 2 * shape[1] * x * y + shape[2] * y * y > 1 else 0
                is_burnt = table[VALUE, slot] >= ceiling
                if is_counting:
                    side[outside] += 1
                    burnt[outside] += is_burnt
                elif is_burnt and burnt[outside] <= CLIPPED_PART * side[outside]:
                    table[SHARE, slot] = 0.0
