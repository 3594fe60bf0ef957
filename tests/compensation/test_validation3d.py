"""Deviations of V0..V3 in drawn laboratories: what is really there is found, what the drift feigns is taken out."""

from __future__ import annotations

import json
from dataclasses import replace
from html.parser import HTMLParser
from typing import Any

import numpy as np
import pytest

from thermostand.compensation.calibration.adjustment import adjust
from thermostand.compensation.calibration.calibrate import Model, calibrate
from thermostand.compensation.calibration.camera_file import CameraFile, build_camera_file
from thermostand.compensation.calibration.session_centres import average_centres
from thermostand.compensation.calibration.stage_geometry import TableSigma
from thermostand.compensation.drift.drift_model import Outside
from thermostand.compensation.drift.paper_model import PaperModel, fit_paper
from thermostand.compensation.observations import Float
from thermostand.compensation.reporting.pages import render_validation_page
from thermostand.compensation.validation3d.document import (
    TABLE_1,
    AFTER_mm,
    BEFORE_mm,
    format_summary,
    serialise_validation,
)
from thermostand.compensation.validation3d.validate import (
    CalibratedCamera,
    CentreUncertainty,
    Deviations,
    LensModel,
    SpatialValidation,
    check_same,
    compute_deviations,
    find_target_pose,
    select_lens_model,
    validate,
)
from thermostand.foundation.errors import CalibrationError, SessionError

from .calibration_truth import SIZE, Laboratory, Truth, board, draw, positions, target_of
from .synthetic import observations as thermal_cycle
from .validation3d_truth import POSITIONS, Moved, validation_session

TRUTH = Truth(seed=3)
TABLE = TableSigma(linear_mm=0.0005, rotary_arcmin=0.1)
GOAL_WITHOUT_DRIFT_um = (1.0, 1.0, 1.5)
GOAL_COMPENSATED_um = (3.0, 3.0, 10.0)


def drift(reference_px: Float, above_K: float) -> Float:
    """Shift and scale of the size of the paper's: about 1 px along J and 1e-4 at 30 K, slightly bent."""
    x, y = ((reference_px - [1223.5, 1023.5]) / 1224).T
    warm = above_K + 0.003 * above_K**2
    return reference_px + np.stack([0.006 * warm + 0.004 * x * above_K, 0.03 * warm + 0.004 * y * above_K], axis=1)


@pytest.fixture(scope="module")
def laboratory() -> Laboratory:
    return draw(TRUTH)


@pytest.fixture(scope="module")
def camera(laboratory: Laboratory) -> CalibratedCamera:
    """Calibrated from 34 positions at 3 mpx."""
    adjustment = adjust(positions(laboratory), board(laboratory), TABLE)
    return CalibratedCamera(adjustment.scene.lens, "pinhole, Brown", adjustment.adjusted_board)


@pytest.fixture(scope="module")
def model() -> PaperModel:
    """Of a thermal cycle of the same camera at 3 mpx, the target at one place."""
    return fit_paper(thermal_cycle(drift, noise_px=0.003, seed=5))


@pytest.fixture(scope="module")
def validated(laboratory: Laboratory, camera: CalibratedCamera, model: PaperModel) -> SpatialValidation:
    observed, frames = validation_session(laboratory, TRUTH, drift, seed=1)
    return validate(observed, frames, camera, model)


def undrifted(laboratory: Laboratory, camera: CalibratedCamera, **options: Any) -> Deviations:
    observed, frames = validation_session(laboratory, TRUTH, **options)
    return compute_deviations("as found", camera, observed, frames, observed.centres_px)


