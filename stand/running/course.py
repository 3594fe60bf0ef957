"""The course of a run: what its plan has come to, and what an operator changes of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from thermostand.experiments.steps import PlannedStep, Step
from thermostand.foundation.clock import NS_PER_S, seconds_ns
from thermostand.foundation.errors import ConfigError
from thermostand.foundation.events import PROMPT
from thermostand.foundation.items import Event, Item, StepMark, StepState
from thermostand.recording.writing.disk import DiskCalls
from thermostand.stand.assembly import Assembly
from thermostand.stand.fault import Fault
from thermostand.stand.gate import OPERATOR
from thermostand.stand.running.executing.executor import Executor
from thermostand.stand.running.memory.journal import Logbook
from thermostand.stand.running.memory.state import RunState
from thermostand.stand.running.opening.stop import STOPPED_BY_OPERATOR, Stop
from thermostand.stand.running.plan_check import check_edit, steps_of
from thermostand.stand.running.status import STATES, StatusBoard
from thermostand.stand.serving.desk import PlanCheck, PlanStep, PromptState, StepStanding, WrittenStep


@dataclass
class Course:
    """A subscriber of the hub. directory: of its session, whose file of notes `notes` writes. pauses_next: a pause
    comes when the step under way is done."""

    assembly: Assembly
    directory: Path
    stop: Stop
    log: Logbook
    executor: Executor
    board: StatusBoard
    notes: DiskCalls
    pauses_next: bool = False
    _prompt: PromptState | None = None
    _began_ns: dict[str, int] = field(default_factory=dict[str, int])
    _ended_ns: dict[str, int] = field(default_factory=dict[str, int])

    def __call__(self, item: Item) -> None:
        """Follow one item: when steps began and ended, what the operator is asked for, and a pause that was to come."""
        match item:
            case StepMark(time_ns, step_id, _, _, StepState.STARTED):
                self._began_ns[step_id] = time_ns
                self._ended_ns.pop(step_id, None)
            case StepMark(time_ns, step_id):
                self._ended_ns[step_id] = time_ns
                if self.pauses_next:
                    self.pauses_next = False
                    self.assembly.stand.gate.hold(OPERATOR)
            case Event() if item.kind == PROMPT:
                self._prompt = PromptState(step_id=self.log.state.under_way, text=item.text)
            case _:
                pass

    @property
    def fault(self) -> Fault | None:
        """What ends it; an operator who stops it is no fault."""
        fault = self.stop.fault
        return None if fault is None or fault.rule == STOPPED_BY_OPERATOR else fault

    def seen(self) -> dict[str, object]:
        """The fields of the stand's state that are a run's."""
        status, stand = self.board.status(), self.assembly.stand
        return {
            "phase": STATES[self.stop.phase],
            "run": status.model_copy(update={"session": str(self.directory), "run_id": self.directory.name}),
            "prompt": self._prompt if OPERATOR in stand.gate.reasons and stand.attended else None,
            "disk_free_bytes": status.disk_free_bytes,
            "pausing": self.pauses_next,
        }

    def go_on(self) -> None:
        """No pause, and none to come."""
        self.pauses_next, self._prompt = False, None
        self.assembly.stand.gate.clear(OPERATOR)

    def steps(self) -> tuple[PlanStep, ...]:
        """The plan in force; of what is to come, when it is expected to be done."""
        state, now_ns = self.log.state, self.assembly.clock.now_ns()
        ends_ns = {step_id: now_ns + seconds_ns(end_s) for step_id, end_s in self.board.eta.ends_s(now_ns).items()}
        return tuple(self._plan_step(state, planned, ends_ns) for planned in state.plan)

    def check_edit(self, from_index: int, steps: Sequence[WrittenStep]) -> PlanCheck:
        """What an edit would say."""
        return check_edit(self.log.state, from_index, steps, self.assembly.config)

    async def edit(self, from_index: int, steps: Sequence[WrittenStep]) -> int:
        """Replace the steps from a place on; by how many. ConfigError for what is none, or cannot be there."""
        by = [_checked(step) for step, _ in steps_of(self.log.state.plan, from_index, steps)]
        await self.executor.edit(from_index, by)
        return len(by)

    def _plan_step(self, state: RunState, planned: PlannedStep, ends_ns: Mapping[str, int]) -> PlanStep:
        step_id, step = planned.step_id, planned.step
        standing = _standing(state, step_id)
        frames, is_to_come = step.frame_count, standing in ("waiting", "under_way")
        return PlanStep.model_construct(
            step_id=step_id,
            index=planned.index,
            kind=step.kind,
            parameters=step.parameters,
            text=step.words,
            standing=standing,
            duration_s=self.board.eta.expected_s(step_id),
            earned_s=state.earned_ns.get(step_id, 0) / NS_PER_S,
            frames=frames,
            frames_saved=frames if standing == "done" else state.frames.get(step_id, 0),
            began_ns=self._began_ns.get(step_id),
            ended_ns=self._ended_ns.get(step_id),
            expected_ns=ends_ns.get(step_id) if is_to_come else None,
        )


def _checked(step: Step | ConfigError) -> Step:
    if isinstance(step, ConfigError):
        raise step
    return step


def _standing(state: RunState, step_id: str) -> StepStanding:
    if step_id in state.skipped:
        return "skipped"
    if step_id in state.done:
        return "done"
    return "under_way" if step_id == state.under_way else "waiting"
