"""Watches the rules; while they hold it keeps heat and cold permitted, and when one objects it makes the stand safe."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from dataclasses import dataclass, field

from drivers.clock import Clock, seconds_ns
from drivers.interface import DeviceError
from stand.hub import Event, Hub
from stand.interlocks import Fault, Watch
from stand.notify import Notifier
from stand.stand import Stand


@dataclass
class Guard:
    """Every `period_s` the rules, every `renew_s` the permits.

    On a fault, in this order: `stop(fault)` latches the stand and cancels the run where it waits, or `hold(fault)`
    latches it and lets the run wait; the trip is recorded, the actuators are made safe, somebody is told. A hold stays
    until `clear`; only a fault that aborts acts meanwhile. Without a `hold` every trip aborts. A permit that cannot be
    renewed is not a fault by itself: the relay then drops, which is its safe state, and the event says so.
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

    async def check(self) -> bool:
        """Whether the guard goes on; False when the run was aborted and the stand has been made safe."""
        faults = self._faults()
        fault = next((each for each in faults if each.action == "abort" or self.hold is None), None)
        if fault is not None:
            self.stop(fault)
            await self._make_safe(fault)
            return False
        if faults and self.hold is not None and self.held is None:
            self.held = faults[0]
            self.hold(faults[0])
            await self._make_safe(faults[0])
        return True

    def clear(self) -> Fault | None:
        """An operator has looked: the hold, which is returned, is forgotten, and every rule has its grace time anew.
        What is still wrong trips again. Letting the run go on is the caller's."""
        fault, self.held = self.held, None
        for watch in self.watches:
            watch.since_ns = None
        return fault

    async def run(self) -> None:
        """Watch until cancelled or aborted."""
        renew_ns = due_ns = self.clock.now_ns()
        while await self.check():
            if self.clock.now_ns() >= renew_ns and self.held is None:
                renew_ns = self.clock.now_ns() + seconds_ns(self.renew_s)
                await self._renew()
            due_ns = max(due_ns + seconds_ns(self.period_s), self.clock.now_ns())
            await self.clock.sleep_until(due_ns)

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
            await self._notify(fault.text)

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

    async def _renew(self) -> None:
        try:
            await self.stand.renew_permits()
        except DeviceError as error:
            text = f"heating and cooling permits not renewed: {error}"
            self.hub.publish(Event(self.clock.now_ns(), "warning", "permit_not_renewed", text))