def test_without_drift_nothing_deviates_by_more_than_the_noise(laboratory: Laboratory, camera: CalibratedCamera):
    found = [undrifted(laboratory, camera, seed=seed) for seed in range(4)]
    mean_um = np.mean([one.mean_um for one in found], axis=0)
    assert np.all(mean_um < GOAL_WITHOUT_DRIFT_um)
    normalised = np.concatenate([(one.translation_um / one.noise_um)[1:] for one in found])
    assert np.sqrt(np.mean(normalised**2, axis=(0, 1))) == pytest.approx([1, 1, 1], abs=0.25)
    turned = np.concatenate([(one.rotation_mrad / one.u_mrad)[1:] for one in found])
    assert np.sqrt(np.mean(turned**2, axis=(0, 1))) == pytest.approx([1, 1, 1], abs=0.25)


def test_a_target_that_moved_is_found_along_the_cameras_axes(laboratory: Laboratory, camera: CalibratedCamera):
    moved = (Moved(2, 1, shift_mm=(0.005, -0.003, 0.008)), Moved(5, 3, turn_rad=(1e-4, -2e-4, 3e-4)))
    found = undrifted(laboratory, camera, noise_px=1e-5, moved=moved)
    assert found.translation_um[2, 1] == pytest.approx([5, -3, 8], abs=0.05)
    assert found.rotation_mrad[5, 3] == pytest.approx([0.1, -0.2, 0.3], abs=1e-3)
    assert found.translation_um[5, 3] == pytest.approx([0, 0, 0], abs=0.1)  # the turn is linear: 7e-8 of scale
    still = np.ones(found.chi.shape, bool)
    still[[2, 5], [1, 3]] = False
    assert np.abs(found.translation_um[still]).max() < 0.05
    assert found.mean_um == pytest.approx(np.array([5, 3, 8]) / 4 / 11, abs=0.03)


def test_frames_of_a_position_are_averaged(laboratory: Laboratory, camera: CalibratedCamera):
    one, nine = (undrifted(laboratory, camera, frames=count) for count in (1, 9))
    assert nine.noise_um[1:] == pytest.approx(one.noise_um[1:] / 3, rel=0.1)
    assert np.all(nine.mean_um < 0.6 * one.mean_um)


def test_the_tables_repeatability_is_measured_by_v0_seen_again(laboratory: Laboratory, camera: CalibratedCamera):
    many = (24.0,) * 18
    moving = undrifted(laboratory, camera, table_mm=(0.001, 0.0, 0.004), temperatures_degC=many)
    assert moving.table_um == pytest.approx([1, 0, 4], rel=0.25, abs=0.3)
    normalised = (moving.translation_um / moving.u_um)[1:]
    assert np.sqrt(np.mean(normalised**2, axis=(0, 1))) == pytest.approx([1, 1, 1], abs=0.4)
    still = undrifted(laboratory, camera, seed=8, temperatures_degC=many)
    assert np.all(still.table_um < (0.1, 0.3, 0.4))


def test_compensation_takes_the_drift_out(validated: SpatialValidation):
    before, after = validated.before, validated.after
    shift_um = 1e3 * 0.03 * (26 + 0.003 * 26**2) * validated.distance_mm / TRUTH.camera.f_px  # at 50 degC, along J
    scale_um = -1e3 * 0.004 / 1224 * 26 * validated.distance_mm
    assert before.translation_um[4, :, 1] == pytest.approx(shift_um, rel=0.03)
    assert before.translation_um[4, 0, 2] == pytest.approx(scale_um[0], rel=0.05)
    assert np.all(before.mean_um > (5, 40, 30))
    assert np.all(after.mean_um < GOAL_WITHOUT_DRIFT_um)
    assert np.all(after.mean_um < GOAL_COMPENSATED_um)
    normalised = (after.translation_um / after.u_um)[1:]
    assert np.all(np.sqrt(np.mean(normalised**2, axis=(0, 1))) < 1.4)
    assert np.all(after.mean_rotation_mrad < 0.1)
    assert np.all(before.chi[4] > 0.5)


