"""Calibration from a session's positions: the joint adjustment of camera, table and board."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from typing import Any, Generic, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from thermostand.compensation.calibration.board import Board, compute_camera_shifts, compute_homography_shifts
from thermostand.compensation.calibration.least_squares import (
    Float,
    Solution,
    compute_normalised_lengths,
    compute_whiteners,
    minimise,
    update_discrepancy,
)
from thermostand.compensation.calibration.pinhole import Pinhole, calibrate_opencv, transform_points
from thermostand.compensation.calibration.session_centres import Positions, Views
from thermostand.compensation.calibration.stage_geometry import ERRORS, PARAMETERS, TableGeometry, TableSigma
from thermostand.compensation.drift.hull import compute_convex_hull
from thermostand.foundation.errors import CalibrationError

# The joint adjustment's residuals and their derivatives.
#
#     minimise  sum |W (project(p) - centre)|^2 + sum ((X - X0)/s_X)^2 + sum (d/s_d)^2 + sum (w/s_w)^2
#
# W: inverse square root of a marker's covariance; X0, s_X: the measured or nominal board; d, w: the table's errors at a
# position (compensation/calibration/stage_geometry.py). Everything that is known enters with its uncertainty: taking
# board or table as exact would put their errors into the camera.


@dataclass(frozen=True, slots=True, eq=False)
class Slopes:
    """Derivatives of M whitened markers, of board point marker[m] in picture[m]: common (M, 2, C) with respect to what
    all share, own (M, 2, F) to what the picture has of its own, points (M, 2, 3) to the board point."""

    picture: NDArray[np.int64]
    marker: NDArray[np.int64]
    common: Float
    own: Float
    points: Float


def build_normal_equations(slopes: Slopes, off: Float, pictures: int, markers: int) -> tuple[Float, Float]:
    """J' J (n, n) and J' r (n,) of residuals off (M, 2); n = C, then F of each picture, then 3 of each board point."""
    common, own, points, off = (
        _scatter_blocks(slopes, part, pictures, markers)
        for part in (slopes.common, slopes.own, slopes.points, off[..., None])
    )
    of_pictures = [part.reshape(pictures, 2 * markers, part.shape[-1]) for part in (common, own, off)]
    of_markers = [
        np.swapaxes(part, 0, 1).reshape(markers, 2 * pictures, part.shape[-1]) for part in (common, points, off)
    ]
    to_own, to_points = np.swapaxes(of_pictures[1], 1, 2), np.swapaxes(of_markers[1], 1, 2)
    flat = common.reshape(-1, common.shape[-1])
    coupling = np.concatenate([_stack_blocks(to_own @ of_pictures[0]), _stack_blocks(to_points @ of_markers[0])])
    crossed = np.swapaxes(np.swapaxes(own, 2, 3) @ points, 1, 2).reshape(-1, 3 * markers)
    others = [
        [_build_block_diagonal(to_own @ of_pictures[1]), crossed],
        [crossed.T, _build_block_diagonal(to_points @ of_markers[1])],
    ]
    # By picture and board point: written out, the derivative is 3,900 x 251 and nearly all zeros, and an adjustment
    # takes 0.27 s instead of 0.11.
    normal = np.block([[flat.T @ flat, coupling.T], [coupling, np.block(others)]])
    parts = flat.T @ off.ravel(), (to_own @ of_pictures[2]).ravel(), (to_points @ of_markers[2]).ravel()
    return normal, np.concatenate(parts)


def _scatter_blocks(slopes: Slopes, values: Float, pictures: int, markers: int) -> Float:
    """(pictures, markers, 2, K) of (M, 2, K): 0 where a marker is not used."""
    placed = np.zeros((pictures, markers, *values.shape[1:]))
    placed[slopes.picture, slopes.marker] = values
    return placed


def _stack_blocks(blocks: Float) -> Float:
    """(B K, C) of blocks (B, K, C)."""
    return blocks.reshape(-1, blocks.shape[-1])


def _build_block_diagonal(blocks: Float) -> Float:
    """(B K, B K) of blocks (B, K, K)."""
    count, size, _ = blocks.shape
    matrix = np.zeros((count, size, count, size))
    each = np.arange(count)
    matrix[each, :, each] = blocks
    return matrix.reshape(count * size, count * size)


# Each distortion term may move the image's corner by about 5 % of its distance from the axis. Round number; it only
# keeps terms finite that the markers do not determine.
_LENS_PRIOR = 0.05
_LENS_ORDERS = np.array([2.0, 4.0, 1.0, 1.0, 6.0, 2.0, 4.0, 6.0])
"""Power of the radius that each distortion term is multiplied by, relative to the radius itself."""


@dataclass(frozen=True, slots=True, eq=False)
class TableScene:
    """Camera, table, its errors (P, 6) in mm and rad, and board points (N, 3), mm: what the adjustment looks for."""

    lens: Pinhole
    table: TableGeometry
    errors: Float
    points_mm: Float


class Scene(Protocol):
    """What is looked for, whatever holds the board: a camera and board points (N, 3), mm, among others."""

    @property
    def lens(self) -> Pinhole:
        """The camera."""
        ...

    @property
    def points_mm(self) -> Float:
        """(N, 3)."""
        ...


Sought = TypeVar("Sought", bound=Scene)


@dataclass(frozen=True, slots=True, eq=False)
class Problem(ABC, Generic[Sought]):
    """The whitened problem: M used markers, of board point marker[m] in picture[m] of so many, with priors of the
    distortion and the board. What pictures have of their own, and where the board is in them, subclasses say."""

    pictures: int
    picture: NDArray[np.int64]
    marker: NDArray[np.int64]
    centres_px: Float
    whitener: Float
    board: Board
    lens_sigma: Float

    @abstractmethod
    def transform_points(self, scene: Sought) -> Float:
        """(M, 3): the used markers in the camera's frame, mm."""

    @abstractmethod
    def compute_slopes(self, scene: Sought) -> Slopes:
        """Derivatives of the markers' residuals."""

    @abstractmethod
    def apply_step(self, scene: Sought, change: Float) -> Sought:
        """The scene a step (n,) away."""

    def compute_own_priors(self, scene: Sought) -> tuple[Float, Float]:
        """Residuals (K,) of what is known beforehand of the pictures' own, and their weights (K,); none."""
        return np.empty(0), np.empty(0)

    def compute_residuals(self, scene: Sought) -> Float:
        """Markers (x, y each), distortion, the pictures' own, board; all of unit variance."""
        off = np.einsum("mij,mj->mi", self.whitener, scene.lens.project(self.transform_points(scene)) - self.centres_px)
        board = (scene.points_mm - self.board.points_mm) / self.board.sigma_mm
        own, _ = self.compute_own_priors(scene)
        return np.concatenate([off.ravel(), scene.lens.distortion / self.lens_sigma, own, board.ravel()])

    def build_equations(self, scene: Sought, residuals: Float) -> tuple[Float, Float]:
        """Normal matrix (n, n) and gradient (n,) of a step of camera, what pictures have of their own, and board."""
        off = residuals[: 2 * len(self.picture)].reshape(-1, 2)
        normal, gradient = build_normal_equations(
            self.compute_slopes(scene), off, self.pictures, len(self.board.points_mm)
        )
        _, own = self.compute_own_priors(scene)
        weights = np.concatenate([1 / self.lens_sigma, own, 1 / self.board.sigma_mm.ravel()])
        lens, count, others = len(scene.lens.vector), len(normal), len(weights) - len(self.lens_sigma)
        known = np.concatenate([np.arange(lens - len(self.lens_sigma), lens), np.arange(count - others, count)])
        normal[known, known] += weights**2
        gradient[known] += weights * residuals[off.size :]
        return normal, gradient


