"""One worker thread per wire: blocking calls in order, off the event loop, with the clock held."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

from drivers.clock import Clock

Result = TypeVar("Result")


class Lane:
    """Runs blocking calls one at a time in its own thread; the thread is the lock of the wire.

    Several devices on one bus share one lane. A cancelled caller waits for the call under way to end (it is bounded
    by the wire's own time-out), so that no half transaction stays on the wire.
    """

    def __init__(self, name: str, clock: Clock) -> None:
        self._executor = ThreadPoolExecutor(max_workers=1, thread_name_prefix=name)
        self._clock = clock

    async def call(self, function: Callable[..., Result], *args: object) -> Result:
        """`function(*args)` in the lane's thread; what it raises is raised here."""
        with self._clock.hold():
            future = asyncio.get_running_loop().run_in_executor(self._executor, function, *args)
            try:
                return await asyncio.shield(future)
            except asyncio.CancelledError:
                await asyncio.wait([future])
                future.exception()  # seen, or asyncio reports it as never retrieved
                raise

    def close(self) -> None:
        """End the thread after the call under way; may be called twice."""
        self._executor.shutdown(wait=False)
