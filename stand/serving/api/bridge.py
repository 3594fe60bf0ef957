"""Between the control loop, which nobody may delay, and the thread that serves clients.

What clients read is a snapshot that the control loop makes and swaps in as a whole. What passes the hub is numbered and
queued here, the oldest being dropped when nobody takes it. What clients order is called on the control loop, one short
call each, and is answered through a future with a time-out.
"""

from __future__ import annotations

import asyncio
import concurrent.futures
import inspect
import math
import threading
import time
from collections import deque
from collections.abc import Awaitable, Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import TypeVar

from pydantic import BaseModel

from thermostand.foundation.clock import WallClock, utc_offset_ns
from thermostand.foundation.documents import Document
from thermostand.foundation.events import COMMAND
from thermostand.foundation.items import Event, Item, Original, StepMark
from thermostand.foundation.readings import Frame
from thermostand.foundation.tasks import describe_failure
from thermostand.stand.serving.api_models import CommandAnswer, PlanCheck, PlanStep, Requester, StandState, WrittenStep
from thermostand.stand.serving.commands import STOP, Served

_REFRESH_S = 0.5  # twice a second, as often as a person sees a change
_SOONEST_S = 0.05  # between two snapshots of a stand of which much is published
_FRESH_S = 0.3  # so long one who asks for the state waits for a new one
# The thread is never waited for: what it has not taken of so many items is dropped for viewers, never for the
# recording.
_QUEUE = 20_000  # items, which are some MB; the thread takes them four times a second at the least
_PLAN_AGE_S = 5.0  # soak times and expected ends change slowly; the begin or end of a step is shown at once
_STOPPED_S = 0.1  # between two stops, from any client: a flood must not fill the recording
COMMAND_LIMIT_S = 5.0  # a device is given its own time-outs
_FIRST_NS = 1_767_225_600_000_000_000  # 2026-01-01

Result = TypeVar("Result")


class NoAnswer(Exception):
    """The control loop has not answered in time."""


@dataclass(frozen=True, slots=True)
class StateSnapshot:
    """The stand as it was at `at_s` (time.monotonic)."""

    state: StandState
    at_s: float

    @property
    def age_s(self) -> float:
        """How long ago that was."""
        return time.monotonic() - self.at_s


