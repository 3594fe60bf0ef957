"""What happens to a run: published on the hub, folded into its state, and kept in `journal.jsonl`, from which a
killed run is resumed.

Append-only, one entry a line (entries.py). A line is on the disk (fdatasync) when `write` returns. What follows the
last sound line is cut off before anything is appended. A damaged line before it stays where it is, and the
lines after it count; of a file with damaged lines a copy is kept as `journal.jsonl.damaged`.
"""

from __future__ import annotations

import errno
import os
from asyncio import Task, create_task, gather
from collections.abc import Callable, Iterable
from contextlib import suppress
from itertools import count
from pathlib import Path

from thermostand.foundation.clock import Clock
from thermostand.foundation.errors import NotFound, SessionError
from thermostand.foundation.events import JOURNAL_NOT_SAVED, EventKind
from thermostand.foundation.files import replace_file, sync_folder
from thermostand.foundation.hub import Hub
from thermostand.foundation.shutdown_deadline import ShutdownDeadline
from thermostand.foundation.workers import WorkerConnection, WorkerThread
from thermostand.recording.format.journal_lines import (
    JOURNAL_NAME,
    LIMIT_BYTES,
    format_damage,
    format_lines,
    make_mark,
    parse_lines,
)
from thermostand.recording.format.layout import TELEMETRY
from thermostand.recording.writing.disk import JOURNAL_LINE, DiskProcess
from thermostand.recording.writing.folder_watch import FolderLost
from thermostand.recording.writing.locks import lock
from thermostand.stand.running.memory.entries import Ended, Entry, Held, JournalEntry, Reset, Tripped, decode, encode
from thermostand.stand.running.memory.fold import apply_entry
from thermostand.stand.running.memory.state import RunState
from thermostand.stand.safety.fault import Fault
from thermostand.stand.safety.gate import HELD, INTERLOCK, REASON_TEXTS, RELEASED, STOPPING

_END_WITHIN_S, _COMPLETE_WITHIN_S = 1.0, 10.0  # real seconds that a disk may take for the last entry
_DAMAGED = ".damaged"  # the ending of the copy of a journal with damaged lines
_KEPT = "journal"  # its name in the disk process


