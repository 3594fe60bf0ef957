"""What can be read without asking anybody: the snapshot, the stream, the interface's own metrics, and the login."""

from __future__ import annotations

import asyncio
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from typing import Annotated, Any

from fastapi import APIRouter, Query, Request, Response, WebSocket
from pydantic import BaseModel, Field
from starlette.websockets import WebSocketDisconnect

from thermostand.experiments.steps import make_step_schema
from thermostand.foundation.documents import Document
from thermostand.stand.serving.api.access import COOKIE, INVITE_PATH, LOGIN_PATH, Access
from thermostand.stand.serving.api.bridge import Bridge, NoAnswer, StateSnapshot
from thermostand.stand.serving.api.stream import EVENTS, MOST_VIEWERS, Stream, make_json
from thermostand.stand.serving.api_models import PlanStep, Requester, StandState

# The stand's numbers in the text format of Prometheus (version 0.0.4), written by hand: twenty lines against a library
# whose registry of global counters would be a second memory of the same numbers.

_PHASES = ("idle", "running", "held", "stopping")
_Sample = tuple[Mapping[str, str], float]


# Written by hand: the snapshot has every number already, and a client library would keep them a second time.
def format_metrics(snapshot: StateSnapshot, drops: int, viewers: int) -> str:
    """The whole page."""
    state = snapshot.state
    lines: list[str] = []
    for name, kind, text, samples in (
        *_list_state_metrics(state),
        *_list_run_metrics(state),
        *_list_interface_metrics(snapshot, drops, viewers),
    ):
        lines += [f"# HELP thermostand_{name} {_escape(text)}", f"# TYPE thermostand_{name} {kind}"]
        lines += [f"thermostand_{name}{_format_labels(labels)} {value:.17g}" for labels, value in samples]
    return "\n".join(lines) + "\n"


_Metric = tuple[str, str, str, Sequence[_Sample]]


def _list_state_metrics(state: StandState) -> Iterator[_Metric]:
    labels = {"stand": state.stand, "version": state.version, "simulated": str(state.simulated).lower()}
    yield "info", "gauge", "The stand and its program.", [(labels, 1.0)]
    yield (
        "phase",
        "gauge",
        "1 for the phase the stand is in.",
        [({"phase": p}, float(p == state.phase)) for p in _PHASES],
    )
    good = {channel: r for channel, r in state.readings.items() if r.value is not None}
    values = [({"channel": channel, "unit": r.unit}, r.value or 0.0) for channel, r in good.items()]
    yield "reading", "gauge", "Last reading of a channel that is not bad, in its unit.", values
    ages = [({"channel": c}, (state.now_ns - r.time_ns) / 1e9) for c, r in state.readings.items()]
    yield "reading_age_seconds", "gauge", "Since a channel was last read.", ages
    bad = [({"channel": c}, float(r.value is None)) for c, r in state.readings.items()]
    yield "reading_bad", "gauge", "1 when the last reading of a channel is no measurement.", bad
    yield "hold", "gauge", "1 for each reason that holds the run.", [({"reason": r}, 1.0) for r in state.reasons]
    fault = [({"rule": state.fault.rule}, 1.0)] if state.fault is not None else []
    yield "fault", "gauge", "1 for the rule that has tripped.", fault
    if state.setpoint_degC is not None:
        yield "setpoint_celsius", "gauge", "Set-point of the chamber.", [({}, state.setpoint_degC)]
    if (hand := state.by_hand) is not None:
        yield "by_hand_setpoint_celsius", "gauge", "Set-point of heat by hand, as ordered.", [({}, hand.setpoint_degC)]
        since = [({}, (state.now_ns - hand.since_ns) / 1e9)]
        yield "by_hand_seconds", "gauge", "Since heat by hand was permitted.", since
    if state.output_percent is not None:
        yield "output_percent", "gauge", "Output of the regulator.", [({}, state.output_percent)]
    yield "heater_permitted", "gauge", "1 while heat is permitted.", [({}, float(state.heater_permitted))]
    yield "compressor_on", "gauge", "1 while the compressor's relay is on.", [({}, float(state.compressor_on))]
    yield "disk_free_bytes", "gauge", "Free for sessions.", [({}, float(state.disk_free_bytes))]
    counters = [({"what": what}, value) for what, value in state.counters.items()]
    yield "wear_total", "counter", "What wears: hours, starts and cycles.", counters
    waiting = sum(run.state in ("waiting", "interrupted") for run in state.queue)
    yield "queue_waiting", "gauge", "Runs still to be done.", [({}, float(waiting))]


