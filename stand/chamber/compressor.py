"""When the refrigeration compressor runs: the regulator's cooling output is a demand, the compressor's limits decide.

The regulator's cooling period (at most 99 s) is far shorter than a compressor's minimum off time, so its output is
read as a demand. Once started, the compressor keeps running and the heater trims the temperature, as in commercial
climate chambers: that holds the air steady, where cycling at full stroke would swing it by kelvins. It stops when the
regulator heats hard against it.

What it did last is kept in a small file, so that a daemon that restarts, or crashes again and again, spares it as one
that keeps running: `restored` and `keep`. The file counts in the host's boot time and names the boot: a system clock
that is stepped between two daemons neither shortens nor lengthens the rest. In virtual time, which has no boot, it
counts in instants of the stand's clock.
"""

from __future__ import annotations

import asyncio
import itertools
import json
import os
import threading
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from pydantic import BaseModel, ConfigDict

from thermostand.foundation.clock import Boot, Clock, get_boot, to_ns
from thermostand.foundation.events import COMPRESSOR_NOT_KEPT
from thermostand.foundation.files import make_durable_folder, sync_folder
from thermostand.foundation.hub import Hub
from thermostand.foundation.sealed import seal, unseal
from thermostand.foundation.shutdown_deadline import ShutdownDeadline
from thermostand.foundation.workers import WorkerThread
from thermostand.stand.config.stand_config import CompressorConfig

_KIND = "compressor"
_CLOSE_LIMIT_S = 1.0  # real seconds for the last state; a disk that hangs does not keep a daemon alive
# Calls of `keep`, and of which of them the file at a path is.
_calls = itertools.count(1)
_latest_calls: dict[Path, int] = {}
_rename_lock = threading.Lock()


@dataclass(frozen=True, slots=True)
class CompressorState:
    """`since_ns`: when it was last switched; `starts_ns`: starts of the last hour."""

    running: bool
    since_ns: int
    starts_ns: tuple[int, ...] = ()


def decide(
    state: CompressorState, limits: CompressorConfig, mv_heat: float, mv_cool: float, now_ns: int
) -> CompressorState:
    """The compressor's state from now on; outputs in %, NaN (an unknown output) never starts it."""
    hour_ago_ns = now_ns - to_ns(3600)
    starts_ns = tuple(start for start in state.starts_ns if start > hour_ago_ns)
    held_ns = now_ns - state.since_ns
    if state.running:
        # It runs on while the heater trims: cycled for each demand, its 600 W swing the air by 0.4 to 1 K.
        unwanted = mv_heat > limits.stop_above_heat_percent and not mv_cool > 0
        if unwanted and held_ns >= to_ns(limits.min_on_s):
            return CompressorState(running=False, since_ns=now_ns, starts_ns=starts_ns)
        return replace(state, starts_ns=starts_ns)
    wanted = mv_cool > limits.start_above_cool_percent and mv_heat <= 0
    rested = held_ns >= to_ns(limits.min_off_s)
    if wanted and rested and len(starts_ns) < limits.max_starts_per_h:
        return CompressorState(running=True, since_ns=now_ns, starts_ns=(*starts_ns, now_ns))
    return replace(state, starts_ns=starts_ns)


class _StoredState(BaseModel):
    """The file's content. boot_id: since_ns and starts_ns are boot time of that start of the host; without it, in
    virtual time, they are instants of the stand's clock."""

    model_config = ConfigDict(strict=True)

    running: bool
    since_ns: int
    starts_ns: list[int]
    boot_id: str | None = None

    def is_usable_in(self, boot: Boot | None) -> bool:
        """Return whether its times can be understood now."""
        return self.boot_id is None if boot is None else boot.id != "" and self.boot_id == boot.id


