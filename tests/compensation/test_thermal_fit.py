"""The thermal form against cameras of heat reservoirs that share no code with it: what it gains, and what it says."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from thermostand.compensation.drift.drift_model import DriftModel, Outside
from thermostand.compensation.drift.evaluation import evaluate
from thermostand.compensation.drift.model_facts import ModelFacts
from thermostand.compensation.drift.model_file import load_model, save_model
from thermostand.compensation.drift.model_selection import fit, select_better
from thermostand.compensation.drift.paper_model import PaperModel, fit_paper
from thermostand.compensation.drift.terms import BacklashTerm
from thermostand.compensation.drift.thermal_fit import fit_thermal
from thermostand.compensation.drift.thermal_model import ThermalModel
from thermostand.compensation.drift.training_data import compute_frame_states
from thermostand.compensation.history.thermal_history import (
    States,
    compute_states_at,
    make_initial_state,
    read_state_row,
)
from thermostand.compensation.observations import Observations, concatenate
from thermostand.experiments.steps import Role
from thermostand.foundation.errors import ConfigError, SessionError

from .reservoirs import Part, cycle, reference, session, warm_up
from .synthetic import observations as without_histories
from .synthetic import quadratic

AT_REST = {"fold_chamber_degC": (10.0, 24.0, 38.0), "fold_rms_px": ((0.003, 0.003),) * 3}
Seen = tuple[Observations, np.ndarray]


@pytest.fixture(scope="module")
def recorded() -> Seen:
    return session(warm_up(24.0) + reference() + cycle())


@pytest.fixture(scope="module")
def thermal(recorded: Seen) -> ThermalModel:
    return fit_thermal(recorded[0])


def left_mpx(model: DriftModel, seen: Seen, role: Role, reference_px: np.ndarray | None = None) -> float:
    """RMS of both coordinates against the noise-free truth, pooled."""
    observed, truth = seen
    at_reference = truth[observed.of(Role.REFERENCE)].mean(axis=0) if reference_px is None else reference_px
    states = compute_frame_states(observed, model.memory)
    frames = np.flatnonzero(observed.of(role))
    left = [at_reference - model.correct(truth[frame], states.where(np.array([frame]))) for frame in frames]
    return 1e3 * float(np.sqrt(np.mean(np.square(left))))


def test_a_polynomial_of_the_temperature_is_limited_by_the_lag_and_the_thermal_form_is_not(
    recorded: Seen, thermal: ThermalModel
):
    for degree in (2, 4):
        assert left_mpx(fit_paper(recorded[0], degree), recorded, Role.VALIDATION) > 8.0
    assert left_mpx(thermal, recorded, Role.VALIDATION) <= 2.0


def test_what_is_asked_for_without_a_form_is_the_one_that_predicts_better(recorded: Seen):
    model = fit(recorded[0])
    assert model.form == "thermal"
    assert {one.form for one in model.candidates} == {"paper", "thermal"}
    assert [one.form for one in model.candidates if one.chosen] == ["thermal"]
    assert model.other is not None
    np.testing.assert_array_equal(getattr(model.other, "coefficients", None), fit_paper(recorded[0]).coefficients)
    asked = fit(recorded[0], degree=2)
    assert (asked.form, asked.other and asked.other.form) == ("paper", "thermal")
    alone = fit(without_histories(quadratic, 0.005))
    assert (alone.form, alone.other) == ("paper", None)


def test_forms_that_are_as_good_at_rest_are_chosen_by_frames_that_were_not(recorded: Seen, thermal: ThermalModel):
    paper = fit(recorded[0]).other
    assert isinstance(paper, PaperModel)
    alike = replace(paper, candidates=tuple(one.model_copy(update=AT_REST) for one in paper.candidates))
    own = replace(thermal, candidates=tuple(one.model_copy(update=AT_REST) for one in thermal.candidates))
    in_use = next(one for one in alike.candidates if one.chosen)
    assert in_use.moving_rms_px is not None
    assert own.candidates[0].moving_rms_px is not None
    assert np.hypot(*in_use.moving_rms_px) > 5 * np.hypot(*own.candidates[0].moving_rms_px)
    assert select_better(alike, own).form == "thermal"
    unseen = [one.model_copy(update={"moving_rms_px": None}) for one in alike.candidates]
    assert select_better(replace(alike, candidates=tuple(unseen)), own).form == "paper"


@pytest.mark.parametrize("air_degC", [15.0, 34.0])
def test_a_warm_up_elsewhere_is_predicted_when_one_was_recorded_and_not_otherwise(
    recorded: Seen, thermal: ThermalModel, air_degC: float
):
    elsewhere = session(reference() + warm_up(air_degC), seed=3)
    assert left_mpx(thermal, elsewhere, Role.WARM_UP) <= 3.0
    untaught = fit_thermal(session(reference() + cycle())[0])
    assert not untaught.has_warm_up
    assert "no warm-up was recorded" in untaught.title
    assert left_mpx(untaught, elsewhere, Role.WARM_UP) > 3 * left_mpx(thermal, elsewhere, Role.WARM_UP)


def test_plays_help_a_camera_with_play_and_are_not_taken_for_one_without(thermal: ThermalModel):
    loose = session(warm_up(24.0) + reference() + cycle(), plays=True)
    model = fit_thermal(loose[0])
    plays = [isinstance(term, BacklashTerm) for term in model.terms]
    of_loose_px, of_tight_px = (np.abs(one.coefficients[:2, plays]).max() for one in (model, thermal))
    assert of_tight_px < 0.003 < 0.03 < of_loose_px
    assert left_mpx(fit_paper(loose[0], 4), loose, Role.VALIDATION) > 50.0
    assert left_mpx(model, loose, Role.VALIDATION) <= 15.0


def test_the_95_percent_interval_holds_95_percent_at_held_out_temperatures(recorded: Seen, thermal: ThermalModel):
    found = evaluate(thermal, recorded[0])
    for part in found.coverage_95:
        assert part >= 0.92
    claimed_px = np.sqrt(found.claimed_px2.mean())
    assert claimed_px < 1.4 * np.sqrt((found.after_px**2).mean())  # the markers' own noise is most of it


def test_the_covariance_is_symmetric_and_grows_away_from_what_was_learned(recorded: Seen, thermal: ThermalModel):
    states = compute_frame_states(recorded[0], thermal.memory)
    usual = states.where(np.flatnonzero(recorded[0].of(Role.FIT))[:1])
    hot = States(usual.memory, usual.rows + np.where(np.arange(usual.rows.shape[1]) == 0, 60.0, 0.0))
    points = np.array([[1200.0, 1000.0], [2200.0, 1600.0]])
    near, far = thermal.covariance(points, usual), thermal.covariance(points, hot)
    np.testing.assert_allclose(near, near.transpose(0, 2, 1), rtol=0, atol=1e-12)
    assert (np.diagonal(near, axis1=1, axis2=2) >= np.square(thermal.claims.least_px)).all()
    assert (np.trace(far, axis1=1, axis2=2) > 10 * np.trace(near, axis1=1, axis2=2)).all()


def test_what_was_not_calibrated_is_flagged(recorded: Seen, thermal: ThermalModel):
    inside = recorded[0].of(Role.FIT, Role.VALIDATION, Role.WARM_UP)
    states = compute_frame_states(recorded[0], thermal.memory)
    point = np.array([[1200.0, 1000.0]])
    assert not any(thermal.flags(point, states.where(np.array([k])))[0] for k in np.flatnonzero(inside))
    usual = states.where(np.flatnonzero(inside)[-1:])
    assert thermal.flags(np.array([[20.0, 1000.0]]), usual)[0] == Outside.PLACE
    ambient = thermal.memory.at[thermal.memory.ambient_lag]
    for column, value, flag in (
        (0, 90.0, Outside.CAMERA),
        (ambient, 90.0, Outside.AMBIENT),
        (-2, 0.0, Outside.SWITCHED_ON),
    ):
        rows = usual.rows.copy()
        rows[0, column] = value
        found = thermal.flags(point, States(usual.memory, rows))[0]
        assert found & ~Outside.STATE == flag  # far away enough, and the whole state is unlike any
    unknown = States.at_degC(45.0, 1, thermal.memory)
    assert thermal.flags(point, unknown)[0] & Outside.HISTORY
    assert np.isnan(thermal.shift(point, unknown)).all()
    for ask in (thermal.correct, thermal.shift, thermal.covariance, thermal.flags):
        with pytest.raises(ValueError, match="temperature alone does not"):
            ask(point, 45.0)


def test_the_same_correction_comes_live_and_from_the_recording(recorded: Seen, thermal: ThermalModel):
    record = recorded[0].histories[0]
    end = 2000
    state = make_initial_state(thermal.memory)
    camera_degC = np.interp(record.ambient_ns, record.camera_ns, record.camera_degC)
    off = ~np.isin(record.ambient_ns, record.camera_ns)
    for index in range(1, end):
        mean = (record.ambient_degC[index] + record.ambient_degC[index - 1]) / 2
        stated = np.nan if off[index] else camera_degC[index]
        state.advance(10.0, mean, record.powered[index - 1], stated)
    at_ns = record.ambient_ns[end - 1 : end]
    offline = compute_states_at(record, thermal.memory, at_ns, camera_degC[end - 1 : end])
    point = np.array([[1200.0, 1000.0]])
    live = States(thermal.memory, read_state_row(state)[None])
    np.testing.assert_allclose(thermal.shift(point, live), thermal.shift(point, offline), atol=1e-6)


def test_a_recorded_warm_up_of_its_own_teaches_too(thermal: ThermalModel):
    alone = session(warm_up(24.0), seed=5, session_id="warm-up")
    rest = session(reference() + cycle(), seed=6, session_id="cycle")
    both = fit_thermal(concatenate([alone[0], rest[0]]))
    assert both.has_warm_up
    assert left_mpx(both, rest, Role.VALIDATION) <= 3.0
    at_reference = rest[1][rest[0].of(Role.REFERENCE)].mean(axis=0)
    assert left_mpx(both, alone, Role.WARM_UP, at_reference) <= 8.0


def test_a_thermal_model_is_read_back_number_for_number(thermal: ThermalModel, tmp_path: Path):
    save_model(thermal, tmp_path / "model.json")
    loaded = load_model(tmp_path / "model.json")
    assert isinstance(loaded, ThermalModel)
    for name in set(ThermalModel.__slots__) - {"facts", "valid"}:
        np.testing.assert_equal(getattr(loaded, name), getattr(thermal, name), err_msg=name)
    for name in ModelFacts.__slots__:
        np.testing.assert_equal(getattr(loaded.facts, name), getattr(thermal.facts, name), err_msg=name)
    assert loaded.valid.__repr__() == thermal.valid.__repr__()
    data = json.loads((tmp_path / "model.json").read_text())
    assert (data["form"], data["schema_version"]) == ("thermal", 10)
    (tmp_path / "older.json").write_text(json.dumps({**data, "schema_version": 9}))
    with pytest.raises(SessionError, match="schema_version: 9"):
        load_model(tmp_path / "older.json")
    (tmp_path / "model.json").write_text(json.dumps({**data, "reference_features": [0.0]}))
    with pytest.raises(SessionError, match="reference_features: shape"):
        load_model(tmp_path / "model.json")


def test_what_the_thermal_form_needs_is_reported(recorded: Seen):
    with pytest.raises(SessionError, match="history of the air"):
        fit(without_histories(quadratic), form="thermal")
    with pytest.raises(ConfigError, match="has no degree"):
        fit(recorded[0], degree=3, form="thermal")
    silent = replace(recorded[0], air_degC=np.full(len(recorded[0].frame), np.nan))
    with pytest.raises(SessionError, match="no air temperature"):
        fit_thermal(silent)


def test_a_session_that_only_one_form_can_be_fitted_to_has_that_form_and_says_what_the_other_lacks():
    """Two set-points are too few for a polynomial; frames on the way to others teach the thermal form."""
    way = [Part(air_degC, 2700, role="warm_up", frames=6, interval_s=300) for air_degC in (34.0, 17.0)]
    observed = session([*reference(), way[0], Part(45.0, 2700, role="fit", frames=5), way[1]])[0]
    messages: list[str] = []
    model = fit(observed, say=messages.append)
    assert (model.form, model.other) == ("thermal", None)
    (sentence,) = messages
    assert sentence.startswith("the paper form")
    with pytest.raises(SessionError, match="at 3 chamber temperatures"):
        fit(observed, form="paper")


def test_the_effective_parameters_are_fewer_than_the_coefficients_and_no_more_than_the_data(
    recorded: Seen, thermal: ThermalModel
):
    groups = {group.name: group for group in thermal.groups}
    assert sum(group.coefficients for group in groups.values()) == thermal.coefficients.size
    assert 8 < thermal.effective_parameters < 0.5 * thermal.coefficients.size
    instants = len(np.unique(np.array(recorded[0].step_id)[recorded[0].of(Role.REFERENCE, Role.FIT, Role.WARM_UP)]))
    assert thermal.effective_parameters < 8 * (instants + len(np.flatnonzero(recorded[0].of(Role.WARM_UP))))
    for group in groups.values():
        assert 0 <= group.effective <= group.coefficients
        assert all(after <= before for before, after in zip(group.prior_px, group.posterior_px, strict=True))
    assert groups["camera"].effective / groups["camera"].coefficients > 0.3


def test_a_model_without_a_prior_has_no_effective_parameters(thermal: ThermalModel):
    bare = replace(thermal, prior_px=None)
    assert bare.groups == ()
    assert np.isnan(bare.effective_parameters)
