"""What a salvaged copy begins with: the segment's own opening and, where that is damaged, its siblings'.

Every segment of a session repeats the session's metadata and attachments, every segment of a series the schemas and
channels. A sibling is a segment of the same session directory that contradicts nothing that is known of the damaged
one: same session id, same attachments, same channels. Where no sibling helps, nothing is guessed.

Metadata has no CRC. So the record `session` is voted on: the one that most segments have is taken, a finished
segment's vote before the own and the own before an unfinished one's when they are equally many.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from mcap.records import Attachment, Channel, Schema

from thermostand.recording.format.inventory import State, inventory
from thermostand.recording.format.layout import FINISHED, FRAMES, TELEMETRY
from thermostand.recording.format.mcap_bytes import Source
from thermostand.recording.reading.walk import Survey, survey

_GREATEST = 999_999_999  # a number beyond is none that a recorder has given
SIBLINGS_PER_SERIES = 4  # enough for a vote, few enough for a night of hundreds
SESSION_ID = "session_id"


@dataclass(frozen=True, slots=True)
class Opening:
    """Metadata `session`, attachments by name, schemas and channels by number."""

    session: Mapping[str, str]
    attachments: Mapping[str, Attachment]
    schemas: Mapping[int, Schema]
    channels: Mapping[int, Channel]

    def knows(self, channel: int) -> bool:
        """Whether messages of that channel can be delivered."""
        return channel in self.channels and self.channels[channel].schema_id in self.schemas


@dataclass(frozen=True, slots=True)
class _Sibling:
    path: Path
    found: Survey


def opening_of(path: Path, own: Survey) -> Opening | None:
    """The opening for the segment at `path`, of which `own` proved itself; None when its session is not known."""
    siblings = [sibling for sibling in _siblings(path) if _agree(own, sibling.found)]
    session = _session(own, siblings)
    if session is None:
        return None
    attachments = dict(own.attachments)
    schemas, channels = own.schemas, own.channels
    if not own.is_opening_whole:
        for sibling in siblings:
            attachments = sibling.found.attachments | attachments
    if own.messages.keys() - own.channels.keys():
        schemas, channels = _tables(own, [sibling.found for sibling in siblings if sibling.path.parent == path.parent])
    return Opening(session, attachments, schemas, channels)


def segments_of(series: Path) -> list[Path]:
    """The finished and unfinished segments in a folder; none when there is no such folder."""
    files = (file for file in inventory(series.parent) if file.series == series.name)
    return [file.path for file in files if file.state is not State.DAMAGED and file.number <= _GREATEST]


def _siblings(path: Path) -> Iterator[_Sibling]:
    """The nearest other segments of the session, each read to its first chunk."""
    number = _number(path)
    for series in (path.parent.parent / TELEMETRY, path.parent.parent / FRAMES):
        segments = [other for other in segments_of(series) if other != path]
        segments.sort(key=lambda other: (abs(_number(other) - number), other.name))
        for other in segments[:SIBLINGS_PER_SERIES]:
            with suppress(OSError):  # what cannot be read does not help
                yield _Sibling(other, _read_opening(other))


def _number(path: Path) -> int:
    return int(path.name.partition(".")[0])


def _read_opening(path: Path) -> Survey:
    fd = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    try:
        return survey(Source(fd), to_first_chunk=True)
    finally:
        os.close(fd)


def _identity(session: Mapping[str, str]) -> tuple[str, str]:
    return session.get(SESSION_ID, ""), session.get("uid", "")


def _agree(one: Survey, other: Survey) -> bool:
    """Whether nothing that is known of both says that they are of different sessions."""
    if one.session and other.session and _identity(one.session) != _identity(other.session):
        return False
    both = one.attachments.keys() & other.attachments.keys()
    return all(one.attachments[name].data == other.attachments[name].data for name in both)


def _session(own: Survey, siblings: list[_Sibling]) -> Mapping[str, str] | None:
    """The session's metadata by vote; None when no segment has it, or the siblings are of several sessions."""
    finished = [sibling.found.session for sibling in siblings if sibling.path.name.endswith(FINISHED)]
    unfinished = [sibling.found.session for sibling in siblings if not sibling.path.name.endswith(FINISHED)]
    votes = [session for session in (*finished, own.session, *unfinished) if session]
    if len({_identity(session) for session in votes}) != 1:
        return None
    ((winner, _),) = Counter(tuple(session.items()) for session in votes).most_common(1)
    return dict(winner)


def _tables(own: Survey, siblings: Iterable[Survey]) -> tuple[Mapping[int, Schema], Mapping[int, Channel]]:
    """Schemas and channels completed from the siblings of the series, if these are of one mind and do not contradict
    the own; else the own."""
    tables = [(sibling.schemas, sibling.channels) for sibling in siblings if sibling.channels]
    if not tables or any(table != tables[0] for table in tables):
        return own.schemas, own.channels
    schemas, channels = tables[0]
    if schemas | own.schemas != own.schemas | schemas or channels | own.channels != own.channels | channels:
        return own.schemas, own.channels
    return schemas | own.schemas, channels | own.channels
