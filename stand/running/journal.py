"""What a run has done, durable: `journal.jsonl` in the session's folder, from which a killed run goes on.

Append-only, one entry a line (recording/reading/journal_lines.py). A line is on the disk (fdatasync) when `write`
returns. What follows the last sound line is cut off before anything is appended. A damaged line before it stays where
it is, and the lines after it count; of a file with damaged lines a copy is kept as `journal.jsonl.damaged`.

    Begun     the run, its plan and the texts it was made of; the first line and no other
    Step      a step was started, or is done
    Dwell     what a soak has earned so far
    Held      a reason to wait appeared or went
    Gap       nothing ran between two instants
    Again     steps that were done are to be done again
    Tripped   the guard has made the stand safe, and why
    Cleared   an operator has seen to what had tripped
    Ended     complete, stopped by the operator, tripped, or failed

Instants are ns on the stand's clock, so a run in virtual time has the same journal each time.
"""

from __future__ import annotations

import json
import os
from asyncio import Task, create_task, gather
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict, dataclass
from itertools import count
from pathlib import Path
from typing import Literal, cast

from foundation.clock import Clock
from foundation.errors import SessionError
from foundation.helper import Line
from foundation.lane import Lane
from foundation.sink import sync_folder
from foundation.whole_file import write_whole
from recording.reading.journal_lines import JOURNAL_NAME, LIMIT_BYTES, damage_text, journal_line, lines_of
from recording.writing.disk import JOURNAL_LINE, Disk
from recording.writing.home import FolderLost
from recording.writing.locks import lock
from stand.running.journal_file import JournalFile, taken_over

_DAMAGED = ".damaged"  # the ending of the copy of a journal with damaged lines
_KEPT = "journal"  # its name in the disk process


@dataclass(frozen=True, slots=True)
class Begun:
    """run: the session's name. plan: hash of the steps' ids. texts: hash of each attached text by its name.
    seed: of the simulated laboratory, None when it was the configured one."""

    time_ns: int
    run: str
    plan: str
    texts: dict[str, str]
    seed: int | None = None


@dataclass(frozen=True, slots=True)
class Step:
    """A step of the plan; "done" is written when all it has recorded is on the disk."""

    time_ns: int
    step_id: str
    state: Literal["started", "done"]


@dataclass(frozen=True, slots=True)
class Dwell:
    """A soak has earned `earned_s` of its duration; also after its end, when it has to be earned anew."""

    time_ns: int
    step_id: str
    earned_s: float


@dataclass(frozen=True, slots=True)
class Held:
    """`reason` holds the run from now on, or (`held` false) does not any more."""

    time_ns: int
    reason: str
    held: bool


@dataclass(frozen=True, slots=True)
class Gap:
    """Nothing was recorded, and nobody watched the stand, between these instants."""

    from_ns: int
    time_ns: int


@dataclass(frozen=True, slots=True)
class Again:
    """These steps count as neither begun nor done from now on, and no frame of theirs before counts."""

    time_ns: int
    step_ids: list[str]


@dataclass(frozen=True, slots=True)
class Tripped:
    """The guard has made the stand safe; nothing goes on before an operator has cleared it."""

    time_ns: int
    rule: str
    text: str


@dataclass(frozen=True, slots=True)
class Cleared:
    """An operator has seen to what had tripped."""

    time_ns: int


@dataclass(frozen=True, slots=True)
class Ended:
    """How the run ended, and why. `interrupted` is what journals of format 1 call `stopped`, by the operator."""

    time_ns: int
    status: Literal["complete", "stopped", "tripped", "failed", "interrupted"]
    text: str


Entry = Begun | Step | Dwell | Held | Gap | Again | Tripped | Cleared | Ended
_ENTRIES: dict[str, type[Entry]] = {
    kind.__name__: kind for kind in (Begun, Step, Dwell, Held, Gap, Again, Tripped, Cleared, Ended)
}


def encode_line(entry: Entry) -> bytes:
    """The entry as a line."""
    return journal_line(json.dumps({"entry": type(entry).__name__, **asdict(entry)}).encode())


def read_lines(data: bytes) -> tuple[list[Entry], int]:
    """The entries of all sound lines, and how many bytes there are up to the end of the last one.

    SessionError when a sound line holds an entry that is not known here.
    """
    lines = lines_of(data)
    return [_decoded(text) for text in lines.sound], lines.size_bytes


def _decoded(text: bytes) -> Entry:
    try:
        fields = cast("dict[str, object]", json.loads(text))
        kind = _ENTRIES[cast("str", fields.pop("entry"))]
        return kind(**fields)  # pyright: ignore[reportArgumentType] - a CRC vouches for what was written here
    except (ValueError, LookupError, TypeError, AttributeError, RecursionError) as error:
        raise SessionError(f"{JOURNAL_NAME}: an entry is of another version of thermostand ({text[:80]!r})") from error


