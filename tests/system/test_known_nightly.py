"""A thermal cycle that decides, over every wire in virtual time: the drift model is fitted in its own process from what
the session has recorded so far."""

from collections.abc import Callable
from pathlib import Path

import pytest

from tests.journals import read_lines
from tests.system.conftest import WHOLE_SENSOR
from thermostand.experiments.adaptive import Visit
from thermostand.experiments.steps import Capture, Decide
from thermostand.foundation.clock import WallClock
from thermostand.recording.reading.session import Session
from thermostand.stand.running.executing.decisions import Decider
from thermostand.stand.running.memory.entries import Edited
from thermostand.stand.running.order import Order
from thermostand.stand.running.session_report import DECIDES
from thermostand.stand.service.run import run_virtual

pytestmark = pytest.mark.nightly

RECIPE = """
name: known
experiments:
  - thermal_cycle:
      table_position: {linear: 0, rotary: 0}
      equilibrium_s: 900
      set_points_degC: [28, 34, 28, 20, 14, 20, 24]
      held_out_degC: [28]
      soak_s: 1200
      until: {known: {residual_px: 0.001, soaks_s: [600, 900], wait_s: 3600}}
      reference_frames: 3
      frames_per_point: 1
"""


async def test_a_session_decides_from_what_it_has_recorded_and_the_same_from_the_same(
    tmp_path: Path, order: Callable[..., Order]
):
    """The first visits go where nothing is known yet, and later ones by the fitted model; it is never content."""
    given = order(RECIPE, camera=WHOLE_SENSOR)
    session = Session.open(await run_virtual(given, tmp_path, 3, lambda _: None))
    entries, _ = read_lines((session.path / "journal.jsonl").read_bytes())
    decisions = [entry for entry in entries if isinstance(entry, Edited)]
    assert not [event.text for event in session.events() if event.kind == "undecided"]
    visited = [mark.parameters["chamber_degC"] for mark in session.steps() if mark.kind == Capture.kind]
    assert {14.0, 34.0} < set(visited)
    by_model = [each.reason.startswith("the residual is predicted") for each in decisions]
    assert not by_model[0]
    assert sum(by_model) > 1
    decide = next(planned.step for planned in given.recipe.plan() if isinstance(planned.step, Decide))
    decider = Decider(session.path, WallClock(), DECIDES)
    first, second = await decider.decide(decide), await decider.decide(decide)
    assert isinstance(first.answer, Visit)
    assert first == second