def _list_run_metrics(state: StandState) -> Iterator[_Metric]:
    run = state.run
    if run is None:
        return
    yield "frames_saved", "gauge", "Frames of this run on the disk.", [({}, float(run.frames_saved))]
    yield "frames_lost", "gauge", "Frames of this run that were lost.", [({}, float(run.frames_lost))]
    yield "step", "gauge", "Number of the step under way.", [({}, float(run.step))]
    yield "steps", "gauge", "Steps of the plan.", [({}, float(run.steps))]
    if run.end_ns is not None:
        yield "left_seconds", "gauge", "Expected until the run ends.", [({}, (run.end_ns - run.now_ns) / 1e9)]


def _list_interface_metrics(snapshot: StateSnapshot, drops: int, viewers: int) -> Iterator[_Metric]:
    yield "snapshot_age_seconds", "gauge", "Since the control loop last reported its state.", [({}, snapshot.age_s)]
    yield "interface_drops_total", "counter", "Items that the interface was too slow for.", [({}, float(drops))]
    yield "viewers", "gauge", "Clients that follow the stream.", [({}, float(viewers))]


def _format_labels(labels: Mapping[str, str]) -> str:
    return (
        "{" + ",".join(f'{name}="{_escape(value, quotes=True)}"' for name, value in labels.items()) + "}"
        if labels
        else ""
    )


def _escape(text: str, *, quotes: bool = False) -> str:
    text = text.replace("\\", "\\\\").replace("\n", "\\n")
    return text.replace('"', '\\"') if quotes else text


_OLD_S = 10.0  # a snapshot is made twice a second: the control loop hangs
_SEND_LIMIT_S = 30.0  # round number; nothing was measured
_MOST_SEQ = 1 << 62
_PAGE = (
    '<!doctype html><html lang="en"><head><meta charset="utf-8"><meta http-equiv="refresh" content="0;url=/">'
    '<title>thermostand</title></head><body><a href="/">thermostand</a></body></html>'
)

Seq = Annotated[int, Query(alias="from", ge=0, le=_MOST_SEQ, description="The last number that you have.")]


class Health(BaseModel):
    """Whether the control loop is alive."""

    ok: bool
    age_s: float
    error: str = ""


class LoginRequest(Document):
    """read_only: for somebody who may only look and press STOP."""

    read_only: bool = Field(default=False, strict=True)


class Invitation(BaseModel):
    """What opens the page in a browser elsewhere, once, within ten minutes. url: "" when the stand is not reached over
    the network."""

    path: str
    url: str


class Events(BaseModel):
    """Events after a number. seq: the last one given, to go on from; gone: what came before is not kept any more."""

    seq: int
    gone: bool
    events: list[dict[str, Any]]


def make_read_routes(bridge: Bridge, stream: Stream, access: Access, url: str) -> APIRouter:
    """The routes. url: of this stand on the network, "" when it does not listen there."""
    router = APIRouter()

    @router.get("/healthz", response_model=Health, responses={503: {"model": Health}})
    async def healthz() -> Response:
        """Return whether the control loop is alive: 200, else 503."""
        age_s = bridge.snapshot.age_s
        health = Health(ok=age_s < _OLD_S, age_s=round(age_s, 3), error="" if age_s < _OLD_S else _explain_age(bridge))
        return _make_response(health.model_dump_json(), 200 if health.ok else 503)

    @router.get("/api/v1/state", response_model=StandState)
    async def state() -> Response:
        """The whole stand as it is now."""
        snapshot = await bridge.get_fresh_snapshot()
        if snapshot.age_s > _OLD_S:
            raise NoAnswer(_explain_age(bridge))
        return _make_response(snapshot.state.model_copy(update={"drops": stream.drops}).model_dump_json())

    @router.get("/api/v1/plan", response_model=list[PlanStep])
    async def plan() -> Response:
        """The plan in force, with what is done and soaked so far; empty when nothing is run."""
        steps = await bridge.plan()
        return _make_response("[" + ",".join(step.model_dump_json() for step in steps) + "]")

    @router.get("/api/v1/plan/schema")
    async def plan_schema() -> dict[str, Any]:
        """The JSON Schema of a step's parameters, by its kind."""
        return make_step_schema()

    @router.get("/api/v1/events", response_model=Events)
    async def events(after: Seq = 0, limit: Annotated[int, Query(ge=1, le=EVENTS)] = 200) -> Response:
        """The events after a number of the stream, oldest first."""
        found = stream.events(after, limit)
        gone = "true" if "event" in stream.list_missing_types(after) else "false"
        seq = found[-1].seq if found else max(after, bridge.snapshot.state.seq)
        return _make_response(f'{{"seq":{seq},"gone":{gone},"events":[{",".join(m.numbered() for m in found)}]}}')

    @router.get("/metrics", response_class=Response, responses={200: {"content": {"text/plain": {}}}})
    async def prometheus() -> Response:
        """Return the metrics in Prometheus' text format."""
        text = format_metrics(bridge.snapshot, stream.drops, stream.viewers)
        return Response(text, media_type="text/plain; version=0.0.4; charset=utf-8")

    _add_stream(router, stream)
    _add_logins(router, access, url)
    return router


