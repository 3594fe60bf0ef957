"""The drawn laboratory as the program gets it, and how far its poses are from the true ones."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from thermostand.compensation.calibration.board import Board, board_of
from thermostand.compensation.calibration.pose import Lens, find_pose
from thermostand.compensation.calibration.session_centres import Positions
from thermostand.compensation.calibration.stage_geometry import TableGeometry
from thermostand.markers.target import Target

from .calibration_truth import SIZE, Laboratory, true_table_frame

Float = NDArray[np.float64]

CENTRE_mm = np.array([120.0, 75.0, 0.0])


def target_of(laboratory: Laboratory, *, measured: bool = True) -> Target:
    """The paper's target, with the drawn CMM coordinates or with nominal ones."""
    cmm = tuple((float(x), float(y)) for x, y in laboratory.cmm_mm) if measured else None
    return Target(name="drawn", columns=9, rows=6, pitch_mm=30, diameter_mm=8, cmm_mm=cmm)


def board(laboratory: Laboratory, *, measured: bool = True) -> Board:
    return board_of(target_of(laboratory, measured=measured))


def positions(laboratory: Laboratory) -> Positions:
    centres = laboratory.centres_px.copy()
    return Positions(
        linear_mm=laboratory.recorded[:, 0],
        rotary_deg=laboratory.recorded[:, 1],
        centres_px=centres,
        covariance_px2=np.tile(laboratory.covariance_px2, (*centres.shape[:2], 1, 1)),
        frames=np.ones(len(centres), np.int64),
        flags=np.zeros(centres.shape[:2], np.uint8),
        chi=float("nan"),
        image_size=SIZE,
    )


def covariances(laboratory: Laboratory) -> Float:
    return np.tile(laboratory.covariance_px2, (54, 1, 1))


def translation_errors_um(laboratory: Laboratory, lens: Lens, known: Board, table: TableGeometry) -> Float:
    """(3, 3): V0 -> V1, V2, V3 of the target's centre in the table's frame, found minus true, X Y Z in um."""
    poses = [find_pose(lens, known, centres, covariances(laboratory)) for centres in laboratory.validation_px]
    found = np.array([pose.place_mm(CENTRE_mm) for pose in poses]) @ table.frame.T
    true = laboratory.validation_rotations @ CENTRE_mm + laboratory.validation_translations_mm
    true = true @ true_table_frame().T
    return 1e3 * ((found[1:] - found[0]) - (true[1:] - true[0]))
