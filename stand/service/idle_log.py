"""The daemon's own record between runs: one session a day, `20261122-idle-log`, begun at local midnight.

What is done by hand is recorded as in a run, and heat depends on it in the same way. While a run records, the
daemon does not, but for the moments in which one takes over from the other: each instant is in a session. Old ones are
removed (`recording.idle_log_days`), but none that has a note or a tag.
"""

from __future__ import annotations

import asyncio
import itertools
import os
import re
import shutil
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path

from thermostand.foundation.clock import NS_PER_S, WallClock
from thermostand.foundation.errors import SessionError
from thermostand.foundation.events import IDLE_LOGS_REMOVED, RUN_END
from thermostand.foundation.hub import Hub, Subscriber
from thermostand.foundation.items import Item
from thermostand.foundation.shutdown_deadline import ShutdownDeadline
from thermostand.foundation.tasks import cancel_all
from thermostand.foundation.workers import WorkerThread
from thermostand.recording.exporting.archive import DELETED
from thermostand.recording.format.manifest import SessionInfo
from thermostand.recording.reading.notes import read_notes
from thermostand.recording.reading.run_status import RunOutcome
from thermostand.recording.reading.session import Session
from thermostand.recording.writing.disk import DiskProcess
from thermostand.recording.writing.recorder import COMPLETE_WITHIN_S, Recorder
from thermostand.stand.assembly.assemble import Assembly
from thermostand.stand.running.session_files import make_recorder, make_session_info, publish_identities

BETWEEN_RUNS = "idle-log"  # in place of a recipe's name
_NAME = re.compile(rf"([0-9]{{8}})-{BETWEEN_RUNS}(-[0-9]+)?")


@dataclass(frozen=True, slots=True)
class _Recording:
    """One session, its recorder at work."""

    recorder: Recorder
    tap: _Tap
    disk: DiskProcess
    task: asyncio.Task[None]

    async def complete(self, within_s: float, deadline: ShutdownDeadline) -> None:
        """SessionError when the disk does not take the rest in time."""
        try:
            await cancel_all([self.task])
            await self.recorder.finish(within_s, deadline)
        finally:
            await self.disk.end_within(deadline)


class IdleLog:
    """Records what passes the hub from `begin` to `end`, as often as wanted; of one day all is in one session. texts:
    attached, by their names there. shutdown_deadline: of a daemon that leaves, with its disk."""

    def __init__(
        self, assembly: Assembly, texts: Mapping[str, str], out: Path, clock: WallClock, deadline: ShutdownDeadline
    ) -> None:
        self._assembly = assembly
        self._texts = dict(texts)
        self._out = out
        self._clock = clock
        self._deadline = deadline
        self._now: _Recording | None = None
        self._cut_off: list[_Recording] = []  # they take nothing any more, and are not complete yet
        self._day = ""
        self._removal: asyncio.Task[None] | None = None
        self._turn = asyncio.Lock()
        self._lane = WorkerThread("day-record", clock, patient=False)  # for a disk that may hang
        self._removing = WorkerThread("idle-logs", clock, patient=False)  # a long removal keeps no record waiting

    @property
    def recorder(self) -> Recorder | None:
        """The recorder of the record under way."""
        return None if self._now is None else self._now.recorder

    def is_of_today(self) -> bool:
        """Return whether midnight has not passed since it was begun."""
        return self._day == self._get_today()

    async def begin(self) -> Recorder:
        """The record of today. That of the day before is cut off in the same moment, so that each item is in one of
        both, and `complete` completes it. SessionError when the disk refuses; that of the day before then goes on."""
        async with self._turn:
            return await self._begin()

    async def get_current(self) -> Recorder:
        """The record under way, which is begun where there is none. As `begin`."""
        async with self._turn:
            return self.recorder or await self._begin()

    async def _begin(self) -> Recorder:
        day = self._get_today()
        info = await self._lane.call(self._find_session, day)
        directory = self._out / info.session_id
        tap, disk = _Tap(self._assembly.hub), DiskProcess()
        recorder = make_recorder(directory, info, self._texts, self._assembly.config, tap, self._clock, disk=disk)
        try:
            await recorder.begin(tuple)
        except BaseException:
            await disk.end_within(self._deadline)
            raise
        self._cut_off_recording()
        self._day = day
        self._now = _Recording(recorder, tap, disk, asyncio.create_task(recorder.run()))
        publish_identities(self._assembly, tap.give)  # a run that is still completed has published them
        self._removal = asyncio.create_task(self._remove_old())
        return recorder

    async def complete(self, within_s: float = COMPLETE_WITHIN_S) -> None:
        """Complete the segments of what was cut off; SessionError when the disk does not take them in time."""
        async with self._turn:
            while self._cut_off:
                await self._cut_off.pop(0).complete(within_s, self._deadline)

    async def end(self, within_s: float = COMPLETE_WITHIN_S) -> None:
        """The same after cutting off what is recorded now. Nothing without `begin`."""
        if self._removal is not None:
            await cancel_all([self._removal])
        async with self._turn:
            self._cut_off_recording()
        await self.complete(within_s)

    def _cut_off_recording(self) -> None:
        if self._now is None:
            return
        recording, self._now = self._now, None
        ended = RUN_END.at(self._clock.now_ns(), "the record between runs ends", status=RunOutcome.COMPLETE)
        recording.tap.give(ended)
        recording.tap.close()
        self._cut_off.append(recording)

    async def _remove_old(self) -> None:
        """Remove the records older than the stand's file allows, reported; what the disk refuses is tried again
        tomorrow."""
        days = self._assembly.config.recording.idle_log_days
        removed = await self._removing.call(remove_idle_logs, self._out, self._get_today(), days) if days else []
        if removed:
            self._assembly.hub.publish(IDLE_LOGS_REMOVED.at(self._clock.now_ns(), names=[*removed], days=days))

    def _get_today(self) -> str:
        now_s = (self._clock.now_ns() + self._clock.utc_offset_ns()) / NS_PER_S
        return f"{datetime.fromtimestamp(now_s).astimezone():%Y%m%d}"

    def _find_session(self, day: str) -> SessionInfo:
        """The day's session, which goes on; `-2`, `-3` ... when there is one that another program, or a stand with
        another configuration, has recorded, or that cannot be read."""
        first = f"{day}-{BETWEEN_RUNS}"
        names = itertools.chain([first], (f"{first}-{number}" for number in itertools.count(2)))
        return next(info for name in names if (info := self._read_info(self._out / name)) is not None)

    def _read_info(self, directory: Path) -> SessionInfo | None:
        """Return who records there: as before, where that can be; None where it cannot."""
        info = self._make_info(directory.name)
        if not os.path.lexists(directory):
            return info
        try:
            session = Session.open(directory)
            before = SessionInfo.of(session.metadata)
            is_same = replace(info, uid=before.uid) == before and dict(session.attachments) == self._texts
        except (SessionError, OSError, LookupError, ValueError):
            return None
        return before if is_same else None

    def _make_info(self, name: str) -> SessionInfo:
        config = self._assembly.config
        serials = ", ".join(camera.serial_number or "" for camera in config.cameras.values())
        return make_session_info(BETWEEN_RUNS, name, config, serials, self._clock)


