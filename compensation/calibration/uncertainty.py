"""How well a calibration knows where a point is seen, pixel by pixel, at a stated distance.

A point is held still among the table's targets, not in the camera's frame: an error of the camera's axis that the
poses share changes no image. As mrcal's: the point moves with the mean of all adjusted target poses.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from thermostand.compensation.calibration.adjustment import Adjustment
from thermostand.compensation.calibration.least_squares import Float
from thermostand.compensation.calibration.pinhole import transform_points
from thermostand.compensation.calibration.stage_geometry import ERRORS, PARAMETERS
from thermostand.compensation.drift.hull import compute_distances_px

NOT_SEEN = "not seen here (no marker was near, so nothing is known of the lens)"
# Twice as far out, errors lie between the 1.3 and the 5 times of the measurement below.
_BEYOND = 0.1
"""Of the hull's mean radius. Measured on 24 drawn lenses (f 1000 to 7246 px, markers within 35 to 100 % of the
picture; ripples of 0 to 50 mpx that the lens model cannot follow): up to here errors are 1.3 times as many sigma as
among the markers, beyond 0.4 they are 5 times as many."""


def is_near_markers(pixels: Float, hull_px: Float) -> NDArray[np.bool_]:
    """(...): whether pixels (..., 2) are among the markers, whose hull (H, 2) is, or near them."""
    radius_px = float(np.linalg.norm(hull_px - hull_px.mean(axis=0), axis=1).mean())
    inside_px = compute_distances_px(pixels.reshape(-1, 2), hull_px).min(axis=1).reshape(pixels.shape[:-1])
    return np.asarray(inside_px >= -_BEYOND * radius_px)


@dataclass(frozen=True, slots=True, eq=False)
class UncertaintyMap:
    """pixels (H, W, 2), covariance_px2 (H, W, 2, 2) of the projection at distance_mm; NaN where nobody has looked."""

    distance_mm: float
    pixels: Float
    covariance_px2: Float

    @property
    def sigma_px(self) -> Float:
        """(H, W): root mean square of the two coordinates' standard uncertainties; NaN where nobody has looked."""
        return np.sqrt(np.trace(self.covariance_px2, axis1=-2, axis2=-1) / 2)


def make_pixel_grid(image_size: tuple[int, int], columns: int) -> Float:
    """Evenly spread pixels (H, W, 2) from corner to corner."""
    width, height = image_size
    rows = max(2, round(columns * height / width))
    return np.stack(np.meshgrid(np.linspace(0, width - 1, columns), np.linspace(0, height - 1, rows)), axis=-1)


def compute_projection_uncertainty(adjustment: Adjustment, distance_mm: float, columns: int = 25) -> UncertaintyMap:
    """The covariance of the projection on a grid of pixels, of points at Z = distance_mm; NaN where not seen."""
    lens = adjustment.scene.lens
    pixels = make_pixel_grid(lens.image_size, columns)
    slopes = lens.compute_slopes(pixels.reshape(-1, 2))
    points = np.column_stack([slopes, np.ones(len(slopes))]) * distance_mm
    jacobian = _compute_jacobian(adjustment, points, pixels.reshape(-1, 2))
    covariance = adjustment.covariance[: jacobian.shape[2], : jacobian.shape[2]]
    found = (jacobian @ covariance @ np.swapaxes(jacobian, 1, 2)).reshape(*pixels.shape, 2)
    known = is_near_markers(pixels, adjustment.hull_px)[..., None, None]
    return UncertaintyMap(distance_mm, pixels, np.where(known, found, np.nan))


def _compute_jacobian(adjustment: Adjustment, points_mm: Float, pixels: Float) -> Float:
    """Derivative (K, 2, n) of the images of points (K, 3) with respect to camera, table and its errors."""
    scene, positions, free = adjustment.scene, adjustment.positions, int(adjustment.freed.sum())
    rotations, translations = adjustment.compute_poses()
    count = len(rotations)
    first_error = len(scene.lens.vector) + PARAMETERS
    moves = np.zeros((len(points_mm), 3, first_error + free * count - len(scene.lens.vector)))
    for index in range(count):
        on_target = (points_mm - translations[index]) @ rotations[index]
        at = np.full(len(points_mm), index)
        table, errors, _ = scene.table.compute_jacobian(
            on_target, positions.linear_mm[at], positions.rotary_deg[at], scene.errors[at]
        )
        moves[:, :, :PARAMETERS] += table / count
        begin = PARAMETERS + free * index
        moves[:, :, begin : begin + free] = errors[:, :, adjustment.freed] / count
    by_point = scene.lens.compute_point_jacobian(points_mm, pixels)
    return np.concatenate([scene.lens.compute_vector_jacobian(points_mm), by_point @ moves], axis=2)


@dataclass(frozen=True, slots=True, eq=False)
class CameraDifference:
    """pixels (H, W, 2), shift_px (H, W, 2): where the second camera sees what the first one sees at the pixels; NaN
    where one of them saw no marker."""

    distance_mm: float
    pixels: Float
    shift_px: Float

    @property
    def rms_px(self) -> float:
        """Root mean square per coordinate over what of the grid both have seen."""
        return float(np.sqrt(np.nanmean(self.shift_px**2)))


def compare_calibrations(
    first: Adjustment, second: Adjustment, distance_mm: float, columns: int = 25
) -> CameraDifference:
    """Return how two calibrations from different positions of one table differ, their frames brought together by the
    table."""
    turn, shift = _align_tables(first, second)
    pixels = make_pixel_grid(first.scene.lens.image_size, columns)
    slopes = first.scene.lens.compute_slopes(pixels)
    points = np.concatenate([slopes, np.ones((*slopes.shape[:-1], 1))], axis=-1) * distance_mm
    moved_px = second.scene.lens.project(points @ turn.T + shift) - pixels
    known = is_near_markers(pixels, first.hull_px) & is_near_markers(pixels, second.hull_px)
    return CameraDifference(distance_mm, pixels, np.where(known[..., None], moved_px, np.nan))


def _align_tables(first: Adjustment, second: Adjustment) -> tuple[Float, Float]:
    """Rotation and translation (mm) from the first camera's frame to the second's: the same target, where either
    table's axes put it, in the sense of least squares over both sessions' positions."""
    linear = np.concatenate([first.positions.linear_mm, second.positions.linear_mm])
    rotary = np.concatenate([first.positions.rotary_deg, second.positions.rotary_deg])
    clouds: list[Float] = []
    for adjustment in (first, second):
        rotations, translations = adjustment.scene.table.compute_poses(linear, rotary, np.zeros((len(linear), ERRORS)))
        points = adjustment.board.points_mm
        clouds.append(transform_points(rotations, translations, points).reshape(-1, 3))
    return _fit_rigid_motion(*clouds)


def _fit_rigid_motion(source: Float, destination: Float) -> tuple[Float, Float]:
    """Rotation and translation of least squares between two clouds (K, 3), by Kabsch."""
    from_mean, to_mean = source.mean(axis=0), destination.mean(axis=0)
    turn = Rotation.align_vectors(destination - to_mean, source - from_mean)[0].as_matrix()
    return turn, to_mean - turn @ from_mean
