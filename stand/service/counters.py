"""What a daemon knows across restarts, in the folder of its sessions: `daemon.json` with the counters.

Written in the background, by the process that touches the disk: no loop waits for it.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from pathlib import Path

from pydantic import BaseModel, ConfigDict, Field

from thermostand.foundation.clock import NS_PER_S, Clock, to_ns
from thermostand.foundation.events import DAEMON_NOT_KEPT
from thermostand.foundation.files import replace_file
from thermostand.foundation.hub import Hub
from thermostand.foundation.items import Batch, Item
from thermostand.foundation.readings import Quality, Reading
from thermostand.foundation.sealed import seal, unseal
from thermostand.foundation.shutdown_deadline import ShutdownDeadline
from thermostand.foundation.workers import WorkerThread

# What wears, counted over the life of a stand: compressor, relays, flap, stages, and the heat that was given.

_UNSEEN_NS = to_ns(60.0)  # between two readings: what happened in a longer gap is unknown, and not counted
_S_PER_H = 3600.0
_OPEN_ABOVE = 0.5  # of the flap's travel


class Counters:
    """A subscriber of the hub. `values`, by name:

    compressor_hours, compressor_starts; relay_cycles.NAME: how often the relay was switched on; flap_cycles: how often
    it was opened; stage_cycles.NAME: how many moves of the axis were seen; heater_Wh: output x heater_W, permitted.
    """

    def __init__(self, earlier: Mapping[str, float], axes: Iterable[str], heater_W: float, hub: Hub) -> None:
        self.values = {
            "compressor_hours": 0.0,
            "compressor_starts": 0.0,
            "flap_cycles": 0.0,
            "heater_Wh": 0.0,
            **earlier,
        }
        self._axes = tuple(axes)
        self._heater_W = heater_W
        self._last: dict[str, Reading] = {}
        hub.subscribe(self._receive)

    def _receive(self, item: Item) -> None:
        if isinstance(item, Batch):
            for reading in item.readings:
                if reading.quality is not Quality.BAD:
                    self._count(reading, self._last.get(reading.channel))
                    self._last[reading.channel] = reading

    def _count(self, reading: Reading, before: Reading | None) -> None:
        if before is None:
            return
        device, _, name = reading.channel.partition(".")
        span_ns = reading.time_ns - before.time_ns
        span_h = span_ns / NS_PER_S / _S_PER_H if 0 < span_ns <= _UNSEEN_NS else 0.0
        rises = reading.value > _OPEN_ABOVE >= before.value
        if device == "relays":
            if rises:
                self._add(f"relay_cycles.{name}", 1)
            if name == "compressor":
                self._add("compressor_starts", rises)
                self._add("compressor_hours", span_h if before.value == 1 else 0.0)
        elif reading.channel == "flap.position":
            self._add("flap_cycles", rises)
        elif device in self._axes and name == "position" and self._begins_to_move(reading, before):
            self._add(f"stage_cycles.{device}", 1)
        elif reading.channel == "regulator.mv_heat" and self._is_permitted():
            self._add("heater_Wh", before.value / 100 * self._heater_W * span_h)

    def _begins_to_move(self, reading: Reading, before: Reading) -> bool:
        """A move is counted where its first change is seen: one that lies between two polls, too."""
        device = reading.channel.partition(".")[0]
        moving = self._last.get(f"{device}.moving")
        return reading.value != before.value and (moving is None or moving.value == 0)

    def _is_permitted(self) -> bool:
        permit = self._last.get("relays.heater_enable")
        return permit is not None and permit.value == 1

    def _add(self, name: str, amount: float) -> None:
        self.values[name] = self.values.get(name, 0.0) + amount


NAME = "daemon.json"
_KIND = "counters"
_CLOSE_LIMIT_S = 1.0  # round number; nothing was measured


class StoredCounters(BaseModel):
    """The file. counters: by name, see counters.py."""

    model_config = ConfigDict(frozen=True)

    counters: dict[str, float] = Field(default_factory=dict)


def load_counters(directory: Path) -> tuple[StoredCounters, str]:
    """Return what a daemon before has left, and what is wrong with it, as a sentence: a damaged file is kept next to
    it, and the counters begin again. Blocking."""
    path = directory / NAME
    try:
        return StoredCounters.model_validate_json(unseal(_KIND, path.read_bytes())), ""
    except FileNotFoundError:
        return StoredCounters(), ""
    except (OSError, ValueError) as error:
        backup = path.with_name(f"{NAME}.damaged")
        with suppress(OSError):
            path.replace(backup)
        why = error.strerror if isinstance(error, OSError) else "it is damaged"
        return (
            StoredCounters(),
            f"{path}: cannot be read ({why}), and is {backup.name} now; the counters begin again at 0",
        )


class CountersFile:
    """Writes the last state that was noted; those that come while the disk works wait, and only the last is written.

    run: calls a function with its arguments where the disk may hang.
    """

    def __init__(self, directory: Path, run: Callable[..., object], hub: Hub, clock: Clock) -> None:
        self._path = directory.absolute() / NAME
        self._run = run
        self._hub = hub
        self._clock = clock
        self._lane = WorkerThread("daemon-file", clock, patient=False)
        self._waiting: StoredCounters | None = None
        self._writing: asyncio.Task[None] | None = None

    def note(self, kept: StoredCounters) -> None:
        """Write it as soon as the disk takes it; returns at once."""
        self._waiting = kept
        if self._writing is None or self._writing.done():
            self._writing = asyncio.create_task(self._write())

    async def close(self, deadline: ShutdownDeadline) -> None:
        """Give the disk a moment for the last state."""
        if self._writing is not None:
            await deadline.wait(self._writing, _CLOSE_LIMIT_S)
            self._writing.cancel()
        self._lane.abandon()

    async def _write(self) -> None:
        while self._waiting is not None:
            kept, self._waiting = self._waiting, None
            try:
                data = seal(_KIND, kept.model_dump_json(indent=1))
                await self._lane.call(self._run, replace_file, self._path, data)
            except (OSError, TimeoutError) as error:
                self._hub.publish(DAEMON_NOT_KEPT.at(self._clock.now_ns(), str(error)))
