"""A desk without a stand behind it, and a server for it: what the interface does with answers and refusals."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncGenerator, Sequence
from contextlib import asynccontextmanager
from pathlib import Path

from pydantic import JsonValue

from thermostand.experiments.steps import Soak, number_steps
from thermostand.foundation.clock import WallClock
from thermostand.foundation.documents import Document
from thermostand.foundation.hub import Hub
from thermostand.foundation.items import Batch, Event
from thermostand.foundation.readings import Reading, bad_reading
from thermostand.foundation.shutdown_deadline import ShutdownDeadline
from thermostand.stand.config.stand_config import find_packaged, load_config
from thermostand.stand.running.memory.state import RunState
from thermostand.stand.running.run_control import check_edit
from thermostand.stand.safety.gate import INTERLOCK, OPERATOR, Gate
from thermostand.stand.service.stand_service import (
    CancelRequest,
    DeviceRequest,
    ExtendRequest,
    MoveRequest,
    NoteRequest,
    PauseRequest,
    RecipeRequest,
    ResumeRequest,
    SaveRequest,
    SkipRequest,
    StandService,
    SubmitRequest,
    describe_hold,
    describe_pause,
)
from thermostand.stand.serving.api.listeners import Interface
from thermostand.stand.serving.api.server import serve
from thermostand.stand.serving.api_models import (
    CommandAnswer,
    Conflict,
    DeviceState,
    FaultRequest,
    FaultState,
    HeatByHand,
    KnownFault,
    Missing,
    NotConfirmed,
    PlanCheck,
    PlanRequest,
    PlanStep,
    QueuedRun,
    ReadingState,
    Requester,
    RunPreview,
    RunRequest,
    RunStatus,
    SimulatedFaults,
    StandState,
    WrittenStep,
)
from thermostand.stand.serving.commands import Served, summarize_argument

STAND = "a stand"
STATUS = RunStatus(
    recipe="thermal-cycle",
    step=12,
    steps=87,
    doing="soak duration_s=2700",
    state="held",
    reasons=("disk_low", "operator"),
    now_ns=1_767_290_400_000_000_000,
    since_ns=1_767_290_340_000_000_000,
    end_ns=1_767_294_000_000_000_000,
    temperatures_degC={"thermometers.air": 23.98, "camera.temperature": None},
    frames_saved=120,
    frames_lost=1,
    disk_free_bytes=12_300_000_000,
    warning="a line\nand another",
)
KNOWN_FAULTS = (
    KnownFault(name="bus.drop", worst=0.05, mended=0.0, text="share of replies lost"),
    KnownFault(name="flap.jam", worst=2000, mended=None, text="feedback counts at which it stops"),
)


class FakeService(StandService):
    """Commands change a gate and a list; `orders` has who gave which."""

    def __init__(self, *reasons: str, run: RunStatus | None = None) -> None:
        Served.__init__(self, Hub(), WallClock())  # there is no stand
        self.gate = Gate()
        for reason in reasons:
            self.gate.hold(reason)
        self.run = run
        self.by_hand: HeatByHand | None = None
        self.tripped: FaultState | None = None
        self.not_confirmed: tuple[NotConfirmed, ...] = ()
        self.moving: tuple[str, ...] = ()
        self.orders: list[tuple[Requester, str, dict[str, JsonValue]]] = []
        self.queue: list[QueuedRun] = []
        self.is_simulated = True
        self.edited: tuple[WrittenStep, ...] = ()
        self.standing: dict[str, JsonValue] = {}
        self.requests: dict[str, tuple[RunRequest, QueuedRun]] = {}
        self.sessions = Path("/nonexistent")
        self.rehearsed: dict[str, JsonValue] = {}
        self.hub.publish(self.batch(21.5))

    @property
    def stand(self) -> str:
        return STAND

    @property
    def shutdown_deadline(self) -> ShutdownDeadline:
        return ShutdownDeadline()

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
            fault=self.tripped,
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
        return check_edit(RunState(plan), from_index, steps, load_config(find_packaged("", "simulated")))

    async def preview(self, request: RunRequest) -> RunPreview:
        raise Conflict("no queue is kept here")

    async def save_recipe(self, who: Requester, given: SaveRequest) -> str:
        return f"saved as {given.recipe}"

    async def remove_recipe(self, who: Requester, given: RecipeRequest) -> str:
        raise Missing("no recipe of that name was saved here")

    async def rehearse(self, who: Requester, given: RunRequest) -> str:
        return "rehearsed"

    def devices(self) -> tuple[DeviceState, ...]:
        return (DeviceState(name="flap", kind="flap"),)

    def make_answer(self, verb: str, text: str) -> CommandAnswer:
        return CommandAnswer(verb=verb, text=text, reasons=tuple(sorted(self.gate.reasons)), moving=self.moving)

    def publish_command(self, who: Requester, name: str, given: Document | None, result: str = "done") -> None:
        super().publish_command(who, name, given, result)
        if result == "done":
            self.orders.append((who, name, summarize_argument(given)))

    def pause(self, who: Requester, given: PauseRequest) -> str:
        self.gate.hold(OPERATOR)
        return describe_pause(given.when)

    def continue_(self, who: Requester) -> str:
        self.gate.clear(OPERATOR)
        return describe_hold(self.gate.reasons)

    def reset(self, who: Requester) -> str:
        if INTERLOCK not in self.gate.reasons:
            raise Conflict("there is nothing to reset: no interlock holds this run")
        self.gate.clear(INTERLOCK)
        return ""

    def stop(self, who: Requester) -> str:
        return ""

    async def skip(self, who: Requester, given: SkipRequest) -> str:
        if given.step_id not in ("0-soak", "1"):
            raise Missing("the plan has no such step")
        return f"step {given.step_id} is left out"

    async def extend(self, who: Requester, given: ExtendRequest) -> str:
        if given.step_id not in ("0-soak", "1"):
            raise Missing("the plan has no such step")
        return f"step {given.step_id} takes {given.by_s / 60:g} min longer"

    async def edit(self, who: Requester, given: PlanRequest) -> str:
        self.edited = given.steps
        return ""

    async def submit(self, who: Requester, given: SubmitRequest) -> QueuedRun:
        key, order = given.key, RunRequest.model_validate(given.model_dump(exclude={"key"}))
        if key and key in self.requests:
            before, run = self.requests[key]
            if before != order:
                raise Conflict("this key was used for another run")
            return run
        number, now_ns = len(self.queue) + 1, self.clock.now_ns()
        run = QueuedRun(id=number, recipe=order.recipe or "written", state="waiting", added_ns=now_ns, key=key)
        self.queue.append(run)
        self.requests[key] = order, run
        return run

    async def cancel(self, who: Requester, given: CancelRequest) -> str:
        self._check_run(given.run)
        self.queue = [each for each in self.queue if each.id != given.run]
        return ""

    async def move(self, who: Requester, given: MoveRequest) -> str:
        self._check_run(given.run)
        return ""

    async def resume(self, who: Requester, given: ResumeRequest) -> str:
        raise Conflict("a run has the stand")

    async def device(self, who: Requester, given: DeviceRequest) -> str:
        if given.device != "flap":
            raise Missing("there is no such device")
        return ""

    async def note(self, who: Requester, given: NoteRequest) -> str:
        return ""

    async def list_simulated_faults(self) -> SimulatedFaults:
        return SimulatedFaults(faults=KNOWN_FAULTS, standing=dict(self.standing))

    async def fault(self, who: Requester, given: FaultRequest) -> str:
        if given.name not in {each.name for each in KNOWN_FAULTS}:
            raise Missing(f"there is no fault {given.name}")
        if given.mend:
            self.standing.pop(given.name, None)
        else:
            self.standing[given.name] = given.value
        return ""

    def _check_run(self, number: int) -> None:
        if all(run.id != number for run in self.queue):
            raise Missing(f"no run {number} in the queue")


@asynccontextmanager
async def serve_fake(
    desk: FakeService, session: Path, interface: Interface | None = None
) -> AsyncGenerator[FakeService]:
    """The desk, served for that session while inside, and once it answers."""
    async with serve(desk, session, STAND, interface or Interface(session.parent)):
        await asyncio.sleep(0)
        yield desk
