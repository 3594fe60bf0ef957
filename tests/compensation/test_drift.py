"""The paper's polynomial: the right space, a good condition, an honest choice of degree, and a model file."""

from __future__ import annotations

import json
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from thermostand.compensation.drift.displacements import compute_displacements
from thermostand.compensation.drift.hull import compute_convex_hull
from thermostand.compensation.drift.hysteresis import compute_hysteresis
from thermostand.compensation.drift.model_facts import ModelFacts
from thermostand.compensation.drift.model_file import load_model, save_model
from thermostand.compensation.drift.paper_model import (
    DegreeScore,
    PaperModel,
    build_design_matrix,
    choose_degree,
    condense,
    fit_paper,
    solve,
)
from thermostand.compensation.drift.thermal_fit import fit_thermal
from thermostand.compensation.history.thermal_history import States
from thermostand.compensation.observations import Observations, concatenate
from thermostand.experiments.steps import Role
from thermostand.foundation.errors import ConfigError, SessionError
from thermostand.foundation.files import write_atomically

from .reservoirs import cycle, reference, session, warm_up
from .synthetic import CAMERA_ABOVE_CHAMBER_K, FIT_DEGC, facts, observations, places_px, polynomial_drift, quadratic

NOISE_PX = 0.005


def rms(values: np.ndarray) -> float:
    return float(np.sqrt((values**2).mean()))


@pytest.fixture(scope="module")
def noisy() -> Observations:
    return observations(quadratic, NOISE_PX, seed=1)


@pytest.fixture(scope="module")
def model(noisy: Observations) -> PaperModel:
    return fit_paper(noisy)


@pytest.mark.parametrize("degree", [1, 2, 3, 4, 5])
def test_a_drift_of_degree_n_is_recovered_everywhere_by_the_fit_of_degree_n(degree: int):
    drift, displacement = polynomial_drift(degree, seed=degree)
    fitted = fit_paper(observations(drift), degree)
    points = np.random.default_rng(0).uniform([0, 0], [2447, 2047], (200, 2))
    for above_K in (-13.0, 3.0, 27.0):
        got = fitted.shift(points, 24 + above_K + CAMERA_ABOVE_CHAMBER_K)
        np.testing.assert_allclose(got, displacement(points, above_K), rtol=0, atol=1e-8)
    assert fitted.score.condition < 1e3
    assert max(fitted.score.rms_px) < 1e-8


@pytest.mark.parametrize("degree", [1, 2, 3])
def test_the_fit_is_that_of_plain_monomials_in_pixels_and_degrees(noisy: Observations, degree: int):
    rows = compute_displacements(noisy, noisy.of(Role.REFERENCE, Role.FIT))
    (i, j), t = rows.measured_px.T, rows.camera_degC
    powers = [(a, b, c) for a in range(6) for b in range(6) for c in range(6) if a + b + c <= degree]
    raw = np.stack([i**a * j**b * t**c for a, b, c in powers], axis=1)
    positions = raw @ np.linalg.lstsq(raw, rows.measured_px + rows.displacement_px, rcond=1e-16)[0]
    corrected = fit_paper(noisy, degree).correct(rows.measured_px, rows.camera_degC)
    np.testing.assert_allclose(corrected, positions, rtol=0, atol=1e-5)


def test_what_is_left_at_held_out_temperatures_is_the_noise(noisy: Observations, model: PaperModel):
    rows = compute_displacements(noisy, noisy.of(Role.VALIDATION))
    after = rows.displacement_px - model.shift(rows.measured_px, rows.camera_degC)
    assert rms(rows.displacement_px) > 0.3
    assert rms(after) == pytest.approx(NOISE_PX * np.sqrt(1 + 1 / 8), rel=0.05)
    assert model.discrepancy_px.max() < 0.3 * NOISE_PX


@pytest.mark.parametrize(("degree", "seed"), [(1, 1), (2, 0), (3, 0)])
def test_the_chosen_degree_is_the_simplest_that_explains_the_drift(degree: int, seed: int):
    drift, _ = polynomial_drift(degree, seed)
    assert fit_paper(observations(drift, NOISE_PX, seed)).degree == degree


