"""Everything the hub publishes, on the disk: two series of segments; losses are counted and reported.

Telemetry is committed on ticks of the stand's clock, each frame by itself; encoding and disk work run in a lane per
series, off the loop and with virtual time held. A slow disk fills the bounded queue of frames and then drops frames;
a nearly full one is left to the telemetry, which waits in memory until it is on the disk. Log times are the items'
own, so the same items at the same instants of a virtual clock give the same bytes.

Heat is only justified by what is recorded: `waiting_since_ns` and `folder_lost` are what a guard needs to know.
"""

from __future__ import annotations

import asyncio
import math
from collections import deque
from collections.abc import Awaitable, Callable, Iterable, Mapping
from contextlib import AsyncExitStack
from dataclasses import dataclass, replace
from pathlib import Path

from thermostand.foundation.clock import Clock, to_ns
from thermostand.foundation.errors import SessionError
from thermostand.foundation.events import SEGMENT_GIVEN_UP, TELL_PLAN, EventKind
from thermostand.foundation.hub import Hub
from thermostand.foundation.items import Event, Item
from thermostand.foundation.readings import Frame
from thermostand.foundation.shutdown_deadline import ShutdownDeadline
from thermostand.foundation.workers import WorkerThread
from thermostand.recording.format.batches import RecordedDevice
from thermostand.recording.format.manifest import SessionInfo
from thermostand.recording.writing.disk import DiskProcess
from thermostand.recording.writing.folder_watch import CompanionFile, FolderWatch
from thermostand.recording.writing.frames import FrameRecorder
from thermostand.recording.writing.pending_items import PendingItems
from thermostand.recording.writing.recorder_settings import USUAL, RecordingSettings
from thermostand.recording.writing.series import DiskSeries, open_series
from thermostand.recording.writing.session_spec import SessionSpec
from thermostand.recording.writing.telemetry import TelemetryRecorder

FINISH_WITHIN_S, COMPLETE_WITHIN_S = 2.0, 60.0  # real seconds that a disk may take for the end of a run: stopped, whole


@dataclass(frozen=True, slots=True)
class Saved:
    """What is known to be on the disk since the start: frames, and messages of telemetry. Frames published are either
    saved, lost or still waiting."""

    frames: int
    telemetry: int
    frames_lost: int


