"""The two series of a session and the watch over their disk: here, or in a process of their own."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from foundation.files import sync_folder
from foundation.helper import Line
from recording.format.layout import FRAMES, TELEMETRY
from recording.writing.disk import FRAMES_LINE, TELEMETRY_LINE, Disk
from recording.writing.forms import SessionForm
from recording.writing.notices import Notice, SpaceWatch
from recording.writing.segment import Record
from recording.writing.series import Series
from recording.writing.writers import SeriesFace, SpaceFace

_NAME = "store"

Waiting = TypeVar("Waiting")


class Store:
    """Both series, made or continued in `directory`; the telemetry is begun. Blocking; raises OSError."""

    def __init__(self, directory: Path, form: SessionForm, time_ns: int, tell: Callable[[Notice], None]) -> None:
        for name in (FRAMES, TELEMETRY):
            (directory / name).mkdir(parents=True, exist_ok=True)
        sync_folder(directory)
        sync_folder(directory.parent)
        frames, telemetry = Series(directory / FRAMES, form.frames()), Series(directory / TELEMETRY, form.telemetry())
        self.frames: SeriesFace = frames
        self.telemetry: SeriesFace = telemetry
        settings = form.settings
        self.space: SpaceFace = SpaceWatch(
            directory,
            settings.stop_frames_below_bytes,
            settings.alert_below_fraction,
            lambda: frames.reserved_bytes,
            tell,
        )
        self.telemetry_space = self.space  # the same, for the writer of telemetry
        telemetry.open(time_ns)


@dataclass(frozen=True, slots=True)
class _Done:
    """What a call of a series came to; `error` beside the rest, for troubles are reported also when it failed."""

    result: object
    error: OSError | None
    is_open: bool
    troubles: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class _SpaceFound:
    frames_stopped: bool
    stop_reason: str
    free_bytes: int
    notices: tuple[Notice, ...]


class Served:
    """A Store in the disk process, as its lines call it."""

    def __init__(self, directory: Path, form: SessionForm, time_ns: int) -> None:
        self._notices: deque[Notice] = deque()
        store = Store(directory, form, time_ns, self._notices.append)
        self._series = {FRAMES: store.frames, TELEMETRY: store.telemetry}
        self._space = store.space

    def do(self, name: str, method: str, *args: object) -> _Done:
        """A method of one series."""
        series, result, failure = self._series[name], None, None
        try:
            result = getattr(series, method)(*args)
        except OSError as error:
            failure = error
        return _Done(result, failure, series.is_open, _taken(series.troubles))

    def check_space(self) -> _SpaceFound:
        """A look at the disk."""
        space = self._space
        space.check()
        return _SpaceFound(space.frames_stopped, space.stop_reason, space.free_bytes, _taken(self._notices))


class RemoteStore:
    """As Store, in the disk process: a line for each series, so that one that hangs leaves the other."""

    def __init__(
        self, disk: Disk, directory: Path, form: SessionForm, time_ns: int, tell: Callable[[Notice], None]
    ) -> None:
        frames, telemetry = disk.line(FRAMES_LINE), disk.line(TELEMETRY_LINE)
        telemetry.make(_NAME, Served, directory.absolute(), form, time_ns)
        found = _Found(tell)
        self.frames: SeriesFace = _RemoteSeries(frames, FRAMES)
        self.telemetry: SeriesFace = _RemoteSeries(telemetry, TELEMETRY)
        self.space: SpaceFace = _RemoteSpace(frames, found)
        self.telemetry_space: SpaceFace = _RemoteSpace(telemetry, found)


class _RemoteSeries:
    def __init__(self, line: Line, name: str) -> None:
        self._line = line
        self._name = name
        self.is_open = False
        self.troubles: deque[str] = deque()

    def check(self) -> None:
        self._do("check")

    def commit(self, records: Sequence[Record], time_ns: int) -> None:
        self._do("commit", list(records), time_ns)

    def probe(self, size_bytes: int, time_ns: int) -> None:
        self._do("probe", size_bytes, time_ns)

    def refound(self) -> bool:
        return bool(self._do("refound"))

    def finish_full(self, time_ns: int) -> None:
        if self.is_open:
            self._do("finish_full", time_ns)

    def finish(self) -> bool:
        try:
            return bool(self._do("finish"))
        except OSError as error:
            self.is_open = False
            self.troubles.append(f"a segment of {self._name} stays unfinished ({error})")
            return False

    def close(self) -> None:
        """The disk process lets go of the folder when it ends."""

    def _do(self, method: str, *args: object) -> object:
        done: _Done = self._line.call(_NAME, "do", self._name, method, *args)
        self.is_open = done.is_open
        self.troubles.extend(done.troubles)
        if done.error is not None:
            raise done.error
        return done.result


class _Found:
    """What the last look at the disk found, for both lines."""

    def __init__(self, tell: Callable[[Notice], None]) -> None:
        self.last = _SpaceFound(frames_stopped=False, stop_reason="", free_bytes=0, notices=())
        self.tell = tell


class _RemoteSpace:
    def __init__(self, line: Line, found: _Found) -> None:
        self._line = line
        self._found = found

    @property
    def frames_stopped(self) -> bool:
        return self._found.last.frames_stopped

    @property
    def stop_reason(self) -> str:
        return self._found.last.stop_reason

    @property
    def free_bytes(self) -> int:
        return self._found.last.free_bytes

    def check(self) -> None:
        self._found.last = found = self._line.call(_NAME, "check_space")
        for notice in found.notices:
            self._found.tell(notice)


def _taken(waiting: deque[Waiting]) -> tuple[Waiting, ...]:
    """All that waits; more may come meanwhile."""
    return tuple(waiting.popleft() for _ in range(len(waiting)))
