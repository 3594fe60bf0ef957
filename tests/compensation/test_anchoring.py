"""A model in a session in which the target was put back elsewhere."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from thermostand.compensation.drift.model_file import load_model, save_model
from thermostand.compensation.drift.paper_model import fit_paper
from thermostand.compensation.drift.rereference import rereference
from thermostand.compensation.drift.thermal_fit import fit_thermal
from thermostand.compensation.drift.thermal_model import ThermalModel
from thermostand.compensation.drift.training_data import compute_frame_states
from thermostand.compensation.observations import Float
from thermostand.experiments.steps import Role
from thermostand.foundation.errors import SessionError

from .drawn_cameras import draw_camera
from .drawn_sessions import DrawnSession, cycle, record_session, reference, warm_up

SEED = 2611
WAY_DEGC, ASKED_DEGC = (31, 38, 45, 52, 45, 38, 31, 24, 17, 10, 17, 24), (34, 48, 20)


@pytest.fixture(scope="module")
def first() -> DrawnSession:
    return record_session(draw_camera(SEED), [*warm_up(), *reference(), *cycle(WAY_DEGC, ())], SEED)


@pytest.fixture(scope="module")
def model(first: DrawnSession) -> ThermalModel:
    return fit_thermal(first.observed)


def moved(away_px: float) -> DrawnSession:
    """Another session; before it the target was put back with a shift of the image, and a turn of 50 urad."""
    made = record_session(draw_camera(SEED), [*warm_up(), *reference(), *cycle(ASKED_DEGC, ASKED_DEGC)], SEED + 1)
    middle = made.truth_px - made.truth_px.mean(axis=(0, 1))
    shift = away_px * np.array([0.8, -0.6]) + 5e-5 * middle[:, :, ::-1] * np.array([-1.0, 1.0])
    return DrawnSession(replace(made.observed, centres_px=made.observed.centres_px + shift), made.truth_px + shift)


def left(model: ThermalModel, first: DrawnSession, asked: DrawnSession) -> tuple[Float, Float]:
    """Deviations (F, 54, 2) of the corrected truth from the first session's reference, and the variance claimed."""
    at_reference_px = first.truth_px[first.observed.of(Role.REFERENCE)].mean(axis=0)
    states = compute_frame_states(asked.observed, model.memory)
    frames = np.flatnonzero(asked.observed.of(Role.VALIDATION)).tolist()
    each = [(asked.truth_px[k], states.where(np.array([k]))) for k in frames]
    deviation = np.array([model.correct(*one) - at_reference_px for one in each])
    return deviation, np.array([np.diagonal(model.covariance(*one), axis1=1, axis2=2) for one in each])


def test_five_frames_of_a_session_take_out_how_the_target_was_put_back(
    first: DrawnSession, model: ThermalModel
) -> None:
    asked = moved(0.3)
    few = asked.observed.of(Role.REFERENCE)
    few[np.flatnonzero(few)[5:]] = False
    here = rereference(model, asked.observed, few)
    deviation, variance = left(here, first, asked)
    assert np.sqrt((left(model, first, asked)[0] ** 2).mean()) > 0.2
    assert np.sqrt((deviation**2).mean()) < 0.006
    assert (np.abs(deviation) < 1.96 * np.sqrt(variance)).mean() > 0.9
    assert np.sqrt(variance.mean()) < 0.012


def test_the_frames_may_be_of_another_temperature(first: DrawnSession, model: ThermalModel) -> None:
    asked = moved(0.3)
    warm = asked.observed.chamber_degC == ASKED_DEGC[0]
    deviation, _ = left(rereference(model, asked.observed, warm), first, asked)
    assert np.sqrt((deviation**2).mean()) < 0.008


def test_it_is_a_model_like_others(first: DrawnSession, model: ThermalModel, tmp_path: Path) -> None:
    here = rereference(replace(fit_paper(first.observed), other=model), moved(0.3).observed)
    save_model(here, tmp_path / "model.json")
    loaded = load_model(tmp_path / "model.json")
    assert isinstance(loaded, ThermalModel)
    np.testing.assert_array_equal(loaded.coefficients, here.coefficients)
    np.testing.assert_allclose(here.coefficient_covariance, here.coefficient_covariance.transpose(0, 2, 1), atol=1e-12)
    assert (np.linalg.eigvalsh(here.coefficient_covariance) > -1e-12).all()


def test_what_cannot_be_anchored_is_refused(first: DrawnSession, model: ThermalModel) -> None:
    near, paper = moved(0.3).observed, fit_paper(first.observed)
    with pytest.raises(SessionError, match="has no thermal form"):
        rereference(paper, near)
    with pytest.raises(SessionError, match=r"12\.0 px"):
        rereference(model, moved(12.0).observed)
    with pytest.raises(SessionError, match="of its target"):
        rereference(model, replace(near, target=near.target.model_copy(update={"name": "another"})))
    with pytest.raises(SessionError, match="no usable reference frames"):
        rereference(model, near, np.zeros(len(near.frame), bool))
