"""`stand run --report`: one command to a complete report, for small recipes and for the session."""

import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from tests import fork_server
from tests.system.conftest import WHOLE_SENSOR
from thermostand.compensation.drift.model_file import load_model
from thermostand.foundation.exit_codes import NOT_REPORTED
from thermostand.recording.reading.scan import verify
from thermostand.recording.reading.session import Session
from thermostand.stand.commands.command_table import app
from thermostand.stand.config.stand_config import find_packaged
from thermostand.stand.estimating.estimate import price_plan
from thermostand.stand.running.order import load_order
from thermostand.stand.running.session_report import MODEL_NAME, REPORT_NAME

RECIPE = """
name: a-night
experiments:
  - warm_up: {table_position: {linear: 0, rotary: 0}, frames: 3, interval_s: 60}
  - thermal_cycle:
      table_position: {linear: 0, rotary: 0}
      equilibrium_s: 120
      set_points_degC: [30, 20, 26, 22]
      held_out_degC: [22]
      soak_s: 120
      band_K: 0
      reference_frames: 2
"""
EVERY_SEQUENCE = (
    RECIPE
    + """
  - calibration:
      equilibrium_s: 120
      linear_mm: [0, 30]
      rotary_deg: [-5, 5]
      frames_per_position: 1
  - validation:
      temperatures_degC: [24, 30]
      positions: [{linear_mm: 20, rotary_deg: 0}, {linear_mm: 25, rotary_deg: 4}]
      equilibrium_s: 120
      soak_s: 120
      band_K: 0
      reference_frames: 1
      frames_per_position: 1
"""
)
TOO_FEW_TEMPERATURES = """
name: too-few
experiments:
  - thermal_cycle:
      table_position: {linear: 0, rotary: 0}
      equilibrium_s: 60
      set_points_degC: [25]
      soak_s: 60
      band_K: 0
      reference_frames: 1
"""
WARM_UP_ALONE = """
name: warm-up-alone
experiments:
  - warm_up: {table_position: {linear: 0, rotary: 0}, cool_down_max_s: 60, frames: 3, interval_s: 60}
"""

OWN_STEPS = """
name: own-steps
steps:
  - close_flap
  - move_to: {linear: 0, rotary: 0}
  - start_chamber: 24
  - soak: 120
  - repeat:
      times: 2
      steps:
        - ramp: {to_degC: 30, rate_K_per_min: 3, every_K: 3, steps: [open_flap, capture, close_flap]}
        - ramp: {to_degC: 24, rate_K_per_min: 3, every_K: 6}
"""


@pytest.fixture
def out(tmp_path: Path) -> Iterator[Path]:
    """A folder for sessions that is not kept: a session is large."""
    yield tmp_path / "sessions"
    shutil.rmtree(tmp_path / "sessions", ignore_errors=True)


def run_reported(recipe: str, config_text: str, out: Path, timeout_s: float) -> subprocess.CompletedProcess[str]:
    config = out.parent / "stand.yaml"
    config.write_text(config_text)
    command = [sys.executable, "-m", "thermostand.stand.cli", "run", recipe, "--config", str(config), "--out", str(out)]
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1"}
    options = ["--virtual-time", "--report"]
    return fork_server.run([*command, *options], capture_output=True, text=True, env=environment, timeout=timeout_s)


def run_here(recipe: str, config_text: str, out: Path) -> Result:
    """The same in this process, which has loaded what a command loads first."""
    recipe_file, config = out.parent / "recipe.yaml", out.parent / "stand.yaml"
    recipe_file.write_text(recipe)
    config.write_text(config_text)
    words = ["run", str(recipe_file), "--config", str(config), "--out", str(out), "--virtual-time", "--report"]
    return CliRunner().invoke(app, words)


def check_reported(ended: subprocess.CompletedProcess[str]) -> Path:
    """The session: sound, with a model and a report in its folder."""
    assert ended.returncode == 0, ended.stderr
    session, *lines = ended.stdout.splitlines()
    directory = Path(session)
    assert verify(directory).is_sound
    assert lines[-2:] == [f"model    {directory / MODEL_NAME}", f"report   {directory / REPORT_NAME}"]
    assert load_model(directory / MODEL_NAME).facts.session_ids == (directory.name,)
    assert directory.name in (directory / REPORT_NAME).read_text(encoding="utf-8")
    return directory


