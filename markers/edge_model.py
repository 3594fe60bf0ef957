"""The pixels along the outline of a round marker, as a function of twelve parameters.

The model of a pixel (u, v), with x = (u - cx) / R, y = (v - cy) / R and M = [[m11, m12], [m12, m22]]:

    F = sqrt(m11 x^2 + 2 m12 x y + m22 y^2)            1 on the outline
    d = (F - 1) F / |M (x, y)| R                       signed distance to the outline, px (first order)
    I = f + (b - f) Phi(d / sigma) + sigma n . grad(b - f) phi(d / sigma)

with planes b = b0 + bx x + by y (ground) and f = f0 + fx x + fy y (disc), Phi the normal distribution function, phi its
density, n the outline's normal. The last term is what blurring does to a step between two slopes; without it a light
gradient of 30 % across a 5 MP frame shifts every centre by 0.15 mpx. Twelve parameters per marker, one row of
`EdgeState.parameters`:  cx cy m11 m12 m22 sigma b0 bx by f0 fx fy.  M is symmetric positive definite and has no
angle, so a circle is not a singular case. sigma contains the pixel box (1/12 px^2).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from markers.compiled import compiled
from markers.pixels import CORE, DISC, GROUND, RESIDUAL, RISE, SHARE, VALUE, Pixels, U, V

CX, CY, M11, M12, M22, SIGMA, B0, BX, BY, F0, FX, FY = range(12)
PARAMETERS = 12

Float = NDArray[np.float64]
Variance = tuple[float, float]
"""floor_DN2 and slope_DN of a `Noise`."""

_TINY = 1e-12
BLOCK = 256
"""Pixels whose derivatives are held at a time: they stay in the processor's nearest cache."""
ERROR = PARAMETERS
PIXEL = PARAMETERS + 1
ROWS = PARAMETERS + 7
"""Rows of a block: the derivatives, the residuals, then the rows of `Pixels.table`."""
_TABLE_END = 6.0
_TABLE_CELLS = 8192
_NODES = np.linspace(-_TABLE_END, _TABLE_END, _TABLE_CELLS + 1)
_STEP = np.array([0.5 * math.erfc(-t / math.sqrt(2)) for t in _NODES])
_DENSITY = np.exp(-0.5 * _NODES * _NODES) / math.sqrt(2 * math.pi)


@dataclass(frozen=True, slots=True, eq=False)
class EdgeState:
    """parameters: (N, 12), see the module. scale_px: (N,), the R of each marker, constant while it is tracked."""

    parameters: Float
    scale_px: Float

    def centres_px(self) -> Float:
        """Centres (x, y), shape (N, 2)."""
        return self.parameters[:, :2]

    def radii_px(self) -> Float:
        """Geometric mean of the semi-axes, shape (N,)."""
        p = self.parameters
        return self.scale_px / np.sqrt(np.sqrt(p[:, M11] * p[:, M22] - p[:, M12] ** 2))

    def half_extents_px(self) -> Float:
        """Half width and half height of each ellipse's bounding box, shape (N, 2)."""
        p = self.parameters
        determinant = p[:, M11] * p[:, M22] - p[:, M12] ** 2
        return self.scale_px[:, None] * np.sqrt(p[:, [M22, M11]] / determinant[:, None])

    def contrast_DN(self) -> Float:
        """Ground minus disc, shape (N,)."""
        return self.parameters[:, B0] - self.parameters[:, F0]

    def __getitem__(self, which: NDArray[np.intp]) -> EdgeState:
        return EdgeState(self.parameters[which], self.scale_px[which])


@compiled
def normal_equations(
    pixels: Pixels, p: Float, scale: float, noise: Variance, normal: Float, right: Float
) -> tuple[float, float]:
    """Set J'WJ (12, 12) and J'We (12,) at the parameters `p`, write each pixel's residual, and return the sum of
    squared residuals and the sum of the pixels' shares."""
    normal[:] = 0
    right[:] = 0
    squares, weights = _core_equations(pixels.table[CORE], pixels.counts[CORE], p, scale, noise, normal, right)
    for region, first in ((GROUND, B0), (DISC, F0)):
        more = _level_equations(pixels.table[region], pixels.counts[region], p, scale, noise, normal, right, first)
        squares += more[0]
        weights += more[1]
    for i in range(PARAMETERS):
        for j in range(i):
            normal[i, j] = normal[j, i]
    return squares, weights