class Journal:
    """The journal of one session, locked (flock) while it is open: one daemon per session.

    Lines that the disk refuses are kept and written with the next one; `trouble` is told when that begins. All lines
    are kept in memory: a journal that was removed under its run is written anew when an operator has cleared that.
    """

    def __init__(self, path: Path, fd: int, data: bytes, damage: str = "") -> None:
        self.path = path
        self.damage = damage  # a sentence, when lines of it are damaged
        self.name = path.name
        self.lost = ""
        self._file: JournalFile | None = JournalFile(path, fd, len(data))
        self._line: Line | None = None  # to the disk process, when that has the file
        self._disk: Disk | None = None
        self._acknowledged = bytearray(data)
        self._waiting: list[bytes] = []
        self._failing = False
        self._notes: set[Task[None]] = set()
        self._lane: Lane | None = None
        self._trouble: Callable[[str], None] = _ignored

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
        return cls(path, fd, b"")

    @classmethod
    def open(cls, directory: Path) -> tuple[Journal, list[Entry]]:
        """The journal of a session and the entries of its sound lines, none when not even the first was written; a torn
        tail is cut off. Of a journal with damaged lines a copy is kept, and its `damage` says so.

        SessionError when there is none, or when a daemon is running this session.
        """
        path = directory / JOURNAL_NAME
        try:
            fd = os.open(path, os.O_RDWR | os.O_CLOEXEC)
        except OSError as error:
            raise SessionError(f"{directory}: has no journal of a run ({error.strerror}); begin a new run") from error
        try:
            if not path.is_file():  # nobody may ever write to a pipe of that name
                raise SessionError(f"{path}: is no file, so no journal; begin a new run")
            if path.stat().st_size > LIMIT_BYTES:
                raise SessionError(
                    f"{path}: is larger than {LIMIT_BYTES // 1_000_000} MB, so no journal; begin a new run"
                )
            entries, data, damage = _opened(fd, path)
        except BaseException as error:
            os.close(fd)
            if isinstance(error, BlockingIOError):
                raise SessionError(f"{directory}: {error.strerror}") from error
            if isinstance(error, OSError):
                raise SessionError(f"{path}: cannot be read ({error.strerror})") from error
            raise
        return cls(path, fd, data, damage), entries

    def start(self, clock: Clock, trouble: Callable[[str], None], disk: Disk | None = None) -> None:
        """Before the first `write`: `clock` is held while the disk works, `trouble` takes a sentence, `disk` is the
        process that has the file from then on."""
        self._lane = Lane("journal", clock, patient=False)
        self._trouble = trouble
        self._disk = disk

    async def write(self, *entries: Entry) -> None:
        """The entries on the disk, or kept for the next time."""
        if self._lane is None:
            raise ValueError("a journal is started before it is written")
        self._waiting.extend(map(encode_line, entries))
        failure = await self._lane.call(self._commit)
        if failure is not None and not self._failing:
            self._trouble(f"{self.path.name} cannot be written ({failure.strerror}); its entries wait in memory")
        self._failing = failure is not None

    def note(self, entry: Entry) -> None:
        """As `write`, without waiting for the disk."""
        task = create_task(self.write(entry))
        self._notes.add(task)
        task.add_done_callback(self._notes.discard)

    async def refound(self) -> bool:
        """Whether the file is at its place; else it is written there anew, whole. OSError when the disk refuses."""
        if self._lane is None:
            return True
        is_back = await self._lane.call(self._refound)
        self.lost = ""
        return is_back

    async def close(self) -> None:
        """Let go of the session, after all notes; may be called twice."""
        await gather(*self._notes)
        if self._lane is not None:
            if self._line is not None:
                with suppress(OSError):
                    await self._lane.call(self._line.call, _KEPT, "close")
            self._lane.close()
            self._lane = None
        self.release()

    def abandon(self) -> None:
        """As `close`, without waiting for a disk that does not answer."""
        if self._lane is not None:
            self._lane.abandon()
            self._lane = None
        self.release()

    def release(self) -> None:
        """As `close`, for a journal that was not started."""
        if self._file is not None:
            self._file.close()

    def _commit(self) -> OSError | None:
        """In the lane's thread: what waits on the disk; on OSError the file is as it was."""
        count = len(self._waiting)
        if not count:
            return None
        data = b"".join(self._waiting[:count])
        try:
            self._do("append", data)
        except OSError as error:
            self.lost = str(error.strerror) if isinstance(error, FolderLost) else ""
            return error
        self.lost = ""
        self._acknowledged += data
        del self._waiting[:count]
        return None

    def _refound(self) -> bool:
        return bool(self._do("refound", bytes(self._acknowledged)))

    def _do(self, method: str, data: bytes) -> object:
        """A method of the file, here or in the disk process, which takes it over before the first."""
        if self._disk is not None and self._file is not None:
            self._file.close()
            self._line = self._disk.line(JOURNAL_LINE)
            self._line.make(_KEPT, taken_over, self.path.absolute(), len(self._acknowledged))
            self._file = None
        if self._line is not None:
            return self._line.call(_KEPT, method, data)
        return getattr(self._file, method)(data)


def _opened(fd: int, path: Path) -> tuple[list[Entry], bytes, str]:
    """Lock, read, keep a copy when lines are damaged, and cut off what was not acknowledged: the entries, the bytes
    that stay and what is damaged; OSError, SessionError."""
    lock(fd)
    with open(fd, "rb", closefd=False) as file:
        data = file.read()
    lines = lines_of(data)
    entries = [_decoded(text) for text in lines.sound]
    damage = ""
    if lines.damaged:
        kept = _kept(path, data, lines.damaged[-1])
        damage = f"{path.name}: {damage_text(lines)}; {kept.name} is a copy of it"
    if lines.size_bytes < len(data):
        os.ftruncate(fd, lines.size_bytes)
        os.fsync(fd)
    return entries, data[: lines.size_bytes], damage


def _kept(path: Path, data: bytes, last_damaged: int) -> Path:
    """A copy of a journal with damaged lines, durably beside it; one that has these lines already will do."""
    damaged = b"\n".join(data.split(b"\n")[:last_damaged])

    def is_it(copy: Path) -> bool:
        return copy.is_file() and copy.read_bytes().startswith(damaged)

    names = (f"{path.name}{_DAMAGED}" if number == 1 else f"{path.name}.{number}{_DAMAGED}" for number in count(1))
    copy = next(copy for copy in map(path.with_name, names) if not copy.exists() or is_it(copy))
    if not copy.exists():
        write_whole(copy, data)
    return copy


def _ignored(text: str) -> None:
    """Before `start` there is nothing to tell."""
