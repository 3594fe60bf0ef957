"""How well a calibration from views knows where a point is, in plain words: at a distance, in the middle, at a corner.

As in uncertainty.py, a point is held still among the board's poses: it moves with their mean when they are adjusted.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from thermostand.compensation.calibration.least_squares import Float
from thermostand.compensation.calibration.rotation import crosses
from thermostand.compensation.calibration.seen_area import NOT_SEEN, seen
from thermostand.compensation.calibration.views import POSE, ViewCalibration

COVERAGE = 2.0
"""k: an interval of two standard uncertainties holds 95 %."""


def projection_sigma_um(found: ViewCalibration, pixels: Float, distance_mm: float) -> Float:
    """Standard uncertainty (K,), um, across the line of sight, of points seen at pixels (K, 2) at Z = distance_mm: root
    mean square of both coordinates, the camera's part alone, without the noise of a new picture; NaN where no marker
    was seen."""
    lens, scene = found.scene.lens, found.scene
    points = np.column_stack([lens.slopes(pixels), np.ones(len(pixels))]) * distance_mm
    by_point, count = lens.point_jacobian(points, pixels), len(scene.rotations)
    first = len(lens.vector)
    jacobian = np.zeros((len(pixels), 2, first + POSE * count))
    jacobian[:, :, :first] = lens.vector_jacobian(points)
    for view in range(count):
        arm = points - scene.translations_mm[view]
        begin = first + POSE * view
        jacobian[:, :, begin : begin + POSE] = np.concatenate([-by_point @ crosses(arm), by_point], axis=2) / count
    known = found.covariance[: jacobian.shape[2], : jacobian.shape[2]]
    variance_px2 = np.trace(jacobian @ known @ np.swapaxes(jacobian, 1, 2), axis1=1, axis2=2) / 2
    sigma_um = 1e3 * np.sqrt(variance_px2) * distance_mm / float(lens.focal_px.mean())
    return np.where(seen(pixels, found.hull_px), sigma_um, np.nan)


@dataclass(frozen=True, slots=True)
class Known:
    """Expanded uncertainties (k = 2), um, across the line of sight at distance_mm: in the middle of the picture, at its
    corners (top left and right, bottom left and right) and the largest where markers were seen. None: not seen there;
    not_seen says so, "" when all of these were."""

    distance_mm: float
    middle_um: float | None
    corners_um: tuple[float | None, ...]
    worst_seen_um: float
    not_seen: str

    @property
    def text(self) -> str:
        """`a point at 1000 mm is known to (k = 2): 3.1 um in the middle of the picture, 9 um at its worst corner`."""
        unseen = self.corners_um.count(None)
        middle = "not seen" if self.middle_um is None else _two_digits(self.middle_um)
        worst = "where it is worst among the markers" if unseen else "at its worst corner"
        corners = f"; {unseen} of its 4 corners: {self.not_seen}" if unseen else ""
        return (
            f"a point at {self.distance_mm:.0f} mm is known to (k = {COVERAGE:g}, without its own picture's noise): "
            f"{middle} in the middle of the picture, {_two_digits(self.worst_seen_um)} {worst}{corners}"
        )


def known(found: ViewCalibration, distance_mm: float) -> Known:
    """How well it knows points at Z = distance_mm."""
    width, height = found.scene.lens.image_size
    corners = [(0, 0), (width - 1, 0), (0, height - 1), (width - 1, height - 1)]
    pixels = np.array([((width - 1) / 2, (height - 1) / 2), *corners], np.float64)
    everywhere = np.concatenate([pixels, found.hull_px])
    sigma_um = COVERAGE * projection_sigma_um(found, everywhere, distance_mm)
    middle, *at_corners = [None if np.isnan(um) else float(um) for um in sigma_um[: len(pixels)]]
    not_seen = NOT_SEEN if None in (middle, *at_corners) else ""
    return Known(distance_mm, middle, tuple(at_corners), float(np.nanmax(sigma_um)), not_seen)


def _two_digits(value_um: float) -> str:
    """3.1 um, 47 um, 960 um: never with an exponent."""
    return f"{float(f'{value_um:.2g}'):g} um"
