"""Several cameras fixed to each other, from pictures that they take of one board at the same moments.

    minimise  sum |W (project_c(R_c (R_v X + t_v) + t_c) - centre)|^2 + sum ((X - X0)/s_X)^2

Camera c is turned by R_c and shifted by t_c against the first one, whose frame is the rig's; the board has one pose
(R_v, t_v) at each moment for all cameras, which is what ties them together. Each camera has a lens and a discrepancy of
its own (views.py).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from thermostand.compensation.calibration.adjustment import compute_lens_sigma
from thermostand.compensation.calibration.board import Board, compute_camera_shifts
from thermostand.compensation.calibration.least_squares import (
    Float,
    compute_whiteners,
    make_equations,
    minimise,
    update_discrepancy,
)
from thermostand.compensation.calibration.pinhole import Pinhole, make_cross_matrices, transform_points
from thermostand.compensation.calibration.session_centres import Views
from thermostand.compensation.calibration.views import LEAST_MARKERS, POSE, calibrate_views, find_inliers
from thermostand.foundation.errors import CalibrationError

LEAST_COMMON = 3
"""Moments at which a camera and the first one both see the board: one fixes it, the others find mistakes."""
# Cameras that are fixed to each other turn by far less between moments; half-turned names of a symmetric target give
# 180 degrees.
_GREATEST_PLAY_DEG = 5.0
_ROUNDS = 10  # a bound only: rounds end when all cameras' chi^2 are settled
_SETTLED = 0.02  # of chi^2, as for one camera

Mask = NDArray[np.bool_]


@dataclass(frozen=True, slots=True, eq=False)
class RigScene:
    """C cameras at V moments. rotations (C, 3, 3), translations_mm (C, 3): from the first camera's frame to each
    camera's. board_rotations (V, 3, 3), board_translations_mm (V, 3): of the board in the first camera's frame.
    points_mm (N, 3): of the board."""

    lenses: tuple[Pinhole, ...]
    rotations: Float
    translations_mm: Float
    board_rotations: Float
    board_translations_mm: Float
    points_mm: Float

    def compute_poses(self, camera: int) -> tuple[Float, Float]:
        """The board's rotations (V, 3, 3) and translations (V, 3), mm, in a camera's frame."""
        turn, shift = self.rotations[camera], self.translations_mm[camera]
        return turn @ self.board_rotations, self.board_translations_mm @ turn.T + shift


@dataclass(frozen=True, slots=True, eq=False)
class RigCalibration:
    """covariance: of a step of lenses, cameras but the first, board poses and board points, in this order. residuals_px
    (V, N, 2): of each camera, computed minus measured, NaN where not used. discrepancies_px (C,): see views.py."""

    scene: RigScene
    covariance: Float
    residuals_px: tuple[Float, ...]
    discrepancies_px: Float

    def compute_pose_sigma(self, camera: int) -> tuple[Float, Float]:
        """Standard uncertainties of a camera's turn (3,), deg, and shift (3,), mm, against the first one."""
        sigma = np.sqrt(np.diag(self._get_pose_covariance(camera)))
        return np.degrees(sigma[:3]), sigma[3:]

    def compute_baseline_mm(self, camera: int) -> tuple[float, float]:
        """Return how far a camera's centre of projection is from the first one's, and the standard uncertainty of that,
        mm."""
        shift = self.scene.translations_mm[camera]
        length = float(np.linalg.norm(shift))
        covariance = self._get_pose_covariance(camera)[3:, 3:]
        return length, float(np.sqrt(shift @ covariance @ shift)) / length

    def compute_lens_sigma(self, camera: int) -> Float:
        """Standard uncertainty of each entry of a camera's lens."""
        begin = sum(len(lens.vector) for lens in self.scene.lenses[:camera])
        return np.sqrt(np.diag(self.covariance)[begin : begin + len(self.scene.lenses[camera].vector)])

    def _get_pose_covariance(self, camera: int) -> Float:
        begin = sum(len(lens.vector) for lens in self.scene.lenses) + POSE * (camera - 1)
        return self.covariance[begin : begin + POSE, begin : begin + POSE]

    def rms_px(self, camera: int) -> float:
        """Root mean square residual of a camera per coordinate."""
        return float(np.sqrt(np.nanmean(self.residuals_px[camera] ** 2)))


def calibrate_rig(cameras: Sequence[Views], board: Board) -> RigCalibration:
    """`cameras`: the views of each camera of the same moments, NaN where one does not see the board.

    CalibrationError when a camera cannot be calibrated alone, or has too few moments in common with the first one.
    """
    scene = _find_start(cameras, board)
    used = [views.seen for views in cameras]
    discrepancies = np.zeros(len(cameras))
    found, residuals, chi2 = _adjust_once(scene, cameras, used, board, discrepancies)
    for _ in range(_ROUNDS):
        # Of the start the discs' eccentricities are only roughly right: there is always a second round.
        before = used
        unsettled = (chi2 > 1 + _SETTLED) | ((discrepancies > 0) & (chi2 < 1 - _SETTLED))
        if unsettled.any():
            discrepancies = np.array(
                [
                    update_discrepancy(views.variance_px2, old, value) if wrong else old
                    for views, old, value, wrong in zip(cameras, discrepancies, chi2, unsettled, strict=True)
                ]
            )
        else:
            used = [find_inliers(*one) for one in zip(residuals, cameras, discrepancies, strict=True)]
        found, residuals, chi2 = _adjust_once(found.scene, cameras, used, board, discrepancies)
        if not unsettled.any() and all(np.array_equal(one, other) for one, other in zip(before, used, strict=True)):
            break
    return found


