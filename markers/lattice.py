"""A lattice grown through unordered points, with clutter and gaps among them.

Breadth first from a seed; each step is predicted from the steps before, so that the lattice follows perspective and
lens distortion.
"""

from __future__ import annotations

import math
from collections import deque

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

# Chosen on rendered poses up to 45 degrees, with distortion; twice is nearly half a step, where clutter lies.
_STEP_TOLERANCE = 0.22
"""A neighbour lies this close, in steps, to where the steps before predict it."""
# Of the last change of the step: 1 would follow the noise of both places as well, 0 no distortion at all.
_CURVATURE = 0.8
# Time grows in proportion.
_NEIGHBOURS = 24
"""The next marker is among a marker's nearest so many, also at a slant and with clutter between."""

Float = NDArray[np.float64]
Index = NDArray[np.intp]
Cell = tuple[int, int]


def grow_largest_lattice(points: Float, count: int) -> dict[Cell, int]:
    """Cell -> candidate of the largest lattice; seeds nearest to the middle first, until one holds `count`."""
    best: dict[Cell, int] = {}
    tried: set[int] = set()
    if len(points) < 4:
        return best
    near: Index = np.asarray(KDTree(points).query(points, min(_NEIGHBOURS, len(points)))[1], dtype=np.intp)
    for seed in np.argsort(np.linalg.norm(points - np.median(points, axis=0), axis=1)):
        if int(seed) in tried:
            continue
        lattice = _grow(points, near, int(seed))
        if len(lattice) > 3:
            tried.update(lattice.values())
        if len(lattice) > len(best):
            best = lattice
        if len(best) >= count:
            break
    return best


def _grow(points: Float, near: Index, seed: int) -> dict[Cell, int]:
    """The lattice around a seed, empty when the seed has no two neighbours to begin with."""
    base = _find_lattice_vectors(points, near[seed])
    cells: dict[Cell, int] = {(0, 0): seed}
    if base is None:
        return {}
    used = {seed}
    queue = deque([(0, 0)])
    while queue:
        cell = queue.popleft()
        for direction in ((1, 0), (-1, 0), (0, 1), (0, -1)):
            beyond = (cell[0] + direction[0], cell[1] + direction[1])
            if beyond in cells:
                continue
            step = _predict_step(cell, direction, base, cells, points)
            found = _find_nearest(points, near[cells[cell]], points[cells[cell]] + step)
            if found in used or math.dist(points[found], points[cells[cell]] + step) > _STEP_TOLERANCE * math.hypot(
                *step
            ):
                continue
            cells[beyond] = found
            used.add(found)
            queue.append(beyond)
    return cells


def _find_nearest(points: Float, among: Index, place: Float) -> int:
    offset = points[among] - place
    return int(among[np.argmin(np.einsum("ij,ij->i", offset, offset))])


def _find_lattice_vectors(points: Float, near: Index) -> tuple[Float, Float] | None:
    """Find the vectors to the nearest neighbour, and to the nearest of the next 8 that is well off that line; near[0]
    is the seed."""
    offset = points[near[1:10]] - points[near[0]]
    first = offset[0]
    for other in offset[1:]:
        # At least 37 degrees off the first: from rendered poses up to 45 degrees of tilt.
        if abs(_compute_cross_product(first, other)) > 0.6 * np.hypot(*first) * np.hypot(*other):
            return first, other
    return None


def _predict_step(
    cell: Cell,
    direction: Cell,
    base: tuple[Float, Float],
    cells: dict[Cell, int],
    points: Float,
) -> Float:
    """The step that led to `cell` plus 0.8 of its change; else a side neighbour's parallel step; else the seed's."""
    i, j = cell
    di, dj = direction
    before, twice = (i - di, j - dj), (i - 2 * di, j - 2 * dj)
    if before in cells:
        step = points[cells[cell]] - points[cells[before]]
        if twice in cells:
            step = step + _CURVATURE * (step - (points[cells[before]] - points[cells[twice]]))
        return step
    for side in ((dj, di), (-dj, -di)):
        here, neighbour = (i + side[0], j + side[1]), (i + side[0] + di, j + side[1] + dj)
        if here in cells and neighbour in cells:
            return points[cells[neighbour]] - points[cells[here]]
    return base[0] * di + base[1] * dj


def _compute_cross_product(a: Float, b: Float) -> float:
    return float(a[0] * b[1] - a[1] * b[0])