class Journal:
    """The journal of one session, locked (flock) while it is open: one daemon per session.

    Lines that the disk refuses are kept and written with the next one; `trouble` is called when that begins. All lines
    are kept in memory: a journal that was removed under its run is rewritten when an operator has reset that.
    """

    def __init__(self, path: Path, fd: int, data: bytes, mark: bytes, damage: str = "") -> None:
        self.path = path
        self._mark = mark
        self.damage = damage  # a sentence, when lines of it are damaged
        self.name = path.name
        self.lost = ""
        self._file: JournalFile | None = JournalFile(path, fd, len(data))
        self._line: WorkerConnection | None = None  # to the disk process, when that has the file
        self._disk: DiskProcess | None = None
        self._acknowledged = bytearray(data)
        self._end = len(data)  # of all lines, those that wait too
        self._waiting: list[bytes] = []
        self._failing = False
        self._notes: set[Task[None]] = set()
        self._worker: WorkerThread | None = None
        self._trouble: Callable[[str], None] = _ignore

    @classmethod
    def create(cls, directory: Path) -> Journal:
        """A new, empty journal in a session's folder; SessionError when there is one, or the disk refuses."""
        path = directory / JOURNAL_NAME
        try:
            fd = os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o644)
            lock(fd)
            sync_folder(directory)
        except OSError as error:
            raise SessionError(f"{path}: no journal can be begun here ({error.strerror})") from error
        return cls(path, fd, b"", make_mark(directory.absolute().name))

    @classmethod
    def open(cls, directory: Path) -> tuple[Journal, list[JournalEntry]]:
        """The journal of a session and the entries of its sound lines, none when not even the first was written; a
        partial last line is cut off. Of a journal with damaged lines a copy is kept, and its `damage` says so.

        SessionError when there is none, or when a daemon is running this session.
        """
        path = directory / JOURNAL_NAME
        try:
            fd = os.open(path, os.O_RDWR | os.O_CLOEXEC)
        except OSError as error:
            if not directory.exists():
                raise NotFound(f"{directory}: no such folder") from error
            kind = SessionError if (directory / TELEMETRY).exists() else NotFound
            raise kind(f"{directory}: has no journal of a run ({error.strerror}); begin a new run") from error
        try:
            if not path.is_file():  # a pipe of that name might never give a byte
                raise SessionError(f"{path}: is no file, so no journal; begin a new run")
            if path.stat().st_size > LIMIT_BYTES:
                raise SessionError(
                    f"{path}: is larger than {LIMIT_BYTES // 1_000_000} MB, so no journal; begin a new run"
                )
            entries, data, mark, damage = _lock_and_read(fd, path)
        except BaseException as error:
            os.close(fd)
            if isinstance(error, BlockingIOError):
                raise SessionError(f"{directory}: {error.strerror}") from error
            if isinstance(error, OSError):
                raise SessionError(f"{path}: cannot be read ({error.strerror})") from error
            raise
        return cls(path, fd, data, mark, damage), entries

    def start(self, clock: Clock, trouble: Callable[[str], None], disk: DiskProcess | None = None) -> None:
        """Start it before the first `write`: `clock` is held while the disk works, `trouble` takes a sentence, `disk`
        is the process that has the file from then on."""
        self._worker = WorkerThread("journal", clock, patient=False)
        self._trouble = trouble
        self._disk = disk

    async def write(self, *entries: JournalEntry) -> None:
        """The entries on the disk, or kept for the next time."""
        self._queue(entries)
        await self._wait_for_commit()

    def note(self, entry: JournalEntry) -> None:
        """Write as `write` does, without waiting for the disk; its line comes before those of later calls. Nothing once
        closed."""
        if self._worker is None:
            return
        self._queue((entry,))
        task = create_task(self._wait_for_commit())
        self._notes.add(task)
        task.add_done_callback(self._finish_note)

    def _finish_note(self, task: Task[None]) -> None:
        self._notes.discard(task)
        if not task.cancelled():
            task.exception()  # a disk that was given up is reported by what gave it up

    def _queue(self, entries: Iterable[JournalEntry]) -> None:
        if self._worker is None:
            raise ValueError("a journal is started before it is written")
        for entry in entries:
            self._waiting.append(format_lines((encode(entry),), self._mark, self._end))
            self._end += len(self._waiting[-1])

    async def _wait_for_commit(self) -> None:
        if self._worker is None:
            return
        failure = await self._worker.call(self._commit)
        if failure is not None and not self._failing:
            self._trouble(f"{self.path.name} cannot be written ({failure.strerror}); its entries wait in memory")
        self._failing = failure is not None

    async def recover(self) -> bool:
        """Return whether the file is at its place; else the whole file is rewritten there. OSError when the disk
        refuses."""
        if self._worker is None:
            return True
        is_back = await self._worker.call(self._refound)
        self.lost = ""
        return is_back

    async def close(self) -> None:
        """Let go of the session, after all notes; may be called twice."""
        await gather(*self._notes)
        if self._worker is not None:
            if self._line is not None:
                with suppress(OSError):
                    await self._worker.call(self._line.call, _KEPT, "close")
            self._worker.close()
            self._worker = None
        self.release()

    def abandon(self) -> None:
        """Close as `close` does, without waiting for a disk that does not answer."""
        if self._worker is not None:
            self._worker.abandon()
            self._worker = None
        self.release()

    def release(self) -> None:
        """Close a journal that was not started."""
        if self._file is not None:
            self._file.close()

    def _commit(self) -> OSError | None:
        """Put what waits on the disk, in the worker thread; on OSError the file is as it was."""
        count = len(self._waiting)
        if not count:
            return None
        data = b"".join(self._waiting[:count])
        try:
            self._call_file("append", data)
        except OSError as error:
            self.lost = str(error.strerror) if isinstance(error, FolderLost) else ""
            return error
        self.lost = ""
        self._acknowledged += data
        del self._waiting[:count]
        return None

    def _refound(self) -> bool:
        return bool(self._call_file("refound", bytes(self._acknowledged)))

    def _call_file(self, method: str, data: bytes) -> object:
        """A method of the file, here or in the disk process, which takes it over before the first."""
        if self._disk is not None and self._file is not None:
            self._file.close()
            self._line = self._disk.line(JOURNAL_LINE)
            self._line.make(_KEPT, take_over, self.path.absolute(), len(self._acknowledged))
            self._file = None
        if self._line is not None:
            return self._line.call(_KEPT, method, data)
        return getattr(self._file, method)(data)


