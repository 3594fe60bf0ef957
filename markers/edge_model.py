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
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from thermostand.markers.jit import compile_part
from thermostand.markers.pixels import CORE, DISC, GROUND, RESIDUAL, RISE, SHARE, VALUE, Pixels, Single, U, V

CX, CY, M11, M12, M22, SIGMA, B0, BX, BY, F0, FX, FY = range(12)
PARAMETERS = 12

Float = NDArray[np.float64]
Variance = tuple[float, float]
"""floor_DN2 and slope_DN of a `Noise`."""

BLOCK = 256
"""Pixels whose derivatives are held at a time: they stay in the processor's nearest cache. They are in single
precision, places relative to the centre, which moves centres by less than 1e-3 mpx, and takes half of the time."""
ERROR = PARAMETERS
X, Y, VALUES, SHARES, RESIDUALS, RISES = range(PARAMETERS + 1, PARAMETERS + 7)
"""Rows of a block: the derivatives, the weighted residuals, then the pixels: place in units of R from the centre, the
other rows of `Pixels.table`."""
ROWS = PARAMETERS + 7
_TINY, _ZERO, _HALF, _ONE = np.float32(1e-12), np.float32(0), np.float32(0.5), np.float32(1)
_TABLE_END = np.float32(6)  # in blurs: beyond it the step is 0 or 1 to 1e-9
# With a series of second order between the nodes 8 kB give what 128 kB gave with linear interpolation, and they stay in
# the nearest cache.
_CELLS = 1024
_PER_CELL = np.float32(12 / _CELLS)
_CELLS_PER = np.float32(_CELLS / 12)
_NODES = np.linspace(-6, 6, _CELLS + 1)
_STEP = np.array([0.5 * math.erfc(-t / math.sqrt(2)) for t in _NODES], np.float32)
_DENSITY = (np.exp(-0.5 * _NODES * _NODES) / math.sqrt(2 * math.pi)).astype(np.float32)


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
        """Return half width and half height of each ellipse's bounding box, shape (N, 2)."""
        p = self.parameters
        determinant = p[:, M11] * p[:, M22] - p[:, M12] ** 2
        return self.scale_px[:, None] * np.sqrt(p[:, [M22, M11]] / determinant[:, None])

    def contrast_DN(self) -> Float:
        """Ground minus disc, shape (N,)."""
        return self.parameters[:, B0] - self.parameters[:, F0]

    def __getitem__(self, which: NDArray[np.intp]) -> EdgeState:
        return EdgeState(self.parameters[which], self.scale_px[which])


class Work(NamedTuple):
    """Work arrays for one marker's J'WJ (12, 12) and J'We (12,)."""

    normal: Float
    right: Float


def allocate_work() -> Work:
    """Allocate the arrays of a fit, not filled yet."""
    return Work(np.empty((PARAMETERS, PARAMETERS)), np.empty(PARAMETERS))


@compile_part
def build_normal_equations(
    pixels: Pixels, p: Float, scale: float, noise: Variance, work: Work, is_known: bool
) -> tuple[float, float]:
    """Set J'WJ, unless it is known well enough from parameters near by, and J'We at the parameters `p`, write each
    pixel's residual, and return the sum of squared residuals and the sum of the pixels' shares."""
    normal, levels = work.normal, np.zeros((PARAMETERS, PARAMETERS))
    work.right[:] = 0
    squares, weights = 0.0, 0.0
    for region in (GROUND, DISC):
        more = _add_level_equations(pixels, region, p, scale, noise, Work(levels, work.right))
        squares += more[0]
        weights += more[1]
    if not is_known:
        for i in range(PARAMETERS):
            for j in range(PARAMETERS):
                normal[i, j] = levels[i, j]
    more = _add_core_equations(pixels, p, scale, noise, work, is_known)
    if not is_known:
        for i in range(PARAMETERS):
            for j in range(i):
                normal[i, j] = normal[j, i]
    return squares + more[0], weights + more[1]


