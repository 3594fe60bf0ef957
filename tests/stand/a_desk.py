"""A desk without a stand behind it, and a server for it: what the interface does with answers and refusals."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncGenerator, Mapping, Sequence
from contextlib import asynccontextmanager
from pathlib import Path

from pydantic import JsonValue

from thermostand.experiments.steps import Soak, number_steps
from thermostand.foundation.clock import WallClock
from thermostand.foundation.hub import Hub
from thermostand.foundation.items import Batch, Event
from thermostand.foundation.readings import Reading, bad_reading
from thermostand.stand.config.stand_config import load_config, packaged
from thermostand.stand.gate import INTERLOCK, OPERATOR, Gate
from thermostand.stand.running.memory.state import RunState
from thermostand.stand.running.plan_check import check_edit
from thermostand.stand.serving.api.doors import Interface
from thermostand.stand.serving.api.server import serve
from thermostand.stand.serving.command_event import command_event
from thermostand.stand.serving.desk import (
    Conflict,
    DeviceState,
    Done,
    FaultRequest,
    FaultState,
    HeatByHand,
    KnownFault,
    Missing,
    PlanStep,
    QueuedRun,
    ReadingState,
    RunRequest,
    RunStatus,
    SimulatedFaults,
    StandState,
    Verb,
    When,
    Who,
    WrittenStep,
)
from thermostand.stand.serving.not_confirmed import NotConfirmed
from thermostand.stand.serving.plan_faults import PlanCheck

STAND = "a stand"
KNOWN_FAULTS = (
    KnownFault(name="bus.drop", worst=0.05, mended=0.0, text="share of replies lost"),
    KnownFault(name="flap.jam", worst=2000, mended=None, text="feedback counts at which it stops"),
)


class ADesk:
    """Commands change a gate and a list; `orders` has who gave which."""

    def __init__(self, *reasons: str, run: RunStatus | None = None) -> None:
        self.hub = Hub()
        self.clock = WallClock()
        self.gate = Gate()
        for reason in reasons:
            self.gate.hold(reason)
        self.run = run
        self.by_hand: HeatByHand | None = None
        self.fault: FaultState | None = None
        self.not_confirmed: tuple[NotConfirmed, ...] = ()
        self.moving: tuple[str, ...] = ()
        self.orders: list[tuple[Who, Verb, dict[str, JsonValue]]] = []
        self.queue: list[QueuedRun] = []
        self.is_simulated = True
        self.edited: tuple[WrittenStep, ...] = ()
        self.standing: dict[str, JsonValue] = {}
        self.requests: dict[str, tuple[RunRequest, QueuedRun]] = {}
        self.hub.publish(self.batch(21.5))

    def batch(self, air_degC: float) -> Batch:
        """A poll of the thermometers, one of which is broken."""
        now_ns = self.clock.now_ns()
        broken = bad_reading("thermometers.granite", "degC", now_ns, "wire is broken")
        return Batch("thermometers", now_ns, (Reading("thermometers.air", air_degC, "degC", now_ns), broken))

    def tell(self, text: str, **data: object) -> None:
        """An event."""
        self.hub.publish(Event(self.clock.now_ns(), "info", "reported", text, data))

    def state(self) -> StandState:
        return StandState(
            stand=STAND,
            version="0",
            simulated=self.is_simulated,
            now_ns=self.clock.now_ns(),
            utc_offset_ns=0,
            phase="held" if self.gate.reasons else "idle" if self.run is None else "running",
            run=self.run,
            reasons=tuple(sorted(self.gate.reasons)),
            by_hand=self.by_hand,
            fault=self.fault,
            not_confirmed=self.not_confirmed,
            readings={
                name: ReadingState(
                    value=None if each.quality == "bad" else each.value,
                    unit=each.unit,
                    quality=each.quality,
                    time_ns=each.time_ns,
                )
                for name, each in self.hub.readings.items()
            },
            queue=tuple(self.queue),
        )

    def plan(self) -> tuple[PlanStep, ...]:
        step = {"kind": "soak", "parameters": {"duration_s": 60.0}, "text": "soak", "duration_s": 60.0}
        return (PlanStep.model_validate({"step_id": "0-soak", "index": 0, "standing": "waiting", **step}),)

    def check_edit(self, from_index: int, steps: Sequence[WrittenStep]) -> PlanCheck:
        """Of a run of one step, on the simulated stand."""
        plan = tuple(number_steps([Soak(60.0)]))
        return check_edit(RunState(plan), from_index, steps, load_config(packaged("", "simulated")))

    def devices(self) -> tuple[DeviceState, ...]:
        return (DeviceState(name="flap", kind="flap"),)

    def pause(self, who: Who, when: When = "now") -> Done:
        self.gate.hold(OPERATOR)
        return self._done(who, "pause", {"when": when})

    def continue_(self, who: Who) -> Done:
        self.gate.clear(OPERATOR)
        return self._done(who, "continue", {})

    def clear(self, who: Who) -> Done:
        if INTERLOCK not in self.gate.reasons:
            raise Conflict("there is nothing to clear: no interlock holds this run")
        self.gate.clear(INTERLOCK)
        return self._done(who, "clear", {})

    def stop(self, who: Who) -> Done:
        return self._done(who, "stop", {})

    async def skip(self, who: Who, step_id: str) -> Done:
        if step_id != "0-soak":
            raise Missing("the plan has no such step")
        return self._done(who, "skip", {"step_id": step_id})

    async def extend(self, who: Who, step_id: str, by_s: float) -> Done:
        if step_id != "0-soak":
            raise Missing("the plan has no such step")
        return self._done(who, "extend", {"step_id": step_id, "by_s": by_s})

    async def edit(self, who: Who, from_index: int, steps: Sequence[WrittenStep]) -> Done:
        self.edited = tuple(steps)
        return self._done(who, "edit", {"from_index": from_index, "steps": len(steps)})

    async def submit(self, who: Who, order: RunRequest, key: str = "") -> QueuedRun:
        if key and key in self.requests:
            before, run = self.requests[key]
            if before != order:
                raise Conflict("this key was used for another run")
            return run
        number, now_ns = len(self.queue) + 1, self.clock.now_ns()
        run = QueuedRun(id=number, recipe=order.recipe or "written", state="waiting", added_ns=now_ns, key=key)
        self.queue.append(run)
        self.requests[key] = order, run
        self._done(who, "submit", {"recipe": run.recipe})
        return run

    async def cancel(self, who: Who, run: int) -> Done:
        self._run(run)
        self.queue = [each for each in self.queue if each.id != run]
        return self._done(who, "cancel", {"run": run})

    async def move(self, who: Who, run: int, to: int) -> Done:
        self._run(run)
        return self._done(who, "move", {"run": run, "to": to})

    async def resume(self, who: Who, session: str) -> Done:
        raise Conflict("a run has the stand")

    async def device(self, who: Who, name: str, verb: str, arguments: Mapping[str, JsonValue]) -> Done:
        if name != "flap":
            raise Missing("there is no such device")
        return self._done(who, "device", {"name": name, "verb": verb, "arguments": dict(arguments)})

    async def note(self, who: Who, session: str, text: str, tags: Sequence[str]) -> Done:
        return self._done(who, "note", {"session": session, "text": text, "tags": list(tags)})

    async def known_faults(self) -> SimulatedFaults:
        return SimulatedFaults(faults=KNOWN_FAULTS, standing=dict(self.standing))

    async def break_(self, who: Who, request: FaultRequest) -> Done:
        if request.name not in {each.name for each in KNOWN_FAULTS}:
            raise Missing(f"there is no fault {request.name}")
        if request.mend:
            self.standing.pop(request.name, None)
        else:
            self.standing[request.name] = request.value
        return self._done(who, "fault", request.model_dump())

    def _run(self, number: int) -> None:
        if all(run.id != number for run in self.queue):
            raise Missing(f"no run {number} in the queue")

    def _done(self, who: Who, verb: Verb, arguments: dict[str, JsonValue]) -> Done:
        self.orders.append((who, verb, arguments))
        self.hub.publish(command_event(self.clock.now_ns(), who, verb, arguments))
        return Done(verb=verb, reasons=tuple(sorted(self.gate.reasons)), moving=self.moving)


@asynccontextmanager
async def served(desk: ADesk, session: Path, interface: Interface | None = None) -> AsyncGenerator[ADesk]:
    """The desk, served for that session while inside, and once it answers."""
    async with serve(desk, desk.hub, desk.clock, session, STAND, interface or Interface(session.parent)):
        await asyncio.sleep(0)
        yield desk
