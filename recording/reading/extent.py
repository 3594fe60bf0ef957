"""Of a part that was cut out of a session: which range, and how the run of the whole ended."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass

from thermostand.foundation.json_values import json_object
from thermostand.recording.format.utc_offsets import UtcOffsets
from thermostand.recording.reading.run_word import Run, known_word


@dataclass(frozen=True, slots=True)
class Extent:
    """What was recorded in [begin_ns, end_ns) of the session of that id. run: how its run had ended by the
    session's record when the part was made."""

    session_id: str
    begin_ns: int
    end_ns: int
    run: Run

    def text(self, utc: UtcOffsets) -> str:
        """As a sentence."""
        span = f"{utc.date_time(self.begin_ns)} to {utc.local_text(self.end_ns)}"
        return f"a part of the session {self.session_id}: {span}; the run's journal and its other part are not in it"

    def record(self) -> str:
        """For the session record of the part."""
        return json.dumps({**asdict(self), "run": str(self.run)}, separators=(",", ":"))


def extent_of(session: Mapping[str, str]) -> Extent | None:
    """By a session's record; None for what is no part, or where it is not understood."""
    fields = json_object(session.get("extent", ""))
    if fields is None:
        return None
    begin_ns, end_ns = fields.get("begin_ns"), fields.get("end_ns")
    if not isinstance(begin_ns, int) or not isinstance(end_ns, int):
        return None
    return Extent(str(fields.get("session_id", "")), begin_ns, end_ns, known_word(str(fields.get("run"))))
