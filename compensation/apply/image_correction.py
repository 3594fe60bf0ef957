"""Images, of files or of a session's frames, as they would have been at the reference temperature.

For measurement correct the centres, not the image; a warped image is for software that wants pixels. The result is
float32: rounding it to 8 bits afterwards costs what it costs (about 0.3 DN), and is the user's choice.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Literal, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from thermostand.compensation.drift.drift_model import DriftModel
from thermostand.compensation.drift_runtime import source_offset
from thermostand.compensation.history.thermal_history import Float, States
from thermostand.foundation.errors import SessionError
from thermostand.foundation.files import write_bytes_atomically
from thermostand.markers.jit import compile_with

# Reading an image at places between its pixels, in float32, fast enough for a camera's stream.
#
# Along each axis the value is a weighted mean of the 8 pixels around the place. The weights are the best linear
# prediction (Wiener, Kriging) of an image whose pixels hang together as in one blurred by `_BLUR_px`, with a little
# noise, and exact for cubics:
#
#     minimise E |sum w_k I_k - I(t)|^2,  cov(I_k, I_l) = exp(-(k - l)^2 / (4 blur^2)) + noise,
#     sum w_k k^n = t^n, n <= 3
#
# For images of lenses (a blur of 0.5 px and more) this leaves the centres of markers where they are at least as well as
# a cubic B-spline does, and needs no filter before. cv2.remap is no alternative: it rounds positions to 1/32 px.
#
# Rows are read first, columns then, in strips so narrow that what is read again lies in the processor's cache. Offsets
# and weights are bilinear between the points of a lattice; beyond its border the image is mirrored about the outermost
# pixels' centres.

Image = NDArray[np.uint8] | NDArray[np.uint16] | NDArray[np.float32]
Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]

# One lattice of weights serves 16 rows, which took 0.6 of the time of weights for each 16 pixels of a row.
BLOCK_px = 16
"""Apart are the points of the lattice."""
_PER_BLOCK = np.float32(1 / BLOCK_px)
# Eight taps left 1.0, 0.37, 0.15 and 0.21 mpx of marker error at a blur of 0.5, 0.6, 0.8 and 1.2 px, for 1.4, 0.64,
# 0.18 and 0.04 of a cubic B-spline, in 0.42 of its processor time. Twice the taps would take about twice the time.
TAPS = 8
_BEFORE = 3
"""Of the 8 pixels, those before the one at or left of the place."""
# One blur serves all lenses: the errors above, at blurs of 0.5 to 1.2 px, are with this one.
_BLUR_px = 0.7
# Keeps the system solvable, and is too little to smooth the image.
_NOISE = 1e-6
_REACH = 1.0
"""How far a place may lie outside the two middle pixels, so that a block of places reads the same pixels."""
# A step of the table is 0.003 px.
_NODES = 1024
_PER_NODE = np.float32(_NODES / (1 + 2 * _REACH))
# Measured on 5 MP frames: 25.5 ms with 256 columns, 35 with 128 and 27 with 512.
_STRIP = 256
_HELD_ROWS = 128  # of the source, read once for all rows of the result that need them; 128 KB with _STRIP
_HELD_BANDS = _HELD_ROWS // BLOCK_px
_NOWHERE = 1 << 40  # further from any row than an image has rows
SMALLEST_px = 16  # twice TAPS
_GREATEST_CHANGE_px = 1.0  # per px of offset change: beyond it the image folds over itself
_AT = np.uint64
"""Of indices: one that may be negative is looked at twice."""


@cache
def _build_weight_table() -> Float32:
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
    change = max(np.abs(np.diff(offset, axis=axis)).max() for offset in (from_x, from_y) for axis in (0, 1))
    if change > _GREATEST_CHANGE_px:
        raise ValueError(f"the shift changes by more than a pixel within {BLOCK_px} px: that is no drift of a camera")
    out = np.empty(image.shape, np.float32)
    _resample(image, _map_to_source_rows(from_x, from_y), from_y, _build_weight_table(), out)
    return out


def _map_to_source_rows(from_x: Float32, from_y: Float32) -> Float32:
    """from_x (M, N) at rows of the source: what the row of the result asks for that is read from it."""
    rows, columns = np.mgrid[: from_x.shape[0], : from_x.shape[1]]
    at = np.clip(rows - _PER_BLOCK * from_y, 0, len(from_x) - 1)
    above = np.minimum(at.astype(np.int64), len(from_x) - 2)
    part = (at - above).astype(np.float32)
    return from_x[above, columns] + part * (from_x[above + 1, columns] - from_x[above, columns])


class _Cells(NamedTuple):
    """Cells of BLOCK_px columns that follow each other; a strip is so many, whose offsets begin at that of `first`."""

    first: int
    cells: int


class _Buffers(NamedTuple):
    """What a band of source rows is read with: whole pixels of the strip's cells, weights of its columns, a row of the
    source, and the rows that are held."""

    whole: Int64
    weights: Float32
    row: Float32
    held: Float32


@compile_with(nogil=True, fastmath=True)
def _resample(image: Image, from_x: Float32, from_y: Float32, table: Float32, out: Float32) -> None:
    """Strip by strip; bands of source rows that were read along x are held until others need their place. from_x: of
    the source's rows, from_y: of the result's."""
    height, width = image.shape
    held = np.empty((_HELD_ROWS, _STRIP), np.float32)
    bands = np.empty(_HELD_BANDS, np.int64)
    whole, weights = np.empty(_STRIP // BLOCK_px, np.int64), np.empty((2 * TAPS, _STRIP), np.float32)
    along = _Buffers(np.empty_like(whole), np.empty_like(weights), np.empty(2 * _STRIP, np.float32), held)
    line = np.empty(_STRIP, np.float32)
    for left in range(0, width, _STRIP):
        wide = min(_STRIP, width - left)
        cells = (wide + BLOCK_px - 1) // BLOCK_px
        strip = _Cells(left // BLOCK_px, cells)
        bands[:] = _NOWHERE
        for y in range(height):
            if y % BLOCK_px == 0:
                cell_row = y // BLOCK_px
                _weigh(from_y[cell_row], from_y[cell_row + 1], strip, table, whole, weights)
            begin = 0
            while begin < cells:
                end = _find_run_end(whole, begin, cells)
                top = y + whole[begin] - _BEFORE
                for band in range(top // BLOCK_px, (top + TAPS - 1) // BLOCK_px + 1):
                    if bands[band % _HELD_BANDS] != band:
                        bands[band % _HELD_BANDS] = band
                        _read_band(image, band, from_x, strip, table, along)
                down = np.float32(y % BLOCK_px)
                _filter_along_y(held, top, weights, down, _Cells(begin, end - begin), line)
                begin = end
            for x in range(_AT(wide)):
                out[_AT(y), _AT(left) + x] = line[x]


@compile_with(nogil=True, fastmath=True)
def _read_band(image: Image, band: int, from_x: Float32, strip: _Cells, table: Float32, buffers: _Buffers) -> None:
    """BLOCK_px rows of the source, in a strip, at the places that the result asks for."""
    whole, weights, row, cells = buffers.whole, buffers.weights, buffers.row, strip.cells
    height, last = image.shape[0], from_x.shape[0] - 1
    upper, lower = from_x[min(max(band, 0), last)], from_x[min(max(band + 1, 0), last)]
    _weigh(upper, lower, strip, table, whole, weights)
    low, high = whole[0], whole[0]
    for cell in range(1, cells):
        low, high = min(low, whole[cell]), max(high, whole[cell])
    for down in range(BLOCK_px):
        y = band * BLOCK_px + down
        _copy_row(
            image,
            _mirror_index(y, height),
            strip.first * BLOCK_px + low - _BEFORE,
            cells * BLOCK_px + TAPS + high - low,
            row,
        )
        begin = 0
        while begin < cells:
            end = _find_run_end(whole, begin, cells)
            run, line = _Cells(begin, end - begin), buffers.held[y % _HELD_ROWS]
            _filter_along_x(row, whole[begin] - low, weights, np.float32(down), run, line)
            begin = end


@compile_with(nogil=True)
def _find_run_end(whole: Int64, begin: int, cells: int) -> int:
    """The first cell after `begin` that reads other whole pixels, `cells` at most."""
    end = begin + 1
    while end < cells and whole[end] == whole[begin]:
        end += 1
    return end


@compile_with(nogil=True, fastmath=True)
def _weigh(upper: Float32, lower: Float32, strip: _Cells, table: Float32, whole: Int64, weights: Float32) -> None:
    """Compute the whole pixels of each cell of a strip's row, whose corners have the offsets `upper` and `lower`, and
    for each column of pixels the weights in its first row (TAPS, pixels) and their change per row."""
    corners = np.empty((4, TAPS), np.float32)
    before, here, next_row = _NOWHERE, _AT(0), _AT(2)
    for cell in range(strip.cells):
        at, behind = _AT(strip.first + cell), _AT(strip.first + cell + 1)
        own = math.floor(np.float32(0.25) * (upper[at] + upper[behind] + lower[at] + lower[behind]))
        whole[cell] = own
        here, next_row = next_row, here
        if own != before:
            _set_weights(table, upper[at] - np.float32(own), corners, here)
            _set_weights(table, lower[at] - np.float32(own), corners, here + _AT(1))
        before = own
        _set_weights(table, upper[behind] - np.float32(own), corners, next_row)
        _set_weights(table, lower[behind] - np.float32(own), corners, next_row + _AT(1))
        left = _AT(cell * BLOCK_px)
        for k in range(_AT(TAPS)):
            value, growth = corners[here, k], corners[here + _AT(1), k] - corners[here, k]
            change = corners[next_row, k] - value
            growth_change = corners[next_row + _AT(1), k] - corners[next_row, k] - growth
            change, growth, growth_change = change * _PER_BLOCK, growth * _PER_BLOCK, growth_change * _PER_BLOCK**2
            for x in range(_AT(BLOCK_px)):
                weights[k, left + x] = value + np.float32(x) * change
            for x in range(_AT(BLOCK_px)):
                weights[k + _AT(TAPS), left + x] = growth + np.float32(x) * growth_change


@compile_with(nogil=True, fastmath=True)
def _set_weights(table: Float32, place: np.float32, weights: Float32, row: np.uint64) -> None:
    """Set a row of `weights` to those of one place."""
    at = (place + np.float32(_REACH)) * _PER_NODE
    node = _AT(min(max(int(at), 0), _NODES - 1))
    part = at - np.float32(node)
    for k in range(_AT(TAPS)):
        weights[row, k] = table[node, k] + part * (table[node + _AT(1), k] - table[node, k])


@compile_with(nogil=True)
def _mirror_index(place: int, size: int) -> int:
    """The row or column of the image that stands for one beyond it."""
    place = abs(place)
    return min(max(place if place < size else 2 * (size - 1) - place, 0), size - 1)


@compile_with(nogil=True)
def _copy_row(image: Image, y: int, begin: int, count: int, row: Float32) -> None:
    """Copy `count` columns of a row of the image, from `begin` on, mirrored at its ends."""
    width = image.shape[1]
    low = min(max(-begin, 0), count)
    high = max(min(width - begin, count), low)
    for x in range(_AT(high - low)):
        row[_AT(low) + x] = image[_AT(y), _AT(begin + low) + x]
    for x in range(low):
        row[x] = image[y, _mirror_index(begin + x, width)]
    for x in range(high, count):
        row[x] = image[y, _mirror_index(begin + x, width)]


@compile_with(nogil=True, fastmath=True)
def _filter_along_x(row: Float32, shift: int, weights: Float32, down: np.float32, run: _Cells, line: Float32) -> None:
    """Pixels of a source row into their place in a held line, `down` rows below their cells' first one. Weights are
    named one by one: the processor then takes many pixels at once."""
    w, d = weights[:TAPS], weights[TAPS:]
    k0, k1, k2, k3, k4, k5, k6, k7 = _AT(0), _AT(1), _AT(2), _AT(3), _AT(4), _AT(5), _AT(6), _AT(7)
    for n in range(_AT(run.first * BLOCK_px), _AT((run.first + run.cells) * BLOCK_px)):
        x = n + _AT(shift)
        line[n] = (
            (w[k0, n] + down * d[k0, n]) * row[x]
            + (w[k1, n] + down * d[k1, n]) * row[x + k1]
            + (w[k2, n] + down * d[k2, n]) * row[x + k2]
            + (w[k3, n] + down * d[k3, n]) * row[x + k3]
            + (w[k4, n] + down * d[k4, n]) * row[x + k4]
            + (w[k5, n] + down * d[k5, n]) * row[x + k5]
            + (w[k6, n] + down * d[k6, n]) * row[x + k6]
            + (w[k7, n] + down * d[k7, n]) * row[x + k7]
        )


@compile_with(nogil=True, fastmath=True)
def _filter_along_y(held: Float32, top: int, weights: Float32, down: np.float32, run: _Cells, line: Float32) -> None:
    """Pixels of a row of the result, from the 8 held rows that begin with `top`."""
    w, d = weights[:TAPS], weights[TAPS:]
    k0, k1, k2, k3, k4, k5, k6, k7 = _AT(0), _AT(1), _AT(2), _AT(3), _AT(4), _AT(5), _AT(6), _AT(7)
    r0, r1, r2, r3 = (top % _HELD_ROWS, (top + 1) % _HELD_ROWS, (top + 2) % _HELD_ROWS, (top + 3) % _HELD_ROWS)
    r4, r5, r6, r7 = ((top + 4) % _HELD_ROWS, (top + 5) % _HELD_ROWS, (top + 6) % _HELD_ROWS, (top + 7) % _HELD_ROWS)
    h0, h1, h2, h3, h4, h5, h6, h7 = held[r0], held[r1], held[r2], held[r3], held[r4], held[r5], held[r6], held[r7]
    for n in range(_AT(run.first * BLOCK_px), _AT((run.first + run.cells) * BLOCK_px)):
        line[n] = (
            (w[k0, n] + down * d[k0, n]) * h0[n]
            + (w[k1, n] + down * d[k1, n]) * h1[n]
            + (w[k2, n] + down * d[k2, n]) * h2[n]
            + (w[k3, n] + down * d[k3, n]) * h3[n]
            + (w[k4, n] + down * d[k4, n]) * h4[n]
            + (w[k5, n] + down * d[k5, n]) * h5[n]
            + (w[k6, n] + down * d[k6, n]) * h6[n]
            + (w[k7, n] + down * d[k7, n]) * h7[n]
        )


ImageFormat = Literal["tiff", "png"]
Shift = Callable[[Float], Float]
"""Points (N, 2) px of the measured image -> their displacement (N, 2), px, to the reference."""


def correct_image(image: Image, model: DriftModel, states: States) -> NDArray[np.float32]:
    """The grey image (height, width) at the reference, float32, for one thermal state; SessionError when it is not of
    the model's size, or when the state does not determine the drift."""
    height, width = image.shape
    own_width, own_height = model.facts.image_size
    if (width, height) != (own_width, own_height):
        raise SessionError(f"the image has {width} x {height} pixels, the model is of {own_width} x {own_height}")

    def shift(xy_px: Float) -> Float:
        return model.shift(xy_px, states)

    try:
        return warp(image, shift)
    except ValueError as error:
        raise SessionError(
            f"the camera's thermal state is not known well enough for a model of the form {model.form}: {error}"
        ) from error


