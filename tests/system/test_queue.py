"""A queue of real runs in virtual time: one goes through, one is killed, resumed and completed by the next start."""

import json
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

from tests import forked
from tests.system.conftest import require_aravis
from thermostand.experiments.steps import Capture
from thermostand.foundation.items import StepState
from thermostand.recording.reading.session import Session
from thermostand.stand.estimating.learned import load_learned
from thermostand.stand.queueing import queue
from thermostand.stand.queueing.queue_work import MOST_FRUITLESS_STARTS
from thermostand.stand.running.order import load_order

RECIPE = """
name: queued
experiments:
  - thermal_cycle:
      equilibrium_s: 120
      set_points_degC: [26]
      held_out_degC: []
      dwell_s: 120
      reference_frames: 1
      frames_per_point: 3
      interval_s: 1
"""

COMMAND = [
    sys.executable,
    "-m",
    "thermostand.stand.cli",
    "queue",
    "start",
    "--virtual-time",
    "--out",
]


def kill_under_way(directory: Path) -> None:
    """Start the queue and kill it when its first run tells that at least a third of it is done."""
    with forked.popen([*COMMAND, str(directory)], stderr=subprocess.PIPE, text=True) as daemon:
        assert daemon.stderr is not None
        shares = (int(line[4:].split("%")[0]) for line in daemon.stderr if line.startswith("run:"))
        assert any(share >= 33 for share in shares)
        daemon.kill()
    assert daemon.returncode == -signal.SIGKILL


def kill_at_once(directory: Path) -> None:
    """Start the queue and kill it when it has reported that its run goes on."""
    with forked.popen([*COMMAND, str(directory)], stderr=subprocess.PIPE, text=True) as daemon:
        assert daemon.stderr is not None
        assert "is resumed in" in daemon.stderr.readline()
        daemon.kill()


def test_a_killed_queue_goes_on_where_it_was_and_comes_to_its_end(tmp_path: Path, config_text: Callable[..., str]):
    require_aravis()
    config, recipe, out = tmp_path / "stand.yaml", tmp_path / "recipe.yaml", tmp_path / "sessions"
    config.write_text(config_text())
    recipe.write_text(RECIPE)
    for name in ("queued", "second"):
        recipe.write_text(RECIPE.replace("name: queued", f"name: {name}"))
        queue.add(out, load_order(str(recipe), str(config)), str(config), 1)
    recipe.write_text("this is no recipe any more")

    kill_under_way(out)
    first, second = queue.queued(out).entries
    assert (first.state, second.state) == ("interrupted", "waiting")
    assert first.session.endswith("-queued")

    ended = forked.run([*COMMAND, str(out), "--report", "--json"], capture_output=True, text=True, timeout=300)
    assert ended.returncode == 0, ended.stderr
    assert f"run 1 (queued) is resumed in {first.session}" in ended.stderr
    entries = queue.queued(out).entries
    assert [(entry.state, entry.reason) for entry in entries] == [("done", ""), ("done", "")]
    assert [run["session"] for run in json.loads(ended.stdout)["runs"]] == [entry.session for entry in entries]
    for entry in entries:
        session, plan = Session.open(out / entry.session), queue.order_of(entry).recipe.plan()
        assert session.incomplete == ()
        captures = {planned.step_id: planned.step.frames for planned in plan if isinstance(planned.step, Capture)}
        assert session.frame_count == sum(captures.values()) == 4
        done = [step.step_id for step in session.steps() if step.state is StepState.DONE and step.kind == "capture"]
        assert sorted(done) == sorted(captures)
        # One temperature is too few for a fit, which is no reason for a run to fail.
        assert f"{out / entry.session} is recorded, but not reported" in ended.stderr
    assert load_learned(out).nights == tuple(sorted(entry.session for entry in entries))


def test_a_run_that_dies_whenever_it_goes_on_makes_way_for_the_next(tmp_path: Path, config_text: Callable[..., str]):
    require_aravis()
    config, recipe, out = tmp_path / "stand.yaml", tmp_path / "recipe.yaml", tmp_path / "sessions"
    config.write_text(config_text())
    for name in ("queued", "second"):
        recipe.write_text(RECIPE.replace("name: queued", f"name: {name}"))
        queue.add(out, load_order(str(recipe), str(config)), str(config), 1)

    kill_under_way(out)
    for _ in range(MOST_FRUITLESS_STARTS):
        kill_at_once(out)
    ended = forked.run([*COMMAND, str(out)], capture_output=True, text=True, timeout=300)
    assert ended.returncode == 0, ended.stderr
    first, second = queue.queued(out).entries
    assert (first.state, second.state) == ("failed", "done")
    assert first.reason.startswith("its daemon was killed 3 times in a row before one more step was done")
    assert Session.open(out / second.session).frame_count == 4
    resumed = [sys.executable, "-m", "thermostand.stand.cli", "resume", str(out / first.session)]
    assert forked.run(resumed, capture_output=True, timeout=300).returncode == 0
    assert Session.open(out / first.session).frame_count == 4
