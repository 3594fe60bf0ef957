"""The pinhole camera with the lens distortion OpenCV and its relatives share.

    x = X/Z, y = Y/Z, r^2 = x^2 + y^2, g = (1 + k1 r^2 + k2 r^4 + k3 r^6) / (1 + k4 r^2 + k5 r^4 + k6 r^6)
    u = fx (x g + 2 p1 x y + p2 (r^2 + 2 x^2)) + cx
    v = fy (y g + p1 (r^2 + 2 y^2) + 2 p2 x y) + cy

Camera frame: x right, y down, z forward, mm. Pixels: integers are pixel centres.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from thermostand.compensation.calibration.least_squares import Float
from thermostand.foundation.errors import CalibrationError


def make_cross_matrices(vectors: Float) -> Float:
    """Matrices (..., 3, 3) that multiply by `vectors` x from the left."""
    matrices = np.zeros((*vectors.shape, 3))
    for row, column, axis in ((2, 1, 0), (0, 2, 1), (1, 0, 2)):
        matrices[..., row, column] = vectors[..., axis]
        matrices[..., column, row] = -vectors[..., axis]
    return matrices


def transform_points(rotations: Float, translations_mm: Float, points_mm: Float) -> Float:
    """(P, N, 3): points (N, 3) at poses (P, 3, 3) and (P, 3), in the camera's frame, mm."""
    return np.einsum("pij,nj->pni", rotations, points_mm) + translations_mm[:, None]


def find_perpendiculars(axis: Float) -> Float:
    """(3, 2): unit vectors at right angles to a unit vector (3,) and each other, steady when it turns a little."""
    coordinate = np.eye(3)[np.argmin(np.abs(axis))]
    first = coordinate - axis * (axis @ coordinate)
    first = first / np.linalg.norm(first)
    return np.column_stack([first, make_cross_matrices(axis) @ first])


# OpenCV's guess is refined by our own fit; not measured.
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


NAMES = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
"""The order of a camera's vector: that of OpenCV and mrcal."""

_UNDISTORTIONS, _UNDISTORTED = 30, 1e-14  # a bound, and a change far below any marker's noise


@dataclass(frozen=True, slots=True, eq=False)
class Pinhole:
    """vector: the first 9 (Brown) or all 12 (rational) of NAMES, px for the first four. image_size: (width, height)."""

    vector: Float
    image_size: tuple[int, int]

    @property
    def focal_px(self) -> Float:
        """(fx, fy)."""
        return self.vector[:2]

    @property
    def distortion(self) -> Float:
        """k1 k2 p1 p2 k3, for the rational model also k4 k5 k6: the order of OpenCV."""
        return self.vector[4:]

    @property
    def matrix(self) -> Float:
        """The camera matrix (3, 3)."""
        fx, fy, cx, cy = self.vector[:4]
        return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])

    def apply_step(self, change: Float) -> Pinhole:
        """The camera with `change` added to its vector."""
        return replace(self, vector=self.vector + change)

    def project(self, points_mm: Float) -> Float:
        """Images (..., 2), px, of points (..., 3) of the camera frame."""
        return _distort(points_mm[..., :2] / points_mm[..., 2:], self.distortion) * self.focal_px + self.vector[2:4]

    def compute_slopes(self, pixels: Float) -> Float:
        """(..., 2): X/Z and Y/Z of the rays that are seen at `pixels` (..., 2); NaN where the lens folds over."""
        wanted = (pixels - self.vector[2:4]) / self.focal_px
        slopes = wanted.copy()
        for _ in range(_UNDISTORTIONS):
            off = wanted - _distort(slopes, self.distortion)
            if np.abs(off).max(initial=0.0) < _UNDISTORTED:
                break
            slopes = (
                slopes + np.linalg.solve(_compute_distortion_jacobian(slopes, self.distortion), off[..., None])[..., 0]
            )
        off = np.abs(wanted - _distort(slopes, self.distortion)).max(axis=-1)
        above, below, _ = _compute_radial_factor(np.sum(slopes**2, axis=-1), self.distortion)
        upright = (above / below > 0) & (np.linalg.det(_compute_distortion_jacobian(slopes, self.distortion)) > 0)
        return np.where(((off < 1e-10) & upright)[..., None], slopes, np.nan)

    def compute_misfit(self, points_mm: Float, pixels: Float) -> Float:
        """Return where points (..., 3) are seen, minus where they should be, px."""
        return self.project(points_mm) - pixels

    def compute_point_jacobian(self, points_mm: Float, pixels: Float) -> Float:
        """Derivative (..., 2, 3) of the misfit with respect to the points, px/mm."""
        slopes = points_mm[..., :2] / points_mm[..., 2:]
        bend = self.focal_px[:, None] * _compute_distortion_jacobian(slopes, self.distortion)
        return np.concatenate([bend, -bend @ slopes[..., None]], axis=-1) / points_mm[..., None, 2:]

    def compute_vector_jacobian(self, points_mm: Float) -> Float:
        """Derivative (..., 2, 9 or 12) of the projection with respect to the camera's vector."""
        slopes = points_mm[..., :2] / points_mm[..., 2:]
        lens = _compute_coefficient_jacobian(slopes, self.distortion) * self.focal_px[:, None]
        distorted = _distort(slopes, self.distortion)
        frame = np.zeros((*slopes.shape, 4))
        frame[..., 0, 0], frame[..., 1, 1] = distorted[..., 0], distorted[..., 1]
        frame[..., 0, 2] = frame[..., 1, 3] = 1.0
        return np.concatenate([frame, lens], axis=-1)


