"""The marker seen in angular sectors: where it does not look like the model fitted to it."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from thermostand.markers.edge_model import CX, CY, Float
from thermostand.markers.jit import compile_part
from thermostand.markers.pixels import CORE, DISC, GROUND, RESIDUAL, RISE, SHARE, Pixels, U, V

Bools = NDArray[np.bool_]
Sectors = NDArray[np.int32]

# Ten degrees of the outline each; whole sectors are left out.
SECTORS = 36
_QUADRANT = SECTORS // 4
_BLOCK = 256
"""Pixels whose sectors are held at a time."""
_PARTS, _TINY, _ONE = np.float32(_QUADRANT), np.float32(1e-12), np.float32(1)


@compile_part
def find_sector(x: np.float32, y: np.float32) -> np.int32:
    """The sector (0..35) of a place relative to the centre. By |y| / (|x| + |y|) within a quadrant: no arc tangent, and
    nearly even. Without branches, so that several pixels are done at a time."""
    part = min(np.int32(_PARTS * abs(y) / (abs(x) + abs(y) + _TINY)), np.int32(_QUADRANT - 1))
    above = part if x >= 0 else np.int32(2 * _QUADRANT - 1) - part
    return above if y >= 0 else np.int32(SECTORS - 1) - above


@compile_part
def make_all_kept() -> Bools:
    """All sectors (36,)."""
    kept = np.empty(SECTORS, np.bool_)
    kept[:] = True
    return kept


@compile_part
def count_kept(kept: Bools) -> int:
    """Return how many sectors are kept."""
    number = 0
    for place in range(SECTORS):
        number += kept[place]
    return number


@compile_part
def find_sectors(pixels: Pixels, region: int, first: int, p: Float, places: Sectors) -> int:
    """Find the sectors of a region's pixels from `first` on, as many as fit in `places`; return their number."""
    u, v, at = pixels.table[region, U], pixels.table[region, V], np.uint64(first)
    cx, cy = np.float32(p[CX] - pixels.origin[0]), np.float32(p[CY] - pixels.origin[1])
    size = min(len(places), pixels.counts[region] - first)
    for k in range(np.uint64(size)):
        places[k] = find_sector(u[at + k] - cx, v[at + k] - cy)
    return size


@compile_part
def mask_sectors(pixels: Pixels, p: Float, kept: Bools) -> None:
    """Give the pixels of sectors that are not `kept` (36,) the share 0."""
    places = np.empty(_BLOCK, np.int32)
    for region in range(3):
        for first in range(0, pixels.counts[region], _BLOCK):
            for k in range(find_sectors(pixels, region, first, p, places)):
                if not kept[places[k]]:
                    pixels.table[region, SHARE, first + k] = 0.0


@compile_part
def compute_deviations(pixels: Pixels, p: Float) -> Float:
    """Return what each sector deviates from the model, in standard deviations, (3, 36): its outline (CORE), its levels
    further out and further in (GROUND, DISC). NaN where there are no pixels."""
    found, places = np.empty((3, SECTORS)), np.empty(_BLOCK, np.int32)
    sums = np.empty((2, SECTORS, 2))  # neighbours are mostly in one sector: they take turns, not to wait for each other
    for region in range(3):
        share, rise, residual = pixels.table[region, SHARE], pixels.table[region, RISE], pixels.table[region, RESIDUAL]
        sums[:] = 0
        for first in range(0, pixels.counts[region], _BLOCK):
            for k in range(np.uint64(find_sectors(pixels, region, first, p, places))):
                at, turn, place = np.uint64(first) + k, k & np.uint64(1), np.uint64(places[k])
                slope = rise[at] if region == CORE else _ONE
                sums[turn, place, 0] += share[at] * slope * residual[at]
                sums[turn, place, 1] += share[at] * slope * slope
        for place in range(SECTORS):
            moment, weight = sums[0, place, 0] + sums[1, place, 0], sums[0, place, 1] + sums[1, place, 1]
            found[region, place] = moment / math.sqrt(weight) if weight > 0 else math.nan
    return found


@compile_part
def compute_misfits(pixels: Pixels, p: Float) -> tuple[float, float]:
    """Root mean square over the sectors of the worse of their outlines and their two levels, and of the worse level; 1
    when the noise explains them. Something that hides a part of the marker, or shines on it, shows here long before it
    shows in the residuals of all pixels together."""
    found = compute_deviations(pixels, p)
    outline, levels = (
        _compute_mean_square(found[CORE]),
        max(_compute_mean_square(found[GROUND]), _compute_mean_square(found[DISC])),
    )
    return math.sqrt(max(outline, levels)), math.sqrt(levels)


@compile_part
def compute_sector_misfits(pixels: Pixels, p: Float) -> Float:
    """Return how unlike the model each sector (36,) is, in standard deviations: the largest of its deviations, and its
    squared residuals altogether. 0 where no pixel counts."""
    squares, count, places = np.zeros(SECTORS), np.zeros(SECTORS), np.empty(_BLOCK, np.int32)
    for region in range(3):
        share, residual = pixels.table[region, SHARE], pixels.table[region, RESIDUAL]
        for first in range(0, pixels.counts[region], _BLOCK):
            for k in range(find_sectors(pixels, region, first, p, places)):
                squares[places[k]] += share[first + k] * residual[first + k] * residual[first + k]
                count[places[k]] += share[first + k]
    found, misfits = compute_deviations(pixels, p), np.zeros(SECTORS)
    for place in range(SECTORS):
        if count[place] > 0:
            misfits[place] = max(0.0, (squares[place] - count[place]) / math.sqrt(2 * count[place]))
        for region in range(3):
            if abs(found[region, place]) > misfits[place]:  # not where it is NaN
                misfits[place] = abs(found[region, place])
    return misfits


@compile_part
def _compute_mean_square(values: Float) -> float:
    """Return the mean square of those that are not NaN, 1 when all are."""
    total, count = 0.0, 0
    for value in values:
        if not math.isnan(value):
            total += value * value
            count += 1
    return total / count if count > 0 else 1.0
