"""How the run of a session ended: the one word that lists, reports and programs use, by the recording and its journal;
and of a part that was cut out of a session, which range, and how the run of the whole ended."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from enum import StrEnum

from thermostand.foundation.events import RUN_BEGINS, RUN_END
from thermostand.foundation.items import Event
from thermostand.foundation.json_values import parse_json_object
from thermostand.recording.format.journal_lines import JournalFacts
from thermostand.recording.format.utc_offsets import UtcOffsets


class RunOutcome(StrEnum):
    """complete: the plan is done. stopped: by its operator. tripped: the guard ended it. failed: an error did.
    interrupted: killed, or without any end. running: it is being recorded now."""

    COMPLETE = "complete"
    STOPPED = "stopped"
    TRIPPED = "tripped"
    FAILED = "failed"
    INTERRUPTED = "interrupted"
    RUNNING = "running"


class Files(StrEnum):
    """sound: everything that was acknowledged is there and as it was written. incomplete: something of it is missing.
    damaged: something is not as it was written. changed: another program has written other content. unknown: by another
    version, whose format this one does not know."""

    SOUND = "sound"
    INCOMPLETE = "incomplete"
    DAMAGED = "damaged"
    CHANGED = "changed"
    UNKNOWN = "unknown"


def find_last_run_event(events: Iterable[Event]) -> Event | None:
    """The last event of a run's beginning or end; None when none is recorded."""
    marks = [event for event in events if event.kind in (*RUN_BEGINS, RUN_END)]
    return max(marks, key=lambda event: event.time_ns, default=None)


def determine_run_outcome(
    events: Iterable[Event], journal: JournalFacts | None, *, is_recording: bool = False
) -> RunOutcome:
    """Decide by the recording or by its journal, whichever has the later entry."""
    if is_recording:
        return RunOutcome.RUNNING
    last = find_last_run_event(events)
    ended_ns = -1 if last is None else last.time_ns
    if journal is not None and (journal.last_ns > ended_ns or (journal.status and journal.last_ns == ended_ns)):
        return parse_run_outcome(journal.status)
    if last is None or last.kind != RUN_END:
        return RunOutcome.INTERRUPTED
    return parse_run_outcome(str(last.data.get("status")))


def parse_run_outcome(status: str) -> RunOutcome:
    """The word, interrupted for what is none."""
    return RunOutcome(status) if status in set(RunOutcome) - {RunOutcome.RUNNING} else RunOutcome.INTERRUPTED


@dataclass(frozen=True, slots=True)
class Extent:
    """What was recorded in [begin_ns, end_ns) of the session of that id. run: how its run had ended by the
    session's record when the part was made."""

    session_id: str
    begin_ns: int
    end_ns: int
    run: RunOutcome

    def text(self, utc: UtcOffsets) -> str:
        """Describe the extent in a sentence."""
        span = f"{utc.date_time(self.begin_ns)} to {utc.local_text(self.end_ns)}"
        return f"a part of the session {self.session_id}: {span}; the run's journal and its other part are not in it"

    def record(self) -> str:
        """Return it as text for the session record of the part."""
        return json.dumps({**asdict(self), "run": str(self.run)}, separators=(",", ":"))


def parse_extent(session: Mapping[str, str]) -> Extent | None:
    """Read the extent from a session's record; None for what is no part, or where it is not understood."""
    fields = parse_json_object(session.get("extent", ""))
    if fields is None:
        return None
    begin_ns, end_ns = fields.get("begin_ns"), fields.get("end_ns")
    if not isinstance(begin_ns, int) or not isinstance(end_ns, int):
        return None
    return Extent(str(fields.get("session_id", "")), begin_ns, end_ns, parse_run_outcome(str(fields.get("run"))))