def _compute_radial_factor(square: Float, distortion: Float) -> tuple[Float, Float, Float]:
    """Numerator, denominator and g'(r^2) of the radial factor."""
    k1, k2, _, _, k3 = distortion[:5]
    k4, k5, k6 = distortion[5:] if len(distortion) > 5 else (0.0, 0.0, 0.0)
    above = 1 + square * (k1 + square * (k2 + square * k3))
    below = 1 + square * (k4 + square * (k5 + square * k6))
    above_slope = k1 + square * (2 * k2 + 3 * square * k3)
    below_slope = k4 + square * (2 * k5 + 3 * square * k6)
    return above, below, (above_slope * below - above * below_slope) / below**2


def _distort(slopes: Float, distortion: Float) -> Float:
    x, y = slopes[..., 0], slopes[..., 1]
    p1, p2 = distortion[2:4]
    square = x**2 + y**2
    above, below, _ = _compute_radial_factor(square, distortion)
    gain = above / below
    distorted = np.empty_like(slopes)
    distorted[..., 0] = x * gain + 2 * p1 * x * y + p2 * (square + 2 * x**2)
    distorted[..., 1] = y * gain + p1 * (square + 2 * y**2) + 2 * p2 * x * y
    return distorted


def _compute_distortion_jacobian(slopes: Float, distortion: Float) -> Float:
    """Derivative (..., 2, 2) of the distorted with respect to the ideal slopes."""
    x, y = slopes[..., 0], slopes[..., 1]
    p1, p2 = distortion[2:4]
    above, below, gain_slope = _compute_radial_factor(x**2 + y**2, distortion)
    gain = above / below
    bend = np.empty((*slopes.shape, 2))
    bend[..., 0, 0] = gain + 2 * x**2 * gain_slope + 2 * p1 * y + 6 * p2 * x
    bend[..., 0, 1] = bend[..., 1, 0] = 2 * x * y * gain_slope + 2 * p1 * x + 2 * p2 * y
    bend[..., 1, 1] = gain + 2 * y**2 * gain_slope + 6 * p1 * y + 2 * p2 * x
    return bend


def _compute_coefficient_jacobian(slopes: Float, distortion: Float) -> Float:
    """Derivative (..., 2, 5 or 8) of the distorted slopes with respect to the distortion."""
    x, y = np.moveaxis(slopes, -1, 0)
    square = x**2 + y**2
    above, below, _ = _compute_radial_factor(square, distortion)
    powers = [square, square**2, square**3]
    radial = [power / below for power in powers]
    tangential = [
        np.stack([2 * x * y, square + 2 * y**2], axis=-1),
        np.stack([square + 2 * x**2, 2 * x * y], axis=-1),
    ]
    columns = [slopes * radial[0][..., None], slopes * radial[1][..., None], *tangential, slopes * radial[2][..., None]]
    if len(distortion) > 5:
        columns += [slopes * (-above / below**2 * power)[..., None] for power in powers]
    return np.stack(columns, axis=-1)