def test_the_drift_models_uncertainty_reaches_the_pose(laboratory: Laboratory, camera: CalibratedCamera):
    """Errors drawn as smooth fields of 3 mpx move the pose as much as is claimed."""
    observed, _ = validation_session(laboratory, TRUTH, noise_px=1e-4)
    centres, covariance = observed.centres_px[1], observed.covariance_px2[1]
    random = np.random.default_rng(4)
    apart = np.linalg.norm(centres[:, None] - centres, axis=-1) / (SIZE[0] / 2)
    root = np.linalg.cholesky(np.exp(-(apart**2) / 2) + 1e-9 * np.eye(54))
    model_px2 = np.tile(0.003**2 * np.eye(2), (54, 1, 1))

    def place_um(shift_px: Float) -> Float:
        mean = average_centres((centres + shift_px)[None], covariance[None])
        return 1e3 * find_target_pose(camera.lens, camera.board, mean, 1.0, CentreUncertainty(), SIZE[0]).place_mm

    places = np.array([place_um(0.003 * root @ random.standard_normal((54, 2))) for _ in range(200)])
    mean = average_centres(centres[None], covariance[None])
    claimed = find_target_pose(camera.lens, camera.board, mean, 1.0, CentreUncertainty(model_px2), SIZE[0]).model
    assert places.std(axis=0) == pytest.approx(1e3 * np.sqrt(np.diagonal(claimed)[3:]), rel=0.15)


@pytest.mark.usefixtures("undrawn")
def test_a_pose_that_was_not_seen_is_left_out_of_the_means_and_shown_as_unknown(
    laboratory: Laboratory, camera: CalibratedCamera, model: PaperModel
):
    observed, frames = validation_session(laboratory, TRUTH, drift, temperatures_degC=(24.0, 40.0, 12.0))
    few = observed.centres_px.copy()
    few[POSITIONS + 1 + 2, 10:] = np.nan  # V2 at 40 degC: ten markers
    rows = [list(row) for row in frames.frames]
    rows[2][1] = np.empty(0, np.int64)  # V1 at 12 degC: no frame
    rows[2][POSITIONS] = np.empty(0, np.int64)
    found = validate(replace(observed, centres_px=few), replace(frames, frames=tuple(map(tuple, rows))), camera, model)
    assert np.argwhere(np.isnan(found.after.translation_um[..., 0])).tolist() == [[1, 2], [2, 1]]
    assert np.argwhere(np.isnan(found.after.repeat_um[:, 0])).tolist() == [[2]]
    assert np.isfinite(found.after.mean_um).all()
    assert found.frame_count[2].tolist() == [1, 0, 1, 1]
    document = json.loads(serialise_validation(found))
    assert document["results"][1]["translation_um"][2][1] == [None, None, None]
    assert document["outside_valid_range"][2][1] is None
    assert ["", "V1", *"------"] in cells(render_validation_page(found))


def test_a_reference_without_a_pose_is_refused(laboratory: Laboratory, camera: CalibratedCamera, model: PaperModel):
    observed, frames = validation_session(laboratory, TRUTH, temperatures_degC=(24.0, 40.0))
    few = observed.centres_px.copy()
    few[2, 10:] = np.nan
    with pytest.raises(CalibrationError, match="V2 at the reference temperature"):
        validate(replace(observed, centres_px=few), frames, camera, model)


def test_corrections_beyond_the_models_range_are_flagged(
    laboratory: Laboratory, camera: CalibratedCamera, model: PaperModel, validated: SpatialValidation
):
    warm = validate(*validation_session(laboratory, TRUTH, drift, temperatures_degC=(24.0, 60.0)), camera, model)
    assert np.all(warm.flags[1] & Outside.CAMERA)
    assert np.all(warm.outside[1] == 1)
    assert not np.any(warm.flags[0] & Outside.CAMERA)
    assert "camera" in format_summary(warm).splitlines()[-1]
    assert not np.any(validated.flags & Outside.CAMERA)


