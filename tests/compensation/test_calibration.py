"""Cameras calibrated in drawn laboratories with known truth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import yaml

from thermostand.compensation.calibration.adjustment import Adjustment, adjust
from thermostand.compensation.calibration.board import make_board
from thermostand.compensation.calibration.calibrate import (
    BROWN,
    Model,
    calibrate,
    compare_halves,
    fit_ray_lens,
    select_model,
)
from thermostand.compensation.calibration.camera_file import build_camera_file
from thermostand.compensation.calibration.pinhole import calibrate_opencv
from thermostand.compensation.calibration.pose import find_pose
from thermostand.compensation.calibration.session_centres import Positions
from thermostand.compensation.calibration.stage_geometry import TableSigma
from thermostand.compensation.calibration.uncertainty import (
    NOT_SEEN,
    compare_calibrations,
    compute_projection_uncertainty,
)
from thermostand.compensation.commands.calibration_cli import format_summary
from thermostand.compensation.reporting.pages import render_calibration_page
from thermostand.compensation.validation3d.validate import LensModel, select_lens_model
from thermostand.drivers.sim.physics.optics import (
    Nodes,
    Optics,
    StandPlacement,
    compute_optics_at,
    compute_true_centres_px,
)
from thermostand.foundation.errors import CalibrationError
from thermostand.markers.target import load_target
from thermostand.stand.config.stand_config import find_packaged

from .calibration_truth import (
    SIZE,
    CENTRE_mm,
    Laboratory,
    TrueCamera,
    Truth,
    board,
    covariances,
    draw,
    positions,
    target_of,
    translation_errors_um,
)

TABLE = TableSigma(linear_mm=0.0005, rotary_arcmin=0.1)
SEEDS = range(4)


@pytest.fixture(scope="module")
def laboratories() -> list[Laboratory]:
    return [draw(Truth(seed=seed)) for seed in SEEDS]


@pytest.fixture(scope="module")
def adjustments(laboratories: list[Laboratory]) -> list[Adjustment]:
    return [adjust(positions(laboratory), board(laboratory), TABLE) for laboratory in laboratories]


def projection_error_px(adjustment: Adjustment, laboratory: Laboratory, camera: TrueCamera) -> np.ndarray:
    """(P, 54, 2): what the calibrated camera makes of the true target at the true poses, brought into its frame."""
    rotations, translations = adjustment.compute_poses()
    own = np.einsum("pij,nj->pni", rotations, adjustment.scene.points_mm) + translations[:, None]
    true = np.einsum("pij,nj->pni", laboratory.rotations, laboratory.board_mm) + laboratory.translations_mm[:, None]
    return adjustment.scene.lens.project(own) - camera.project(true)


def test_residuals_are_the_noise_and_nothing_else(adjustments: list[Adjustment]):
    ratios = [adjustment.reprojection_ratio for adjustment in adjustments]
    assert max(ratios) < 1.02
    assert min(ratios) > 0.93
    assert all(abs(adjustment.chi - 1) < 0.04 for adjustment in adjustments)
    assert all(adjustment.discrepancy_px == 0 for adjustment in adjustments)
    assert all(adjustment.used.all() for adjustment in adjustments)


def test_the_camera_is_found_within_its_uncertainty(adjustments: list[Adjustment]):
    true = TrueCamera()
    wanted = np.array([true.f_px, true.f_px, true.cx_px, true.cy_px, true.k1, true.k2, true.p1, true.p2, true.k3])
    off = np.array([(adjustment.scene.lens.vector - wanted) / adjustment.camera_sigma for adjustment in adjustments])
    assert np.abs(off).max() < 3.7
    assert 0.6 < np.sqrt(np.mean(off**2)) < 1.5  # neither too good nor too bad


def test_fitted_projections_are_better_than_one_detection(
    adjustments: list[Adjustment], laboratories: list[Laboratory]
):
    for adjustment, laboratory in zip(adjustments, laboratories, strict=True):
        off = projection_error_px(adjustment, laboratory, TrueCamera())
        assert np.sqrt(np.mean(off**2)) < 0.0012


def test_board_and_table_are_corrected_beyond_what_was_known_of_them(
    adjustments: list[Adjustment], laboratories: list[Laboratory]
):
    for adjustment, laboratory in zip(adjustments, laboratories, strict=True):
        off = (adjustment.scene.points_mm - laboratory.board_mm)[:, :2]
        assert off.std() < 0.0003 < (laboratory.cmm_mm - laboratory.board_mm[:, :2]).std()
        assert np.sqrt(np.mean((off / adjustment.points_sigma_mm[:, :2]) ** 2)) < 1.8


def test_few_positions_give_a_camera_though_their_halves_give_none(laboratories: list[Laboratory]):
    few = positions(laboratories[1]).select(np.isin(np.arange(34), np.linspace(0, 33, 4).round()))
    found = calibrate(few, target_of(laboratories[1]))
    assert (found.model, found.halves, len(found.not_known)) == (BROWN, None, 1)
    file = build_camera_file(found, camera_serial="1", session_ids=("a",), target_name="drawn", software_version="0")
    assert file.uncertainty.halves_rms_px is None
    assert file.not_known[0] in render_calibration_page(file, found)
    assert file.not_known[0] in format_summary(file, target_of(laboratories[1]))


def test_of_a_wide_lens_what_nobody_saw_and_rays_that_do_not_describe_it_are_not_given():
    """Polynomials of degree 5 do not follow a lens of 100 deg; its corners are beyond all markers."""
    laboratory = draw(Truth(seed=1, camera=TrueCamera(f_px=1000.0, k1=-0.25, k2=0.1), distance_mm=300.0))
    few = positions(laboratory).select(np.isin(np.arange(34), np.linspace(0, 33, 5).round()))
    few.centres_px[~((few.centres_px > 0) & (few.centres_px < SIZE)).all(axis=2)] = np.nan
    found = calibrate(few, target_of(laboratory), model=Model.BROWN)
    assert found.rays_times > 5
    made = {"camera_serial": "1", "session_ids": ("a",), "target_name": "drawn", "software_version": "0"}
    file, kept = build_camera_file(found, **made), build_camera_file(found, **made, keep_rays=True)
    assert (file.rays, kept.rays is None, file.rays_warning) == (None, False, kept.rays_warning)
    assert file.rays_warning in format_summary(file, target_of(laboratory))
    assert file.rays_warning in format_summary(kept, target_of(laboratory))
    with pytest.raises(CalibrationError, match="no ray model"):
        select_lens_model(file, LensModel.RAYS)
    sigma_px = np.array(file.uncertainty.sigma_px, np.float64)
    assert np.isnan(sigma_px[[0, 0, -1, -1], [0, -1, 0, -1]]).all()
    assert np.nanmax(sigma_px) < 0.5
    assert file.uncertainty.not_seen == NOT_SEEN
    assert NOT_SEEN in format_summary(file, target_of(laboratory))
    page = render_calibration_page(file, found)
    assert file.rays_warning in page
    assert "not seen here" in page


def test_validation_positions_come_out_within_a_micrometre(
    adjustments: list[Adjustment], laboratories: list[Laboratory]
):
    errors = np.concatenate(
        [
            translation_errors_um(laboratory, adjustment.scene.lens, adjustment.adjusted_board, adjustment.scene.table)
            for adjustment, laboratory in zip(adjustments, laboratories, strict=True)
        ]
    )
    assert np.all(np.sqrt(np.mean(errors**2, axis=0)) < (0.15, 0.15, 1.3))


def test_a_poses_covariance_is_that_of_its_scatter():
    exact = draw(Truth(seed=9, noise_px=0.0, linear_mm=0.0, rotary_arcmin=0.0, cmm_mm=0.0))
    adjustment = adjust(
        replace(positions(exact), covariance_px2=np.tile(1e-8 * np.eye(2), (34, 54, 1, 1))), board(exact), TABLE
    )
    random = np.random.default_rng(5)
    covariance = np.tile(0.003**2 * np.eye(2), (54, 1, 1))
    places, chis = [], []
    for _ in range(60):
        centres = exact.validation_px[3] + 0.003 * random.standard_normal((54, 2))
        pose = find_pose(adjustment.scene.lens, adjustment.adjusted_board, centres, covariance)
        places.append(pose.locate_point_mm(CENTRE_mm))
        chis.append(pose.chi)
    predicted = np.sqrt(np.diag(pose.compute_covariance(CENTRE_mm)))
    assert np.all(np.abs(np.std(places, axis=0) / predicted - 1) < 0.3)
    assert abs(np.mean(chis) - 1) < 0.05


def test_priors_beat_a_board_and_a_table_taken_as_exact(laboratories: list[Laboratory], adjustments: list[Adjustment]):
    """As OpenCV takes the board: the CMM's micrometre alone is 8.8 mpx."""
    laboratory = laboratories[0]
    seen = adjustments[0].positions
    points = np.column_stack([laboratory.cmm_mm, np.zeros(54)])
    peer = calibrate_opencv(seen.centres_px, points, SIZE)
    assert peer.rms_px / np.sqrt(2) > 2.5 * adjustments[0].rms_px
    stiff = adjust(positions(laboratory), board(laboratory), TableSigma(linear_mm=1e-6, rotary_arcmin=1e-4))
    assert stiff.discrepancy_px > 0.003


