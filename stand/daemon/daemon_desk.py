"""What may be asked of a daemon: of the run it has as its guest, of its queue, and of the devices between runs."""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Mapping, Sequence
from dataclasses import asdict
from typing import NoReturn, TypeVar

from pydantic import JsonValue

from thermostand.foundation.errors import StandError
from thermostand.foundation.patience import Patience
from thermostand.stand.daemon.daemon import Daemon
from thermostand.stand.gate import INTERLOCK
from thermostand.stand.running.run_desk import RunDesk
from thermostand.stand.running.said import Said, keep
from thermostand.stand.running.simulated_faults import break_or_mend, simulated_faults
from thermostand.stand.serving.command_event import command_event
from thermostand.stand.serving.desk import (
    Conflict,
    DeviceState,
    Done,
    FaultRequest,
    FaultState,
    HeatByHand,
    PlanStep,
    QueuedRun,
    RunRequest,
    SimulatedFaults,
    StandState,
    Verb,
    When,
    Who,
    WrittenStep,
)
from thermostand.stand.serving.plan_faults import PlanCheck
from thermostand.stand.serving.seen import seen_state

Result = TypeVar("Result")
_NOTHING_RUNS = "nothing is run now"


class DaemonDesk:
    """stand/serving/desk.py has what each method does. What concerns a run is asked of the run's own desk."""

    def __init__(self, daemon: Daemon) -> None:
        self._daemon = daemon
        self._assembly = daemon.open_stand.assembly

    def state(self) -> StandState:
        """As it is now."""
        daemon, assembly, run = self._daemon, self._assembly, self._run
        state = (
            seen_state(assembly.config, assembly.stand, assembly.hub, assembly.clock) if run is None else run.state()
        )
        changes: dict[str, object] = {
            "queue": daemon.orders.shown(),
            "queue_halted": daemon.orders.queued.halted,
            "counters": {name: round(value, 4) for name, value in daemon.counters.values.items()},
            "fault": state.fault or self._fault(),
            "busy": daemon.busy,
        }
        if run is None:
            changes["disk_free_bytes"] = daemon.disk_free_bytes
            if daemon.has_guest:
                changes["phase"] = "stopping" if daemon.orders.leaving else "running"
            else:
                changes["by_hand"] = self._heat_by_hand()
        return state.model_copy(update=changes)

    def plan(self) -> tuple[PlanStep, ...]:
        """The plan in force; empty when nothing is run."""
        run = self._run
        return () if run is None else run.plan()

    def check_edit(self, from_index: int, steps: Sequence[WrittenStep]) -> PlanCheck:
        """What an edit would say; nothing is ordered, so nothing is recorded."""
        run = self._run
        if run is None:
            raise Conflict(_NOTHING_RUNS)
        return run.check_edit(from_index, steps)

    def devices(self) -> tuple[DeviceState, ...]:
        """The commands that devices take by hand."""
        return self._daemon.by_hand.devices(self._daemon.refused_by_hand())

    def pause(self, who: Who, when: When = "now") -> Done:
        """Hold the run."""
        return self._of_run(who, "pause", {"when": when}, lambda run: run.pause(who, when))

    def continue_(self, who: Who) -> Done:
        """End a pause."""
        return self._of_run(who, "continue", {}, lambda run: run.continue_(who))

    def clear(self, who: Who) -> Done:
        """An operator has removed the cause of a trip: what is still wrong trips again. A halted queue continues."""
        daemon, gate = self._daemon, self._assembly.stand.gate
        if INTERLOCK not in gate.reasons and not daemon.orders.queued.halted:
            self._refuse(who, "clear", {}, "there is nothing to clear: no interlock holds this stand")
        self._tell(who, "clear", {})
        gate.clear(INTERLOCK)
        daemon.note()
        if daemon.open_stand.latched is None:
            daemon.clear_queue()
        return self._done("clear", daemon.open_stand.cleared())

    def stop(self, who: Who) -> Done:
        """Make the stand safe and end the run, if there is one."""
        self._daemon.stop()
        self._tell(who, "stop", {})
        return self._done("stop", "the stand is made safe" + (", and the run ends" if self._daemon.has_guest else ""))

    async def skip(self, who: Who, step_id: str) -> Done:
        """Leave a step out, or break it off."""
        return await self._of_run(who, "skip", {"step_id": step_id}, lambda run: run.skip(who, step_id))

    async def extend(self, who: Who, step_id: str, by_s: float) -> Done:
        """Soak for so much longer."""
        arguments: dict[str, JsonValue] = {"step_id": step_id, "by_s": by_s}
        return await self._of_run(who, "extend", arguments, lambda run: run.extend(who, step_id, by_s))

    async def edit(self, who: Who, from_index: int, steps: Sequence[WrittenStep]) -> Done:
        """Replace the steps from a place on."""
        arguments: dict[str, JsonValue] = {"from_index": from_index, "steps": len(steps)}
        return await self._of_run(who, "edit", arguments, lambda run: run.edit(who, from_index, steps))

    async def submit(self, who: Who, order: RunRequest, key: str = "") -> QueuedRun:
        """Check a run and queue it."""
        arguments: dict[str, JsonValue] = {"recipe": order.recipe, "key": key}
        entry = await self._tried(who, "submit", arguments, self._daemon.orders.submit(who, order, key))
        self._daemon.wake()
        return self._daemon.orders.shown_run(entry)

    async def cancel(self, who: Who, run: int) -> Done:
        """Take a run out of the queue."""
        await self._tried(who, "cancel", {"run": run}, self._daemon.orders.cancel(run))
        self._daemon.wake()
        return self._done("cancel", f"run {run} is out of the queue")

    async def move(self, who: Who, run: int, to: int) -> Done:
        """Make a run the `to`-th of those to be done."""
        await self._tried(who, "move", {"run": run, "to": to}, self._daemon.orders.move(run, to))
        return self._done("move", f"run {run} has turn {to}")

    async def resume(self, who: Who, session: str) -> Done:
        """Its run is the next one."""
        if self._daemon.open_stand.latched is not None:
            self._refuse(who, "resume", {"session": session}, "the stand has tripped; clear it first")
        entry = await self._tried(who, "resume", {"session": session}, self._daemon.orders.resume(session))
        self._daemon.wake()
        return self._done("resume", f"run {entry.id} is resumed next")

    async def device(self, who: Who, name: str, verb: str, arguments: Mapping[str, JsonValue]) -> Done:
        """Tell a device something by hand: what takes longer than a moment goes on when this returns, and its
        failure is an event."""
        order: dict[str, JsonValue] = {"device": name, "verb": verb, "arguments": dict(arguments)}
        text = await self._tried(who, "device", order, self._daemon.do_by_hand(name, verb, arguments))
        return self._done("device", text)

    async def note(self, who: Who, session: str, text: str, tags: Sequence[str]) -> Done:
        """Of any session in the daemon's folder."""
        said, orders = Said(who, text, tags), self._daemon.orders
        folder = await orders.reading.call(orders.folder_of, session)
        await keep(said, folder, self._assembly.hub, self._assembly.clock, orders.notes)
        self._tell(who, "note", {"tags": list(tags)})
        return self._done("note", "noted")

    async def known_faults(self) -> SimulatedFaults:
        """Of the simulated laboratory."""
        return await simulated_faults(self._assembly)

    async def break_(self, who: Who, request: FaultRequest) -> Done:
        """Break something of the simulated laboratory, or mend it."""
        order = request.model_dump(exclude_defaults=True)
        return self._done("fault", await self._tried(who, "fault", order, break_or_mend(self._assembly, request)))

    @property
    def patience(self) -> Patience:
        """Of a daemon that leaves."""
        return self._daemon.open_stand.patience

    @property
    def _run(self) -> RunDesk | None:
        guest = self._daemon.guest
        return None if guest is None else guest.desk

    def _fault(self) -> FaultState | None:
        open_stand = self._daemon.open_stand
        fault = open_stand.latched
        if fault is None:
            return None
        return FaultState(rule=fault.rule, text=fault.text, since_ns=open_stand.fault_ns, data=fault.data)

    def _heat_by_hand(self) -> HeatByHand | None:
        """As it was ordered: what the regulator says of it is unknown while its wire is gone."""
        chamber = self._assembly.stand.chamber
        if chamber.ordered is None:
            return None
        return HeatByHand(**asdict(chamber.ordered), cut_ns=chamber.permits.ended_ns)

    def _of_run(
        self, who: Who, verb: Verb, arguments: Mapping[str, JsonValue], call: Callable[[RunDesk], Result]
    ) -> Result:
        run = self._run
        if run is None:
            self._refuse(who, verb, arguments, _NOTHING_RUNS)
        return call(run)

    async def _tried(self, who: Who, verb: Verb, arguments: Mapping[str, JsonValue], work: Awaitable[Result]) -> Result:
        """What `work` gives, published with who asked for it, or with why it was refused."""
        try:
            result = await work
        except StandError as error:
            self._tell(who, verb, arguments, f"refused: {error}")
            raise
        self._tell(who, verb, arguments)
        return result

    def _refuse(self, who: Who, verb: Verb, arguments: Mapping[str, JsonValue], reason: str) -> NoReturn:
        self._tell(who, verb, arguments, f"refused: {reason}")
        raise Conflict(reason)

    def _tell(self, who: Who, verb: Verb, arguments: Mapping[str, JsonValue], result: str = "done") -> None:
        event = command_event(self._assembly.clock.now_ns(), who, verb, arguments, result)
        self._assembly.hub.publish(event)

    def _done(self, verb: Verb, text: str) -> Done:
        stand = self._assembly.stand
        reasons = tuple(sorted(stand.gate.reasons))
        return Done(verb=verb, text=text, reasons=reasons, moving=tuple(stand.motions.texts))
