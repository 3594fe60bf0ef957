"""The joint adjustment's residuals and their derivatives.

    minimise  sum |W (project(p) - centre)|^2 + sum ((X - X0)/s_X)^2 + sum (d/s_d)^2 + sum (w/s_w)^2

W: inverse square root of a marker's covariance; X0, s_X: the measured or nominal board; d, w: the table's errors at a
position (compensation/calibration/stage_geometry.py). Everything that is known enters with its uncertainty: taking
board or table as exact would put their errors into the camera.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thermostand.compensation.calibration.board import Board
from thermostand.compensation.calibration.least_squares import Float, whiteners
from thermostand.compensation.calibration.pinhole import Pinhole
from thermostand.compensation.calibration.session_centres import Positions
from thermostand.compensation.calibration.stage_geometry import PARAMETERS, TableGeometry, TableSigma


@dataclass(frozen=True, slots=True, eq=False)
class Slopes:
    """Derivatives of M whitened markers, of board point marker[m] in picture[m]: common (M, 2, C) with respect to what
    all share, own (M, 2, F) to what the picture has of its own, points (M, 2, 3) to the board point."""

    picture: NDArray[np.int64]
    marker: NDArray[np.int64]
    common: Float
    own: Float
    points: Float


def equations_of(slopes: Slopes, off: Float, pictures: int, markers: int) -> tuple[Float, Float]:
    """J' J (n, n) and J' r (n,) of residuals off (M, 2); n = C, then F of each picture, then 3 of each board point."""
    common, own, points, off = (
        _placed(slopes, part, pictures, markers) for part in (slopes.common, slopes.own, slopes.points, off[..., None])
    )
    of_pictures = [part.reshape(pictures, 2 * markers, part.shape[-1]) for part in (common, own, off)]
    of_markers = [
        np.swapaxes(part, 0, 1).reshape(markers, 2 * pictures, part.shape[-1]) for part in (common, points, off)
    ]
    to_own, to_points = np.swapaxes(of_pictures[1], 1, 2), np.swapaxes(of_markers[1], 1, 2)
    flat = common.reshape(-1, common.shape[-1])
    beside = np.concatenate([_rows(to_own @ of_pictures[0]), _rows(to_points @ of_markers[0])])
    crossed = np.swapaxes(np.swapaxes(own, 2, 3) @ points, 1, 2).reshape(-1, 3 * markers)
    others = [[_diagonal(to_own @ of_pictures[1]), crossed], [crossed.T, _diagonal(to_points @ of_markers[1])]]
    normal = np.block([[flat.T @ flat, beside.T], [beside, np.block(others)]])
    parts = flat.T @ off.ravel(), (to_own @ of_pictures[2]).ravel(), (to_points @ of_markers[2]).ravel()
    return normal, np.concatenate(parts)


def _placed(slopes: Slopes, values: Float, pictures: int, markers: int) -> Float:
    """(pictures, markers, 2, K) of (M, 2, K): 0 where a marker is not used."""
    placed = np.zeros((pictures, markers, *values.shape[1:]))
    placed[slopes.picture, slopes.marker] = values
    return placed


def _rows(blocks: Float) -> Float:
    """(B K, C) of blocks (B, K, C)."""
    return blocks.reshape(-1, blocks.shape[-1])


def _diagonal(blocks: Float) -> Float:
    """(B K, B K) of blocks (B, K, K)."""
    count, size, _ = blocks.shape
    matrix = np.zeros((count, size, count, size))
    each = np.arange(count)
    matrix[each, :, each] = blocks
    return matrix.reshape(count * size, count * size)


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


@dataclass(frozen=True, slots=True, eq=False)
class Problem:
    """The whitened problem: M used markers, at position[m] with board point marker[m]."""

    position: NDArray[np.int64]
    marker: NDArray[np.int64]
    linear_mm: Float
    rotary_deg: Float
    centres_px: Float
    whitener: Float
    prior_mm: Float
    sigma_mm: Float
    freed: NDArray[np.bool_]
    errors_sigma: Float
    lens_sigma: Float

    @property
    def count(self) -> int:
        """How many residuals there are, those of the priors included."""
        errors = int(self.freed.sum()) * len(self.linear_mm)
        return 2 * len(self.position) + len(self.lens_sigma) + errors + self.prior_mm.size

    def residuals(self, scene: TableScene) -> Float:
        """(count,): markers (x, y each), distortion, table errors, board; all of unit variance."""
        seen = _seen_points(scene, self)
        off = np.einsum("mij,mj->mi", self.whitener, scene.lens.project(seen) - self.centres_px)
        return np.concatenate(
            [
                off.ravel(),
                scene.lens.distortion / self.lens_sigma,
                (scene.errors / self.errors_sigma)[:, self.freed].ravel(),
                ((scene.points_mm - self.prior_mm) / self.sigma_mm).ravel(),
            ]
        )

    def slopes(self, scene: TableScene) -> Slopes:
        """Derivatives of the markers' residuals."""
        points = scene.points_mm[self.marker]
        seen = _seen_points(scene, self)
        linear, rotary = self.linear_mm[self.position], self.rotary_deg[self.position]
        to_table, to_errors, to_points = scene.table.jacobian(points, linear, rotary, scene.errors[self.position])
        by_point = self.whitener @ scene.lens.point_jacobian(seen, self.centres_px)
        by_lens = self.whitener @ scene.lens.vector_jacobian(seen)
        return Slopes(
            self.position,
            self.marker,
            np.concatenate([by_lens, by_point @ to_table], axis=2),
            by_point @ to_errors[:, :, self.freed],
            by_point @ to_points,
        )

    def equations(self, scene: TableScene, residuals: Float) -> tuple[Float, Float]:
        """Normal matrix (n, n) and gradient (n,) of a step of camera, table, free table errors and board points."""
        off = residuals[: 2 * len(self.position)].reshape(-1, 2)
        normal, gradient = equations_of(self.slopes(scene), off, len(self.linear_mm), len(self.prior_mm))
        errors = np.tile(1 / self.errors_sigma[self.freed], len(scene.errors))
        weights = np.concatenate([1 / self.lens_sigma, errors, 1 / self.sigma_mm.ravel()])
        lens, others = len(scene.lens.vector), len(weights) - len(self.lens_sigma)
        known = np.concatenate([np.arange(4, lens), np.arange(len(normal) - others, len(normal))])
        normal[known, known] += weights**2
        gradient[known] += weights * residuals[off.size :]
        return normal, gradient

    def stepped(self, scene: TableScene, change: Float) -> TableScene:
        """The scene a step (n,) away."""
        lens, free = len(scene.lens.vector), int(self.freed.sum())
        first_point = len(change) - scene.points_mm.size
        errors = scene.errors.copy()
        errors[:, self.freed] += change[lens + PARAMETERS : first_point].reshape(-1, free)
        return TableScene(
            scene.lens.stepped(change[:lens]),
            scene.table.stepped(change[lens : lens + PARAMETERS]),
            errors,
            scene.points_mm + change[first_point:].reshape(-1, 3),
        )