def _find_start(cameras: Sequence[Views], board: Board) -> RigScene:
    """Each camera calibrated alone; the rig from the moments that it has in common with the first one."""
    moments = len(cameras[0].centres_px)
    rotations, translations = (
        np.full((len(cameras), moments, 3, 3), np.nan),
        np.full((len(cameras), moments, 3), np.nan),
    )
    lenses: list[Pinhole] = []
    for number, views in enumerate(cameras):
        enough = views.seen.sum(axis=1) >= LEAST_MARKERS
        alone = calibrate_views(views.select(enough), board).scene
        rotations[number, enough], translations[number, enough] = alone.rotations, alone.translations_mm
        lenses.append(alone.lens)
    turns, shifts = [np.eye(3)], [np.zeros(3)]
    for number in range(1, len(cameras)):
        common = np.isfinite(translations[[0, number], :, 0]).all(axis=0)
        if np.count_nonzero(common) < LEAST_COMMON:
            raise CalibrationError(
                f"camera {number + 1} and the first one both see the target at {np.count_nonzero(common)} moments, "
                f"{LEAST_COMMON} are needed: hold it where both see it"
            )
        between = Rotation.from_matrix(rotations[number, common] @ np.swapaxes(rotations[0, common], 1, 2))
        apart_deg = float(np.degrees((between * between.mean().inv()).magnitude().max()))
        if apart_deg > _GREATEST_PLAY_DEG:
            raise CalibrationError(
                f"camera {number + 1} turns by {apart_deg:.0f} deg against the first one between the pictures: it is "
                "not fixed, the pictures are not of the same moments, or the cameras read the target from different "
                "ends (nominal_roll_deg; a target with marks settles it)"
            )
        turn = between.mean().as_matrix()
        turns.append(turn)
        shifts.append(np.median(translations[number, common] - translations[0, common] @ turn.T, axis=0))
    for number in range(1, len(cameras)):
        missing = np.isnan(translations[0, :, 0]) & np.isfinite(translations[number, :, 0])
        rotations[0, missing] = turns[number].T @ rotations[number, missing]
        translations[0, missing] = (translations[number, missing] - shifts[number]) @ turns[number]
    if np.isnan(translations[0]).any():
        raise CalibrationError(
            f"at {np.isnan(translations[0, :, 0]).sum()} moments no camera sees enough of the target"
        )
    return RigScene(tuple(lenses), np.array(turns), np.array(shifts), rotations[0], translations[0], board.points_mm)


def _adjust_once(
    scene: RigScene, cameras: Sequence[Views], used: list[Mask], board: Board, discrepancies: Float
) -> tuple[RigCalibration, list[Float], Float]:
    """The fit with the eccentricities of `scene`, all residuals of each camera, and chi^2 of each (C,)."""
    shifts = [
        compute_camera_shifts(lens.project, *scene.compute_poses(number), scene.points_mm, board.diameters_mm)
        for number, lens in enumerate(scene.lenses)
    ]
    seen = [
        _CameraObservations(*one) for one in zip(range(len(cameras)), cameras, shifts, used, discrepancies, strict=True)
    ]
    problem = _Problem(seen, board, tuple(compute_lens_sigma(lens) for lens in scene.lenses))
    solution = minimise(scene, problem.compute_residuals, make_equations(problem.compute_jacobian), problem.apply_step)
    state = solution.state
    free = 1 - len(solution.covariance) / len(problem.compute_residuals(state))
    chi2 = np.array([float(np.mean(one.compute_residuals(state) ** 2)) / free for one in seen], np.float64)
    residuals: list[Float] = []
    for number, (views, shift) in enumerate(zip(cameras, shifts, strict=True)):
        turns, places = state.compute_poses(number)
        points = transform_points(turns, places, state.points_mm)
        residuals.append(state.lenses[number].project(points) - (views.centres_px - shift))
    kept = tuple(np.where(mask[:, :, None], one, np.nan) for mask, one in zip(used, residuals, strict=True))
    return RigCalibration(state, solution.covariance, kept, discrepancies), residuals, chi2