@compile_part
def _add_core_equations(
    pixels: Pixels, p: Float, scale: float, noise: Variance, work: Work, is_known: bool
) -> tuple[float, float]:
    """Add the pixels near the outline to the upper half of J'WJ, unless that is known, and to J'We."""
    rows = np.empty((ROWS, BLOCK), np.float32)
    block = rows.ravel()
    squares, weights = 0.0, 0.0
    for first in range(0, pixels.counts[CORE], BLOCK):
        size = load_block(block, pixels, CORE, first, p, scale)
        more = compute_derivatives(block, size, p, scale, noise)
        squares += more[0]
        weights += more[1]
        _keep_residuals(block, size, pixels.table[CORE], first)
        for i in range(0, PARAMETERS, 3):
            for j in range(PARAMETERS if is_known else i, PARAMETERS, 3):
                _add_products(rows, i, j, size, work.normal)
            _add_right(rows, i, size, work.right)
    return squares, weights


@compile_part
def load_block(block: Single, pixels: Pixels, region: int, first: int, p: Float, scale: float) -> int:
    """Copy the pixels of a region from `first` on into a block, as many as fit; return their number."""
    table, size = pixels.table[region], min(BLOCK, pixels.counts[region] - first)
    at = np.uint64(first)  # unsigned: not looked at for being negative
    u, v, value, share = table[U], table[V], table[VALUE], table[SHARE]
    cx, cy = np.float32(p[CX] - pixels.origin[0]), np.float32(p[CY] - pixels.origin[1])
    per_scale = np.float32(1 / scale)
    for k in range(np.uint64(size)):
        block[X * BLOCK + k] = (u[at + k] - cx) * per_scale
        block[Y * BLOCK + k] = (v[at + k] - cy) * per_scale
        block[VALUES * BLOCK + k] = value[at + k]
        block[SHARES * BLOCK + k] = share[at + k]
    return size


@compile_part
def _keep_residuals(block: Single, size: int, table: Single, first: int) -> None:
    """Write what the model says about a block's pixels into the table."""
    residual, rise, at = table[RESIDUAL], table[RISE], np.uint64(first)
    for k in range(np.uint64(size)):
        residual[at + k] = block[RESIDUALS * BLOCK + k]
        rise[at + k] = block[RISES * BLOCK + k]


@compile_part
def compute_derivatives(block: Single, size: int, p: Float, scale: float, noise: Variance) -> tuple[float, float]:
    """Compute from the first `size` pixels of `block` the weighted derivatives by the parameters and the weighted
    residuals.

    Terms that vanish on the outline are left out: the fit still ends where J'We = 0, which is free of bias while the
    model holds. The rows of `block` lie one after the other, BLOCK numbers each, so that the compiler sees that they
    do not overlap and does several pixels at a time; all numbers of the loop are single, or it would widen them.
    """
    m11, m12, m22, sigma = np.float32(p[M11]), np.float32(p[M12]), np.float32(p[M22]), np.float32(p[SIGMA])
    b0, bx, by = np.float32(p[B0]), np.float32(p[BX]), np.float32(p[BY])
    f0, fx, fy = np.float32(p[F0]), np.float32(p[FX]), np.float32(p[FY])
    read_variance, gain, size_px = np.float32(noise[0]), np.float32(noise[1]), np.float32(scale)
    per_sigma, sharpness = _ONE / sigma, sigma / size_px
    slope_x, slope_y = bx - fx, by - fy
    squares, weights = _ZERO, _ZERO
    for k in range(size):
        x, y = block[X * BLOCK + k], block[Y * BLOCK + k]
        gx, gy = m11 * x + m12 * y, m12 * x + m22 * y
        F = math.sqrt(max(gx * x + gy * y, _TINY))
        per_length = _ONE / (math.sqrt(gx * gx + gy * gy) + _TINY)
        nx, ny = gx * per_length, gy * per_length
        t = (F - _ONE) * F * per_length * size_px * per_sigma
        step, density = evaluate_normal_distribution(t)
        disc = f0 + fx * x + fy * y
        contrast = b0 + bx * x + by * y - disc
        model = disc + contrast * step + (slope_x * nx + slope_y * ny) * density * sharpness
        root = math.sqrt(_ONE / (read_variance + gain * max(model, _ZERO)))
        residual = (block[VALUES * BLOCK + k] - model) * root
        share = block[SHARES * BLOCK + k]  # 0 or 1: its own square
        rise = contrast * density * per_sigma * root
        block[RESIDUALS * BLOCK + k] = residual
        block[RISES * BLOCK + k] = rise
        squares, weights = squares + share * residual * residual, weights + share
        root, rise = root * share, rise * share
        bend = rise * size_px * per_length
        block[CX * BLOCK + k] = -rise * nx
        block[CY * BLOCK + k] = -rise * ny
        block[M11 * BLOCK + k] = _HALF * bend * x * x
        block[M12 * BLOCK + k] = bend * x * y
        block[M22 * BLOCK + k] = _HALF * bend * y * y
        block[SIGMA * BLOCK + k] = -rise * t
        ground, inside = step * root, (_ONE - step) * root
        block[B0 * BLOCK + k] = ground
        block[BX * BLOCK + k] = ground * x
        block[BY * BLOCK + k] = ground * y
        block[F0 * BLOCK + k] = inside
        block[FX * BLOCK + k] = inside * x
        block[FY * BLOCK + k] = inside * y
        block[ERROR * BLOCK + k] = residual * share
    return float(squares), float(weights)