def problem_of(
    positions: Positions,
    shifts_px: Float,
    used: NDArray[np.bool_],
    board: Board,
    sigma: TableSigma,
    discrepancy_px: float,
    lens: Pinhole,
) -> Problem:
    """The problem of the markers `used` (P, N), their ellipses' centres moved by -shifts_px (P, N, 2) to the discs'."""
    position, marker = np.nonzero(used)
    covariance = positions.covariance_px2[used] + discrepancy_px**2 * np.eye(2)
    sigma_vector = sigma.vector
    freed = sigma_vector > 0
    return Problem(
        position=position,
        marker=marker,
        linear_mm=positions.linear_mm,
        rotary_deg=positions.rotary_deg,
        centres_px=(positions.centres_px - shifts_px)[used],
        whitener=whiteners(covariance),
        prior_mm=board.points_mm,
        sigma_mm=board.sigma_mm,
        freed=freed,
        errors_sigma=np.where(freed, sigma_vector, 1.0),
        lens_sigma=lens_sigma(lens),
    )


def _seen_points(scene: TableScene, problem: Problem) -> Float:
    """(M, 3): the used markers in the camera's frame, mm."""
    rotations, translations = scene.table.poses(problem.linear_mm, problem.rotary_deg, scene.errors)
    points = scene.points_mm[problem.marker]
    turned = np.einsum("mij,mj->mi", rotations[problem.position], points)
    return turned + translations[problem.position]


def lens_sigma(lens: Pinhole) -> Float:
    """Weak priors of the distortion: each term moves the image's corner by a part of its radius.

    They bound only combinations that the markers do not see, such as k1 against k4.
    """
    width, height = lens.image_size
    corner = math.hypot(width, height) / 2 / float(lens.focal_px.mean())
    return _LENS_PRIOR / corner ** _LENS_ORDERS[: len(lens.distortion)]
