"""Dwells that end when the camera has settled, over every wire in virtual time."""

from collections.abc import Callable
from pathlib import Path

import pytest

from tests.journals import read_lines
from tests.system.conftest import WHOLE_SENSOR
from thermostand.compensation.observations import Observations, observe
from thermostand.experiments.steps import Role
from thermostand.foundation.clock import NS_PER_S
from thermostand.foundation.items import StepState
from thermostand.foundation.progress import progress
from thermostand.recording.reading.session import Session
from thermostand.stand.running.memory.entries import Soaked
from thermostand.stand.running.order import Order
from thermostand.stand.service.run import run_virtual

RECIPE = """
name: settled
experiments:
  - thermal_cycle:
      table_position: {linear: 0, rotary: 0}
      equilibrium_s: 600
      set_points_degC: [28]
      soak_s: 3600
      until: {settled: {drift_px_per_min: 0.004}}
      reference_frames: 2
      frames_per_point: 1
"""
# A chamber that is never at its set-point, as far as these thresholds can tell, and a target that is not there.
NEVER = RECIPE.replace("drift_px_per_min: 0.004", "drift_px_per_min: 0.0001").replace("[28]", "[26]")
NEVER = NEVER.replace("soak_s: 3600", "soak_s: 900")


pytestmark = pytest.mark.usefixtures("compiled_fit")


async def test_a_dwell_ends_when_the_camera_has_settled_and_says_why(tmp_path: Path, order: Callable[..., Order]):
    session = Session.open(await run_virtual(order(RECIPE, camera=WHOLE_SENSOR), tmp_path, 3, lambda _: None))
    reported = [event.text for event in session.events() if event.kind == "settled"]
    assert len(reported) == 1
    assert all("K/min" in text and "mpx/min" in text for text in reported)
    soaks = [mark for mark in session.steps() if mark.kind == "soak_until_settled"]
    assert [mark.state for mark in soaks] == [StepState.STARTED, StepState.DONE]
    begin, end = soaks
    soak_s = (end.time_ns - begin.time_ns) / NS_PER_S
    assert 900.0 < soak_s < 2700.0
    entries, _ = read_lines((session.path / "journal.jsonl").read_bytes())
    dwells = [entry for entry in entries if isinstance(entry, Soaked) and entry.step_id == begin.step_id]
    soaked_s = [entry.soaked_s for entry in dwells]
    assert len(soaked_s) >= soak_s / 70.0  # each 60 s, a look included
    assert soaked_s == sorted(soaked_s)
    assert [entry.ended for entry in dwells if entry.ended] == [dwells[-1].ended] == ["settled"]  # nothing is owed
    check_the_flap_opens_for_looks_only(session)
    check_looks_are_not_fitted(observe([session.path], progress))


def check_the_flap_opens_for_looks_only(session: Session) -> None:
    _, position = session.readings("flap.position")
    assert 0.0 < (position > 0.5).mean() < 0.15
    assert not [event for event in session.events() if event.level == "error"]


def check_looks_are_not_fitted(observed: Observations) -> None:
    assert observed.of(Role.SETTLING).sum() > 5
    assert observed.of(Role.REFERENCE).sum() == 2
    assert observed.of(Role.FIT).sum() == 1
    assert set(observed.chamber_degC[observed.of(Role.SETTLING)]) == {28.0}


async def test_a_dwell_that_never_settles_ends_at_its_longest_and_says_so(tmp_path: Path, order: Callable[..., Order]):
    session = Session.open(await run_virtual(order(NEVER), tmp_path, 3, lambda _: None))
    reported = [event for event in session.events() if event.kind in ("settled", "not_settled")]
    assert [(event.kind, event.level) for event in reported] == [("not_settled", "warning")]
    assert reported[0].text.startswith("not settled after 15 min: ")
    begin, end = (mark for mark in session.steps() if mark.kind == "soak_until_settled")
    assert 900.0 <= (end.time_ns - begin.time_ns) / NS_PER_S < 915.0