def _add_stream(router: APIRouter, stream: Stream) -> None:
    """The stream of all that happens."""

    @router.websocket("/api/v1/stream")
    async def follow(socket: WebSocket, after: Annotated[int | None, Query(alias="from")] = None) -> None:
        """The stream: what there is after a number, or from now on."""
        if stream.viewers >= MOST_VIEWERS:
            sentence = f"{MOST_VIEWERS} viewers follow the stream already"
            await socket.send_denial_response(_make_response(make_json({"error": sentence}), 503))
            return
        await socket.accept()
        await _send_stream(socket, stream, None if after is None else max(0, min(after, _MOST_SEQ)))


def _add_logins(router: APIRouter, access: Access, url: str) -> None:
    """The routes by which a browser elsewhere is let in."""

    @router.get(LOGIN_PATH, response_class=Response, include_in_schema=False)
    async def login(once: str = "") -> Response:
        """The page for a browser with a one-time address of `stand token login`: a cookie instead of it."""
        cookie = access.log_in(once[:100])
        if not cookie:
            return _make_response(
                make_json({"error": "this address has been used, or is too old; `stand token login`"}), 401
            )
        # No redirect: after a link in a mail the cookie, which is SameSite=Strict, would not be sent with it.
        answer = Response(_PAGE, media_type="text/html; charset=utf-8")
        answer.set_cookie(COOKIE, cookie, max_age=30 * 86400, httponly=True, samesite="strict", path="/")
        return answer

    @router.get("/api/v1/who", response_model=Requester)
    async def who(request: Request) -> Response:
        """Return as whom the stand knows you, and your role."""
        return _make_response(request.state.who.model_dump_json())

    @router.post(INVITE_PATH, response_model=Invitation)
    async def invite(request: Request, body: LoginRequest | None = None) -> Response:
        """A one-time path that opens the page on another machine, with the rights of who asks at most."""
        code = access.make_login_code(request.state.who, read_only=body is not None and body.read_only)
        path = f"{LOGIN_PATH}?once={code}"
        return _make_response(make_json({"path": path, "url": f"{url}{path}" if url else ""}))


async def _send_stream(socket: WebSocket, stream: Stream, after: int | None) -> None:
    """Send the stream until the viewer leaves, or does not take what is sent for half a minute."""
    viewer = stream.join(after)

    async def send() -> None:
        while True:
            text = await viewer.next()
            async with asyncio.timeout(_SEND_LIMIT_S):
                await socket.send_text(text)

    async def listen() -> None:
        while True:  # it has nothing to say; this sees it leave
            await socket.receive_text()

    tasks = [asyncio.ensure_future(send()), asyncio.ensure_future(listen())]
    try:
        await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
    finally:
        stream.leave(viewer)
        for task in tasks:
            task.cancel()
        ends = await asyncio.gather(*tasks, return_exceptions=True)
    with suppress(Exception):
        await socket.close()
    for end in ends:
        if isinstance(end, Exception) and not isinstance(
            end, WebSocketDisconnect | TimeoutError | RuntimeError | KeyError
        ):
            raise end


def _explain_age(bridge: Bridge) -> str:
    why = f": {bridge.failure}" if bridge.failure else ""
    return f"the stand's control loop has not answered for {bridge.snapshot.age_s:.0f} s{why}"


def _make_response(text: str, status: int = 200) -> Response:
    return Response(text, status, media_type="application/json")