def test_table_figures_and_document_compare_ours_with_the_papers(validated: SpatialValidation):
    text = format_summary(validated)
    assert "paper, after" in text
    assert text.splitlines()[3].split() == ["paper,", "after", "12.4", "25.4", "28.7"]
    assert f"{validated.after.mean_um[2]:.2f} (u ≤ {validated.after.u_mean_um[2]:.2f})" in text
    page = render_validation_page(validated)
    rows = cells(page)
    assert page.count("<svg") == 2
    assert rows.count(["", "aver (abs)", "0.0298", "0.2126", "0.2326", "0.0204", "0.0411", "0.0499"]) == 1
    ours = validated.before.translation_um[1, 0], validated.after.translation_um[1, 0]
    wanted = [f"{value / 1e3:.4f}" for value in np.concatenate(ours)]
    assert [f"{validated.camera_degC[1]:.2f}", "V0", *wanted] in rows
    document = json.loads(serialise_validation(validated))
    assert document["results"][1]["mean_um"] == validated.after.mean_um.tolist()
    assert [one["name"] for one in document["positions"]] == ["V0", "V1", "V2", "V3"]


def test_the_papers_averages_are_those_of_its_own_table():
    for one in TABLE_1:
        for values, mean in ((one.before_mm, one.mean_before_mm), (one.after_mm, one.mean_after_mm)):
            assert np.abs(values).mean(axis=0) == pytest.approx(mean, abs=6e-5)
    gains = [100 * (1 - after / before) for before, after in zip(BEFORE_mm, AFTER_mm, strict=True)]
    assert gains == pytest.approx([29, 81, 80], abs=1.1)


@pytest.fixture(scope="module")
def file(laboratory: Laboratory) -> CameraFile:
    found = calibrate(positions(laboratory), target_of(laboratory), TABLE, Model.BROWN)
    return build_camera_file(
        found, camera_serial="TS-0001", session_ids=("cycle-2",), target_name="paper-9x6", software_version="0"
    )


def test_pinhole_and_rays_agree(laboratory: Laboratory, file: CameraFile, model: PaperModel):
    observed, frames = validation_session(laboratory, TRUTH, drift, temperatures_degC=(24.0, 43.0))
    pinhole, rays = (validate(observed, frames, select_lens_model(file, lens), model) for lens in LensModel)
    assert rays.after.translation_um == pytest.approx(pinhole.after.translation_um, abs=0.3)
    assert (pinhole.lens, rays.lens) == (file.model, f"rays, degree {file.ray_lens.degree}")


def test_camera_model_and_session_must_belong_together(laboratory: Laboratory, file: CameraFile, model: PaperModel):
    observed, _ = validation_session(laboratory, TRUTH, temperatures_degC=(24.0, 43.0))
    check_same(observed, file, model)
    with pytest.raises(SessionError, match="is of camera TS-9"):
        check_same(observed, file, replace(model, facts=replace(model.facts, camera_serial="TS-9")))
    with pytest.raises(SessionError, match="TS-0001, target other"):
        check_same(observed, file.model_copy(update={"target_name": "other"}), model)


class _Cells(HTMLParser):
    def __init__(self) -> None:
        super().__init__()
        self.rows: list[list[str]] = []
        self._in_cell = False

    def handle_starttag(self, tag: str, attrs: object) -> None:
        if tag == "tr":
            self.rows.append([])
        elif tag == "td":
            self.rows[-1].append("")
            self._in_cell = True

    def handle_endtag(self, tag: str) -> None:
        self._in_cell = self._in_cell and tag != "td"

    def handle_data(self, data: str) -> None:
        if self._in_cell:
            self.rows[-1][-1] += data


def cells(page: str) -> list[list[str]]:
    """The rows of all tables of a page; a mark behind a position's name is left out."""
    parser = _Cells()
    parser.feed(page)
    return [[cell.removesuffix(" *") for cell in row] for row in parser.rows]
