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

from markers.compiled import compiled
from markers.edge_model import (
    B0,
    BLOCK,
    CX,
    CY,
    ERROR,
    F0,
    PARAMETERS,
    PIXEL,
    ROWS,
    Float,
    Variance,
    derivatives,
    load_block,
)
from markers.pixels import CORE, DISC, GROUND, SHARE, VALUE, Pixels, U, V

MOST_CLUSTERS = 6
_LEAST_CLUSTERS = 2
_LEAST_ARC_px = 3.0
"""Residuals nearer than this hang together by the blur and by the colour filter alone."""

SAMPLED_MARKERS = 27
"""Of a frame, evenly spread: they determine the growth of its variances to 16 %, at half of the time of all."""
_LEAST_MARKERS = 8
"""With fewer the growth of a frame's variances is a guess."""
_DOUBT_OF_LESS = 2.0
_TINY = 1e-12

_MOVED, _TAKEN, _SQUARE = range(3)
"""Of each cluster with weights w: the sums of w g e, of w g^2 and of w^2 g^2."""
_X, _Y, _G, _H, _E, _CLUSTER, _SEEN = range(7)
"""Rows of a block of pixels: place, then the weights in its two clusters; influences on cx and cy; residual; the first
of the clusters; how many rows."""


@compiled
def clusters_of(radius_px: float) -> int:
    """Into how many parts the quadrant is divided: there is a cluster about each end of a part."""
    return int(min(max(0.5 * math.pi * radius_px / _LEAST_ARC_px, _LEAST_CLUSTERS), MOST_CLUSTERS))


@compiled
def centre_scatter(pixels: Pixels, p: Float, scale: float, noise: Variance, inverse: Float, parts: int) -> Float:
    """The cluster-robust variances of cx and cy, px^2, and below them what they would be with independent residuals of
    unit variance, (2, 2). inverse: (J'WJ)^-1. parts: of the quadrant. The second row is less than the diagonal of
    `inverse` by what the fit takes from the residuals of each cluster, by the square of the part of all influence that
    is the cluster's.
    """
    sums, rows, seen = np.zeros((2, 3, parts + 1)), np.empty((ROWS, BLOCK)), np.empty((_SEEN, BLOCK))
    for region, level in ((CORE, -1), (GROUND, B0), (DISC, F0)):
        table, count = pixels.table[region], pixels.counts[region]
        for first in range(0, count, BLOCK):
            size = load_block(rows, table, first, count)
            for k in range(size):
                seen[_X, k], seen[_Y, k] = (rows[PIXEL + U, k] - p[CX]) / scale, (rows[PIXEL + V, k] - p[CY]) / scale
            if region == CORE:
                derivatives(rows.ravel(), size, p, scale, noise)
                _core_influences(rows, inverse, size, seen)
            else:
                _level_influences(rows, p, noise, inverse, level, size, seen)
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


@compiled
def _core_influences(rows: Float, inverse: Float, size: int, seen: Float) -> None:
    """What pixels near the outline move the centre by, and their residuals, from their derivatives."""
    for k in range(size):
        seen[_G, k], seen[_H, k], seen[_E, k] = 0.0, 0.0, rows[ERROR, k]
    for i in range(PARAMETERS):
        a, b = inverse[CX, i], inverse[CY, i]
        for k in range(size):
            seen[_G, k] += a * rows[i, k]
            seen[_H, k] += b * rows[i, k]


@compiled
def _level_influences(
    rows: Float, p: Float, noise: Variance, inverse: Float, level: int, size: int, seen: Float
) -> None:
    """The same for pixels that see only the plane whose parameters begin at `level`."""
    a, b, c = p[level], p[level + 1], p[level + 2]
    g0, gx, gy = inverse[CX, level], inverse[CX, level + 1], inverse[CX, level + 2]
    h0, hx, hy = inverse[CY, level], inverse[CY, level + 1], inverse[CY, level + 2]
    for k in range(size):
        x, y = seen[_X, k], seen[_Y, k]
        model = a + b * x + c * y
        root = math.sqrt(rows[PIXEL + SHARE, k] / (noise[0] + noise[1] * max(model, 0.0)))
        seen[_G, k], seen[_H, k] = root * (g0 + gx * x + gy * y), root * (h0 + hx * x + hy * y)
        seen[_E, k] = root * (rows[PIXEL + VALUE, k] - model)


@compiled
def _add_block(seen: Float, size: int, sums: Float) -> None:
    """Add pixels to the two clusters of each."""
    parts = sums.shape[2] - 1
    for k in range(size):
        x, y = abs(seen[_X, k]), abs(seen[_Y, k])
        place = parts * y / (x + y + _TINY)
        cluster = min(math.floor(place), parts - 1.0)
        far = place - cluster
        near = 1 - far
        seen[_X, k], seen[_Y, k] = near * math.sqrt(1 + 2 * far), far * math.sqrt(1 + 2 * near)
        seen[_CLUSTER, k] = cluster
    for k in range(size):
        cluster = int(seen[_CLUSTER, k])
        for axis in range(2):
            g = seen[_G + axis, k]
            moved, taken = g * seen[_E, k], g * g
            for side in range(2):
                weight = seen[_X + side, k]
                sums[axis, _MOVED, cluster + side] += weight * moved
                sums[axis, _TAKEN, cluster + side] += weight * taken
                sums[axis, _SQUARE, cluster + side] += weight * weight * taken


def variance_growth(scatter: Float, clean: NDArray[np.bool_]) -> Float:
    """By what the variances of a frame's centres grow (2,), along x and y: the sums over its `clean` (N,) markers of
    the robust over the independent ones of `scatter` (N, 2, 2), NaN for markers that were not looked at.

    Pulled to 1 where it could be chance (James and Stein): independent noise keeps the covariance that it has. To
    claim less than that takes twice the evidence.
    """
    seen = scatter[clean & np.isfinite(scatter[:, 0, 0])]
    robust, independent = seen[:, 0], seen[:, 1]
    if len(robust) < _LEAST_MARKERS:
        return np.ones(2)
    whole = independent.sum(axis=0)
    ratio = robust.sum(axis=0) / whole
    chance = np.sqrt(np.sum((robust - ratio * independent) ** 2, axis=0)) / whole
    beyond = ratio - 1
    doubt = np.where(beyond < 0, _DOUBT_OF_LESS, 1.0) * chance
    return 1 + beyond * np.maximum(1 - (doubt / np.where(beyond == 0, 1.0, beyond)) ** 2, 0)
