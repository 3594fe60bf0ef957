"""A camera calibrated from pictures of a board in any poses: held in the hand, or on a stand nobody measures.

    minimise  sum |W (project(R_v X + t_v) - centre)|^2 + sum ((X - X0)/s_X)^2

The board's points X are adjusted within the uncertainty s_X of print and flatness, so that a warped board does not
become a distorted lens; every view has a pose of its own. What noise and board do not explain is a discrepancy in px,
with which chi^2 is 1.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from thermostand.compensation.calibration.adjustment import Problem, Slopes, build_problem_fields
from thermostand.compensation.calibration.board import Board, compute_camera_shifts, compute_homography_shifts
from thermostand.compensation.calibration.least_squares import (
    Float,
    Solution,
    compute_normalised_lengths,
    minimise,
    update_discrepancy,
)
from thermostand.compensation.calibration.pinhole import (
    Pinhole,
    calibrate_opencv,
    make_cross_matrices,
    transform_points,
)
from thermostand.compensation.calibration.pose import find_pose
from thermostand.compensation.calibration.session_centres import Views
from thermostand.compensation.calibration.uncertainty import NOT_SEEN, is_near_markers
from thermostand.compensation.drift.hull import compute_convex_hull
from thermostand.foundation.errors import CalibrationError

COVERAGE = 2.0
"""k: an interval of two standard uncertainties holds 95 %."""


def compute_projection_sigma_um(found: ViewCalibration, pixels: Float, distance_mm: float) -> Float:
    """Standard uncertainty (K,), um, across the line of sight, of points seen at pixels (K, 2) at Z = distance_mm: root
    mean square of both coordinates, the camera's part alone, without the noise of a new picture; NaN where no marker
    was seen."""
    lens, scene = found.scene.lens, found.scene
    points = np.column_stack([lens.compute_slopes(pixels), np.ones(len(pixels))]) * distance_mm
    by_point, count = lens.compute_point_jacobian(points, pixels), len(scene.rotations)
    first = len(lens.vector)
    jacobian = np.zeros((len(pixels), 2, first + POSE * count))
    jacobian[:, :, :first] = lens.compute_vector_jacobian(points)
    for view in range(count):
        arm = points - scene.translations_mm[view]
        begin = first + POSE * view
        jacobian[:, :, begin : begin + POSE] = (
            np.concatenate([-by_point @ make_cross_matrices(arm), by_point], axis=2) / count
        )
    known = found.covariance[: jacobian.shape[2], : jacobian.shape[2]]
    variance_px2 = np.trace(jacobian @ known @ np.swapaxes(jacobian, 1, 2), axis1=1, axis2=2) / 2
    sigma_um = 1e3 * np.sqrt(variance_px2) * distance_mm / float(lens.focal_px.mean())
    return np.where(is_near_markers(pixels, found.hull_px), sigma_um, np.nan)


@dataclass(frozen=True, slots=True)
class PointUncertainty:
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
        middle = "not seen" if self.middle_um is None else _format_um(self.middle_um)
        worst = "where it is worst among the markers" if unseen else "at its worst corner"
        corners = f"; {unseen} of its 4 corners: {self.not_seen}" if unseen else ""
        return (
            f"a point at {self.distance_mm:.0f} mm is known to (k = {COVERAGE:g}, without its own picture's noise): "
            f"{middle} in the middle of the picture, {_format_um(self.worst_seen_um)} {worst}{corners}"
        )


def compute_point_uncertainty(found: ViewCalibration, distance_mm: float) -> PointUncertainty:
    """Return how well it knows points at Z = distance_mm."""
    width, height = found.scene.lens.image_size
    corners = [(0, 0), (width - 1, 0), (0, height - 1), (width - 1, height - 1)]
    pixels = np.array([((width - 1) / 2, (height - 1) / 2), *corners], np.float64)
    everywhere = np.concatenate([pixels, found.hull_px])
    sigma_um = COVERAGE * compute_projection_sigma_um(found, everywhere, distance_mm)
    middle, *at_corners = [None if np.isnan(um) else float(um) for um in sigma_um[: len(pixels)]]
    not_seen = NOT_SEEN if None in (middle, *at_corners) else ""
    return PointUncertainty(distance_mm, middle, tuple(at_corners), float(np.nanmax(sigma_um)), not_seen)


def _format_um(value_um: float) -> str:
    """3.1 um, 47 um, 960 um: never with an exponent."""
    return f"{float(f'{value_um:.2g}'):g} um"


POSE = 6
"""Parameters of a view: a turn (rad) and a shift (mm), in the camera's frame."""
LEAST_VIEWS = 5  # round number; nothing was measured
LEAST_MARKERS = 12  # round number; nothing was measured
# Round number; nothing was measured. With less tilt the focal length cannot be separated from the distance.
_LEAST_TILT_DEG = 10.0
_ROUNDS = 10  # a bound only: rounds end when chi^2 is settled
# One in 10^7 markers of normal noise lies beyond 6 sigma in two coordinates; half of it would drop one in a hundred.
_OUTLIER = 6.0
_MOST_OUTLIERS = 0.02  # as for positions of the table (adjustment.py); not measured
_SETTLED = 0.02  # of chi^2
_FOLDS = 5  # the usual number; time grows in proportion


