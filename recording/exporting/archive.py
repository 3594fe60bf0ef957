"""Copies of finished sessions on another disk, read back before they count, and the deletion of what has such a copy.

A copy grows as `NAME.part` next to its place: each file under its own name once it is complete and synced, so that a
copy that was interrupted goes on behind the last file. Then all of it is read back from the disk and compared with what
was read of the session, `archive.json` is written with the checksums, and the folder gets its name. The session itself
takes a line in its notes. Nothing of a session that is being recorded is touched, or of one whose run is not over.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import closing, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import cast

from thermostand.foundation.errors import SessionError
from thermostand.foundation.files import make_durable_folder, replace_file, sync_folder
from thermostand.foundation.json_values import parse_json_object
from thermostand.foundation.lock_file import try_lock
from thermostand.recording.format.inventory import SegmentState, list_segments
from thermostand.recording.format.journal_lines import JOURNAL_NAME
from thermostand.recording.reading.catalogue import DELETED, ListedSession, compute_contents_digest
from thermostand.recording.reading.notes import NOTES_NAME, Archived, add_archived
from thermostand.recording.reading.run_status import Files, RunOutcome

MANIFEST = "archive.json"
KEEP_TAG = "keep"  # a session with this tag is never deleted
_BLOCK_BYTES = 1 << 22  # round number; nothing was measured
_SPARE_BYTES = 100_000_000  # left free at the place of the copies
_OVER = (RunOutcome.COMPLETE, RunOutcome.STOPPED, RunOutcome.TRIPPED, RunOutcome.FAILED)

Report = Callable[[int], None]


@dataclass(frozen=True, slots=True)
class DeletionRule:
    """What may be deleted: sound, with a copy as it is now, without KEEP_TAG, ended at least after_days ago."""

    after_days: float

    def __str__(self) -> str:
        return (
            f"deleted are sound sessions that ended at least {self.after_days:g} days ago, have a copy that is read "
            f"back first, and do not have the tag {KEEP_TAG}"
        )

    def applies(self, entry: ListedSession, now_ns: int) -> bool:
        """Return whether the rule applies to this session, by what the list knows of it."""
        age_ns = 0 if entry.end_utc_ns is None else now_ns - entry.end_utc_ns
        is_old = entry.end_utc_ns is not None and age_ns >= self.after_days * 86_400e9
        return bool(is_old and entry.archived and entry.files == Files.SOUND and KEEP_TAG not in entry.tags)


def explain_unfit(entry: ListedSession) -> str:
    """Return why a session is not copied now; "" when it may be."""
    if any(state in (SegmentState.RECORDING, SegmentState.UNFINISHED) for _, state, _ in entry.segments):
        return "is being recorded, or was never finished (`stand session repair`)"
    return "" if entry.run in _OVER else f"its run is {entry.run} and may be resumed"


def archive(entry: ListedSession, to: Path, by: str, now_ns: int, report: Report = lambda _: None) -> Path:
    """A verified copy of the session in `to`, and a line in its notes that says so; returns the copy. `report` gets the
    bytes done, of twice the session's size. Blocking. SessionError when it cannot be made; what is there is kept for
    the next try."""
    if reason := explain_unfit(entry):
        raise SessionError(f"{entry.path}: {reason}")
    copy, part = to / entry.name, to / f"{entry.name}.part"
    try:
        contents = compute_contents_digest(entry.path)
        if not _is_copy(copy, contents):
            if os.path.lexists(copy):
                raise SessionError(f"{copy}: is there already and is another session, or an older state of this one")
            make_durable_folder(part)
            _check_space(entry, to, part)
            _remove_extra(part, set(_list_files(entry.path)))
            sums = {
                name: _copy_file(entry.path / name, part / name, report) for name in sorted(_list_files(entry.path))
            }
            _check_same(part, sums, report)
            if compute_contents_digest(entry.path) != contents:
                raise SessionError(f"{entry.path}: has changed while it was copied; try again")
            manifest = {"contents": contents, "session": entry.name, "blake2b": sums}
            replace_file(part / MANIFEST, json.dumps(manifest, indent=1).encode())
            part.rename(copy)
            sync_folder(to)
        add_archived(entry.path, Archived(str(copy.resolve()), now_ns, contents), by)
        _copy_file(entry.path / NOTES_NAME, copy / NOTES_NAME, lambda _: None)
    except OSError as error:
        raise SessionError(f"{copy}: the copy failed ({error.strerror or error})") from error
    return copy


def check_copy(copy: Path, contents: str, report: Report = lambda _: None) -> None:
    """Read a copy back; SessionError when a byte of it is not what the session had."""
    try:
        sums = _read_manifest(copy).get("blake2b")
        if not _is_copy(copy, contents) or not isinstance(sums, dict):
            raise SessionError(f"{copy}: is not a complete copy")
        _check_same(copy, cast("dict[str, str]", sums), report)
    except OSError as error:
        raise SessionError(f"{copy}: cannot be read back ({error.strerror or error})") from error


def delete(entry: ListedSession, report: Report = lambda _: None) -> None:
    """Remove a session whose copy has just been read back. SessionError, and then nothing is removed, when the copy is
    not what it should be, or the session has changed or is in use."""
    check_copy(Path(entry.archived), entry.contents, report)
    gone = entry.path.with_name(f".{entry.path.name}{DELETED}")
    try:
        with closing(_JournalLock(entry.path)):
            if compute_contents_digest(entry.path) != entry.contents or explain_unfit(entry) or entry.path.is_symlink():
                raise SessionError(f"{entry.path}: has changed since it was copied; it is kept")
            entry.path.rename(gone)
        shutil.rmtree(gone)
    except OSError as error:
        raise SessionError(f"{entry.path}: cannot be deleted ({error.strerror or error})") from error


class _JournalLock:
    """The journal's lock, as a daemon has it that runs or resumes the session; SessionError when one has it."""

    def __init__(self, path: Path) -> None:
        self._fd = -1
        with suppress(FileNotFoundError):
            self._fd = os.open(path / JOURNAL_NAME, os.O_RDWR | os.O_CLOEXEC | os.O_NOFOLLOW)
            if not try_lock(self._fd):
                self.close()
                raise SessionError(f"{path}: a daemon has this session open; it is kept")
        if any(file.state is SegmentState.RECORDING for file in list_segments(path)):
            self.close()
            raise SessionError(f"{path}: is being recorded; it is kept")

    def close(self) -> None:
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1


