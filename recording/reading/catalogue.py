"""The sessions of a folder, from an index next to them: `.sessions.sqlite`.

The index is made from the sessions and holds nothing else. An entry counts as long as the names, sizes and times of its
session's files are those it was made of; all others are made again. An index that is lost, damaged, of another version
or somebody else's is made again; where none can be written, the list takes as long as it takes to look at each session.

Nothing is imported here that takes time: a list of known sessions needs neither numpy nor protobuf.
"""

from __future__ import annotations

import hashlib
import json
import os
import sqlite3
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing, suppress
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from thermostand.foundation.errors import SessionError
from thermostand.foundation.version import read_version
from thermostand.recording.format.inventory import is_locked
from thermostand.recording.format.journal_lines import JOURNAL_NAME
from thermostand.recording.format.layout import DAMAGED, FINISHED, FRAMES, TELEMETRY, UNFINISHED
from thermostand.recording.format.manifest import MANIFEST_NAME
from thermostand.recording.reading.notes import NOTES_NAME, Archived, Note, read_notes

if TYPE_CHECKING:
    from thermostand.recording.reading.scan import Scan

INDEX_NAME = ".sessions.sqlite"
DELETED = ".deleted"  # of a folder that is being deleted, behind a dot and its name
_VERSION = 4  # of the index; the program's version counts, too, for what it says of a session
_BUSY_S = 1.0  # how long another one that writes the index is waited for
_SCHEMA = "CREATE TABLE sessions (name BLOB PRIMARY KEY, sealed TEXT NOT NULL, entry TEXT NOT NULL)"
# Each file is asked for its size: one that was cut short in place must not be listed as sound.
_File = tuple[str, int, int, bool]  # name, size, time of its last change in ns, whether a recorder has it open
_INSTANT, _TEXT = (int, type(None)), (str,)
_KINDS: dict[str, tuple[type, ...]] = {
    **dict.fromkeys(("frames", "size_bytes"), (int,)),
    **dict.fromkeys(("begin_ns", "end_ns", "start_ns", "end_utc_ns"), _INSTANT),
    **dict.fromkeys(("run", "files", "state_text", "lacks", "segments_json", "contents"), _TEXT),
    "has_camera_degC": (bool, type(None)),
}  # of an index that somebody else has written, too
_SUFFIXES = (FINISHED, UNFINISHED, DAMAGED)

Report = Callable[[float, str], None]


@dataclass(frozen=True, slots=True)
class ListedSession:
    """A session at a glance (`scan.Scan` has the meanings), with the notes that people wrote.

    start_ns: begin_ns as UTC, end_utc_ns: end_ns. run, files: words of Run and Files. state_text, lacks: in words.
    segments_json: those of `segments`, which a list does not show and so need not be read.
    contents: names and sizes of the segments and the journal as a digest, which a copy elsewhere shares.
    """

    path: Path
    metadata: dict[str, str]
    attachments: tuple[str, ...]
    frames: int
    size_bytes: int
    begin_ns: int | None
    end_ns: int | None
    start_ns: int | None
    end_utc_ns: int | None
    run: str
    files: str
    state_text: str
    lacks: str
    has_camera_degC: bool | None
    segments_json: str
    troubles: tuple[str, ...]
    missing: tuple[str, ...]
    contents: str = ""
    notes: tuple[Note, ...] = ()
    tags: tuple[str, ...] = ()
    copies: tuple[Archived, ...] = ()

    @property
    def name(self) -> str:
        """The name of its folder."""
        return self.path.name or self.path.resolve().name

    @property
    def segments(self) -> tuple[tuple[str, str, int], ...]:
        """Name, state and size in bytes of each."""
        return tuple((str(name), str(state), int(size)) for name, state, size in json.loads(self.segments_json))

    @property
    def simulated(self) -> bool:
        """The devices were fakes."""
        return self.metadata.get("simulated") == "true"

    @property
    def archived(self) -> str:
        """The folder of the last verified copy of all of it as it is now; "" when there is none."""
        return next((copy.to for copy in reversed(self.copies) if copy.contents == self.contents), "")


