"""What people say of a session: notes and tags, and where it was archived, in a small file of its own, `notes.jsonl`.

Lines are only ever added, each with who and when, in the form of the journal's: a CRC, then a JSON object. So a running
session takes a note, too, and its recording is not touched. A partial or damaged line is left out, and reported.
"""

from __future__ import annotations

import fcntl
import json
import os
import re
import stat
from collections.abc import Iterable, Mapping
from contextlib import ExitStack
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import cast

from thermostand.foundation.errors import ConfigError, SessionError
from thermostand.foundation.files import sync_folder
from thermostand.foundation.json_values import parse_json_object
from thermostand.recording.format.journal_lines import (
    format_damage,
    format_lines,
    format_unended,
    make_mark,
    parse_lines,
)

NOTES_NAME = "notes.jsonl"
LONGEST_NOTE = 4000  # characters
LIMIT_BYTES = 4_000_000  # a thousand of the longest notes
TAG = re.compile(r"[^\W_][\w.:+-]{0,39}")
_HEAD_BYTES = 20  # of a line, with its end
_APPENDING = os.O_RDWR | os.O_APPEND | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK
_NOTE, _TAGS, _UNTAG, _ARCHIVED = "note", "tags", "untag", "archived"


@dataclass(frozen=True, slots=True)
class Note:
    """A sentence about the session: when (UTC, ns), by whom, what."""

    time_ns: int
    by: str
    text: str


@dataclass(frozen=True, slots=True)
class Archived:
    """A verified copy: the folder it is in, when it was made (UTC, ns), and of which files (`archive.contents_of`)."""

    to: str
    time_ns: int
    contents: str


@dataclass(frozen=True, slots=True)
class SessionNotes:
    """All notes and tags of a session; `tags` are in the order they were given first. damage: what is lost of them.
    unended: bytes at the end that are no line, which was being written or is lost; "" when nothing is."""

    notes: tuple[Note, ...] = ()
    tags: tuple[str, ...] = ()
    archived: tuple[Archived, ...] = ()
    damage: str = ""
    unended: str = ""

    def as_json(self) -> dict[str, object]:
        """Fields for programs."""
        return asdict(self)


def read_notes(directory: Path) -> SessionNotes:
    """Read the notes of the session in `directory`; empty when there are none, or none can be read."""
    try:
        fd = os.open(directory / NOTES_NAME, os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK)
    except OSError:
        return SessionNotes()
    try:
        data = os.read(fd, LIMIT_BYTES) if stat.S_ISREG(os.fstat(fd).st_mode) else b""
    except OSError:
        return SessionNotes()
    finally:
        os.close(fd)
    lines = parse_lines(data)
    found = _fold(entry for line in lines.sound if (entry := parse_json_object(line)) is not None)
    damage = format_damage(lines) if lines.damaged else ""
    return replace(found, damage=damage, unended=format_unended(lines.unended_bytes) if lines.unended_bytes else "")


def add_note(directory: Path, text: str, by: str, time_ns: int) -> None:
    """A note, durable when this returns. ConfigError for an empty or endless one, SessionError when it is not kept."""
    text = text.strip()
    if not 0 < len(text) <= LONGEST_NOTE:
        raise ConfigError(f"a note has 1 to {LONGEST_NOTE} characters; this one has {len(text)}")
    _append(directory, {"entry": _NOTE, "time_ns": time_ns, "by": by, "text": text})


def add_tags(directory: Path, tags: Iterable[str], by: str, time_ns: int, *, remove: bool = False) -> None:
    """Give the session these tags, or take them away; as add_note. A tag that it has already is no error."""
    found = [check_tag(tag) for tag in tags]
    _append(directory, {"entry": _UNTAG if remove else _TAGS, "time_ns": time_ns, "by": by, "tags": found})


def add_archived(directory: Path, copy: Archived, by: str) -> None:
    """Say that a verified copy is there; as add_note."""
    fields = {"entry": _ARCHIVED, "time_ns": copy.time_ns, "by": by, "to": copy.to, "contents": copy.contents}
    _append(directory, fields)


def check_tag(tag: str) -> str:
    """The tag; ConfigError when it is none."""
    if TAG.fullmatch(tag) is None:
        raise ConfigError(
            f"{tag!r}: a tag is one word of at most 40 letters, digits and . : + - _, and begins with a letter or digit"
        )
    return tag


def _append(directory: Path, fields: Mapping[str, object]) -> None:
    """Append one line behind the last one; a partial line behind that is cut off.

    The folder is opened first and not through a symbolic link, so that nothing is ever written elsewhere. What the disk
    took of a line that it did not take whole is cut off again.
    """
    path = directory / NOTES_NAME
    text = json.dumps(fields, ensure_ascii=False).encode(errors="replace")
    try:
        with ExitStack() as opened:
            folder = os.open(directory, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC | os.O_NOFOLLOW)
            opened.callback(os.close, folder)
            fd = os.open(NOTES_NAME, _APPENDING, 0o644, dir_fd=folder)
            opened.callback(os.close, fd)
            fcntl.flock(fd, fcntl.LOCK_EX)
            status = os.fstat(fd)
            if not stat.S_ISREG(status.st_mode) or status.st_size + len(text) + _HEAD_BYTES > LIMIT_BYTES:
                raise SessionError(f"{path}: is no file of notes, or is full")
            lines, end = parse_lines(os.pread(fd, LIMIT_BYTES, 0)), status.st_size
            end -= lines.unended_bytes
            os.ftruncate(fd, end)
            _write_whole(fd, format_lines((text,), lines.mark or make_mark(directory.absolute().name), end), end)
            os.fsync(fd)
            sync_folder(directory)  # the file may be new
    except OSError as error:
        why = "the folder is a symbolic link" if directory.is_symlink() else error.strerror
        raise SessionError(f"{path}: the note could not be kept ({why})") from error


def _write_whole(fd: int, data: bytes, size_bytes: int) -> None:
    """All of it behind the `size_bytes` that are there, or nothing and OSError: a disk that fills up takes a part."""
    written = 0
    try:
        while written < len(data):
            written += os.write(fd, data[written:])
    except OSError:
        os.ftruncate(fd, size_bytes)
        raise


def _fold(entries: Iterable[dict[str, object]]) -> SessionNotes:
    notes: list[Note] = []
    tags: dict[str, None] = {}
    archived: list[Archived] = []
    for entry in entries:
        time_ns, by = entry.get("time_ns"), str(entry.get("by", ""))
        if not isinstance(time_ns, int) or not 0 <= time_ns < 1 << 63:
            continue
        match entry.get("entry"):
            case "note":
                notes.append(Note(time_ns, by, str(entry.get("text", ""))))
            case "tags":
                tags |= dict.fromkeys(_parse_tags(entry))
            case "untag":
                tags = {tag: None for tag in tags if tag not in set(_parse_tags(entry))}
            case "archived":
                archived.append(Archived(str(entry.get("to", "")), time_ns, str(entry.get("contents", ""))))
            case _:
                pass  # of a later version
    return SessionNotes(tuple(notes), tuple(tags), tuple(archived))


def _parse_tags(entry: dict[str, object]) -> list[str]:
    found = entry.get("tags")
    texts = cast("list[object]", found) if isinstance(found, list) else []
    return [tag for tag in texts if isinstance(tag, str) and TAG.fullmatch(tag)]
