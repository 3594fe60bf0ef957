"""A queue of real runs in virtual time: one goes through, one is killed, resumed and completed by the next start."""

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

from stand import queue
from stand.hub import StepState
from stand.recording.session import Session
from tests.system.conftest import require_aravis

RECIPE = """
name: queued
experiments:
  - thermal_cycle:
      equilibrium_s: 300
      set_points_degC: [26]
      held_out_degC: []
      dwell_s: 300
      reference_frames: 1
      frames_per_point: 3
      interval_s: 1
"""

STARTED = """
import os, signal, sys
from pathlib import Path
from stand import queue, queue_run
from stand.hub import StepMark
from stand.queue_cli import app

class KilledAtTheCapture(queue_run.Follow):
    def __call__(self, item):
        super().__call__(item)
        if isinstance(item, StepMark) and item.kind == "OpenFlap":
            os.kill(os.getpid(), signal.SIGKILL)

if "kill" in sys.argv[2:]:
    queue_run.Follow = KilledAtTheCapture
app(["start", "--virtual-time", "--out", sys.argv[1]])
"""


def start(directory: Path, *how: str) -> "subprocess.CompletedProcess[str]":
    command = [sys.executable, "-c", STARTED, str(directory), *how]
    return subprocess.run(command, capture_output=True, text=True, check=False, timeout=60)


def test_a_killed_queue_goes_on_where_it_was_and_comes_to_its_end(tmp_path: Path, config_text: Callable[..., str]):
    require_aravis()
    config, recipe, out = tmp_path / "stand.yaml", tmp_path / "recipe.yaml", tmp_path / "sessions"
    config.write_text(config_text())
    recipe.write_text(RECIPE)
    for name in ("queued", "second"):
        recipe.write_text(RECIPE.replace("name: queued", f"name: {name}"))
        queue.add(out, queue.load_order(str(recipe), str(config)), str(config), 1)
    recipe.write_text("this is no recipe any more")

    killed = start(out, "kill")
    assert killed.returncode == -9, killed.stderr
    first, second = queue.queued(out).entries
    assert (first.state, second.state) == ("interrupted", "waiting")
    assert first.session.endswith("-queued")

    ended = start(out)
    assert ended.returncode == 0, ended.stderr
    assert f"run 1 (queued) goes on in {first.session}" in ended.stderr
    entries = queue.queued(out).entries
    assert [(entry.state, entry.reason) for entry in entries] == [("done", ""), ("done", "")]
    for entry in entries:
        session = Session.open(out / entry.session)
        assert session.incomplete == ()
        assert session.frame_count == 5
        done = [step.step_id for step in session.steps() if step.state is StepState.DONE and step.kind == "Capture"]
        assert len(done) == len(set(done)) == 3
