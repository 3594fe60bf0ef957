"""The course of a run: what its plan has come to, and what an operator changes of it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from thermostand.experiments.steps import STEPS, PlannedStep, Situation, Step, make_step
from thermostand.foundation.clock import NS_PER_S, Clock, to_ns
from thermostand.foundation.errors import ConfigError
from thermostand.foundation.events import NOTE, PROMPT
from thermostand.foundation.hub import Hub
from thermostand.foundation.items import Event, Item, StepMark, StepState
from thermostand.recording.reading.notes import add_note, add_tags, check_tag
from thermostand.recording.writing.disk import DiskCalls
from thermostand.stand.assembly.assemble import Assembly
from thermostand.stand.config.stand_config import StandConfig
from thermostand.stand.estimating.estimate import price_plan
from thermostand.stand.running.executing.executor import Executor
from thermostand.stand.running.memory.entries import make_edit
from thermostand.stand.running.memory.fold import apply_entry, find_refusal
from thermostand.stand.running.memory.journal import Logbook
from thermostand.stand.running.memory.state import RunState
from thermostand.stand.running.opening.stop import Stop
from thermostand.stand.running.order import find_plan_faults
from thermostand.stand.running.status import STATES, StatusBoard
from thermostand.stand.safety.gate import OPERATOR
from thermostand.stand.serving.api_models import (
    PlanCheck,
    PlanStep,
    PromptState,
    Requester,
    StepFault,
    StepStanding,
    WrittenStep,
)

# What an operator says of a session through a stand's interface: kept in the session's file of notes, and published as
# an event, which is recorded by the session that is open then.


@dataclass(frozen=True, slots=True)
class OperatorNote:
    """A sentence, tags, or both; ConfigError for neither, and for what is no tag."""

    who: Requester
    text: str
    tags: Sequence[str]

    def __post_init__(self) -> None:
        if not self.text.strip() and not self.tags:
            raise ConfigError("a note needs a text or a tag")
        for tag in self.tags:
            check_tag(tag)


async def save_note(text: OperatorNote, session: Path, notes: DiskCalls, hub: Hub, clock: Clock) -> None:
    """Durable when this returns; SessionError when it is not. `notes` touches the disk, which may hang."""
    await notes.call(_write_note, text, session, clock.now_ns())
    who, tags = text.who, list(text.tags)
    hub.publish(NOTE.at(clock.now_ns(), text.text, who=who.name, how=who.how, session=session.name, tags=tags))


def _write_note(text: OperatorNote, session: Path, now_ns: int) -> None:
    if text.text.strip():
        add_note(session, text.text, text.who.name, now_ns)
    if text.tags:
        add_tags(session, text.tags, text.who.name, now_ns)


# Steps that somebody wants to replace others by, checked as an edit checks them: what is wrong with each of them.

_SET_POINT = "chamber_degC"


def resolve_steps(
    plan: Sequence[PlannedStep], from_index: int, steps: Sequence[WrittenStep]
) -> Iterator[tuple[Step | ConfigError, float | None]]:
    """Each of the steps that are to follow the first `from_index` of the plan, or what is wrong with it; and the
    chamber's set-point there, None while it is stopped. Frames for which none is stated are at that one."""
    found = Situation()
    for planned in plan[:from_index]:
        found = planned.step.situation_after(found)
    for written in steps:
        here_degC, parameters = found.set_point_degC, dict[str, object](written.parameters)
        is_labelled = written.kind in STEPS and STEPS[written.kind].at_set_point
        if is_labelled and parameters.get(_SET_POINT) is None and here_degC is not None:
            parameters[_SET_POINT] = here_degC
        try:
            step = make_step(written.kind, parameters)
        except ConfigError as error:
            yield error, here_degC
        else:
            found = step.situation_after(found)
            yield step, here_degC


