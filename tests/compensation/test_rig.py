"""Cameras of a rig against the drawn truth, which OpenCV projects."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from thermostand.compensation.calibration.board import Board
from thermostand.compensation.calibration.rig import RigCalibration, calibrate_rig
from thermostand.compensation.calibration.session_centres import Views
from thermostand.compensation.cli import app
from thermostand.foundation.errors import CalibrationError

from .renderer import Scene, photograph, render

Float = NDArray[np.float64]

SIZE = (1224, 1024)
NOISE_px = 0.02
MATRIX = np.array([[1500.0, 0, 611.5], [0, 1500.0, 511.5], [0, 0, 1]])
DISTORTION = np.array([-0.12, 0.08, 3e-4, -2e-4, 0.0])
TURNS = Rotation.from_euler("xyz", [(0, 0, 0), (1, -9, 2), (-7, 3, 90)], degrees=True).as_matrix()
SHIFTS_mm = np.array([(0, 0, 0), (160.0, 3, 20), (-20, 90, 30)])
COLUMNS, ROWS = 6, 4


def drawn(seed: int, cameras: int, moments: int = 9) -> tuple[list[Views], Board]:
    """What each camera sees of a board that is 30 um off its print, tilted to all sides 700 mm away."""
    rng = np.random.default_rng(seed)
    row, column = np.divmod(np.arange(COLUMNS * ROWS), COLUMNS)
    places = np.column_stack([40.0 * column, 40.0 * row, np.zeros(len(row))])
    sigma = np.full(places.shape, 0.03)
    true = places + sigma * rng.standard_normal(places.shape)
    centres = np.full((cameras, moments, len(places), 2), np.nan)
    for moment in range(moments):
        angle = 2 * np.pi * moment / moments
        tilt = Rotation.from_rotvec(np.radians(25) * np.array([np.cos(angle), np.sin(angle), 0.2]))
        turn = np.diag([1.0, -1.0, -1.0]) @ tilt.as_matrix()
        shift = np.array([*rng.uniform(-40, 40, 2), 700 + 60 * np.sin(3 * angle)]) - turn @ places.mean(axis=0)
        in_rig = true @ turn.T + shift
        for camera in range(cameras):
            points = in_rig @ TURNS[camera].T + SHIFTS_mm[camera]
            pixels = cv2.projectPoints(points, np.zeros(3), np.zeros(3), MATRIX, DISTORTION)[0].reshape(-1, 2)
            inside = np.all((pixels > 5) & (pixels < np.array(SIZE) - 5), axis=1)
            pixels = pixels + NOISE_px * rng.standard_normal(pixels.shape)
            centres[camera, moment] = np.where(inside[:, None], pixels, np.nan)
    covariance = np.tile(NOISE_px**2 * np.eye(2), (moments, len(places), 1, 1))
    return [Views(one, covariance, SIZE) for one in centres], Board(places, sigma, np.full(len(places), 1e-3))


def errors_in_sigmas(found: RigCalibration, camera: int) -> Float:
    """Turn and shift (6,) off the truth, in their standard uncertainties."""
    turn_deg, shift_mm = found.compute_pose_sigma(camera)
    turned = Rotation.from_matrix(found.scene.rotations[camera] @ TURNS[camera].T).as_rotvec(degrees=True)
    return np.concatenate([turned / turn_deg, (found.scene.translations_mm[camera] - SHIFTS_mm[camera]) / shift_mm])


def test_two_and_three_cameras_are_found_within_their_claimed_uncertainty():
    """chi^2 of 30 numbers, correlated: 1 +- 0.3."""
    pairs = [calibrate_rig(*drawn(seed, 2)) for seed in range(3)]
    three = calibrate_rig(*drawn(7, 3))
    off = np.concatenate([*(errors_in_sigmas(one, 1) for one in pairs), *(errors_in_sigmas(three, n) for n in (1, 2))])
    assert 0.4 < np.mean(off**2) < 1.9
    assert np.abs(off).max() < 4
    assert max(pairs[0].compute_pose_sigma(1)[1]) < 0.5
    assert all(one.rms_px(0) == pytest.approx(NOISE_px, rel=0.15) for one in pairs)
    assert not pairs[0].discrepancies_px.any()


def test_a_moment_that_only_one_camera_sees_counts_and_an_outlier_does_not():
    views, board = drawn(1, 2)
    views[0].centres_px[4], views[1].centres_px[6] = np.nan, np.nan
    views[1].centres_px[2, 5] += 1.0
    found = calibrate_rig(views, board)
    assert np.isnan(found.residuals_px[1][2, 5]).all()
    assert np.abs(errors_in_sigmas(found, 1)).max() < 4


def test_the_worse_camera_has_the_larger_discrepancy():
    views, board = drawn(2, 2)
    views[1].centres_px[:] += 0.06 * np.random.default_rng(5).standard_normal(views[1].centres_px.shape)
    found = calibrate_rig(views, board)
    assert found.discrepancies_px[0] < 0.01
    assert found.discrepancies_px[1] == pytest.approx(0.06, rel=0.2)


def test_cameras_that_never_see_the_target_together_are_refused():
    views, board = drawn(1, 2, 14)
    views[0].centres_px[:7], views[1].centres_px[7:] = np.nan, np.nan
    with pytest.raises(CalibrationError, match=r"camera 2 .* at 0 moments"):
        calibrate_rig([replace(one) for one in views], board)


def test_a_camera_that_reads_the_target_from_its_other_end_is_refused():
    views, board = drawn(3, 2)
    views[1].centres_px[::2] = views[1].centres_px[::2, ::-1].copy()
    with pytest.raises(CalibrationError, match=r"camera 2 turns by"):
        calibrate_rig(views, board)


def test_the_command_takes_pictures_of_the_same_names_and_says_where_the_second_camera_is(tmp_path: Path):
    tilts = [(0, 0), (27, 4), (-26, 8), (5, 28), (0, -27), (18, 18)]
    for folder, shift_mm in (("left", (30.0, 0.0)), ("right", (-30.0, 0.0))):
        (tmp_path / folder).mkdir()
        for number, (about_x, about_y) in enumerate(tilts[: 6 if folder == "left" else 5]):
            pose = {"tilt_x_deg": about_x, "tilt_y_deg": about_y, "distance_mm": 1200.0 + 30 * number}
            scene = Scene(size=(720, 560), f_px=2200, shift_mm=shift_mm, **pose)
            cv2.imwrite(str(tmp_path / folder / f"{number}.png"), photograph(scene, render(scene), number))
    folders, out = [str(tmp_path / "left"), str(tmp_path / "right")], tmp_path / "rig"
    result = CliRunner().invoke(app, ["calibrate-rig", *folders, "--target", "paper-9x6", "--export", str(out)])
    assert result.exit_code == 0, result.output
    assert "6 moments, 2 cameras" in result.stdout
    assert "(k = 2) from left, turned by " in result.stdout
    left, right = json.loads((out / "rig.json").read_text())
    assert left["translation_mm"] == [0, 0, 0]
    off = np.array(right["translation_mm"]) - [-60, 0, 0]
    assert np.all(np.abs(off) < 4 * np.array(right["translation_sigma_mm"]))
    assert (out / "right" / "opencv.yaml").exists()
    alone = CliRunner().invoke(app, ["calibrate-rig", folders[0], "--target", "paper-9x6", "--export", str(out)])
    assert "two or more cameras" in alone.stderr