def score(degree: int, *fold_rms_px: float) -> DegreeScore:
    folds = tuple((rms_px, 0.0) for rms_px in fold_rms_px)
    chamber_degC = tuple(float(number) for number in range(len(folds)))
    return DegreeScore(
        degree=degree, terms=1, condition=1.0, rms_px=(0, 0), fold_chamber_degC=chamber_degC, fold_rms_px=folds
    )


def test_one_standard_error_of_the_difference_decides():
    best = score(3, 0.10, 0.20, 0.10, 0.30)
    assert choose_degree((score(1, 0.20, 0.30, 0.20, 0.40), score(2, 0.09, 0.23, 0.10, 0.30), best)) == 2
    assert choose_degree((score(1, 0.20, 0.30, 0.20, 0.40), score(2, 0.11, 0.21, 0.11, 0.31), best)) == 3
    assert choose_degree((best, score(4, 0.10, 0.20, 0.10, 0.31))) == 3


def test_only_reference_and_fit_frames_are_fitted(noisy: Observations, model: PaperModel, tmp_path: Path):
    other = ~noisy.of(Role.REFERENCE, Role.FIT)
    spoiled = noisy.centres_px.copy()
    spoiled[other] += 7.0
    role = noisy.role.astype("U16")
    role[np.flatnonzero(other)[:5]] = "warm_up"
    save_model(fit_paper(replace(noisy, centres_px=spoiled, role=role)), tmp_path / "spoiled.json")
    save_model(model, tmp_path / "model.json")
    assert (tmp_path / "spoiled.json").read_bytes() == (tmp_path / "model.json").read_bytes()


def test_an_uncertain_centre_counts_for_little_and_a_missing_one_for_nothing(noisy: Observations):
    centres, covariance = noisy.centres_px.copy(), noisy.covariance_px2.copy()
    centres[12, 7] += 3.0
    covariance[12, 7] *= 1e6
    centres[13, 8] = np.nan
    reference = places_px()
    before, after = fit_paper(noisy, 2), fit_paper(replace(noisy, centres_px=centres, covariance_px2=covariance), 2)
    change = after.shift(reference, 50.0) - before.shift(reference, 50.0)
    assert 0 < np.abs(change).max() < 0.1 * NOISE_PX


def test_the_covariance_of_the_coefficients_is_that_of_repeated_fits(model: PaperModel):
    rng = np.random.default_rng(3)
    xy, camera_degC = rng.uniform([0, 0], [2447, 2047], (60, 2)), rng.uniform(25, 67, 60)
    terms = build_design_matrix(xy, camera_degC, 2, model.scaling)
    sigma = rng.uniform(0.002, 0.01, 60)
    fits = [solve([condense(terms, sigma * rng.standard_normal(60), sigma**2)], 60) for _ in range(400)]
    white = np.linalg.cholesky(terms.T @ (terms / sigma[:, None] ** 2))
    scatter = np.cov(np.array([one.coefficients for one in fits]) @ white, rowvar=False)
    np.testing.assert_allclose(scatter, np.eye(10), atol=0.3)
    ratio = [np.trace(white.T @ one.covariance @ white) / 10 for one in fits]
    assert 1.0 <= min(ratio) <= float(np.median(ratio)) < 1.1  # inflated by chi^2 where that exceeds 1, never deflated


def test_the_valid_range_is_the_hull_of_the_markers_and_the_temperatures_of_the_fit(model: PaperModel):
    corners = np.array([[170.0, 375.0], [2274.0, 375.0], [2274.0, 1690.0], [170.0, 1690.0], [1200.0, 1000.0]])
    assert model.inside(corners, 45.0).all()
    out = np.array([[160.0, 1000.0], [2290.0, 1000.0], [1200.0, 360.0], [1200.0, 1700.0], [np.nan, 1000.0]])
    assert not model.inside(out, 45.0).any()
    temperatures = np.array([24.9, 25.0, 67.0, 67.1, np.nan])
    assert model.inside(np.full((5, 2), 1000.0), temperatures).tolist() == [False, True, True, False, False]
    assert model.scaling.camera_degC == (25.0, 67.0)