def build_problem_fields(
    views: Views, board: Board, *, lens: Pinhole, shifts_px: Float, used: NDArray[np.bool_], discrepancy_px: float
) -> dict[str, Any]:
    """The fields that all problems have, of the markers `used` (P, N), their ellipses' centres moved by -shifts_px
    (P, N, 2) to the discs'."""
    picture, marker = np.nonzero(used)
    return {
        "pictures": len(used),
        "picture": picture,
        "marker": marker,
        "centres_px": (views.centres_px - shifts_px)[used],
        "whitener": compute_whiteners(views.covariance_px2[used] + discrepancy_px**2 * np.eye(2)),
        "board": board,
        "lens_sigma": compute_lens_sigma(lens),
    }


@dataclass(frozen=True, slots=True, eq=False)
class TableProblem(Problem[TableScene]):
    """The table holds the board, at positions (P,); freed (6,): of its errors, with sigmas (6,)."""

    linear_mm: Float
    rotary_deg: Float
    freed: NDArray[np.bool_]
    errors_sigma: Float

    def compute_own_priors(self, scene: TableScene) -> tuple[Float, Float]:
        """Return the priors of the table's free errors."""
        own = (scene.errors / self.errors_sigma)[:, self.freed].ravel()
        return own, np.tile(1 / self.errors_sigma[self.freed], len(scene.errors))

    def transform_points(self, scene: TableScene) -> Float:
        """(M, 3): the used markers in the camera's frame, mm."""
        rotations, translations = scene.table.compute_poses(self.linear_mm, self.rotary_deg, scene.errors)
        turned = np.einsum("mij,mj->mi", rotations[self.picture], scene.points_mm[self.marker])
        return turned + translations[self.picture]

    def compute_slopes(self, scene: TableScene) -> Slopes:
        """Derivatives of the markers' residuals."""
        points = scene.points_mm[self.marker]
        seen = self.transform_points(scene)
        linear, rotary = self.linear_mm[self.picture], self.rotary_deg[self.picture]
        to_table, to_errors, to_points = scene.table.compute_jacobian(
            points, linear, rotary, scene.errors[self.picture]
        )
        by_point = self.whitener @ scene.lens.compute_point_jacobian(seen, self.centres_px)
        by_lens = self.whitener @ scene.lens.compute_vector_jacobian(seen)
        return Slopes(
            self.picture,
            self.marker,
            np.concatenate([by_lens, by_point @ to_table], axis=2),
            by_point @ to_errors[:, :, self.freed],
            by_point @ to_points,
        )

    def apply_step(self, scene: TableScene, change: Float) -> TableScene:
        """The scene a step (n,) of camera, table, free table errors and board points away."""
        lens, free = len(scene.lens.vector), int(self.freed.sum())
        first_point = len(change) - scene.points_mm.size
        errors = scene.errors.copy()
        errors[:, self.freed] += change[lens + PARAMETERS : first_point].reshape(-1, free)
        return TableScene(
            scene.lens.apply_step(change[:lens]),
            scene.table.apply_step(change[lens : lens + PARAMETERS]),
            errors,
            scene.points_mm + change[first_point:].reshape(-1, 3),
        )


