"""Guaranteed soaks: one ends when its time is over and the chamber was in its band at last; else it goes on, and at its
longest the frames after it are marked, or the run is held. Over every wire, in virtual time."""

import os
import signal
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from tests.system.conftest import WHOLE_SENSOR
from tests.system.test_step_faults import Operator, run_with
from thermostand.compensation.observations import observe
from thermostand.foundation.events import SOAK_LONGER
from thermostand.foundation.hub import Hub
from thermostand.foundation.items import Event, Item, StepMark, StepState
from thermostand.foundation.readings import UNSETTLED
from thermostand.recording.reading.session import Session
from thermostand.stand.running.order import Order
from thermostand.stand.running.resume import load_interruption
from thermostand.stand.service.run import Interrupted, resume, run_virtual

RECIPE = """
name: soaked
steps:
  - close_flap
  - start_chamber: 24
  - soak: 60
  - open_flap
  - capture: {frames: 1, role: reference}
  - close_flap
  - set_temperature: 34
  - soak: %s
  - open_flap
  - capture: {frames: 1, role: fit}
  - close_flap
  - stop_chamber
"""
BAND_K = 1.0


def unwatched(hub: Hub) -> None:
    """Nobody looks."""


def events_of(session: Session, kind: str) -> list[Event]:
    return [event for event in session.events() if event.kind == kind]


def last_soak_ns(session: Session) -> tuple[int, int]:
    """Of the soak at 34 degC: when it began and ended for good."""
    marks = [item for item in session.items() if isinstance(item, StepMark) and item.kind == "soak" and item.index == 7]
    return marks[0].time_ns, next(mark.time_ns for mark in reversed(marks) if mark.state is StepState.DONE)


def off_K(session: Session, begin_ns: int, end_ns: int) -> float:
    """How far the chamber was from 34 degC at the most, as it was recorded between these instants."""
    times_ns, pv_degC = session.readings("regulator.pv")
    within = (times_ns >= begin_ns) & (times_ns <= end_ns)
    return float(abs(pv_degC[within] - 34.0).max())


async def test_a_soak_goes_on_until_the_chamber_was_in_its_band_for_the_last_third(
    tmp_path: Path, order: Callable[..., Order]
):
    session = Session.open(await run_virtual(order(RECIPE % "330"), tmp_path / "out", None, unwatched))
    begin_ns, end_ns = last_soak_ns(session)
    assert 331e9 < end_ns - begin_ns < 660e9
    assert off_K(session, end_ns - 110_000_000_000, end_ns) <= BAND_K
    assert off_K(session, end_ns - 125_000_000_000, end_ns) > BAND_K  # it did not wait for longer than that
    longer = events_of(session, "soak_longer")
    assert sum(float(str(event.data["by_s"])) for event in longer) == pytest.approx(
        (end_ns - begin_ns) / 1e9 - 330.0, abs=2.0
    )
    assert events_of(session, "soak_unsettled") == []
    assert [meta.flags for meta in session.frame_metas()] == [(), ()]


@pytest.mark.parametrize("soak", ["600", "{duration_s: 150, band_K: 0}"])
async def test_a_soak_in_a_good_chamber_and_one_without_a_band_take_their_time(
    tmp_path: Path, order: Callable[..., Order], soak: str
):
    session = Session.open(await run_virtual(order(RECIPE % soak), tmp_path / "out", None, unwatched))
    begin_ns, end_ns = last_soak_ns(session)
    assert (end_ns - begin_ns) / 1e9 == pytest.approx(600.0 if soak == "600" else 150.0, abs=1.0)
    assert events_of(session, "soak_longer") == []
    assert [meta.flags for meta in session.frame_metas()] == [(), ()]


async def test_after_its_longest_the_frames_are_marked_and_a_fit_leaves_them_out(
    tmp_path: Path, order: Callable[..., Order]
):
    path = await run_virtual(
        order(RECIPE % "{duration_s: 120, max_s: 150}", camera=WHOLE_SENSOR), tmp_path / "out", None, unwatched
    )
    session = Session.open(path)
    begin_ns, end_ns = last_soak_ns(session)
    assert (end_ns - begin_ns) / 1e9 == pytest.approx(150.0, abs=1.0)
    assert off_K(session, end_ns - 10_000_000_000, end_ns) > BAND_K
    assert [event.level for event in events_of(session, "soak_unsettled")] == ["warning"]
    assert [meta.flags for meta in session.frame_metas()] == [(), (UNSETTLED,)]
    assert list(observe(path).left_out.values()) == [1]


async def test_a_frame_is_marked_while_the_chamber_is_out_of_its_band(tmp_path: Path, order: Callable[..., Order]):
    """As after a soak too short for the chamber's overshoot; here the regulator reads wrong for a
    minute."""
    recipe = (RECIPE % "600").replace("{frames: 1, role: fit}", "{frames: 40, interval_s: 10, role: fit}")
    ordered = order(recipe, simulation={"faults": ["regulator.pv_offset_K=1.6@750:60"]})
    session = Session.open(await run_virtual(ordered, tmp_path / "out", None, unwatched))
    times_ns, pv_degC = session.readings("regulator.pv")
    marked = list[bool]()
    for meta in session.frame_metas()[1:]:
        off_K = abs(float(pv_degC[max(0, np.searchsorted(times_ns, meta.time_ns) - 1)]) - 34.0)
        if abs(off_K - BAND_K) > 0.25:  # what it moves between a poll and an exposure
            assert (meta.flags == (UNSETTLED,)) is (off_K > BAND_K)
            marked.append(off_K > BAND_K)
    assert 2 <= marked.count(True) <= 30 <= len(marked)
    assert events_of(session, "soak_unsettled") == []
    assert 1 <= len(events_of(session, "frame_unsettled")) <= 6


async def test_a_run_that_is_interrupted_while_a_soak_goes_on_ends_it_in_the_band_all_the_same(
    tmp_path: Path, order: Callable[..., Order]
):
    def stop(item: Item) -> None:
        if isinstance(item, Event) and item.kind == SOAK_LONGER:
            os.kill(os.getpid(), signal.SIGINT)

    with pytest.raises(Interrupted):
        await run_virtual(order(RECIPE % "330"), tmp_path / "out", None, lambda hub: hub.subscribe(stop))
    (directory,) = (tmp_path / "out").iterdir()
    session = Session.open(await resume(load_interruption(directory), unwatched))
    _, end_ns = last_soak_ns(session)
    assert off_K(session, end_ns - 110_000_000_000, end_ns) <= BAND_K
    assert [meta.flags for meta in session.frame_metas()] == [(), ()]


async def test_a_soak_that_may_not_end_unsettled_holds_the_run_and_begins_again_when_cleared(
    tmp_path: Path, order: Callable[..., Order]
):
    """Twice too short; the operator gives the chamber time before the third."""
    ordered, operator = order(RECIPE % "{duration_s: 240, max_s: 240, unsettled: hold}"), Operator(1.0)
    session = await run_with(ordered, tmp_path / "out", operator)
    assert {rule for rule, _ in operator.holds} == {"device_fault"}
    assert 1 <= len(operator.holds) <= 3
    _, end_ns = last_soak_ns(session)
    assert off_K(session, end_ns - 80_000_000_000, end_ns) <= BAND_K
    assert [meta.flags for meta in session.frame_metas()] == [(), ()]
