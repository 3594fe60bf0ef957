"""One sequence of requests to a device at a time, and whether what was found out about the device still holds."""

from __future__ import annotations

import asyncio
from types import TracebackType

from thermostand.foundation.errors import Unreachable


class Exclusive:
    """`async with` around each sequence: a write and what is read back stay together. is_known: set by the driver once
    it has asked the device who it is and how it is set; not so any more after a loss (Unreachable), since it may
    come back power-cycled, or another unit may stand there."""

    def __init__(self) -> None:
        self.is_known = False
        self._lock = asyncio.Lock()

    async def __aenter__(self) -> None:
        await self._lock.acquire()

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        if isinstance(error, Unreachable):
            self.is_known = False
        self._lock.release()
