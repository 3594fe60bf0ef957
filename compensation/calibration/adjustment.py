"""Calibration from a session's positions: the joint adjustment of camera, table and board."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from thermostand.compensation.calibration.board import Board
from thermostand.compensation.calibration.bundle import TableScene, problem_of
from thermostand.compensation.calibration.centre_corrections import shifts_by_camera, shifts_by_homography
from thermostand.compensation.calibration.least_squares import (
    Float,
    Solution,
    lengths_in_sigmas,
    minimise,
    next_discrepancy,
)
from thermostand.compensation.calibration.pinhole import Pinhole, calibrate_opencv
from thermostand.compensation.calibration.session_centres import Positions
from thermostand.compensation.calibration.stage_geometry import ERRORS, TableGeometry, TableSigma
from thermostand.compensation.drift.hull import convex_hull
from thermostand.foundation.errors import CalibrationError

_LEAST_TURN_DEG = 5.0
_LEAST_TRAVEL_MM = 10.0


def table_from_poses(
    linear_mm: Float, rotary_deg: Float, rotations: Float, translations_mm: Float, middle_mm: Float
) -> TableGeometry:
    """The table that puts the target, whose middle is (3,), at poses (P, 3, 3) and (P, 3).

    CalibrationError when an axis hardly moved.
    """
    if np.ptp(rotary_deg) < _LEAST_TURN_DEG or np.ptp(linear_mm) < _LEAST_TRAVEL_MM:
        raise CalibrationError(
            f"the positions span {np.ptp(linear_mm):g} mm and {np.ptp(rotary_deg):g} deg; "
            f"{_LEAST_TRAVEL_MM:g} mm and {_LEAST_TURN_DEG:g} deg are needed to separate camera and table"
        )
    rotary = _axis(rotary_deg, rotations)
    turns = Rotation.from_rotvec(rotary_deg[:, None] * rotary, degrees=True)
    mount = (turns.inv() * Rotation.from_matrix(rotations)).mean().as_matrix()
    base_mm, linear, offset_mm = _places(linear_mm, turns.as_matrix(), translations_mm)
    # What of o is along the axis is for the wobble to act on, and otherwise the same as a shift of the base.
    along = rotary * (rotary @ (offset_mm + mount @ middle_mm))
    return TableGeometry(base_mm + along, linear, rotary, mount, offset_mm - along)


def _axis(rotary_deg: Float, rotations: Float) -> Float:
    """Unit vector about which the target turns with rising angle: sum of all turns from the first position."""
    total = (rotary_deg - rotary_deg[0]) @ Rotation.from_matrix(rotations @ rotations[0].T).as_rotvec()
    return total / np.linalg.norm(total)


def _places(linear_mm: Float, turns: Float, translations_mm: Float) -> tuple[Float, Float, Float]:
    """c, l and o of t = c + z l + turn o, by least squares."""
    identity = np.broadcast_to(np.eye(3), turns.shape)
    design = np.concatenate([identity, linear_mm[:, None, None] * np.eye(3), turns], axis=2).reshape(-1, 9)
    found = np.asarray(np.linalg.lstsq(design, translations_mm.ravel(), rcond=1e-9)[0], np.float64)
    return found[:3], found[3:6] / np.linalg.norm(found[3:6]), found[6:]


_ROUNDS = 10
_OUTLIER = 8.0
_LEAST_OUTLIER_SIGMA = 6.0
_MEDIAN_LENGTH = 1.18
"""Of a vector of two coordinates of unit variance."""
_MOST_OUTLIERS = 0.02
_CLOSE_TO_ONE = 0.02


@dataclass(frozen=True, slots=True, eq=False)
class Adjustment:
    """The adjusted scene and how well it is known.

    covariance: of a step of the whole scene, in the order camera, table, free errors position by position, board
    point by point. freed (6,): the degrees of freedom the table's errors have. positions: the observations used,
    centres now those of the discs. residuals_px (P, N, 2): computed minus measured, NaN without a centre. used (P, N):
    markers that were neither missing nor outliers. discrepancy_px: what the model leaves unexplained per coordinate,
    beyond noise and priors; 0 when they explain all. chi: of all residuals, the discrepancy not counted as noise.
    """

    scene: TableScene
    board: Board
    sigma: TableSigma
    freed: NDArray[np.bool_]
    covariance: Float
    positions: Positions
    residuals_px: Float
    used: NDArray[np.bool_]
    discrepancy_px: float
    chi: float

    @property
    def camera_sigma(self) -> Float:
        """Standard uncertainty of each entry of the camera's vector."""
        return np.sqrt(np.diag(self.covariance)[: len(self.scene.lens.vector)])

    @property
    def points_sigma_mm(self) -> Float:
        """Standard uncertainty (N, 3) of the adjusted board."""
        return np.sqrt(np.diag(self.covariance)[-self.scene.points_mm.size :]).reshape(-1, 3)

    @property
    def adjusted_board(self) -> Board:
        """The board as the adjustment leaves it."""
        return Board(self.scene.points_mm, self.points_sigma_mm, self.board.diameters_mm)

    @property
    def rms_px(self) -> float:
        """Root mean square residual per coordinate."""
        return float(np.sqrt(np.mean(self.residuals_px[self.used] ** 2)))

    @property
    def hull_px(self) -> Float:
        """(H, 2): of the markers that were used, where they were seen."""
        return convex_hull(self.positions.centres_px[self.used])

    @property
    def normalised(self) -> Float:
        """(P, N, 2): residuals in units of the detection sigma of their coordinate."""
        return self.residuals_px / np.sqrt(np.diagonal(self.positions.covariance_px2, axis1=2, axis2=3))

    @property
    def reprojection_ratio(self) -> float:
        """Root mean square residual per coordinate over the detection sigma."""
        return float(np.sqrt(np.mean(self.normalised[self.used] ** 2)))

    def poses(self) -> tuple[Float, Float]:
        """Rotation (P, 3, 3) and translation (P, 3), mm, of the target at each position."""
        return self.scene.table.poses(self.positions.linear_mm, self.positions.rotary_deg, self.scene.errors)