def test_a_nominal_board_is_measured_by_the_way(laboratories: list[Laboratory]):
    laboratory = laboratories[1]
    adjustment = adjust(positions(laboratory), board(laboratory, measured=False), TABLE)
    assert adjustment.reprojection_ratio < 1.02
    scatter = adjustment.scene.points_mm[:, :2] - laboratory.board_mm[:, :2]
    shape = scatter - _affine(laboratory.board_mm[:, :2], scatter)
    assert shape.std() < 0.0003
    assert scatter.std() < 0.02


def _affine(plane: np.ndarray, values: np.ndarray) -> np.ndarray:
    design = np.column_stack([plane, np.ones(len(plane))])
    return design @ np.linalg.lstsq(design, values, rcond=None)[0]


def test_an_uneven_board_and_a_wobbling_table_are_no_harm():
    truth = Truth(seed=3, flatness_mm=0.005, straightness_mm=0.002, wobble_arcmin=0.3)
    laboratory = draw(truth)
    adjustment = adjust(
        positions(laboratory), board(laboratory), replace(TABLE, straightness_mm=0.002, wobble_arcmin=0.3)
    )
    assert adjustment.reprojection_ratio < 1.02
    assert abs(adjustment.chi - 1) < 0.05
    heights = adjustment.scene.points_mm[:, 2] - laboratory.board_mm[:, 2]
    plane = laboratory.board_mm[:, :2]
    assert (heights - _affine(plane, heights[:, None])[:, 0]).std() < 0.0006  # its tilt is the mount's
    assert adjust(positions(laboratory), board(laboratory), TABLE).discrepancy_px > 0.01


