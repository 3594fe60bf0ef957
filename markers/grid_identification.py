"""Which candidate is which marker: a lattice is grown through the candidates and laid over the target.

1. Growth: from a seed and two lattice vectors, breadth first; each step is predicted from the step before.
2. Placement: every way the target's cells can lie on the lattice; gaps that the growth left are filled. The smallest
   homography residual wins, not the largest count: clutter in line with the grid adds support, but does not fit. Where
   a side of the grid is beyond the frame, the window wins whose missing markers are all beyond it.
3. Orientation: the marks, else the rotation nearest to the previous frame's, else to the nominal roll (0:
   the rows point to the right, marker 1 is bottom left). Never a guess: what stays open is refused.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from thermostand.foundation.errors import DetectionError
from thermostand.markers.candidate_search import Candidates
from thermostand.markers.homography import (
    check_homography,
    compute_area_scale,
    compute_pitch_px,
    compute_roll_deg,
    fit_homography,
    predict_px,
    project,
)
from thermostand.markers.lattice import Cell, grow_largest_lattice
from thermostand.markers.target import DonutMarkers, OddMarker, Target

# The ways a target lies over a lattice grown through the candidates.

# A missing marker counts as so much residual. In rendered clutter the choice by residual found 8 of 10 targets and none
# wrong, that by the number of markers 4 of 10 and one wrong.
_MISSING_PX = 0.5
_FEWER_THAN_BEST = 2  # markers; from rendered scenes with clutter
LEAST_SEEN = 6
"""Fewer markers are no placement: any four fit a homography."""
_OWN_PLACE = (0.2, 0.06)
"""A marker is this close to where the others put it, in distances of neighbours: while some of them may be wrong, and
when those have gone."""
_BEYOND_CELLS = 2  # rows beyond the found ones in which a target may go on; not measured
_REACH = 0.35  # of a pitch; at 0.5 a candidate belongs to two places
_SETTLING_SHARE = 0.7  # of the best placement's markers; not measured
# Tighter than the gate of 0.2 behind it.
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


def find_placements(lattice: dict[Cell, int], points: Float, target: Target) -> list[GridPlacement]:
    """All placements with at most two markers fewer than the best, in all rotations; gaps and misfits settled."""
    cells: Index = np.array(list(lattice.keys()), dtype=np.intp)
    members: Index = np.array(list(lattice.values()), dtype=np.intp)
    if not _is_counter_clockwise(cells, points[members]):
        cells = cells * np.array([1, -1])
    tables = _list_rotations(cells, members, target)
    if max(_count_seen(table) for table in tables) < target.least_markers:
        # In a lattice seen at a slant a diagonal may be the shorter step.
        tables += [table for shear in _SHEARS for table in _list_rotations(cells @ shear, members, target)]
    if max(_count_seen(table) for table in tables) < target.count:
        tables = _settle_tables(tables, points, target)
        tables += _settle_tables(_shift_best_table(tables, points, target), points, target)
    return _fit_placements(_select_fullest(_remove_duplicates(tables)), points, target)


def _fit_placements(tables: list[Index], points: Float, target: Target) -> list[GridPlacement]:
    """The placements of those tables that are the image of a flat target at all."""
    possible: list[GridPlacement] = []
    for table in tables:
        with suppress(DetectionError):
            possible.append(fit_placement(table, points, target))
    return possible


def _settle_tables(tables: list[Index], points: Float, target: Target) -> list[Index]:
    most = max((_count_seen(table) for table in tables), default=0)
    near = [table for table in tables if _count_seen(table) >= max(LEAST_SEEN, _SETTLING_SHARE * most)]
    tree, possible = KDTree(points), list[Index]()
    for table in near:
        with suppress(DetectionError):
            possible.append(settle_table(table, points, tree, target))
    return possible


def _shift_best_table(tables: list[Index], points: Float, target: Target) -> list[Index]:
    """The best table moved by up to two cells, where that finds as many markers: the growth may have missed a side of
    the grid and continued into clutter at the other.
    """
    possible = _fit_placements(_select_fullest(tables), points, target)
    if not possible:
        return []
    best = min(possible, key=lambda p: p.residual_px)
    cells, members = target.cells()[best.candidate >= 0], best.candidate[best.candidate >= 0]
    least = max(LEAST_SEEN, _SETTLING_SHARE * best.seen)
    moved = [table for table in _list_rotations(cells, members, target, _BEYOND_CELLS) if _count_seen(table) >= least]
    tree = KDTree(points)
    return [
        table for table in moved if _count_within_reach(table, points, tree, target) >= best.seen - _FEWER_THAN_BEST
    ]


def _count_within_reach(candidate: Index, points: Float, tree: KDTree, target: Target) -> int:
    """Return how many markers have a candidate near where the homography of those in the table puts them."""
    target_mm = target.coordinates_mm()
    seen = candidate >= 0
    try:
        homography = fit_homography(target_mm[seen], points[candidate[seen]])
        away, _ = tree.query(project(homography, target_mm))
    except DetectionError:
        return 0
    return int((away < _REACH * compute_pitch_px(homography, target)).sum())


def _select_fullest(tables: list[Index]) -> list[Index]:
    most = max((_count_seen(table) for table in tables), default=0)
    return [table for table in tables if _count_seen(table) >= max(LEAST_SEEN, most - _FEWER_THAN_BEST)]


def fit_placement(candidate: Index, points: Float, target: Target) -> GridPlacement:
    """The homography of a table marker -> candidate, and how well it fits."""
    seen = candidate >= 0
    target_mm, centres_px = target.coordinates_mm()[seen], points[candidate[seen]]
    homography = fit_homography(target_mm, centres_px)
    off = np.linalg.norm(project(homography, target_mm) - centres_px, axis=1)
    missing = len(candidate) - int(seen.sum())
    return GridPlacement(candidate, homography, float(np.sqrt(np.mean(off**2))) + _MISSING_PX * missing)


def settle_table(candidate: Index, points: Float, tree: KDTree, target: Target) -> Index:
    """Each marker's candidate chosen again: the one nearest to where all others put it, -1 when none is near enough.
    tree: of the points.

    Clutter in line with the grid goes, and a marker that the growth did not reach comes.
    """
    target_mm = target.coordinates_mm()
    for own_place in _OWN_PLACE:
        seen = candidate >= 0
        if seen.sum() < LEAST_SEEN:
            return candidate
        homography = _fit_robust_homography(target_mm[seen], points[candidate[seen]], target)
        centres_px = np.where(seen[:, None], points[candidate], np.nan)
        place = predict_px(target_mm, centres_px, homography)
        limit = own_place * target.spacing_mm * np.sqrt(compute_area_scale(homography, target_mm))
        away, found = tree.query(place)
        candidate = np.where(away < limit, np.asarray(found, dtype=np.intp), np.intp(-1))
    return candidate


def _fit_robust_homography(target_mm: Float, centres_px: Float, target: Target) -> Float:
    threshold_px = _RANSAC_PITCH * compute_pitch_px(fit_homography(target_mm, centres_px), target)
    return check_homography(cv2.findHomography(target_mm, centres_px, cv2.RANSAC, threshold_px)[0])


def _remove_duplicates(tables: list[Index]) -> list[Index]:
    return list(np.unique(np.stack(tables), axis=0)) if tables else []


def _count_seen(candidate: Index) -> int:
    return int((candidate >= 0).sum())


def _is_counter_clockwise(cells: Index, points: Float) -> bool:
    """Return whether the lattice, as numbered, is seen from the front: the second axis is a quarter turn
    counter-clockwise of the first, which is a negative cross product while y points down."""
    design = np.column_stack([cells, np.ones(len(cells))])
    first, second = np.linalg.lstsq(design, points, rcond=None)[0][:2]
    return bool(first[0] * second[1] - first[1] * second[0] < 0)


def _list_rotations(cells: Index, members: Index, target: Target, beyond: int = 0) -> list[Index]:
    tables: list[Index] = []
    for _ in range(4):
        tables += _list_windows(cells, members, target, beyond)
        cells = cells @ _QUARTER_TURN
    return tables


def _list_windows(cells: Index, members: Index, target: Target, beyond: int) -> list[Index]:
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


# What is printed on a target to show which way up it is: the odd marker, or the three with a hole.

_MOST_WRONG = 1
"""Of the markers of a placement, those with a hole that should have none or without one that should: glare in a disc
looks like a hole, dirt fills one. Another turn of the target has at least as many wrong as it puts marks elsewhere."""


def select_by_marks(placements: list[GridPlacement], candidates: Candidates, target: Target) -> list[GridPlacement]:
    """Keep the placements that the marks agree with, all when the target has none. Raises DetectionError when there are
    none, and says when a mirror image would agree."""
    if target.odd_marker is not None:
        return _select_by_odd_marker(placements, candidates, target, target.odd_marker)
    if target.donut_markers is not None:
        return _select_by_donuts(placements, candidates, target, target.donut_markers)
    return placements


def _select_by_odd_marker(
    placements: list[GridPlacement], candidates: Candidates, target: Target, odd: OddMarker
) -> list[GridPlacement]:
    """Keep the placements with a disc of the odd size in the odd marker's place."""
    tolerance = 0.5 * abs(np.log(odd.diameter_mm / target.diameter_mm))

    def agrees(placement: GridPlacement) -> bool:
        return bool(abs(np.log(_compute_odd_size_ratio(placement, candidates, target, odd))) < tolerance)

    fitting = [p for p in placements if agrees(p)]
    if fitting:
        return fitting
    mirrored = any(agrees(one) for p in placements for one in _mirror(p, target))
    raise _make_refusal(placements, target, f"odd marker {odd.number}", mirrored=mirrored)


