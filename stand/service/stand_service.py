"""What can be asked of a stand: its one service, for a run in its own process and for a daemon.

Each command is a method here and nothing else (stand/serving/commands.py says what follows from it). What it does to
the page is the page's.
"""

from __future__ import annotations

from collections.abc import Collection, Coroutine, Sequence
from typing import TYPE_CHECKING, Annotated, cast

from pydantic import ConfigDict, Field, JsonValue

from thermostand.foundation.documents import Document
from thermostand.foundation.errors import ConfigError, SessionError
from thermostand.recording.reading.notes import LONGEST_NOTE
from thermostand.stand.config.interface_section import Role
from thermostand.stand.safety.gate import ENDINGS, INTERLOCK, OPERATOR, Phase
from thermostand.stand.serving.api_models import (
    LONGEST_RECIPE,
    CommandAnswer,
    Conflict,
    DeviceState,
    FaultRequest,
    FaultState,
    Missing,
    PlanCheck,
    PlanRequest,
    PlanStep,
    QueuedRun,
    Requester,
    RunPreview,
    RunRequest,
    RunStatus,
    SimulatedFaults,
    StandState,
    Tag,
    When,
    WrittenStep,
    snapshot_state,
)
from thermostand.stand.serving.commands import Served, Typed, command

if TYPE_CHECKING:
    from pathlib import Path

    from thermostand.foundation.shutdown_deadline import ShutdownDeadline
    from thermostand.recording.writing.disk import DiskCalls
    from thermostand.stand.running.run_control import RunControl
    from thermostand.stand.service.host import Host
    from thermostand.stand.service.run_queue import RunQueue

_NOTHING_RUNS = "nothing is run now"
_NO_QUEUE = "this is one run by itself; a queue is kept, and devices are operated, by `stand serve`"
_ENDING = (Phase.ABORTING, Phase.ENDING, Phase.ENDED)

RunNumber = Annotated[int, Typed("id", "Its number in `stand queue list`."), Field(ge=1, le=1 << 53)]
SessionName = Annotated[str, Field(max_length=255)]
StepId = Annotated[str, Typed("step", help="Its number in `stand status --plan`, or its id."), Field(max_length=200)]


class PauseRequest(Document):
    """now: before the next action; step: when the step under way is done."""

    when: Annotated[
        When, Typed("at_next_step", value="step", help="When the step under way is done, not before the next action.")
    ] = "now"


class SkipRequest(Document):
    """The step that is left out or broken off: its id, or its number in the plan from 1 on."""

    step_id: StepId


class ExtendRequest(Document):
    """The soak that takes longer, and by how much."""

    step_id: StepId
    by_s: Annotated[float, Typed("minutes", unit=60.0, help="How much longer, in minutes.")] = Field(
        gt=0, le=31_622_400
    )


class SubmitRequest(RunRequest):
    """A run that is asked for. key: the caller's own word for it: asked again with it, nothing is queued twice."""

    recipe: Annotated[
        str, Typed("recipe", "A recipe file, or the name of an installed one.", is_first=True, text_in="recipe_text")
    ] = Field(default="", max_length=200)
    recipe_text: Annotated[str, Typed("")] = Field(default="", max_length=LONGEST_RECIPE)
    attended: Annotated[bool, Typed("attended", "A person will do what the plan's prompts ask for.")] = Field(
        default=False, strict=True
    )
    tags: Annotated[tuple[Tag, ...], Typed("tag", "For the catalogue of sessions; may be given several times.")] = (
        Field(default=(), max_length=32)
    )
    note: Annotated[str, Typed("note", "For the catalogue of sessions.")] = Field(default="", max_length=LONGEST_NOTE)
    key: Annotated[str, Typed("key", "A name of your own for this order: the same name again queues nothing.")] = Field(
        default="", max_length=200
    )


class RecipeRequest(Document):
    """A recipe of one's own, by its name."""

    recipe: SessionName


class SaveRequest(Document):
    """A recipe under its own name. recipe_text: YAML or JSON, as GET /api/v1/recipes/schema has it."""

    recipe: SessionName
    recipe_text: str = Field(min_length=1, max_length=LONGEST_RECIPE)


class CancelRequest(Document):
    """A run of the queue."""

    run: RunNumber


class MoveRequest(Document):
    """1 is the next to be run."""

    run: RunNumber
    to: Annotated[int, Typed("position", "1 is the next to be run.")] = Field(ge=1, le=1_000_000)