def test_misplaced_markers_are_left_out_and_lost_ones_do_not_matter(
    laboratories: list[Laboratory], adjustments: list[Adjustment]
):
    seen = positions(laboratories[2])
    seen.centres_px[3, 7] += (0.2, -0.1)
    seen.centres_px[20, 40] += (0.0, 0.05)
    seen.centres_px[11, 0:9] = np.nan
    adjustment = adjust(seen, board(laboratories[2]), TABLE)
    dropped = seen.seen & ~adjustment.used
    assert np.argwhere(dropped).tolist() == [[3, 7], [20, 40]]
    assert adjustment.reprojection_ratio < 1.02
    change = adjustment.scene.lens.vector - adjustments[2].scene.lens.vector
    assert np.all(np.abs(change) < adjustment.camera_sigma)


def test_a_lens_that_browns_model_cannot_follow_does_not_bend_the_board():
    laboratory = draw(Truth(seed=0, camera=TrueCamera(ripple_px=0.05)))
    seen, known = positions(laboratory), board(laboratory)
    adjustment = adjust(seen, known, TABLE)
    assert adjustment.discrepancy_px > 0.01
    off = adjustment.scene.points_mm[:, :2] - laboratory.board_mm[:, :2]
    assert off.std() < 0.0013  # the board is not bent to please the lens
    pose = find_pose(
        adjustment.scene.lens, adjustment.adjusted_board, laboratory.validation_px[3], covariances(laboratory)
    )
    assert pose.chi > 2


def test_the_ray_model_agrees_with_brown_where_brown_is_right(
    laboratories: list[Laboratory], adjustments: list[Adjustment]
):
    rays = fit_ray_lens(adjustments[0], 5)
    errors = translation_errors_um(laboratories[0], rays, adjustments[0].adjusted_board, adjustments[0].scene.table)
    assert np.all(np.abs(errors) < (0.4, 0.4, 2.5))
    pose = find_pose(
        rays, adjustments[0].adjusted_board, laboratories[0].validation_px[2], covariances(laboratories[0])
    )
    assert abs(pose.chi - 1) < 0.25


def test_models_are_chosen_by_positions_they_were_not_fitted_to(laboratories: list[Laboratory]):
    found = calibrate(positions(laboratories[0]), target_of(laboratories[0]), TABLE)
    assert found.model == BROWN  # the rational model is no better, and less simple
    assert found.rays.degree == 5  # a cubic lens needs it; degrees 3 and 4 leave 13 mpx
    assert found.score(BROWN).rms_px == pytest.approx(0.003, rel=0.12)
    assert found.score("rays, degree 3").rms_px > 0.008
    assert found.score(BROWN).positions == 34
    assert select_model(found.scores) == BROWN
    assert found.rays_times == pytest.approx(1.0, abs=0.1)
    assert found.rays_warning == ""


def test_the_uncertainty_of_the_projection_covers_the_truth(laboratories: list[Laboratory]):
    """Calibrations of one camera and board on several sessions differ by what each says it may be off."""
    drawn = [laboratories[0], *(draw(Truth(seed=seed, board_seed=0)) for seed in (11, 12))]
    adjustments = [adjust(positions(each), board(each), TABLE) for each in drawn]
    first = adjustments[0]
    found = compute_projection_uncertainty(first, 826.0)
    assert found.sigma_px.shape == found.pixels.shape[:2]
    middle, corner = found.sigma_px[10, 12], found.sigma_px[0, 0]
    assert 0.0005 < middle < 0.003 < corner < 0.02
    shifts = np.array([compare_calibrations(first, other, 826.0).shift_px for other in adjustments[1:]])
    normalised = np.linalg.norm(shifts, axis=-1) / (2 * found.sigma_px)
    assert 0.2 < np.sqrt(np.nanmean(normalised**2)) < 2.0


