"""What can be ordered: the run, its plan, the queue, and devices by hand. Each is called on the control loop."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Header, Path, Request, Response
from pydantic import ConfigDict, Field, JsonValue

from thermostand.foundation.documents import Document
from thermostand.recording.reading.notes import LONGEST_NOTE
from thermostand.stand.serving.api.access import STOP_PATH
from thermostand.stand.serving.api.bridge import Bridge
from thermostand.stand.serving.desk import (
    DeviceState,
    Done,
    FaultRequest,
    QueuedRun,
    RunRequest,
    SimulatedFaults,
    Tag,
    When,
    Who,
    WrittenStep,
)
from thermostand.stand.serving.plan_faults import PlanCheck

_Id = Annotated[int, Path(ge=1, le=1 << 53)]
_Name = Annotated[str, Path(max_length=255)]


class PauseRequest(Document):
    """now: before the next action; step: when the step under way is done."""

    when: When = "now"


class SkipRequest(Document):
    """The step that is left out or broken off."""

    step_id: str = Field(max_length=200)


class ExtendRequest(Document):
    """The soak that takes longer, and by how much."""

    step_id: str = Field(max_length=200)
    by_s: float = Field(gt=0, le=31_622_400)


class PlanRequest(Document):
    """The steps from a place on are replaced by these."""

    from_index: int = Field(ge=0, le=1_000_000)
    steps: tuple[WrittenStep, ...] = Field(max_length=10_000)


class MoveRequest(Document):
    """1 is the next to be run."""

    to: int = Field(ge=1, le=1_000_000)


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

    text: str = Field(default="", max_length=LONGEST_NOTE)
    tags: tuple[Tag, ...] = Field(default=(), max_length=32)


class DeviceRequest(Document):
    """What a verb of a device is given, by name: GET /api/v1/devices has the arguments that each takes."""

    arguments: dict[str, JsonValue] = Field(default_factory=dict)


class SubmitRequest(RunRequest):
    """A run that is asked for. key: the caller's own word for it: asked again with it, nothing is queued twice."""

    key: str = Field(default="", max_length=200)

    def order(self) -> RunRequest:
        """Without the key."""
        return RunRequest.model_validate(self.model_dump(exclude={"key"}))


def commands(bridge: Bridge) -> APIRouter:
    """The routes."""
    router = APIRouter(prefix="/api/v1")
    _of_the_run(router, bridge)
    _of_the_queue(router, bridge)
    _of_devices(router, bridge)
    _of_the_simulator(router, bridge)
    return router


def who(request: Request) -> Who:
    """Who asks, as the gatekeeper has found out."""
    return request.state.who


def done(answer: Done) -> Response:
    """The answer to a command."""
    return Response(answer.model_dump_json(), media_type="application/json")


def _of_the_run(router: APIRouter, bridge: Bridge) -> None:
    @router.post(STOP_PATH.removeprefix("/api/v1"), response_model=Done)
    async def stop(request: Request) -> Response:
        """Make the stand safe and end the run. Needs no token and no body, in every state, as often as you like."""
        return done(await bridge.stop(who(request)))

    @router.post("/run/pause", response_model=Done)
    async def pause(request: Request, body: PauseRequest | None = None) -> Response:
        """Hold the run; the chamber keeps its set-point, a dwell what it has earned."""
        when = "now" if body is None else body.when
        return done(await bridge.command(lambda desk: desk.pause(who(request), when)))

    @router.post("/run/continue", response_model=Done)
    async def continue_(request: Request) -> Response:
        """End a pause, or the pause of a prompt."""
        return done(await bridge.command(lambda desk: desk.continue_(who(request))))

    @router.post("/run/clear", response_model=Done)
    async def clear(request: Request) -> Response:
        """The cause of a trip has been removed."""
        return done(await bridge.command(lambda desk: desk.clear(who(request))))

    @router.post("/run/skip", response_model=Done)
    async def skip(request: Request, body: SkipRequest) -> Response:
        """Leave a step out, or break it off."""
        return done(await bridge.command(lambda desk: desk.skip(who(request), body.step_id)))

    @router.post("/run/extend", response_model=Done)
    async def extend(request: Request, body: ExtendRequest) -> Response:
        """Soak for so much longer."""
        return done(await bridge.command(lambda desk: desk.extend(who(request), body.step_id, body.by_s)))

    @router.put("/run/plan", response_model=Done)
    async def edit(request: Request, body: PlanRequest) -> Response:
        """Replace steps that were not begun."""
        return done(await bridge.command(lambda desk: desk.edit(who(request), body.from_index, body.steps)))

    @router.post("/run/plan/check", response_model=PlanCheck)
    async def check_edit(body: PlanRequest) -> Response:
        """What replacing these steps would say, step by step; changes nothing."""
        found = await bridge.check_edit(body.from_index, body.steps)
        return Response(found.model_dump_json(), media_type="application/json")