@dataclass(frozen=True, slots=True, eq=False)
class _Round:
    """One adjustment with fixed eccentricities, markers and discrepancy. excess: squares over their
    expectation, 1 when all is explained."""

    solution: Solution[TableScene]
    shifts_px: Float
    used: NDArray[np.bool_]
    discrepancy_px: float
    residuals_px: Float
    inliers: NDArray[np.bool_]
    chi2: float
    excess: float
    is_explained: bool


@dataclass(frozen=True, slots=True, eq=False)
class Start:
    """Where an adjustment begins: Brown's camera and the table, with the corrections (P, N, 2), px, by homographies."""

    scene: TableScene
    shifts_px: Float


def adjust(
    positions: Positions, board: Board, sigma: TableSigma, *, rational: bool = False, start: Start | None = None
) -> Adjustment:
    """Calibrate: OpenCV and the target's poses give the start, then everything is adjusted together.

    start: of these positions, where it is known already. Rounds follow until the eccentricity of the discs, the
    outliers and the discrepancy are settled. CalibrationError when the observations do not determine a camera.
    """
    start = start or start_of(positions, board)
    scene, shifts = start.scene, start.shifts_px
    if rational:
        scene = replace(scene, lens=Pinhole(np.concatenate([scene.lens.vector, np.zeros(3)]), scene.lens.image_size))
    found = _adjusted(scene, positions, board, sigma, shifts, positions.seen, 0.0)
    for _ in range(_ROUNDS):
        scene = found.solution.state
        poses = scene.table.poses(positions.linear_mm, positions.rotary_deg, scene.errors)
        shifts = shifts_by_camera(scene.lens.project, *poses, scene.points_mm, board.diameters_mm)
        discrepancy_px = found.discrepancy_px
        if not found.is_explained:
            discrepancy_px = next_discrepancy(positions.sigma_px**2, discrepancy_px, found.excess)
        found = _adjusted(scene, positions, board, sigma, shifts, found.inliers, discrepancy_px)
        if found.is_explained and np.array_equal(found.used, found.inliers):
            break
    return Adjustment(
        scene=found.solution.state,
        board=board,
        sigma=sigma,
        freed=sigma.vector > 0,
        covariance=found.solution.covariance,
        positions=replace(positions, centres_px=positions.centres_px - found.shifts_px),
        residuals_px=found.residuals_px,
        used=found.used,
        discrepancy_px=found.discrepancy_px,
        chi=float(np.sqrt(found.chi2)),
    )


