"""What the compressor did last, on the disk for the next daemon; written in the background."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from pathlib import Path

from thermostand.foundation.calls import Lane
from thermostand.foundation.clock import Clock, boot_of
from thermostand.foundation.events import COMPRESSOR_NOT_KEPT
from thermostand.foundation.hub import Hub
from thermostand.foundation.patience import Patience
from thermostand.stand.chamber.compressor import CompressorState, keep

_CLOSE_LIMIT_S = 1.0  # real seconds for the last state; a disk that hangs does not keep a daemon alive


class CompressorFile:
    """Keeps the last state noted in `path`, None to keep none. States that come while the disk works wait their turn,
    and only the last of them is written."""

    def __init__(self, path: Path | None, hub: Hub, clock: Clock) -> None:
        self._path = None if path is None else path.absolute()
        self._hub = hub
        self._clock = clock
        self._lane: Lane | None = None
        self._waiting: CompressorState | None = None
        self._writing: asyncio.Task[None] | None = None
        self._run: Callable[..., object] = _here

    def through(self, run: Callable[..., object]) -> None:
        """From now on `run(function, *arguments)` touches the disk: a process that may hang in our place."""
        self._run = run

    def note(self, state: CompressorState) -> None:
        """Write `state` as soon as the disk takes it; returns at once."""
        if self._path is None:
            return
        self._waiting = state
        if self._writing is None or self._writing.done():
            self._writing = asyncio.create_task(self._write(self._path))

    async def close(self, patience: Patience | None = None) -> None:
        """Give the disk a moment for the last state; may be called twice."""
        if self._writing is not None:
            await (patience or Patience()).wait(self._writing, _CLOSE_LIMIT_S)
            self._writing.cancel()
        if self._lane is not None:
            self._lane.close()
            self._lane = None

    async def _write(self, path: Path) -> None:
        self._lane = self._lane or Lane("compressor-file", self._clock, patient=False)
        while self._waiting is not None:
            state, self._waiting = self._waiting, None
            try:
                await self._lane.call(self._run, keep, path, state, boot_of(self._clock))
            except OSError as error:
                self._hub.publish(COMPRESSOR_NOT_KEPT.at(self._clock.now_ns(), str(error)))


def _here(function: Callable[..., object], *arguments: object) -> object:
    """In this process."""
    return function(*arguments)