def check_edit(state: RunState, from_index: int, steps: Sequence[WrittenStep], config: StandConfig) -> PlanCheck:
    """Return what an edit of the plan from `from_index` on would say. Changes nothing, and asks no device."""
    found = list(resolve_steps(state.plan, from_index, steps))
    seen = PlanCheck(
        texts=tuple("" if isinstance(step, ConfigError) else step.words for step, _ in found),
        set_points_degC=tuple(degC for _, degC in found),
    )
    by = [step for step, _ in found if not isinstance(step, ConfigError)]
    wrong = [(index, step) for index, (step, _) in enumerate(found, from_index) if isinstance(step, ConfigError)]
    if wrong:  # the others cannot be judged: what stands before them is not known
        return _add_faults(seen, [(index, str(error)) for index, error in wrong])
    change = make_edit(0, from_index, by)
    if reason := find_refusal(state, change):
        return _add_faults(seen, [(None, reason)])
    plan = apply_entry(state, change).plan
    if faults := list(find_plan_faults(plan, config)):
        return _add_faults(seen, faults)
    try:
        priced = price_plan(plan, config)
    except ConfigError as error:
        return _add_faults(seen, [(None, str(error))])
    return seen.model_copy(update={"duration_s": sum(each.duration_s for each in priced[from_index:])})


def _add_faults(seen: PlanCheck, faults: Sequence[tuple[int | None, str]]) -> PlanCheck:
    return seen.model_copy(update={"faults": tuple(StepFault(index=index, text=text) for index, text in faults)})


@dataclass
class RunControl:
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

    def get_state_fields(self) -> dict[str, object]:
        """The fields of the stand's state that are a run's."""
        status, stand = self.board.status(), self.assembly.stand
        return {
            "phase": STATES[self.stop.phase],
            "run": status.model_copy(update={"session": str(self.directory), "run_id": self.directory.name}),
            "prompt": self._prompt if OPERATOR in stand.gate.reasons and stand.attended else None,
            "disk_free_bytes": status.disk_free_bytes,
            "pausing": self.pauses_next,
        }

    def end_pause(self) -> None:
        """End the pause, and any that was to come."""
        self.pauses_next, self._prompt = False, None
        self.assembly.stand.gate.clear(OPERATOR)

    def steps(self) -> tuple[PlanStep, ...]:
        """The plan in force; of what is to come, when it is expected to be done."""
        state, now_ns = self.log.state, self.assembly.clock.now_ns()
        ends_ns = {step_id: now_ns + to_ns(end_s) for step_id, end_s in self.board.eta.ends_s(now_ns).items()}
        return tuple(self._make_plan_step(state, planned, ends_ns) for planned in state.plan)

    def check_edit(self, from_index: int, steps: Sequence[WrittenStep]) -> PlanCheck:
        """Return what an edit would say."""
        return check_edit(self.log.state, from_index, steps, self.assembly.config)

    async def edit(self, from_index: int, steps: Sequence[WrittenStep]) -> int:
        """Replace the steps from a place on; by how many. ConfigError for what is none, or cannot be there."""
        by = [_require_step(step) for step, _ in resolve_steps(self.log.state.plan, from_index, steps)]
        await self.executor.edit(from_index, by)
        return len(by)

    def _make_plan_step(self, state: RunState, planned: PlannedStep, ends_ns: Mapping[str, int]) -> PlanStep:
        step_id, step = planned.step_id, planned.step
        standing = _find_standing(state, step_id)
        frames, is_to_come = step.frame_count, standing in ("waiting", "under_way")
        return PlanStep.model_construct(
            step_id=step_id,
            index=planned.index,
            kind=step.kind,
            parameters=step.parameters,
            text=step.words,
            standing=standing,
            duration_s=self.board.eta.expected_s(step_id),
            soaked_s=state.soaked_ns.get(step_id, 0) / NS_PER_S,
            frames=frames,
            frames_saved=frames if standing == "done" else state.frames.get(step_id, 0),
            began_ns=self._began_ns.get(step_id),
            ended_ns=self._ended_ns.get(step_id),
            expected_ns=ends_ns.get(step_id) if is_to_come else None,
        )


def _require_step(step: Step | ConfigError) -> Step:
    if isinstance(step, ConfigError):
        raise step
    return step


def _find_standing(state: RunState, step_id: str) -> StepStanding:
    if step_id in state.skipped:
        return "skipped"
    if step_id in state.done:
        return "done"
    return "under_way" if step_id == state.under_way else "waiting"
