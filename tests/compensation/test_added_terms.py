"""A kind of drift term that another package adds is found everywhere by its one class."""

import json
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from tests.installed import install
from thermostand.compensation.apply.runtime_export import export_c, export_runtime
from thermostand.compensation.design.next_visit import (
    DesignGoal,
    compute_equilibrium,
    decide,
    fit_surroundings,
    forecast,
    read_current_state,
)
from thermostand.compensation.drift.model_file import load_model, save_model
from thermostand.compensation.drift.terms import TERMS
from thermostand.compensation.drift.thermal_fit import fit_thermal
from thermostand.compensation.drift.thermal_model import ThermalModel
from thermostand.compensation.drift_runtime import Drift
from thermostand.compensation.drift_runtime import compiled as worked_out
from thermostand.compensation.expression import AIR, CAMERA, POWER, Origin, away, backlash, format_c, format_words, lag
from thermostand.compensation.history.thermal_history import States, make_initial_state, read_state_row
from thermostand.compensation.reporting.report_numbers import describe_formula
from thermostand.foundation.errors import ConfigError, SessionError

from .compiled_header import COMPILER, compile_header, run_header
from .drawn_cameras import draw_camera
from .drawn_sessions import DrawnSession, Stretch, record_session, reference, warm_up
from .made_up_models import LIFE

EXAMPLE = Path(__file__).parents[2] / "docs" / "examples" / "tube-term"
MODULE = (EXAMPLE / "acme_tube.py").read_text(encoding="utf-8")
VISITS = [Stretch(degC, 1500, "fit", 5) for degC in (52.0, 10.0, 45.0, 17.0, 31.0)]


@pytest.fixture(scope="module")
def tube(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """The package, installed; nothing of this program knows it."""
    folder = tmp_path_factory.mktemp("site")
    install(
        folder, "acme-tube", {"acme_tube": MODULE}, {"thermostand.drift_terms": "tube gradient = acme_tube:Gradient"}
    )
    sys.path.insert(0, str(folder))
    yield
    sys.path.remove(str(folder))
    TERMS.pop("tube gradient", None)
    sys.modules.pop("acme_tube", None)


@pytest.fixture(scope="module")
def seen(tube: None) -> DrawnSession:
    return record_session(draw_camera(3), [*warm_up(), *reference(), *VISITS])


@pytest.fixture(scope="module")
def model(seen: DrawnSession) -> ThermalModel:
    return fit_thermal(seen.observed)


def added(model: ThermalModel) -> list[int]:
    return [number for number, term in enumerate(model.terms) if term.kind == "tube gradient"]


def test_a_fit_has_it_and_a_file_keeps_it(model: ThermalModel, tmp_path: Path):
    assert [model.terms[number].model_dump() for number in added(model)] == [{"tau_s": 700.0}, {"tau_s": 2000.0}]
    assert np.abs(model.coefficients[:, added(model)]).min() > 0
    assert "tube gradient 11.6667 to 33.3333 min" in model.title
    save_model(model, tmp_path / "model.json")
    TERMS.pop("tube gradient")
    sys.modules.pop("acme_tube")  # another program reads it
    loaded = load_model(tmp_path / "model.json")
    assert isinstance(loaded, ThermalModel)
    assert [term.model_dump() for term in loaded.terms] == [term.model_dump() for term in model.terms]
    data = json.loads((tmp_path / "model.json").read_text())
    data["terms"][added(model)[0]]["tau_s"] = -1.0
    (tmp_path / "model.json").write_text(json.dumps(data))
    with pytest.raises(SessionError, match=r"terms.*tau_s"):
        load_model(tmp_path / "model.json")


def test_the_report_s_formula_has_it(model: ThermalModel):
    formula = describe_formula(model)
    assert formula.terms[added(model)[0]] == "(lag(camera(11.6667 min), 5 min) − air(11.6667 min)) supply(20 min)"
    assert formula.coefficients_px.shape == (len(model.terms), 8)


def test_the_run_time_and_the_header_have_it(model: ThermalModel, tmp_path: Path):
    export_runtime(model, tmp_path)
    drift, state = Drift.load(tmp_path / "drift.json"), make_initial_state(model.memory)
    places = model.facts.reference_centres_px[:6]
    corrected, flags = [], []
    for sample in LIFE:
        drift.advance(*sample)
        state.advance(*sample)
        corrected.append(drift.correct(places))
        flags.append(drift.flags(places))
    here = States(model.memory, read_state_row(state)[None])
    np.testing.assert_allclose(corrected[-1], model.correct(places, here), rtol=0, atol=1e-9)
    if COMPILER is not None:
        c = run_header(
            compile_header(export_c(model, tmp_path / "drift.h")), places, np.array(LIFE), model.facts.image_size
        )
        np.testing.assert_allclose(c.corrected_px, corrected, rtol=0, atol=1e-9)
        np.testing.assert_array_equal(c.flags, flags)


def test_the_forecast_has_it(seen: DrawnSession, model: ThermalModel):
    around = fit_surroundings(seen.observed, ramp_K_per_min=20.0)
    inner = [part for part in model.memory.parts if part[0] == "lag" and part[1] not in (AIR, CAMERA, POWER)]
    assert len(inner) == 2
    long = forecast(
        around, read_current_state(seen.observed, model.memory), np.array([40.0]), np.full(1, 12 * 3600.0)
    ).states
    rest = compute_equilibrium(around, np.array([40.0]), model.memory).states
    assert long.of(inner) == pytest.approx(rest.of(inner), abs=0.01)
    assert decide(seen.observed, DesignGoal((10.0, 52.0), 1e-4)).reason.startswith("the residual is predicted")


def test_a_package_that_is_broken_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, seen: DrawnSession):
    monkeypatch.syspath_prepend(tmp_path)
    install(tmp_path, "acme-none", {}, {"thermostand.drift_terms": "none = acme_none:No"}, "2.0")
    with pytest.raises(ConfigError, match=r"none: acme-none 2.0 cannot be loaded.*reinstall it"):
        fit_thermal(seen.observed)


@pytest.mark.parametrize(
    ("feature", "words", "c", "value"),
    [
        (1.0, "1", "1.0", 1.0),
        (away(CAMERA) ** 2, "T^2", "(((x[0] - 44.0) / 20.0) * ((x[0] - 44.0) / 20.0))", 0.25),
        (0.5 * (CAMERA - AIR) / 2 + POWER, "0.5 (T - air) / 2 + supply", None, 3.5),
        (away(CAMERA - (AIR + 1)) * 2, "(T - (air + 1)) 2", None, -1.0),
        (lag(POWER, 60.0) - 1, "supply(1 min) - 1", None, -1.0),
    ],
)
def test_an_expression_in_words_in_c_and_as_a_number(feature, words: str, c: str | None, value: float):
    at = {CAMERA: 0, AIR: 1, POWER: 2, lag(POWER, 60.0): 3}
    bound = Origin(44.0, 24.0).bind(feature)
    assert format_words(feature) == words
    assert worked_out(bound, at)([34.0, 24.0, 1.0, 0.0]) == value
    written = format_c(bound, {part: f"x[{place}]" for part, place in at.items()})
    assert c is None or written == c
    assert eval(written, {}, {"x": [34.0, 24.0, 1.0, 0.0]}) == pytest.approx(value)


def test_what_is_no_expression_is_refused():
    with pytest.raises(ValueError, match="no expression"):
        worked_out(backlash(CAMERA, 3.0), {CAMERA: 0})