def make_entry(seen: Scan, contents: str = "") -> ListedSession:
    """Return what a list shows of a session that was looked at."""
    from thermostand.recording.reading.run_status import Files

    by_operator = read_notes(seen.path)
    return ListedSession(
        path=seen.path,
        metadata=dict(seen.metadata),
        attachments=tuple(seen.attachments),
        frames=seen.frames,
        size_bytes=seen.size_bytes,
        begin_ns=seen.begin_ns,
        end_ns=seen.end_ns,
        start_ns=None if seen.begin_ns is None else seen.utc.utc_ns(seen.begin_ns),
        end_utc_ns=None if seen.end_ns is None else seen.utc.utc_ns(seen.end_ns),
        run=str(seen.run),
        files=str(seen.files),
        state_text=seen.state_text,
        lacks=seen.lacks,
        has_camera_degC=seen.has_camera_degC,
        segments_json=json.dumps([(file.name, str(file.state), file.size_bytes) for file in seen.inventory]),
        troubles=seen.sentences(Files.DAMAGED),
        missing=seen.sentences(Files.INCOMPLETE),
        contents=contents or compute_contents_digest(seen.path),
        notes=by_operator.notes,
        tags=by_operator.tags,
        copies=by_operator.archived,
    )


SessionCache = dict[Path, tuple[str, ListedSession]]  # a digest of the files, and what was made of them


def load_catalogue(
    folder: Path, report: Callable[[int], Report] | None = None, memory: SessionCache | None = None
) -> list[ListedSession]:
    """The sessions in `folder`, the oldest first. `report`: called with how many must be looked at, gives what is
    called with the progress. memory: takes what is new in place of the index, for who must not wait for a disk that
    hangs. Blocking; OSError when the folder cannot be read."""
    found = {path: (inode, files) for path, inode in _list_folders(folder) if (files := _list_files(path)) is not None}
    digests = {path: _compute_digest(files) for path, files in found.items()}
    with closing(_Index(folder, memory)) as index:
        known = {path: entry for path in found if (entry := index.get(path, digests[path])) is not None}
        new = [path for path in found if path not in known]
        tell = report(len(new)) if report is not None and new else None
        for number, path in enumerate(new):
            if tell is not None:
                tell(number, path.name)
            with suppress(SessionError):  # it was removed meanwhile
                known[path] = inspect_session(path)
                index.put(path, digests[path], known[path])
        index.keep(found)
    return sorted(known.values(), key=lambda entry: (entry.begin_ns or 0, str(entry.path)))


def inspect_session(path: Path) -> ListedSession:
    """The session in `path`, whatever an index says; SessionError when there is none."""
    from thermostand.recording.reading.scan import scan  # takes half a second to import

    return make_entry(scan(path))


def compute_contents_digest(path: Path) -> str:
    """Names and sizes of a session's segments and journal as a digest: the same of a complete copy of them."""
    files = _list_files(path)
    return (
        ""
        if files is None
        else _compute_digest([(name, size) for name, size, *_ in files if "/" in name or name == JOURNAL_NAME])
    )


def _list_folders(folder: Path) -> Iterator[tuple[Path, int]]:
    """Each with its number: another folder of the same name has another one."""
    with os.scandir(folder) as entries:
        found = [(entry.name, entry.inode()) for entry in entries if entry.is_dir()]
    yield from ((folder / name, number) for name, number in found if not _is_deleted(name))


def _is_deleted(name: str) -> bool:
    return name.startswith(".") and name.endswith(DELETED)


def _list_files(path: Path) -> list[_File] | None:
    """List the files that a session consists of; None when there is no segment. One that a living recorder has open
    counts as another file."""
    found: list[_File] = []
    place = os.fspath(path)  # path objects, and context managers but for the folders, would double the time of a list
    for series in (TELEMETRY, FRAMES):
        try:
            with os.scandir(f"{place}/{series}") as entries:
                for entry in entries:
                    name = entry.name
                    if name.endswith(_SUFFIXES):
                        status = entry.stat()
                        is_open = name.endswith(UNFINISHED) and is_locked(Path(entry.path))
                        found.append((f"{series}/{name}", status.st_size, status.st_mtime_ns, is_open))
        except OSError:  # not there, or removed meanwhile
            continue
    if not found:
        return None
    found.sort()
    for name in (JOURNAL_NAME, NOTES_NAME, MANIFEST_NAME):
        try:
            status = os.stat(f"{place}/{name}")
        except OSError:
            continue
        found.append((name, status.st_size, status.st_mtime_ns, False))
    return found


def _compute_digest(values: object) -> str:
    return hashlib.blake2b(repr(values).encode(errors="surrogateescape"), digest_size=16).hexdigest()


