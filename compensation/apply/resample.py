"""Reading an image at places between its pixels, in float32, fast enough for a camera's stream.

Along each axis the value is a weighted mean of the 8 pixels around the place. The weights are the best linear
prediction (Wiener, Kriging) of an image whose pixels hang together as in one blurred by `_BLUR_px`, with a little
noise, and exact for cubics:

    minimise E |sum w_k I_k - I(t)|^2,  cov(I_k, I_l) = exp(-(k - l)^2 / (4 blur^2)) + noise,  sum w_k k^n = t^n, n <= 3

For images of lenses (a blur of 0.5 px and more) this leaves the centres of markers where they are at least as well as a
cubic B-spline does, and needs no filter before. cv2.remap is no alternative: it rounds positions to 1/32 px.

Rows are read first, columns then. Offsets and weights are linear between the points of a lattice; beyond its border the
image is mirrored about the outermost pixels' centres.
"""

from __future__ import annotations

import math
from functools import cache

import numba as nb
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8] | NDArray[np.uint16] | NDArray[np.float32]
Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]

BLOCK_px = 16
"""Apart are the points of the lattice."""
_PER_BLOCK = np.float32(1 / BLOCK_px)
TAPS = 8
_BEFORE = 3
"""Of the 8 pixels, those before the one at or left of the place."""
_BLUR_px = 0.7
_NOISE = 1e-6
_REACH = 0.5
"""How far a place may lie outside the two middle pixels, so that a block of places reads the same pixels."""
_NODES = 512
_PER_NODE = np.float32(_NODES / (1 + 2 * _REACH))
_BEYOND_px = 48
_KEPT_ROWS = 64
_NOWHERE = 1 << 40
SMALLEST_px = 16


@cache
def _weights_table() -> Float32:
    """Weights (_NODES + 1, TAPS) of places from -_REACH to 1 + _REACH after the pixel _BEFORE."""
    pixel = np.arange(TAPS) - float(_BEFORE)
    place = np.linspace(-_REACH, 1 + _REACH, _NODES + 1)

    def covariance(apart: Float64) -> Float64:
        return np.exp(-(apart**2) / (4 * _BLUR_px**2))

    powers = np.arange(4)
    exact = pixel[:, None] ** powers
    known = covariance(pixel[:, None] - pixel) + _NOISE * np.eye(TAPS)
    system = np.block([[known, exact], [exact.T, np.zeros((4, 4))]])
    wanted = np.concatenate([covariance(pixel[:, None] - place), place ** powers[:, None]])
    return np.ascontiguousarray(np.linalg.solve(system, wanted)[:TAPS].T, np.float32)


def resample(image: Image, from_x: Float32, from_y: Float32) -> Float32:
    """The image (height, width) that has at pixel (x, y) what `image` has at (x + from_x, y + from_y), float32.

    from_x, from_y (M, N): finite offsets, px, at every BLOCK_px-th pixel in both directions, the last ones beyond the
    image; bilinear in between. ValueError for images of less than 16 pixels in either direction, and for offsets that
    change by more than a pixel from one point to the next.
    """
    if image.ndim != 2 or min(image.shape) < SMALLEST_px:
        raise ValueError(
            f"an image to interpolate is (height, width) of at least {SMALLEST_px} x {SMALLEST_px} pixels, "
            f"not {image.shape}"
        )
    if max(np.abs(np.diff(offset, axis=axis)).max() for offset in (from_x, from_y) for axis in (0, 1)) > 2 * _REACH:
        raise ValueError(f"the shift changes by more than a pixel within {BLOCK_px} px: that is no drift of a camera")
    out = np.empty(image.shape, np.float32)
    _resample(image, _padded(from_x), _padded(from_y), _weights_table(), out)
    return out


def _padded(lattice: Float32) -> Float32:
    """With its last row twice: the last cell of an image may begin at its end."""
    return np.pad(lattice, ((0, 1), (0, 0)), mode="edge")


@nb.njit(cache=True, nogil=True, fastmath=True)
def _resample(image: Image, from_x: Float32, from_y: Float32, table: Float32, out: Float32) -> None:
    """Row by row; source rows that were read along x are kept until no row of the result needs them."""
    height, width = image.shape
    blocks = (width + BLOCK_px - 1) // BLOCK_px
    kept = np.empty((_KEPT_ROWS, blocks * BLOCK_px), np.float32)
    kept_row = np.full(_KEPT_ROWS, -(1 << 40), np.int64)
    padded = np.empty(blocks * BLOCK_px + 2 * _BEYOND_px, np.float32)
    line = np.empty(blocks * BLOCK_px, np.float32)
    begin, end = np.empty(TAPS, np.float32), np.empty(TAPS, np.float32)
    for y in range(height):
        before = _NOWHERE
        for block in range(blocks):
            first, last = _offset(from_y, y, block), _offset(from_y, y, block + 1)
            whole = math.floor(np.float32(0.5) * (first + last))
            top = min(max(y + whole - _BEFORE, 1 - height), 2 * height - 2 - TAPS)
            if whole != before:
                before = whole
                for row in range(top, top + TAPS):
                    slot = row % _KEPT_ROWS
                    if kept_row[slot] != row:
                        kept_row[slot] = row
                        _pad(image[_mirrored(row, height)], padded)
                        _read_row(padded, row, from_x, from_y, table, kept[slot])
                _weights(table, first - np.float32(whole), begin)
            else:
                begin, end = end, begin
            _weights(table, last - np.float32(whole), end)
            left = block * BLOCK_px
            _mean_of_rows(kept, top, left, begin, end, line[left : left + BLOCK_px])
        for x in range(width):
            out[y, x] = line[x]