def _adjusted(
    start: TableScene,
    positions: Positions,
    board: Board,
    sigma: TableSigma,
    shifts_px: Float,
    used: NDArray[np.bool_],
    discrepancy_px: float,
) -> _Round:
    problem = problem_of(positions, shifts_px, used, board, sigma, discrepancy_px, start.lens)
    solution = minimise(start, problem.residuals, problem.equations, problem.stepped)
    degrees = problem.count - len(solution.covariance)
    chi2 = solution.cost / degrees
    excess = max(chi2, _board_excess(solution, board))
    residuals = _residuals(solution.state, positions, shifts_px)
    slack = 3 * np.sqrt(2 / degrees) if discrepancy_px == 0 else _CLOSE_TO_ONE
    return _Round(
        solution=solution,
        shifts_px=shifts_px,
        used=used,
        discrepancy_px=discrepancy_px,
        residuals_px=residuals,
        inliers=_inliers(residuals, positions, discrepancy_px),
        chi2=chi2,
        excess=excess,
        is_explained=bool(excess <= 1 + slack and (discrepancy_px == 0 or excess >= 1 - slack)),
    )


def _board_excess(solution: Solution[TableScene], board: Board) -> float:
    """Squared corrections of the board in its plane over what its prior allows, less three standard errors.

    A lens that the model cannot follow bends the board before it shows in the residuals.
    """
    moved = (solution.state.points_mm - board.points_mm) / board.sigma_mm
    left = 1 - np.diag(solution.covariance)[-moved.size :].reshape(-1, 3) / board.sigma_mm**2
    free = float(np.sum(left[:, :2]))
    return float(np.sum(moved[:, :2] ** 2)) / free - 3 * np.sqrt(2 / free)


def start_of(positions: Positions, board: Board) -> Start:
    """Camera and poses by OpenCV, of centres corrected by the homographies."""
    shifts = np.array(
        [shifts_by_homography(centres, board.points_mm, board.diameters_mm) for centres in positions.centres_px]
    )
    centres = positions.centres_px - shifts
    start = calibrate_opencv(centres, board.points_mm, positions.image_size)
    table = table_from_poses(
        positions.linear_mm, positions.rotary_deg, start.rotations, start.translations_mm, board.points_mm.mean(axis=0)
    )
    return Start(TableScene(start.lens, table, np.zeros((len(centres), ERRORS)), board.points_mm), shifts)


def _residuals(scene: TableScene, positions: Positions, shifts_px: Float) -> Float:
    """(P, N, 2): computed minus measured centres, px; NaN without a centre."""
    rotations, translations = scene.table.poses(positions.linear_mm, positions.rotary_deg, scene.errors)
    seen = np.einsum("pij,nj->pni", rotations, scene.points_mm) + translations[:, None]
    return scene.lens.project(seen) - (positions.centres_px - shifts_px)


def _inliers(residuals_px: Float, positions: Positions, discrepancy_px: float) -> NDArray[np.bool_]:
    """(P, N): markers not far outside the scatter of all, unless those that are would be too many for accidents."""
    seen = positions.seen
    lengths = lengths_in_sigmas(residuals_px[seen], positions.covariance_px2[seen], discrepancy_px)
    near = lengths <= max(_LEAST_OUTLIER_SIGMA, _OUTLIER * float(np.median(lengths)) / _MEDIAN_LENGTH)
    inliers = seen.copy()
    if np.mean(~near) <= _MOST_OUTLIERS:
        inliers[seen] = near
    return inliers