@dataclass(frozen=True, slots=True, eq=False)
class PosedScene:
    """Camera, rotations (P, 3, 3) and translations (P, 3), mm, of the views, and board points (N, 3), mm."""

    lens: Pinhole
    rotations: Float
    translations_mm: Float
    points_mm: Float

    def transform_points(self) -> Float:
        """(P, N, 3): the board's points in the camera's frame, mm."""
        return transform_points(self.rotations, self.translations_mm, self.points_mm)


@dataclass(frozen=True, slots=True, eq=False)
class ViewCalibration:
    """A camera calibrated from views of a board.

    Attributes
    ----------
    covariance
        Of a step of lens, views and board points, in this order.
    residuals_px
        (P, N, 2), computed minus measured, px; NaN where not used.
    discrepancy_px
        What noise and board leave unexplained per coordinate, px.
    """

    scene: PosedScene
    board: Board
    covariance: Float
    residuals_px: Float
    discrepancy_px: float

    @property
    def hull_px(self) -> Float:
        """(H, 2): of the markers that were used, where they are computed to be seen."""
        scene = self.scene
        return compute_convex_hull(
            scene.lens.project(scene.transform_points()[np.isfinite(self.residuals_px[:, :, 0])])
        )

    @property
    def lens_sigma(self) -> Float:
        """Standard uncertainty of each entry of the lens's vector."""
        return np.sqrt(np.diag(self.covariance)[: len(self.scene.lens.vector)])

    @property
    def rms_px(self) -> float:
        """Root mean square residual per coordinate."""
        return float(np.sqrt(np.nanmean(self.residuals_px**2)))

    @property
    def warp_mm(self) -> float:
        """How far the adjusted markers are out of their best plane, root mean square, mm."""
        points = self.scene.points_mm
        design = np.column_stack([np.ones(len(points)), points[:, :2]])
        height = points[:, 2] - design @ np.linalg.lstsq(design, points[:, 2], rcond=None)[0]
        return float(np.sqrt(np.mean(height**2)))

    @property
    def adjusted_board(self) -> Board:
        """The board as the calibration leaves it."""
        sigma = np.sqrt(np.diag(self.covariance)[-self.scene.points_mm.size :]).reshape(-1, 3)
        return Board(self.scene.points_mm, sigma, self.board.diameters_mm)


def calibrate_views(views: Views, board: Board) -> ViewCalibration:
    """Calibrate Brown's pinhole from views of a board; OpenCV gives the start.

    Rounds follow until the eccentricity of the discs, the outliers and the discrepancy are settled.

    Parameters
    ----------
    views
        Pictures of the board in different poses.
    board
        Its marker centres, with their uncertainty.

    Returns
    -------
    ViewCalibration
        The lens, the poses and the adjusted board, with their covariance.

    Raises
    ------
    CalibrationError
        When the views are too few or too alike to determine a camera.

    References
    ----------
    D. C. Brown, Close-range camera calibration, Photogrammetric Engineering 37 (1971).
    """
    if len(views.centres_px) < LEAST_VIEWS:
        raise CalibrationError(f"{len(views.centres_px)} pictures show the target, {LEAST_VIEWS} are needed")
    homographic = [compute_homography_shifts(one, board.points_mm, board.diameters_mm) for one in views.centres_px]
    start = calibrate_opencv(views.centres_px - np.array(homographic), board.points_mm, views.image_size)
    _require_tilt(start.rotations)
    scene = PosedScene(start.lens, start.rotations, start.translations_mm, board.points_mm)
    used, discrepancy_px = views.seen, 0.0
    solution, residuals, chi2 = _adjust_once(scene, views, used, board, discrepancy_px)
    for _ in range(_ROUNDS):
        # Of the start the discs' eccentricities are only roughly right: there is always a second round.
        explained = chi2 <= 1 + _SETTLED and (discrepancy_px == 0 or chi2 >= 1 - _SETTLED)
        before = used
        if explained:
            used = find_inliers(residuals, views, discrepancy_px)
        else:
            discrepancy_px = update_discrepancy(views.variance_px2, discrepancy_px, chi2)
        solution, residuals, chi2 = _adjust_once(solution.state, views, used, board, discrepancy_px)
        if explained and np.array_equal(before, used):
            break
    kept = np.where(used[:, :, None], residuals, np.nan)
    return ViewCalibration(solution.state, board, solution.covariance, kept, discrepancy_px)


