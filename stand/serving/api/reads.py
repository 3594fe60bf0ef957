"""What can be read without asking anybody: the snapshot, the stream, the interface's own metrics, and the login."""

from __future__ import annotations

import asyncio
from contextlib import suppress
from typing import Annotated, Any

from fastapi import APIRouter, Query, Request, Response, WebSocket
from pydantic import BaseModel, Field
from starlette.websockets import WebSocketDisconnect

from thermostand.experiments.steps import schema_of_steps
from thermostand.foundation.documents import Document
from thermostand.stand.serving.api.access import COOKIE, INVITE_PATH, LOGIN_PATH, Access
from thermostand.stand.serving.api.bridge import Bridge, NoAnswer
from thermostand.stand.serving.api.metrics import metrics
from thermostand.stand.serving.api.stream import EVENTS, MOST_VIEWERS, Stream, json_of
from thermostand.stand.serving.desk import PlanStep, StandState, Who

_OLD_S = 10.0  # a snapshot is made twice a second: the control loop hangs
_SEND_LIMIT_S = 30.0
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


def reads(bridge: Bridge, stream: Stream, access: Access, url: str) -> APIRouter:
    """The routes. url: of this stand on the network, "" when it does not listen there."""
    router = APIRouter()

    @router.get("/healthz", response_model=Health, responses={503: {"model": Health}})
    async def healthz() -> Response:
        """Whether the control loop is alive: 200, else 503."""
        age_s = bridge.snapshot.age_s
        health = Health(ok=age_s < _OLD_S, age_s=round(age_s, 3), error="" if age_s < _OLD_S else _too_old(bridge))
        return _json(health.model_dump_json(), 200 if health.ok else 503)

    @router.get("/api/v1/state", response_model=StandState)
    async def state() -> Response:
        """The whole stand as it is now."""
        snapshot = await bridge.fresh()
        if snapshot.age_s > _OLD_S:
            raise NoAnswer(_too_old(bridge))
        return _json(snapshot.state.model_copy(update={"drops": stream.drops}).model_dump_json())

    @router.get("/api/v1/plan", response_model=list[PlanStep])
    async def plan() -> Response:
        """The plan in force, with what is done and earned; empty when nothing is run."""
        steps = await bridge.plan()
        return _json("[" + ",".join(step.model_dump_json() for step in steps) + "]")

    @router.get("/api/v1/plan/schema")
    async def plan_schema() -> dict[str, Any]:
        """The JSON Schema of a step's parameters, by its kind."""
        return schema_of_steps()

    @router.get("/api/v1/events", response_model=Events)
    async def events(after: Seq = 0, limit: Annotated[int, Query(ge=1, le=EVENTS)] = 200) -> Response:
        """The events after a number of the stream, oldest first."""
        found = stream.events(after, limit)
        gone = "true" if "event" in stream.missing_types(after) else "false"
        seq = found[-1].seq if found else max(after, bridge.snapshot.state.seq)
        return _json(f'{{"seq":{seq},"gone":{gone},"events":[{",".join(m.numbered() for m in found)}]}}')

    @router.get("/metrics", response_class=Response, responses={200: {"content": {"text/plain": {}}}})
    async def prometheus() -> Response:
        """For Prometheus, in its text format."""
        text = metrics(bridge.snapshot, stream.drops, stream.viewers)
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
            await socket.send_denial_response(_json(json_of({"error": sentence}), 503))
            return
        await socket.accept()
        await _follow(socket, stream, None if after is None else max(0, min(after, _MOST_SEQ)))


def _add_logins(router: APIRouter, access: Access, url: str) -> None:
    """The routes by which a browser elsewhere is let in."""

    @router.get(LOGIN_PATH, response_class=Response, include_in_schema=False)
    async def login(once: str = "") -> Response:
        """The page for a browser with a one-time address of `stand token login`: a cookie instead of it."""
        cookie = access.log_in(once[:100])
        if not cookie:
            return _json(json_of({"error": "this address has been used, or is too old; `stand token login`"}), 401)
        # No redirect: after a link in a mail the cookie, which is SameSite=Strict, would not be sent with it.
        answer = Response(_PAGE, media_type="text/html; charset=utf-8")
        answer.set_cookie(COOKIE, cookie, max_age=30 * 86400, httponly=True, samesite="strict", path="/")
        return answer

    @router.get("/api/v1/who", response_model=Who)
    async def who(request: Request) -> Response:
        """As whom the stand knows you, and whether you may only look."""
        return _json(request.state.who.model_dump_json())

    @router.post(INVITE_PATH, response_model=Invitation)
    async def invite(request: Request, body: LoginRequest | None = None) -> Response:
        """A one-time path that opens the page on another machine, with the rights of who asks at most."""
        code = access.login_code(request.state.who, read_only=body is not None and body.read_only)
        path = f"{LOGIN_PATH}?once={code}"
        return _json(json_of({"path": path, "url": f"{url}{path}" if url else ""}))


async def _follow(socket: WebSocket, stream: Stream, after: int | None) -> None:
    """Until the viewer leaves, or does not take what is sent for half a minute."""
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


def _too_old(bridge: Bridge) -> str:
    why = f": {bridge.failure}" if bridge.failure else ""
    return f"the stand's control loop has not answered for {bridge.snapshot.age_s:.0f} s{why}"


def _json(text: str, status: int = 200) -> Response:
    return Response(text, status, media_type="application/json")