def _of_the_queue(router: APIRouter, bridge: Bridge) -> None:
    @router.get("/queue", response_model=list[QueuedRun])
    async def queue() -> Response:
        """What has ended, the run under way, and those to be done in their order."""
        return _list(bridge.snapshot.state.queue)

    @router.post("/queue", response_model=QueuedRun, status_code=201)
    async def submit(
        request: Request,
        body: SubmitRequest,
        idempotency_key: Annotated[str, Header(max_length=200)] = "",
    ) -> Response:
        """Check a run and queue it. With the key of an earlier one: that one; 409 when its request was another."""
        key = idempotency_key or body.key
        run = await bridge.ask(lambda desk: desk.submit(who(request), body.order(), key))
        return Response(run.model_dump_json(), 201, media_type="application/json")

    @router.delete("/queue/{run}", response_model=Done)
    async def cancel(request: Request, run: _Id) -> Response:
        """Take a run out of the queue; what it has recorded stays."""
        return done(await bridge.command(lambda desk: desk.cancel(who(request), run)))

    @router.post("/queue/{run}/move", response_model=Done)
    async def move(request: Request, run: _Id, body: MoveRequest) -> Response:
        """Change when a run has its turn."""
        return done(await bridge.command(lambda desk: desk.move(who(request), run, body.to)))


def _of_devices(router: APIRouter, bridge: Bridge) -> None:
    @router.get("/devices", response_model=list[DeviceState])
    async def devices() -> Response:
        """What there is, and which commands it takes by hand between runs."""
        return _list(await bridge.ask(lambda desk: desk.devices()))

    @router.post("/devices/{name}/{verb}", response_model=Done)
    async def device(request: Request, name: _Name, verb: _Name, body: DeviceRequest | None = None) -> Response:
        """Tell a device something, through the same gate as a run."""
        arguments = {} if body is None else body.arguments
        return done(await bridge.command(lambda desk: desk.device(who(request), name, verb, arguments)))

    @router.post("/sessions/{name}/notes", response_model=Done)
    async def note(request: Request, name: _Name, body: NoteRequest) -> Response:
        """Add a note and tags to a session, running or finished."""
        return done(await bridge.command(lambda desk: desk.note(who(request), name, body.text, body.tags)))

    @router.post("/sessions/{name}/resume", response_model=Done)
    async def resume(request: Request, name: _Name) -> Response:
        """Resume an interrupted run in its session."""
        return done(await bridge.command(lambda desk: desk.resume(who(request), name)))


def _of_the_simulator(router: APIRouter, bridge: Bridge) -> None:
    @router.get("/simulator/faults", response_model=SimulatedFaults)
    async def faults() -> Response:
        """What can be broken in the simulated laboratory, and what is; 409 for a real stand."""
        known = await bridge.ask(lambda desk: desk.known_faults())
        return Response(known.model_dump_json(), media_type="application/json")

    @router.post("/simulator/faults", response_model=Done)
    async def fault(request: Request, body: FaultRequest) -> Response:
        """Break something on purpose, or mend it; 409 for a real stand."""
        return done(await bridge.command(lambda desk: desk.break_(who(request), body)))


def _list(values: tuple[QueuedRun, ...] | tuple[DeviceState, ...]) -> Response:
    return Response("[" + ",".join(each.model_dump_json() for each in values) + "]", media_type="application/json")
