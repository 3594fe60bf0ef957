"""The outline seen in angular sectors: where a marker does not look like the ellipse fitted to it."""

from __future__ import annotations

import math

import numpy as np

from compensation.compiled import compiled
from compensation.markers.edge_model import CX, CY, Float
from compensation.markers.pixels import CORE, RESIDUAL, RISE, SHARE, Pixels, U, V

SECTORS = 36
_QUADRANT = SECTORS // 4


@compiled
def sector(p: Float, u: float, v: float) -> int:
    """The sector (0..35) of a pixel. By |y| / (|x| + |y|) within a quadrant: no arc tangent, and nearly even."""
    x, y = u - p[CX], v - p[CY]
    part = min(int(_QUADRANT * abs(y) / (abs(x) + abs(y) + 1e-12)), _QUADRANT - 1)
    if y >= 0:
        return part if x >= 0 else 2 * _QUADRANT - 1 - part
    return SECTORS - 1 - part if x >= 0 else 2 * _QUADRANT + part


@compiled
def outline_misfit(pixels: Pixels, p: Float) -> float:
    """How far the outline is off the ellipse, sector by sector: root mean square of the displacements over their
    standard deviations. 1 when the noise explains them. Something that hides a part of the outline shows here long
    before it shows in the residuals of all pixels together."""
    moment, weight = np.zeros(SECTORS), np.zeros(SECTORS)
    table = pixels.table[CORE]
    for k in range(pixels.counts[CORE]):
        place = sector(p, table[U, k], table[V, k])
        moment[place] += table[SHARE, k] * table[RISE, k] * table[RESIDUAL, k]
        weight[place] += table[SHARE, k] * table[RISE, k] * table[RISE, k]
    total, count = 0.0, 0
    for place in range(SECTORS):
        if weight[place] > 0:
            total += moment[place] * moment[place] / weight[place]
            count += 1
    return math.sqrt(total / max(count, 1))