class _Index:
    """The file; every trouble with it means that nothing is known."""

    def __init__(self, folder: Path, memory: SessionCache | None) -> None:
        self._path = folder / INDEX_NAME
        self._memory = memory
        self._version = f"{_VERSION} {read_version()}"
        self._rows: dict[bytes, tuple[str, str]] = {}
        self._new: dict[bytes, tuple[str, str]] = {}
        self._gone: set[bytes] = set()
        with suppress(OSError, sqlite3.Error, ValueError):
            if self._is_ours():
                self._rows = self._read()

    def get(self, path: Path, files: str) -> ListedSession | None:
        """Return what was entered of these files; None when nothing was."""
        if self._memory is not None and (seen := self._memory.get(path)) is not None and seen[0] == files:
            return seen[1]
        name = os.fsencode(path.name)
        found = self._rows.get(name)
        if found is None or found[0] != self._seal(name, files, found[1]):
            return None
        try:
            return _decode(path, found[1])
        except (ValueError, TypeError, KeyError, AttributeError, RecursionError):
            return None

    def put(self, path: Path, files: str, entry: ListedSession) -> None:
        """Enter it, with the others, at the end."""
        if self._memory is not None:
            self._memory[path] = files, entry
            return
        self._new[os.fsencode(path.name)] = (files, _encode(entry))

    def keep(self, found: Mapping[Path, object]) -> None:
        """Forget all others."""
        if self._memory is not None:
            for path in self._memory.keys() - found.keys():
                del self._memory[path]
            return
        self._gone = set(self._rows) - {os.fsencode(path.name) for path in found}

    def close(self) -> None:
        """Write what is new; where that is refused, the next list looks again."""
        if not self._new and not self._gone:
            return
        with suppress(OSError, sqlite3.Error):
            if not self._is_ours() or not self._rows:
                for name in (INDEX_NAME, f"{INDEX_NAME}-journal"):  # one of its changes must not be undone in a new one
                    self._path.with_name(name).unlink(missing_ok=True)
            with closing(self._open()) as opened, opened:
                if not opened.execute("SELECT count(*) FROM sqlite_master").fetchone()[0]:
                    opened.execute(_SCHEMA)
                opened.executemany("DELETE FROM sessions WHERE name = ?", [(name,) for name in self._gone])
                rows = [(name, self._seal(name, files, text), text) for name, (files, text) in self._new.items()]
                opened.executemany("INSERT OR REPLACE INTO sessions VALUES (?, ?, ?)", rows)

    def _open(self) -> sqlite3.Connection:
        opened = sqlite3.connect(self._path, timeout=_BUSY_S)
        opened.execute("PRAGMA trusted_schema = OFF")
        return opened

    def _is_ours(self) -> bool:
        """Return whether it is a file, and no link to another place."""
        return self._path.is_file() and not self._path.is_symlink()

    def _read(self) -> dict[bytes, tuple[str, str]]:
        """Name -> digest of the files, entry; sqlite3.Error when it is no index."""
        with closing(sqlite3.connect(f"{self._path.absolute().as_uri()}?mode=ro", _BUSY_S, uri=True)) as opened:
            opened.execute("PRAGMA trusted_schema = OFF")
            tables = opened.execute("SELECT sql FROM sqlite_master WHERE sql IS NOT NULL").fetchall()
            if tables != [(_SCHEMA,)]:
                return {}
            rows = opened.execute("SELECT name, sealed, entry FROM sessions").fetchall()
        return {
            name: (str(sealed), text)
            for name, sealed, text in rows
            if isinstance(name, bytes) and isinstance(text, str)
        }

    def _seal(self, name: bytes, files: str, text: str) -> str:
        """Return what a row was made by, of which files, and all that it says: the database itself has no checksums."""
        return _compute_digest((self._version, name, files, text))


def _encode(entry: ListedSession) -> str:
    values = {field.name: getattr(entry, field.name) for field in fields(entry) if field.name != "path"}
    for name in ("notes", "copies"):
        values[name] = [asdict(each) for each in values[name]]
    return json.dumps(values)


def _decode(path: Path, text: str) -> ListedSession:
    """ValueError, TypeError, KeyError or AttributeError when the text is none."""
    values = cast("dict[str, Any]", json.loads(text))
    notes = tuple(Note(**each) for each in values.pop("notes"))
    copies = tuple(Archived(**each) for each in values.pop("copies"))
    lists = {name: tuple(map(str, values.pop(name))) for name in ("attachments", "troubles", "missing", "tags")}
    metadata = {str(key): str(value) for key, value in values.pop("metadata").items()}
    for name, value in values.items():
        if type(value) not in _KINDS[name]:
            raise TypeError(name)
    return ListedSession(path=path, metadata=metadata, notes=notes, copies=copies, **lists, **values)