def test_the_hull_has_the_corners_only():
    rng = np.random.default_rng(2)
    square = np.array([[0.0, 0.0], [4.0, 0.0], [4.0, 4.0], [0.0, 4.0]])
    points = np.concatenate([rng.uniform(0.1, 3.9, (50, 2)), square, [[2.0, 0.0], [4.0, 1.0]], square])
    assert sorted(compute_convex_hull(points).tolist()) == sorted(square.tolist())


def test_nan_in_is_nan_out(model: PaperModel):
    points = np.array([[np.nan, 5.0], [1000.0, 1000.0], [1000.0, 1000.0]])
    got = model.correct(points, np.array([40.0, np.nan, 40.0]))
    assert np.isnan(got[:2]).all()
    assert np.isfinite(got[2]).all()


def test_an_answer_that_is_not_known_is_an_error(model: PaperModel):
    with pytest.raises(ValueError, match="state is NaN"):
        model.correct(np.array([[1000.0, 1000.0]]), np.nan)
    with pytest.raises(ValueError, match="one temperature for all 3 points"):
        model.correct(np.full((3, 2), 1000.0), np.array([40.0, 41.0]))
    with pytest.raises(ValueError, match="one state for all 3 points"):
        model.correct(np.full((3, 2), 1000.0), States.at_degC(np.array([40.0, 41.0]), 2))


def test_the_reference_is_the_mean_of_the_reference_frames(noisy: Observations, model: PaperModel):
    np.testing.assert_allclose(model.facts.reference_centres_px, noisy.centres_px[:8].mean(axis=0), rtol=0, atol=1e-9)
    assert (model.facts.reference_degC, model.facts.reference_chamber_degC) == (39.0, 24.0)


def test_a_model_is_read_back_number_for_number(model: PaperModel, tmp_path: Path):
    centres = model.facts.reference_centres_px.copy()
    centres[3] = np.nan
    saved = replace(model, facts=replace(model.facts, reference_centres_px=centres))
    save_model(saved, tmp_path / "model.json")
    loaded = load_model(tmp_path / "model.json")
    for name in ModelFacts.__slots__:
        np.testing.assert_equal(getattr(loaded.facts, name), getattr(saved.facts, name), err_msg=name)
    for name in set(PaperModel.__slots__) - {"facts"}:
        np.testing.assert_equal(getattr(loaded, name), getattr(saved, name), err_msg=name)
    assert [path.name for path in tmp_path.iterdir()] == ["model.json"]


