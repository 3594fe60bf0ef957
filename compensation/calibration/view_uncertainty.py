"""How well a calibration from views knows where a point is, in plain words: at a distance, in the middle, at a corner.

As in uncertainty.py, a point is held still among the board's poses: it moves with their mean when they are adjusted.
"""

from __future__ import annotations

import numpy as np

from compensation.calibration.least_squares import Float
from compensation.calibration.rotation import crosses
from compensation.calibration.views import POSE, ViewCalibration

COVERAGE = 2.0
"""k: an interval of two standard uncertainties holds 95 %."""


def projection_sigma_um(found: ViewCalibration, pixels: Float, distance_mm: float) -> Float:
    """Standard uncertainty (K,), um, across the line of sight, of points seen at pixels (K, 2) at Z = distance_mm: root
    mean square of both coordinates, the camera's part alone, without the noise of a new picture."""
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
    return 1e3 * np.sqrt(variance_px2) * distance_mm / float(lens.focal_px.mean())


def in_words(found: ViewCalibration, distance_mm: float) -> str:
    """`at 1000 mm a point is known to 3.1 um (k = 2) in the middle of the picture, to 9 um at its worst corner`."""
    width, height = found.scene.lens.image_size
    corners = [(0, 0), (width - 1, 0), (0, height - 1), (width - 1, height - 1)]
    pixels = np.array([((width - 1) / 2, (height - 1) / 2), *corners], np.float64)
    middle, *others = COVERAGE * projection_sigma_um(found, pixels, distance_mm)
    return (
        f"at {distance_mm:.0f} mm a point is known to {_two_digits(middle)} um (k = {COVERAGE:g}) "
        f"in the middle of the picture, to {_two_digits(max(others))} um at its worst corner, "
        "beside the noise of its own picture"
    )


def _two_digits(value_um: float) -> str:
    """3.1, 47, 960: never with an exponent."""
    return f"{float(f'{value_um:.2g}'):g}"
