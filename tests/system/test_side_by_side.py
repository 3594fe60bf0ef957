"""Virtual runs side by side on one machine, of one configuration, from the command line."""

import subprocess
import sys
from pathlib import Path

import yaml

from tests import fork_server
from tests.sections import change
from tests.system.conftest import CALM, CORNER, SHORT_RECIPE, require_aravis
from tests.system.test_run import digests
from thermostand.recording.reading.session import Session
from thermostand.stand.config.stand_config import find_packaged

# A session as short as it can be.
RECIPE = (
    SHORT_RECIPE.replace("600", "60")
    .replace("[30, 20, 24]", "[26]")
    .replace("[20]", "[]")
    .replace("frames: 2", "frames: 1")
)
STAND = [sys.executable, "-m", "thermostand.stand.cli"]


def begun(tmp_path: Path, name: str, *arguments: str) -> subprocess.Popen[str]:
    require_aravis()
    command = [*STAND, *arguments, "--virtual-time", "--out", str(tmp_path / name)]
    return fork_server.popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def ended(run: subprocess.Popen[str]) -> Path:
    stdout, stderr = run.communicate(timeout=300)
    assert run.returncode == 0, stderr
    return Path(stdout.splitlines()[-1])


def test_two_virtual_sessions_side_by_side_of_the_installed_configuration_give_the_same_session(tmp_path: Path):
    recipe = tmp_path / "short.yaml"
    recipe.write_text(RECIPE)
    config = tmp_path / "config.yaml"  # how full this machine's disk is adds no event
    text = find_packaged("", "simulated").read_text()
    config.write_text(text.replace("{directory: sessions}", "{directory: sessions, alert_below_percent: 0}"))
    assert "alert_below_percent: 0" in config.read_text()
    arguments = ("run", str(recipe), "--seed", "7", "--config", str(config))
    runs = [begun(tmp_path, name, *arguments) for name in ("first", "second")]
    first, second = (digests(ended(run)) for run in runs)
    assert first == second
    assert {name.split("/")[0] for name in first} >= {"frames", "telemetry", "journal.jsonl"}


def test_a_virtual_run_goes_on_and_a_new_one_begins_while_the_laboratory_of_a_killed_one_lives(tmp_path: Path):
    """An orphaned laboratory lives for a minute; nobody waits for its addresses."""
    recipe, config = tmp_path / "short.yaml", tmp_path / "config.yaml"
    recipe.write_text(RECIPE)
    data = yaml.safe_load(find_packaged("", "simulated").read_text())
    change(data, CALM)
    data["cameras"]["camera"] |= CORNER
    config.write_text(yaml.safe_dump(data))
    arguments = ("run", str(recipe), "--config", str(config))
    killed = begun(tmp_path, "killed", *arguments)
    assert killed.stderr is not None
    assert any(line.startswith("run:") for line in killed.stderr)  # it is under way
    killed.kill()
    killed.communicate()
    (session,) = (tmp_path / "killed").iterdir()
    resumed = fork_server.popen(
        [*STAND, "resume", str(session)], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    new = begun(tmp_path, "new", *arguments)
    assert ended(resumed) == session
    assert Session.open(session).frame_count == Session.open(ended(new)).frame_count == 2