class _CameraObservations:
    """The used observations of one camera: M markers, at moment[m] of board point marker[m]."""

    def __init__(self, camera: int, views: Views, shifts_px: Float, used: Mask, discrepancy_px: float) -> None:
        self.camera = camera
        self.moment, self.marker = np.nonzero(used)
        self.centres_px = (views.centres_px - shifts_px)[used]
        self.whitener = compute_whiteners(views.covariance_px2[used] + discrepancy_px**2 * np.eye(2))

    def compute_residuals(self, scene: RigScene) -> Float:
        off = scene.lenses[self.camera].project(self._transform_points(scene)[2]) - self.centres_px
        return np.einsum("mij,mj->mi", self.whitener, off)

    def compute_jacobian(self, scene: RigScene, count: int) -> Float:
        """(M, 2, count), see `RigCalibration.covariance` for the order."""
        lens, turn = scene.lenses[self.camera], scene.rotations[self.camera]
        on_board, in_rig, in_camera = self._transform_points(scene)
        by_point = self.whitener @ lens.compute_point_jacobian(in_camera, self.centres_px)
        slopes = np.zeros((len(self.moment), 2, count))
        begin = sum(len(one.vector) for one in scene.lenses[: self.camera])
        slopes[:, :, begin : begin + len(lens.vector)] = self.whitener @ lens.compute_vector_jacobian(in_camera)
        poses = sum(len(one.vector) for one in scene.lenses)
        if self.camera > 0:
            own = slice(poses + POSE * (self.camera - 1), poses + POSE * self.camera)
            slopes[:, :, own] = np.concatenate([-by_point @ make_cross_matrices(in_rig @ turn.T), by_point], axis=2)
        boards = poses + POSE * (len(scene.lenses) - 1)
        by_rig = by_point @ turn
        pose = np.concatenate([-by_rig @ make_cross_matrices(on_board), by_rig], axis=2)
        each = np.arange(len(self.moment))[:, None]
        slopes[each, :, boards + POSE * self.moment[:, None] + np.arange(POSE)] = np.swapaxes(pose, 1, 2)
        first_point = boards + POSE * len(scene.board_rotations)
        points = by_rig @ scene.board_rotations[self.moment]
        slopes[each, :, first_point + 3 * self.marker[:, None] + np.arange(3)] = np.swapaxes(points, 1, 2)
        return slopes

    def _transform_points(self, scene: RigScene) -> tuple[Float, Float, Float]:
        """(M, 3) each: the markers turned as the board is, in the rig's frame, and in the camera's."""
        on_board = np.einsum("mij,mj->mi", scene.board_rotations[self.moment], scene.points_mm[self.marker])
        in_rig = on_board + scene.board_translations_mm[self.moment]
        in_camera = in_rig @ scene.rotations[self.camera].T + scene.translations_mm[self.camera]
        return on_board, in_rig, in_camera


@dataclass(frozen=True, slots=True, eq=False)
class _Problem:
    """The whitened problem of all cameras."""

    seen: Sequence[_CameraObservations]
    board: Board
    lens_sigmas: tuple[Float, ...]

    def compute_residuals(self, scene: RigScene) -> Float:
        parts = [one.compute_residuals(scene).ravel() for one in self.seen]
        parts += [lens.distortion / sigma for lens, sigma in zip(scene.lenses, self.lens_sigmas, strict=True)]
        return np.concatenate([*parts, ((scene.points_mm - self.board.points_mm) / self.board.sigma_mm).ravel()])

    def compute_jacobian(self, scene: RigScene) -> Float:
        lenses = sum(len(lens.vector) for lens in scene.lenses)
        first_point = lenses + POSE * (len(scene.lenses) - 1 + len(scene.board_rotations))
        count = first_point + scene.points_mm.size
        parts = [one.compute_jacobian(scene, count).reshape(-1, count) for one in self.seen]
        end = 0
        for lens, sigma in zip(scene.lenses, self.lens_sigmas, strict=True):
            end += len(lens.vector)
            prior = np.zeros((len(sigma), count))
            prior[range(len(sigma)), range(end - len(sigma), end)] = 1 / sigma
            parts.append(prior)
        prior = np.zeros((scene.points_mm.size, count))
        prior[range(len(prior)), range(first_point, count)] = 1 / self.board.sigma_mm.ravel()
        return np.concatenate([*parts, prior])

    def apply_step(self, scene: RigScene, change: Float) -> RigScene:
        lenses: list[Pinhole] = []
        for lens in scene.lenses:
            lenses.append(lens.apply_step(change[: len(lens.vector)]))
            change = change[len(lens.vector) :]
        others = len(scene.lenses) - 1
        poses = change[: POSE * (others + len(scene.board_rotations))].reshape(-1, POSE)
        turns = Rotation.from_rotvec(poses[:, :3]).as_matrix()
        return RigScene(
            tuple(lenses),
            np.concatenate([scene.rotations[:1], turns[:others] @ scene.rotations[1:]]),
            np.concatenate([scene.translations_mm[:1], scene.translations_mm[1:] + poses[:others, 3:]]),
            turns[others:] @ scene.board_rotations,
            scene.board_translations_mm + poses[others:, 3:],
            scene.points_mm + change[-scene.points_mm.size :].reshape(-1, 3),
        )
