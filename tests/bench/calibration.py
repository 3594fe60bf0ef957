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
from tests.bench.figures import Figure, compare, measure_in_turns, measure_milliseconds, report_progress, set_upper_goal
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
from thermostand.compensation.calibration.adjustment import Adjustment, adjust, fit_table
from thermostand.compensation.calibration.board import Board, compute_homography_shifts
from thermostand.compensation.calibration.calibrate import compare_halves, fit_ray_lens
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
    report_progress("calibration, laboratories")
    found = [_Case(draw(Truth(seed=seed))) for seed in SEEDS]
    rippled = [_Case(draw(Truth(seed=seed, camera=TrueCamera(ripple_px=0.05)))) for seed in SEEDS]
    report_progress("calibration, times")
    return [
        set_upper_goal(1.05, _compare_residuals(found)),
        *(
            set_upper_goal(goal, figure)
            for goal, figure in zip(GOALS_um, _compare_translations("pinhole", found), strict=True)
        ),
        *_compare_translations("rays, degree 5", found, rays=True),
        *_compare_translations("pinhole, lens ripple 0.05 px", rippled),
        *_compare_translations("rays, lens ripple 0.05 px", rippled, rays=True),
        _compare_halves(found[0]),
        _measure_time(found[0]),
        *mrcal_peer.figures(),
    ]


class _Case:
    """One laboratory, calibrated by both."""

    def __init__(self, laboratory: Laboratory) -> None:
        self.laboratory = laboratory
        self.seen, self.board = positions(laboratory), board(laboratory)
        self.ours = adjust(self.seen, self.board, TABLE)
        self.corrected = _correct(self.seen, self.board)
        self.peer = _calibrate_opencv(self.corrected, self.board)

    def our_errors_um(self, *, rays: bool) -> Float:
        adjusted: Adjustment = self.ours
        lens = fit_ray_lens(adjusted, 5) if rays else adjusted.scene.lens
        return translation_errors_um(self.laboratory, lens, adjusted.adjusted_board, adjusted.scene.table)

    def peer_errors_um(self) -> Float:
        table: TableGeometry = fit_table(
            self.seen.linear_mm, self.seen.rotary_deg, self.peer.rotations, self.peer.translations_mm, CENTRE_mm
        )
        return translation_errors_um(self.laboratory, self.peer.lens, self.board, table)


def _correct(seen: Positions, known: Board) -> Float:
    """The discs' centres for the peer, which knows nothing of discs."""
    shifts = [compute_homography_shifts(centres, known.points_mm, known.diameters_mm) for centres in seen.centres_px]
    return seen.centres_px - np.array(shifts)


def _calibrate_opencv(centres_px: Float, known: Board) -> OpencvCalibration:
    return calibrate_opencv(centres_px, known.points_mm, SIZE)


def _compare_residuals(cases: list[_Case]) -> Figure:
    ours = [case.ours.reprojection_ratio for case in cases]
    theirs = [1e3 * case.peer.rms_px / np.sqrt(2) / NOISE_mpx for case in cases]
    return compare("calibration, reprojection per coordinate", "detection sigma", PEER, ours, theirs)


def _compare_translations(model: str, cases: list[_Case], *, rays: bool = False) -> list[Figure]:
    """Root mean square over V1..V3 and all laboratories, for X, Y and Z."""
    ours = _compute_rms([case.our_errors_um(rays=rays) for case in cases])
    theirs = _compute_rms([case.peer_errors_um() for case in cases])
    return [
        compare(f"calibration, V0..V3 along {axis}, {model}", "um RMS", PEER, [own], [other])
        for axis, own, other in zip("XYZ", ours, theirs, strict=True)
    ]


def _compute_rms(errors: list[Float]) -> list[float]:
    return np.sqrt(np.mean(np.concatenate(errors) ** 2, axis=0)).tolist()


def _compare_halves(case: _Case) -> Figure:
    """Calibrations from every other position and from the rest, at 826 mm."""
    found = compare_halves(case.seen, case.board, TABLE, 826.0, rational=False)
    return Figure("calibration, the halves' projections differ by", "mpx RMS", 1e3 * found.rms_px, "absolute")


def _measure_time(case: _Case) -> Figure:
    own, other = measure_in_turns(
        lambda: measure_milliseconds(lambda: adjust(case.seen, case.board, TABLE)),
        lambda: measure_milliseconds(lambda: _calibrate_opencv(case.corrected, case.board)),
        ROUNDS,
    )
    return compare("calibration, camera, table and board together", "ms", PEER, own, other)
