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
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

NS_PER_S = 1_000_000_000
PIECE_S = 1.0  # the longest that anybody sleeps on a timer that stands still while the host is suspended

# Measured on a virtual machine: with 2 ms frames were late by 2.6 ms (99th percentile), with 5 ms by 0.03 and 0.27 in
# two runs. It costs 0.5 % of a core at one frame a second; half of it is not enough, twice costs 1 %.
_AWAKE_NS = 5_000_000  # a thread that sleeps may be woken this late
_BOOT_TIME = getattr(time, "CLOCK_BOOTTIME", time.CLOCK_MONOTONIC)  # Linux; elsewhere only recordings are read
_LOOK_NS, _LOOKS = 1_000_000, 5  # of two clocks at one instant


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


def to_ns(duration_s: float) -> int:
    """A duration in s as a whole number of ns."""
    return round(duration_s * NS_PER_S)


def boot_time_ns() -> int:
    """ns since the host was started, time in which it was suspended included; never goes back (CLOCK_BOOTTIME)."""
    return time.clock_gettime_ns(_BOOT_TIME)


def _awake_ns() -> int:
    return time.monotonic_ns()


def _utc_ns() -> int:
    return time.time_ns()  # noqa: TID251 - the one place that reads time


def _boot_id() -> str:
    try:
        return Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()
    except (OSError, ValueError):
        return ""


@dataclass(frozen=True, slots=True)
class Boot:
    """A start of the host and the stand's instant at which its boot time was 0. `id` is the kernel's name of it, ""
    when it has none. Boot time outlives the process and is not moved by a step of the system clock, as UTC is."""

    id: str
    began_ns: int

    def time_ns(self, stand_ns: int) -> int:
        """The boot time of an instant of the stand's clock."""
        return stand_ns - self.began_ns

    def stand_ns(self, time_ns: int) -> int:
        """The instant of the stand's clock of a boot time."""
        return time_ns + self.began_ns


class WallClock:
    """The host's clock: UTC read once, then boot time. So a step of the system clock is not a step of ours, and the
    time of a suspend, in which CLOCK_MONOTONIC and every timer of an event loop stand still, has passed here.

    `no_earlier_than_ns`: an instant that a clock before this one has reached already. A system clock that was set back
    since is not followed behind it: that is an offset to UTC from the start. `boot_ns`, `utc_ns` and `awake_ns` (boot
    time without suspends) read the host's clocks; tests give their own.
    """

    lead_ns = 20_000_000  # a late timer of the event loop, and a camera that starts its acquisition

    def __init__(
        self,
        no_earlier_than_ns: int = 0,
        boot_ns: Callable[[], int] = boot_time_ns,
        utc_ns: Callable[[], int] = _utc_ns,
        awake_ns: Callable[[], int] = _awake_ns,
    ) -> None:
        self._boot_ns, self._utc_ns, self._awake_ns = boot_ns, utc_ns, awake_ns
        now_ns = boot_ns()
        self.boot = Boot(_boot_id(), max(now_ns + self._minus_boot_ns(utc_ns), no_earlier_than_ns) - now_ns)

    def now_ns(self) -> int:
        """ns since the epoch."""
        return self._boot_ns() + self.boot.began_ns

    def utc_offset_ns(self) -> int:
        """UTC as the system clock has it now, minus the instant now."""
        return self._minus_boot_ns(self._utc_ns) - self.boot.began_ns

    def suspended_ns(self) -> int:
        """Return how long the host has been suspended since it was started."""
        return -self._minus_boot_ns(self._awake_ns)

    def _minus_boot_ns(self, read_ns: Callable[[], int]) -> int:
        """A clock minus the boot time, read between two looks at the latter; a process that was kept from running
        between them looks again."""
        looks: list[tuple[int, int]] = []
        for _ in range(_LOOKS):
            before_ns, other_ns, after_ns = self._boot_ns(), read_ns(), self._boot_ns()
            looks.append((after_ns - before_ns, other_ns - before_ns))
            if after_ns - before_ns < _LOOK_NS:
                break
        return min(looks)[1]

    async def sleep_until(self, time_ns: int) -> None:
        """Sleep to an absolute deadline; the event loop's timers come up to some ms late. They stand still while the
        host is suspended, so one that waits for more than a second waits in pieces."""
        await asyncio.sleep(0)
        while (left_ns := time_ns - self.now_ns()) > 0:  # noqa: ASYNC110 - a timer may come a ns too early
            await asyncio.sleep(min(left_ns / NS_PER_S, PIECE_S))

    def hold(self) -> AbstractContextManager[None]:
        """Real time cannot be held."""
        return nullcontext()


def get_boot(clock: Now) -> Boot | None:
    """The start of the host that `clock` counts from; None for virtual time, which has none."""
    return clock.boot if isinstance(clock, WallClock) else None


