"""Journals of runs, read by tests."""

from __future__ import annotations

from recording.reading.journal_lines import lines_of
from stand.running.memory.entries import Written, decoded


def read_lines(data: bytes) -> tuple[list[Written], int]:
    """The entries of all sound lines, and how many bytes there are up to the end of the last one.

    SessionError when a sound line holds an entry that is not known here.
    """
    lines = lines_of(data)
    return [decoded(text) for text in lines.sound], lines.size_bytes