def _select_by_donuts(
    placements: list[GridPlacement], candidates: Candidates, target: Target, donuts: DonutMarkers
) -> list[GridPlacement]:
    """Keep the placements whose holes are where they should be, with the fewest wrong ones."""
    wrong = [_count_wrong_holes(p, candidates, target) for p in placements]
    if min(wrong) <= _MOST_WRONG:
        return [p for p, number in zip(placements, wrong, strict=True) if number == min(wrong)]
    mirrored = min(
        (_count_wrong_holes(one, candidates, target) for p in placements for one in _mirror(p, target)),
        default=min(wrong),
    )
    name = "donut markers {}, {} and {}".format(*donuts.numbers)
    raise _make_refusal(placements, target, name, mirrored=mirrored <= _MOST_WRONG)


def _make_refusal(placements: list[GridPlacement], target: Target, marks: str, *, mirrored: bool) -> DetectionError:
    found = max(p.seen for p in placements)
    if mirrored:
        return DetectionError(
            f"the image of {target.name} is mirrored, by the place of its {marks}: turn mirroring off in the camera or "
            "the viewer",
            found,
        )
    return DetectionError(f"found {found} of {target.count} markers of {target.name}, but not the {marks}", found)


def _mirror(placement: GridPlacement, target: Target) -> list[GridPlacement]:
    """The placements of a mirrored target."""
    return [
        replace(placement, candidate=placement.candidate[places])
        for places, is_mirror in target.symmetries()
        if is_mirror
    ]


