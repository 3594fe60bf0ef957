"""The first frame: where something like a round marker may be, without knowing anything but the target.

A local threshold half way between the darkest and the lightest of the surroundings, then connected components that
look like filled ellipses. Accuracy is a few tenths of a pixel; edge_fit.py does the rest.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from thermostand.markers.noise import Image, find_full_scale_DN
from thermostand.markers.target import Target

_CELLS_PER_DISC = 9.5
"""The surroundings are looked at on a coarse grid with about this many cells across the largest disc."""
# Rendered targets with a contrast of 40 of 255 DN are found in ten of ten poses, so that twice as much would still do.
_LEAST_CONTRAST = 15 / 255
_LEAST_SIDE_PX = 4  # of a disc; 15 px found nothing in images of 640 x 480 with dots of 8 to 10
_ENOUGH_PX = 12
"""Across the smallest disc that is looked for: images with more are reduced, which takes a fifth of the time."""
# A disc at a slant of 72 degrees. Clutter that passes costs time only, since no lattice takes it.
_GREATEST_ASPECT = 3.2
_ROWS = 512  # so that arrays of floats of a large image are not held whole
# A spot's area is within this factor of the median of its neighbours; from rendered scenes with clutter.
_NEIGHBOUR_AREA_RATIO = 1.6

Float = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Candidates:
    """centres_px: (K, 2) (x, y); areas_px2: (K,), holes included; hollow: (K,), which part of it is a hole, looked for
    in targets with donut markers only. Unordered, with clutter and gaps."""

    centres_px: Float
    areas_px2: Float
    hollow: Float

    def __len__(self) -> int:
        return len(self.areas_px2)


def iterate_disc_sizes_px(target: Target, shape: tuple[int, int]) -> Iterator[float]:
    """Largest diameters a usual disc may have in the image, to be tried in turn: first that of a target which fills
    the frame, then halves of it down to the smallest discs that can be found.
    """
    height, width = shape
    shortest, longest = np.sort(np.ptp(target.nominal_mm(), axis=0)) / target.diameter_mm + 1
    size = 1.25 * float(max(min(width / longest, height / shortest), min(height / longest, width / shortest)))
    while size > 1.5 * _LEAST_SIDE_PX:
        yield size
        size /= 2


def find_candidates(image: Image, target: Target, size_px: float) -> Candidates:
    """Ellipses between about a quarter of `size_px` and `size_px` across; an odd marker may be larger or smaller."""
    odd = target.odd_marker.diameter_mm / target.diameter_mm if target.odd_marker else 1.0
    largest, smallest = size_px * max(odd, 1.0), max(size_px / 4 * min(odd, 1.0), _LEAST_SIDE_PX)
    factor = max(1, int(smallest / _ENOUGH_PX))
    coarse = _reduce(image, factor)
    dark = coarse if target.polarity == "dark" else ~coarse
    inside = _threshold_dark(dark, largest / factor, find_full_scale_DN(image))
    found = _find_ellipses(inside, smallest / factor, largest / factor, target.hole_part)
    # Pixel k of the coarse image covers k factor - 0.5 .. (k + 1) factor - 0.5 of the image.
    centres_px = (found.centres_px + 0.5) * factor - 0.5
    return _filter_by_neighbours(Candidates(centres_px, found.areas_px2 * factor**2, found.hollow), odd**2)


def _reduce(image: Image, factor: int) -> Image:
    """Means over factor x factor pixels; what does not fill a whole one at the right and bottom is left out."""
    if factor == 1:
        return image
    height, width = (side // factor for side in image.shape)
    whole = image[: height * factor, : width * factor]
    return cv2.resize(whole, (width, height), interpolation=cv2.INTER_AREA)  # pyright: ignore[reportReturnType] - type kept


def _threshold_dark(image: Image, largest_px: float, full_scale: int) -> NDArray[np.uint8]:
    """255 where a pixel is darker than the middle between the extremes around it, 0 elsewhere and where nothing is."""
    factor = max(1, round(largest_px / _CELLS_PER_DISC))
    height, width = image.shape
    coarse = cv2.resize(image, (-(-width // factor), -(-height // factor)), interpolation=cv2.INTER_AREA)
    coarse = cv2.GaussianBlur(coarse, (3, 3), 0)
    window = 2 * round(largest_px / factor) + 1
    box = cv2.getStructuringElement(cv2.MORPH_RECT, (window, window))
    smooth = (window // 2 | 1, window // 2 | 1)
    top = cv2.blur(cv2.dilate(coarse, box).astype(np.float32), smooth)
    bottom = cv2.blur(cv2.erode(coarse, box).astype(np.float32), smooth)
    middle = np.empty(top.shape, image.dtype)
    for row in range(0, len(top), _ROWS):  # of 70 megapixels each array of floats is 280 MB
        high, low = top[row : row + _ROWS], bottom[row : row + _ROWS]
        middle[row : row + _ROWS] = np.where(high - low < _LEAST_CONTRAST * full_scale, 0, (high + low) / 2)
    del top, bottom
    threshold = cv2.resize(middle, (width, height), interpolation=cv2.INTER_LINEAR)
    return np.asarray(cv2.compare(image, threshold, cv2.CMP_LT), dtype=np.uint8)


def _find_ellipses(inside: NDArray[np.uint8], smallest_px: float, largest_px: float, hole: float) -> Candidates:
    """The connected components whose area is that of the ellipse with their second moments. hole: the part of its area
    that a component may lack in its middle, 0 when none does."""
    # By blocks of 2 x 2 pixels: the same components in 2.5 ms instead of the default's 7.7.
    count, labels, stats, _ = cv2.connectedComponentsWithStatsWithAlgorithm(inside, 8, cv2.CV_32S, cv2.CCL_BBDT)
    short, long = np.minimum(stats[:, 2], stats[:, 3]), np.maximum(stats[:, 2], stats[:, 3])
    keep = (short >= smallest_px / 1.5) & (short >= _LEAST_SIDE_PX - 1) & (long <= 1.1 * largest_px + 1)
    keep &= (long <= _GREATEST_ASPECT * short) & (stats[:, 4] > 0.5 * (1 - hole) * short * long)
    keep[0] = False
    rows: list[tuple[float, float, float, float]] = []
    for label in np.arange(count)[keep]:
        left, top, width, height, seen = stats[label]
        patch = (labels[top : top + height, left : left + width] == label).astype(np.uint8)
        moments = cv2.moments(_fill_holes(patch) if hole else patch, True)
        area = moments["m00"]
        if _is_ellipse(moments, area):
            rows.append((left + moments["m10"] / area, top + moments["m01"] / area, area, 1 - seen / area))
    table = np.array(rows, dtype=np.float64).reshape(-1, 4)
    return Candidates(table[:, :2], table[:, 2], table[:, 3])


def _fill_holes(patch: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """The component without its holes."""
    outlines, _ = cv2.findContours(patch, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    return np.asarray(cv2.drawContours(np.zeros_like(patch), outlines, -1, [1], cv2.FILLED), np.uint8)


def _is_ellipse(moments: dict[str, float], area: float) -> bool:
    """Return whether area = 4 pi sqrt(det of the second central moments); few pixels make a rough outline, so small
    components are judged with more tolerance."""
    # 1/12: the variance within a pixel.
    xx, yy, xy = moments["mu20"] / area + 1 / 12, moments["mu02"] / area + 1 / 12, moments["mu11"] / area
    ellipse = 4 * np.pi * np.sqrt(max(xx * yy - xy * xy, 0.0))
    # From rendered scenes: 3 % alone is too strict below 10 px across, where the outline of a few pixels is rough.
    return bool(abs(area / ellipse - 1) < 0.03 + 1.5 / area)


def _filter_by_neighbours(found: Candidates, odd_area_ratio: float) -> Candidates:
    """Drop candidates whose area differs from the median of their 8 neighbours and from the odd marker's."""
    if len(found) < 9:
        return found
    nearest = np.asarray(KDTree(found.centres_px).query(found.centres_px, 9)[1], dtype=np.intp)[:, 1:]
    ratio = found.areas_px2 / np.median(found.areas_px2[nearest], axis=1)
    keep = np.abs(np.log(ratio)) < np.log(_NEIGHBOUR_AREA_RATIO)
    keep |= np.abs(np.log(ratio / odd_area_ratio)) < np.log(_NEIGHBOUR_AREA_RATIO)
    return Candidates(found.centres_px[keep], found.areas_px2[keep], found.hollow[keep])
