"""OpenCV's calibration: the start of the bundle adjustment, and the peer it is measured against.

`calibrateCamera` takes the board as exact and gives every view a free pose; it knows nothing of the table.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from thermostand.compensation.calibration.least_squares import Float
from thermostand.compensation.calibration.pinhole import Pinhole
from thermostand.foundation.errors import CalibrationError

_CRITERIA = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 200, 1e-12)


@dataclass(frozen=True, slots=True, eq=False)
class OpencvCalibration:
    """lens, and the pose of each view: rotations (P, 3, 3) and translations (P, 3), mm. rms_px: over both coordinates,
    sqrt(mean(dx^2 + dy^2)), as OpenCV counts."""

    lens: Pinhole
    rotations: Float
    translations_mm: Float
    rms_px: float


def calibrate_opencv(centres_px: Float, points_mm: Float, image_size: tuple[int, int]) -> OpencvCalibration:
    """Calibrate from centres (P, N, 2), NaN where missing, of board points (N, 3), of which Z is taken as 0.

    CalibrationError when OpenCV finds no camera.
    """
    plane = np.column_stack([points_mm[:, :2], np.zeros(len(points_mm))])
    seen = np.isfinite(centres_px[:, :, 0])
    objects = [plane[view].astype(np.float32) for view in seen]
    images = [centres[view].astype(np.float32) for centres, view in zip(centres_px, seen, strict=True)]
    try:
        rms, matrix, distortion, turns, shifts = cv2.calibrateCamera(
            objects, images, image_size, np.eye(3), np.zeros(5), criteria=_CRITERIA
        )
    except cv2.error as error:
        raise CalibrationError(f"OpenCV finds no camera for these {len(images)} views ({error.err})") from error
    if not np.isfinite(rms):
        raise CalibrationError("OpenCV finds no camera: its fit does not converge")
    frame = [matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]]
    lens = Pinhole(np.concatenate([frame, np.ravel(distortion)[:5]]), image_size)
    rotations = Rotation.from_rotvec(np.array(turns, np.float64).reshape(-1, 3)).as_matrix()
    return OpencvCalibration(lens, rotations, np.array(shifts, np.float64).reshape(-1, 3), float(rms))
