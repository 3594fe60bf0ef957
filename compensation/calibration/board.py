"""What is known of the target's markers before a calibration, and after it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from thermostand.compensation.calibration.least_squares import Float
from thermostand.markers.corner_board import BoardOfCorners
from thermostand.markers.eccentricity import compute_centroid_offsets_px, compute_disc_centres_by_homography_px
from thermostand.markers.target import Target

_POINT_mm = 1e-3  # a corner has no size; 1 um keeps the outline's polygon from being empty


@dataclass(frozen=True, slots=True, eq=False)
class Board:
    """The centres of a board's markers, with what is known of them.

    Attributes
    ----------
    points_mm
        Marker centres (N, 3) in the target's frame, mm: X right, Y up, Z towards the camera.
    sigma_mm
        Standard uncertainty of each coordinate (N, 3), mm.
    diameters_mm
        Diameters (N,), mm.
    """

    points_mm: Float
    sigma_mm: Float
    diameters_mm: Float


def make_corner_board(board: BoardOfCorners) -> Board:
    """The board of a file of corners, as dots so small that their outlines have no other centres than they have."""
    sigma = np.tile([board.printing_error_mm, board.printing_error_mm, board.flatness_mm], (board.count, 1))
    points = np.column_stack([board.coordinates_mm(), np.zeros(board.count)])
    return Board(points, sigma, np.full(board.count, _POINT_mm))


def make_board(target: Target) -> Board:
    """The target file's board: measured centres with their uncertainty, or nominal ones with the printing error."""
    plane = target.coordinates_mm()
    in_plane_mm = target.printing_error_mm if target.cmm_mm is None else target.cmm_uncertainty_mm
    sigma = np.tile([in_plane_mm, in_plane_mm, target.flatness_mm], (target.count, 1))
    return Board(np.column_stack([plane, np.zeros(target.count)]), sigma, target.diameters_mm())


# How far the centres of the discs' images are from the images of their centres, for a whole calibration.
#
# Before the camera is known the target's homography stands for it; with a camera the outlines are projected. A disc of
# 8 mm at 1 m and 30 deg is off by 41 mpx per coordinate; the homography alone leaves 3 mpx where the lens distorts.

Project = Callable[[Float], Float]
"""Points (..., 3) of the camera frame, mm -> pixels (..., 2)."""

# With the radius below the polygon has the disc's second moment exactly; the number of points only affects higher
# orders.
_OUTLINE_POINTS = 32
_OUTLINE_RADIUS = float(np.sqrt(3 / (2 + np.cos(2 * np.pi / _OUTLINE_POINTS))))
"""Of the polygon over the disc's: both then have the same second moment over area, which is what moves the centroid."""


def compute_homography_shifts(centres_px: Float, points_mm: Float, diameters_mm: Float) -> Float:
    """Centre of the ellipse minus image of the centre (N, 2), px; NaN where the marker has no centre."""
    return centres_px - compute_disc_centres_by_homography_px(centres_px, points_mm[:, :2], diameters_mm / 2)


def compute_camera_shifts(
    projection: Project, rotation: Float, translation_mm: Float, points_mm: Float, diameters_mm: Float
) -> Float:
    """Centroid of the disc's image minus image of the centre (..., N, 2), px, for poses (..., 3, 3) and (..., 3)."""
    angle = 2 * np.pi / _OUTLINE_POINTS * np.arange(_OUTLINE_POINTS)
    circle = np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=1)
    outline_mm = points_mm[:, None] + _OUTLINE_RADIUS * diameters_mm[:, None, None] / 2 * circle
    target_mm = np.concatenate([outline_mm, points_mm[:, None]], axis=1)
    seen_mm = np.einsum("...ij,nkj->...nki", rotation, target_mm) + translation_mm[..., None, None, :]
    pixels = projection(seen_mm)
    return compute_centroid_offsets_px(pixels[..., :-1, :], pixels[..., -1, :])