class Recorder:
    """Records from `start` to `finish`; `run` does the work between and is cancelled before `finish`.

    `directory` gets the folders `frames` and `telemetry`; a directory with segments of an earlier run is continued.
    `prepare` gives what of a frame is recorded, in a thread of its own and in order of the frames. `disk` is the
    process that touches the disk; without one this process does."""

    def __init__(
        self,
        directory: Path,
        info: SessionInfo,
        attachments: Mapping[str, str],
        devices: Mapping[str, RecordedDevice],
        hub: Hub,
        clock: Clock,
        *,
        settings: RecordingSettings = USUAL,
        prepare: Callable[[Frame], Frame] | None = None,
        disk: DiskProcess | None = None,
    ) -> None:
        self.directory = directory
        self.disk = disk
        self._form = SessionSpec(info.metadata(), dict(attachments), dict(devices), settings)
        self._hub = hub
        self._clock = clock
        self._settings = settings
        self._waiting = PendingItems()
        self._notices: deque[Event] = deque()  # from any thread
        tell = self._notices.append
        self._homes = FolderWatch(directory, tell)
        self._frames = FrameRecorder(settings, prepare, clock, self._waiting, self._homes)
        self._telemetry = TelemetryRecorder(
            directory, devices, settings=settings, clock=clock, waiting=self._waiting, homes=self._homes, tell=tell
        )
        self._receivers = self._frames.receive, self._telemetry.receive, self._receive_plan
        self._plan: dict[str, int] = {}  # that the manifest does not have yet
        self._finishing: asyncio.Future[None] | None = None

    @property
    def frames_lost(self) -> int:
        """Frames published but not in the session."""
        return self._frames.losses.total

    def count_lost(self, step_id: str) -> int:
        """Frames of this step published but not in the session."""
        return self._frames.losses.of(step_id)

    @property
    def saved(self) -> Saved:
        """What has been acknowledged since `start`: it is on the disk and stays there."""
        return Saved(self._frames.saved, self._telemetry.messages_saved, self._frames.losses.total)

    @property
    def waiting_since_ns(self) -> int | None:
        """The instant at which the oldest reading, event or frame was published that is not yet durable in this
        session's own folder; None when nothing is due. A frame that the disk refused waits until frames can be written
        again."""
        return self._waiting.since_ns

    @property
    def folder_lost(self) -> str:
        """Why the session's folder has gone, as a sentence; "" while it is there, or is being made again."""
        return self._homes.lost

    @property
    def writer_ended(self) -> str:
        """Why the process that touches the disk has ended, as a sentence; "" while it has not."""
        return "" if self.disk is None else self.disk.ended

    @property
    def disk_free_bytes(self) -> int:
        """The free bytes that the last commit found; asking does not wait for the disk."""
        return self._frames.series.space.last.free_bytes

    def watch_file(self, file: CompanionFile) -> None:
        """Count this file as part of the session's folder from now on: `folder_lost` and `refound` know of it."""
        self._homes.companions.append(file)

    def recover_folder(self) -> None:
        """An operator has reset the loss of the folder: continue in it, or in a new one at its place, with continued
        numbers. Returns at once."""
        self._homes.request_recovery()

    def start(self, earlier: Iterable[Item] = ()) -> None:
        """Make the folders, begin the telemetry and listen to the hub; SessionError when the disk refuses. `earlier`:
        what was published before, in its order, and belongs to the session."""
        self._take(self._open_series(), earlier)

    async def begin(self, earlier: Callable[[], Iterable[Item]]) -> None:
        """Begin recording off the event loop, as `start` does."""
        lane = WorkerThread("record-begin", self._clock, patient=False)
        try:
            series = await lane.call(self._open_series)
        finally:
            lane.close()
        self._take(series, earlier())

    def _open_series(self) -> tuple[DiskSeries, DiskSeries]:
        try:
            return open_series(self.disk, self.directory, self._form, self._clock.now_ns(), self._notices.append)
        except OSError as error:
            raise SessionError(f"{self.directory}: no session can be recorded here ({error})") from error

    def _take(self, series: tuple[DiskSeries, DiskSeries], earlier: Iterable[Item]) -> None:
        self._frames.begin(series[0])
        self._telemetry.begin(series[1])
        self._begun_ns = self._clock.now_ns()
        receivers = self._receivers
        for item in earlier:
            for receive in receivers:
                receive(item)
        for receive in receivers:
            self._hub.subscribe(receive)

    async def run(self) -> None:
        """Record until cancelled."""
        async with asyncio.TaskGroup() as tasks:
            # By itself: it has to report a disk that holds up the others.
            tasks.create_task(self._on_ticks(self._report_on_tick))
            tasks.create_task(self._on_ticks(self._save_telemetry))
            tasks.create_task(self._frames.record())
            tasks.create_task(self._on_ticks(self._frames.tend))
            tasks.create_task(self._recover_when_requested())

    async def flush(self) -> None:
        """Return when everything published before the call is on the disk or counted as lost. Only while `run` runs;
        telemetry the disk refuses is waited for."""
        frames, items = self._frames.taken, self._telemetry.items_taken
        await self._telemetry.save()
        while self._telemetry.taking and (self._frames.done < frames or self._telemetry.items_saved < items):
            await self._waiting.change.wait()

    async def finish(self, within_s: float = math.inf, deadline: ShutdownDeadline | None = None) -> None:
        """Put what still waits on the disk and complete the segments; SessionError when telemetry was not saved or its
        segment stays unfinished, or when the disk has not done all that within so many real seconds, or so long as
        `deadline` lasts: it is then left to itself. Items published later are not recorded. It runs to its end also
        when the caller is cancelled. May be called twice."""
        deadline = deadline or ShutdownDeadline()
        if self._finishing is None:
            if not self._telemetry.taking:
                return
            self._finishing = asyncio.ensure_future(self._finish())
        try:
            await deadline.wait(self._finishing, within_s)
        except asyncio.CancelledError:
            await deadline.wait(self._finishing, within_s)
            await self._wait_for_finish()
            raise
        await self._wait_for_finish()
        for receive in self._receivers:
            self._hub.unsubscribe(receive)
        await self._finishing

    async def _wait_for_finish(self) -> None:
        """Wait for nothing any more that `_finish` has not done."""
        if self._finishing is not None and not self._finishing.done():
            self._telemetry.lane.abandon()
            self._frames.lane.abandon()
            await asyncio.wait([self._finishing])

    async def _finish(self) -> None:
        frames, telemetry = self._frames, self._telemetry
        try:
            async with AsyncExitStack() as stack:  # each of these is done, also when one before it fails
                stack.callback(telemetry.lane.close)
                stack.callback(frames.lane.close)
                stack.push_async_callback(telemetry.lane.call, telemetry.series.close)
                stack.push_async_callback(frames.lane.call, frames.series.close)
                stack.push_async_callback(self._complete)
                stack.callback(self._report)
                stack.push_async_callback(frames.lane.call, frames.series.finish)
                await frames.finish()
        except TimeoutError as error:
            raise SessionError(
                f"{self.directory}: the disk has not answered in time; the session is unfinished, {frames.waiting} "
                f"frames and {telemetry.messages_waiting} messages waited to be saved; `stand session repair` "
                "completes it when the disk answers"
            ) from error

    async def _complete(self) -> None:
        await self._telemetry.finish()
        await self._save_plan()
        await self._telemetry.lane.call(self._telemetry.series.end)

    def _receive_plan(self, item: Item) -> None:
        """Keep what an event says of the plan for the manifest."""
        if isinstance(item, Event) and item.kind in TELL_PLAN:
            size = {name: item.data.get(name) for name in ("steps", "frames")}
            self._plan = {name: count for name, count in size.items() if isinstance(count, int)}

    async def _save_plan(self) -> None:
        if plan := self._plan:
            self._plan = {}
            await self._telemetry.lane.call(self._telemetry.series.plan, plan)

    def tell(self, kind: EventKind, text: str) -> None:
        """An event of this kind with the next report; from any thread."""
        self._notices.append(kind.at(0, text))

    async def _on_ticks(self, work: Callable[[int], Awaitable[None]]) -> None:
        """Do this work at each instant at which the telemetry is committed."""
        due_ns = self._clock.now_ns()
        while True:
            due_ns += to_ns(self._settings.telemetry_commit_s)
            await self._clock.sleep_until(due_ns)
            await work(due_ns)

    async def _save_telemetry(self, _: int) -> None:
        await self._telemetry.save()
        await self._save_plan()
        self._report()  # a disk that is nearly full: frames are lost until this is reported

    async def _report_on_tick(self, _: int) -> None:
        self._report()

    async def _recover_when_requested(self) -> None:
        """Find the folders or make them again after `refound`, and make the loss an event."""
        while True:
            await self._homes.recovery_requested.wait()
            made_again = await self._homes.recover(
                lambda: self._telemetry.lane.call(self._telemetry.series.recover),
                lambda: self._frames.lane.call(self._frames.series.recover),
            )
            if made_again:
                self._notices.append(self._homes.make_loss_event(made_again, self._begun_ns))
            await self._telemetry.save()
            self._report()

    def _report(self) -> None:
        """Publish what was lost, overcome or noticed since the last time."""
        for series in (self._frames.series, self._telemetry.series):
            while series.troubles:
                self._notices.append(SEGMENT_GIVEN_UP.at(0, series.troubles.popleft()))
        self._notices.extend(self._frames.losses.take())
        while self._notices:
            self._hub.publish(replace(self._notices.popleft(), time_ns=self._clock.now_ns()))
