"""How far the residuals of a fit move the centre, when they hang together.

The covariance (J'WJ)^-1 chi^2 takes every pixel's residual as independent of the next one's. JPEG, rows that flicker,
neighbours mixed by a colour filter and the grain of a print make it too small; a blur that is no Gaussian, whose
residuals are large and even about the centre, makes it too large. The cluster-robust ("sandwich") covariance does not
ask why: with the influence g_i of each pixel on the centre and its residual e_i,

    variance = sum over clusters (sum of g_i e_i in the cluster)^2

A cluster is a sector of the first quadrant with its mirror images in the three others, so that what is even about the
centre, or the same along a row or a column, is summed up before it is squared.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from markers.compiled import compiled
from markers.edge_model import (
    B0,
    BX,
    BY,
    CX,
    CY,
    F0,
    FX,
    FY,
    M11,
    M12,
    M22,
    SIGMA,
    Float,
    Variance,
    normal_distribution,
)
from markers.pixels import CORE, DISC, GROUND, RESIDUAL, RISE, SHARE, Pixels, U, V

MOST_CLUSTERS = 9
_LEAST_CLUSTERS = 2
_LEAST_ARC_px = 3.0
"""Residuals nearer than this hang together by the blur and by the colour filter alone."""

SAMPLED_MARKERS = 18
"""Of a frame, evenly spread: they determine the growth of its variances to 14 %, at a third of the time of all."""
_LEAST_MARKERS = 8
"""With fewer the growth of a frame's variances is a guess."""
_TINY = 1e-12


@compiled
def clusters_of(radius_px: float) -> int:
    """How many clusters a marker has."""
    return int(min(max(0.5 * math.pi * radius_px / _LEAST_ARC_px, _LEAST_CLUSTERS), MOST_CLUSTERS))


@compiled
def centre_scatter(pixels: Pixels, p: Float, scale: float, noise: Variance, inverse: Float, clusters: int) -> Float:
    """The cluster-robust variances of cx and cy, px^2, and below them what they would be with independent residuals of
    unit variance, (2, 2). inverse: (J'WJ)^-1. The second row is less than the diagonal of `inverse` by what the fit
    takes from the residuals of each cluster: sum c_k (1 - c_k / c), with a cluster's part c_k of c.
    """
    moved, part = np.zeros((2, clusters)), np.zeros((2, clusters))
    _add_core(pixels.table[CORE], pixels.counts[CORE], p, scale, noise, inverse, moved, part)
    for region, first in ((GROUND, B0), (DISC, F0)):
        _add_level(pixels.table[region], pixels.counts[region], p, scale, noise, inverse, first, moved, part)
    variances = np.zeros((2, 2))
    for axis in range(2):
        whole = 0.0
        for cluster in range(clusters):
            whole += part[axis, cluster]
        for cluster in range(clusters):
            variances[0, axis] += moved[axis, cluster] ** 2
            variances[1, axis] += part[axis, cluster] * (1 - part[axis, cluster] / whole)
    return variances


@compiled
def _add_core(
    table: Float, count: int, p: Float, scale: float, noise: Variance, inverse: Float, moved: Float, part: Float
) -> None:
    """Add the pixels near the outline to their clusters; the derivatives are those of edge_model.py."""
    m11, m12, m22, sigma = p[M11], p[M12], p[M22], p[SIGMA]
    slope_x, slope_y, sharpness = p[BX] - p[FX], p[BY] - p[FY], sigma / scale
    a, b = inverse[CX], inverse[CY]
    for k in range(count):
        x, y = (table[U, k] - p[CX]) / scale, (table[V, k] - p[CY]) / scale
        gx, gy = m11 * x + m12 * y, m12 * x + m22 * y
        F = math.sqrt(max(gx * x + gy * y, _TINY))
        per_length = 1 / (math.sqrt(gx * gx + gy * gy) + _TINY)
        nx, ny = gx * per_length, gy * per_length
        t = (F - 1) * F * per_length * scale / sigma
        step, density = normal_distribution(t)
        disc = p[F0] + p[FX] * x + p[FY] * y
        contrast = p[B0] + p[BX] * x + p[BY] * y - disc
        model = disc + contrast * step + (slope_x * nx + slope_y * ny) * density * sharpness
        root = 1 / math.sqrt(noise[0] + noise[1] * max(model, 0.0))
        rise, outer, inner = table[RISE, k], step * root, (1 - step) * root
        bend = rise * scale * per_length
        xx, xy, yy = 0.5 * bend * x * x, bend * x * y, 0.5 * bend * y * y
        g = -rise * (a[CX] * nx + a[CY] * ny + a[SIGMA] * t) + a[M11] * xx + a[M12] * xy + a[M22] * yy
        h = -rise * (b[CX] * nx + b[CY] * ny + b[SIGMA] * t) + b[M11] * xx + b[M12] * xy + b[M22] * yy
        g += outer * (a[B0] + a[BX] * x + a[BY] * y) + inner * (a[F0] + a[FX] * x + a[FY] * y)
        h += outer * (b[B0] + b[BX] * x + b[BY] * y) + inner * (b[F0] + b[FX] * x + b[FY] * y)
        _add(g, h, x, y, table[SHARE, k], table[RESIDUAL, k], moved, part)


@compiled
def _add_level(
    table: Float,
    count: int,
    p: Float,
    scale: float,
    noise: Variance,
    inverse: Float,
    first: int,
    moved: Float,
    part: Float,
) -> None:
    """Add pixels that see only the plane whose parameters begin at `first`."""
    a, b = inverse[CX], inverse[CY]
    for k in range(count):
        x, y = (table[U, k] - p[CX]) / scale, (table[V, k] - p[CY]) / scale
        model = p[first] + p[first + 1] * x + p[first + 2] * y
        root = 1 / math.sqrt(noise[0] + noise[1] * max(model, 0.0))
        g = root * (a[first] + a[first + 1] * x + a[first + 2] * y)
        h = root * (b[first] + b[first + 1] * x + b[first + 2] * y)
        _add(g, h, x, y, table[SHARE, k], table[RESIDUAL, k], moved, part)


@compiled
def _add(g: float, h: float, x: float, y: float, share: float, residual: float, moved: Float, part: Float) -> None:
    """Add a pixel with the influences g and h on cx and cy to its cluster."""
    clusters = moved.shape[1]
    cluster = min(int(clusters * abs(y) / (abs(x) + abs(y) + _TINY)), clusters - 1)
    moved[0, cluster] += share * g * residual
    moved[1, cluster] += share * h * residual
    part[0, cluster] += share * g * g
    part[1, cluster] += share * h * h


def variance_growth(scatter: Float, clean: NDArray[np.bool_]) -> Float:
    """By what the variances of a frame's centres grow (2,), along x and y: the sums over its `clean` (N,) markers of
    the robust over the independent ones of `scatter` (N, 2, 2), NaN for markers that were not looked at.

    Pulled to 1 where it could be chance (James and Stein): independent noise keeps the covariance that it has.
    """
    seen = scatter[clean & np.isfinite(scatter[:, 0, 0])]
    robust, independent = seen[:, 0], seen[:, 1]
    if len(robust) < _LEAST_MARKERS:
        return np.ones(2)
    whole = independent.sum(axis=0)
    ratio = robust.sum(axis=0) / whole
    chance = np.sqrt(np.sum((robust - ratio * independent) ** 2, axis=0)) / whole
    beyond = ratio - 1
    return 1 + beyond * np.maximum(1 - (chance / np.where(beyond == 0, 1.0, beyond)) ** 2, 0)
