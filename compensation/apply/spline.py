"""Cubic B-spline interpolation of images in float32, fast enough for a camera's stream.

An image is turned into spline coefficients once (M. Unser, A. Aldroubi, M. Eden, IEEE Trans. Signal Processing 41,
1993, 821-848: one causal and one anti-causal recursion along each axis, pole sqrt(3) - 2), then read anywhere with 4 x
4 of them. cv2.remap is no alternative: it rounds positions to 1/32 px.

Beyond its border the image is mirrored about the outermost pixels' centres.
"""

from __future__ import annotations

import math

import numba as nb
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8] | NDArray[np.uint16] | NDArray[np.float32]
Float32 = NDArray[np.float32]

_POLE = np.float32(math.sqrt(3.0) - 2.0)
_GAIN = np.float32(6.0)  # (1 - pole)(1 - 1/pole), of one axis
_LAST = np.float32(_POLE / (_POLE * _POLE - 1.0))
_HORIZON = 12  # the pole to this power is 1e-7, below float32
_ROWS = 8  # that are filtered side by side: a recursion alone waits for its own last result
_SHORTEST_RUN = 8
BORDER_PX = 4
"""How far beyond the image the coefficients go; a position further out reads as if it were there."""


def coefficients(image: Image) -> Float32:
    """The spline coefficients of an image (height, width), with BORDER_PX mirrored ones on each side.

    ValueError for an image of less than 16 pixels in either direction.
    """
    if image.ndim != 2 or min(image.shape) < 16:
        raise ValueError(f"an image to interpolate is (height, width) of at least 16 x 16 pixels, not {image.shape}")
    height, width = image.shape
    border = BORDER_PX
    spline = np.empty((height + 2 * border, width + 2 * border), np.float32)
    inner = spline[border:-border, border:-border]
    inner[:] = image
    _filter_columns(inner)
    _filter_rows(inner)
    spline[:border, border:-border] = inner[border:0:-1]
    spline[-border:, border:-border] = inner[-2 : -2 - border : -1]
    spline[:, :border] = spline[:, 2 * border : border : -1]
    spline[:, -border:] = spline[:, -border - 2 : -2 * border - 2 : -1]
    return spline


@nb.njit(cache=True, nogil=True, fastmath=True)
def _filter_columns(image: Float32) -> None:
    """Along axis 0, in place; a row at a time, so that the processor takes many columns at once."""
    height, width = image.shape
    first = np.empty(width, np.float32)
    for x in range(width):
        first[x] = image[0, x]
    power = _POLE
    for y in range(1, _HORIZON):
        for x in range(width):
            first[x] += power * image[y, x]
        power *= _POLE
    for x in range(width):
        image[0, x] = _GAIN * first[x]
    for y in range(1, height):
        for x in range(width):
            image[y, x] = _GAIN * image[y, x] + _POLE * image[y - 1, x]
    for x in range(width):
        image[height - 1, x] = _LAST * (image[height - 1, x] + _POLE * image[height - 2, x])
    for y in range(height - 2, -1, -1):
        for x in range(width):
            image[y, x] = _POLE * (image[y + 1, x] - image[y, x])


@nb.njit(cache=True, nogil=True, fastmath=True)
def _filter_rows(image: Float32) -> None:
    """Along axis 1, in place."""
    height, width = image.shape
    strip = np.empty((width, _ROWS), np.float32)
    for begin in range(0, height, _ROWS):
        rows = min(_ROWS, height - begin)
        for row in range(rows):
            for x in range(width):
                strip[x, row] = image[begin + row, x]
        for row in range(rows, _ROWS):
            for x in range(width):
                strip[x, row] = 0.0
        _filter_columns(strip)
        for row in range(rows):
            for x in range(width):
                image[begin + row, x] = strip[x, row]


@nb.njit(cache=True, nogil=True, fastmath=True, inline="always")
def _weights(t: np.float32) -> tuple[np.float32, np.float32, np.float32, np.float32]:
    """Of the four coefficients around a position, `t` (0..1) after the second of them."""
    sixth, third2 = np.float32(1.0 / 6.0), np.float32(2.0 / 3.0)
    one, half = np.float32(1.0), np.float32(0.5)
    rest = one - t
    first = sixth * rest * rest * rest
    last = sixth * t * t * t
    second = third2 - half * t * t * (np.float32(2.0) - t)
    return first, second, one - first - second - last, last


