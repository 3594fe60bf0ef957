"""Which candidate is which marker: a lattice is grown through the candidates and laid over the target.

1. Growth: from a seed and two lattice vectors, breadth first; each step is predicted from the step before.
2. Placement: every way the target's rows and columns can lie on the lattice. The smallest homography residual wins,
   not the largest count: clutter in line with the grid adds support, but does not fit.
3. Orientation: the odd marker, else the rotation nearest to the previous frame's, else nearest to the nominal roll
   (0: the rows point to the right, marker 1 is bottom left). Never a guess: what stays open is refused.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from compensation.markers.bootstrap import Candidates
from compensation.markers.lattice import Cell, largest_lattice
from compensation.target import Target
from drivers.interface import StandError

_MISSING_PX = 0.5
_AMBIGUOUS_RESIDUAL = 1.5
_AMBIGUOUS_ROLL_DEG = 30.0
_TRACKED_PITCH = 0.5
_GATE_PITCH = 0.2
_RANSAC_PITCH = 0.12

Float = NDArray[np.float64]
Index = NDArray[np.intp]


class DetectionError(StandError):
    """The target was not found or not identified beyond doubt; `found` counts the markers that were."""

    def __init__(self, text: str, found: int = 0) -> None:
        super().__init__(text)
        self.found = found


@dataclass(frozen=True, slots=True, eq=False)
class Identified:
    """candidate: (N,) the candidate that is each marker, -1 for none. homography: (3, 3), target mm -> px."""

    candidate: Index
    homography: Float


@dataclass(frozen=True, slots=True, eq=False)
class _Placement:
    """One way to lay the target over the lattice; residual_px counts missing markers as well."""

    candidate: Index
    homography: Float
    residual_px: float


def identify(candidates: Candidates, target: Target, previous: Float | None = None) -> Identified:
    """The markers among the candidates; `previous` is the homography of the frame before.

    Raises DetectionError with the reason when there are too few or more than one reading is possible.
    """
    lattice = largest_lattice(candidates.centres_px, target.count)
    _require(len(lattice), target)
    placements = _placements(lattice, candidates.centres_px, target)
    _require(max((int((p.candidate >= 0).sum()) for p in placements), default=0), target)
    placements = _with_odd_marker(placements, candidates, target)
    placements = _near_previous(placements, candidates.centres_px, target, previous)
    chosen = _by_roll(_by_residual(placements, target), target, previous)
    return _gated(chosen, candidates.centres_px, target)


def project(homography: Float, points: Float) -> Float:
    """Points (K, 2) mapped by a homography."""
    mapped = np.column_stack([points, np.ones(len(points))]) @ homography.T
    return mapped[:, :2] / mapped[:, 2:]


def fit_homography(target_mm: Float, centres_px: Float) -> Float:
    """Least-squares homography (3, 3), target mm -> px, from at least four pairs of points."""
    homography, _ = cv2.findHomography(target_mm, centres_px, 0)
    return np.asarray(homography, dtype=np.float64)


def roll_deg(homography: Float, target: Target) -> float:
    """Counter-clockwise angle in the image of the rows' direction, in the middle of the target."""
    middle = target.coordinates_mm().mean(axis=0)
    ends = project(homography, np.stack([middle, middle + np.array([target.pitch_mm, 0])]))
    return float(np.degrees(np.arctan2(-(ends[1, 1] - ends[0, 1]), ends[1, 0] - ends[0, 0])))


def _require(found: int, target: Target) -> None:
    if found < target.least_markers:
        raise DetectionError(
            f"found {found} of {target.count} markers of {target.name}: {target.least_markers} are needed", found
        )


def _cross(a: Float, b: Float) -> float:
    return float(a[0] * b[1] - a[1] * b[0])