def build_table_problem(positions: Positions, board: Board, sigma: TableSigma, **chosen: Any) -> TableProblem:
    """chosen: as `whitened` takes it."""
    freed = sigma.vector > 0
    return TableProblem(
        **build_problem_fields(positions, board, **chosen),
        linear_mm=positions.linear_mm,
        rotary_deg=positions.rotary_deg,
        freed=freed,
        errors_sigma=np.where(freed, sigma.vector, 1.0),
    )


def compute_lens_sigma(lens: Pinhole) -> Float:
    """Weak priors of the distortion: each term moves the image's corner by a part of its radius.

    They bound only combinations that the markers do not see, such as k1 against k4.
    """
    width, height = lens.image_size
    corner = math.hypot(width, height) / 2 / float(lens.focal_px.mean())
    return _LENS_PRIOR / corner ** _LENS_ORDERS[: len(lens.distortion)]


# Round numbers; nothing was measured. With less travel camera and table cannot be separated.
_LEAST_TURN_DEG = 5.0
_LEAST_TRAVEL_MM = 10.0


def fit_table(
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
    rotary = _find_rotary_axis(rotary_deg, rotations)
    turns = Rotation.from_rotvec(rotary_deg[:, None] * rotary, degrees=True)
    mount = (turns.inv() * Rotation.from_matrix(rotations)).mean().as_matrix()
    base_mm, linear, offset_mm = _fit_offsets(linear_mm, turns.as_matrix(), translations_mm)
    # What of o is along the axis is for the wobble to act on, and otherwise the same as a shift of the base.
    along = rotary * (rotary @ (offset_mm + mount @ middle_mm))
    return TableGeometry(base_mm + along, linear, rotary, mount, offset_mm - along)


def _find_rotary_axis(rotary_deg: Float, rotations: Float) -> Float:
    """Unit vector about which the target turns with rising angle: sum of all turns from the first position."""
    total = (rotary_deg - rotary_deg[0]) @ Rotation.from_matrix(rotations @ rotations[0].T).as_rotvec()
    return total / np.linalg.norm(total)


def _fit_offsets(linear_mm: Float, turns: Float, translations_mm: Float) -> tuple[Float, Float, Float]:
    """c, l and o of t = c + z l + turn o, by least squares."""
    identity = np.broadcast_to(np.eye(3), turns.shape)
    design = np.concatenate([identity, linear_mm[:, None, None] * np.eye(3), turns], axis=2).reshape(-1, 9)
    found = np.asarray(np.linalg.lstsq(design, translations_mm.ravel(), rcond=1e-9)[0], np.float64)
    return found[:3], found[3:6] / np.linalg.norm(found[3:6]), found[6:]


# A bound only: rounds end when the discrepancy and the outliers are settled.
_ROUNDS = 10
# Times the median of normal noise, and 6 sigma at the least. Round numbers; nothing was measured. Of normal noise one
# marker in 6e7 lies beyond 6 sigma; beyond half of it one in 90 does, which is then dropped.
_OUTLIER = 8.0
_LEAST_OUTLIER_SIGMA = 6.0
_MEDIAN_LENGTH = 1.18
"""Of a vector of two coordinates of unit variance."""
# With more than 2 % beyond, nothing is dropped: that is no set of stray markers but a wrong target or a wrong order.
# Round number; nothing was measured.
_MOST_OUTLIERS = 0.02
_CLOSE_TO_ONE = 0.02  # of chi^2, when a discrepancy is fitted: its standard deviation is then 1 % off at most


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
        return compute_convex_hull(self.positions.centres_px[self.used])

    @property
    def normalised(self) -> Float:
        """(P, N, 2): residuals in units of the detection sigma of their coordinate."""
        return self.residuals_px / np.sqrt(np.diagonal(self.positions.covariance_px2, axis1=2, axis2=3))

    @property
    def reprojection_ratio(self) -> float:
        """Root mean square residual per coordinate over the detection sigma."""
        return float(np.sqrt(np.mean(self.normalised[self.used] ** 2)))

    def compute_poses(self) -> tuple[Float, Float]:
        """Rotation (P, 3, 3) and translation (P, 3), mm, of the target at each position."""
        return self.scene.table.compute_poses(self.positions.linear_mm, self.positions.rotary_deg, self.scene.errors)


@dataclass(frozen=True, slots=True, eq=False)
class _Iteration:
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
class InitialGuess:
    """The place where an adjustment begins: Brown's camera and the table, with the corrections (P, N, 2), px, by
    homographies."""

    scene: TableScene
    shifts_px: Float


def adjust(
    positions: Positions, board: Board, sigma: TableSigma, *, rational: bool = False, start: InitialGuess | None = None
) -> Adjustment:
    """Calibrate: OpenCV and the target's poses give the start, then everything is adjusted together.

    start: of these positions, where it is known already. Rounds follow until the eccentricity of the discs, the
    outliers and the discrepancy are settled. CalibrationError when the observations do not determine a camera.
    """
    start = start or find_initial_guess(positions, board)
    scene, shifts = start.scene, start.shifts_px
    if rational:
        scene = replace(scene, lens=Pinhole(np.concatenate([scene.lens.vector, np.zeros(3)]), scene.lens.image_size))
    given = positions, board, sigma
    found = _adjust_once(*given, start=scene, shifts_px=shifts, used=positions.seen, discrepancy_px=0.0)
    for _ in range(_ROUNDS):
        scene = found.solution.state
        poses = scene.table.compute_poses(positions.linear_mm, positions.rotary_deg, scene.errors)
        shifts = compute_camera_shifts(scene.lens.project, *poses, scene.points_mm, board.diameters_mm)
        discrepancy_px = found.discrepancy_px
        if not found.is_explained:
            discrepancy_px = update_discrepancy(positions.sigma_px**2, discrepancy_px, found.excess)
        found = _adjust_once(*given, start=scene, shifts_px=shifts, used=found.inliers, discrepancy_px=discrepancy_px)
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


def _adjust_once(
    positions: Positions,
    board: Board,
    sigma: TableSigma,
    *,
    start: TableScene,
    shifts_px: Float,
    used: NDArray[np.bool_],
    discrepancy_px: float,
) -> _Iteration:
    chosen = {"shifts_px": shifts_px, "used": used, "discrepancy_px": discrepancy_px}
    problem = build_table_problem(positions, board, sigma, lens=start.lens, **chosen)
    solution = minimise(start, problem.compute_residuals, problem.build_equations, problem.apply_step)
    degrees = len(problem.compute_residuals(solution.state)) - len(solution.covariance)
    chi2 = solution.cost / degrees
    excess = max(chi2, _compute_board_excess(solution, board))
    residuals = _compute_residuals(solution.state, positions, shifts_px)
    slack = 3 * np.sqrt(2 / degrees) if discrepancy_px == 0 else _CLOSE_TO_ONE
    return _Iteration(
        solution=solution,
        shifts_px=shifts_px,
        used=used,
        discrepancy_px=discrepancy_px,
        residuals_px=residuals,
        inliers=_find_inliers(residuals, positions, discrepancy_px),
        chi2=chi2,
        excess=excess,
        is_explained=bool(excess <= 1 + slack and (discrepancy_px == 0 or excess >= 1 - slack)),
    )


def _compute_board_excess(solution: Solution[TableScene], board: Board) -> float:
    """Squared corrections of the board in its plane over what its prior allows, less three standard errors.

    A lens that the model cannot follow bends the board before it shows in the residuals.
    """
    moved = (solution.state.points_mm - board.points_mm) / board.sigma_mm
    left = 1 - np.diag(solution.covariance)[-moved.size :].reshape(-1, 3) / board.sigma_mm**2
    free = float(np.sum(left[:, :2]))
    return float(np.sum(moved[:, :2] ** 2)) / free - 3 * np.sqrt(2 / free)


def find_initial_guess(positions: Positions, board: Board) -> InitialGuess:
    """Camera and poses by OpenCV, of centres corrected by the homographies."""
    shifts = np.array(
        [compute_homography_shifts(centres, board.points_mm, board.diameters_mm) for centres in positions.centres_px]
    )
    centres = positions.centres_px - shifts
    start = calibrate_opencv(centres, board.points_mm, positions.image_size)
    table = fit_table(
        positions.linear_mm, positions.rotary_deg, start.rotations, start.translations_mm, board.points_mm.mean(axis=0)
    )
    return InitialGuess(TableScene(start.lens, table, np.zeros((len(centres), ERRORS)), board.points_mm), shifts)


def _compute_residuals(scene: TableScene, positions: Positions, shifts_px: Float) -> Float:
    """(P, N, 2): computed minus measured centres, px; NaN without a centre."""
    rotations, translations = scene.table.compute_poses(positions.linear_mm, positions.rotary_deg, scene.errors)
    seen = transform_points(rotations, translations, scene.points_mm)
    return scene.lens.project(seen) - (positions.centres_px - shifts_px)


def _find_inliers(residuals_px: Float, positions: Positions, discrepancy_px: float) -> NDArray[np.bool_]:
    """(P, N): markers not far outside the scatter of all, unless those that are would be too many for accidents."""
    seen = positions.seen
    lengths = compute_normalised_lengths(residuals_px[seen], positions.covariance_px2[seen], discrepancy_px)
    near = lengths <= max(_LEAST_OUTLIER_SIGMA, _OUTLIER * float(np.median(lengths)) / _MEDIAN_LENGTH)
    inliers = seen.copy()
    if np.mean(~near) <= _MOST_OUTLIERS:
        inliers[seen] = near
    return inliers