@nb.njit(cache=True, nogil=True, fastmath=True)
def _read_row(padded: Float32, row: int, from_x: Float32, from_y: Float32, table: Float32, out: Float32) -> None:
    """A source row at the places that the row of the result which is read from it asks for."""
    begin, end = np.empty(TAPS, np.float32), np.empty(TAPS, np.float32)
    lowest = float(BLOCK_px * (from_x.shape[0] - 2))
    within = min(max(float(row), 0.0), lowest)
    for block in range(len(out) // BLOCK_px):
        y = min(max(row - float(_offset(from_y, within, block)), 0.0), lowest)
        first, last = _offset(from_x, y, block), _offset(from_x, y, block + 1)
        whole = math.floor(np.float32(0.5) * (first + last))
        _weights(table, first - np.float32(whole), begin)
        _weights(table, last - np.float32(whole), end)
        left = block * BLOCK_px
        at = min(max(_BEYOND_px + left + whole - _BEFORE, 0), len(padded) - BLOCK_px - TAPS)
        _mean_along(padded[at : at + BLOCK_px + TAPS], begin, end, out[left : left + BLOCK_px])


@nb.njit(cache=True, nogil=True, fastmath=True, inline="always")
def _offset(lattice: Float32, y: float, column: int) -> np.float32:
    """The lattice's value at one of its columns and the image's row y."""
    cell = int(y) // BLOCK_px
    part = (np.float32(y) - np.float32(cell * BLOCK_px)) * _PER_BLOCK
    return lattice[cell, column] + part * (lattice[cell + 1, column] - lattice[cell, column])


@nb.njit(cache=True, nogil=True, fastmath=True, inline="always")
def _mirrored(row: int, height: int) -> int:
    """The row of the image that stands for one beyond it."""
    row = abs(row)
    return row if row < height else 2 * (height - 1) - row


@nb.njit(cache=True, nogil=True, fastmath=True)
def _pad(row: Image, padded: Float32) -> None:
    """Copy a row, mirrored at its ends."""
    width = len(row)
    for x in range(width):
        padded[_BEYOND_px + x] = row[x]
    for x in range(_BEYOND_px):
        padded[_BEYOND_px - 1 - x] = padded[_BEYOND_px + min(1 + x, width - 1)]
    for x in range(_BEYOND_px + width, len(padded)):
        padded[x] = padded[max(2 * (_BEYOND_px + width - 1) - x, _BEYOND_px)]


@nb.njit(cache=True, nogil=True, fastmath=True, inline="always")
def _weights(table: Float32, place: np.float32, weights: Float32) -> None:
    """The weights (TAPS,) of one place."""
    at = (place + np.float32(_REACH)) * _PER_NODE
    node = min(max(int(at), 0), _NODES - 1)
    part = at - np.float32(node)
    before, after = table[node], table[node + 1]
    for k in range(TAPS):
        weights[k] = before[k] + part * (after[k] - before[k])


@nb.njit(cache=True, nogil=True, fastmath=True)
def _mean_along(row: Float32, begin: Float32, end: Float32, out: Float32) -> None:
    """One block along a row. Weights are named one by one: the processor then takes many pixels at once."""
    a0, a1, a2, a3 = begin[0], begin[1], begin[2], begin[3]
    a4, a5, a6, a7 = begin[4], begin[5], begin[6], begin[7]
    d0, d1, d2, d3 = end[0] - a0, end[1] - a1, end[2] - a2, end[3] - a3
    d4, d5, d6, d7 = end[4] - a4, end[5] - a5, end[6] - a6, end[7] - a7
    for x in range(BLOCK_px):
        s = np.float32(x) * _PER_BLOCK
        out[x] = (
            (a0 + s * d0) * row[x]
            + (a1 + s * d1) * row[x + 1]
            + (a2 + s * d2) * row[x + 2]
            + (a3 + s * d3) * row[x + 3]
            + (a4 + s * d4) * row[x + 4]
            + (a5 + s * d5) * row[x + 5]
            + (a6 + s * d6) * row[x + 6]
            + (a7 + s * d7) * row[x + 7]
        )


@nb.njit(cache=True, nogil=True, fastmath=True)
def _mean_of_rows(kept: Float32, top: int, left: int, begin: Float32, end: Float32, out: Float32) -> None:
    """One block of a row of the result, from the 8 kept rows that begin with `top`."""
    right = left + BLOCK_px
    r0, r1 = kept[top % _KEPT_ROWS, left:right], kept[(top + 1) % _KEPT_ROWS, left:right]
    r2, r3 = kept[(top + 2) % _KEPT_ROWS, left:right], kept[(top + 3) % _KEPT_ROWS, left:right]
    r4, r5 = kept[(top + 4) % _KEPT_ROWS, left:right], kept[(top + 5) % _KEPT_ROWS, left:right]
    r6, r7 = kept[(top + 6) % _KEPT_ROWS, left:right], kept[(top + 7) % _KEPT_ROWS, left:right]
    a0, a1, a2, a3 = begin[0], begin[1], begin[2], begin[3]
    a4, a5, a6, a7 = begin[4], begin[5], begin[6], begin[7]
    d0, d1, d2, d3 = end[0] - a0, end[1] - a1, end[2] - a2, end[3] - a3
    d4, d5, d6, d7 = end[4] - a4, end[5] - a5, end[6] - a6, end[7] - a7
    for x in range(BLOCK_px):
        s = np.float32(x) * _PER_BLOCK
        out[x] = (
            (a0 + s * d0) * r0[x]
            + (a1 + s * d1) * r1[x]
            + (a2 + s * d2) * r2[x]
            + (a3 + s * d3) * r3[x]
            + (a4 + s * d4) * r4[x]
            + (a5 + s * d5) * r5[x]
            + (a6 + s * d6) * r6[x]
            + (a7 + s * d7) * r7[x]
        )
