"""Watches the rules; while they hold it keeps heat and cold permitted, and when one objects it makes the stand safe."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from drivers.clock import Clock, seconds_ns
from drivers.interface import DeviceError
from stand.hub import Event, Hub
from stand.interlocks import Fault, Rule, first_fault
from stand.stand import Stand


@dataclass
class Guard:
    """Every `period_s` the rules, every `renew_s` the permits.

    On a fault, in this order: `stop(fault)` latches the stand and cancels the run where it waits, the trip is
    recorded, the actuators are made safe. A permit that cannot be renewed is not a fault by itself: the relay then
    drops, which is its safe state, and the event says so.
    """

    stand: Stand
    rules: tuple[Rule, ...]
    hub: Hub
    clock: Clock
    period_s: float
    renew_s: float
    stop: Callable[[Fault], None]

    async def check(self) -> bool:
        """Whether every rule holds; when one does not, the stand has been made safe."""
        fault = first_fault(self.rules, self.hub, self.clock.now_ns())
        if fault is None:
            return True
        self.stop(fault)
        self.hub.publish(Event(self.clock.now_ns(), "error", f"guard.{fault.rule}", fault.text))
        await self.stand.make_safe()
        return False

    async def run(self) -> None:
        """Watch until cancelled or tripped."""
        renew_ns = due_ns = self.clock.now_ns()
        while await self.check():
            if self.clock.now_ns() >= renew_ns:
                renew_ns = self.clock.now_ns() + seconds_ns(self.renew_s)
                await self._renew()
            due_ns = max(due_ns + seconds_ns(self.period_s), self.clock.now_ns())
            await self.clock.sleep_until(due_ns)

    async def _renew(self) -> None:
        try:
            await self.stand.renew_permits()
        except DeviceError as error:
            text = f"heating and cooling permits not renewed: {error}"
            self.hub.publish(Event(self.clock.now_ns(), "warning", "permit_not_renewed", text))
