"""What can be asked of a stand while one run has it: the desk of that run."""

from __future__ import annotations

from collections.abc import Callable, Coroutine, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from pydantic import JsonValue

from thermostand.experiments.steps import PlannedStep, Step
from thermostand.foundation.clock import NS_PER_S, seconds_ns
from thermostand.foundation.errors import ConfigError, SessionError
from thermostand.foundation.events import PROMPT
from thermostand.foundation.items import Event, Item, StepMark, StepState
from thermostand.recording.writing.disk import DiskCalls
from thermostand.stand.assembly import Assembly, device_kinds
from thermostand.stand.estimating.eta import Eta
from thermostand.stand.fault import Fault
from thermostand.stand.gate import INTERLOCK, OPERATOR, Phase
from thermostand.stand.running.executing.executor import Executor
from thermostand.stand.running.memory.journal import Logbook
from thermostand.stand.running.memory.state import RunState
from thermostand.stand.running.opening.stop import STOPPED_BY_OPERATOR, Stop
from thermostand.stand.running.plan_check import check_edit, steps_of
from thermostand.stand.running.said import Said, keep
from thermostand.stand.running.simulated_faults import break_or_mend, simulated_faults
from thermostand.stand.running.status import STATES
from thermostand.stand.serving.command_event import command_event
from thermostand.stand.serving.desk import (
    Conflict,
    DeviceState,
    Done,
    FaultRequest,
    FaultState,
    Missing,
    PlanStep,
    PromptState,
    QueuedRun,
    RunRequest,
    RunStatus,
    SimulatedFaults,
    StandState,
    StepStanding,
    Verb,
    When,
    Who,
    WrittenStep,
)
from thermostand.stand.serving.plan_faults import PlanCheck
from thermostand.stand.serving.seen import seen_state

_NO_QUEUE = "this is one run by itself; a queue is kept, and devices are operated, by `stand serve`"
_ENDING = (Phase.ABORTING, Phase.ENDING, Phase.ENDED)


