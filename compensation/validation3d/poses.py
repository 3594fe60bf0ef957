"""Frames of one position -> where the target is in the camera's frame, and how uncertain the drift model leaves it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from thermostand.compensation.calibration.averages import MeanCentres
from thermostand.compensation.calibration.board import Board
from thermostand.compensation.calibration.least_squares import Float
from thermostand.compensation.calibration.pose import Lens, Pose, find_pose
from thermostand.compensation.calibration.rotation import crosses

_CORRELATED = 1 / 2
"""Of the image's width: over this distance errors of a drift model are taken to be alike."""


@dataclass(frozen=True, slots=True, eq=False)
class Doubts:
    """What is uncertain of centres besides their noise; None without a correction.

    model_px2 (N, 2, 2): covariance of the drift model's. errors_px (V, N, 2): of the stand's, V fields of one standard
    uncertainty each.
    """

    model_px2: Float | None = None
    errors_px: Float | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Found:
    """place_mm (3,): of the target's middle. rotation (3, 3). noise, model, stand (6, 6): covariances of a small
    rotation (rad) and of the place (mm) by the markers' noise, the drift model, the stand's correction. chi: of Pose.
    """

    place_mm: Float
    rotation: Float
    noise: Float
    model: Float
    stand: Float
    chi: float


def find(lens: Lens, board: Board, mean: MeanCentres, growth: float, doubts: Doubts, image_width_px: int) -> Found:
    """Pose from mean centres, their covariances times `growth`. CalibrationError when the markers give no pose."""
    covariance_px2 = mean.covariance_px2 * growth
    pose = find_pose(lens, board, mean.centres_px, covariance_px2)
    seen = np.isfinite(mean.centres_px[:, 0])
    pixels = mean.centres_px[seen]
    about_middle = _about(pose, middle_mm(board))
    gain = about_middle @ _gain(lens, board.points_mm[seen], pose, pixels, covariance_px2[seen])
    model, stand = np.zeros((6, 6)), np.zeros((6, 6))
    if doubts.model_px2 is not None:
        model = gain @ _field(pixels, doubts.model_px2[seen], _CORRELATED * image_width_px) @ gain.T
    if doubts.errors_px is not None:
        moved = doubts.errors_px[:, seen].reshape(len(doubts.errors_px), -1) @ gain.T
        stand = moved.T @ moved
    noise = about_middle @ pose.covariance @ about_middle.T
    return Found(pose.place_mm(middle_mm(board)), pose.rotation, noise, model, stand, pose.chi)


def middle_mm(board: Board) -> Float:
    """The middle (3,) of the target: of all its points the least dependent on its rotation."""
    return (board.points_mm.min(axis=0) + board.points_mm.max(axis=0)) / 2


def rotation_mrad(found: Found, reference: Found) -> Float:
    """The rotation vector (3,) from the reference's orientation, about the camera's axes."""
    return 1e3 * Rotation.from_matrix(found.rotation @ reference.rotation.T).as_rotvec()


def _about(pose: Pose, point_mm: Float) -> Float:
    """(6, 6): a pose's small rotation and translation -> the rotation and the shift of a point of the target."""
    found = np.eye(6)
    found[3:, :3] = -crosses(pose.rotation @ point_mm)
    return found


def _gain(lens: Lens, points_mm: Float, pose: Pose, pixels: Float, covariance_px2: Float) -> Float:
    """(6, 2N): how the pose follows its centres, (J' W J)^-1 J' W."""
    turned = points_mm @ pose.rotation.T
    moves = np.concatenate([-crosses(turned), np.broadcast_to(np.eye(3), (len(turned), 3, 3))], axis=2)
    slopes = lens.point_jacobian(turned + pose.translation_mm, pixels) @ moves
    weighted = np.linalg.inv(covariance_px2) @ slopes
    return pose.covariance @ weighted.reshape(-1, 6).T


def _field(pixels: Float, covariance_px2: Float, length_px: float) -> Float:
    """(2N, 2N): covariance of an error that is a smooth field, of which (N, 2, 2) is known at each point; along x and
    y independent, between points falling as a Gaussian."""
    apart = np.linalg.norm(pixels[:, None] - pixels, axis=-1) / length_px
    sigma = np.sqrt(np.diagonal(covariance_px2, axis1=1, axis2=2))
    field = np.exp(-(apart**2) / 2)[:, None, :, None] * np.eye(2)[None, :, None, :]
    return (sigma[:, :, None, None] * field * sigma).reshape(2 * len(pixels), -1)
