"""The marker seen in angular sectors: where it does not look like the model fitted to it."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from markers.compiled import compiled
from markers.edge_model import CX, CY, Float
from markers.pixels import CORE, DISC, GROUND, RESIDUAL, RISE, SHARE, Pixels, U, V

Bools = NDArray[np.bool_]

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
def all_kept() -> Bools:
    """All sectors (36,)."""
    kept = np.empty(SECTORS, np.bool_)
    kept[:] = True
    return kept


@compiled
def number_of(kept: Bools) -> int:
    """How many sectors are kept."""
    number = 0
    for place in range(SECTORS):
        number += kept[place]
    return number


@compiled
def set_aside(pixels: Pixels, p: Float, kept: Bools) -> None:
    """Give the pixels of sectors that are not `kept` (36,) the share 0."""
    for region in range(3):
        table = pixels.table[region]
        for k in range(pixels.counts[region]):
            if not kept[sector(p, table[U, k], table[V, k])]:
                table[SHARE, k] = 0.0


@compiled
def deviations(pixels: Pixels, p: Float) -> Float:
    """What each sector deviates from the model, in standard deviations, (3, 36): its outline (CORE), its levels
    further out and further in (GROUND, DISC). NaN where there are no pixels."""
    moment, weight = np.zeros((3, SECTORS)), np.zeros((3, SECTORS))
    for region in range(3):
        table = pixels.table[region]
        for k in range(pixels.counts[region]):
            place = sector(p, table[U, k], table[V, k])
            slope = table[RISE, k] if region == CORE else 1.0
            moment[region, place] += table[SHARE, k] * slope * table[RESIDUAL, k]
            weight[region, place] += table[SHARE, k] * slope * slope
        for place in range(SECTORS):
            seen = weight[region, place] > 0
            moment[region, place] = moment[region, place] / math.sqrt(weight[region, place]) if seen else math.nan
    return moment


@compiled
def misfits(pixels: Pixels, p: Float) -> tuple[float, float]:
    """Root mean square over the sectors of the worse of their outlines and their two levels, and of the worse level; 1
    when the noise explains them. Something that hides a part of the marker, or shines on it, shows here long before it
    shows in the residuals of all pixels together."""
    found = deviations(pixels, p)
    outline, levels = _mean_square(found[CORE]), max(_mean_square(found[GROUND]), _mean_square(found[DISC]))
    return math.sqrt(max(outline, levels)), math.sqrt(levels)


@compiled
def sector_misfits(pixels: Pixels, p: Float) -> Float:
    """How unlike the model each sector (36,) is, in standard deviations: the largest of its deviations, and its
    squared residuals altogether. 0 where no pixel counts."""
    squares, count = np.zeros(SECTORS), np.zeros(SECTORS)
    for region in range(3):
        table = pixels.table[region]
        for k in range(pixels.counts[region]):
            place = sector(p, table[U, k], table[V, k])
            squares[place] += table[SHARE, k] * table[RESIDUAL, k] * table[RESIDUAL, k]
            count[place] += table[SHARE, k]
    found, misfits = deviations(pixels, p), np.zeros(SECTORS)
    for place in range(SECTORS):
        if count[place] > 0:
            misfits[place] = max(0.0, (squares[place] - count[place]) / math.sqrt(2 * count[place]))
        for region in range(3):
            if abs(found[region, place]) > misfits[place]:  # not where it is NaN
                misfits[place] = abs(found[region, place])
    return misfits


@compiled
def _mean_square(values: Float) -> float:
    """Of those that are not NaN, 1 when all are."""
    total, count = 0.0, 0
    for value in values:
        if not math.isnan(value):
            total += value * value
            count += 1
    return total / count if count > 0 else 1.0