@dataclass
class RunDesk:
    """The desk of a run (stand/serving/desk.py has what each method does). A subscriber of the hub.

    session: its folder. status: the published state of the run. latched: why the guard holds the stand. cleared: what
    came of a clear. notes: where the session's file of notes is written. eta: what the steps are expected to take, the
    same as the run's end is from.
    """

    assembly: Assembly
    session: Path
    stop_run: Stop
    log: Logbook
    executor: Executor
    status: Callable[[], RunStatus]
    latched: Callable[[], Fault | None]
    cleared: Callable[[], str]
    notes: DiskCalls
    eta: Eta

    def __post_init__(self) -> None:
        self._pausing = False
        self._prompt: PromptState | None = None
        self._began_ns: dict[str, int] = {}
        self._ended_ns: dict[str, int] = {}
        self._fault: tuple[Fault, int] | None = None

    def __call__(self, item: Item) -> None:
        """Follow one item: when steps began and ended, what the operator is asked for, and a pause that was to come."""
        match item:
            case StepMark(time_ns, step_id, _, _, StepState.STARTED):
                self._began_ns[step_id] = time_ns
                self._ended_ns.pop(step_id, None)
            case StepMark(time_ns, step_id):
                self._ended_ns[step_id] = time_ns
                if self._pausing:
                    self._pausing = False
                    self.assembly.stand.gate.hold(OPERATOR)
            case Event() if item.kind == PROMPT:
                self._prompt = PromptState(step_id=self.log.state.under_way, text=item.text)
            case _:
                pass

    def state(self) -> StandState:
        """As it is now."""
        stand, status = self.assembly.stand, self.status()
        asked = self._prompt if OPERATOR in stand.gate.reasons and stand.attended else None
        return seen_state(self.assembly.config, stand, self.assembly.hub, self.assembly.clock).model_copy(
            update={
                "phase": STATES[self.stop_run.phase],
                "run": status.model_copy(update={"session": str(self.session), "run_id": self.session.name}),
                "fault": self._fault_now(),
                "prompt": asked,
                "disk_free_bytes": status.disk_free_bytes,
                "pausing": self._pausing,
            }
        )

    def plan(self) -> tuple[PlanStep, ...]:
        """The plan in force; of what is to come, when it is expected to be done."""
        state, now_ns = self.log.state, self.assembly.clock.now_ns()
        ends_ns = {step_id: now_ns + seconds_ns(end_s) for step_id, end_s in self.eta.ends_s(now_ns).items()}
        return tuple(self._plan_step(state, planned, ends_ns) for planned in state.plan)

    def check_edit(self, from_index: int, steps: Sequence[WrittenStep]) -> PlanCheck:
        """What an edit would say."""
        self._check_running()
        return check_edit(self.log.state, from_index, steps, self.assembly.config)

    def devices(self) -> tuple[DeviceState, ...]:
        """None takes an order from anybody but the run."""
        return tuple(
            DeviceState(name=name, kind=kind, channels=self._channels(name), refused="a run has the stand")
            for name, kind in device_kinds(self.assembly.config).items()
        )

    def pause(self, who: Who, when: When = "now") -> Done:
        """Before the next action, or when the step under way is done."""
        self._check_running()
        self._pausing = when == "step"
        if not self._pausing:
            self.assembly.stand.gate.hold(OPERATOR)
        return self._done(who, "pause", {"when": when}, "paused" if when == "now" else "pauses after this step")

    def continue_(self, who: Who) -> Done:
        """End a pause, one that is still to come as well."""
        self._check_running()
        self._pausing, self._prompt = False, None
        self.assembly.stand.gate.clear(OPERATOR)
        return self._done(who, "continue", {}, "the pause is over")

    def clear(self, who: Who) -> Done:
        """Conflict when no interlock holds the run."""
        if INTERLOCK not in self.assembly.stand.gate.reasons:
            raise Conflict("there is nothing to clear: no interlock holds this run")
        self.assembly.stand.gate.clear(INTERLOCK)
        return self._done(who, "clear", {}, self.cleared())

    def stop(self, who: Who) -> Done:
        """At once, and then say who did it."""
        self.stop_run()
        return self._done(who, "stop", {}, "stopping; the stand is made safe first")

    async def skip(self, who: Who, step_id: str) -> Done:
        """Leave a step out, or break it off."""
        self._check_step(step_id)
        await _changed(self.executor.skip(step_id))
        return self._done(who, "skip", {"step_id": step_id}, "the step is left out")

    async def extend(self, who: Who, step_id: str, by_s: float) -> Done:
        """Soak for so much longer."""
        self._check_step(step_id)
        await _changed(self.executor.extend(step_id, by_s))
        return self._done(who, "extend", {"step_id": step_id, "by_s": by_s}, f"{by_s:g} s longer")

    async def edit(self, who: Who, from_index: int, steps: Sequence[WrittenStep]) -> Done:
        """Replace the steps from a place on."""
        self._check_running()
        by = [_checked(step) for step, _ in steps_of(self.log.state.plan, from_index, steps)]
        await self.executor.edit(from_index, by)
        data: dict[str, JsonValue] = {"from_index": from_index, "steps": len(by)}
        return self._done(
            who, "edit", data, f"the steps from number {from_index + 1} on are replaced by {len(by)} others"
        )

    async def submit(self, who: Who, order: RunRequest, key: str = "") -> QueuedRun:
        """Conflict: there is no queue."""
        raise Conflict(_NO_QUEUE)

    async def cancel(self, who: Who, run: int) -> Done:
        """Conflict: there is no queue."""
        raise Conflict(_NO_QUEUE)

    async def move(self, who: Who, run: int, to: int) -> Done:
        """Conflict: there is no queue."""
        raise Conflict(_NO_QUEUE)

    async def resume(self, who: Who, session: str) -> Done:
        """Conflict: one run at a time."""
        raise Conflict("a run has the stand; a session is resumed when it has ended")

    async def device(self, who: Who, name: str, verb: str, arguments: Mapping[str, JsonValue]) -> Done:
        """Conflict: the run has the stand."""
        if name not in (kinds := device_kinds(self.assembly.config)):
            raise Missing(f"this stand has no device of that name; there are {', '.join(kinds)}")
        raise Conflict("a run has the stand; pause does not change that, STOP ends the run")

    async def note(self, who: Who, session: str, text: str, tags: Sequence[str]) -> Done:
        """Of the session of this run."""
        if session != self.session.name:
            raise Missing(f"the session under way is {self.session.name}; others get notes from `stand session`")
        await keep(Said(who, text, tags), self.session, self.assembly.hub, self.assembly.clock, self.notes)
        return self._done(who, "note", {"tags": list(tags)}, "noted")

    async def known_faults(self) -> SimulatedFaults:
        """Of the simulated laboratory."""
        return await simulated_faults(self.assembly)

    async def break_(self, who: Who, request: FaultRequest) -> Done:
        """Conflict when it is no simulated stand."""
        text = await break_or_mend(self.assembly, request)
        return self._done(who, "fault", request.model_dump(exclude_defaults=True), text)

    def _done(self, who: Who, verb: Verb, arguments: Mapping[str, JsonValue], text: str) -> Done:
        stand = self.assembly.stand
        self.assembly.hub.publish(command_event(self.assembly.clock.now_ns(), who, verb, arguments))
        reasons, moving = tuple(sorted(stand.gate.reasons)), tuple(stand.motions.texts)
        return Done(verb=verb, text=text, reasons=reasons, moving=moving)

    def _check_running(self) -> None:
        if self.stop_run.phase in _ENDING:
            raise Conflict("the run is being ended: the stand is made safe, and nothing else is done")

    def _check_step(self, step_id: str) -> None:
        self._check_running()
        if self.log.state.step(step_id) is None:
            raise Missing("the plan has no step of that id; `stand status --plan` shows those there are")

    def _fault_now(self) -> FaultState | None:
        fault = self.stop_run.fault or self.latched()
        if fault is None or fault.rule == STOPPED_BY_OPERATOR:
            self._fault = None
            return None
        if self._fault is None or self._fault[0] != fault:
            self._fault = fault, self.assembly.clock.now_ns()
        return FaultState(rule=fault.rule, text=fault.text, since_ns=self._fault[1], data=fault.data)

    def _plan_step(self, state: RunState, planned: PlannedStep, ends_ns: Mapping[str, int]) -> PlanStep:
        step_id, step = planned.step_id, planned.step
        standing = _standing(state, step_id)
        frames, is_to_come = step.frame_count, standing in ("waiting", "under_way")
        earned_s = state.earned_ns.get(step_id, 0) / NS_PER_S
        return PlanStep.model_construct(
            step_id=step_id,
            index=planned.index,
            kind=step.kind,
            parameters=step.parameters,
            text=step.words,
            standing=standing,
            duration_s=self.eta.expected_s(step_id),
            earned_s=earned_s,
            frames=frames,
            frames_saved=frames if standing == "done" else state.frames.get(step_id, 0),
            began_ns=self._began_ns.get(step_id),
            ended_ns=self._ended_ns.get(step_id),
            expected_ns=ends_ns.get(step_id) if is_to_come else None,
        )

    def _channels(self, name: str) -> tuple[str, ...]:
        return tuple(channel for channel in self.assembly.hub.readings if channel.startswith(f"{name}."))


def _checked(step: Step | ConfigError) -> Step:
    if isinstance(step, ConfigError):
        raise step
    return step


async def _changed(change: Coroutine[None, None, None]) -> None:
    """What cannot be done with a plan as it is: Conflict."""
    try:
        await change
    except (ConfigError, SessionError) as error:
        raise Conflict(str(error)) from error


def _standing(state: RunState, step_id: str) -> StepStanding:
    if step_id in state.skipped:
        return "skipped"
    if step_id in state.done:
        return "done"
    return "under_way" if step_id == state.under_way else "waiting"