def _placements(lattice: dict[Cell, int], points: Float, target: Target) -> list[_Placement]:
    """All placements with at most two markers fewer than the best, in all rotations the target's sides allow."""
    cells: Index = np.array(list(lattice.keys()), dtype=np.intp)
    members = np.array(list(lattice.values()), dtype=np.intp)
    if not _rows_point_up(cells, points[members]):
        cells = cells * np.array([1, -1])
    found: list[Index] = []
    for _ in range(4):
        found += _windows(cells, members, target)
        cells = np.stack([cells[:, 1], -cells[:, 0]], axis=1)
    counts = np.array([(candidate >= 0).sum() for candidate in found])
    enough = [c for c, n in zip(found, counts, strict=True) if n >= max(6, counts.max() - 2)]
    return [_placement(candidate, points, target) for candidate in enough]


def _rows_point_up(cells: Index, points: Float) -> bool:
    """Whether the lattice, as numbered, is seen from the front: the second axis is a quarter turn counter-clockwise
    of the first, which is a negative cross product while y points down.
    """
    design = np.column_stack([cells, np.ones(len(cells))])
    axes = np.linalg.lstsq(design, points, rcond=None)[0]
    return _cross(axes[0], axes[1]) < 0


def _windows(cells: Index, members: Index, target: Target) -> list[Index]:
    """Every columns x rows window over the lattice, as tables marker -> candidate."""
    low, high = cells.min(axis=0), cells.max(axis=0) + 1
    starts = [
        range(min(low[i], high[i] - size), max(low[i], high[i] - size) + 1)
        for i, size in enumerate((target.columns, target.rows))
    ]
    tables: list[Index] = []
    for left in starts[0]:
        for bottom in starts[1]:
            column, row = cells[:, 0] - left, cells[:, 1] - bottom
            inside = (column >= 0) & (column < target.columns) & (row >= 0) & (row < target.rows)
            table = np.full(target.count, -1, dtype=np.intp)
            table[row[inside] * target.columns + column[inside]] = members[inside]
            tables.append(table)
    return tables


def _placement(candidate: Index, points: Float, target: Target) -> _Placement:
    seen = candidate >= 0
    target_mm, centres_px = target.coordinates_mm()[seen], points[candidate[seen]]
    homography = fit_homography(target_mm, centres_px)
    off = np.linalg.norm(project(homography, target_mm) - centres_px, axis=1)
    missing = len(candidate) - int(seen.sum())
    return _Placement(candidate, homography, float(np.sqrt(np.mean(off**2))) + _MISSING_PX * missing)


def _with_odd_marker(placements: list[_Placement], candidates: Candidates, target: Target) -> list[_Placement]:
    """Those with a disc of the odd size in the odd marker's place; all when the target has none."""
    if target.odd_marker is None:
        return placements
    usual = target.odd_marker.diameter_mm / target.diameter_mm
    fitting = [p for p in placements if abs(np.log(_odd_size(p, candidates, target))) < 0.5 * abs(np.log(usual))]
    if not fitting:
        found = max(int((p.candidate >= 0).sum()) for p in placements)
        raise DetectionError(
            f"found {found} of {target.count} markers of {target.name}, but not the odd marker "
            f"{target.odd_marker.number}",
            found,
        )
    return fitting


def _odd_size(placement: _Placement, candidates: Candidates, target: Target) -> float:
    """Diameter of the disc in the odd marker's place over the expected one; the other markers give the scale."""
    seen = placement.candidate >= 0
    odd = target.odd_marker.number - 1 if target.odd_marker else 0
    if not seen[odd]:
        return float("inf")
    expected = target.diameters_mm() * np.sqrt(_area_scale(placement.homography, target.coordinates_mm()))
    size = np.sqrt(candidates.areas_px2[placement.candidate]) / expected
    return float(size[odd] / np.median(size[seen]))


def _area_scale(homography: Float, points: Float) -> Float:
    """px^2 per mm^2 at points (K, 2): the determinant of a homography's derivative, det H / w^3."""
    w = np.column_stack([points, np.ones(len(points))]) @ homography[2]
    return np.abs(np.linalg.det(homography) / w**3)


