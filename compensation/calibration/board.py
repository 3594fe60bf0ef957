"""What is known of the target's markers before a calibration, and after it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from thermostand.compensation.calibration.least_squares import Float
from thermostand.markers.corner_board import BoardOfCorners
from thermostand.markers.target import Target

_POINT_mm = 1e-3


@dataclass(frozen=True, slots=True, eq=False)
class Board:
    """Marker centres (N, 3) in the target's frame (X right, Y up, Z towards the camera), mm, with the standard
    uncertainty of each coordinate (N, 3), mm, and the diameters (N,), mm."""

    points_mm: Float
    sigma_mm: Float
    diameters_mm: Float


def board_of_corners(board: BoardOfCorners) -> Board:
    """The board of a file of corners, as dots so small that their outlines have no other centres than they have."""
    sigma = np.tile([board.printing_error_mm, board.printing_error_mm, board.flatness_mm], (board.count, 1))
    points = np.column_stack([board.coordinates_mm(), np.zeros(board.count)])
    return Board(points, sigma, np.full(board.count, _POINT_mm))


def board_of(target: Target) -> Board:
    """The target file's board: measured centres with their uncertainty, or nominal ones with the printing error."""
    plane = target.coordinates_mm()
    in_plane_mm = target.printing_error_mm if target.cmm_mm is None else target.cmm_uncertainty_mm
    sigma = np.tile([in_plane_mm, in_plane_mm, target.flatness_mm], (target.count, 1))
    return Board(np.column_stack([plane, np.zeros(target.count)]), sigma, target.diameters_mm())