def _adjust_once(
    scene: PosedScene, views: Views, used: NDArray[np.bool_], board: Board, discrepancy_px: float
) -> tuple[Solution[PosedScene], Float, float]:
    """The fit with the eccentricities of `scene`, its residuals (P, N, 2), px, and chi^2 per degree of freedom."""
    shifts = compute_camera_shifts(
        scene.lens.project, scene.rotations, scene.translations_mm, scene.points_mm, board.diameters_mm
    )
    problem = _PosedProblem(
        **build_problem_fields(
            views, board, lens=scene.lens, shifts_px=shifts, used=used, discrepancy_px=discrepancy_px
        )
    )
    solution = minimise(scene, problem.compute_residuals, problem.build_equations, problem.apply_step)
    state = solution.state
    chi2 = solution.cost / (len(problem.compute_residuals(state)) - len(solution.covariance))
    return solution, state.lens.project(state.transform_points()) - (views.centres_px - shifts), chi2


def cross_validate_px(views: Views, board: Board) -> float:
    """Root mean square residual per coordinate of pictures that the calibration has not seen, about the poses found
    from them, corrected for the poses' six degrees of freedom. CalibrationError when that cannot be known, as the
    pictures without those that are held out do not determine a camera."""
    count = len(views.centres_px)
    if (left := count - math.ceil(count / _FOLDS)) < LEAST_VIEWS:
        raise CalibrationError(f"of {count} pictures {left} are left when some are held out, {LEAST_VIEWS} are needed")
    fold = np.arange(len(views.centres_px)) % _FOLDS
    squares: list[float] = []
    for number in range(_FOLDS):
        found = calibrate_views(views.select(fold != number), board)
        held = views.select(fold == number)
        for centres, covariance in zip(held.centres_px, held.covariance_px2, strict=True):
            pose = find_pose(found.scene.lens, found.adjusted_board, centres, covariance)
            residuals = pose.residuals_px[np.isfinite(centres[:, 0])]
            squares.append(float(np.sum(residuals**2)) / (residuals.size - POSE))
    return float(np.sqrt(np.mean(squares)))


def _require_tilt(rotations: Float) -> None:
    """CalibrationError when the board was parallel to itself in all pictures: focal length and distance are
    then one."""
    normals = rotations[:, :, 2]
    apart_deg = np.degrees(np.arccos(np.clip(normals @ normals.T, -1, 1))).max()
    if apart_deg < _LEAST_TILT_DEG:
        raise CalibrationError(
            f"the target is tilted by {apart_deg:.0f} deg between the pictures, {_LEAST_TILT_DEG:g} are needed to tell "
            "focal length from distance: tilt it by 20 to 40 deg, to all sides"
        )


@dataclass(frozen=True, slots=True, eq=False)
class _PosedProblem(Problem[PosedScene]):
    """Each view has a pose of its own, of which nothing is known beforehand."""

    def transform_points(self, scene: PosedScene) -> Float:
        return self._rotate_points(scene) + scene.translations_mm[self.picture]

    def _rotate_points(self, scene: PosedScene) -> Float:
        """(M, 3): the used markers turned as in their views."""
        return np.einsum("mij,mj->mi", scene.rotations[self.picture], scene.points_mm[self.marker])

    def compute_slopes(self, scene: PosedScene) -> Slopes:
        """Derivatives of the markers' residuals with respect to camera, pose and board point."""
        turned, seen = self._rotate_points(scene), self.transform_points(scene)
        by_point = self.whitener @ scene.lens.compute_point_jacobian(seen, self.centres_px)
        return Slopes(
            self.picture,
            self.marker,
            self.whitener @ scene.lens.compute_vector_jacobian(seen),
            np.concatenate([-by_point @ make_cross_matrices(turned), by_point], axis=2),
            by_point @ scene.rotations[self.picture],
        )

    def apply_step(self, scene: PosedScene, change: Float) -> PosedScene:
        lens = len(scene.lens.vector)
        poses = change[lens : len(change) - scene.points_mm.size].reshape(-1, POSE)
        return PosedScene(
            scene.lens.apply_step(change[:lens]),
            Rotation.from_rotvec(poses[:, :3]).as_matrix() @ scene.rotations,
            scene.translations_mm + poses[:, 3:],
            scene.points_mm + change[-scene.points_mm.size :].reshape(-1, 3),
        )


def find_inliers(residuals_px: Float, views: Views, discrepancy_px: float) -> NDArray[np.bool_]:
    """Markers not far outside the scatter, unless those that are would be too many for accidents."""
    seen = views.seen
    lengths = compute_normalised_lengths(residuals_px[seen], views.covariance_px2[seen], discrepancy_px)
    kept = seen.copy()
    if np.mean(lengths > _OUTLIER) <= _MOST_OUTLIERS:
        kept[seen] = lengths <= _OUTLIER
    return kept
