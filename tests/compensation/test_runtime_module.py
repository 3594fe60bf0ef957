"""The module for other people's programs says what the model says; a model file holds both forms."""

import ast
import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from thermostand.compensation.apply.runtime_export import build_runtime_model, export_runtime
from thermostand.compensation.drift.drift_model import DriftModel, Outside
from thermostand.compensation.drift.model_file import load_model, save_model
from thermostand.compensation.drift_runtime import Drift
from thermostand.compensation.history.thermal_history import States, make_initial_state, read_state_row
from thermostand.foundation.errors import SessionError

from .made_up_models import LIFE, MODELS, POINTS, paper, thermal


@pytest.mark.parametrize("model", MODELS)
def test_the_module_gives_the_model_s_corrections_and_flags_at_every_instant(model: DriftModel, tmp_path: Path):
    export_runtime(model, tmp_path / "new")
    live, state = Drift.load(tmp_path / "new" / "drift.json"), make_initial_state(model.memory)
    assert np.isnan(live.correct(POINTS)).all()
    seen = set()
    for number, sample in enumerate(LIFE):
        live.advance(*sample)
        state.advance(*sample)
        if number % 7 and not np.isnan(sample).any():
            continue
        states = (
            States(model.memory, read_state_row(state)[None])
            if model.form == "thermal"
            else States.at_degC(live._camera_degC, 1)
        )
        corrected = live.correct(POINTS)
        if np.isnan(corrected).all():
            with pytest.raises(ValueError, match="state is NaN"):
                model.correct(POINTS, states)
        else:
            np.testing.assert_allclose(corrected, model.correct(POINTS, states), atol=1e-12)
        np.testing.assert_array_equal(live.flags(POINTS), model.flags(POINTS, states))
        seen |= set(live.flags(POINTS).tolist())
    flags = Outside(0)
    for found in seen:
        flags |= Outside(found)
    assert 0 in seen or (model.form == "thermal" and np.isinf(model.valid.least_on_s))
    assert flags == (~Outside(0) if model.form == "thermal" else Outside.PLACE | Outside.CAMERA)


def test_the_module_needs_numpy_only_and_runs_where_nothing_else_is(tmp_path: Path):
    _, module = export_runtime(thermal(), tmp_path)
    tree = ast.parse(module.read_text())
    imported = {name.name for node in ast.walk(tree) if isinstance(node, ast.Import) for name in node.names}
    assert imported == {"json", "math", "numpy"}
    assert not any(isinstance(node, ast.ImportFrom) for node in ast.walk(tree))
    program = (
        "import sys; sys.path[:0] = ['.']; from drift_runtime import Drift; d = Drift.load('drift.json');"
        "[d.advance(10, 24.0, 1, 44.0) for _ in range(2000)]; print(d.correct([[320.5, 200.25]]).tolist());"
        "assert not {'compensation', 'stand', 'scipy', 'cv2'} & set(sys.modules)"
    )
    done = subprocess.run([sys.executable, "-I", "-c", program], cwd=tmp_path, capture_output=True, check=True)
    state = make_initial_state(thermal().memory)
    for _ in range(2000):
        state.advance(10, 24.0, 1, 44.0)
    states = States(thermal().memory, read_state_row(state)[None])
    expected = thermal().correct(np.array([[320.5, 200.25]]), states)
    np.testing.assert_allclose(json.loads(done.stdout), expected, atol=1e-9)


def test_the_exported_file_is_small():
    assert len(json.dumps(build_runtime_model(thermal()))) < 5000
    assert len(json.dumps(build_runtime_model(paper(4)))) < 5000


def test_a_file_that_is_no_runtime_model_is_refused():
    with pytest.raises(ValueError, match="drift runtime model"):
        Drift({"format": "thermostand drift model"})
    with pytest.raises(ValueError, match="of this version"):
        Drift(build_runtime_model(thermal()) | {"version": 3})


def test_a_model_file_holds_both_forms_and_one_of_a_single_form_still_opens(tmp_path: Path):
    path = tmp_path / "model.json"
    for model, other in ((thermal(), paper(2)), (paper(2), thermal())):
        save_model(replace(model, other=other), path)
        loaded = load_model(path)
        assert (loaded.form, loaded.other and loaded.other.form) == (model.form, other.form)
        for one, two in ((loaded, model), (loaded.other, other)):
            assert one is not None
            states = States.at_degC(40.0, len(POINTS), two.memory)
            np.testing.assert_array_equal(one.shift(POINTS, states), two.shift(POINTS, states))
    data = json.loads(path.read_text())
    single = {name: value for name, value in data.items() if name != "other"}
    path.write_text(json.dumps(single))
    assert load_model(path).other is None
    for changed in ({"camera_serial": "TS-0002"}, {"other": single}):
        path.write_text(json.dumps(data | {"other": data["other"] | changed}))
        with pytest.raises(SessionError, match=r"model\.json: .*\(other"):
            load_model(path)