@nb.njit(cache=True, nogil=True, fastmath=True)
def read_rows(spline: Float32, from_x: Float32, from_y: Float32, step_px: int, out: Float32) -> None:
    """An image that reads, at pixel (x, y), the spline at (x + from_x, y + from_y); out (height, width) is written.

    from_x, from_y (M, N): offsets in px at every `step_px`-th pixel in both directions, the last ones beyond the image;
    bilinear in between.
    """
    height, width = out.shape
    at_x, at_y = np.empty(width, np.float32), np.empty(width, np.float32)
    for y in range(height):
        _offsets(from_x, step_px, y, at_x)
        _offsets(from_y, step_px, y, at_y)
        begin = 0
        while begin < width:
            x0, y0 = math.floor(at_x[begin]), math.floor(at_y[begin])
            end = begin + 1
            while end < width and math.floor(at_x[end]) == x0 and math.floor(at_y[end]) == y0:
                end += 1
            # As much of the run as reads within the image; the rest, and what is between two runs, goes singly.
            left, right = max(begin, -x0), min(end, width - 1 - x0)
            if not 0 <= y + y0 < height or right - left < _SHORTEST_RUN:
                left = right = begin
            for x in range(begin, left):
                out[y, x] = _read(spline, x + at_x[x], y + at_y[x])
            if right > left:
                _read_run(spline, left, y, x0, y0, at_x[left:right], at_y[left:right], out[y, left:right])
            for x in range(right, end):
                out[y, x] = _read(spline, x + at_x[x], y + at_y[x])
            begin = end


@nb.njit(cache=True, nogil=True, fastmath=True)
def _offsets(lattice: Float32, step_px: int, y: int, out: Float32) -> None:
    """The lattice's values along the image's row y."""
    cell, inverse = y // step_px, np.float32(1.0 / step_px)
    v = np.float32(y - cell * step_px) * inverse
    for block in range(lattice.shape[1] - 1):
        begin = lattice[cell, block] + v * (lattice[cell + 1, block] - lattice[cell, block])
        end = lattice[cell, block + 1] + v * (lattice[cell + 1, block + 1] - lattice[cell, block + 1])
        step = (end - begin) * inverse
        for x in range(block * step_px, min((block + 1) * step_px, out.shape[0])):
            out[x] = begin + np.float32(x - block * step_px) * step


@nb.njit(cache=True, nogil=True, fastmath=True)
def _read_run(spline: Float32, left: int, y: int, x0: int, y0: int, at_x: Float32, at_y: Float32, out: Float32) -> None:
    """Pixels left, left + 1 ... that read the same whole number of pixels away: without a look-up each, the processor
    takes many at once."""
    j, shift = y + y0 + BORDER_PX - 1, left + x0 + BORDER_PX - 1
    whole_x, whole_y = np.float32(x0), np.float32(y0)
    for x in range(out.shape[0]):
        a0, a1, a2, a3 = _weights(at_x[x] - whole_x)
        b0, b1, b2, b3 = _weights(at_y[x] - whole_y)
        i = x + shift
        out[x] = (
            b0 * (a0 * spline[j, i] + a1 * spline[j, i + 1] + a2 * spline[j, i + 2] + a3 * spline[j, i + 3])
            + b1
            * (
                a0 * spline[j + 1, i]
                + a1 * spline[j + 1, i + 1]
                + a2 * spline[j + 1, i + 2]
                + a3 * spline[j + 1, i + 3]
            )
            + b2
            * (
                a0 * spline[j + 2, i]
                + a1 * spline[j + 2, i + 1]
                + a2 * spline[j + 2, i + 2]
                + a3 * spline[j + 2, i + 3]
            )
            + b3
            * (
                a0 * spline[j + 3, i]
                + a1 * spline[j + 3, i + 1]
                + a2 * spline[j + 3, i + 2]
                + a3 * spline[j + 3, i + 3]
            )
        )


@nb.njit(cache=True, nogil=True, fastmath=True)
def _read(spline: Float32, x: float, y: float) -> np.float32:
    """The spline at one position of the image, px; one that is too far outside is brought nearer."""
    height, width = spline.shape
    at_x = min(max(x + BORDER_PX, 1.0), width - 3.0)
    at_y = min(max(y + BORDER_PX, 1.0), height - 3.0)
    i, j = int(at_x), int(at_y)
    a0, a1, a2, a3 = _weights(np.float32(at_x - i))
    total = np.float32(0.0)
    for row, b in enumerate(_weights(np.float32(at_y - j))):
        k = j - 1 + row
        total += b * (a0 * spline[k, i - 1] + a1 * spline[k, i] + a2 * spline[k, i + 1] + a3 * spline[k, i + 2])
    return total
