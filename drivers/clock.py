"""The one place that reads time or sleeps.

An instant is an int, ns since the epoch; a duration is a float of seconds. Physics, poll periods, soaks and experiment
time-outs run on a Clock; wire time-outs are real seconds and never do. Mixing the two is the classic trap: a 1 s
Modbus time-out at x1000 is 1 ms.
"""

from __future__ import annotations

import asyncio
import heapq
import itertools
import time
from collections.abc import Awaitable, Callable, Generator, Sized
from contextlib import AbstractContextManager, contextmanager, nullcontext
from typing import Protocol

NS_PER_S = 1_000_000_000

_AWAKE_NS = 2_000_000  # a thread that sleeps may be woken this late


class Now(Protocol):
    """The part of a clock that a fake device needs."""

    def now_ns(self) -> int:
        """ns since the epoch; never goes back."""
        ...


class Clock(Now, Protocol):
    """Time as the stand sees it."""

    @property
    def lead_ns(self) -> int:
        """How long before an instant to begin with what must be ready at it; 0 where nothing takes long."""
        ...

    async def sleep_until(self, time_ns: int) -> None:
        """Return at or after `time_ns`; at once when it has passed."""
        ...

    def hold(self) -> AbstractContextManager[None]:
        """Virtual time stands still inside: a transaction, a grab, a commit is under way."""
        ...


def seconds_ns(duration_s: float) -> int:
    """A duration in s as a whole number of ns."""
    return round(duration_s * NS_PER_S)


class WallClock:
    """The host's clock: the epoch read once, then the monotonic counter, so that a step of the host's time is not
    a step of ours."""

    lead_ns = 20_000_000  # a late timer of the event loop, and a camera that starts its acquisition

    def __init__(self) -> None:
        self._epoch_ns = time.time_ns() - time.monotonic_ns()  # noqa: TID251 - the one place that reads time

    def now_ns(self) -> int:
        """ns since the epoch."""
        return self._epoch_ns + time.monotonic_ns()

    async def sleep_until(self, time_ns: int) -> None:
        """Sleep to an absolute deadline; the event loop's timers come up to some ms late."""
        await asyncio.sleep(0)
        while (left_ns := time_ns - self.now_ns()) > 0:  # noqa: ASYNC110 - a timer may come a ns too early
            await asyncio.sleep(left_ns / NS_PER_S)

    def hold(self) -> AbstractContextManager[None]:
        """Real time cannot be held."""
        return nullcontext()


class FollowedClock:
    """The simulator's end of virtual time: it stands where the daemon last put it."""

    def __init__(self, start_ns: int) -> None:
        self._now_ns = start_ns

    def now_ns(self) -> int:
        """The last time it was told."""
        return self._now_ns

    def follow(self, time_ns: int) -> None:
        """Move to `time_ns`; ValueError when that would go back."""
        if time_ns < self._now_ns:
            raise ValueError(f"time cannot go back from {self._now_ns} to {time_ns}")
        self._now_ns = time_ns


class VirtualClock:
    """Time that jumps to the earliest sleeper as soon as nobody holds it and the event loop has nothing else to run.

    Sleepers are woken one at a time, in order of (deadline, order of going to sleep), each only after all that the
    one before set in motion has come to rest. So a run is repeatable to the byte, however the host schedules threads.
    There is one such clock to an event loop: two would each wait for the other to have nothing to run.

    Before time moves, `advance(time_ns)` tells the simulator and waits for its answer.
    """

    lead_ns = 0

    def __init__(self, start_ns: int, advance: Callable[[int], Awaitable[None]] | None = None) -> None:
        self._now_ns = start_ns
        self._advance = advance
        self._holds = 0
        self._sleepers: list[tuple[int, int, asyncio.Future[None]]] = []
        self._order = itertools.count()
        self._changed = asyncio.Event()

    def now_ns(self) -> int:
        """The present virtual instant."""
        return self._now_ns

    async def sleep_until(self, time_ns: int) -> None:
        """Wait for virtual time to reach `time_ns`; even a past deadline takes its turn."""
        future: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        heapq.heappush(self._sleepers, (max(time_ns, self._now_ns), next(self._order), future))
        self._changed.set()
        await future

    @contextmanager
    def hold(self) -> Generator[None]:
        """Virtual time stands still inside."""
        self._holds += 1
        try:
            yield
        finally:
            self._holds -= 1
            self._changed.set()

    async def run(self) -> None:
        """Drive time until cancelled; run it as a task beside whatever sleeps on this clock."""
        while True:
            await self._rest()
            deadline_ns, _, future = heapq.heappop(self._sleepers)
            if future.done():  # cancelled while asleep
                continue
            if deadline_ns > self._now_ns:
                if self._advance is not None:
                    await self._advance(deadline_ns)
                self._now_ns = deadline_ns
            if not future.done():
                future.set_result(None)

    async def _rest(self) -> None:
        """Return when someone sleeps, nobody holds, and the loop has nothing else to run."""
        about_to_run = _about_to_run(asyncio.get_running_loop())
        while True:
            if self._holds or not self._sleepers:
                self._changed.clear()
                await self._changed.wait()
            elif about_to_run:
                await asyncio.sleep(0)
            else:
                return


def block_until(clock: Now, time_ns: int) -> None:
    """Keep the calling thread until `time_ns`, which is some ms ahead, to a tenth of a ms; for lanes. ValueError in
    virtual time, which would never get there."""
    if isinstance(clock, VirtualClock) and clock.now_ns() < time_ns:
        raise ValueError("virtual time does not pass while a thread waits for it")
    while (left_ns := time_ns - clock.now_ns()) > 0:
        time.sleep(max(0, left_ns - _AWAKE_NS) / NS_PER_S)  # noqa: TID251 - the one place that sleeps


def _about_to_run(loop: asyncio.AbstractEventLoop) -> Sized:
    """The callbacks that `loop` will run next, without the one that runs now.

    asyncio keeps them to itself, under this name in every version so far. Counting quiet turns of the loop instead is a
    guess, and six turns for each sleeper were a quarter of the time of a polled night.
    """
    return vars(loop)["_ready"]
