"""Which candidate is which marker: a lattice is grown through the candidates and laid over the target.

1. Growth: from a seed and two lattice vectors, breadth first; each step is predicted from the step before.
2. Placement: every way the target's cells can lie on the lattice; gaps that the growth left are filled. The smallest
   homography residual wins, not the largest count: clutter in line with the grid adds support, but does not fit. Where
   a side of the grid is beyond the frame, the window wins whose missing markers are all beyond it.
3. Orientation: the marks (marks.py), else the rotation nearest to the previous frame's, else to the nominal roll (0:
   the rows point to the right, marker 1 is bottom left). Never a guess: what stays open is refused.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from thermostand.foundation.errors import DetectionError
from thermostand.markers.bootstrap import Candidates
from thermostand.markers.lattice import largest_lattice
from thermostand.markers.marks import with_marks
from thermostand.markers.placement import LEAST_SEEN, GridPlacement, placements, settled
from thermostand.markers.plane import area_scale, expected_px, fit_homography, pitch_px, project, roll_deg
from thermostand.markers.target import Target

__all__ = [
    "DetectionError",
    "Identified",
    "expected_px",
    "fit_homography",
    "identify",
    "pitch_px",
    "project",
    "roll_deg",
]

_AMBIGUOUS_RESIDUAL = 1.5
_AMBIGUOUS_ROLL_DEG = 30.0
_TRACKED_PITCH = 0.5
_MOST_SPOTS, _MOST_SPOTS_PER_MARKER = 2000, 20
"""Among more spots that look like markers nothing is looked for: the time grows with their number."""
_LARGEST_LATTICE = 4
"""In a lattice of more than so many times its markers the target fits in hundreds of places."""

Float = NDArray[np.float64]
Index = NDArray[np.intp]


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
        raise _too_many(f"{len(points)} round spots", target)
    lattice = largest_lattice(points, target.count)
    if len(lattice) < LEAST_SEEN:
        raise _too_few(len(lattice), target)
    if len(lattice) > _LARGEST_LATTICE * target.count:
        raise _too_many(f"a grid of {len(lattice)} spots", target)
    possible = placements(lattice, points, target)
    _require(max((p.seen for p in possible), default=0), target)
    possible = with_marks(possible, candidates, target)
    possible = _near_previous(possible, points, target, previous)
    chosen = _by_roll(_by_residual(possible, target, shape), target, previous)
    return _checked(chosen, points, target)


def _require(found: int, target: Target) -> None:
    if found < target.least_markers:
        raise _too_few(found, target)


def _too_many(what: str, target: Target) -> DetectionError:
    return DetectionError(
        f"found {what} where {target.name} has {target.count} markers: is it another target? If not, cut it out of the "
        "image"
    )


def _too_few(found: int, target: Target) -> DetectionError:
    return DetectionError(
        f"found {found} of {target.count} markers of {target.name}: {target.least_markers} are needed", found
    )


def _near_previous(
    placements: list[GridPlacement], points: Float, target: Target, previous: Float | None
) -> list[GridPlacement]:
    """Those within half a pitch of where the frame before had the markers; all when there are none."""
    if previous is None:
        return placements
    expected = project(previous, target.coordinates_mm())
    limit = _TRACKED_PITCH * pitch_px(previous, target)
    near = [p for p in placements if _rms_distance(p, points, expected) < limit]
    return near or placements


def _rms_distance(placement: GridPlacement, points: Float, expected: Float) -> float:
    seen = placement.candidate >= 0
    return float(np.sqrt(np.mean(np.sum((points[placement.candidate[seen]] - expected[seen]) ** 2, axis=1))))


def _by_residual(placements: list[GridPlacement], target: Target, shape: tuple[int, int] | None) -> list[GridPlacement]:
    """The rotations of the best-fitting window; refuses when another window fits nearly as well."""
    placements = _beyond_the_frame(placements, target, shape) or placements
    best = min(placements, key=lambda p: p.residual_px)
    same = [p for p in placements if _same_window(p, best, target)]
    others = [p for p in placements if not _same_window(p, best, target)]
    if any(p.residual_px < _AMBIGUOUS_RESIDUAL * best.residual_px for p in others):
        found = best.seen
        raise DetectionError(
            f"found {found} of {target.count} markers of {target.name}, but they fit in more than one place of the "
            "grid",
            found,
        )
    return same


def _beyond_the_frame(
    placements: list[GridPlacement], target: Target, shape: tuple[int, int] | None
) -> list[GridPlacement]:
    """Those with missing markers, all of which are cut by the image's border or beyond it; none when one has all."""
    if shape is None or any(p.seen == target.count for p in placements):
        return []
    limits = np.array(shape[::-1]) - 1
    chosen: list[GridPlacement] = []
    for placement in placements:
        missing = placement.candidate < 0
        places = target.coordinates_mm()[missing]
        radii = target.diameters_mm()[missing] / 2 * np.sqrt(area_scale(placement.homography, places))
        centres = project(placement.homography, places)
        if np.all(np.any((centres < radii[:, None]) | (centres > limits - radii[:, None]), axis=1)):
            chosen.append(placement)
    return chosen


def _same_window(one: GridPlacement, other: GridPlacement, target: Target) -> bool:
    """Whether two placements cover the same part of the image, however rotated: their corners coincide."""
    columns, rows = target.columns, target.rows
    corners = target.nominal_mm()[[0, columns - 1, columns * (rows - 1), columns * rows - 1]]
    first, second = project(one.homography, corners), project(other.homography, corners)
    away = np.linalg.norm(first[:, None] - second[None], axis=2).min(axis=1)
    return bool(away.max() < 0.25 * pitch_px(one.homography, target))


def _by_roll(placements: list[GridPlacement], target: Target, previous: Float | None) -> GridPlacement:
    """The rotation nearest to the expected one; refuses when a second is about as near, or agrees with the marks."""
    if len(placements) > 1 and target.donut_markers is not None:
        raise DetectionError(f"too few of the donut markers of {target.name} are seen", placements[0].seen)
    expected = target.nominal_roll_deg if previous is None else roll_deg(previous, target)
    turns = [abs((roll_deg(p.homography, target) - expected + 180) % 360 - 180) for p in placements]
    order = np.argsort(turns)
    best = placements[order[0]]
    if len(order) > 1 and turns[order[1]] - turns[order[0]] < _AMBIGUOUS_ROLL_DEG:
        raise DetectionError(
            f"the {target.columns}x{target.rows} grid of {target.name} is ambiguous at roll "
            f"{roll_deg(best.homography, target):.0f} deg: give nominal_roll_deg in the target file",
            best.seen,
        )
    return best


def _checked(chosen: GridPlacement, points: Float, target: Target) -> Identified:
    """Without what lies off the place that the others give it: clutter in line with the grid."""
    candidate = settled(chosen.candidate, points, KDTree(points), target)
    kept = candidate >= 0
    _require(int(kept.sum()), target)
    return Identified(candidate, fit_homography(target.coordinates_mm()[kept], points[candidate[kept]]))