def _lock_and_read(fd: int, path: Path) -> tuple[list[JournalEntry], bytes, bytes, str]:
    """Lock, read, keep a copy when lines are damaged, and cut off what was not acknowledged: the entries, the bytes
    that stay, the file's mark and what is damaged; OSError, SessionError."""
    lock(fd)
    with open(fd, "rb", closefd=False) as file:
        data = file.read()
    lines = parse_lines(data)
    entries = [decode(text) for text in lines.sound]
    damage = ""
    if lines.damaged:
        kept = _keep_damaged_copy(path, data, lines.damaged[-1])
        damage = f"{path.name}: {format_damage(lines)}; {kept.name} is a copy of it"
    if lines.size_bytes < len(data):
        os.ftruncate(fd, lines.size_bytes)
        os.fsync(fd)
    return entries, data[: lines.size_bytes], lines.mark or make_mark(path.absolute().parent.name), damage


def _keep_damaged_copy(path: Path, data: bytes, last_damaged: int) -> Path:
    """A copy of a journal with damaged lines, durably next to it; one that has these lines already will do."""
    damaged = b"\n".join(data.split(b"\n")[:last_damaged])

    def is_it(copy: Path) -> bool:
        return copy.is_file() and copy.read_bytes().startswith(damaged)

    names = (f"{path.name}{_DAMAGED}" if number == 1 else f"{path.name}.{number}{_DAMAGED}" for number in count(1))
    copy = next(copy for copy in map(path.with_name, names) if not copy.exists() or is_it(copy))
    if not copy.exists():
        replace_file(copy, data)
    return copy


def _ignore(text: str) -> None:
    """Do nothing: before `start` there is nothing to report."""


class JournalFile:
    """The open, locked file `path`, of which `size_bytes` are acknowledged. Blocking; used from one thread."""

    def __init__(self, path: Path, fd: int, size_bytes: int) -> None:
        self._path = path
        self._fd = fd
        self._size_bytes = size_bytes

    def append(self, data: bytes) -> None:
        """The lines on the disk; on OSError the file is as it was, FolderLost when it is not at its place any more."""
        if not self._is_in_place():
            raise FolderLost(errno.ENOENT, f"the file {self._path} was removed or renamed while it was written")
        try:
            if os.pwrite(self._fd, data, self._size_bytes) < len(data):
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))  # a part of it fitted
            os.fdatasync(self._fd)
        except OSError:
            with suppress(OSError):
                os.ftruncate(self._fd, self._size_bytes)
            raise
        self._size_bytes += len(data)

    def refound(self, data: bytes) -> bool:
        """Return whether the file is at its place again; else one with all the lines, `data`, is made there."""
        if self._is_in_place():
            return True
        part = self._path.with_name(f".{self._path.name}.{os.getpid()}.part")
        fd = os.open(part, os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_CLOEXEC, 0o644)
        try:
            lock(fd)
            if os.pwrite(fd, data, 0) < len(data):
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            os.fsync(fd)
            os.replace(part, self._path)
            sync_folder(self._path.parent)
        except OSError:
            os.close(fd)
            with suppress(OSError):
                part.unlink()
            raise
        self.close()
        self._fd, self._size_bytes = fd, len(data)
        return False

    def close(self) -> None:
        """Unlock and close; may be called twice."""
        fd, self._fd = self._fd, -1
        if fd >= 0:
            os.close(fd)

    def _is_in_place(self) -> bool:
        try:
            return os.path.samestat(self._path.stat(), os.fstat(self._fd))
        except (FileNotFoundError, NotADirectoryError):
            return False


