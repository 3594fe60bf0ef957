"""Journals of runs, read by tests."""

from __future__ import annotations

from collections.abc import Iterable

from thermostand.recording.format.journal_lines import format_lines, make_mark, parse_lines
from thermostand.stand.running.memory.entries import JournalEntry, decode, encode

MARK = make_mark("a session")


def lines_with(entries: Iterable[JournalEntry], place: int = 0, mark: bytes = MARK) -> bytes:
    """The lines of a journal, from that place of the file on."""
    return format_lines(map(encode, entries), mark, place)


def read_lines(data: bytes) -> tuple[list[JournalEntry], int]:
    """The entries of all sound lines, and how many bytes there are up to the end of the last one.

    SessionError when a sound line holds an entry that is not known here.
    """
    lines = parse_lines(data)
    return [decode(text) for text in lines.sound], lines.size_bytes
