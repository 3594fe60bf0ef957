"""How far the target at V0, V1, ... seems to have moved since the reference temperature."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from scipy.spatial.transform import Rotation

from thermostand.compensation.calibration.board import Board
from thermostand.compensation.calibration.pinhole import crosses
from thermostand.compensation.calibration.pose import Lens, Pose, find_pose
from thermostand.compensation.calibration.session_centres import MeanCentres, mean_centres, scatter_chi
from thermostand.compensation.observations import Float, Observations
from thermostand.compensation.validation3d.validation_frames import FrameIndices, ValidationFrames
from thermostand.foundation.errors import CalibrationError

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
class FoundPose:
    """place_mm (3,): of the target's middle. rotation (3, 3). noise, model, stand (6, 6): covariances of a small
    rotation (rad) and of the place (mm) by the markers' noise, the drift model, the stand's correction. chi: of Pose.
    """

    place_mm: Float
    rotation: Float
    noise: Float
    model: Float
    stand: Float
    chi: float


def find(lens: Lens, board: Board, mean: MeanCentres, growth: float, doubts: Doubts, image_width_px: int) -> FoundPose:
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
    return FoundPose(pose.place_mm(middle_mm(board)), pose.rotation, noise, model, stand, pose.chi)


def middle_mm(board: Board) -> Float:
    """The middle (3,) of the target: of all its points the least dependent on its rotation."""
    return (board.points_mm.min(axis=0) + board.points_mm.max(axis=0)) / 2


def rotation_mrad(found: FoundPose, reference: FoundPose) -> Float:
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


_LEAST_MARKERS = 12


@dataclass(frozen=True, slots=True, eq=False)
class CalibratedCamera:
    """The calibrated camera and target, and what the lens model is called."""

    lens: Lens
    lens_name: str
    board: Board

    @property
    def middle_mm(self) -> Float:
        """The middle (3,) of the target."""
        return middle_mm(self.board)


@dataclass(frozen=True, slots=True, eq=False)
class Deviations:
    """T temperatures, the first is the reference, P positions; NaN where there is no pose.

    translation_um, rotation_mrad (T, P, 3): since the reference, along and about X, Y, Z. noise_um, model_um, stand_um
    (T, P, 3): standard uncertainty of the translation by the markers' noise, the drift model and the stand's
    correction; table_um (3,): by the table, from repeat_um (T, 3), V0 at the end of each temperature minus V0 at its
    begin. u_mrad (T, P, 3): of the rotation, by all but the table. chi (T, P): misfit of the pose, 1 when noise
    explains it.
    """

    name: str
    translation_um: Float
    rotation_mrad: Float
    noise_um: Float
    model_um: Float
    stand_um: Float
    u_mrad: Float
    repeat_um: Float
    table_um: Float
    chi: Float

    @property
    def u_um(self) -> Float:
        """(T, P, 3): standard uncertainty of the translation; a deviation has the table's share twice."""
        return np.sqrt(self.noise_um**2 + self.model_um**2 + self.stand_um**2 + 2 * self.table_um**2)

    @property
    def per_temperature_um(self) -> Float:
        """(T, 3): mean absolute deviation over the positions."""
        return _mean(np.abs(self.translation_um), axis=1)

    @property
    def u_per_temperature_um(self) -> Float:
        """(T, 3): its standard uncertainty, the positions' taken as fully correlated: an upper limit."""
        return _mean(self.u_um, axis=1)

    @property
    def mean_um(self) -> Float:
        """(3,): mean over the temperatures but the reference; what the paper reports."""
        return _mean(self.per_temperature_um[1:], axis=0)

    @property
    def u_mean_um(self) -> Float:
        """(3,): its standard uncertainty, an upper limit as above."""
        return _mean(self.u_per_temperature_um[1:], axis=0)

    @property
    def mean_rotation_mrad(self) -> Float:
        """(3,): mean absolute rotation over the positions, then over the temperatures but the reference."""
        return _mean(_mean(np.abs(self.rotation_mrad), axis=1)[1:], axis=0)