class Bridge:
    """Made, opened and closed on the control loop; `fresh`, `take`, `ask`, `command`, `stop` and `plan` are for the
    other side, `stopping` is for any thread.

    The numbers of the stream go up from one daemon to the next, too: they begin at the time of its start.
    """

    def __init__(self, service: Served) -> None:
        self.failure = ""  # why there is no new snapshot
        self.commands = service.commands
        self._service = service
        self._hub = service.hub
        self._clock = service.clock
        self._loop = asyncio.get_running_loop()
        self._items: deque[tuple[int, int, Item]] = deque(maxlen=_QUEUE)
        self._seq = choose_first_seq()
        self._command_seq = 0
        self._plan: tuple[PlanStep, ...] | None = None
        self._plan_at_s = 0.0
        self._tasks: set[asyncio.Task[None]] = set()
        self._stop_lock = threading.Lock()
        self._stopping: concurrent.futures.Future[BaseModel] | None = None
        self._stopped_s = -math.inf
        self._refreshing: asyncio.Future[None] | None = None
        self._next: asyncio.TimerHandle | None = None
        self._is_open = True
        self.snapshot = StateSnapshot(service.state(), time.monotonic())
        self._refresh()
        self._hub.subscribe(self._follow)

    def close(self) -> None:
        """Stop following the stand and taking orders."""
        self._is_open = False
        self._hub.unsubscribe(self._follow)
        if self._next is not None:
            self._next.cancel()

    def _follow(self, item: Item) -> None:
        if not self._is_open or isinstance(item, Frame | Original):
            return
        self._seq += 1
        self._items.append((self._seq, utc_offset_ns(self._clock), item))
        if isinstance(item, Event | StepMark):
            self._plan = None
            if isinstance(item, Event) and item.kind == COMMAND:
                self._command_seq = self._seq
            self._refresh_within(max(0.0, self.snapshot.at_s + _SOONEST_S - time.monotonic()))

    def _refresh_within(self, wait_s: float) -> None:
        due_s = self._loop.time() + wait_s
        if self._next is None or self._next.when() > due_s:
            if self._next is not None:
                self._next.cancel()
            self._next = self._loop.call_at(due_s, self._refresh)

    def _refresh(self) -> None:
        """Swap in what is now; where that fails the last one stays, which grows old."""
        if not self._is_open:
            return
        try:
            state = self._service.state().model_copy(update={"seq": self._seq})
            self.snapshot, self.failure = StateSnapshot(state, time.monotonic()), ""
        except Exception as error:  # noqa: BLE001 - clients see that it is old; the run does not depend on them
            self.failure = describe_failure(error)
        self._next = None
        self._refresh_within(_REFRESH_S)

    # From here on: called by the thread that serves clients, in its own loop.

    def take(self) -> list[tuple[int, int, Item]]:
        """Return what has been published since, with its number and the offset to UTC then."""
        taken: list[tuple[int, int, Item]] = []
        with suppress(IndexError):
            while True:
                taken.append(self._items.popleft())
        return taken

    async def ask(
        self, call: Callable[[Served], Result | Awaitable[Result]], limit_s: float = COMMAND_LIMIT_S
    ) -> Result:
        """Return what `call` gives on the control loop, or what it raises. NoAnswer when that takes longer than
        `limit_s`: it may still be done."""
        answer: concurrent.futures.Future[Result] = concurrent.futures.Future()
        self._post(lambda: self._call(call, answer))
        return await _wait_within(limit_s, asyncio.wrap_future(answer))

    async def perform(self, name: str, who: Requester, given: Document | None = None) -> BaseModel:
        """Do a command, as `ask`; Done has the number of its event."""
        return await self.ask(self._perform_numbered(name, who, given))

    def _perform_numbered(
        self, name: str, who: Requester, given: Document | None
    ) -> Callable[[Served], Awaitable[BaseModel]]:
        async def numbered(service: Served) -> BaseModel:
            before = self._command_seq
            came = service.perform(name, who, given)
            came = await came if inspect.isawaitable(came) else came
            self._refresh_within(0.0)
            is_numbered = isinstance(came, CommandAnswer) and self._command_seq > before
            return came.model_copy(update={"seq": self._command_seq}) if is_numbered else came

        return numbered

    def request_stop(self, who: Requester) -> concurrent.futures.Future[BaseModel]:
        """The stop that is on its way, begun if there is none; from any thread. One that follows another within 0.1 s
        is done when these are over, with all that came until then. It ends as `ask`, but without a limit, and is not
        to be cancelled: a thousand who stop share it."""
        with self._stop_lock:
            if self._stopping is None or self._stopping.done():
                stopping = self._stopping = concurrent.futures.Future[BaseModel]()
                try:
                    self._post(lambda: self._begin_stop(who, stopping))
                except NoAnswer as error:
                    stopping.set_exception(error)
            return self._stopping

    async def stop(self, who: Requester) -> BaseModel:
        """Stop, as `stopping`. NoAnswer as `ask`."""
        stopping = asyncio.wrap_future(self.request_stop(who))
        stopping.add_done_callback(lambda each: each.cancelled() or each.exception())  # others have it, too
        return await _wait_within(COMMAND_LIMIT_S, asyncio.shield(stopping))

    async def get_fresh_snapshot(self) -> StateSnapshot:
        """The stand as it is now; the last snapshot when the control loop has no time for another one."""
        if self._refreshing is None:
            self._refreshing = asyncio.ensure_future(self.ask(lambda _: self._refresh(), _FRESH_S))
            self._refreshing.add_done_callback(self._finish_refresh)
        with suppress(NoAnswer):
            await asyncio.shield(self._refreshing)
        return self.snapshot

    async def plan(self) -> tuple[PlanStep, ...]:
        """The plan in force, at most some seconds old; made in a thread of its own, as it may be long."""
        plan = self._plan
        if plan is None or time.monotonic() > self._plan_at_s + _PLAN_AGE_S:
            self._plan_at_s = time.monotonic()
            plan = self._plan = await asyncio.to_thread(self._service.plan)
        return plan

    async def check_edit(self, from_index: int, steps: Sequence[WrittenStep]) -> PlanCheck:
        """Return what an edit of the plan would say; in a thread of its own, as `plan`."""
        return await asyncio.to_thread(self._service.check_edit, from_index, steps)

    def _finish_refresh(self, refreshing: asyncio.Future[None]) -> None:
        self._refreshing = None
        if not refreshing.cancelled():
            refreshing.exception()

    def _post(self, call: Callable[[], None]) -> None:
        try:
            self._loop.call_soon_threadsafe(call)
        except RuntimeError:  # it is closed
            raise NoAnswer("the daemon has ended") from None

    def _begin_stop(self, who: Requester, stopping: concurrent.futures.Future[BaseModel]) -> None:
        """Begin the stop, on the control loop."""
        if (wait_s := self._stopped_s + _STOPPED_S - time.monotonic()) > 0.0:
            self._loop.call_later(wait_s, self._begin_stop, who, stopping)
            return
        self._stopped_s = time.monotonic()
        self._call(self._perform_numbered(STOP, who, None), stopping)

    def _call(
        self, call: Callable[[Served], Result | Awaitable[Result]], answer: concurrent.futures.Future[Result]
    ) -> None:
        """Call on the control loop."""
        if not self._is_open:
            answer.set_exception(NoAnswer("the daemon is ending"))
            return
        try:
            result = call(self._service)
        except Exception as error:  # noqa: BLE001 - it belongs to who asked
            _set_answer(answer, error)
            return
        if inspect.isawaitable(result):
            task = asyncio.ensure_future(self._complete(result, answer))
            self._tasks.add(task)
            task.add_done_callback(self._tasks.discard)
        else:
            _set_answer(answer, result)

    async def _complete(self, result: Awaitable[Result], answer: concurrent.futures.Future[Result]) -> None:
        try:
            _set_answer(answer, await result)
        except Exception as error:  # noqa: BLE001 - it belongs to who asked
            _set_answer(answer, error)


def make_no_answer(limit_s: float) -> NoAnswer:
    """Make the answer for a control loop that has taken longer."""
    return NoAnswer(f"the stand has not answered within {limit_s:g} s; it may still do what was asked")


async def _wait_within(limit_s: float, answer: Awaitable[Result]) -> Result:
    try:
        async with asyncio.timeout(limit_s):  # wait_for may lose a cancellation that comes with the answer
            return await answer
    except TimeoutError:
        raise make_no_answer(limit_s) from None


def _set_answer(answer: concurrent.futures.Future[Result], result: Result | Exception) -> None:
    if answer.cancelled() or not answer.set_running_or_notify_cancel():
        return
    if isinstance(result, Exception):
        answer.set_exception(result)
    else:
        answer.set_result(result)


def choose_first_seq() -> int:
    """A number that no daemon before this one has reached: its stream has fewer than 1000 items a second."""
    return (WallClock().now_ns() - _FIRST_NS) // 1_000_000
