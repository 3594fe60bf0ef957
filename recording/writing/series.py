"""The segments of one folder, one after the other; the two such series of a session, and the daemon's end of each."""

from __future__ import annotations

import re
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

from thermostand.foundation.files import make_durable_folder, sync_folder
from thermostand.foundation.items import Event
from thermostand.recording.format.inventory import find_foreign_numbers
from thermostand.recording.format.layout import FRAMES, TELEMETRY, TEMPORARY
from thermostand.recording.format.manifest import Sealed
from thermostand.recording.writing.disk import FRAMES_LINE, TELEMETRY_LINE, DiskProcess
from thermostand.recording.writing.folder_watch import WatchedFolder
from thermostand.recording.writing.manifest_file import ManifestFile
from thermostand.recording.writing.notices import SpaceWatch
from thermostand.recording.writing.segment import CommitSink, MessageRecord, Segment, SeriesSpec
from thermostand.recording.writing.session_spec import SessionSpec

Item = TypeVar("Item")

_KEPT = "series"  # the name of the SessionSeries in the disk process


class Series:
    """The segments of one folder, one open at a time. Blocking; used from one thread.

    The folder is made when there is none, and never again but by `refound`: when it is removed or renamed, every write
    raises FolderLost.
    """

    def __init__(self, folder: Path, form: SeriesSpec, seal: Callable[[str, Sealed], None] | None = None) -> None:
        self._folder = folder
        self._form = form
        self._seal = seal or _ignore_sealed  # called with each finished segment
        self._home = WatchedFolder(folder)
        self._used = -1  # the highest number that a message was committed under; it is never used again
        self._segment: Segment | None = None
        self._failed: Segment | None = None  # given up, but not yet cut back to what was acknowledged
        self.troubles: deque[str] = deque()  # errors that were overcome, as sentences; another thread may take them

    @property
    def is_open(self) -> bool:
        """Whether there is an open segment."""
        return self._segment is not None

    @property
    def reserved_bytes(self) -> int:
        """What the open segment has reserved and not yet used; any thread may ask."""
        segment = self._segment
        return 0 if segment is None else segment.reserved_bytes

    def open(self, time_ns: int) -> Segment:
        """The open segment, begun when there is none; raises OSError.

        None is begun while the one before still holds a block that was refused: it would be in both.
        """
        if self._segment is None:
            self._home.check()
            self._let_go()
            number = max(find_next_number(self._folder), self._used + 1)
            self._segment = Segment(self._folder, number, self._form, time_ns)
        return self._segment

    def commit(self, records: Sequence[MessageRecord], time_ns: int) -> None:
        """All of `records` on the disk when this returns, in a new segment when the present one is full or fails;
        OSError when the new one fails, too; FolderLost before anything is written. `time_ns` (now) decides whether a
        segment is old enough to be closed."""
        self._home.check()
        self.finish_full(time_ns)
        segment = self.open(time_ns)
        try:
            self._commit(segment, records)
        except OSError:
            self._commit(self.open(time_ns), records)

    def _commit(self, segment: Segment, records: Sequence[MessageRecord]) -> None:
        try:
            segment.commit(records)
        except OSError as error:
            self._give_up(segment, error)
            raise
        self._used = max(self._used, segment.number)

    def _give_up(self, segment: Segment, error: OSError) -> None:
        if not segment.is_empty:  # else nothing is left behind that anybody would miss
            self.troubles.append(f"a segment of {self._form.name} was given up ({error})")
        self._failed, self._segment = segment, None
        with suppress(OSError):  # tried again before the next segment
            self._let_go()

    def _let_go(self) -> None:
        """Cut the segment that failed back and close it; OSError while the disk does not allow it."""
        if self._failed is not None:
            self._failed.abandon()
            self._failed = None

    def check(self) -> None:
        """FolderLost when the folder has been removed or renamed; any OSError when it cannot be asked."""
        self._home.check()

    def probe(self, size_bytes: int, time_ns: int) -> None:
        """OSError while the disk would refuse a segment, or a block of that size; nothing of it stays."""
        self._home.check()
        path = self._folder / f"probe{TEMPORARY}"  # the next salvage removes it when this process is killed meanwhile
        path.unlink(missing_ok=True)
        try:
            with closing(CommitSink(path)) as sink:
                sink.append([bytes(size_bytes)])
                segment = self.open(time_ns)
                if segment.is_empty:
                    self._segment = None
                    segment.abandon()
        finally:
            path.unlink(missing_ok=True)

    def recover(self) -> bool:
        """Return, after a FolderLost, whether the folder is back, and writing continues where it was; else one is made
        at its place, and the numbers continue. OSError when that cannot be done."""
        if self._home.recover():
            return True
        segment, self._segment = self._segment, None
        self._close(segment)
        return False

    def close(self) -> None:
        """Let go of the folder, after `finish`."""
        self._home.close()

    def finish_full(self, time_ns: int) -> None:
        """Close the open segment when it has its size or age."""
        segment, form = self._segment, self._form
        if segment is None:
            return
        if segment.committed_bytes >= form.segment_bytes or time_ns - segment.begun_ns >= form.segment_ns:
            self.finish()

    def finish(self) -> bool:
        """Close the open segment, if any; False when it cannot be finished: it stays `.part`, and that is a trouble."""
        segment, self._segment = self._segment, None
        try:
            self._let_go()
            if segment is not None:
                self._seal(segment.name, segment.finish())
        except OSError as error:
            self.troubles.append(f"a segment of {self._form.name} stays unfinished ({error})")
            self._close(segment)
            return False
        return True

    def _close(self, unfinished: Segment | None) -> None:
        """The last try to cut back what failed, then close it as it is: nothing of it is written elsewhere later."""
        failed, self._failed = self._failed, None
        for segment in (failed, unfinished):
            if segment is not None:
                with suppress(OSError):
                    segment.abandon()
                segment.close()


