"""Marker detection on fifteen real photographs of a printed target, beside OpenCV.

Webcam pictures of 640 x 480 with dots of 4 px radius (robot_cal_tools, Apache-2.0). Nobody knows where the dots truly
are: homography and quartic of one half of a picture's dots, alternately, predict the other half. An error is the root
mean square of one coordinate, less what the prediction's own uncertainty adds; it contains the sheet's, about 0.12 mm
of print and paper, which is 65 mpx here and the same for everybody.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from tests.bench.figures import Figure, compare, make_absolute, make_skipped, report_progress, set_upper_ratio_goal
from thermostand.markers.detection import NARROW_SIGMA, WIDE_SIGMA, Detection, Image, detect
from thermostand.markers.image_file import read_image
from thermostand.markers.target import Target, load_target
from thermostand.stand.config.stand_config import find_packaged

Float = NDArray[np.float64]

IMAGES = Path(__file__).parents[3] / "shared" / "data" / "robot_cal_tools_10x10" / "images"
COUNT = 15
_DEGREE = 4
_MOST_GAIN = 1.5
"""Beyond it a dot lies outside those that predict it."""
_BEST_BAND = 1.05


def figures(directory: Path) -> list[Figure]:
    """Held-out errors beside OpenCV and beside other bands, and chi^2 of the claimed covariances."""
    paths = [IMAGES / f"{number}.png" for number in range(COUNT)]
    if not all(path.exists() for path in paths):
        return [make_skipped("photographs, held-out dots", "they are not here")]
    report_progress("markers, photographs")
    target = load_target(find_packaged("targets", "robot-cal-tools-10x10"))
    images = [read_image(path) for path in paths]
    found = [detect(image, target) for image in images]
    centres = [detection.centres_px for detection in found]
    ours_mpx = _error_mpx(centres, target)
    grids = [_find_opencv_centres(image, detection, target) for image, detection in zip(images, found, strict=True)]
    lines = [set_upper_ratio_goal(1.05, _compare("cv2.findCirclesGrid", ours_mpx, _error_mpx(grids, target)))]
    for name, band_sigma in (("9 blurs", WIDE_SIGMA), ("6 blurs", 6.0), ("4.5 blurs", NARROW_SIGMA)):
        fixed = [_in_band(image, target, one, band_sigma) for image, one in zip(images, found, strict=True)]
        lines.append(
            set_upper_ratio_goal(_BEST_BAND, _compare(f"a band of {name}", ours_mpx, _error_mpx(fixed, target)))
        )
    chi2 = np.concatenate([_squares(one.centres_px, target, one.covariance_px2) for one in found])
    return [
        *lines,
        make_absolute("photographs, chi^2 of held-out dots, the sheet's errors with it", "", [float(chi2.mean())]),
    ]


def _compare(peer: str, ours_mpx: float, other_mpx: float) -> Figure:
    return compare("photographs, held-out dots", "mpx RMS", peer, [ours_mpx], [other_mpx])


def _in_band(image: Image, target: Target, found: Detection, band_sigma: float) -> Float:
    """The centres as a frame after `found` has them in another band."""
    before = Detection(
        found.centres_px, found.covariance_px2, found.flags, found.chi, found.homography, found.state,
        found.growth, found.excess_px2, band_sigma, found.is_suspect,
    )  # fmt: skip
    return detect(image, target, before).centres_px


def _find_opencv_centres(image: Image, detection: Detection, target: Target) -> Float:
    """findCirclesGrid's centres in the order of the target's markers."""
    grid = cv2.findCirclesGrid(image, (target.columns, target.rows))[1].reshape(-1, 2).astype(np.float64)
    return grid[np.linalg.norm(detection.centres_px[:, None] - grid[None], axis=2).argmin(axis=1)]


def _error_mpx(centres: list[Float], target: Target) -> float:
    return 1e3 * float(np.sqrt(np.mean(np.concatenate([_squares(one, target) for one in centres]))))


def _squares(centres_px: Float, target: Target, covariance_px2: Float | None = None) -> Float:
    """Squared errors (K,) of the dots' coordinates as the other half of them predicts them; over their variances."""
    places = target.coordinates_mm()
    even = target.cells().sum(axis=1) % 2 == 0
    design = _monomials(places)
    squares: list[Float] = []
    for known, asked in ((even, ~even), (~even, even)):
        homography = cv2.findHomography(places[known], centres_px[known], 0)[0]
        mapped = np.column_stack([places, np.ones(len(places))]) @ homography.T
        straight = mapped[:, :2] / mapped[:, 2:]
        by_known = design[asked] @ np.linalg.pinv(design[known])
        gain2 = 1 + np.sum(by_known**2, axis=1)
        error = (centres_px - straight)[asked] - by_known @ (centres_px - straight)[known]
        square = error**2 / gain2[:, None]
        if covariance_px2 is not None:
            square /= np.diagonal(covariance_px2, axis1=1, axis2=2)[asked]
        squares.append(square[gain2 < _MOST_GAIN**2].ravel())
    return np.concatenate(squares)


def _monomials(places: Float) -> Float:
    low, high = places.min(axis=0), places.max(axis=0)
    x, y = ((2 * places - low - high) / (high - low)).T
    return np.stack([x**i * y**j for i in range(_DEGREE + 1) for j in range(_DEGREE + 1 - i)], axis=1)