@compiled
def _core_equations(
    table: Float, count: int, p: Float, scale: float, noise: Variance, normal: Float, right: Float
) -> tuple[float, float]:
    """Add the pixels near the outline to the upper half of `normal`, and to `right`."""
    rows = np.empty((ROWS, BLOCK))
    block = rows.ravel()
    squares, weights = 0.0, 0.0
    for first in range(0, count, BLOCK):
        size = load_block(rows, table, first, count)
        more = derivatives(block, size, p, scale, noise)
        squares += more[0]
        weights += more[1]
        for row in (RESIDUAL, RISE):
            for k in range(size):
                table[row, first + k] = rows[PIXEL + row, k]
        for i in range(0, PARAMETERS, 3):
            for j in range(i, PARAMETERS, 3):
                _add_products(rows, i, j, size, normal)
            _add_right(rows, i, size, right)
    return squares, weights


@compiled
def load_block(rows: Float, table: Float, first: int, count: int) -> int:
    """Copy the pixels from `first` on into a block (ROWS, BLOCK), as many as there is room for; their number."""
    size = min(BLOCK, count - first)
    for row in (U, V, VALUE, SHARE):
        for k in range(size):
            rows[PIXEL + row, k] = table[row, first + k]
    return size


@compiled
def derivatives(block: Float, size: int, p: Float, scale: float, noise: Variance) -> tuple[float, float]:
    """From the first `size` pixels of `block` its weighted derivatives by the parameters and weighted residuals.

    Terms that vanish on the outline are left out: the fit still ends where J'We = 0, which is free of bias while the
    model holds. The rows of `block` lie one after the other, BLOCK numbers each, so that the compiler sees that they
    do not overlap and does eight pixels at a time.
    """
    m11, m12, m22, sigma = p[M11], p[M12], p[M22], p[SIGMA]
    cx, cy, b0, bx, by, f0, fx, fy = p[CX], p[CY], p[B0], p[BX], p[BY], p[F0], p[FX], p[FY]
    floor, gain = noise[0], noise[1]
    per_scale, per_sigma, sharpness = 1 / scale, 1 / sigma, sigma / scale
    slope_x, slope_y = bx - fx, by - fy
    squares, weights = 0.0, 0.0
    for k in range(size):
        x = (block[(PIXEL + U) * BLOCK + k] - cx) * per_scale
        y = (block[(PIXEL + V) * BLOCK + k] - cy) * per_scale
        gx, gy = m11 * x + m12 * y, m12 * x + m22 * y
        F = math.sqrt(max(gx * x + gy * y, _TINY))
        per_length = 1 / (math.sqrt(gx * gx + gy * gy) + _TINY)
        nx, ny = gx * per_length, gy * per_length
        t = (F - 1) * F * per_length * scale * per_sigma
        step, density = normal_distribution(t)
        disc = f0 + fx * x + fy * y
        contrast = b0 + bx * x + by * y - disc
        model = disc + contrast * step + (slope_x * nx + slope_y * ny) * density * sharpness
        root = math.sqrt(1 / (floor + gain * max(model, 0.0)))
        residual = (block[(PIXEL + VALUE) * BLOCK + k] - model) * root
        weight = block[(PIXEL + SHARE) * BLOCK + k]
        share = math.sqrt(weight)
        rise = contrast * density * per_sigma * root
        block[(PIXEL + RESIDUAL) * BLOCK + k] = residual
        block[(PIXEL + RISE) * BLOCK + k] = rise
        squares, weights = squares + weight * residual * residual, weights + weight
        root, rise = root * share, rise * share
        bend = rise * scale * per_length
        block[CX * BLOCK + k] = -rise * nx
        block[CY * BLOCK + k] = -rise * ny
        block[M11 * BLOCK + k] = 0.5 * bend * x * x
        block[M12 * BLOCK + k] = bend * x * y
        block[M22 * BLOCK + k] = 0.5 * bend * y * y
        block[SIGMA * BLOCK + k] = -rise * t
        ground, inside = step * root, (1 - step) * root
        block[B0 * BLOCK + k] = ground
        block[BX * BLOCK + k] = ground * x
        block[BY * BLOCK + k] = ground * y
        block[F0 * BLOCK + k] = inside
        block[FX * BLOCK + k] = inside * x
        block[FY * BLOCK + k] = inside * y
        block[ERROR * BLOCK + k] = residual * share
    return squares, weights