def _compute_odd_size_ratio(placement: GridPlacement, candidates: Candidates, target: Target, odd: OddMarker) -> float:
    """Diameter of the disc in the odd marker's place over the expected one; the other markers give the scale."""
    seen, index = placement.candidate >= 0, odd.number - 1
    if not seen[index]:
        return float("inf")
    expected = target.diameters_mm() * np.sqrt(compute_area_scale(placement.homography, target.coordinates_mm()))
    size = np.sqrt(candidates.areas_px2[placement.candidate]) / expected
    return float(size[index] / np.median(size[seen]))


def _count_wrong_holes(placement: GridPlacement, candidates: Candidates, target: Target) -> int:
    """Return how many markers have a hole that should have none, or none that should have one; marks that are not seen
    count as well."""
    seen, donut = placement.candidate >= 0, target.is_donut()
    hollow: NDArray[np.bool_] = candidates.hollow[placement.candidate] > 0.5 * target.hole_part
    return int(np.count_nonzero((hollow != donut)[seen])) + int(np.count_nonzero(donut & ~seen))


__all__ = [
    "DetectionError",
    "Identified",
    "predict_px",
    "fit_homography",
    "identify",
    "compute_pitch_px",
    "project",
    "compute_roll_deg",
]

# Another placement within this factor of the best is a refusal, not a guess: of ten rendered scenes with clutter two
# were refused and none was wrong.
_AMBIGUOUS_RESIDUAL = 1.5
_AMBIGUOUS_ROLL_DEG = 30.0  # turns that differ by less are refused; round number, nothing was measured
_TRACKED_PITCH = 0.5  # beyond it another marker is nearer
_MOST_SPOTS, _MOST_SPOTS_PER_MARKER = 2000, 20
"""Among more spots that look like markers nothing is looked for: the time grows with their number."""
_LARGEST_LATTICE = 4
"""In a lattice of more than so many times its markers the target fits in hundreds of places."""


