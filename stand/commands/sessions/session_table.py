"""The list of sessions, for people and for programs. Nothing is imported here that takes time."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict

from thermostand.foundation.instants import format_date_time, format_duration, format_utc
from thermostand.foundation.usage import escape_line
from thermostand.recording.reading.catalogue import ListedSession

COLUMNS = ("session", "recipe", "start (local)", "duration", "frames", "size", "devices", "run", "files")
ON_THE_RIGHT = frozenset({"duration", "frames", "size"})
_NOTE_WIDTH = 40
_GAP = 2  # between columns
_LEFT_OUT = ("note", "archived", "devices", "size", "tags", "recipe", "duration", "frames", "start (local)")
"""What a narrow terminal does without, the first one first: which session it is and how it stands is shown in any."""


def format_size(size_bytes: int) -> str:
    """`143.7 MB`, in powers of 1000."""
    for limit, unit in ((1e9, "GB"), (1e6, "MB"), (1e3, "kB")):
        if size_bytes >= limit:
            return f"{size_bytes / limit:.1f} {unit}"
    return f"{size_bytes} B"


def make_rows(entries: Sequence[ListedSession]) -> tuple[tuple[str, ...], list[tuple[str, ...]]]:
    """The columns and a row for each session. Columns of tags, copies and notes are there when any session has one."""
    has_copies = any(entry.copies for entry in entries)
    optional = {
        "tags": [",".join(entry.tags) for entry in entries],
        "archived": [("yes" if entry.archived else "no") if has_copies else "" for entry in entries],
        "note": [_get_last_note(entry) for entry in entries],
    }
    shown = {name: cells for name, cells in optional.items() if any(cells)}
    columns = (*COLUMNS, *shown)
    return columns, [
        (*_make_row(entry), *(cells[place] for cells in shown.values())) for place, entry in enumerate(entries)
    ]


def _make_row(entry: ListedSession) -> tuple[str, ...]:
    length = "" if entry.begin_ns is None or entry.end_ns is None else format_duration(entry.end_ns - entry.begin_ns)
    return (
        escape_line(entry.name),
        escape_line(entry.metadata.get("recipe", "?")),
        "" if entry.start_ns is None else format_date_time(entry.start_ns),
        length,
        str(entry.frames),
        format_size(entry.size_bytes),
        "simulated" if entry.simulated else "real",
        entry.run,
        escape_line(f"{entry.state_text}{'; ' if entry.lacks else ''}{entry.lacks}"),
    )


def _get_last_note(entry: ListedSession) -> str:
    if not entry.notes:
        return ""
    text = escape_line(entry.notes[-1].text)
    return text if len(text) <= _NOTE_WIDTH else f"{text[: _NOTE_WIDTH - 3]}..."


def fit_columns(
    columns: tuple[str, ...], table: Sequence[tuple[str, ...]], width: int
) -> tuple[tuple[str, ...], list[tuple[str, ...]], tuple[str, ...]]:
    """The columns that fit into so many characters, the table with these alone, and the columns that are left out."""
    widths = {name: max(len(name), *(len(row[at]) for row in table)) for at, name in enumerate(columns)}
    left_out: list[str] = []
    for name in _LEFT_OUT:
        if sum(widths.values()) + _GAP * (len(widths) - 1) <= width:
            break
        if widths.pop(name, None) is not None:
            left_out.append(name)
    kept = [at for at, name in enumerate(columns) if name in widths]
    return tuple(columns[at] for at in kept), [tuple(row[at] for at in kept) for row in table], tuple(left_out)


def format_lines(columns: tuple[str, ...], table: Sequence[tuple[str, ...]]) -> Iterator[str]:
    """The table in columns, for a file or a pipe."""
    widths = [max(map(len, column)) for column in zip(columns, *table, strict=True)]
    for row in (columns, *table):
        yield "  ".join(f"{cell:<{width}}" for cell, width in zip(row, widths, strict=True)).rstrip()


def make_entry_json(entry: ListedSession) -> dict[str, object]:
    """One session of `stand session list --json`, the head of `info --json`. start and end are UTC, what ends in _ns is
    an instant of the stand's clock but for that of a note or copy, which is UTC, and durations are differences."""
    has_times = entry.begin_ns is not None and entry.end_ns is not None
    return {
        "name": entry.name,
        "path": str(entry.path),
        "metadata": entry.metadata,
        "start": None if entry.start_ns is None else format_utc(entry.start_ns),
        "end": None if entry.end_utc_ns is None else format_utc(entry.end_utc_ns),
        "begin_ns": entry.begin_ns,
        "end_ns": entry.end_ns,
        "duration_s": ((entry.end_ns or 0) - (entry.begin_ns or 0)) / 1e9 if has_times else None,
        "frames": entry.frames,
        "bytes": entry.size_bytes,
        "simulated": entry.simulated,
        "run": entry.run,
        "files": entry.files,
        "segments": [{"file": name, "state": state, "bytes": bytes_} for name, state, bytes_ in entry.segments],
        "troubles": list(entry.troubles),
        "missing": list(entry.missing),
        "has_camera_temperature": entry.has_camera_degC,
        "tags": list(entry.tags),
        "notes": [asdict(note) for note in entry.notes],
        "archived": entry.archived or None,
    }
