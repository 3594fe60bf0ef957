"""A guard over rules whose objections a test switches."""

import asyncio
from typing import Any

from thermostand.foundation.clock import Clock, VirtualClock, to_ns
from thermostand.foundation.errors import DeviceFault
from thermostand.foundation.hub import Hub
from thermostand.foundation.items import Event
from thermostand.stand.guarding.guard import Guard
from thermostand.stand.safety.fault import Fault, Readings, Rule, Watch
from thermostand.stand.safety.gate import Gate
from thermostand.stand.safety.latch import Latch, LatchFile
from thermostand.stand.safety.making_safe import Safety


class PlainActuator:
    """Writes down that it was made safe, or does not confirm it."""

    name = "relays"

    def __init__(self, log: list[str]) -> None:
        self.log = log
        self.failure = ""

    async def make_safe(self) -> None:
        await asyncio.sleep(0)
        self.log.append("safe")
        if self.failure:
            raise DeviceFault(self.name, self.failure)


class NotedFile(LatchFile):
    """Writes down what is kept."""

    def __init__(self, log: list[str]) -> None:
        super().__init__(())
        self.log = log

    def keep(self, fault: Fault, since_ns: int) -> str:
        self.log.append(f"latch {fault.rule}")
        return ""


class Bench:
    """A guard over rules whose objections a test switches."""

    def __init__(
        self,
        *actions: Any,
        can_hold: bool = True,
        clock: Clock | None = None,
    ) -> None:
        self.log: list[str] = []
        self.events: list[Event] = []
        self.clock = clock or VirtualClock(0)
        self.broken: Exception | None = None  # what the rules raise
        self.objecting: set[int] = set()
        self.actuator = PlainActuator(self.log)
        self.hub = hub = Hub()
        self.safety = Safety(lambda: self.log.append("revoke"), hub, self.clock)
        self.safety.take(self.actuator, 60.0)
        hub.subscribe(lambda item: self.events.append(item) if isinstance(item, Event) else None)
        watches = tuple(Watch(self._rule(index), 0.0, action) for index, action in enumerate(actions))
        stop, hold = (lambda fault, name=name: self.log.append(f"{name} {fault.rule}") for name in ("stop", "hold"))
        self.latch = Latch(Gate(), hub, self.clock)
        self.guard = Guard(
            safety=self.safety,
            latch=self.latch,
            watches=watches,
            hub=hub,
            clock=self.clock,
            period_s=1.0,
            stop=stop,
            hold=hold if can_hold else None,
            release=self._release,
        )

    def clear(self) -> None:
        """As an operator does."""
        if self.latch.fault is not None:
            self.latch.reset()
            self.guard.reset_grace_times()
            self.guard.recheck_holds()

    def _release(self) -> None:
        self.log.append("release")
        self.latch.reset()

    def _rule(self, index: int) -> Rule:
        def rule(readings: Readings, now_ns: int) -> Fault | None:
            if self.broken is not None:
                raise self.broken
            return Fault(f"rule{index}", "it is so") if index in self.objecting else None

        return rule

    async def run_for(self, duration_s: float) -> bool:
        """Let the guard watch for a while; whether it still does."""
        time = asyncio.create_task(self.clock.run())
        watching = asyncio.create_task(self.guard.run())
        await self.clock.sleep_until(self.clock.now_ns() + to_ns(duration_s))
        still = not watching.done()
        for task in (watching, time):
            task.cancel()
        await asyncio.gather(watching, time, return_exceptions=True)
        return still
