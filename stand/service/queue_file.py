"""The file of a queue of runs, `queue.json` in the recording directory, and its locks.

The file is replaced as a whole, and then what it was before is put next to it as `queue.json.last`: two that are the
same are a change that the disk has lost. `.queue.lock` is locked
(flock) while it is read or changed, `.queue.worker` as long as a process runs the queue: a run that is marked as
running when none does was interrupted.
"""

from __future__ import annotations

import fcntl
import os
from collections.abc import Generator
from contextlib import ExitStack, contextmanager, suppress
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Literal

from pydantic import AfterValidator, Field, ValidationError

from thermostand.foundation.document_faults import format_path
from thermostand.foundation.documents import Document
from thermostand.foundation.errors import NotFound, SessionError
from thermostand.foundation.files import replace_file
from thermostand.foundation.sealed import seal, unseal

QUEUE_NAME = "queue.json"
LAST_NAME = "queue.json.last"
KEPT_ENDED = 100
"""So many of the runs that have ended stay in the file, the latest: with its three texts a run has 9 kB, and the whole
file is written at each change. What was run stays in its session."""
_KIND = "queue"
_LOCK_NAME = ".queue.lock"
_WORKER_NAME = ".queue.worker"
_REMEDY = (
    f"{LAST_NAME} in the same folder is the queue before its last change: rename it to {QUEUE_NAME}, or move both away"
)


class QueueState(StrEnum):
    """Where a queued run is. Waiting and interrupted ones are still to be done, the interrupted one first. An operator
    who stops a run of a daemon ends it: it is resumed only when asked for."""

    WAITING = "waiting"
    RUNNING = "running"
    DONE = "done"
    FAILED = "failed"
    STOPPED = "stopped"
    INTERRUPTED = "interrupted"


def _check_folder_name(name: str) -> str:
    """A session's folder must be in the recording directory."""
    if name in (".", "..") or "/" in name or "\\" in name or not name.isprintable() or len(name.encode()) > 255:
        raise ValueError("expected the name of a folder in the recording directory")
    return name


class QueueEntry(Document):
    """One run. The texts are those of the files when it was added: a later edit does not change what is queued.

    config: the file its text is from, for messages. Instants are ns since the epoch on the host's clock. session: the
    name of its folder in the recording directory, "" before it has one. reason: why it did not come to its end.
    fruitless_starts: how often in a row it was begun or resumed without finishing one more step. key, request: the
    word of who asked for it, so that asking again adds nothing, and what was asked. added_by: who that was. attended:
    somebody is there to do what the plan prompts for. note, tags: of its session, once it has one.
    """

    id: int = Field(ge=1)
    recipe: str
    config: str
    config_text: str
    recipe_text: str
    target_text: str
    state: QueueState = QueueState.WAITING
    added_ns: int
    began_ns: int | None = None
    ended_ns: int | None = None
    session: Annotated[str, AfterValidator(_check_folder_name)] = ""
    reason: str = ""
    fruitless_starts: int = Field(default=0, ge=0)
    key: str = ""
    request: str = ""
    added_by: str = ""
    attended: bool = False
    note: str = ""
    tags: tuple[str, ...] = ()

    @property
    def is_open(self) -> bool:
        """Whether it is still to be done."""
        return self.state in (QueueState.WAITING, QueueState.INTERRUPTED)


class Queue(Document):
    """The whole file. entries: what has ended, then the running one, then what is to be done in its order.

    next_id: no number is given twice. changes: how often it was changed, so that no two states are the same.
    halted: why nothing is begun until an operator says so, "" when it may be.
    """

    version: Literal[1] = 1
    next_id: int = Field(default=1, ge=1)
    changes: int = Field(default=0, ge=0)
    halted: str = ""
    entries: tuple[QueueEntry, ...] = ()


class QueueDraft:
    """A queue that is being changed; `queue` is written when the block ends well."""

    def __init__(self, queue: Queue) -> None:
        self.queue = queue

    def entry(self, number: int) -> QueueEntry:
        """The entry of this number; SessionError when there is none."""
        for entry in self.queue.entries:
            if entry.id == number:
                return entry
        raise SessionError(f"no run {number} in the queue; `stand queue list` shows those there are")

    def put(self, entry: QueueEntry) -> None:
        """Replace the entry of the same number."""
        self.set(entries=tuple(entry if old.id == entry.id else old for old in self.queue.entries))

    def set(self, **changes: object) -> None:
        """Set other fields of the queue."""
        self.queue = self.queue.model_copy(update=changes)


