"""The public names: what use-from-python.md shows runs, `import thermostand` is enough, and arrays can be fitted."""

from __future__ import annotations

import asyncio
import importlib
import inspect
import json
import math
import os
import re
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import thermostand
from thermostand import compensation, markers, recording
from thermostand.compensation.drift.training_data import compute_frame_states
from thermostand.compensation.expression import POWER, lag
from thermostand.compensation.history.thermal_history import ThermalHistory, ThermalStateSpec, compute_states_at
from thermostand.experiments.steps import Role

from .conftest import Recorded
from .test_calibration_session import record as record_calibration

ROOT = Path(__file__).parents[2]
NOTEBOOK = (ROOT / "docs" / "how-to" / "use-from-python.md").read_text(encoding="utf-8")
BLOCKS = re.findall(r"```python\n(.*?)```", NOTEBOOK, re.DOTALL)


@pytest.mark.usefixtures("undrawn")
def test_what_the_notebook_page_shows_runs(recorded: Recorded, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    assert len(BLOCKS) == 7
    (tmp_path / "my-session").symlink_to(recorded.path)
    asyncio.run(record_calibration(tmp_path / "calibration", "calibration"))
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {}
    for block in BLOCKS:
        exec(compile(block, "docs/how-to/use-from-python.md", "exec"), names)
    assert {"model.json", "report.html", "report.json"} <= set(os.listdir(tmp_path))
    assert len(names["settled"]) == 4  # type: ignore[arg-type]
    assert max(names["evaluation"].rms_after_px) < 0.012  # type: ignore[attr-defined]
    assert names["found"].found == 54  # type: ignore[attr-defined]


@pytest.mark.parametrize("name", [name for name in dir(thermostand) if inspect.isfunction(getattr(thermostand, name))])
def test_a_public_function_documents_each_parameter_and_what_it_gives(name: str):
    """In numpydoc form, which the site shows; what only writes a file gives nothing."""
    function = getattr(thermostand, name)
    document = inspect.getdoc(function) or ""
    sections = re.split(r"\n\n(\w+)\n-+\n", document)
    parts = dict(zip(sections[1::2], sections[2::2], strict=True))
    listed = {
        each
        for line in re.findall(r"^(\w.*?)(?: :.*)?$", parts["Parameters"], re.MULTILINE)
        for each in line.split(", ")
    }
    assert set(inspect.signature(function).parameters) <= listed
    gives = str(inspect.signature(function).return_annotation) != "None"
    assert not gives or parts.keys() & {"Returns", "Yields"}


@pytest.mark.parametrize("package", [recording, markers, compensation, thermostand])
def test_each_public_name_exists_and_no_other(package: object):
    names = dir(package)
    assert len(names) > 5
    for name in names:
        assert getattr(package, name) is not None
    with pytest.raises(AttributeError, match="has no attribute 'nothing'"):
        package.nothing  # type: ignore[attr-defined]  # noqa: B018


def test_a_name_of_thermostand_is_that_of_its_package():
    assert thermostand.Session is recording.Session
    assert thermostand.session is recording.open_whole
    assert thermostand.detect is markers.detect
    assert thermostand.fit is compensation.fit
    assert thermostand.report is compensation.report
    assert thermostand.__version__ == importlib.metadata.version("thermostand")


def test_one_import_is_enough_and_light():
    code = (
        "import sys, thermostand\n"
        "assert not {'numpy', 'thermostand.recording.reading', 'numba', 'cv2'} & {*sys.modules}\n"
        "thermostand.Session\n"
        "assert not {'numba', 'scipy', 'cv2', 'matplotlib'} & {*sys.modules}"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_every_package_says_that_it_is_typed():
    for name in ("foundation", "drivers", "experiments", "recording", "markers", "stand", "compensation"):
        assert (ROOT / name / "py.typed").exists(), name
    assert (ROOT / "thermostand" / "py.typed").exists()


def arrays(set_points: tuple[float, ...] = (24.0, 10.0, 38.0, 52.0), frames: int = 3):
    chamber_degC = np.repeat(set_points, frames)
    x, y = np.meshgrid(np.linspace(50, 600, 6), np.linspace(50, 450, 4))
    at_rest = np.column_stack([x.ravel(), y.ravel()])
    moved = (chamber_degC - 24.0)[:, None, None] * np.array([0.01, -0.02])
    return at_rest + moved, chamber_degC + 20, chamber_degC


def test_arrays_become_observations_with_a_reference():
    centres_px, camera_degC, chamber_degC = arrays()
    centres_px[2, 5] = np.nan
    camera_degC[4] = np.nan
    seen = thermostand.observations_of(centres_px, camera_degC, chamber_degC=chamber_degC, reference_degC=23.0)
    assert seen.of(Role.REFERENCE).tolist() == [True] * 3 + [False] * 9
    assert seen.usable.tolist() == [True] * 4 + [False] + [True] * 7
    assert np.isnan(seen.centres_px[2, 5]).all()
    assert np.isnan(seen.covariance_px2[2, 5]).all()
    assert np.isnan(seen.centres_px[4]).all()
    assert seen.image_size == (602, 452)
    assert np.diff(seen.time_ns).tolist() == [10**9] * 11
    assert seen.target.count == 24


@pytest.mark.usefixtures("undrawn")
def test_a_fit_of_arrays_finds_the_drift_and_may_be_kept(tmp_path: Path):
    centres_px, camera_degC, chamber_degC = arrays()
    seen = thermostand.observations_of(
        centres_px, camera_degC, chamber_degC=chamber_degC, sigma_px=0.001, camera_serial="mine"
    )
    model = thermostand.fit(seen)
    score = thermostand.evaluate(model, seen)
    assert model.form == "paper"
    assert score.rms_before_px == pytest.approx((0.18, 0.36), rel=0.2)
    assert max(score.rms_after_px) < 1e-6
    thermostand.save_model(model, tmp_path / "model.json")
    again = thermostand.load_model(tmp_path / "model.json")
    np.testing.assert_array_equal(again.correct(centres_px[-1], 72.0), model.correct(centres_px[-1], 72.0))
    thermostand.report(tmp_path / "report.html", seen, model, score)
    assert "camera mine" in (tmp_path / "report.html").read_text()


def test_air_over_time_makes_a_history_for_the_thermal_form():
    centres_px, camera_degC, chamber_degC = arrays()
    time_ns = np.arange(12) * 60 * 10**9
    air = (time_ns - 10**9, chamber_degC + 0.5)
    seen = thermostand.observations_of(centres_px, camera_degC, time_ns, chamber_degC=chamber_degC, air=air)
    assert np.isfinite(seen.air_degC[:11]).all()
    assert len(seen.histories) == 1
    assert seen.histories[0].has_ambient


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"camera_degC": np.zeros(5)}, r"not \(12, 24, 2\) and \(5,\)"),
        ({"centres_px": np.zeros((12, 24))}, r"not \(12, 24\)"),
        ({"time_ns": np.zeros(3)}, r"time_ns has shape \(3,\)"),
        ({"role": ["fit"]}, r"role has shape \(1,\)"),
        ({"role": ["sleep"] * 12}, r"role has 'sleep'; there are reference, fit"),
        ({"centres_px": [[[1, 2]], [[1, 2], [3, 4]]]}, r"centres_px: expected numbers, as many in each row"),
        ({"camera_degC": ["warm"] * 12}, r"camera_degC: expected numbers"),
        ({"centres_px": np.full((12, 24, 2), np.nan)}, r"none of the 12 frames has a centre"),
        ({"time_ns": np.arange(12)[::-1]}, r"time_ns does not grow at frame 1"),
        ({"covariance_px2": np.ones((12, 2, 2))}, r"covariance_px2 has shape \(12, 2, 2\), not \(12, 24, 2, 2\)"),
        ({"covariance_px2": -np.eye(2)}, r"covariance_px2 of frame 0, marker 0 is no covariance"),
        ({"covariance_px2": np.full((12, 24, 2, 2), np.nan)}, r"covariance_px2 of frame 0, marker 0 is no covariance"),
        ({"camera_degC": [math.inf] * 12}, r"camera_degC: inf degC in place 0"),
        ({"camera_degC": [30.0] * 11 + [1e7]}, r"camera_degC: 1e\+07 degC in place 11"),
        ({"chamber_degC": [-400.0] * 12}, r"chamber_degC: -400 degC in place 0"),
        ({"air": (np.arange(3), [20.0, math.inf, 20.0])}, r"air: inf degC in place 1"),
        ({"centres_px": np.full((12, 24, 2), -1e7)}, r"marker 0 of frame 0 is at \(-1e\+07, -1e\+07\) px, outside"),
        ({"centres_px": np.full((12, 24, 2), 1e7)}, r"marker 0 of frame 0 is at \(1e\+07, 1e\+07\) px, outside"),
        ({"image_size": (300, 300)}, r"outside the image of 300 x 300"),
        ({"sigma_px": 0.0}, r"sigma_px is 0.0; expected one above 0"),
        ({"air": np.zeros(12)}, r"air: expected \(time_ns, values\)"),
        ({"air": (np.zeros(3), np.zeros(4))}, r"air: expected \(time_ns, values\), two columns of the same length"),
    ],
)
def test_arrays_that_do_not_agree_are_refused(change: dict[str, object], sentence: str):
    centres_px, camera_degC, chamber_degC = arrays()
    given = {"centres_px": centres_px, "camera_degC": camera_degC, "chamber_degC": chamber_degC} | change
    with pytest.raises(ValueError, match=sentence):
        thermostand.observations_of(**given)  # type: ignore[arg-type]


