"""Which instants of a session its segments cover, and so what it means that something of an instant is not there."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from math import inf

from thermostand.foundation.clock import NS_PER_S
from thermostand.foundation.events import RUN_BEGINS, RUN_END
from thermostand.foundation.items import Event
from thermostand.recording.format.chain import Link
from thermostand.recording.format.holes import Hole
from thermostand.recording.format.inventory import SegmentFile, State
from thermostand.recording.format.layout import TELEMETRY
from thermostand.recording.reading.journal_lines import JournalFacts

# Between the middle of a frame's exposure and its description being on the disk, or the frame itself.
TORN_NS = 5 * NS_PER_S


@dataclass(frozen=True, slots=True)
class Coverage:
    """links: the finished segments that were read, by their names, in order. begins_ns: when the run began or resumed.
    is_ended: whether the end of a run is recorded. holes: those that the session's own record lists, as a copy of an
    incomplete session does."""

    files: Sequence[SegmentFile]
    links: dict[str, Link]
    begins_ns: tuple[int, ...]
    is_ended: bool
    holes: tuple[Hole, ...]

    def is_reported(self, series: str, time_ns: int) -> bool:
        """Whether the session's own record says that the series lacks that instant."""
        return any(hole.series == series and hole.covers(time_ns) for hole in self.holes)

    def is_torn_at(self, series: str, time_ns: int) -> bool:
        """The series lost what it held of that instant because the recorder was killed: it lies behind the end of a
        salvaged segment and before the next one, or right behind the last segment of a run without an end."""
        links = self._of(series)
        late_ns = late_by_ns(series)
        for index, link in enumerate(links):
            following = links[index + 1] if index + 1 < len(links) else None
            end_ns = inf if following is None else following.first_ns
            if link.salvaged and (following is None or following.number == link.number + 1):
                resumed_ns = min((begin for begin in self.begins_ns if begin > link.last_ns), default=inf)
                torn_ns = min(end_ns, resumed_ns)
            elif link.salvaged or (following is None and not self.is_ended):
                torn_ns = link.last_ns + TORN_NS
            else:
                continue
            if link.last_ns - late_ns < time_ns < torn_ns:
                return True
        return False

    def unread(self, series: str) -> list[tuple[float, float]]:
        """Between which instants the series is in segments that were not read: from the end of one that was to
        the begin of the next. A recorder at work may be about to write what comes behind the last one."""
        stretches: list[tuple[float, float]] = []
        begin_ns, is_open, number = -inf, False, -1
        for file in self.files:
            link = self.links.get(file.name)
            if file.series != series or (link is None and file.number == number):
                continue  # what was left beside a finished segment of the same number counts for nothing
            if link is None:
                is_open |= file.state is not State.DAMAGED
                continue
            number = file.number
            if link.count:
                stretches += [(begin_ns, link.first_ns)] if is_open else []
                begin_ns, is_open = link.last_ns - late_by_ns(series), False
        if is_open or any(file.state is State.RECORDING for file in self.files):
            stretches.append((begin_ns, inf))
        return stretches

    def _of(self, series: str) -> list[Link]:
        return [link for link in self.links.values() if link.series == series]


def late_by_ns(series: str) -> int:
    """How long before the end of a segment something may have been that is in the next one."""
    return TORN_NS if series == TELEMETRY else 0  # a description is written after what happened meanwhile


def coverage_of(
    files: Sequence[SegmentFile],
    links: dict[str, Link],
    events: Iterable[Event],
    holes: tuple[Hole, ...],
    journal: JournalFacts | None,
) -> Coverage:
    """From the session's files and what its events and its journal say of the run."""
    kinds = [(event.kind, event.time_ns) for event in events if event.kind in (*RUN_BEGINS, RUN_END)]
    begins_ns = tuple(time_ns for kind, time_ns in kinds if kind in RUN_BEGINS)
    is_ended = any(kind == RUN_END for kind, _ in kinds) or (journal is not None and bool(journal.status))
    return Coverage(files, links, begins_ns, is_ended, holes)
