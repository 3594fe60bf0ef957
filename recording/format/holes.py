"""What of a recorded session is not there, as stretches of its two series."""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import asdict, dataclass, replace
from typing import cast

from thermostand.recording.format.layout import FRAMES, TELEMETRY
from thermostand.recording.format.utc_offsets import UtcOffsets

_WHAT = {TELEMETRY: "", FRAMES: "of steps that are done"}
_NUMBERS = (int, type(None))


@dataclass(frozen=True, slots=True)
class Hole:
    """A stretch of a series that is not there.

    first, last: numbers of the segments that are missing; both None when only frames, or their descriptions, are, and
    last alone when their number is unknown. begin_ns, end_ns: the recorded data end and begin again at these
    instants, None at the begin and the end of the session. frames: how many are not there. excused: frames that the
    recorder itself reported as lost: such a stretch makes no session incomplete.
    """

    series: str
    first: int | None
    last: int | None
    begin_ns: int | None
    end_ns: int | None
    frames: int = 0
    excused: bool = False

    def covers(self, time_ns: int) -> bool:
        """Return whether something of that instant would have been in it."""
        return (self.begin_ns is None or self.begin_ns < time_ns) and (self.end_ns is None or time_ns < self.end_ns)

    def clip(self, begin_ns: int, end_ns: int) -> Hole | None:
        """Return what of it lies in [begin_ns, end_ns), None when nothing does; how many frames that are is known of
        all."""
        first_ns = begin_ns - 1 if self.begin_ns is None else max(self.begin_ns, begin_ns - 1)
        last_ns = end_ns if self.end_ns is None else min(self.end_ns, end_ns)
        if last_ns - first_ns <= 1:
            return None
        is_whole = (first_ns, last_ns) == (self.begin_ns, self.end_ns)
        return replace(self, begin_ns=first_ns, end_ns=last_ns, frames=self.frames if is_whole else 0)

    def format_time(self, utc: UtcOffsets) -> str:
        """`from 2026-01-01 18:00:00 to 2026-01-01 18:10:00 CET`, "" when nothing is known of it."""
        if self.end_ns is None:
            return "" if self.begin_ns is None else f"from {utc.local_text(self.begin_ns)}"
        begin = "" if self.begin_ns is None else f"from {utc.date_time(self.begin_ns)} "
        return f"{begin}to {utc.local_text(self.end_ns)}"

    def text(self, utc: UtcOffsets) -> str:
        """The hole as a part of a sentence: which segments, when, and how many frames."""
        frames = "" if not self.frames else f"{self.frames} frame{'' if self.frames == 1 else 's'} {_WHAT[self.series]}"
        if self.first is None:
            return ", ".join(part for part in (frames, self.format_time(utc)) if part)
        behind = ", ".join(part for part in (self.format_time(utc), frames) if part)
        return f"{format_segments(self.series, self.first, self.last)}{f' ({behind})' if behind else ''}"


def format_segments(series: str, first: int, last: int | None) -> str:
    """`telemetry/0003.mcap to 0012.mcap`."""
    name = f"{series}/{first:04d}.mcap"
    if last is None:
        return f"{name} and what follows it"
    return name if last == first else f"{name} to {last:04d}.mcap"


def format_holes(holes: Iterable[Hole]) -> str:
    """Write the holes for the session record of a copy; "" when it has none."""
    entries = [asdict(hole) for hole in holes]
    return json.dumps(entries, separators=(",", ":")) if entries else ""


def parse_holes(text: str) -> tuple[Hole, ...]:
    """The inverse; what is not understood of a text is left out."""
    try:
        found: object = json.loads(text) if text else []
    except (ValueError, RecursionError):
        return ()
    entries = cast("list[object]", found) if isinstance(found, list) else []
    return tuple(hole for entry in entries if (hole := _parse_hole(entry)) is not None)


def _parse_hole(entry: object) -> Hole | None:
    if not isinstance(entry, dict):
        return None
    fields = cast("dict[str, object]", entry)
    numbers = [fields.get(name) for name in ("first", "last", "begin_ns", "end_ns", "frames")]
    series, excused = fields.get("series"), fields.get("excused")
    if series not in _WHAT or not isinstance(excused, bool) or not all(isinstance(n, _NUMBERS) for n in numbers):
        return None
    first, last, begin_ns, end_ns, frames = cast("list[int | None]", numbers)
    return Hole(
        series=cast("str", series),
        first=first,
        last=last,
        begin_ns=begin_ns,
        end_ns=end_ns,
        frames=frames or 0,
        excused=excused,
    )
