"""How far the residuals of a fit move the centre, when they hang together.

The covariance (J'WJ)^-1 chi^2 takes every pixel's residual as independent of the next one's. JPEG, rows that flicker,
neighbours mixed by a colour filter and the grain of a print make it too small; a blur that is no Gaussian, whose
residuals are large and even about the centre, makes it too large. The cluster-robust ("sandwich") covariance does not
ask why: with the influence g_i of each pixel on the centre and its residual e_i,

    variance = sum over clusters (sum of g_i e_i in the cluster)^2

A cluster is a sector of the first quadrant with its mirror images in the three others, so that what is even about the
centre, or the same along a row or a column, is summed up before it is squared. Neighbouring clusters overlap by half,
and each pixel counts in two of them, with weights whose squares add up to 1: sectors that end sharply cut through
pixels, and where a wrong blur leaves large residuals the cut is most of the sum.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from thermostand.markers.edge_model import (
    B0,
    BLOCK,
    CX,
    CY,
    ERROR,
    F0,
    PARAMETERS,
    ROWS,
    SHARES,
    VALUES,
    Float,
    Single,
    Variance,
    X,
    Y,
    compute_derivatives,
    load_block,
)
from thermostand.markers.jit import compile_part
from thermostand.markers.pixels import CORE, DISC, GROUND, Pixels

# Chosen on discs of 17 px (of 3, 4, 6 and 8), judged on radii of 10, 17 and 35 px, other angles and seeds; noise alone
# stays at 1.00 to 1.08. Two would fit the 15 photographs better (chi^2 of 1.0, not 2.5), but are worse known elsewhere.
MOST_CLUSTERS = 6
_LEAST_CLUSTERS = 2  # of a quadrant: one would have no variance
# Twice as much makes four clusters of a disc of 17 px instead of six, half changes discs below 11 px only.
_LEAST_ARC_px = 3.0
"""Residuals nearer than this hang together by the blur and by the colour filter alone."""

# Half as many would know the growth to 23 %, all 54 to 11 % in twice the time.
SAMPLED_MARKERS = 27
"""Of a frame, evenly spread: they determine the growth of its variances to 16 %, at half of the time of all, which are
looked at where the sample is conspicuous (detection.py)."""
_LEAST_MARKERS = 8
"""With fewer the growth of a frame's variances is a guess."""
# Less than independent noise is claimed only on twice the evidence, for it makes intervals narrower.
_SHRINKAGE_SIGMAS = 2.0
_TINY, _ZERO, _ONE, _THREE = np.float32(1e-12), np.float32(0), np.float32(1), np.float32(3)

_MOVED, _TAKEN, _SQUARE = range(3)
"""Of each cluster with weights w: the sums of w g e, of w g^2 and of w^2 g^2."""
_X, _Y, _G, _H, _E, _PLACE, _THIS, _NEXT, _SEEN = range(9)
"""Rows of a block of pixels: place in the image; influences on cx and cy; residual; the cluster before it in the
quadrant; its weights in that and in the next; how many rows."""


@compile_part
def count_clusters(radius_px: float) -> int:
    """Return into how many parts the quadrant is divided: each end of a part has a cluster about it."""
    return int(min(max(0.5 * math.pi * radius_px / _LEAST_ARC_px, _LEAST_CLUSTERS), MOST_CLUSTERS))


@compile_part
def compute_centre_scatter(
    pixels: Pixels, p: Float, scale: float, noise: Variance, inverse: Float, parts: int
) -> Float:
    """The cluster-robust variances of cx and cy, px^2, and below them what they would be with independent residuals of
    unit variance, (2, 2). inverse: (J'WJ)^-1. parts: of the quadrant. The second row is less than the diagonal of
    `inverse` by what the fit takes from the residuals of each cluster, by the square of the part of all influence that
    is the cluster's.
    """
    sums, seen = np.zeros((2, 3, parts + 1)), np.empty((_SEEN, BLOCK), np.float32)
    rows = np.empty((ROWS, BLOCK), np.float32)
    block = rows.ravel()
    for region, level in ((CORE, -1), (GROUND, B0), (DISC, F0)):
        for first in range(0, pixels.counts[region], BLOCK):
            size = load_block(block, pixels, region, first, p, scale)
            for k in range(size):
                seen[_X, k], seen[_Y, k] = rows[X, k], rows[Y, k]
            if region == CORE:
                compute_derivatives(block, size, p, scale, noise)
                _set_core_influences(rows, inverse, size, seen)
            else:
                _set_level_influences(rows, p[level : level + 3], noise, inverse[:2, level : level + 3], size, seen)
            _add_block(seen, size, sums)
    variances = np.zeros((2, 2))
    for axis in range(2):
        whole = 0.0
        for cluster in range(parts + 1):
            whole += sums[axis, _SQUARE, cluster]
        for cluster in range(parts + 1):
            variances[0, axis] += sums[axis, _MOVED, cluster] ** 2
            variances[1, axis] += sums[axis, _SQUARE, cluster] - sums[axis, _TAKEN, cluster] ** 2 / whole
    return variances