def read_queue(directory: Path) -> Queue:
    """The queue of a recording directory, an empty one when there is none; SessionError when it cannot be read."""
    if not any((directory / name).exists() for name in (QUEUE_NAME, LAST_NAME)):
        return Queue()
    with _lock(directory):
        return _settle(directory, _load(directory))


@contextmanager
def change_queue(directory: Path) -> Generator[QueueDraft]:
    """Change the queue, under its lock: all of the change is on the disk at the end, or nothing."""
    with _lock(directory):
        before = _load(directory)
        draft = QueueDraft(_settle(directory, before))
        yield draft
        if draft.queue != before:
            _store(directory, _prune(draft.queue))


@contextmanager
def lock_worker(directory: Path) -> Generator[None]:
    """Run this queue alone; SessionError when another process does. What the last one had under way is
    interrupted from now on."""
    with _open(directory / _WORKER_NAME) as worker:
        with _lock(directory):  # a check whether the queue is being run takes the same lock
            if not _try_lock(worker):
                raise SessionError(f"{directory}: another process is running its queue already")
            found = _load(directory)
            if _has_running(found):
                _store(directory, _interrupt(found))
        yield


def start_working(directory: Path) -> ExitStack:
    """`working` until what is returned is closed, or its process ends."""
    stack = ExitStack()
    stack.enter_context(lock_worker(directory))
    return stack


def _prune(queue: Queue) -> Queue:
    """Drop all but the latest of the runs that have ended."""
    ended = [entry.id for entry in queue.entries if not entry.is_open and entry.state is not QueueState.RUNNING]
    old = frozenset(ended[:-KEPT_ENDED])
    return queue.model_copy(update={"entries": tuple(entry for entry in queue.entries if entry.id not in old)})


def _settle(directory: Path, queue: Queue) -> Queue:
    """A run marked as running while no process runs the queue was interrupted."""
    if not _has_running(queue):
        return queue
    with _open(directory / _WORKER_NAME) as worker:
        return _interrupt(queue) if _try_lock(worker) else queue


def _has_running(queue: Queue) -> bool:
    return any(entry.state is QueueState.RUNNING for entry in queue.entries)


def _interrupt(queue: Queue) -> Queue:
    cut = {"state": QueueState.INTERRUPTED, "reason": "its daemon was killed"}
    entries = (entry.model_copy(update=cut) if entry.state is QueueState.RUNNING else entry for entry in queue.entries)
    return queue.model_copy(update={"entries": tuple(entries)})


def _load(directory: Path) -> Queue:
    path, last = directory / QUEUE_NAME, directory / LAST_NAME
    try:
        data = path.read_bytes()
        if last.is_file() and last.read_bytes() == data:
            raise SessionError(
                f"{path}: the disk has lost its last change; look at what is queued, then remove {LAST_NAME} next to it"
            )
        return Queue.model_validate_json(unseal(_KIND, data))
    except FileNotFoundError:
        if not last.exists():
            return Queue()
        raise SessionError(f"{path}: is missing; {_REMEDY}") from None
    except OSError as error:
        raise SessionError(f"{path}: cannot be read ({error.strerror})") from error
    except ValueError as error:
        raise SessionError(f"{path}: is damaged ({_describe_first_fault(error)}); {_REMEDY}") from error


def _describe_first_fault(error: ValueError) -> str:
    if not isinstance(error, ValidationError):
        return str(error)
    fault = error.errors()[0]
    where = format_path(fault["loc"])
    return f"{where}: {fault['msg']}" if where else fault["msg"]


def _store(directory: Path, queue: Queue) -> None:
    path = directory / QUEUE_NAME
    try:
        before = path.read_bytes() if path.exists() else None
        queue = queue.model_copy(update={"changes": queue.changes + 1})
        replace_file(path, seal(_KIND, queue.model_dump_json(indent=1)))
    except OSError as error:
        raise SessionError(f"{path}: cannot be written ({error.strerror}); the queue is as it was") from error
    if before is not None:
        with suppress(OSError):  # an older state is there, or none
            replace_file(directory / LAST_NAME, before)


@contextmanager
def _lock(directory: Path) -> Generator[None]:
    with _open(directory / _LOCK_NAME) as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield


@contextmanager
def _open(path: Path) -> Generator[int]:
    try:
        file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
    except FileNotFoundError as error:
        raise NotFound(f"{path.parent}: no such folder; `stand serve` makes it") from error
    except OSError as error:
        raise SessionError(f"{path.parent}: its queue cannot be locked ({error.strerror})") from error
    try:
        yield file
    finally:
        os.close(file)


def _try_lock(file: int) -> bool:
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True
