"""What is printed on a target to show which way up it is: the odd marker, or the three with a hole."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from thermostand.foundation.errors import DetectionError
from thermostand.markers.bootstrap import Candidates
from thermostand.markers.placement import GridPlacement
from thermostand.markers.plane import area_scale
from thermostand.markers.target import DonutMarkers, OddMarker, Target

_MOST_WRONG = 1
"""Of the markers of a placement, those with a hole that should have none or without one that should: glare in a disc
looks like a hole, dirt fills one. Another turn of the target has at least as many wrong as it puts marks elsewhere."""


def with_marks(placements: list[GridPlacement], candidates: Candidates, target: Target) -> list[GridPlacement]:
    """Those placements that the marks agree with, all when the target has none. Raises DetectionError when there are
    none, and says when a mirror image would agree."""
    if target.odd_marker is not None:
        return _with_odd_marker(placements, candidates, target, target.odd_marker)
    if target.donut_markers is not None:
        return _with_donuts(placements, candidates, target, target.donut_markers)
    return placements


def _with_odd_marker(
    placements: list[GridPlacement], candidates: Candidates, target: Target, odd: OddMarker
) -> list[GridPlacement]:
    """Those with a disc of the odd size in the odd marker's place."""
    tolerance = 0.5 * abs(np.log(odd.diameter_mm / target.diameter_mm))

    def agrees(placement: GridPlacement) -> bool:
        return bool(abs(np.log(_odd_size(placement, candidates, target, odd))) < tolerance)

    fitting = [p for p in placements if agrees(p)]
    if fitting:
        return fitting
    mirrored = any(agrees(one) for p in placements for one in _mirrored(p, target))
    raise _refusal(placements, target, f"odd marker {odd.number}", mirrored=mirrored)


def _with_donuts(
    placements: list[GridPlacement], candidates: Candidates, target: Target, donuts: DonutMarkers
) -> list[GridPlacement]:
    """Those whose holes are where they should be, with the fewest wrong ones."""
    wrong = [_wrong_holes(p, candidates, target) for p in placements]
    if min(wrong) <= _MOST_WRONG:
        return [p for p, number in zip(placements, wrong, strict=True) if number == min(wrong)]
    mirrored = min(
        (_wrong_holes(one, candidates, target) for p in placements for one in _mirrored(p, target)), default=min(wrong)
    )
    name = "donut markers {}, {} and {}".format(*donuts.numbers)
    raise _refusal(placements, target, name, mirrored=mirrored <= _MOST_WRONG)


def _refusal(placements: list[GridPlacement], target: Target, marks: str, *, mirrored: bool) -> DetectionError:
    found = max(p.seen for p in placements)
    if mirrored:
        return DetectionError(
            f"the image of {target.name} is mirrored, by the place of its {marks}: turn mirroring off in the camera or "
            "the viewer",
            found,
        )
    return DetectionError(f"found {found} of {target.count} markers of {target.name}, but not the {marks}", found)


def _mirrored(placement: GridPlacement, target: Target) -> list[GridPlacement]:
    """The placements of a mirrored target."""
    return [
        replace(placement, candidate=placement.candidate[places])
        for places, is_mirror in target.symmetries()
        if is_mirror
    ]


def _odd_size(placement: GridPlacement, candidates: Candidates, target: Target, odd: OddMarker) -> float:
    """Diameter of the disc in the odd marker's place over the expected one; the other markers give the scale."""
    seen, index = placement.candidate >= 0, odd.number - 1
    if not seen[index]:
        return float("inf")
    expected = target.diameters_mm() * np.sqrt(area_scale(placement.homography, target.coordinates_mm()))
    size = np.sqrt(candidates.areas_px2[placement.candidate]) / expected
    return float(size[index] / np.median(size[seen]))


def _wrong_holes(placement: GridPlacement, candidates: Candidates, target: Target) -> int:
    """How many markers have a hole that should have none, or none that should have one; marks that are not seen count
    as well."""
    seen, donut = placement.candidate >= 0, target.is_donut()
    hollow: NDArray[np.bool_] = candidates.hollow[placement.candidate] > 0.5 * target.hole_part
    return int(np.count_nonzero((hollow != donut)[seen])) + int(np.count_nonzero(donut & ~seen))