def test_lists_do_as_arrays_and_points_of_another_shape_are_refused():
    centres_px, camera_degC, chamber_degC = arrays()
    given = thermostand.observations_of(
        centres_px.tolist(),
        camera_degC.tolist(),
        chamber_degC=chamber_degC.tolist(),
        covariance_px2=[[1e-6, 1e-7], [1.000000000001e-7, 1e-6]],  # symmetric to rounding, as fits give it
    )
    model = thermostand.fit(given)
    place = [[300.0, 200.0]]
    np.testing.assert_array_equal(model.correct(place, 50.0), model.correct(np.array(place), 50.0))  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"points are \(N, 2\), not \(2,\)"):
        model.correct(np.array([300.0, 200.0]), 50.0)


def test_every_name_that_the_notebook_page_uses_exists():
    names = set(re.findall(r"thermostand\.([A-Za-z_]+)", NOTEBOOK))
    assert {"states", "rereference", "calibrate_views"} <= names
    assert names <= set(dir(thermostand))


def test_a_camera_that_was_off_in_between_is_known_from_its_supply_and_readings():
    """Frames at the ends of a session; in between the camera was off for two hours, which frames alone do not tell."""
    air_ns = np.arange(0, 8 * 3600, 60) * 10**9
    hours = air_ns / 3.6e12
    is_on = ((hours < 3) | (hours >= 5)).astype(float)
    own_degC = np.where(is_on > 0, 24 + 15 * -np.expm1(-np.where(hours < 3, hours, hours - 5) / 0.4), np.nan)
    frames = np.isin(air_ns, air_ns[[10, 60, 170, 312]])
    air = (air_ns, np.full(len(air_ns), 24.0))
    known: dict[str, Any] = {"air": air}
    supplied: dict[str, Any] = known | {"supply": (air_ns, is_on), "camera": (air_ns, own_degC)}
    slow = [lag(POWER, 1620.0)]
    memory = ThermalStateSpec(tuple(slow))
    history = ThermalHistory(*air, air_ns, is_on, air_ns[is_on > 0], own_degC[is_on > 0])
    truth = compute_states_at(history, memory, air_ns[frames], own_degC[frames])
    model: Any = SimpleNamespace(memory=memory)
    found = thermostand.states(model, time_ns=air_ns[frames], camera_degC=own_degC[frames], **supplied)
    np.testing.assert_allclose(found.of(slow), truth.of(slow))
    blind = thermostand.states(model, time_ns=air_ns[frames], camera_degC=own_degC[frames], **known)
    assert np.abs(blind.of(slow) - truth.of(slow)).max() > 0.1
    centres_px = np.tile([[0.0, 0.0], [9.0, 0.0], [0.0, 9.0], [9.0, 9.0]], (4, 1, 1))
    seen = thermostand.observations_of(centres_px, own_degC[frames], air_ns[frames], **supplied)
    np.testing.assert_allclose(compute_frame_states(seen, memory).of(slow), truth.of(slow))
    with pytest.raises(ValueError, match="only together with air"):
        thermostand.observations_of(centres_px, own_degC[frames], air_ns[frames], supply=supplied["supply"])
    with pytest.raises(ValueError, match="time_ns go backwards"):
        thermostand.states(model, time_ns=air_ns[::-1], **known)


@pytest.mark.nightly
def test_the_notebook_page_is_sound_for_a_strict_type_checker(tmp_path: Path):
    (tmp_path / "page.py").write_text("\n".join(BLOCKS))
    settings = {"include": ["."], "typeCheckingMode": "strict", "reportUnusedExpression": False}
    (tmp_path / "pyrightconfig.json").write_text(json.dumps({**settings, "extraPaths": [str(ROOT)]}))
    command = [sys.executable, "-m", "pyright", "-p", str(tmp_path), "--pythonpath", sys.executable]
    checked = subprocess.run(command, capture_output=True, text=True, check=False)
    assert checked.returncode == 0, checked.stdout