def _ignore_sealed(name: str, sealed: Sealed) -> None:
    """Do nothing: the series has no session around it."""


def find_next_number(folder: Path) -> int:
    """The number after the highest segment in `folder`, finished or not, damaged or half copied; 0 in an empty one. A
    file that was put there under a number far outside does not count."""
    numbers = [int(match[1]) for path in folder.iterdir() if (match := re.match(r"(\d{4,})\.mcap", path.name))]
    return max(set(numbers) - find_foreign_numbers(numbers), default=-1) + 1


@dataclass(frozen=True, slots=True)
class SeriesReply:
    """What a call of a series came to; `error` next to the rest, for troubles are reported also when it failed."""

    result: object
    error: OSError | None
    is_open: bool
    troubles: tuple[str, ...]


class SpaceFound(NamedTuple):
    """What a look at the disk found; see SpaceWatch."""

    frames_stopped: bool = False
    stop_reason: str = ""
    free_bytes: int = 0
    notices: tuple[Event, ...] = ()


class SessionSeries:
    """The two series of a session, made or continued in `directory`, and the watch over their disk; the telemetry is
    begun. Blocking; raises OSError. Each series is used from one thread, the watch from both."""

    def __init__(self, directory: Path, form: SessionSpec, time_ns: int) -> None:
        for name in (FRAMES, TELEMETRY):
            make_durable_folder(directory / name)
        sync_folder(directory)
        sync_folder(directory.parent)
        self._manifest = ManifestFile(directory, form.make_manifest())
        frames = Series(directory / FRAMES, form.frames(), self._manifest.seal)
        telemetry = Series(directory / TELEMETRY, form.make_telemetry_spec(), self._manifest.seal)
        self._series = {FRAMES: frames, TELEMETRY: telemetry}
        self._notices: deque[Event] = deque()
        stop, alert = form.settings.stop_frames_below_bytes, form.settings.alert_below_fraction
        self._space = SpaceWatch(directory, stop, alert, lambda: frames.reserved_bytes, self._notices.append)
        telemetry.open(time_ns)

    def do(self, name: str, method: str, *args: object) -> SeriesReply:
        """A method of one series."""
        series, result, failure = self._series[name], None, None
        try:
            result = getattr(series, method)(*args)
        except OSError as error:
            failure = error
        return SeriesReply(result, failure, series.is_open, _drain(series.troubles))

    def plan(self, size: Mapping[str, int]) -> None:
        """State how many `steps` and `frames` the plan has."""
        self._manifest.plan(size)

    def end(self) -> None:
        """Everything that was recorded is in finished segments: the manifest says so, with the journal as it is now."""
        self._manifest.end()

    def check_space(self) -> SpaceFound:
        """A look at the disk."""
        space = self._space
        space.check()
        return SpaceFound(space.frames_stopped, space.stop_reason, space.free_bytes, _drain(self._notices))


