"""The daemon's own record between runs: one session a day, `20261122-house`, begun at local midnight.

What is done by hand is recorded as in a run, and heat depends on it in the same way. While a run records, the house
does not: each instant is in one session.
"""

from __future__ import annotations

import asyncio
import importlib.metadata
import itertools
import os
import platform
from collections.abc import Callable
from datetime import datetime
from pathlib import Path

from foundation.clock import NS_PER_S, WallClock
from foundation.errors import SessionError
from foundation.hub import Hub, Subscriber
from foundation.items import Event, Item
from foundation.tasks import cancelled
from recording.reading.contents import RUN_END
from recording.reading.run_word import Run
from recording.reading.session import Session
from recording.writing.disk import Disk
from recording.writing.recorder import COMPLETE_WITHIN_S, Recorder
from recording.writing.settings import SessionInfo
from stand.assembly import Assembly
from stand.running.session_files import recorder_in

HOUSE = "house"  # in place of a recipe's name


class HouseRecord:
    """Records what passes the hub from `begin` to `end`, as often as wanted; of one day all is in one session."""

    def __init__(self, assembly: Assembly, config_text: str, out: Path, clock: WallClock) -> None:
        self.recorder: Recorder | None = None
        self._assembly = assembly
        self._config_text = config_text
        self._out = out
        self._clock = clock
        self._hub = _Tap(assembly.hub)
        self._disk: Disk | None = None
        self._task: asyncio.Task[None] | None = None
        self._day = ""
        self._turn = asyncio.Lock()

    def is_of_today(self) -> bool:
        """Whether midnight has not passed since it was begun."""
        return self._day == self._today()

    async def begin(self) -> Recorder:
        """SessionError when the disk refuses it."""
        async with self._turn:
            self._day = self._today()
            info = self._info(await asyncio.to_thread(self._place, self._day))
            directory, texts, disk = self._out / info.session_id, {"config.yaml": self._config_text}, Disk()
            recorder = recorder_in(directory, info, texts, self._assembly.config, self._hub, self._clock, disk)
            try:
                await recorder.begin(tuple)
            except BaseException:
                disk.close()
                raise
            self._disk, self._task, self.recorder = disk, asyncio.create_task(recorder.run()), recorder
            return recorder

    async def end(self, within_s: float = COMPLETE_WITHIN_S) -> None:
        """Complete its segments; SessionError when the disk does not take them in time. Nothing without `begin`."""
        async with self._turn:
            recorder, self.recorder = self.recorder, None
            if recorder is None or self._task is None or self._disk is None:
                return
            ended = Event(self._clock.now_ns(), "info", RUN_END, "the house's record ends", {"status": Run.COMPLETE})
            self._hub.give(ended)
            try:
                await cancelled([self._task])
                await recorder.finish(within_s)
            finally:
                self._disk.close()

    def _today(self) -> str:
        now_s = (self._clock.now_ns() + self._clock.utc_offset_ns()) / NS_PER_S
        return f"{datetime.fromtimestamp(now_s).astimezone():%Y%m%d}"

    def _place(self, day: str) -> str:
        """The name of the day's session; `-2`, `-3` ... when there is one that another program, or a stand with another
        configuration, has recorded, or that cannot be read."""
        first = f"{day}-{HOUSE}"
        names = itertools.chain([first], (f"{first}-{number}" for number in itertools.count(2)))
        return next(name for name in names if self._may_continue(self._out / name))

    def _may_continue(self, directory: Path) -> bool:
        if not os.path.lexists(directory):
            return True
        try:
            session = Session.open(directory)
            return (
                SessionInfo.of(session.metadata) == self._info(directory.name)
                and session.attachments.get("config.yaml") == self._config_text
            )
        except (SessionError, OSError, LookupError, ValueError):
            return False

    def _info(self, name: str) -> SessionInfo:
        config = self._assembly.config
        return SessionInfo(
            session_id=name,
            recipe=HOUSE,
            operator=config.operator,
            camera_serial=", ".join(camera.serial_number or "" for camera in config.cameras.values()),
            software_version=importlib.metadata.version("thermostand"),
            clock_source="wall",
            simulated=config.simulation is not None,
            host=platform.node(),
        )


class _Tap(Hub):
    """The house's hub as its recorder sees it: `give` reaches the recorder alone."""

    def __init__(self, hub: Hub) -> None:
        super().__init__()
        self._house = hub
        self._recorders: list[Subscriber] = []

    def subscribe(self, subscriber: Subscriber) -> None:
        self._recorders.append(subscriber)
        self._house.subscribe(subscriber)

    def unsubscribe(self, subscriber: Callable[[Item], None]) -> None:
        self._recorders = [each for each in self._recorders if each != subscriber]
        self._house.unsubscribe(subscriber)

    def publish(self, item: Item) -> None:
        self._house.publish(item)

    def give(self, item: Item) -> None:
        """To those who record, and nobody else."""
        for recorder in self._recorders:
            recorder(item)
