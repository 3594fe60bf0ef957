"""Watches the rules; while they hold it keeps heat and cold permitted, and when one objects it makes the stand safe."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from dataclasses import dataclass, field

from drivers.clock import NS_PER_S, Clock, seconds_ns
from drivers.interface import DeviceError
from stand.guarding.interlocks import Fault, Watch
from stand.guarding.notify import Notifier
from stand.hub import Event, Hub
from stand.stand import Stand

_SAFE_AGAIN_S = 60.0  # between tries, while it is not confirmed: a jammed flap's motor must not be worn


@dataclass
class Guard:
    """Every `period_s` the rules, every `renew_s` the permits.

    On a fault, in this order: `stop(fault)` latches the stand and cancels the run where it waits, or `hold(fault)`
    latches it and lets the run wait; the trip is recorded, the actuators are made safe, somebody is told. A hold stays
    until `clear`; only a fault that aborts acts meanwhile, and what is not confirmed safe is tried again. Without a
    `hold` every trip aborts. A permit that cannot be renewed is not a fault by itself: the relay then drops, which is
    its safe state, and the event says so. A guard that fails aborts.
    """

    stand: Stand
    watches: tuple[Watch, ...]
    hub: Hub
    clock: Clock
    period_s: float
    renew_s: float
    stop: Callable[[Fault], None]
    hold: Callable[[Fault], None] | None = None
    notifier: Notifier | None = None
    held: Fault | None = None  # why the run waits
    _warned: set[int] = field(default_factory=set[int])  # watches whose warning stands
    _to_make_safe: bool = False  # the hold is new
    _made_safe_ns: int = 0

    async def check(self) -> bool:
        """Whether the guard goes on; False when the run was aborted and the stand has been made safe."""
        faults = self._faults()
        fault = next((each for each in faults if each.action == "abort" or self.hold is None), None)
        if fault is not None:
            self.stop(fault)
            await self._make_safe(fault)
            return False
        if faults and self.held is None:
            self._hold(faults[0])
        if self.held is not None:
            await self._keep_safe(self.held)
        return True

    def clear(self) -> Fault | None:
        """An operator has looked: the hold, which is returned, is forgotten, and every rule has its grace time anew.
        What is wrong still trips again, what has no grace time before anything moves. Letting the run go on is the
        caller's."""
        fault, self.held = self.held, None
        for watch in self.watches:
            watch.since_ns = None
        if fault is not None and (still := self._faults()):
            self._hold(still[0])
        return fault

    async def run(self) -> None:
        """Watch until cancelled or aborted."""
        self._tell_deafness()
        try:
            await self._watch()
        except Exception as error:
            fault = Fault("guard_failed", f"the guard failed ({type(error).__name__}: {error})")
            self.stop(fault)
            await self._make_safe(fault)
            raise

    async def _watch(self) -> None:
        renew_ns = due_ns = self.clock.now_ns()
        while await self.check():
            if self.clock.now_ns() >= renew_ns and self.held is None:
                renew_ns = self.clock.now_ns() + seconds_ns(self.renew_s)
                await self._renew()
            due_ns = max(due_ns + seconds_ns(self.period_s), self.clock.now_ns())
            await self.clock.sleep_until(due_ns)
            self._tell_lateness(due_ns)

    def _hold(self, fault: Fault) -> None:
        """From now on the run waits; the next look makes safe. Nothing without a way to hold."""
        if self.hold is not None:
            self.held, self._to_make_safe = fault, True
            self.hold(fault)

    async def _keep_safe(self, fault: Fault) -> None:
        """Make safe at the begin of a hold, and while that is not confirmed again and again."""
        if self._to_make_safe:
            self._to_make_safe, self._made_safe_ns = False, self.clock.now_ns()
            await self._make_safe(fault)
        elif self.stand.unconfirmed and self.clock.now_ns() >= self._made_safe_ns + seconds_ns(_SAFE_AGAIN_S):
            self._made_safe_ns = self.clock.now_ns()
            await self.stand.make_safe()

    def _faults(self) -> list[Fault]:
        """Those that trip; those that only warn are published when they begin. Every rule is asked: some remember."""
        now_ns = self.clock.now_ns()
        faults: list[Fault] = []
        for index, watch in enumerate(self.watches):
            fault = watch.check(self.hub, now_ns)
            if watch.action != "warn":
                if fault is not None:
                    faults.append(fault)
            elif fault is None:
                self._warned.discard(index)
            elif index not in self._warned:
                self._warned.add(index)
                self.hub.publish(Event(now_ns, "warning", f"guard.{fault.rule}", fault.text))
        return faults

    async def _make_safe(self, fault: Fault) -> None:
        self.hub.publish(Event(self.clock.now_ns(), "error", f"guard.{fault.rule}", fault.text))
        try:
            await self.stand.make_safe()
        finally:  # also when the run that waits for this look has just been cancelled
            unsafe = self.stand.unconfirmed
            await self._notify(f"{fault.text}; NOT SAFE: {'; '.join(unsafe)}" if unsafe else fault.text)

    async def _notify(self, text: str) -> None:
        """Tell, to its end also when the guard is cancelled meanwhile: an aborted run does that at once."""
        telling = asyncio.ensure_future(self._tell(text))
        try:
            await asyncio.shield(telling)
        except asyncio.CancelledError:
            await asyncio.wait([telling])
            raise

    async def _tell(self, text: str) -> None:
        failure = "" if self.notifier is None else await self.notifier.tell(text)
        if failure:
            self.hub.publish(Event(self.clock.now_ns(), "warning", "notify_failed", failure))

    def _tell_deafness(self) -> None:
        """A command that cannot be run is found now, not at the first trip."""
        missing = "" if self.notifier is None else self.notifier.missing()
        if missing:
            self.hub.publish(Event(self.clock.now_ns(), "warning", "notify_failed", missing))

    def _tell_lateness(self, due_ns: int) -> None:
        """Whoever keeps the event loop from its turn keeps the guard from looking; the permits have dropped then."""
        late_s = (self.clock.now_ns() - due_ns) / NS_PER_S
        if late_s > self.renew_s:
            text = f"the guard looked {late_s:.1f} s late: the daemon was held up"
            self.hub.publish(Event(self.clock.now_ns(), "warning", "guard_late", text))

    async def _renew(self) -> None:
        try:
            await self.stand.renew_permits()
        except DeviceError as error:
            text = f"heating and cooling permits not renewed: {error}"
            self.hub.publish(Event(self.clock.now_ns(), "warning", "permit_not_renewed", text))