def utc_offset_ns(clock: Now) -> int:
    """UTC minus the instant now; 0 in virtual time, which is its own UTC."""
    return clock.utc_offset_ns() if isinstance(clock, WallClock) else 0


class FollowedClock:
    """The simulator's end of virtual time: it stands where the daemon last put it."""

    def __init__(self, start_ns: int) -> None:
        self._now_ns = start_ns

    def now_ns(self) -> int:
        """The last time it was given."""
        return self._now_ns

    def follow(self, time_ns: int) -> None:
        """Move to `time_ns`; ValueError when that would go back."""
        if time_ns < self._now_ns:
            raise ValueError(f"time cannot go back from {self._now_ns} to {time_ns}")
        self._now_ns = time_ns


class VirtualClock:
    """Time that jumps to the earliest sleeper as soon as nothing holds it and the event loop has nothing else to run.

    Sleepers are woken one at a time, in order of (deadline, order of going to sleep), each only after all that the
    one before set in motion has come to rest. So a run is repeatable to the byte, however the host schedules threads.
    There is one such clock to an event loop: two would each wait for the other to have nothing to run.

    When time moves, `advance(time_ns)` informs the simulator and waits for its answer before anybody is woken. The new
    time holds from then on: what comes from outside meanwhile, such as a signal, must not date what it does to the
    simulator before it, or the time between would seem to have passed without effect.

    `await_answers` blocks until the simulated devices have answered all that has arrived at them.
    """

    lead_ns = 0

    def __init__(
        self,
        start_ns: int,
        advance: Callable[[int], Awaitable[None]] | None = None,
        await_answers: Callable[[], None] | None = None,
    ) -> None:
        self._now_ns = start_ns
        self._advance = advance
        self.await_answers = await_answers
        self._holds = 0
        self._sleepers: list[tuple[int, int, asyncio.Future[None]]] = []
        self._order = itertools.count()
        self._changed = asyncio.Event()
        self._alone: asyncio.Task[None] | None = None

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
        """Drive time until cancelled; run it as a task along with those that sleep on this clock. Raises what `advance`
        raises; time goes on without it, since what ends a run sleeps, too."""
        while True:
            await self._rest()
            deadline_ns, _, future = heapq.heappop(self._sleepers)
            if future.done():  # cancelled while asleep
                continue
            if deadline_ns > self._now_ns:
                self._now_ns = deadline_ns
                try:
                    if self._advance is not None:
                        await self._advance(deadline_ns)
                except Exception:
                    heapq.heappush(self._sleepers, (deadline_ns, -1, future))
                    self._advance = None
                    self._alone = asyncio.create_task(self.run())
                    raise
            if not future.done():
                future.set_result(None)

    async def _rest(self) -> None:
        """Return when a task sleeps, nothing holds time, and the loop has nothing else to run."""
        about_to_run = _get_ready_callbacks(asyncio.get_running_loop())
        while True:
            if self._holds or not self._sleepers:
                self._changed.clear()
                await self._changed.wait()
            elif about_to_run:
                await asyncio.sleep(0)
            else:
                return


def compute_call_pause_s(clock: Now, pause_s: float) -> float:
    """Real seconds to keep between two calls of a device that wants `pause_s`. In virtual time a call takes none, so
    none pass between the calls of one instant, and those of two instants are apart on the clock."""
    return 0.0 if isinstance(clock, VirtualClock) else pause_s


def await_simulated_answers(clock: Now | None) -> bool:
    """Return whether a reply that has not come by now never comes, since the simulated devices have answered all that
    was asked: they are waited for, however busy the host. False at once in real time, where nobody can know."""
    if not isinstance(clock, VirtualClock) or clock.await_answers is None:
        return False
    clock.await_answers()
    return True


def block_until(clock: Now, time_ns: int) -> None:
    """Keep the calling thread until `time_ns`, which is some ms ahead, to a tenth of a ms; for lanes. ValueError in
    virtual time, which would never get there."""
    if isinstance(clock, VirtualClock) and clock.now_ns() < time_ns:
        raise ValueError("virtual time does not pass while a thread waits for it")
    while (left_ns := time_ns - clock.now_ns()) > 0:
        time.sleep(min(max(0, left_ns - _AWAKE_NS) / NS_PER_S, PIECE_S))  # noqa: TID251 - the one place that sleeps


def _get_ready_callbacks(loop: asyncio.AbstractEventLoop) -> Sized:
    """The callbacks that `loop` will run next, without the one that runs now.

    asyncio keeps them to itself, under this name in every version so far. Counting quiet turns of the loop instead is a
    guess, and six turns for each sleeper were a quarter of the time of a polled session.
    """
    return vars(loop)["_ready"]