def _list_files(directory: Path) -> Iterator[str]:
    """The regular files of a session, by their paths within it, but for its notes, which still grow."""
    for folder, _, names in os.walk(directory):
        for name in names:
            path = Path(folder, name)
            if path.is_file() and not path.is_symlink() and path != directory / NOTES_NAME:
                yield str(path.relative_to(directory))


def _is_copy(copy: Path, contents: str) -> bool:
    """Return whether a folder is a copy with these contents, by names and sizes."""
    return copy.is_dir() and _read_manifest(copy).get("contents") == contents == compute_contents_digest(copy)


def _read_manifest(copy: Path) -> dict[str, object]:
    try:
        return parse_json_object((copy / MANIFEST).read_bytes()) or {}
    except OSError:
        return {}


def _remove_extra(part: Path, wanted: set[str]) -> None:
    """Take out of a copy that is begun what the session does not have (any more)."""
    for path in [path for path in part.rglob("*") if not path.is_dir() and str(path.relative_to(part)) not in wanted]:
        path.unlink()


def _check_space(entry: ListedSession, to: Path, part: Path) -> None:
    existing_bytes = sum(path.stat().st_size for path in part.rglob("*") if path.is_file())
    needed, free = entry.size_bytes - existing_bytes + _SPARE_BYTES, shutil.disk_usage(to).free
    if needed > free:
        raise SessionError(f"{to}: has {free / 1e9:.1f} GB free, and {entry.name} needs {needed / 1e9:.1f} GB")


def _copy_file(source: Path, target: Path, report: Report) -> str:
    """Copy one file, synced, under its name when it is complete; the checksum of what was read of the source. A file of
    the same size that an earlier try has left is not copied again: it is compared with the others."""
    if not source.is_file():
        return ""
    is_present = target.is_file() and target.stat().st_size == source.stat().st_size and target.name != NOTES_NAME
    make_durable_folder(target.parent)
    growing = target.with_name(f".{target.name}.copying")
    digest = hashlib.blake2b(digest_size=16)
    with source.open("rb") as read, open(os.devnull if is_present else growing, "wb") as written:
        while block := read.read(_BLOCK_BYTES):
            digest.update(block)
            written.write(block)
            report(len(block))
        # A copied session must not push what a run needs out of the memory.
        os.posix_fadvise(read.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)
        if not is_present:
            written.flush()
            os.fsync(written.fileno())
    if not is_present:
        status = source.stat()
        os.utime(growing, ns=(status.st_atime_ns, status.st_mtime_ns))
        growing.replace(target)
        sync_folder(target.parent)
    return digest.hexdigest()


def _check_same(folder: Path, sums: dict[str, str], report: Report) -> None:
    """Read all files from the disk; one that differs is removed where a copy is being made, so that the next try copies
    it again."""
    for name, expected in sums.items():
        path = folder / name
        digest = hashlib.blake2b(digest_size=16)
        with path.open("rb") as file:
            os.posix_fadvise(file.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)  # from the disk, not from memory
            while block := file.read(_BLOCK_BYTES):
                digest.update(block)
                report(len(block))
        if digest.hexdigest() != expected:
            if folder.suffix == ".part":
                path.unlink()
            raise SessionError(f"{path}: reads back differently from what the session has; the copy does not count")
