"""The one owner of making safe: every actuator, until it has confirmed.

A rule, the operator or a run that ends demands it, without waiting for it. Permissions are
gone at once. Each actuator has a task of its own, so that one that does not answer delays none of the others.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from thermostand.foundation.clock import Clock, to_ns
from thermostand.foundation.errors import GarbledReply, Unreachable
from thermostand.foundation.events import CONFIRMED_SAFE, NOT_CONFIRMED_SAFE
from thermostand.foundation.hub import Hub
from thermostand.foundation.tasks import wait_for_first

# Below the 15 s of the relay board's own timer.
TRY_LIMIT_S = 10.0  # real seconds of one try; the dead-man relay drops by itself after that
_PAUSE_S = 1.0  # between tries
_REPORTED_AFTER_S = 60.0  # round number; nothing was measured
_GIVEN_UP_AFTER_S = 60.0  # before that, a second signal does not end it


class SafetyActuator(Protocol):
    """What of an actuator is needed here."""

    @property
    def name(self) -> str:
        """The name for the sentence that says what is not confirmed."""
        ...

    async def make_safe(self) -> None:
        """Bring it to its safe state, now; raises when that could not be confirmed."""
        ...


@dataclass(frozen=True, slots=True)
class Pending:
    """An actuator that has not confirmed its safe state, which was demanded at since_ns. failure: why the last try did
    not confirm it, "" while the first one is under way."""

    name: str
    since_ns: int
    failure: str


class _SafeStateTask:
    """Makes one actuator safe as often as it is demanded, and until it confirms.

    A demand is met by a call that begins after it: one under way may already have passed what a verb commands now.
    """

    def __init__(self, actuator: SafetyActuator, pause_s: float, clock: Clock, changed: Callable[[], None]) -> None:
        self.failure = ""  # why the last try did not confirm
        self.demanded = self.begun = self.tried = self.confirmed = 0
        self._since_ns = 0  # when the first demand was made that is not confirmed
        self._actuator = actuator
        self._pause_s = pause_s
        self._clock = clock
        self._changed = changed
        self._demand = asyncio.Event()
        self._task: asyncio.Task[None] | None = None

    def demand(self) -> None:
        """Begin at once, also when the last try has just failed; one that has not begun yet serves two demands."""
        if self.demanded > self.begun:
            return
        if self.confirmed == self.demanded:
            self._since_ns = self._clock.now_ns()
        self.demanded += 1
        self._demand.set()
        if self._task is None or self._task.done() or self._task.cancelling():
            self._task = asyncio.create_task(self._until_confirmed())

    def pending(self) -> Pending | None:
        """Return what is not confirmed yet; None when what was demanded is."""
        is_confirmed = self.confirmed == self.demanded
        return None if is_confirmed else Pending(self._actuator.name, self._since_ns, self.failure)

    def cancel(self) -> None:
        """An operator has taken over: what is not confirmed yet is tried no more."""
        if self._task is not None:
            self._task.cancel()
        self.failure, self.begun, self.tried, self.confirmed = "", self.demanded, self.demanded, self.demanded

    async def close(self) -> None:
        """Try no more."""
        if self._task is not None:
            self._task.cancel()
            await asyncio.wait([self._task])

    async def _until_confirmed(self) -> None:
        while self.confirmed < self.demanded:
            self._demand.clear()
            demand = self.begun = self.demanded
            self.failure = await self._try()
            self.tried = demand
            if not self.failure:
                self.confirmed = demand
            self._changed()
            if self.failure:
                await self._pause()

    async def _try(self) -> str:
        """Return why it is not confirmed, "" when it is; after a lost answer it is called a second time at once."""
        name = self._actuator.name
        try:
            async with asyncio.timeout(TRY_LIMIT_S):
                try:
                    await self._actuator.make_safe()
                except (Unreachable, GarbledReply):
                    await self._actuator.make_safe()
        except Exception as error:  # noqa: BLE001 - an actuator that fails in any way is tried again
            return f"{name} did not confirm its safe state: {str(error) or 'no answer in time'}"
        return ""

    async def _pause(self) -> None:
        """Wait until the next try is due, or demanded."""
        due_ns = self._clock.now_ns() + to_ns(self._pause_s)
        await wait_for_first(self._clock.sleep_until(due_ns), self._demand.wait())


class Safety:
    """Brings every actuator it has taken to its safe state. `revoke` takes back every permission, at once.

    It continues until each has confirmed what was demanded last; `close` ends that. An actuator is taken when it has
    been opened: a device that another run has open is not commanded.
    """

    def __init__(self, revoke: Callable[[], None], hub: Hub, clock: Clock) -> None:
        self._makers: tuple[_SafeStateTask, ...] = ()
        self._until_cleared: dict[SafetyActuator, _SafeStateTask] = {}
        self._revoke = revoke
        self._hub = hub
        self._clock = clock
        self._reported: dict[_SafeStateTask, str] = {}
        self._changed = asyncio.Event()  # set, and replaced, when something was tried
        self._unsafe_since_ns: int | None = None
        self._given_up = False

    @property
    def unconfirmed(self) -> tuple[str, ...]:
        """What has been tried and not confirmed, a sentence each."""
        return tuple(maker.failure for maker in self._makers if maker.failure)

    @property
    def pending(self) -> tuple[Pending, ...]:
        """What has not confirmed its safe state, be it tried or not."""
        return tuple(pending for maker in self._makers if (pending := maker.pending()) is not None)

    @property
    def is_confirmed(self) -> bool:
        """Whether everything demanded so far is confirmed."""
        return all(maker.confirmed == maker.demanded for maker in self._makers)

    def demand(self) -> None:
        """Permissions are gone when this returns, and every actuator is being made safe; it waits for nothing."""
        self._revoke()
        if self._unsafe_since_ns is None:
            self._unsafe_since_ns = self._clock.now_ns()
        for maker in self._makers:
            maker.demand()

    def take(self, actuator: SafetyActuator, pause_s: float = _PAUSE_S) -> None:
        """Make this actuator, too, safe with each demand from now on, and again after `pause_s` while it does not
        confirm."""
        self._makers = (*self._makers, _SafeStateTask(actuator, pause_s, self._clock, self._on_change))

    def add_until_cleared(self, actuator: SafetyActuator) -> None:
        """Take an actuator as `take` does, until an operator resets the hold."""
        if actuator not in self._until_cleared:
            self.take(actuator)
            self._until_cleared[actuator] = self._makers[-1]

    def give_up(self) -> bool:
        """An operator does not want to wait for the confirmation any more: whether that ends the wait, as it does from
        a minute after the demand on."""
        since_ns = self._unsafe_since_ns
        late = since_ns is not None and self._clock.now_ns() - since_ns >= to_ns(_GIVEN_UP_AFTER_S)
        if late and not self._given_up:
            self._given_up = True
            self._on_change()
        return self._given_up

    def reset_give_up(self) -> None:
        """Wait for confirmations again: an operator who did not want to wait for one may want to for the next."""
        self._given_up = False

    def cancel_pending(self) -> None:
        """An operator has reset the hold: what is not confirmed is tried no more, or it would undo what the run does
        from now on."""
        for maker in self._makers:
            maker.cancel()
        self._makers = tuple(maker for maker in self._makers if maker not in self._until_cleared.values())
        self._until_cleared.clear()
        self._on_change()

    async def wait_until_tried(self) -> None:
        """Return when every actuator has been tried once since the last demand, with or without success."""
        while any(maker.tried < maker.demanded for maker in self._makers):
            await self._changed.wait()

    async def wait_until_settled(self) -> None:
        """Return when everything is confirmed, or an operator has given up."""
        await self.wait_until_tried()
        while not (self.is_confirmed or self._given_up):
            await self._changed.wait()

    async def wait_until_confirmed(self, limit_s: float) -> bool:
        """Return whether everything is confirmed within that time, on the stand's clock, and before an operator gives
        up; an event says what is not, after a minute and then each time in twice as long."""
        end_ns, wait_s = self._clock.now_ns() + to_ns(limit_s), _REPORTED_AFTER_S
        await self.wait_until_tried()
        while not self.is_confirmed and not self._given_up and self._clock.now_ns() < end_ns:
            due_ns = min(end_ns, self._clock.now_ns() + to_ns(wait_s))
            wait_s *= 2.0
            if not await self._wait_for_change(due_ns) and not self.is_confirmed:
                text, unconfirmed = f"still trying: {'; '.join(self.unconfirmed)}", list(self.unconfirmed)
                self._hub.publish(NOT_CONFIRMED_SAFE.at(self._clock.now_ns(), text, unconfirmed=unconfirmed))
        return self.is_confirmed

    async def close(self) -> None:
        """Try no more; may be called twice."""
        await asyncio.gather(*(maker.close() for maker in self._makers))

    async def _wait_for_change(self, due_ns: int) -> bool:
        """Wait for the confirmation, or for an operator to give up, until then."""
        sleeping = asyncio.ensure_future(self._clock.sleep_until(due_ns))
        try:
            while not (sleeping.done() or self.is_confirmed or self._given_up):
                changed = asyncio.ensure_future(self._changed.wait())
                await asyncio.wait((sleeping, changed), return_when=asyncio.FIRST_COMPLETED)
                changed.cancel()
            return not sleeping.done()
        finally:
            sleeping.cancel()

    def _on_change(self) -> None:
        self._report()
        if self.is_confirmed:
            self._unsafe_since_ns = None
        self._changed.set()
        self._changed = asyncio.Event()

    def _report(self) -> None:
        """Each new reason, and the end of the last one."""
        for maker in self._makers:
            if maker.failure and self._reported.get(maker) != maker.failure:
                self._reported[maker] = maker.failure
                unsafe = NOT_CONFIRMED_SAFE.at(self._clock.now_ns(), maker.failure, unconfirmed=[maker.failure])
                self._hub.publish(unsafe)
        if self._reported and self.is_confirmed:
            self._reported.clear()
            self._hub.publish(CONFIRMED_SAFE.at(self._clock.now_ns()))