def remove_idle_logs(directory: Path, today: str, days: int) -> list[str]:
    """Remove the records between runs that were begun more than so many days before `today` (YYYYMMDD) and have neither
    note nor tag; their names. Blocking. What cannot be removed stays."""
    removed: list[str] = []
    for path in sorted(directory.glob(f"[0-9]*-{BETWEEN_RUNS}*")):
        named = _NAME.fullmatch(path.name)
        if named is None or path.is_symlink() or _compute_age_days(named[1], today) <= days:
            continue
        with suppress(SessionError, OSError, LookupError, ValueError):
            kept = read_notes(path)
            is_kept = kept.notes or kept.tags or kept.damage or kept.unended  # what is lost may be a tag
            if Session.open(path).metadata["recipe"] == BETWEEN_RUNS and not is_kept:
                gone = path.with_name(f".{path.name}{DELETED}")  # a reader never sees half of one
                path.rename(gone)
                shutil.rmtree(gone)
                removed.append(path.name)
    return removed


def _compute_age_days(day: str, today: str) -> int:
    """The age of a day, both as YYYYMMDD; 0 for what is no date."""
    try:
        return (datetime.strptime(today, "%Y%m%d") - datetime.strptime(day, "%Y%m%d")).days
    except ValueError:
        return 0


class _Tap(Hub):
    """The stand's hub as one recorder sees it, until it is closed: `give` reaches that recorder alone."""

    def __init__(self, hub: Hub) -> None:
        super().__init__()
        self._hub = hub
        self._recorders: list[Subscriber] = []

    def subscribe(self, subscriber: Subscriber) -> None:
        self._recorders.append(subscriber)
        self._hub.subscribe(subscriber)

    def unsubscribe(self, subscriber: Callable[[Item], None]) -> None:
        self._recorders = [each for each in self._recorders if each != subscriber]
        self._hub.unsubscribe(subscriber)

    def publish(self, item: Item) -> None:
        self._hub.publish(item)

    def close(self) -> None:
        """Let nothing pass any more."""
        for recorder in self._recorders:
            self._hub.unsubscribe(recorder)

    def give(self, item: Item) -> None:
        """Give an item to those who record, and nobody else."""
        for recorder in self._recorders:
            recorder(item)