def damaged(text: str) -> dict[str, str]:
    """What may be wrong with a file -> its text."""
    data = json.loads(text)
    wide = {**data, "coefficients_px": [row[:-1] for row in data["coefficients_px"]]}
    ragged = {**data, "coefficients_px": [data["coefficients_px"][0], data["coefficients_px"][1][:-1]]}
    return {
        "cut": text[: len(text) // 2],
        "empty": "",
        "list": "[]",
        "other format": json.dumps({**data, "format": "something else"}),
        "later version": json.dumps({**data, "schema_version": 11}),
        "text for number": json.dumps({**data, "reference_degC": "warm"}),
        "nan": text.replace('"reference_degC": 39.0', '"reference_degC": NaN'),
        "key missing": json.dumps({name: value for name, value in data.items() if name != "hull_px"}),
        "key unknown": json.dumps({**data, "colour": "blue"}),
        "shape": json.dumps(wide),
        "ragged": json.dumps(ragged),
        "degree": json.dumps({**data, "degree": 3}),
        "terms": json.dumps({**data, "terms_abc": data["terms_abc"][::-1]}),
        "range": json.dumps({**data, "camera_range_degC": [67.0, 25.0]}),
        "hull": json.dumps({**data, "hull_px": data["hull_px"][:2]}),
        "hull a line": json.dumps({**data, "hull_px": [[0, 0], [100, 100], [200, 200]]}),
        "hull a point": json.dumps({**data, "hull_px": [[5, 5]] * 3}),
        "hull turned over": json.dumps({**data, "hull_px": data["hull_px"][::-1]}),
    }


def test_a_damaged_model_file_is_refused_with_a_sentence(model: PaperModel, tmp_path: Path):
    save_model(model, tmp_path / "good.json")
    path = tmp_path / "bad.json"
    for what, text in damaged((tmp_path / "good.json").read_text()).items():
        path.write_text(text)
        with pytest.raises(SessionError, match=r"bad\.json: ") as raised:
            load_model(path)
        assert "\n" not in str(raised.value), what
    path.write_bytes(b"\xff\xfe\x00binary")
    with pytest.raises(SessionError, match=r"bad\.json: cannot be read"):
        load_model(path)
    with pytest.raises(SessionError, match=r"none\.json: no such file"):
        load_model(tmp_path / "none.json")


def test_a_model_that_cannot_be_written_leaves_nothing(model: PaperModel, tmp_path: Path):
    with pytest.raises(SessionError, match="cannot be written"):
        save_model(model, tmp_path / "nowhere" / "model.json")
    (tmp_path / "folder").mkdir()
    with pytest.raises(SessionError, match="cannot be written"):
        save_model(model, tmp_path / "folder")
    assert [path.name for path in tmp_path.iterdir()] == ["folder"]


def test_a_file_that_cannot_be_finished_leaves_the_older_one(tmp_path: Path):
    (tmp_path / "model.json").write_text("older")
    with pytest.raises(UnicodeEncodeError):
        write_atomically(tmp_path / "model.json", "begun, then \ud800")
    assert [(path.name, path.read_text()) for path in tmp_path.iterdir()] == [("model.json", "older")]


@pytest.mark.parametrize(
    ("fit_degC", "degree", "sentence"),
    [
        ((31.0,), None, r"needs frames at 3 chamber temperatures or more, found 2 \(24, 31 degC\)"),
        ((10.0, 31.0, 52.0), 3, "of degree 3 needs frames at 5 chamber temperatures or more, found 4"),
        (FIT_DEGC, 6, "the degree is 1 to 5, not 6"),
        ((24.1, 24.2, 24.3), None, "temperature hardly changes"),
    ],
)
def test_too_few_temperatures_are_refused_with_a_sentence(
    fit_degC: tuple[float, ...], degree: int | None, sentence: str
):
    with pytest.raises(ConfigError if degree == 6 else SessionError, match=sentence):
        fit_paper(observations(quadratic, fit_degC=fit_degC), degree)


def test_a_warm_up_session_given_as_well_changes_nothing(noisy: Observations, model: PaperModel):
    warm_up = observations(quadratic, session=facts("warm-up"))
    warm_up = replace(warm_up, role=np.array(["warm_up"] * len(warm_up.frame)))
    both = fit_paper(concatenate([warm_up, noisy]))
    np.testing.assert_array_equal(both.coefficients, model.coefficients)
    np.testing.assert_array_equal(both.facts.reference_centres_px, model.facts.reference_centres_px)
    assert both.facts.session_ids == ("warm-up", "cycle-1")


def test_two_sessions_with_the_target_moved_between_them_are_one_fit(noisy: Observations):
    other = observations(quadratic, NOISE_PX, seed=9, session=facts("cycle-2"))
    other = replace(other, centres_px=other.centres_px + 3.0)
    fitted = fit_paper(concatenate([noisy, other]))
    points = places_px()
    np.testing.assert_allclose(fitted.shift(points, 60.0), points - quadratic(points, 21.0), rtol=0, atol=NOISE_PX)


def test_sessions_with_different_reference_temperatures_are_refused(noisy: Observations):
    other = observations(quadratic, NOISE_PX, session=facts("cycle-2"))
    chamber = np.where(other.role == "reference", 20.0, other.chamber_degC)
    with pytest.raises(SessionError, match="different reference temperatures: 20, 24 degC"):
        fit_paper(concatenate([noisy, replace(other, chamber_degC=chamber)]))


def test_markers_in_one_line_are_refused(noisy: Observations):
    row = noisy.centres_px.copy()
    row[:, 9:] = np.nan
    level = row[:, :, 1].copy()
    row[:, :, 1] = np.where(np.isfinite(level), 1000.0, np.nan)
    with pytest.raises(SessionError, match="all in one line"):
        fit_paper(replace(noisy, centres_px=row))


@pytest.mark.parametrize("noise_px", [0.0, 0.05])
def test_markers_in_one_line_with_their_noise_are_refused(noise_px: float):
    """With noise across the line the polynomial is determined, but by nothing."""
    seen = observations(quadratic, noise_px, seed=3)
    row = np.where(np.arange(54)[:, None] < 9, seen.centres_px, np.nan)
    with pytest.raises(SessionError, match="in one line"):
        fit_paper(replace(seen, centres_px=row))


def test_two_rows_of_markers_do_not_determine_degree_4(noisy: Observations):
    rows = noisy.centres_px.copy()
    rows[:, 18:] = np.nan
    few = replace(noisy, centres_px=rows)
    with pytest.raises(SessionError, match="polynomial of degree 4"):
        fit_paper(few, 4)


# Branches, closure and repeatability of drifts that are known.


WAY_DEGC = (31.0, 45.0, 31.0, 24.0, 10.0, 24.0)


def visited(opening_px: float, cycles: int = 1, creep_px: float = 0.0, noise_px: float = 0.0) -> Observations:
    """Set-points in the order of WAY_DEGC; on the way down J is lower by the opening, each cycle adds creep to I."""
    way = (24.0, *WAY_DEGC * cycles)
    still = observations(quadratic, noise_px, fit_degC=WAY_DEGC * cycles, held_out_degC=())
    visit = np.concatenate([np.zeros(8, int), 1 + np.arange(len(WAY_DEGC) * cycles).repeat(2)])
    falls = np.array([False] + [later < earlier for earlier, later in pairwise(way)])
    cycle_of = np.maximum(visit - 1, 0) // len(WAY_DEGC)
    moved = np.stack([creep_px * cycle_of, -opening_px * falls[visit]], axis=1)
    return replace(still, centres_px=still.centres_px + moved[:, None])


def test_the_gap_between_the_branches_is_found_with_its_uncertainty():
    (found,) = compute_hysteresis(visited(0.05, noise_px=0.004))
    assert [gap.chamber_degC for gap in found.gaps] == [24.0, 31.0]
    for gap in found.gaps:
        np.testing.assert_allclose(gap.uncertainty_px, 0.004 * np.sqrt((1 + 1 / 8) / 54), rtol=0.01)
        assert (np.abs(gap.difference_px - [0, 0.05]) < 4 * gap.uncertainty_px).all()
    np.testing.assert_allclose(found.largest_px, [0, 0.05], atol=0.003)
    np.testing.assert_allclose(found.rms_px, [0, 0.05], atol=0.003)
    np.testing.assert_allclose(found.area_px_K, [0, 0.05 * 7], atol=0.02)
    hot, cold = (quadratic(places_px(), above_K).mean(axis=0)[1] for above_K in (21.0, -14.0))
    assert found.range_px[1] == pytest.approx(hot - cold + 0.05, abs=0.003)  # 10 degC is reached from above


def test_no_opening_is_no_hysteresis():
    (found,) = compute_hysteresis(visited(0.0))
    np.testing.assert_allclose(found.largest_px, 0, atol=1e-9)
    np.testing.assert_allclose(found.closure_px, 0, atol=1e-9)
    assert np.isnan(found.repeatability_px).all()


def test_what_does_not_come_back_is_closure_and_repeatability():
    (found,) = compute_hysteresis(visited(0.0, cycles=2, creep_px=0.02))
    np.testing.assert_allclose(found.closure_px, [0.02, 0], atol=1e-9)
    assert 0.5 * 0.02 / np.sqrt(2) < found.repeatability_px[0] <= 0.02 / np.sqrt(2) + 1e-9
    assert found.repeatability_px[1] == pytest.approx(0, abs=1e-9)


def test_a_camera_with_play_opens_and_the_thermal_form_closes_it():
    loose, _ = session(warm_up(24.0) + reference() + cycle(), plays=True)
    (before,) = compute_hysteresis(loose)
    (paper,) = compute_hysteresis(loose, fit_paper(loose, 2))
    (after,) = compute_hysteresis(loose, fit_thermal(loose))
    assert before.rms_px[1] > 0.1
    assert paper.rms_px[1] > 0.5 * before.rms_px[1]
    assert after.rms_px[1] < 0.2 * before.rms_px[1]


def test_one_way_only_has_no_gaps():
    (found,) = compute_hysteresis(observations(quadratic, fit_degC=FIT_DEGC[3:], held_out_degC=()))
    assert found.gaps == ()
    assert np.isnan(found.largest_px).all()
    assert np.isnan(found.rms_px).all()