def _drain(waiting: deque[Item]) -> tuple[Item, ...]:
    """All that waits; more may come, and another thread take some, meanwhile."""
    taken: list[Item] = []
    with suppress(IndexError):
        while True:
            taken.append(waiting.popleft())
    return tuple(taken)


class DiskSpace:
    """What the last look at the disk found, whichever series asked; `tell` takes its notices."""

    def __init__(self, tell: Callable[[Event], None]) -> None:
        self.last = SpaceFound()
        self._tell = tell

    def found(self, space: SpaceFound) -> None:
        """Keep the free space as of now, and pass its notices on."""
        self.last = space
        for notice in space.notices:
            self._tell(notice)


class DiskSeries:
    """One series of a session, in the disk process or in this one: a line for each, so that one that hangs leaves the
    other. Its methods are those of Series. `ask` calls a method of the SessionSeries."""

    def __init__(self, name: str, ask: Callable[..., Any], space: DiskSpace) -> None:
        self.is_open = False
        self.troubles: deque[str] = deque()
        self.space = space
        self._name = name
        self._ask = ask

    def check_space(self) -> None:
        """See SpaceWatch.check."""
        self.space.found(self._ask("check_space"))

    def check(self) -> None:
        """Check the disk as Series.check does; all methods below are those of Series, too."""
        self._do("check")

    def commit(self, records: Sequence[MessageRecord], time_ns: int) -> None:
        """All of `records` on the disk."""
        self._do("commit", list(records), time_ns)

    def probe(self, size_bytes: int, time_ns: int) -> None:
        """OSError while the disk would refuse a block."""
        self._do("probe", size_bytes, time_ns)

    def recover(self) -> bool:
        """Return whether the folder is back."""
        return bool(self._do("recover"))

    def finish_full(self, time_ns: int) -> None:
        """Close a segment that has its size or age."""
        if self.is_open:
            self._do("finish_full", time_ns)

    def finish(self) -> bool:
        """Close the open segment; False, and a trouble, also when the process has ended."""
        try:
            return bool(self._do("finish"))
        except OSError as error:
            self.is_open = False
            self.troubles.append(f"a segment of {self._name} stays unfinished ({error})")
            return False

    def plan(self, size: Mapping[str, int]) -> None:
        """See SessionSeries.plan; a process that has ended writes nothing."""
        with suppress(OSError):
            self._ask("plan", dict(size))

    def end(self) -> None:
        """See SessionSeries.end."""
        with suppress(OSError):
            self._ask("end")

    def close(self) -> None:
        """Let go of the folder; a process that has ended has."""
        with suppress(OSError):
            self._do("close")

    def _do(self, method: str, *args: object) -> object:
        done: SeriesReply = self._ask("do", self._name, method, *args)
        self.is_open = done.is_open
        self.troubles.extend(done.troubles)
        if done.error is not None:
            raise done.error
        return done.result


def open_series(
    disk: DiskProcess | None, directory: Path, form: SessionSpec, time_ns: int, tell: Callable[[Event], None]
) -> tuple[DiskSeries, DiskSeries]:
    """Frames and telemetry of a session, made or continued; raises OSError. disk: the process that has them, None: this
    one."""
    space = DiskSpace(tell)
    if disk is None:
        both = SessionSeries(directory, form, time_ns)
        asks: list[Callable[..., Any]] = [partial(_call_method, both)] * 2
    else:
        lines = disk.line(FRAMES_LINE), disk.line(TELEMETRY_LINE)
        lines[1].make(_KEPT, SessionSeries, directory.absolute(), form, time_ns)
        asks = [partial(line.call, _KEPT) for line in lines]
    return DiskSeries(FRAMES, asks[0], space), DiskSeries(TELEMETRY, asks[1], space)


def _call_method(series: SessionSeries, method: str, *args: object) -> Any:
    return getattr(series, method)(*args)
