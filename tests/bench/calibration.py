"""Calibration beside cv2.calibrateCamera on the same drawn laboratories: residuals, validation positions, time.

The truth is the tests' own generator (tests/compensation/calibration_truth.py): 34 positions, 54 markers, 3 mpx of
detection noise, a print that is 20 um off and measured to 1 um, a table of 0.5 um and 0.1 arcmin. Both get the
measured board. Translations are those of the target's centre from V0 to V1..V3, in the frame of the table's axes:
the peer's frame is given by its own poses of the calibration positions, so each gets its axes from what it found.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tests.bench import mrcal_peer
from tests.bench.figures import Figure, at_most, in_turns, milliseconds, progress, side_by_side
from tests.compensation.calibration_truth import (
    SIZE,
    CENTRE_mm,
    Laboratory,
    TrueCamera,
    Truth,
    board,
    draw,
    positions,
    translation_errors_um,
)
from thermostand.compensation.calibration.adjustment import Adjustment, adjust, table_from_poses
from thermostand.compensation.calibration.board import Board, shifts_by_homography
from thermostand.compensation.calibration.calibrate import halves, rays_of
from thermostand.compensation.calibration.pinhole import OpencvCalibration, calibrate_opencv
from thermostand.compensation.calibration.session_centres import Positions
from thermostand.compensation.calibration.stage_geometry import TableGeometry, TableSigma

SEEDS = range(6)
ROUNDS = 3
NOISE_mpx = 3.0
TABLE = TableSigma(linear_mm=0.0005, rotary_arcmin=0.1)
PEER = "cv2.calibrateCamera, CMM board"
GOALS_um = (1.0, 1.0, 1.5)

Float = NDArray[np.float64]


def figures(directory: Path) -> list[Figure]:
    """Residuals, translation errors with a perfect lens and with a ripple, the halves, time."""
    progress("calibration, laboratories")
    found = [_Case(draw(Truth(seed=seed))) for seed in SEEDS]
    rippled = [_Case(draw(Truth(seed=seed, camera=TrueCamera(ripple_px=0.05)))) for seed in SEEDS]
    progress("calibration, times")
    return [
        at_most(1.05, _residuals(found)),
        *(at_most(goal, figure) for goal, figure in zip(GOALS_um, _translations("pinhole", found), strict=True)),
        *_translations("rays, degree 5", found, rays=True),
        *_translations("pinhole, lens ripple 0.05 px", rippled),
        *_translations("rays, lens ripple 0.05 px", rippled, rays=True),
        _halves(found[0]),
        _time(found[0]),
        *mrcal_peer.figures(),
    ]


class _Case:
    """One laboratory, calibrated by both."""

    def __init__(self, laboratory: Laboratory) -> None:
        self.laboratory = laboratory
        self.seen, self.board = positions(laboratory), board(laboratory)
        self.ours = adjust(self.seen, self.board, TABLE)
        self.corrected = _corrected(self.seen, self.board)
        self.peer = _opencv(self.corrected, self.board)

    def our_errors_um(self, *, rays: bool) -> Float:
        adjusted: Adjustment = self.ours
        lens = rays_of(adjusted, 5) if rays else adjusted.scene.lens
        return translation_errors_um(self.laboratory, lens, adjusted.adjusted_board, adjusted.scene.table)

    def peer_errors_um(self) -> Float:
        table: TableGeometry = table_from_poses(
            self.seen.linear_mm, self.seen.rotary_deg, self.peer.rotations, self.peer.translations_mm, CENTRE_mm
        )
        return translation_errors_um(self.laboratory, self.peer.lens, self.board, table)


def _corrected(seen: Positions, known: Board) -> Float:
    """The discs' centres for the peer, which knows nothing of discs."""
    shifts = [shifts_by_homography(centres, known.points_mm, known.diameters_mm) for centres in seen.centres_px]
    return seen.centres_px - np.array(shifts)


def _opencv(centres_px: Float, known: Board) -> OpencvCalibration:
    return calibrate_opencv(centres_px, known.points_mm, SIZE)


def _residuals(cases: list[_Case]) -> Figure:
    ours = [case.ours.reprojection_ratio for case in cases]
    theirs = [1e3 * case.peer.rms_px / np.sqrt(2) / NOISE_mpx for case in cases]
    return side_by_side("calibration, reprojection per coordinate", "detection sigma", PEER, ours, theirs)


def _translations(model: str, cases: list[_Case], *, rays: bool = False) -> list[Figure]:
    """Root mean square over V1..V3 and all laboratories, for X, Y and Z."""
    ours = _rms([case.our_errors_um(rays=rays) for case in cases])
    theirs = _rms([case.peer_errors_um() for case in cases])
    return [
        side_by_side(f"calibration, V0..V3 along {axis}, {model}", "um RMS", PEER, [own], [other])
        for axis, own, other in zip("XYZ", ours, theirs, strict=True)
    ]


def _rms(errors: list[Float]) -> list[float]:
    return np.sqrt(np.mean(np.concatenate(errors) ** 2, axis=0)).tolist()


def _halves(case: _Case) -> Figure:
    """Calibrations from every other position and from the rest, at 826 mm."""
    found = halves(case.seen, case.board, TABLE, 826.0, rational=False)
    return Figure("calibration, the halves' projections differ by", "mpx RMS", 1e3 * found.rms_px, "absolute")


def _time(case: _Case) -> Figure:
    own, other = in_turns(
        lambda: milliseconds(lambda: adjust(case.seen, case.board, TABLE)),
        lambda: milliseconds(lambda: _opencv(case.corrected, case.board)),
        ROUNDS,
    )
    return side_by_side("calibration, camera, table and board together", "ms", PEER, own, other)
