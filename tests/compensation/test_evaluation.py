"""The score of a compensation, against drifts that are known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from thermostand.compensation.drift.evaluation import compute_improvement_percent, evaluate, format_table
from thermostand.compensation.drift.paper_model import PaperModel, fit_paper
from thermostand.compensation.observations import Observations
from thermostand.foundation.errors import SessionError

from .synthetic import HELD_OUT_DEGC, facts, observations, places_px, quadratic

NOISE_PX = 0.005


@pytest.fixture(scope="module")
def seen() -> Observations:
    return observations(quadratic, NOISE_PX, seed=4)


@pytest.fixture(scope="module")
def model(seen: Observations) -> PaperModel:
    return fit_paper(seen)


def true_rms(above_K: float) -> np.ndarray:
    return np.sqrt(((quadratic(places_px(), above_K) - places_px()) ** 2).mean(axis=0))


def test_before_is_the_drift_and_after_is_the_noise(seen: Observations, model: PaperModel):
    got = evaluate(model, seen)
    truth = np.sqrt(np.mean([true_rms(degC - 24) ** 2 for degC in HELD_OUT_DEGC], axis=0))
    np.testing.assert_allclose(got.rms_before_px, truth, rtol=0.01)
    np.testing.assert_allclose(got.rms_after_px, NOISE_PX * np.sqrt(1 + 1 / 8), rtol=0.06)
    assert (got.held_out, got.frames, got.method) == (True, 12, "held-out temperatures")
    assert not got.outside.any()


def test_the_95_percent_interval_holds_95_percent(seen: Observations, model: PaperModel):
    for part in evaluate(model, seen).coverage_95:
        assert 0.92 <= part <= 0.98


def test_each_temperature_has_its_own_rms(seen: Observations, model: PaperModel):
    got = evaluate(model, seen).temperatures
    assert [row.chamber_degC for row in got] == list(HELD_OUT_DEGC)
    assert [row.camera_degC for row in got] == [degC + 15 for degC in HELD_OUT_DEGC]
    for row in got:
        np.testing.assert_allclose(row.before_px, true_rms(row.chamber_degC - 24), rtol=0.05)
        assert max(row.after_px) < 1.3 * NOISE_PX
        assert row.frames == 2


def test_without_held_out_frames_one_temperature_is_left_out_at_a_time():
    all_fitted = observations(quadratic, NOISE_PX, seed=5, held_out_degC=())
    model = fit_paper(all_fitted)
    got = evaluate(model, all_fitted)
    assert not got.held_out
    assert got.method.startswith("no held-out frames")
    assert [row.chamber_degC for row in got.temperatures] == list(model.score.fold_chamber_degC)
    for row, fold in zip(got.temperatures, model.score.fold_rms_px, strict=True):
        np.testing.assert_allclose(row.after_px, fold)


def test_a_model_scores_a_session_it_was_not_fitted_to(model: PaperModel):
    other = observations(quadratic, NOISE_PX, seed=6, session=facts("cycle-2"))
    np.testing.assert_allclose(evaluate(model, other).rms_after_px, NOISE_PX * np.sqrt(1 + 1 / 8), rtol=0.06)


def test_temperatures_beyond_the_fit_are_reported(model: PaperModel):
    hotter = observations(quadratic, NOISE_PX, held_out_degC=(34.0, 60.0))
    np.testing.assert_array_equal(evaluate(model, hotter).outside, np.repeat([False, True], 2 * 54))


def test_the_score_of_another_camera_is_refused(seen: Observations, model: PaperModel):
    with pytest.raises(SessionError, match=r"TS-0001, .* of camera other"):
        evaluate(model, replace(seen, sessions=(facts(camera="other"),)))
    with pytest.raises(SessionError, match="images of"):
        evaluate(model, replace(seen, image_size=(640, 480)))


def test_too_few_temperatures_to_leave_one_out_are_refused(model: PaperModel):
    few = observations(quadratic, fit_degC=(31.0,), held_out_degC=())
    with pytest.raises(SessionError, match=r"degree 2 .* 4 .*, found 2"):
        evaluate(model, few)


def test_the_table_is_shown_with_the_papers(seen: Observations, model: PaperModel):
    exact = replace(
        evaluate(model, seen), before_px=np.array([[0.2, -0.5]]), after_px=np.array([[-0.01, 0.05]]), frames=12
    )
    assert format_table(exact).splitlines()[1:] == [
        "                                 along I                       along J",
        "                  before     after    gain      before     after    gain",
        "paper              0.191     0.100    48 %       0.576     0.090    84 %",
        "this session       0.200     0.010    95 %       0.500     0.050    90 %",
        "12 frames; same session, interpolated; held-out temperatures",
    ]
    assert format_table(replace(exact, simulated=True)).splitlines()[1:] == [
        "                                             along I                       along J",
        "                              before     after    gain      before     after    gain",
        "paper                          0.191     0.100    48 %       0.576     0.090    84 %",
        "this session (simulated)       0.200     0.010    95 %       0.500     0.050    90 %",
        "12 frames; same session, interpolated; held-out temperatures",
    ]


def test_growth_is_a_negative_gain():
    assert compute_improvement_percent(0.1, 0.2) == pytest.approx(-100)
    assert np.isnan(compute_improvement_percent(0.0, 0.2))