@compile_part
def evaluate_normal_distribution(t: np.float32) -> tuple[np.float32, np.float32]:
    """The normal distribution function and its density, by Taylor's series from the nearest node; error below 2e-7."""
    t = min(max(t, -_TABLE_END), _TABLE_END)
    cell = np.uint32(np.int32((t + _TABLE_END) * _CELLS_PER + _HALF))
    node = np.float32(np.int32(cell)) * _PER_CELL - _TABLE_END
    away = t - node
    density, bend = _DENSITY[cell], node * away
    return (
        _STEP[cell] + density * away * (_ONE - _HALF * bend),
        density * (_ONE - bend + _HALF * (bend * bend - away * away)),
    )


@compile_part
def _add_products(rows: Single, i: int, j: int, size: int, normal: Float) -> None:
    """Add the products of rows i..i+2 with rows j..j+2: nine sums at a time stay in registers."""
    a0 = a1 = a2 = b0 = b1 = b2 = c0 = c1 = c2 = _ZERO
    a, b, c, x0, x1, x2 = rows[i], rows[i + 1], rows[i + 2], rows[j], rows[j + 1], rows[j + 2]
    for k in range(size):
        a0, a1, a2 = a0 + a[k] * x0[k], a1 + a[k] * x1[k], a2 + a[k] * x2[k]
        b0, b1, b2 = b0 + b[k] * x0[k], b1 + b[k] * x1[k], b2 + b[k] * x2[k]
        c0, c1, c2 = c0 + c[k] * x0[k], c1 + c[k] * x1[k], c2 + c[k] * x2[k]
    for row, sums in enumerate(((a0, a1, a2), (b0, b1, b2), (c0, c1, c2))):
        for column in range(3):
            normal[i + row, j + column] += sums[column]


@compile_part
def _add_right(rows: Single, i: int, size: int, right: Float) -> None:
    """Add the products of rows i..i+2 with the residuals."""
    sa = sb = sc = _ZERO
    a, b, c, residual = rows[i], rows[i + 1], rows[i + 2], rows[ERROR]
    for k in range(size):
        sa, sb, sc = sa + a[k] * residual[k], sb + b[k] * residual[k], sc + c[k] * residual[k]
    right[i] += sa
    right[i + 1] += sb
    right[i + 2] += sc


@compile_part
def _add_level_equations(
    pixels: Pixels, region: int, p: Float, scale: float, noise: Variance, work: Work
) -> tuple[float, float]:
    """Add the pixels of a region that sees only the plane of its level."""
    table, normal, right = pixels.table[region], work.normal, work.right
    first = B0 if region == GROUND else F0
    u, v, value, share, residual = table[U], table[V], table[VALUE], table[SHARE], table[RESIDUAL]
    cx, cy = np.float32(p[CX] - pixels.origin[0]), np.float32(p[CY] - pixels.origin[1])
    per_scale, read_variance, gain = np.float32(1 / scale), np.float32(noise[0]), np.float32(noise[1])
    level, slope_x, slope_y = np.float32(p[first]), np.float32(p[first + 1]), np.float32(p[first + 2])
    n = sx = sy = sxx = sxy = syy = e = ex = ey = squares = weights = _ZERO
    for k in range(np.uint64(pixels.counts[region])):
        x, y = (u[k] - cx) * per_scale, (v[k] - cy) * per_scale
        model = level + slope_x * x + slope_y * y
        weight = _ONE / (read_variance + gain * max(model, _ZERO))
        difference = value[k] - model
        residual[k] = difference * math.sqrt(weight)
        weight *= share[k]
        squares, weights = squares + weight * difference * difference, weights + share[k]
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
    return float(squares), float(weights)
