"""Journals of runs, read by tests."""

from __future__ import annotations

from collections.abc import Iterable

from thermostand.recording.format.journal_lines import journal_lines, lines_of, mark_of
from thermostand.stand.running.memory.entries import Written, decoded, encoded

MARK = mark_of("a session")


def lines_with(entries: Iterable[Written], place: int = 0, mark: bytes = MARK) -> bytes:
    """The lines of a journal, from that place of the file on."""
    return journal_lines(map(encoded, entries), mark, place)


def read_lines(data: bytes) -> tuple[list[Written], int]:
    """The entries of all sound lines, and how many bytes there are up to the end of the last one.

    SessionError when a sound line holds an entry that is not known here.
    """
    lines = lines_of(data)
    return [decoded(text) for text in lines.sound], lines.size_bytes
