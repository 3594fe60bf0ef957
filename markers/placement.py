"""The ways a target lies over a lattice grown through the candidates."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from thermostand.foundation.errors import DetectionError
from thermostand.markers.lattice import Cell
from thermostand.markers.plane import area_scale, checked_homography, expected_px, fit_homography, pitch_px, project
from thermostand.markers.target import Target

_MISSING_PX = 0.5
_FEWER_THAN_BEST = 2
LEAST_SEEN = 6
"""Fewer markers are no placement: any four fit a homography."""
_OWN_PLACE = (0.2, 0.06)
"""A marker is this close to where the others put it, in distances of neighbours: while some of them may be wrong, and
when those have gone."""
_BEYOND_CELLS = 2
_REACH = 0.35
_WORTH_SETTLING = 0.7
_RANSAC_PITCH = 0.12
_QUARTER_TURN = np.array([[0, 1], [-1, 0]])
_SHEARS = tuple(np.array(shear) for shear in ([[1, 1], [0, 1]], [[1, -1], [0, 1]], [[1, 0], [1, 1]], [[1, 0], [-1, 1]]))

Float = NDArray[np.float64]
Index = NDArray[np.intp]


@dataclass(frozen=True, slots=True, eq=False)
class GridPlacement:
    """One way to lay the target over the lattice. candidate: (N,) of each marker, -1 for none. homography: target mm
    -> px. residual_px: root mean square over the markers seen, and half a pixel for each that is missing.
    """

    candidate: Index
    homography: Float
    residual_px: float

    @property
    def seen(self) -> int:
        """How many markers have a candidate."""
        return int((self.candidate >= 0).sum())


def placements(lattice: dict[Cell, int], points: Float, target: Target) -> list[GridPlacement]:
    """All placements with at most two markers fewer than the best, in all rotations; gaps and misfits settled."""
    cells: Index = np.array(list(lattice.keys()), dtype=np.intp)
    members: Index = np.array(list(lattice.values()), dtype=np.intp)
    if not _counter_clockwise(cells, points[members]):
        cells = cells * np.array([1, -1])
    tables = _turned(cells, members, target)
    if max(_seen(table) for table in tables) < target.least_markers:
        # In a lattice seen at a slant a diagonal may be the shorter step.
        tables += [table for shear in _SHEARS for table in _turned(cells @ shear, members, target)]
    if max(_seen(table) for table in tables) < target.count:
        tables = _settled(tables, points, target)
        tables += _settled(_beyond(tables, points, target), points, target)
    return _placed(_fullest(_distinct(tables)), points, target)


def _placed(tables: list[Index], points: Float, target: Target) -> list[GridPlacement]:
    """The placements of those tables that are the image of a flat target at all."""
    possible: list[GridPlacement] = []
    for table in tables:
        with suppress(DetectionError):
            possible.append(placement(table, points, target))
    return possible


def _settled(tables: list[Index], points: Float, target: Target) -> list[Index]:
    most = max((_seen(table) for table in tables), default=0)
    near = [table for table in tables if _seen(table) >= max(LEAST_SEEN, _WORTH_SETTLING * most)]
    tree, possible = KDTree(points), list[Index]()
    for table in near:
        with suppress(DetectionError):
            possible.append(settled(table, points, tree, target))
    return possible


def _beyond(tables: list[Index], points: Float, target: Target) -> list[Index]:
    """The best table moved by up to two cells, where that finds as many markers: the growth may have missed a side of
    the grid and continued into clutter at the other.
    """
    possible = _placed(_fullest(tables), points, target)
    if not possible:
        return []
    best = min(possible, key=lambda p: p.residual_px)
    cells, members = target.cells()[best.candidate >= 0], best.candidate[best.candidate >= 0]
    least = max(LEAST_SEEN, _WORTH_SETTLING * best.seen)
    moved = [table for table in _turned(cells, members, target, _BEYOND_CELLS) if _seen(table) >= least]
    tree = KDTree(points)
    return [table for table in moved if _within_reach(table, points, tree, target) >= best.seen - _FEWER_THAN_BEST]


def _within_reach(candidate: Index, points: Float, tree: KDTree, target: Target) -> int:
    """How many markers have a candidate near where the homography of those in the table puts them."""
    target_mm = target.coordinates_mm()
    seen = candidate >= 0
    try:
        homography = fit_homography(target_mm[seen], points[candidate[seen]])
        away, _ = tree.query(project(homography, target_mm))
    except DetectionError:
        return 0
    return int((away < _REACH * pitch_px(homography, target)).sum())


def _fullest(tables: list[Index]) -> list[Index]:
    most = max((_seen(table) for table in tables), default=0)
    return [table for table in tables if _seen(table) >= max(LEAST_SEEN, most - _FEWER_THAN_BEST)]


def placement(candidate: Index, points: Float, target: Target) -> GridPlacement:
    """The homography of a table marker -> candidate, and how well it fits."""
    seen = candidate >= 0
    target_mm, centres_px = target.coordinates_mm()[seen], points[candidate[seen]]
    homography = fit_homography(target_mm, centres_px)
    off = np.linalg.norm(project(homography, target_mm) - centres_px, axis=1)
    missing = len(candidate) - int(seen.sum())
    return GridPlacement(candidate, homography, float(np.sqrt(np.mean(off**2))) + _MISSING_PX * missing)


def settled(candidate: Index, points: Float, tree: KDTree, target: Target) -> Index:
    """Each marker's candidate chosen again: the one nearest to where all others put it, -1 when none is near enough.
    tree: of the points.

    Clutter in line with the grid goes, and a marker that the growth did not reach comes.
    """
    target_mm = target.coordinates_mm()
    for own_place in _OWN_PLACE:
        seen = candidate >= 0
        if seen.sum() < LEAST_SEEN:
            return candidate
        homography = _robust_homography(target_mm[seen], points[candidate[seen]], target)
        centres_px = np.where(seen[:, None], points[candidate], np.nan)
        place = expected_px(target_mm, centres_px, homography)
        limit = own_place * target.spacing_mm * np.sqrt(area_scale(homography, target_mm))
        away, found = tree.query(place)
        candidate = np.where(away < limit, np.asarray(found, dtype=np.intp), np.intp(-1))
    return candidate


def _robust_homography(target_mm: Float, centres_px: Float, target: Target) -> Float:
    threshold_px = _RANSAC_PITCH * pitch_px(fit_homography(target_mm, centres_px), target)
    return checked_homography(cv2.findHomography(target_mm, centres_px, cv2.RANSAC, threshold_px)[0])


def _distinct(tables: list[Index]) -> list[Index]:
    return list(np.unique(np.stack(tables), axis=0)) if tables else []


def _seen(candidate: Index) -> int:
    return int((candidate >= 0).sum())


def _counter_clockwise(cells: Index, points: Float) -> bool:
    """Whether the lattice, as numbered, is seen from the front: the second axis is a quarter turn counter-clockwise
    of the first, which is a negative cross product while y points down.
    """
    design = np.column_stack([cells, np.ones(len(cells))])
    first, second = np.linalg.lstsq(design, points, rcond=None)[0][:2]
    return bool(first[0] * second[1] - first[1] * second[0] < 0)


def _turned(cells: Index, members: Index, target: Target, beyond: int = 0) -> list[Index]:
    tables: list[Index] = []
    for _ in range(4):
        tables += _windows(cells, members, target, beyond)
        cells = cells @ _QUARTER_TURN
    return tables


def _windows(cells: Index, members: Index, target: Target, beyond: int) -> list[Index]:
    """Every place of the target in the lattice's bounds and `beyond` cells around, as tables marker -> candidate."""
    own = target.cells()
    own = own - own.min(axis=0)
    low = cells.min(axis=0)
    extent, size = cells.max(axis=0) - low + 1, own.max(axis=0) + 1
    margin = np.maximum(size - extent, 0) + beyond
    places = np.abs(extent - size) + 2 * beyond + 1
    occupied = np.full(places + size, -1, dtype=np.intp)
    occupied[tuple((cells - low + margin).T)] = members
    return [occupied[own[:, 0] + left, own[:, 1] + bottom] for left in range(places[0]) for bottom in range(places[1])]
