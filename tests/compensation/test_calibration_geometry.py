"""Lenses, tables, rotations and eccentricity against OpenCV, finite differences and the independent truth."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from thermostand.compensation.calibration.adjustment import TableProblem, TableScene, build_table_problem, fit_table
from thermostand.compensation.calibration.board import Board, compute_camera_shifts, compute_homography_shifts
from thermostand.compensation.calibration.least_squares import Float, make_equations, minimise
from thermostand.compensation.calibration.pinhole import Pinhole, find_perpendiculars
from thermostand.compensation.calibration.pose import find_pose
from thermostand.compensation.calibration.rays import fit_rays
from thermostand.compensation.calibration.stage_geometry import TableSigma
from thermostand.foundation.errors import CalibrationError

from .calibration_truth import SIZE, TrueCamera, Truth, board, draw, ellipse_centres, positions

BROWN = Pinhole(np.array([7246.0, 7251, 1231.8, 1015.4, -0.12, 0.35, 2e-4, -3e-4, 0.7]), SIZE)
RATIONAL = Pinhole(np.concatenate([BROWN.vector, [0.05, -0.2, 0.4]]), SIZE)
MIDDLE = np.array([120.0, 75.0, 0.0])
RANDOM = np.random.default_rng(0)
POINTS = np.column_stack(
    [RANDOM.uniform(-130, 130, 200), RANDOM.uniform(-110, 110, 200), RANDOM.uniform(700, 970, 200)]
)


@pytest.mark.parametrize("lens", [BROWN, RATIONAL])
def test_projections_are_opencvs(lens: Pinhole):
    theirs, _ = cv2.projectPoints(POINTS, np.zeros(3), np.zeros(3), lens.matrix, lens.distortion)
    assert np.abs(lens.project(POINTS) - theirs[:, 0]).max() < 1e-9


@pytest.mark.parametrize("lens", [BROWN, RATIONAL])
def test_slopes_undo_projections(lens: Pinhole):
    assert np.abs(lens.compute_slopes(lens.project(POINTS)) - POINTS[:, :2] / POINTS[:, 2:]).max() < 1e-12


def test_slopes_are_nan_where_the_lens_folds_over():
    folding = Pinhole(np.array([500.0, 500, 1000, 1000, -0.5, 0, 0, 0, 0]), SIZE)
    slopes = folding.compute_slopes(np.array([[1000.0, 1000], [2000, 1000]]))
    assert np.isfinite(slopes[0]).all()
    assert np.isnan(slopes[1]).all()


@pytest.mark.parametrize("lens", [BROWN, RATIONAL])
def test_lens_derivatives_are_those_of_small_steps(lens: Pinhole):
    pixels = lens.project(POINTS)
    by_point = lens.compute_point_jacobian(POINTS, pixels)
    for axis in range(3):
        step = 1e-3 * np.eye(3)[axis]
        numeric = (lens.project(POINTS + step) - lens.project(POINTS - step)) / 2e-3
        assert np.abs(by_point[:, :, axis] - numeric).max() < 1e-6 * np.abs(by_point).max()
    by_vector = lens.compute_vector_jacobian(POINTS)
    for index in range(len(lens.vector)):
        step = 1e-4 * np.eye(len(lens.vector))[index]
        numeric = (lens.apply_step(step).project(POINTS) - lens.apply_step(-step).project(POINTS)) / 2e-4
        assert np.abs(by_vector[:, :, index] - numeric).max() < 1e-4


def test_rays_are_straight_invertible_and_differentiated_right():
    rays = fit_rays(
        5, BROWN.project(POINTS), POINTS, np.full(200, 0.003), BROWN, np.array([[0, 0], [2447, 0], [2447, 2047.0]])
    )
    pixels = rays.project(POINTS)
    assert np.abs(rays.compute_misfit(POINTS, pixels)).max() < 1e-8
    assert np.abs(pixels - BROWN.project(POINTS)).max() < 0.05
    start, slope = rays.lines(pixels)
    assert np.abs(start + POINTS[:, 2:] * slope - POINTS[:, :2]).max() < 1e-8
    jacobian = rays.compute_point_jacobian(POINTS, pixels)
    for axis in range(3):
        step = 1e-3 * np.eye(3)[axis]
        numeric = (rays.project(POINTS + step) - rays.project(POINTS - step)) / 2e-3
        assert np.abs(jacobian[:, :, axis] - numeric).max() < 1e-3 * np.abs(jacobian).max()


def test_rays_know_where_they_were_fitted():
    hull = np.array([[100.0, 100], [2300, 100], [2300, 1900], [100, 1900]])
    rays = fit_rays(3, BROWN.project(POINTS), POINTS, np.full(200, 0.003), BROWN, hull)
    assert rays.inside(np.array([[1000.0, 1000], [50, 1000], [2000, 2000]])).tolist() == [True, False, False]
    with pytest.raises(CalibrationError, match=r"20 marker centres .* degree 5"):
        fit_rays(5, BROWN.project(POINTS[:20]), POINTS[:20], np.full(20, 0.003), BROWN, hull)


def test_directions_across_an_axis_are_at_right_angles():
    axis = np.array([0.6, -0.48, 0.64])
    frame = np.column_stack([axis, find_perpendiculars(axis)])
    assert np.abs(frame.T @ frame - np.eye(3)).max() < 1e-12


def written_out(problem: TableProblem, scene: TableScene) -> Float:
    """The derivatives of all residuals of the adjustment, nearly all of them zeros."""
    slopes, count, free = problem.compute_slopes(scene), len(problem.picture), int(problem.freed.sum())
    lens, first_error = len(scene.lens.vector), slopes.common.shape[2]
    first_point = first_error + free * len(scene.errors)
    rows = len(problem.compute_residuals(scene))
    matrix = np.zeros((rows, first_point + scene.points_mm.size))
    for index, (position, marker) in enumerate(zip(problem.picture, problem.marker, strict=True)):
        own = slice(2 * index, 2 * index + 2)
        matrix[own, :first_error] = slopes.common[index]
        matrix[own, first_error + free * position : first_error + free * (position + 1)] = slopes.own[index]
        matrix[own, first_point + 3 * marker : first_point + 3 * marker + 3] = slopes.points[index]
    errors = np.tile(1 / problem.errors_sigma[problem.freed], len(scene.errors))
    priors = np.concatenate([1 / problem.lens_sigma, errors, 1 / problem.board.sigma_mm.ravel()])
    columns = [*range(4, lens), *range(first_error, matrix.shape[1])]
    matrix[np.arange(2 * count, rows), columns] = priors
    return matrix


def test_the_adjustments_derivatives_are_those_of_small_steps():
    """Every column of the whole problem, at a state with errors in it and without one marker; and the equations are
    those of these derivatives."""
    laboratory = draw(Truth(seed=1))
    seen = positions(laboratory).select(np.arange(34) % 4 == 0)
    seen.centres_px[2, 7] = np.nan
    table = fit_table(
        seen.linear_mm, seen.rotary_deg, laboratory.rotations[::4], laboratory.translations_mm[::4], MIDDLE
    )
    random = np.random.default_rng(1)
    errors = random.standard_normal((9, 6)) * (1e-3, 1e-3, 1e-3, 1e-5, 1e-5, 1e-5)
    known = board(laboratory)
    scene = TableScene(RATIONAL, table, errors, known.points_mm)
    sigma = TableSigma(0.0005, 0.1, 0.001, 0.2)
    problem = build_table_problem(
        seen, known, sigma, lens=RATIONAL, shifts_px=np.zeros_like(seen.centres_px), used=seen.seen, discrepancy_px=0.0
    )
    jacobian, residuals = written_out(problem, scene), problem.compute_residuals(scene)
    assert len(jacobian) == len(residuals)
    normal, gradient = problem.build_equations(scene, residuals)
    scale = np.sqrt(np.diag(normal))
    assert np.abs((normal - jacobian.T @ jacobian) / scale / scale[:, None]).max() < 1e-12
    assert np.abs(gradient - jacobian.T @ residuals).max() < 1e-12 * np.abs(gradient).max()
    for column in range(jacobian.shape[1]):
        size = 1e-6 / max(1e-6, np.abs(jacobian[:, column]).max()) * 1e3
        step = size * np.eye(jacobian.shape[1])[column]
        numeric = (
            problem.compute_residuals(problem.apply_step(scene, step))
            - problem.compute_residuals(problem.apply_step(scene, -step))
        ) / (2 * size)
        scale = np.abs(jacobian[:, column]).max()
        assert np.abs(jacobian[:, column] - numeric).max() < 2e-4 * scale, column


def test_the_tables_axes_are_found_from_poses():
    laboratory = draw(Truth(seed=0, linear_mm=0.0, rotary_arcmin=0.0))
    linear, rotary = laboratory.recorded.T
    table = fit_table(linear, rotary, laboratory.rotations, laboratory.translations_mm, MIDDLE)
    rotations, translations = table.compute_poses(linear, rotary, np.zeros((34, 6)))
    assert np.abs(rotations - laboratory.rotations).max() < 1e-9
    assert np.abs(translations - laboratory.translations_mm).max() < 1e-6


def test_eccentricity_is_that_of_the_drawn_outlines():
    camera, laboratory = TrueCamera(k1=0, k2=0, p1=0, p2=0), draw(Truth(seed=0, distance_mm=1000))
    lens = Pinhole(np.array([camera.f_px, camera.f_px, camera.cx_px, camera.cy_px, 0, 0, 0, 0, 0]), SIZE)
    rotation, translation = laboratory.rotations[0], laboratory.translations_mm[0]
    diameters = np.full(54, 8.0)
    centres = ellipse_centres(camera, laboratory.board_mm, rotation, translation, 8.0)
    true = centres - camera.project(laboratory.board_mm @ rotation.T + translation)
    assert np.abs(true).max() > 0.02
    assert (
        np.abs(compute_camera_shifts(lens.project, rotation, translation, laboratory.board_mm, diameters) - true).max()
        < 1e-4
    )
    by_homography = compute_homography_shifts(centres, laboratory.board_mm, diameters)
    assert np.abs(by_homography - true).max() < 1e-4
    centres[5] = np.nan
    assert np.isnan(compute_homography_shifts(centres, laboratory.board_mm, diameters)[5]).all()


def test_poses_without_noise_are_exact():
    lens = BROWN
    laboratory = draw(Truth(seed=2, noise_px=0))
    known = Board(laboratory.board_mm, np.full((54, 3), 1e-6), np.full(54, 1e-3))
    for rotation, translation in zip(laboratory.rotations, laboratory.translations_mm, strict=True):
        pixels = lens.project(laboratory.board_mm @ rotation.T + translation)
        pose = find_pose(lens, known, pixels, np.tile(1e-6 * np.eye(2), (54, 1, 1)))
        assert np.abs(pose.rotation - rotation).max() < 1e-9
        assert np.abs(pose.translation_mm - translation).max() < 1e-5


def test_too_few_markers_give_no_pose():
    laboratory = draw(Truth(seed=2))
    centres = laboratory.centres_px[0].copy()
    centres[3:] = np.nan
    with pytest.raises(CalibrationError, match="3 markers give no pose; 4 are needed"):
        find_pose(BROWN, board(laboratory), centres, np.tile(np.eye(2), (54, 1, 1)))


def test_a_parameter_that_nothing_depends_on_is_refused():
    with pytest.raises(CalibrationError, match="all parameters"):
        minimise(
            np.zeros(2),
            lambda x: x[:1] - 1,
            make_equations(lambda _: np.array([[1.0, 0.0]])),
            lambda state, change: state + change,
        )


def test_the_minimum_of_a_curved_valley_is_found():
    """Rosenbrock's function, from its usual start."""
    found = minimise(
        np.array([-1.2, 1.0]),
        lambda x: np.array([10 * (x[1] - x[0] ** 2), 1 - x[0]]),
        make_equations(lambda x: np.array([[-20 * x[0], 10.0], [-1.0, 0.0]])),
        lambda state, change: state + change,
    )
    assert found.state == pytest.approx([1, 1], abs=1e-3)