@pytest.mark.usefixtures("compiled_fit")
@pytest.mark.parametrize(
    ("text", "frames"),
    [
        pytest.param(RECIPE, 3 + 2 + 4, id="warm-up and cycle"),
        pytest.param(EVERY_SEQUENCE, 3 + 2 + 4 + 4 + 2 * 3, id="every sequence", marks=pytest.mark.nightly),
    ],
)
def test_one_command_runs_a_recipe_to_a_report(out: Path, config_text: Callable[..., str], text: str, frames: int):
    recipe = out.parent / "recipe.yaml"
    recipe.write_text(text)
    directory = check_reported(run_reported(str(recipe), config_text(camera=WHOLE_SENSOR), out, 900))
    assert Session.open(directory).frame_count == frames


@pytest.mark.usefixtures("compiled_fit")
def test_a_run_whose_frames_allow_no_fit_is_complete_and_says_so(out: Path, config_text: Callable[..., str]):
    ended = run_here(TOO_FEW_TEMPERATURES, config_text(camera=WHOLE_SENSOR), out)
    assert ended.exit_code == NOT_REPORTED
    directory = Path(ended.stdout.strip())
    assert verify(directory).is_sound
    last = ended.stderr.splitlines()[-1]
    assert last.startswith(f"error: {directory} is recorded, but")
    assert last.endswith(f"; {directory / REPORT_NAME} shows the drift alone")
    assert "Drift over temperature" in (directory / REPORT_NAME).read_text(encoding="utf-8")
    assert not (directory / MODEL_NAME).exists()


@pytest.mark.nightly
@pytest.mark.usefixtures("compiled_fit")
def test_a_warm_up_alone_has_a_report_of_its_drift_and_no_model(out: Path, config_text: Callable[..., str]):
    ended = run_here(WARM_UP_ALONE, config_text(camera=WHOLE_SENSOR), out)
    assert ended.exit_code == 0, ended.stderr
    session, *lines = ended.stdout.splitlines()
    assert lines == [f"report   {Path(session) / REPORT_NAME}"]
    assert not (Path(session) / MODEL_NAME).exists()
    assert ">Warm-up<" in (Path(session) / REPORT_NAME).read_text(encoding="utf-8")


@pytest.mark.usefixtures("compiled_fit")
def test_frames_of_ones_own_steps_have_a_report_of_what_was_recorded(out: Path, config_text: Callable[..., str]):
    ended = run_here(OWN_STEPS, config_text(camera=WHOLE_SENSOR), out)
    assert ended.exit_code == 0, ended.stderr
    session, *lines = ended.stdout.splitlines()
    assert lines == [f"report   {Path(session) / REPORT_NAME}"]
    assert Session.open(Path(session)).frame_count == 4
    page = (Path(session) / REPORT_NAME).read_text(encoding="utf-8")
    assert "4 (4 other)" in page
    assert "Drift over time" in page


@pytest.mark.nightly
@pytest.mark.usefixtures("compiled_fit")
def test_the_session_runs_from_one_command_to_a_complete_report(out: Path, config_text: Callable[..., str]):
    text = config_text(recording={"frame_encoding": "roi"})
    directory = check_reported(run_reported("overnight", text, out, 3600))
    session = Session.open(directory)
    assert session.frame_count == 3600 + 34 * 5 + 20 + 14 * 5
    assert not [event.text for event in session.events() if event.level != "info"]

    order = load_order("overnight", str(out.parent / "stand.yaml"))
    expected_s = {step.planned.step_id: step.duration_s for step in price_plan(order.recipe.plan(), order.config)}
    marks = [mark for mark in session.steps() if mark.kind != "cool_down"]  # the simulated camera is cold already
    took_s = sum((end.time_ns - begin.time_ns) / 1e9 for begin, end in zip(marks[::2], marks[1::2], strict=True))
    assert took_s == pytest.approx(sum(expected_s[mark.step_id] for mark in marks[::2]), rel=0.02)
    assert sum(expected_s.values()) < 14 * 3600  # 18:00 to 08:00
    report = (directory / REPORT_NAME).read_text(encoding="utf-8")
    for title in (
        "Result",
        "Warm-up",
        "Drift over temperature",
        "Before and after compensation",
        "Model",
        "Recorded data",
        "Measured with",
    ):
        assert f">{title}<" in report
    assert find_packaged("recipes", "overnight").read_text() == session.attachments["recipe.yaml"]
