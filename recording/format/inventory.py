"""The files a recorded session consists of, in any state; only names, sizes and locks are looked at.

The segments of a series are a chain: each says of which session it is and which number it has. Missing numbers are
ranges: a file of any number costs nothing.
"""

from __future__ import annotations

import fcntl
import os
import re
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from enum import StrEnum
from itertools import pairwise
from pathlib import Path

from thermostand.recording.format.layout import (
    DAMAGED,
    FINISHED,
    FRAMES,
    SESSION_CRC,
    TELEMETRY,
    UNFINISHED,
    make_segment_metadata,
)

MOST_MISSING = 10_000  # segments; a session has hundreds


class SegmentState(StrEnum):
    """finished: indexed, read by everything. unfinished: left by a recorder that is gone. recording: a recorder has it
    open. damaged: the original of a repaired segment, kept because not all of it could be recovered."""

    FINISHED = "finished"
    UNFINISHED = "unfinished"
    RECORDING = "recording"
    DAMAGED = "damaged"


_STATE = {FINISHED: SegmentState.FINISHED, UNFINISHED: SegmentState.UNFINISHED, DAMAGED: SegmentState.DAMAGED}
# A second damaged original of the same number is NNNN.2.mcap.damaged. A number has one spelling.
_NAME = re.compile(
    rf"(\d{{4}}|[1-9]\d{{4,}})({re.escape(FINISHED)}|{re.escape(UNFINISHED)}|(?:\.\d+)?{re.escape(DAMAGED)})"
)


@dataclass(frozen=True, slots=True)
class SegmentFile:
    """A segment's file. `name` is its path within the session, `telemetry/0003.mcap`."""

    path: Path
    series: str
    number: int
    state: SegmentState
    size_bytes: int

    @property
    def name(self) -> str:
        """Series and file name."""
        return f"{self.series}/{self.path.name}"


def list_segments(directory: Path) -> tuple[SegmentFile, ...]:
    """The segments in `directory`, telemetry first, in order of their numbers; none when it is no session."""
    return tuple(file for series in (TELEMETRY, FRAMES) for file in _list_series(directory / series))


def _is_like_segment(name: str) -> bool:
    """Return whether it has an ending of segments, in small letters, capitals or cut short."""
    return name.lower().endswith(tuple(_STATE)) or _CHANGED_SEGMENT.fullmatch(name) is not None


def list_strays(directory: Path) -> tuple[str, ...]:
    """Return what lies among the segments or next to their folders, is called as if it were one, and is none: a copy
    (`0003 (1).mcap`, `00003.mcap`), what another system leaves (`._0003.mcap`), or no file. It counts for nothing."""
    found: list[str] = []
    for series in ("", TELEMETRY, FRAMES):
        with suppress(OSError):
            names = [path.name for path in (directory / series).iterdir() if _is_like_segment(path.name)]
            known = {file.path.name for file in _list_series(directory / series)} if series else set[str]()
            found += [f"{series}/{name}".lstrip("/") for name in sorted(set(names) - known)]
    return tuple(found)


# What a file system leaves of the names of a session: capitals (TELEMETRY/0003.MCAP), or 8.3 (TELEME~1/0003~1.MCA).
_CHANGED_FOLDER = re.compile(r"(telemetry|frames|telem\w*~\d+|frame\w*~\d+)", re.IGNORECASE)
_CHANGED_SEGMENT = re.compile(r"\d{4,}(~\d+)?\.(mca|mcap|mcap\.part|par|mcap\.damaged|dam)", re.IGNORECASE)


def explain_changed_names(directory: Path) -> str:
    """Return why no segment is found where a file system has changed their names, as the part of a sentence; "" when it
    has not."""
    with suppress(OSError):
        for folder in sorted(path for path in directory.iterdir() if _CHANGED_FOLDER.fullmatch(path.name)):
            for path in sorted(folder.iterdir()):
                if (_CHANGED_SEGMENT.fullmatch(path.name) and _parse_segment_file(path) is None) or (
                    folder.name not in (TELEMETRY, FRAMES) and _CHANGED_SEGMENT.fullmatch(path.name)
                ):
                    return (
                        f"a file system has changed its names to capitals or 8.3 ({folder.name}/{path.name}); give "
                        f"them back as {TELEMETRY}/NNNN.mcap and {FRAMES}/NNNN.mcap, or copy the session in a tar or "
                        "zip archive"
                    )
    return ""


def _list_series(folder: Path) -> list[SegmentFile]:
    try:
        paths = list(folder.iterdir())
    except OSError:  # no such folder
        return []
    files = [file for path in paths if (file := _parse_segment_file(path)) is not None]
    return sorted(files, key=lambda file: (file.number, file.path.name))


def _parse_segment_file(path: Path) -> SegmentFile | None:
    """The segment at `path`; None when it is none, or was given another name under our eyes."""
    name = _NAME.fullmatch(path.name)
    try:
        if name is None or not path.is_file():
            return None
        state = next(state for suffix, state in _STATE.items() if path.name.endswith(suffix))
        if state is SegmentState.UNFINISHED and is_locked(path):
            state = SegmentState.RECORDING
        return SegmentFile(path, path.parent.name, int(name[1]), state, path.stat().st_size)
    except FileNotFoundError:
        return None


def is_locked(path: Path) -> bool:
    """A living recorder holds its file locked. Our own lock is shared and released at once: nothing waits for it."""
    try:
        fd = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)  # a pipe of that name must not block
    except PermissionError:  # recorded by another user: whether that process still lives is unknown
        return False
    try:
        fcntl.flock(fd, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    finally:
        os.close(fd)
    return False


def is_misplaced(series: str, number: int, place: Mapping[str, str], session: Mapping[str, str]) -> bool:
    """Return whether the record `segment` gives another place in the session than the file's name: it was doubled,
    swapped or renamed."""
    due = make_segment_metadata(series, number, session)
    return bool(place.keys() - due.keys()) or any(place.get(key) != due[key] for key in due.keys() - {SESSION_CRC})


def find_foreign_numbers(numbers: Iterable[int]) -> set[int]:
    """Find the numbers that no segment of the session can have: behind more missing ones than any session has
    segments."""
    known = sorted(set(numbers))
    for place, (before, after) in enumerate(pairwise([-1, *known])):
        if after - before > MOST_MISSING:
            return set(known[place:])
    return set()


def find_missing_numbers(numbers: Iterable[int]) -> Iterator[tuple[int, int]]:
    """(first, last) of each range of numbers from 0 on that is not there; foreign ones do not count."""
    known = set(numbers)
    for before, after in pairwise([-1, *sorted(known - find_foreign_numbers(known))]):
        if after > before + 1:
            yield before + 1, after - 1