def take_over(path: Path, size_bytes: int) -> JournalFile:
    """The journal that another process has begun or read, and has just unlocked; OSError."""
    fd = os.open(path, os.O_RDWR | os.O_CLOEXEC)
    try:
        lock(fd)
    except OSError:
        os.close(fd)
        raise
    return JournalFile(path, fd, size_bytes)


class Logbook:
    """`state` is what the entries so far make of a run; from `begin` on those that are to outlive the daemon are in the
    journal, too."""

    def __init__(self, hub: Hub, clock: Clock, state: RunState) -> None:
        self.state = state
        self._hub = hub
        self._clock = clock
        self._journal: Journal | None = None

    async def begin(self, journal: Journal, *entries: JournalEntry, disk: DiskProcess | None = None) -> None:
        """The journal's first entries of this run, on the disk when this returns; `disk` writes it."""
        self._journal = journal
        journal.start(self._clock, lambda text: self.tell(JOURNAL_NOT_SAVED, text), disk)
        await self.write(*entries)

    async def end(self, ended: Ended, deadline: ShutdownDeadline) -> None:
        """The journal's last entry, at this instant; SessionError when the disk does not take it in time, or so long
        as `deadline` lasts."""
        journal = self._journal
        if journal is None:
            return
        within_s = _COMPLETE_WITHIN_S if ended.status == "complete" else _END_WITHIN_S
        ending = create_task(self._end(journal, Ended(self._clock.now_ns(), ended.status, ended.text)))
        if not await deadline.wait(ending, within_s):
            journal.abandon()
            with suppress(TimeoutError):  # as all that waited for the journal
                await ending
            text = "the disk has not answered in time; how the run ended is not in the journal"
            raise SessionError(f"{journal.path}: {text}")
        await ending

    async def _end(self, journal: Journal, ended: Ended) -> None:
        await self.write(ended)
        await journal.close()

    def enter(self, entry: Entry) -> None:
        """Enter into the state alone what the recording proves, or the next gap makes void."""
        self.state = apply_entry(self.state, entry)

    async def write(self, *entries: JournalEntry) -> None:
        """Enter it into the state at once; it is on the disk when this returns, or kept for the next time."""
        for entry in entries:
            self.enter(entry)
        if self._journal is not None:
            await self._journal.write(*entries)

    def tell(self, kind: EventKind, text: str = "", /, **data: object) -> None:
        """An event, now."""
        self._hub.publish(kind.at(self._clock.now_ns(), text, **data))

    def tripped(self, fault: Fault) -> None:
        """The guard makes the stand safe; it publishes that itself."""
        self._note(Tripped(self._clock.now_ns(), fault.rule, fault.text))

    def note_hold(self, reason: str, held: bool) -> None:
        """A listener of the gate; the end of a run is published separately."""
        if reason == STOPPING:
            return
        self.tell(HELD if held else RELEASED, REASON_TEXTS.get(reason, reason), reason=reason)
        now_ns = self._clock.now_ns()
        if reason == INTERLOCK and not held:
            self._note(Reset(now_ns))
        self._note(Held(now_ns, reason, held))

    def _note(self, entry: JournalEntry) -> None:
        self.enter(entry)
        if self._journal is not None:
            self._journal.note(entry)
