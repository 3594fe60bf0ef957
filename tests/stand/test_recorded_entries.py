"""What only the recording proves is put between the entries of a journal, each once; and what a run writes in it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from tests.journals import read_lines
from tests.stand.test_run_table import CAPTURE, ID, PLAN, WARM
from thermostand.foundation.clock import VirtualClock, WallClock
from thermostand.foundation.errors import SessionError
from thermostand.foundation.events import PLAN_CHANGED
from thermostand.foundation.hub import Hub
from thermostand.foundation.items import Event, StepMark, StepState
from thermostand.foundation.shutdown_deadline import ShutdownDeadline
from thermostand.recording.format.capture_restarts import make_restart_event
from thermostand.stand.running.memory.entries import (
    Begun,
    Ended,
    Entry,
    Held,
    Reset,
    Restarted,
    Skipped,
    StepChanged,
    Taken,
    Tripped,
    make_change_data,
)
from thermostand.stand.running.memory.fold import fold
from thermostand.stand.running.memory.journal import JOURNAL_NAME, Journal, Logbook
from thermostand.stand.running.resume import Interruption, merge_recorded
from thermostand.stand.safety.fault import Fault
from thermostand.stand.safety.gate import INTERLOCK, OPERATOR, STOPPING

BEGUN = Begun(1, "cycle-1", "0f", {})


def mark(time_ns: int, step_id: str, state: StepState) -> StepMark:
    return StepMark(time_ns, step_id, 0, "capture", state)


def plan_changed(change: Skipped) -> Event:
    return Event(change.time_ns, "warning", PLAN_CHANGED, "left out", make_change_data(change))


def test_a_step_is_done_when_its_end_is_recorded_and_not_when_it_was_begun_or_failed():
    started = StepChanged(2, CAPTURE, "started")
    items = [mark(2, CAPTURE, StepState.STARTED), mark(5, WARM, StepState.FAILED), mark(4, CAPTURE, StepState.DONE)]
    frames = [(3, CAPTURE)]
    assert merge_recorded([BEGUN, started], items, frames) == [
        BEGUN,
        started,
        Taken(3, CAPTURE),
        StepChanged(4, CAPTURE, "done"),
    ]


def test_a_capture_that_was_begun_again_and_a_change_of_the_plan_count_once_be_they_in_the_journal_or_not():
    again, skipped = Restarted(5, [CAPTURE], 2), Skipped(7, WARM)
    items = [
        make_restart_event(5, CAPTURE, 3, "", 2),
        plan_changed(skipped),
        Event(8, "info", "note", "x", make_change_data(skipped)),
    ]
    whole: list[Entry] = [BEGUN, again, skipped]
    assert merge_recorded([BEGUN], items, []) == whole
    assert merge_recorded([BEGUN, again], items, []) == whole
    assert merge_recorded([BEGUN, skipped], items, []) == whole
    assert merge_recorded([BEGUN, again, skipped], items, []) == whole
    other = Restarted(5, [WARM])
    assert merge_recorded([BEGUN, other], items[:1], []) == [BEGUN, other, again]


def test_of_an_instant_in_which_a_capture_is_begun_again_its_end_before_does_not_count_but_its_frame():
    again = Restarted(5, [CAPTURE])
    items = [mark(5, CAPTURE, StepState.DONE)]
    assert merge_recorded([BEGUN, again], items, [(5, CAPTURE)]) == [
        BEGUN,
        StepChanged(5, CAPTURE, "done"),
        again,
        Taken(5, CAPTURE),
    ]


def test_a_run_that_is_not_resumed_after_all_is_left_to_others(tmp_path: Path):
    Journal.create(tmp_path).release()
    journal, _ = Journal.open(tmp_path)
    nothing: Any = None
    before = Interruption(tmp_path, nothing, nothing, journal, fold(PLAN, []), 0, None, (), nothing)
    with pytest.raises(SessionError, match="is running this session"):
        Journal.open(tmp_path)
    before.release()
    before.release()
    Journal.open(tmp_path)[0].release()


async def test_what_holds_a_run_is_reported_journaled_and_folded_but_for_its_end(tmp_path: Path):
    hub, clock, events = Hub(), VirtualClock(5), list[Event]()
    hub.subscribe(lambda item: events.append(item) if isinstance(item, Event) else None)
    logbook, journal = Logbook(hub, clock, fold(PLAN, [])), Journal.create(tmp_path)
    logbook.tripped(Fault("early", "before the run"))
    assert logbook.state.tripped == "before the run"
    logbook.enter(Reset(5))
    await logbook.begin(journal, BEGUN)
    for reason, held in ((OPERATOR, True), (STOPPING, True), (INTERLOCK, True), (OPERATOR, False), (INTERLOCK, False)):
        logbook.note_hold(reason, held)
    logbook.tripped(Fault("air_hot", "too hot"))
    assert [(event.kind, event.data["reason"]) for event in events] == [
        ("held", OPERATOR),
        ("held", INTERLOCK),
        ("released", OPERATOR),
        ("released", INTERLOCK),
    ]
    assert (logbook.state.reasons, logbook.state.tripped) == (frozenset(), "too hot")
    await journal.close()
    assert read_lines((tmp_path / JOURNAL_NAME).read_bytes())[0] == [
        BEGUN,
        Held(5, OPERATOR, True),
        Held(5, INTERLOCK, True),
        Held(5, OPERATOR, False),
        Reset(5),
        Held(5, INTERLOCK, False),
        Tripped(5, "air_hot", "too hot"),
    ]


async def test_the_end_of_a_run_is_the_last_entry_of_its_journal_which_nobody_has_then(tmp_path: Path):
    logbook = Logbook(Hub(), WallClock(), fold(PLAN, []))
    await logbook.end(Ended(1, "stopped", ""), ShutdownDeadline())  # nothing was begun
    await logbook.begin(Journal.create(tmp_path), BEGUN)
    await logbook.write(StepChanged(2, ID[0], "started"))
    await logbook.end(Ended(3, "stopped", "by the operator"), ShutdownDeadline())
    journal, entries = Journal.open(tmp_path)
    journal.release()
    assert entries[:2] == [BEGUN, StepChanged(2, ID[0], "started")]
    (ended,) = entries[2:]
    assert isinstance(ended, Ended)
    assert (ended.status, ended.text) == ("stopped", "by the operator")
    assert ended.time_ns > 3
    assert logbook.state.ended == ended