@compiled
def normal_distribution(t: float) -> tuple[float, float]:
    """The normal distribution function and its density, by linear interpolation in tables; error below 2e-7."""
    place = (min(max(t, -_TABLE_END), _TABLE_END) + _TABLE_END) * (_TABLE_CELLS / (2 * _TABLE_END))
    cell = np.uint32(min(place, _TABLE_CELLS - 1.0))
    part = place - cell
    return (
        _STEP[cell] + part * (_STEP[cell + np.uint32(1)] - _STEP[cell]),
        _DENSITY[cell] + part * (_DENSITY[cell + np.uint32(1)] - _DENSITY[cell]),
    )


@compiled
def _add_products(rows: Float, i: int, j: int, size: int, normal: Float) -> None:
    """Add the products of rows i..i+2 with rows j..j+2: nine sums at a time stay in registers."""
    a0 = a1 = a2 = b0 = b1 = b2 = c0 = c1 = c2 = 0.0
    a, b, c, x0, x1, x2 = rows[i], rows[i + 1], rows[i + 2], rows[j], rows[j + 1], rows[j + 2]
    for k in range(size):
        a0, a1, a2 = a0 + a[k] * x0[k], a1 + a[k] * x1[k], a2 + a[k] * x2[k]
        b0, b1, b2 = b0 + b[k] * x0[k], b1 + b[k] * x1[k], b2 + b[k] * x2[k]
        c0, c1, c2 = c0 + c[k] * x0[k], c1 + c[k] * x1[k], c2 + c[k] * x2[k]
    for row, sums in enumerate(((a0, a1, a2), (b0, b1, b2), (c0, c1, c2))):
        for column in range(3):
            normal[i + row, j + column] += sums[column]


@compiled
def _add_right(rows: Float, i: int, size: int, right: Float) -> None:
    """Add the products of rows i..i+2 with the residuals."""
    sa = sb = sc = 0.0
    a, b, c, residual = rows[i], rows[i + 1], rows[i + 2], rows[ERROR]
    for k in range(size):
        sa, sb, sc = sa + a[k] * residual[k], sb + b[k] * residual[k], sc + c[k] * residual[k]
    right[i] += sa
    right[i + 1] += sb
    right[i + 2] += sc


@compiled
def _level_equations(
    table: Float, count: int, p: Float, scale: float, noise: Variance, normal: Float, right: Float, first: int
) -> tuple[float, float]:
    """Add pixels that see only the plane whose parameters begin at `first`."""
    per_scale = 1 / scale
    n, sx, sy, sxx, sxy, syy, e, ex, ey = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    squares, weights = 0.0, 0.0
    for k in range(count):
        x, y = (table[U, k] - p[CX]) * per_scale, (table[V, k] - p[CY]) * per_scale
        model = p[first] + p[first + 1] * x + p[first + 2] * y
        weight = 1 / (noise[0] + noise[1] * max(model, 0.0))
        difference = table[VALUE, k] - model
        table[RESIDUAL, k] = difference * math.sqrt(weight)
        weight *= table[SHARE, k]
        squares += weight * difference * difference
        weights += table[SHARE, k]
        n, sx, sy = n + weight, sx + weight * x, sy + weight * y
        sxx, sxy, syy = sxx + weight * x * x, sxy + weight * x * y, syy + weight * y * y
        weight *= difference
        e, ex, ey = e + weight, ex + weight * x, ey + weight * y
    normal[first, first] += n
    normal[first, first + 1] += sx
    normal[first, first + 2] += sy
    normal[first + 1, first + 1] += sxx
    normal[first + 1, first + 2] += sxy
    normal[first + 2, first + 2] += syy
    right[first] += e
    right[first + 1] += ex
    right[first + 2] += ey
    return squares, weights