def load_state(path: Path | None, now_ns: int, boot: Boot | None) -> CompressorState:
    """Return what `path` keeps, for a compressor that is off now. When it was switched off is unknown, and so taken for
    just now, when the file is missing or damaged, is of another boot, ends with a running compressor, or has times in
    the future. Starts of another boot are forgotten."""
    unknown = CompressorState(running=False, since_ns=now_ns)
    if path is None:
        return unknown
    try:
        kept = _StoredState.model_validate_json(unseal(_KIND, path.read_bytes()))
    except (OSError, ValueError):
        return unknown
    if not kept.is_usable_in(boot):
        return unknown
    began_ns = 0 if boot is None else boot.began_ns
    starts_ns = tuple(start_ns + began_ns for start_ns in kept.starts_ns if start_ns + began_ns <= now_ns)
    since_ns = kept.since_ns + began_ns
    return CompressorState(False, now_ns if kept.running or since_ns > now_ns else since_ns, starts_ns)


def save_state(path: Path | None, state: CompressorState, boot: Boot | None) -> None:
    """Write `state` to `path`, whole or not at all; it blocks for the disk. Raises OSError.

    Several threads may keep at once: each has a temporary file of its own, and the state of the latest call stays.
    """
    if path is None:
        return
    number = next(_calls)
    make_durable_folder(path.parent)
    part = path.with_name(f".{path.name}.{os.getpid()}-{number}.part")
    try:
        _write(part, state, boot)
        with _rename_lock:
            if number > _latest_calls.get(path, 0):
                part.replace(path)
                _latest_calls[path] = number
    finally:
        part.unlink(missing_ok=True)
    sync_folder(path.parent)


def _write(path: Path, state: CompressorState, boot: Boot | None) -> None:
    began_ns = 0 if boot is None else boot.began_ns
    starts_ns = [start_ns - began_ns for start_ns in state.starts_ns]
    kept = {"running": state.running, "since_ns": state.since_ns - began_ns, "starts_ns": starts_ns}
    with path.open("wb") as file:
        file.write(seal(_KIND, json.dumps(kept if boot is None else {**kept, "boot_id": boot.id})))
        file.flush()
        os.fsync(file.fileno())


class CompressorFile:
    """Keeps the last state noted in `path`, None to keep none. States that come while the disk works wait their turn,
    and only the last of them is written."""

    def __init__(self, path: Path | None, hub: Hub, clock: Clock) -> None:
        self._path = None if path is None else path.absolute()
        self._hub = hub
        self._clock = clock
        self._worker: WorkerThread | None = None
        self._waiting: CompressorState | None = None
        self._writing: asyncio.Task[None] | None = None
        self._run: Callable[..., object] = _call_directly

    def delegate_to(self, run: Callable[..., object]) -> None:
        """Let `run(function, *arguments)` touch the disk from now on: a process that may hang in our place."""
        self._run = run

    def note(self, state: CompressorState) -> None:
        """Write `state` as soon as the disk takes it; returns at once."""
        if self._path is None:
            return
        self._waiting = state
        if self._writing is None or self._writing.done():
            self._writing = asyncio.create_task(self._write(self._path))

    async def close(self, deadline: ShutdownDeadline | None = None) -> None:
        """Give the disk a moment for the last state; may be called twice."""
        if self._writing is not None:
            await (deadline or ShutdownDeadline()).wait(self._writing, _CLOSE_LIMIT_S)
            self._writing.cancel()
        if self._worker is not None:
            self._worker.close()
            self._worker = None

    async def _write(self, path: Path) -> None:
        self._worker = self._worker or WorkerThread("compressor-file", self._clock, patient=False)
        while self._waiting is not None:
            state, self._waiting = self._waiting, None
            try:
                await self._worker.call(self._run, save_state, path, state, get_boot(self._clock))
            except OSError as error:
                self._hub.publish(COMPRESSOR_NOT_KEPT.at(self._clock.now_ns(), str(error)))


def _call_directly(function: Callable[..., object], *arguments: object) -> object:
    """Call the function in this process."""
    return function(*arguments)