@dataclass(frozen=True, slots=True, eq=False)
class Identified:
    """candidate: (N,) the candidate that is each marker, -1 for none. homography: (3, 3), target mm -> px."""

    candidate: Index
    homography: Float


def identify(
    candidates: Candidates, target: Target, previous: Float | None = None, shape: tuple[int, int] | None = None
) -> Identified:
    """The markers among the candidates; `previous` is the homography of the frame before, `shape` the image's (height,
    width), which says what may be beyond it.

    Raises DetectionError with the reason when there are too few or more than one reading is possible.
    """
    points = candidates.centres_px
    if len(points) > max(_MOST_SPOTS, _MOST_SPOTS_PER_MARKER * target.count):
        raise _make_too_many_error(f"{len(points)} round spots", target)
    lattice = grow_largest_lattice(points, target.count)
    if len(lattice) < LEAST_SEEN:
        raise _make_too_few_error(len(lattice), target)
    if len(lattice) > _LARGEST_LATTICE * target.count:
        raise _make_too_many_error(f"a grid of {len(lattice)} spots", target)
    possible = find_placements(lattice, points, target)
    _require(max((p.seen for p in possible), default=0), target)
    possible = select_by_marks(possible, candidates, target)
    possible = _select_near_previous(possible, points, target, previous)
    chosen = _select_by_roll(_select_by_residual(possible, target, shape), target, previous)
    return _drop_clutter(chosen, points, target)


def _require(found: int, target: Target) -> None:
    if found < target.least_markers:
        raise _make_too_few_error(found, target)


def _make_too_many_error(what: str, target: Target) -> DetectionError:
    return DetectionError(
        f"found {what} where {target.name} has {target.count} markers: is it another target? If not, cut it out of the "
        "image"
    )


def _make_too_few_error(found: int, target: Target) -> DetectionError:
    return DetectionError(
        f"found {found} of {target.count} markers of {target.name}: {target.least_markers} are needed", found
    )


def _select_near_previous(
    placements: list[GridPlacement], points: Float, target: Target, previous: Float | None
) -> list[GridPlacement]:
    """Keep the placements within half a pitch of where the frame before had the markers; all when none is."""
    if previous is None:
        return placements
    expected = project(previous, target.coordinates_mm())
    limit = _TRACKED_PITCH * compute_pitch_px(previous, target)
    near = [p for p in placements if _compute_rms_distance(p, points, expected) < limit]
    return near or placements