class ResumeRequest(Document):
    """The name of a session."""

    session: SessionName


class DeviceRequest(Document):
    """What a verb of a device is given, by name: GET /api/v1/devices has the arguments that each takes."""

    device: SessionName
    verb: SessionName
    arguments: dict[str, JsonValue] = Field(default_factory=dict)


class NoteRequest(Document):
    """A sentence about a session, tags to find it by, or both."""

    model_config = ConfigDict(
        json_schema_extra={
            "anyOf": [
                {"properties": {"text": {"pattern": r"\S"}}, "required": ["text"]},
                {"properties": {"tags": {"minItems": 1}}, "required": ["tags"]},
            ]
        }
    )

    session: SessionName
    text: str = Field(default="", max_length=LONGEST_NOTE)
    tags: tuple[Tag, ...] = Field(default=(), max_length=32)


class StandService(Served):
    """The service of the open stand that `host` has: for days, or for one run."""

    def __init__(self, host: Host) -> None:
        assembly = host.open_stand.assembly
        super().__init__(assembly.hub, assembly.clock)
        self.host = host
        self._open_stand = host.open_stand
        self._assembly = assembly

    def state(self) -> StandState:
        """The state as it is now."""
        assembly, run, host = self._assembly, self._run, self.host
        changes = host.get_state_fields()
        if run is not None:
            changes.update(run.get_state_fields())
        elif host.active_run is not None:
            changes["phase"] = "stopping" if host.is_leaving else "running"
        latch = self._open_stand.latch
        if (fault := latch.fault) is not None:
            changes["fault"] = FaultState(rule=fault.rule, text=fault.text, since_ns=latch.since_ns, data=fault.data)
        return snapshot_state(assembly.config, assembly.stand, self.hub, self.clock).model_copy(update=changes)

    def plan(self) -> tuple[PlanStep, ...]:
        """The plan in force; empty when nothing is run."""
        return () if self._run is None else self._run.steps()

    def check_edit(self, from_index: int, steps: Sequence[WrittenStep]) -> PlanCheck:
        """Return what an edit would say; nothing is ordered, so nothing is recorded."""
        return self._require_run().check_edit(from_index, steps)

    async def preview(self, request: RunRequest) -> RunPreview:
        """Return what a recipe would do here now: see RunPreview."""
        run = self._run
        run_end_ns = None if run is None else cast("RunStatus", run.get_state_fields()["run"]).end_ns
        return await self._require_queue().preview(request, run_end_ns)

    def devices(self) -> tuple[DeviceState, ...]:
        """The commands that devices take by hand, between runs."""
        return self.host.devices()

    async def list_simulated_faults(self) -> SimulatedFaults:
        """List the faults of the simulated laboratory."""
        from thermostand.stand.running.simulated_faults import list_simulated_faults

        return await list_simulated_faults(self._assembly)

    def find_role(self, name: str, given: Document | None) -> Role | None:
        """That of the command, or of a device's verb."""
        if not isinstance(given, DeviceRequest):
            return super().find_role(name, given)
        for verb in (verb for each in self.devices() if each.name == given.device for verb in each.verbs):
            if verb.verb == given.verb:
                return verb.role
        return super().find_role(name, given)

    def make_answer(self, verb: str, text: str) -> CommandAnswer:
        """Make an answer with what holds the run now, and what is still under way."""
        stand = self._assembly.stand
        reasons, moving = tuple(sorted(stand.gate.reasons)), tuple(stand.motions.texts)
        return CommandAnswer(verb=verb, text=text, reasons=reasons, moving=moving)

    @command("/run/stop", anywhere=True, role=None)
    def stop(self, who: Requester) -> str:
        """Make the stand safe and end the run, as Ctrl-C does. Needs no token and no body, in every state, as often as
        you like.

        Example: stand stop
        """
        self.host.stop()
        return "the stand is made safe" + ("" if self.host.active_run is None else ", and the run ends")

    @command("/run/pause")
    def pause(self, who: Requester, given: PauseRequest) -> str:
        """Hold the run before its next action; soak time so far is kept, and the chamber holds its set-point.

        Moves under way are completed, and the answer lists them; `stand stop` stops it. The flap is shut within a
        minute. After guard.pause_limit_h the stand is made safe and held.

        Example: stand pause && stand continue
        """
        run = self._require_run()
        run.pauses_next = given.when == "step"
        if not run.pauses_next:
            self._assembly.stand.gate.hold(OPERATOR)
        return describe_pause(given.when)

    @command("/run/continue")
    def continue_(self, who: Requester) -> str:
        """End a pause, or the pause of a prompt.

        Example: stand continue sessions/20260101T180000Z-thermal-cycle
        """
        self._require_run().end_pause()
        return describe_hold(self._assembly.stand.gate.reasons)

    @command("/run/reset", verbs=(), role="commission")
    def reset(self, who: Requester) -> str:
        """The cause of a trip has been removed: what is still wrong trips again. A halted queue continues."""
        host, orders = self.host, self.host.orders
        if self._open_stand.latch.fault is None and (orders is None or not orders.queued.halted):
            raise Conflict(f"there is nothing to reset: no interlock holds this {'run' if orders is None else 'stand'}")
        still = self._open_stand.reset()
        host.note()
        if self._open_stand.latch.fault is None:
            host.reset_queue()
        return f"reset; {still}" if still else "reset"

    @command("/run/skip")
    async def skip(self, who: Requester, given: SkipRequest) -> str:
        """Leave a step out, or break it off. Durable when it is answered.

        Frames after a soak that was left out are flagged `unsettled`, and a fit leaves them out.

        Example: stand skip 12
        """
        run, step_id = self._step(given.step_id)
        await _change_plan(run.executor.skip(step_id))
        return f"step {given.step_id} is left out"

    @command("/run/extend")
    async def extend(self, who: Requester, given: ExtendRequest) -> str:
        """Soak for longer in a step. Durable when it is answered.

        Example: stand extend 12 30
        """
        run, step_id = self._step(given.step_id)
        await _change_plan(run.executor.extend(step_id, given.by_s))
        return f"step {given.step_id} takes {given.by_s / 60.0:g} min longer"

    @command("/run/plan", http="PUT", verbs=())
    async def edit(self, who: Requester, given: PlanRequest) -> str:
        """Replace the steps from a place on, none of which was begun. Durable when it is answered."""
        count = await self._require_run().edit(given.from_index, given.steps)
        return f"the steps from number {given.from_index + 1} on are replaced by {count} others"

    @command("/queue", status=201, verbs=("submit", "queue add"), by_secop="recipe")
    async def submit(self, who: Requester, given: SubmitRequest) -> QueuedRun:
        """Check a run and queue it as it is now. Later edits of its file change nothing.

        Recipe, limits, wires and the space on the disk are checked. With the key of an earlier run: that one, 409 when
        its request was another.

        Example: stand submit overnight --key monday
        """
        orders, order = self._require_queue(), RunRequest.model_validate(given.model_dump(exclude={"key"}))
        entry = await orders.submit(who, order, given.key)
        self.host.wake()
        return orders.describe_run(entry)

    @command("/own-recipes/{recipe}", http="PUT", verbs=(), by_secop=None, title="Save as a recipe")
    async def save_recipe(self, who: Requester, given: SaveRequest) -> str:
        """Save a recipe of your own beside the sessions, in the place of one of that name; installed ones stay."""
        await self._require_queue().save_recipe(given.recipe, given.recipe_text)
        return f"saved as {given.recipe}"

    @command("/own-recipes/{recipe}", http="DELETE", verbs=(), by_secop=None, title="Remove this recipe")
    async def remove_recipe(self, who: Requester, given: RecipeRequest) -> str:
        """Remove a recipe of your own; runs that were queued with it stay as they are."""
        await self._require_queue().remove_recipe(given.recipe)
        return f"the recipe {given.recipe} is removed"

    @command("/rehearsals", verbs=(), by_secop=None)
    async def rehearse(self, who: Requester, given: RunRequest) -> str:
        """Run a recipe in virtual time, in a simulated laboratory. Nothing of this stand moves; the session is in the
        list, marked as simulated, when it is done."""
        name = await self._require_queue().rehearse_order(given)
        return f"{name} is rehearsed in virtual time; its session comes into the list, marked as simulated"

    @command("/queue/{run}", http="DELETE", verbs=("queue remove",), title="Remove")
    async def cancel(self, who: Requester, given: CancelRequest) -> str:
        """Take a run out of the queue; what it has recorded stays.

        Example: stand queue remove 5
        """
        await self._require_queue().cancel(given.run)
        self.host.wake()
        return f"run {given.run} is out of the queue"

    @command("/queue/{run}/move", verbs=("queue move",))
    async def move(self, who: Requester, given: MoveRequest) -> str:
        """Change when a run has its turn.

        Example: stand queue move 5 1
        """
        await self._require_queue().move(given.run, given.to)
        return f"run {given.run} has turn {given.to}"

    @command("/sessions/{session}/resume", verbs=())
    async def resume(self, who: Requester, given: ResumeRequest) -> str:
        """Resume an interrupted run in its session; it is the next one."""
        orders = self._require_queue()
        if self._open_stand.latch.fault is not None:
            raise Conflict("the stand has tripped; reset it first")
        entry = await orders.resume(given.session)
        self.host.wake()
        return f"run {entry.id} is resumed next"

    @command("/devices/{device}/{verb}", verbs=())
    async def device(self, who: Requester, given: DeviceRequest) -> str:
        """Tell a device something between runs, through the same gate as a run. What takes longer than a moment goes on
        when this is answered, and its failure is an event."""
        return await self.host.run_manual_order(given.device, given.verb, given.arguments)

    @command("/sessions/{session}/notes", verbs=(), by_secop=None)
    async def note(self, who: Requester, given: NoteRequest) -> str:
        """Add a note and tags to a session, running or finished."""
        from thermostand.stand.running.run_control import OperatorNote, save_note

        text = OperatorNote(who, given.text, given.tags)
        await save_note(text, *await self._find_notes(given.session), self.hub, self.clock)
        return "noted"

    @command("/simulator/faults", verbs=(), by_secop=None)
    async def fault(self, who: Requester, given: FaultRequest) -> str:
        """Break something of the simulated laboratory on purpose, or mend it; 409 for a real stand."""
        from thermostand.stand.running.simulated_faults import break_or_mend

        return await break_or_mend(self._assembly, given)

    @property
    def stand(self) -> str:
        """The name of the stand."""
        return self._assembly.config.name

    @property
    def shutdown_deadline(self) -> ShutdownDeadline:
        """The shutdown deadline of a stand that is closed."""
        return self._open_stand.shutdown_deadline

    @property
    def _run(self) -> RunControl | None:
        """The control of the run that has the stand, once it can be asked anything."""
        active_run = self.host.active_run
        return None if active_run is None else active_run.course

    def _require_run(self) -> RunControl:
        run = self._run
        if run is None:
            raise Conflict(_NOTHING_RUNS)
        if run.stop.phase in _ENDING:
            raise Conflict("the run is being ended: the stand is made safe, and nothing else is done")
        return run

    def _step(self, wanted: str) -> tuple[RunControl, str]:
        """A step of the run, by its id, or by its number in the plan."""
        run = self._require_run()
        plan = run.log.state.plan
        found = [each.step_id for each in plan if wanted in (each.step_id, str(each.index + 1))]
        if not found:
            raise Missing(f"the plan has no step {wanted}; `stand status --plan` shows those there are")
        return run, found[0]

    def _require_queue(self) -> RunQueue:
        if self.host.orders is None:
            raise Conflict(_NO_QUEUE)
        return self.host.orders

    async def _find_notes(self, session: str) -> tuple[Path, DiskCalls]:
        """The folder of a session, and what writes its file of notes."""
        if (orders := self.host.orders) is not None:
            return await orders.reading.call(orders.find_session, session), orders.notes
        run = self._require_run()
        if session != run.directory.name:
            raise Missing(f"the session under way is {run.directory.name}; others get notes from `stand session`")
        return run.directory, run.notes


def describe_pause(when: When) -> str:
    """The message about a pause."""
    begins = "pauses when the step under way is done" if when == "step" else "paused"
    return f"{begins}; `stand continue` ends the pause"


def describe_hold(reasons: Collection[str]) -> str:
    """Return whether the run continues, and if not, what may be done about it."""
    if not reasons:
        return "the run continues"
    known = [ENDINGS[reason] for reason in sorted(reasons) if reason in (OPERATOR, INTERLOCK)]
    return "; ".join([f"still held: {', '.join(sorted(reasons))}", *known])


async def _change_plan(change: Coroutine[None, None, None]) -> None:
    """Raise Conflict for what cannot be done with a plan as it is."""
    try:
        await change
    except (ConfigError, SessionError) as error:
        raise Conflict(str(error)) from error
