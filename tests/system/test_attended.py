"""`--attended` on the command line: the run waits at a prompt, is killed there, and waits again when it goes on."""

import subprocess
import sys
from collections import Counter
from collections.abc import Callable
from pathlib import Path

from tests import fork_server
from thermostand.recording.reading.session import Session

PROMPTED = """
name: prompted
experiments:
  - warm_up: {table_position: {linear: 0, rotary: 0}, frames: 2, cool_down_max_s: 10, rolls_deg: [20]}
"""
STAND = [sys.executable, "-m", "thermostand.stand.cli"]


def attended(*arguments: object) -> subprocess.Popen[str]:
    command = [*STAND, *map(str, arguments), "--attended"]
    return fork_server.popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def asked(daemon: subprocess.Popen[str]) -> None:
    """Return when the daemon has said what the operator has to do."""
    assert daemon.stderr is not None
    lines = list[str]()
    for line in daemon.stderr:
        lines.append(line)
        if "roll the camera" in line:
            return
    raise AssertionError(f"nobody was asked: {lines}")


def test_an_attended_run_waits_at_its_prompt_also_when_it_is_resumed(tmp_path: Path, config_text: Callable[..., str]):
    config, recipe, out = tmp_path / "stand.yaml", tmp_path / "recipe.yaml", tmp_path / "out"
    config.write_text(config_text())
    recipe.write_text(PROMPTED)
    with attended("run", recipe, "--config", config, "--out", out, "--virtual-time") as daemon:
        asked(daemon)
        daemon.kill()
    (directory,) = out.iterdir()
    with attended("resume", directory) as daemon:
        asked(daemon)
        continued = [*STAND, "continue", str(directory)]
        while fork_server.run(continued, capture_output=True, timeout=30).returncode:
            assert daemon.poll() is None  # its socket comes with its first step
        assert daemon.wait(60) == 0
    session = Session.open(directory)
    counted = Counter(event.kind for event in session.events())
    assert (counted["prompt_skipped"], counted["released"]) == (0, 1)
    assert session.frame_count == 2