def _near_previous(
    placements: list[_Placement], points: Float, target: Target, previous: Float | None
) -> list[_Placement]:
    """Those within half a pitch of where the frame before had the markers; all when there are none."""
    if previous is None:
        return placements
    expected = project(previous, target.coordinates_mm())
    limit = _TRACKED_PITCH * pitch_px(previous, target)
    near = [p for p in placements if _rms_distance(p, points, expected) < limit]
    return near or placements


def _rms_distance(placement: _Placement, points: Float, expected: Float) -> float:
    seen = placement.candidate >= 0
    return float(np.sqrt(np.mean(np.sum((points[placement.candidate[seen]] - expected[seen]) ** 2, axis=1))))


def pitch_px(homography: Float, target: Target) -> float:
    """The pitch in the middle of the target: the side of a square of the same area."""
    middle = target.coordinates_mm().mean(axis=0, keepdims=True)
    return target.pitch_mm * float(np.sqrt(_area_scale(homography, middle)[0]))


def _by_residual(placements: list[_Placement], target: Target) -> list[_Placement]:
    """The rotations of the best-fitting window; refuses when another window fits nearly as well."""
    best = min(placements, key=lambda p: p.residual_px)
    same = [p for p in placements if _same_window(p, best, target)]
    others = [p for p in placements if not _same_window(p, best, target)]
    if any(p.residual_px < _AMBIGUOUS_RESIDUAL * best.residual_px for p in others):
        found = int((best.candidate >= 0).sum())
        raise DetectionError(
            f"found {found} of {target.count} markers of {target.name}, but they fit in more than one place of the "
            "grid",
            found,
        )
    return same


def _same_window(one: _Placement, other: _Placement, target: Target) -> bool:
    """Whether two placements cover the same part of the image, however rotated: their corners coincide."""
    columns, rows = target.columns, target.rows
    corners = target.nominal_mm()[[0, columns - 1, columns * (rows - 1), columns * rows - 1]]
    first, second = project(one.homography, corners), project(other.homography, corners)
    away = np.linalg.norm(first[:, None] - second[None], axis=2).min(axis=1)
    return bool(away.max() < 0.25 * pitch_px(one.homography, target))


def _by_roll(placements: list[_Placement], target: Target, previous: Float | None) -> _Placement:
    """The rotation nearest to the expected one; refuses when a second is about as near."""
    expected = target.nominal_roll_deg if previous is None else roll_deg(previous, target)
    turns = [abs((roll_deg(p.homography, target) - expected + 180) % 360 - 180) for p in placements]
    order = np.argsort(turns)
    best = placements[order[0]]
    if len(order) > 1 and turns[order[1]] - turns[order[0]] < _AMBIGUOUS_ROLL_DEG:
        raise DetectionError(
            f"the {target.columns}x{target.rows} grid of {target.name} is ambiguous at roll "
            f"{roll_deg(best.homography, target):.0f} deg: give nominal_roll_deg in the target file",
            int((best.candidate >= 0).sum()),
        )
    return best


def _gated(placement: _Placement, points: Float, target: Target) -> Identified:
    """Without markers that lie off the plane's homography: they are clutter in line with the grid."""
    target_mm = target.coordinates_mm()
    seen = np.flatnonzero(placement.candidate >= 0)
    pitch = pitch_px(placement.homography, target)
    centres = points[placement.candidate[seen]]
    robust, _ = cv2.findHomography(target_mm[seen], centres, cv2.RANSAC, _RANSAC_PITCH * pitch)
    off = np.linalg.norm(project(np.asarray(robust, dtype=np.float64), target_mm[seen]) - centres, axis=1)
    kept = seen[off < _GATE_PITCH * pitch]
    _require(len(kept), target)
    candidate = np.full(target.count, -1, dtype=np.intp)
    candidate[kept] = placement.candidate[kept]
    return Identified(candidate, fit_homography(target_mm[kept], points[candidate[kept]]))