def deviations(
    name: str,
    camera: CalibratedCamera,
    observations: Observations,
    frames: ValidationFrames,
    centres_px: Float,
    model_px2: Float | None = None,
    errors_px: Float | None = None,
) -> Deviations:
    """Of centres (F, N, 2), which may be corrected. model_px2 (F, N, 2, 2), errors_px (V, F, N, 2): of the corrections,
    as poses.Doubts has them.

    The frames of a position at a temperature are averaged first. CalibrationError when V0, V1, ... at the reference
    have no pose.
    """
    means = [[_averaged(observations, centres_px, indices) for indices in row] for row in frames.frames]
    chi = scatter_chi([mean for row in means for mean in row if mean is not None])
    growth = 1.0 if np.isnan(chi) else max(1.0, chi) ** 2
    width = observations.image_size[0]
    grid: list[list[FoundPose | None]] = []
    for row, indices in zip(means, frames.frames, strict=True):
        grid.append([])
        for mean, chosen in zip(row, indices, strict=True):
            doubts = _doubts(chosen, model_px2, errors_px)
            grid[-1].append(None if mean is None else find(camera.lens, camera.board, mean, growth, doubts, width))
    return _compared(name, frames.names, grid)


def _doubts(indices: FrameIndices, model_px2: Float | None, errors_px: Float | None) -> Doubts:
    """Means over the frames: what is wrong with a correction is common to them. Of the frames that have the marker."""
    return Doubts(
        None if model_px2 is None or not len(indices) else _mean(model_px2[indices], axis=0),
        None if errors_px is None or not len(indices) else _mean(errors_px[:, indices], axis=1),
    )


def _averaged(observations: Observations, centres_px: Float, indices: FrameIndices) -> MeanCentres | None:
    """None when too few markers are left for a pose that can be judged."""
    mean = mean_centres(centres_px[indices], observations.covariance_px2[indices]) if len(indices) else None
    if mean is None or np.count_nonzero(np.isfinite(mean.centres_px[:, 0])) < _LEAST_MARKERS:
        return None
    return mean


def _compared(name: str, names: tuple[str, ...], grid: list[list[FoundPose | None]]) -> Deviations:
    count = len(names)
    reference = [found for found in grid[0][:count] if found is not None]
    if len(reference) < count:
        missing = next(name for name, found in zip(names, grid[0], strict=False) if found is None)
        raise CalibrationError(
            f"{missing} at the reference temperature, from which all deviations are, has fewer than {_LEAST_MARKERS} "
            f"markers ({name})"
        )
    apart = [[_apart(found, first) for found, first in zip(row, reference, strict=False)] for row in grid]
    repeats = [_apart(row[count], row[0]) for row in grid]
    return Deviations(
        name=name,
        **{
            field.name: np.array([[getattr(one, field.name) for one in row] for row in apart])
            for field in fields(_Apart)
        },
        repeat_um=np.array([one.translation_um for one in repeats]),
        table_um=_table_um(repeats),
        chi=np.array([[np.nan if found is None else found.chi for found in row[:count]] for row in grid]),
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Apart:
    """One pose against another, each (3,)."""

    translation_um: Float
    rotation_mrad: Float
    noise_um: Float
    model_um: Float
    stand_um: Float
    u_mrad: Float


def _apart(found: FoundPose | None, other: FoundPose | None) -> _Apart:
    """What the drift model leaves unexplained counts twice, at the reference as well; the stand's correction is nothing
    there, and its errors count once."""
    if found is None or other is None:
        return _Apart(*np.full((6, 3), np.nan))
    noise = np.diagonal(found.noise) + np.diagonal(other.noise)
    model = np.diagonal(found.model) + np.diagonal(other.model)
    stand = np.diagonal(found.stand)
    return _Apart(
        translation_um=1e3 * (found.place_mm - other.place_mm),
        rotation_mrad=rotation_mrad(found, other),
        noise_um=1e3 * np.sqrt(noise[3:]),
        model_um=1e3 * np.sqrt(model[3:]),
        stand_um=1e3 * np.sqrt(stand[3:]),
        u_mrad=1e3 * np.sqrt((noise + model + stand)[:3]),
    )


def _table_um(repeats: list[_Apart]) -> Float:
    """(3,): standard uncertainty of one visit, from the scatter of returns without the markers' share; what the camera
    drifts in these minutes is in it. 0 when the table never came back."""
    squares = np.array([one.translation_um**2 - one.noise_um**2 for one in repeats])
    return np.sqrt(np.maximum(np.nan_to_num(_mean(squares, axis=0)), 0) / 2)


def _mean(values: Float, axis: int) -> Float:
    """Mean of what is known; NaN where nothing is."""
    known = np.isfinite(values)
    count = known.sum(axis=axis)
    return np.where(count > 0, np.where(known, values, 0.0).sum(axis=axis) / np.maximum(count, 1), np.nan)
