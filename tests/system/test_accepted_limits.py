"""A configuration that weakens the protection, at the command line: refused, or accepted by name, shown, recorded."""

from collections.abc import Callable
from pathlib import Path

import pytest
import yaml
from typer.testing import CliRunner, Result

from thermostand.recording.reading.session import Session
from thermostand.stand.commands.command_table import app

RECIPE = """
name: one
experiments:
  - calibration: {equilibrium_s: 30, linear_mm: [0], rotary_deg: [0], frames_per_position: 1}
"""


@pytest.fixture
def stand(tmp_path: Path, config_text: Callable[..., str]) -> Callable[..., Result]:
    """`stand COMMAND RECIPE` with entries of the guard's and the compressor's section replaced."""
    (tmp_path / "recipe.yaml").write_text(RECIPE)
    data = yaml.safe_load(config_text())

    def call(command: str, *options: str, **sections: dict[str, object]) -> Result:
        changed = {**data, **{name: {**data.get(name, {}), **entries} for name, entries in sections.items()}}
        config = tmp_path / "stand.yaml"
        config.write_text(yaml.safe_dump(changed))
        return CliRunner().invoke(
            app, [command, str(tmp_path / "recipe.yaml"), "--config", str(config), *options], catch_exceptions=False
        )

    return call


def test_a_weakened_limit_is_refused_and_when_accepted_by_name_shown_at_each_start_and_recorded(
    tmp_path: Path, stand: Callable[..., Result]
):
    out = ("--virtual-time", "--out", str(tmp_path / "sessions"))
    refused = stand("run", *out, compressor={"min_off_s": 60})
    assert refused.exit_code == 2
    assert "stand.yaml: compressor.min_off_s: 60 s " in refused.stderr
    assert len(refused.stderr.splitlines()) == 1
    assert not (tmp_path / "sessions").exists()

    run = stand("run", *out, compressor={"min_off_s": 60}, guard={"overrides": ["compressor.min_off_s"]})
    assert run.exit_code == 0, run.stderr
    assert "compressor.min_off_s 60 (safe: at least 180 s)" in run.stderr
    events = Session.open(Path(run.stdout.strip())).events()
    reported = [(event.level, event.data) for event in events if event.kind == "limits_overridden"]
    assert reported == [("warning", {"compressor.min_off_s": 60.0})]


def test_an_alert_program_that_does_not_exist_is_refused_where_a_run_would_begin_but_not_in_a_plan(
    tmp_path: Path, stand: Callable[..., Result]
):
    alerts = {"command": [str(tmp_path / "tell"), "--urgent"]}
    assert stand("plan", alerts=alerts).exit_code == 0
    refused = stand("run", "--out", str(tmp_path / "sessions"), alerts=alerts)
    assert refused.exit_code == 2
    assert f"alerts.command: {tmp_path / 'tell'} is no program" in refused.stderr
    assert len(refused.stderr.splitlines()) == 1
    assert not (tmp_path / "sessions").exists()