def _compute_rms_distance(placement: GridPlacement, points: Float, expected: Float) -> float:
    seen = placement.candidate >= 0
    return float(np.sqrt(np.mean(np.sum((points[placement.candidate[seen]] - expected[seen]) ** 2, axis=1))))


def _select_by_residual(
    placements: list[GridPlacement], target: Target, shape: tuple[int, int] | None
) -> list[GridPlacement]:
    """The rotations of the best-fitting window; refuses when another window fits nearly as well."""
    placements = _select_cut_by_frame(placements, target, shape) or placements
    best = min(placements, key=lambda p: p.residual_px)
    same = [p for p in placements if _is_same_window(p, best, target)]
    others = [p for p in placements if not _is_same_window(p, best, target)]
    if any(p.residual_px < _AMBIGUOUS_RESIDUAL * best.residual_px for p in others):
        found = best.seen
        raise DetectionError(
            f"found {found} of {target.count} markers of {target.name}, but they fit in more than one place of the "
            "grid",
            found,
        )
    return same


def _select_cut_by_frame(
    placements: list[GridPlacement], target: Target, shape: tuple[int, int] | None
) -> list[GridPlacement]:
    """Keep the placements with missing markers, all of which are cut by the image's border or beyond it; none when one
    has all."""
    if shape is None or any(p.seen == target.count for p in placements):
        return []
    limits = np.array(shape[::-1]) - 1
    chosen: list[GridPlacement] = []
    for placement in placements:
        missing = placement.candidate < 0
        places = target.coordinates_mm()[missing]
        radii = target.diameters_mm()[missing] / 2 * np.sqrt(compute_area_scale(placement.homography, places))
        centres = project(placement.homography, places)
        if np.all(np.any((centres < radii[:, None]) | (centres > limits - radii[:, None]), axis=1)):
            chosen.append(placement)
    return chosen


def _is_same_window(one: GridPlacement, other: GridPlacement, target: Target) -> bool:
    """Return whether two placements cover the same part of the image, however rotated: their corners coincide."""
    columns, rows = target.columns, target.rows
    corners = target.nominal_mm()[[0, columns - 1, columns * (rows - 1), columns * rows - 1]]
    first, second = project(one.homography, corners), project(other.homography, corners)
    away = np.linalg.norm(first[:, None] - second[None], axis=2).min(axis=1)
    # Half way to a window that is shifted by half a marker. Round number; nothing was measured.
    return bool(away.max() < 0.25 * compute_pitch_px(one.homography, target))


def _select_by_roll(placements: list[GridPlacement], target: Target, previous: Float | None) -> GridPlacement:
    """The rotation nearest to the expected one; refuses when a second is about as near, or agrees with the marks."""
    if len(placements) > 1 and target.donut_markers is not None:
        raise DetectionError(f"too few of the donut markers of {target.name} are seen", placements[0].seen)
    expected = target.nominal_roll_deg if previous is None else compute_roll_deg(previous, target)
    turns = [abs((compute_roll_deg(p.homography, target) - expected + 180) % 360 - 180) for p in placements]
    order = np.argsort(turns)
    best = placements[order[0]]
    if len(order) > 1 and turns[order[1]] - turns[order[0]] < _AMBIGUOUS_ROLL_DEG:
        raise DetectionError(
            f"the {target.columns}x{target.rows} grid of {target.name} is ambiguous at roll "
            f"{compute_roll_deg(best.homography, target):.0f} deg: give nominal_roll_deg in the target file",
            best.seen,
        )
    return best


def _drop_clutter(chosen: GridPlacement, points: Float, target: Target) -> Identified:
    """Drop what lies off the place that the others give it: clutter in line with the grid."""
    candidate = settle_table(chosen.candidate, points, KDTree(points), target)
    kept = candidate >= 0
    _require(int(kept.sum()), target)
    return Identified(candidate, fit_homography(target.coordinates_mm()[kept], points[candidate[kept]]))
