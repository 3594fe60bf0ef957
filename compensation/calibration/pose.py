"""Where a target is in the frame of a calibrated camera, with the uncertainty the markers' covariances imply.

pose = find_pose(lens, board, detection.centres_px, detection.covariance_px2)
pose.translation_mm, pose.covariance_of([120, 75, 0])
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from thermostand.compensation.calibration.board import Board, compute_camera_shifts
from thermostand.compensation.calibration.least_squares import Float, compute_whiteners, make_equations, minimise
from thermostand.compensation.calibration.pinhole import make_cross_matrices
from thermostand.foundation.errors import CalibrationError

_LEAST_MARKERS = 4  # eight numbers for the six of a pose


class Lens(Protocol):
    """A calibrated camera: the pinhole, or the ray model. Points are (..., 3) mm in its frame, pixels (..., 2)."""

    def project(self, points_mm: Float) -> Float:
        """Images (..., 2), px."""
        ...

    def compute_slopes(self, pixels: Float) -> Float:
        """X/Z and Y/Z (..., 2) of what is seen there; of lines that do not meet in a point, at their mean distance."""
        ...

    def compute_misfit(self, points_mm: Float, pixels: Float) -> Float:
        """(..., 2): how far points are from the lines of sight of pixels, expressed in px."""
        ...

    def compute_point_jacobian(self, points_mm: Float, pixels: Float) -> Float:
        """Derivative (..., 2, 3) of the misfit with respect to the points, px/mm."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class Pose:
    """p = rotation X + translation_mm of target points X, in the camera's frame.

    covariance (6, 6): of a small rotation (rad, applied from the left, about the camera frame's axes) and of the
    translation (mm); from the markers' noise alone. residuals_px (N, 2): NaN where no marker was used. chi: root mean
    square of the whitened residuals per degree of freedom; 1 when noise explains them.
    """

    rotation: Float
    translation_mm: Float
    covariance: Float
    residuals_px: Float
    chi: float

    def locate_point_mm(self, point_mm: Float) -> Float:
        """Return where a point (3,) of the target is in the camera's frame, mm."""
        return self.rotation @ point_mm + self.translation_mm

    def compute_covariance(self, point_mm: Float) -> Float:
        """Covariance (3, 3), mm^2, of that place."""
        slopes = np.hstack([-make_cross_matrices(self.rotation @ point_mm), np.eye(3)])
        return slopes @ self.covariance @ slopes.T


@dataclass(frozen=True, slots=True, eq=False)
class _RigidMotion:
    rotation: Float
    translation_mm: Float


@dataclass(frozen=True, slots=True, eq=False)
class _RefinedPose:
    placed: _RigidMotion
    covariance: Float
    cost: float
    residuals_px: Float


def find_pose(lens: Lens, board: Board, centres_px: Float, covariance_px2: Float) -> Pose:
    """The target's pose from the ellipses' centres (N, 2) and covariances (N, 2, 2), NaN where a marker is missing.

    Least squares of the whitened distances from markers to their lines of sight; the eccentricity of the discs'
    images is taken out. CalibrationError with fewer than four markers or without a solution.
    """
    seen = np.isfinite(centres_px[:, 0])
    if np.count_nonzero(seen) < _LEAST_MARKERS:
        raise CalibrationError(f"{np.count_nonzero(seen)} markers give no pose; {_LEAST_MARKERS} are needed")
    points, diameters = board.points_mm[seen], board.diameters_mm[seen]
    whitener = compute_whiteners(covariance_px2[seen])
    measured = centres_px[seen]
    placed = _find_start(lens, points, measured)
    first = _refine(lens, points, measured, diameters, whitener, placed)
    refined = _refine(lens, points, measured, diameters, whitener, first.placed)
    residuals = np.full(centres_px.shape, np.nan)
    residuals[seen] = refined.residuals_px
    chi = float(np.sqrt(refined.cost / max(1, 2 * len(points) - 6)))
    return Pose(refined.placed.rotation, refined.placed.translation_mm, refined.covariance, residuals, chi)


def _refine(
    lens: Lens, points_mm: Float, measured_px: Float, diameters_mm: Float, whitener: Float, start: _RigidMotion
) -> _RefinedPose:
    """The pose of least squares, with the eccentricity that the discs have at the start."""
    pixels = measured_px - compute_camera_shifts(
        lens.project, start.rotation, start.translation_mm, points_mm, diameters_mm
    )

    def residuals(placed: _RigidMotion) -> Float:
        off = lens.compute_misfit(_transform_points(placed, points_mm), pixels)
        return np.einsum("nij,nj->ni", whitener, off).ravel()

    def jacobian(placed: _RigidMotion) -> Float:
        swing = -make_cross_matrices(points_mm @ placed.rotation.T)
        moves = np.concatenate([swing, np.broadcast_to(np.eye(3), swing.shape)], axis=2)
        slopes = lens.compute_point_jacobian(_transform_points(placed, points_mm), pixels)
        return (whitener @ slopes @ moves).reshape(-1, 6)

    def stepped(placed: _RigidMotion, change: Float) -> _RigidMotion:
        return _RigidMotion(
            Rotation.from_rotvec(change[:3]).as_matrix() @ placed.rotation, placed.translation_mm + change[3:]
        )

    solution = minimise(start, residuals, make_equations(jacobian), stepped)
    off = lens.compute_misfit(_transform_points(solution.state, points_mm), pixels)
    return _RefinedPose(solution.state, solution.covariance, solution.cost, off)


def _transform_points(placed: _RigidMotion, points_mm: Float) -> Float:
    return points_mm @ placed.rotation.T + placed.translation_mm


def _find_start(lens: Lens, points_mm: Float, pixels: Float) -> _RigidMotion:
    """The better of the two poses a plane has in an ideal camera."""
    slopes = lens.compute_slopes(pixels)
    if not np.isfinite(slopes).all():
        raise CalibrationError("the camera is not calibrated where some of the markers are")
    plane = np.column_stack([points_mm[:, :2], np.zeros(len(points_mm))])
    found, turns, shifts, _ = cv2.solvePnPGeneric(plane, slopes, np.eye(3), np.zeros(4), flags=cv2.SOLVEPNP_IPPE)
    if not found:
        raise CalibrationError("the markers give no pose")
    rotation = Rotation.from_rotvec(np.ravel(turns[0])).as_matrix()
    return _RigidMotion(rotation, np.ravel(shifts[0]).astype(np.float64))