@compile_part
def _set_core_influences(rows: Single, inverse: Float, size: int, seen: Single) -> None:
    """Set what pixels near the outline move the centre by, and their residuals, from their derivatives."""
    for k in range(size):
        seen[_G, k], seen[_H, k], seen[_E, k] = _ZERO, _ZERO, rows[ERROR, k]
    for i in range(PARAMETERS):
        a, b = np.float32(inverse[CX, i]), np.float32(inverse[CY, i])
        for k in range(size):
            seen[_G, k] += a * rows[i, k]
            seen[_H, k] += b * rows[i, k]


@compile_part
def _set_level_influences(
    rows: Single, plane: Float, noise: Variance, influence: Float, size: int, seen: Single
) -> None:
    """The same for pixels that see only a plane, by its parameters (3,) and what they move cx and cy by (2, 3)."""
    a, b, c = np.float32(plane[0]), np.float32(plane[1]), np.float32(plane[2])
    read_variance, gain = np.float32(noise[0]), np.float32(noise[1])
    for k in range(size):
        model = a + b * seen[_X, k] + c * seen[_Y, k]
        root = math.sqrt(rows[SHARES, k] / (read_variance + gain * max(model, _ZERO)))
        seen[_E, k] = root * (rows[VALUES, k] - model)
        seen[_PLACE, k] = root
    for row, axis in ((_G, CX), (_H, CY)):
        g, gx, gy = np.float32(influence[axis, 0]), np.float32(influence[axis, 1]), np.float32(influence[axis, 2])
        for k in range(size):
            seen[row, k] = seen[_PLACE, k] * (g + gx * seen[_X, k] + gy * seen[_Y, k])


@compile_part
def _add_block(seen: Single, size: int, sums: Float) -> None:
    """Add pixels to the two clusters of each. It is looked at all the clusters of all pixels, several pixels at a time:
    to add each to its own two, one after the other, takes three times as long."""
    parts = sums.shape[2] - 1
    for k in range(size):
        x, y = abs(seen[_X, k]), abs(seen[_Y, k])
        place = np.float32(parts) * y / (x + y + _TINY)
        cell = np.float32(np.int32(place))
        square = (place - cell) * (place - cell) * (_THREE - (place - cell) - (place - cell))
        seen[_PLACE, k], seen[_THIS, k], seen[_NEXT, k] = cell, math.sqrt(_ONE - square), math.sqrt(square)
    for cluster in range(parts + 1):
        middle, before = np.float32(cluster), np.float32(cluster - 1)
        gx = gy = gxx = gyy = wxx = wyy = _ZERO
        for k in range(size):
            cell, g, h, e = seen[_PLACE, k], seen[_G, k], seen[_H, k], seen[_E, k]
            weight = (seen[_THIS, k] if cell == middle else _ZERO) + (seen[_NEXT, k] if cell == before else _ZERO)
            wg, wh = weight * g, weight * h
            gx, gy = gx + wg * e, gy + wh * e
            gxx, gyy = gxx + wg * g, gyy + wh * h
            wxx, wyy = wxx + wg * wg, wyy + wh * wh
        for axis, found in enumerate(((gx, gxx, wxx), (gy, gyy, wyy))):
            for row in range(3):
                sums[axis, row, cluster] += found[row]


def compute_variance_ratio(scatter: Float, clean: NDArray[np.bool_]) -> tuple[Float, Float]:
    """The sums over a frame's `clean` (N,) markers of the robust over the independent variances of `scatter`
    (N, 2, 2), NaN for markers that were not looked at, along x and y (2,), and the standard deviations that chance
    gives these ratios (2,). 1 and infinite where the markers are few."""
    seen = scatter[clean & np.isfinite(scatter[:, 0, 0])]
    robust, independent = seen[:, 0], seen[:, 1]
    if len(robust) < _LEAST_MARKERS:
        return np.ones(2), np.full(2, np.inf)
    whole = independent.sum(axis=0)
    ratio = robust.sum(axis=0) / whole
    return ratio, np.sqrt(np.sum((robust - ratio * independent) ** 2, axis=0)) / whole


def compute_variance_growth(ratio: Float, chance: Float) -> Float:
    """Compute by what the variances of a frame's centres grow (2,), along x and y, for a `compute_variance_ratio`.

    Pulled to 1 where it could be chance (James and Stein): independent noise keeps the covariance that it has. To
    claim less than that takes twice the evidence.
    """
    beyond = ratio - 1
    tolerance = np.where(beyond < 0, _SHRINKAGE_SIGMAS, 1.0) * chance
    return 1 + beyond * np.maximum(1 - (tolerance / np.where(beyond == 0, 1.0, beyond)) ** 2, 0)
