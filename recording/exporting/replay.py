"""Publishes a recorded session again: the same items in the same order, at their own instants of a clock.

To subscribers a replay looks like the run, except that there is no stand behind it. As fast as possible is a
VirtualClock, held while a lane works, so nothing is dropped. 1 x and N x is a ReplayClock.
"""

from __future__ import annotations

import asyncio
import math
import shutil
from collections.abc import Callable, Coroutine, Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import replace
from pathlib import Path
from typing import Any

from thermostand.foundation.clock import Clock, VirtualClock, WallClock
from thermostand.foundation.errors import SessionError
from thermostand.foundation.files import create_folder
from thermostand.foundation.hub import Hub
from thermostand.foundation.items import Item
from thermostand.foundation.readings import Frame
from thermostand.foundation.workers import WorkerThread
from thermostand.recording.exporting.topics import recorded_devices
from thermostand.recording.format.holes import format_holes
from thermostand.recording.format.journal_lines import JOURNAL_NAME
from thermostand.recording.reading.notes import NOTES_NAME
from thermostand.recording.reading.session import Session
from thermostand.recording.writing.recorder import Recorder, RecordingSettings, SessionInfo
from thermostand.recording.writing.recorder_settings import VIRTUAL_COMMIT_S

# Items read at once, at most one frame among them: few enough to keep memory flat, enough to make the hand-over to the
# reading thread cheap.
PORTION_ITEMS = 256


class ReplayClock:
    """A clock that stands at `start_ns` when it is made and runs `speed` times as fast as `wall`."""

    def __init__(self, start_ns: int, speed: float, wall: Clock | None = None) -> None:
        if not (math.isfinite(speed) and speed > 0):
            raise ValueError(f"a speed is a positive number, not {speed}")
        self._wall = wall if wall is not None else WallClock()
        self._start_ns = start_ns
        self._wall_start_ns = self._wall.now_ns()
        self._speed = speed

    @property
    def lead_ns(self) -> int:
        """The lead of the wall clock, in the session's time."""
        return round(self._wall.lead_ns * self._speed)

    def now_ns(self) -> int:
        """The instant of the session, ns since the epoch."""
        return self._start_ns + round((self._wall.now_ns() - self._wall_start_ns) * self._speed)

    async def sleep_until(self, time_ns: int) -> None:
        """Return at or after that instant of the session; at once when it has passed."""
        await self._wall.sleep_until(self._wall_start_ns + math.ceil((time_ns - self._start_ns) / self._speed))

    def hold(self) -> AbstractContextManager[None]:
        """Hold the time, as far as the wall clock can be held."""
        return self._wall.hold()


async def replay(session: Session, hub: Hub, clock: Clock) -> None:
    """Publish every item of the session on `hub`, each when `clock` has reached the instant of its publication.

    The order is that of the recording. Reading and decoding hold the clock, off the loop. Raises SessionError at the
    first item that cannot be read.
    """
    items = session.published()
    lane = WorkerThread("replay", clock)
    try:
        while portion := await lane.call(_take_portion, items):
            for time_ns, item in portion:
                await clock.sleep_until(time_ns)
                hub.publish(item)
    finally:
        lane.close()


def _take_portion(items: Iterator[tuple[int, Item]]) -> list[tuple[int, Item]]:
    """The next items, up to and with a frame; none at the end."""
    portion: list[tuple[int, Item]] = []
    for time_ns, item in items:
        portion.append((time_ns, item))
        if isinstance(item, Frame) or len(portion) >= PORTION_ITEMS:
            break
    return portion


async def replay_and_record(
    session: Session, out: Path, speed: float | None, watch: Callable[[Hub], None] = lambda hub: None
) -> Path:
    """Replay `session` and record it again as the session `out`, which must not exist; returns `out`.

    speed: times as fast as it was, None as fast as possible. `watch(hub)` may subscribe before the first item. The copy
    has the same metadata (the session's id, too), attachments, devices, items, journal and notes. Nothing in it is
    about the replay, for it is the same session in other segments. What the original lacks is in its metadata.
    SessionError when it has no items, or cannot be read or written whole, as on a disk that is slower than `speed`;
    `out` then does not appear.
    """
    first_ns = next((time_ns for time_ns, _ in session.published()), None)
    if first_ns is None:
        raise SessionError(f"{session.path}: holds nothing that could be replayed")
    clock = VirtualClock(first_ns) if speed is None else ReplayClock(first_ns, speed)
    hub = Hub()
    watch(hub)
    settings = _make_settings(VIRTUAL_COMMIT_S if speed is None else speed)
    info = SessionInfo.of(session.metadata)
    if session.holes:
        info = replace(info, holes=format_holes(session.holes))
    with create_folder(out) as folder:
        devices = recorded_devices(session.telemetry_segments)
        recorder = Recorder(folder, info, session.attachments, devices, hub, clock, settings=settings)
        recorder.start()
        background = [recorder.run()] + ([clock.run()] if isinstance(clock, VirtualClock) else [])
        try:
            await _run_with_background(replay(session, hub, clock), background)
        finally:
            _copy_texts(session, folder)  # before the manifest is written last, which has the hash of the journal
            await recorder.finish()
        if recorder.frames_lost:
            raise SessionError(
                f"{out}: {recorder.frames_lost} frames could not be written; is the disk full or too slow?"
            )
    return out


async def _run_with_background(
    work: Coroutine[Any, Any, None], background: Sequence[Coroutine[Any, Any, None]]
) -> None:
    """Await `work`, but raise at once what the background raises; nothing runs on when this returns."""
    tasks = [asyncio.create_task(coroutine) for coroutine in (work, *background)]
    try:
        done, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        for task in done:
            task.result()
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)


def _copy_texts(session: Session, folder: Path) -> None:
    """The run's journal and the notes of people, where there are any; they are as good as they were."""
    for name in (JOURNAL_NAME, NOTES_NAME):
        if (session.path / name).is_file():
            shutil.copyfile(session.path / name, folder / name)


def _make_settings(commit_s: float) -> RecordingSettings:
    """Make settings without the rules of a stand for a nearly full disk: a copy may fill it without an alert."""
    return RecordingSettings(telemetry_commit_s=commit_s, stop_frames_below_bytes=0, alert_below_fraction=0.0)
