"""What a daemon knows across restarts, beside its sessions: `daemon.json` with the counters.

Written in the background, by the process that touches the disk: no loop waits for it.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from pydantic import BaseModel, ConfigDict, Field

from thermostand.foundation.calls import Lane
from thermostand.foundation.clock import Clock
from thermostand.foundation.events import DAEMON_NOT_KEPT
from thermostand.foundation.files import replace_file
from thermostand.foundation.hub import Hub
from thermostand.foundation.patience import Patience
from thermostand.foundation.sealed import seal, unseal

NAME = "daemon.json"
_KIND = "counters"
_CLOSE_LIMIT_S = 1.0


class Kept(BaseModel):
    """The file. counters: by name, see counters.py."""

    model_config = ConfigDict(frozen=True)

    counters: dict[str, float] = Field(default_factory=dict)


def kept_in(directory: Path) -> tuple[Kept, str]:
    """What a daemon before has left, and what is wrong with it, as a sentence: a damaged file is kept beside it, and
    the counters begin again. Blocking."""
    path = directory / NAME
    try:
        return Kept.model_validate_json(unseal(_KIND, path.read_bytes())), ""
    except FileNotFoundError:
        return Kept(), ""
    except (OSError, ValueError) as error:
        aside = path.with_name(f"{NAME}.damaged")
        with suppress(OSError):
            path.replace(aside)
        why = error.strerror if isinstance(error, OSError) else "it is damaged"
        return Kept(), f"{path}: cannot be read ({why}), and is {aside.name} now; the counters begin again at 0"


class KeptFile:
    """Writes the last state that was noted; those that come while the disk works wait, and only the last is written.

    run: calls a function with its arguments where the disk may hang.
    """

    def __init__(self, directory: Path, run: Callable[..., object], hub: Hub, clock: Clock) -> None:
        self._path = directory.absolute() / NAME
        self._run = run
        self._hub = hub
        self._clock = clock
        self._lane = Lane("daemon-file", clock, patient=False)
        self._waiting: Kept | None = None
        self._writing: asyncio.Task[None] | None = None

    def note(self, kept: Kept) -> None:
        """Write it as soon as the disk takes it; returns at once."""
        self._waiting = kept
        if self._writing is None or self._writing.done():
            self._writing = asyncio.create_task(self._write())

    async def close(self, patience: Patience) -> None:
        """Give the disk a moment for the last state."""
        if self._writing is not None:
            await patience.wait(self._writing, _CLOSE_LIMIT_S)
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
