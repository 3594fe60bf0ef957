"""Blocking calls of one wire, in order: in a thread of their own in real time, on the spot in virtual time."""

from __future__ import annotations

import asyncio
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

from drivers.clock import Clock, VirtualClock

Result = TypeVar("Result")

# How long a lane's thread that computes (encoding, checksums) may keep the event loop from its turn; Python's own 5 ms
# would make frames late by as much.
_SWITCH_S = 0.0005


class Lane:
    """Runs blocking calls one at a time in its own thread; the thread is the lock of the wire.

    Several devices on one bus share one lane. A cancelled caller waits for the call under way to end (it is bounded
    by the wire's own time-out), so that no half transaction stays on the wire.

    In virtual time nothing may happen meanwhile, so there is no thread to hand over to: the call is made at once, and
    the loop waits with it. A signal is then served when the call has ended, on a dead wire after its time-out.
    """

    def __init__(self, name: str, clock: Clock) -> None:
        self._clock = clock
        self._executor: ThreadPoolExecutor | None = None
        if not isinstance(clock, VirtualClock):
            sys.setswitchinterval(_SWITCH_S)
            self._executor = ThreadPoolExecutor(max_workers=1, thread_name_prefix=name)

    async def call(self, function: Callable[..., Result], *args: object) -> Result:
        """`function(*args)` in its turn; what it raises is raised here."""
        if self._executor is None:
            return function(*args)
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
        if self._executor is not None:
            self._executor.shutdown(wait=False)