def test_the_halves_of_a_session_agree(laboratories: list[Laboratory]):
    found = compare_halves(positions(laboratories[0]), board(laboratories[0]), TABLE, 826.0, rational=False)
    assert 0.0005 < found.rms_px < 0.01


def test_positions_that_determine_no_camera_are_refused(laboratories: list[Laboratory]):
    seen = positions(laboratories[0])
    turned = seen.select(np.abs(seen.rotary_deg) < 1)
    with pytest.raises(CalibrationError, match="the positions span 280 mm and 0 deg"):
        adjust(turned, board(laboratories[0]), TABLE)
    moved = seen.select(np.abs(seen.linear_mm) < 1)
    with pytest.raises(CalibrationError, match="the positions span 0 mm and 60 deg"):
        adjust(moved, board(laboratories[0]), TABLE)


def test_inputs_stay_as_they_were(laboratories: list[Laboratory]):
    seen, known = positions(laboratories[0]), board(laboratories[0])
    before = seen.centres_px.copy(), known.points_mm.copy()
    adjust(seen, known, TABLE)
    assert np.array_equal(seen.centres_px, before[0])
    assert np.array_equal(known.points_mm, before[1])


# The simulated stand's own camera, found from its positions of the calibration recipe: no code is shared with it.


NOISE_px = 0.0012  # the mean of five frames
WARM = Nodes(43.0, 39.0, 38.0, 24.0, 24.25, 24.2)  # after hours in a chamber at 24 degC
MIDDLE_mm = np.array([120.0, 75.0, 0.0])
VALIDATION = ((70.0, 0.0), (95.0, 8.0), (10.0, -20.0), (140.0, 22.0))


def optics(linear_mm: float, rotary_deg: float) -> Optics:
    return compute_optics_at("modified", WARM, StandPlacement(linear_mm=linear_mm, rotary_deg=rotary_deg))


def recipe_places() -> np.ndarray:
    recipe = yaml.safe_load(find_packaged("recipes", "calibration").read_text())["experiments"][0]["calibration"]
    left_out = [(entry["linear_mm"], entry["rotary_deg"]) for entry in recipe["left_out"]]
    grid = [(z, angle) for z in recipe["linear_mm"] for angle in recipe["rotary_deg"]]
    return np.array([place for place in grid if place not in left_out], float)


def test_the_recipes_positions_give_the_stands_camera_and_its_validation_positions():
    random = np.random.default_rng(4)
    places = recipe_places()
    assert len(places) == 34
    centres = np.array([compute_true_centres_px(optics(*place)) for place in places])
    covariance = np.tile(NOISE_px**2 * np.eye(2), (34, 54, 1, 1))
    seen = Positions(
        linear_mm=places[:, 0],
        rotary_deg=places[:, 1],
        centres_px=centres + NOISE_px * random.standard_normal(centres.shape),
        covariance_px2=covariance,
        frames=np.full(34, 5),
        flags=np.zeros((34, 54), np.uint8),
        chi=1.0,
        image_size=(2448, 2048),
    )
    found = adjust(seen, make_board(load_target(find_packaged("targets", "paper-9x6"))), TableSigma())
    true = optics(0.0, 0.0)
    assert found.reprojection_ratio < 1.05
    assert abs(found.scene.lens.vector[0] - true.f_px) < 4 * found.camera_sigma[0] + 0.01
    # A tilted sensor is a turned camera whose principal point is elsewhere.
    principal = np.array([true.cx_px, true.cy_px]) + true.f_px * np.array(
        [true.sensor_tilt_rad[1], -true.sensor_tilt_rad[0]]
    )
    assert np.all(np.abs(found.scene.lens.vector[2:4] - principal) < 4 * found.camera_sigma[2:4])
    for lens in (found.scene.lens, fit_ray_lens(found, 5)):
        poses = [
            find_pose(lens, found.adjusted_board, compute_true_centres_px(optics(*place)), covariance[0])
            for place in VALIDATION
        ]
        places_mm = np.array([pose.locate_point_mm(MIDDLE_mm) for pose in poses]) @ found.scene.table.frame.T
        moved_um = 1e3 * (places_mm[1:] - places_mm[0])
        wanted_um = 1e3 * np.array([(0, 0, linear_mm - VALIDATION[0][0]) for linear_mm, _ in VALIDATION[1:]])
        assert np.all(np.abs(moved_um - wanted_um) < (1.0, 1.0, 2.0))