def compute_middle_flags(model: DriftModel, states: States) -> int:
    """Return why the correction at the middle of the image is an extrapolation (Outside), 0 when it is not."""
    width, height = model.facts.image_size
    return int(model.flags(np.array([[(width - 1) / 2, (height - 1) / 2]]), states)[0])


def write_image(path: Path, image: NDArray[np.float32], form: ImageFormat, dtype: np.dtype[np.generic]) -> None:
    """tiff: float32 as it is. png: rounded to `dtype`, the original's. The file appears when it is complete;
    SessionError when the place refuses."""
    pixels: NDArray[np.generic] = image
    if form == "png":
        pixels = np.clip(np.round(image), 0, np.iinfo(dtype.name).max).astype(dtype)
    done, data = cv2.imencode(f".{form}", pixels)  # pyright: ignore[reportCallIssue, reportArgumentType]
    if not done:
        raise SessionError(f"{path}: the image cannot be written as {form}")
    write_bytes_atomically(path, data.tobytes())


def warp(image: Image, shift: Shift) -> NDArray[np.float32]:
    """The grey image (height, width) with each of its points moved by `shift`, float32 (height, width).

    What was outside the image is its mirror image. The shift is evaluated every 16 px and bilinear in between (0.1 mpx
    for a drift that bends by 0.5 px over the image). NaN in the shift, and one that changes by more than a pixel within
    16, is refused: ValueError.
    """
    height, width = image.shape
    grid_x, grid_y = (np.arange(0, size + BLOCK_px, BLOCK_px, dtype=np.float64) for size in (width, height))
    lattice = np.stack(np.meshgrid(grid_x, grid_y), axis=-1)
    offset = source_offset(shift, lattice.reshape(-1, 2)).reshape(lattice.shape).astype(np.float32)
    if not np.isfinite(offset).all():
        raise ValueError("the shift is not finite everywhere in the image")
    from_x, from_y = np.ascontiguousarray(offset[:, :, 0]), np.ascontiguousarray(offset[:, :, 1])
    return resample(image, from_x, from_y)
