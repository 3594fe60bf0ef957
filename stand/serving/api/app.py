"""The application: every route of the HTTP interface, and how what goes wrong is answered."""

from __future__ import annotations

import importlib.metadata
import inspect
from collections.abc import Callable, Iterable, Mapping
from typing import Annotated, Any, cast

from fastapi import APIRouter, FastAPI, Header, Path, Request, Response
from fastapi.exceptions import RequestValidationError
from pydantic import BaseModel, JsonValue, ValidationError, create_model
from pydantic.fields import FieldInfo
from starlette.exceptions import HTTPException
from starlette.routing import Match

from thermostand.foundation.document_faults import format_path
from thermostand.foundation.documents import Document
from thermostand.foundation.errors import ConfigError, DeviceError, SessionError, StandError, StandTripped
from thermostand.stand.config.interface_section import Role
from thermostand.stand.serving.api.access import FAILED, Access, App, Gatekeeper
from thermostand.stand.serving.api.bridge import Bridge, NoAnswer
from thermostand.stand.serving.api.listeners import Interface
from thermostand.stand.serving.api.overview_routes import make_overview_routes
from thermostand.stand.serving.api.read_routes import make_read_routes
from thermostand.stand.serving.api.session_routes import make_session_routes
from thermostand.stand.serving.api.stream import Stream, make_json
from thermostand.stand.serving.api_models import (
    Conflict,
    DeviceState,
    Forbidden,
    Missing,
    PlanCheck,
    PlanRequest,
    QueuedRun,
    Requester,
    RunPreview,
    RunRequest,
    SimulatedFaults,
)
from thermostand.stand.serving.commands import STOP, Command

# The routes of the commands, made from their table, and what can be asked about them. Each is called on the control
# loop.

API = "/api/v1"
_KEY = "idempotency_key"  # the header that does what a field `key` does


class CommandInfo(BaseModel):
    """A command: its name, what a button for it is called, what it does, how it is given, the role that it needs, null
    for none, and the JSON Schema of what it takes, {} for nothing."""

    name: str
    title: str
    text: str
    method: str
    path: str
    role: Role | None
    argument: dict[str, JsonValue]


def make_command_routes(bridge: Bridge) -> APIRouter:
    """The routes."""
    router = APIRouter(prefix=API)
    for each in bridge.commands.values():
        router.add_api_route(
            each.path,
            _make_endpoint(bridge, each),
            methods=[each.http],
            name=each.method,
            response_model=each.answer,
            status_code=each.status,
            description=each.text,
            openapi_extra={"x-role": each.role or "none"},
        )

    @router.get("/commands", response_model=list[CommandInfo])
    async def known() -> Response:
        """List what may be ordered, and how."""
        return _make_list_response(
            CommandInfo(
                name=each.name,
                title=each.title,
                text=each.summary,
                method=each.http,
                path=f"{API}{each.path}",
                role=each.role,
                argument={} if each.argument is None else each.argument.model_json_schema(),
            )
            for each in bridge.commands.values()
        )

    # Asked of the stand by the page: rules written again in JavaScript would differ from those that count.
    @router.post("/run/plan/check", response_model=PlanCheck)
    async def check_edit(body: PlanRequest) -> Response:
        """Return what replacing these steps would say, step by step; changes nothing."""
        return _make_response(await bridge.check_edit(body.from_index, body.steps))

    @router.post("/previews", response_model=RunPreview)
    async def preview(body: RunRequest) -> Response:
        """Return what a recipe would do on this stand now: its course over time, frames, bytes, end; queues nothing."""
        return _make_response(await bridge.ask(lambda service: service.preview(body)))

    @router.get("/queue", response_model=list[QueuedRun])
    async def queue() -> Response:
        """Return what has ended, the run under way, and those to be done in their order."""
        return _make_list_response(bridge.snapshot.state.queue)

    @router.get("/devices", response_model=list[DeviceState])
    async def devices() -> Response:
        """List the devices, and which commands each takes by hand between runs."""
        return _make_list_response(await bridge.ask(lambda service: service.devices()))

    @router.get("/simulator/faults", response_model=SimulatedFaults)
    async def faults() -> Response:
        """List what can be broken in the simulated laboratory, and what is; 409 for a real stand."""
        return _make_response(await bridge.ask(lambda service: service.list_simulated_faults()))

    return router


def _make_endpoint(bridge: Bridge, command: Command) -> Any:
    """A function with the parameters that FastAPI takes from path, header and body, for this command."""
    parameters = [inspect.Parameter("request", inspect.Parameter.POSITIONAL_OR_KEYWORD, annotation=Request)]
    if (argument := command.argument) is not None:
        fields = argument.model_fields
        parameters += [_make_parameter(name, Annotated[_get_kind(fields[name]), Path()]) for name in command.in_path]
        body = {name: info for name, info in fields.items() if name not in command.in_path}
        if body:
            is_needed = any(info.is_required() for info in body.values())
            kind = argument if len(body) == len(fields) else _make_body_model(argument, body)
            parameters.append(
                _make_parameter("body", kind) if is_needed else _make_parameter("body", kind | None, None)
            )
        if "key" in body:
            parameters.append(_make_parameter(_KEY, Annotated[str, Header(max_length=200)], ""))

    async def endpoint(request: Request, **given: Any) -> Response:
        who = cast("Requester", request.state.who)
        if command.name == STOP:
            return _make_response(await bridge.stop(who))
        return _make_response(await bridge.perform(command.name, who, _make_argument(command, given)), command.status)

    endpoint.__name__ = command.method
    cast("Any", endpoint).__signature__ = inspect.Signature(parameters)
    return endpoint


def _make_argument(command: Command, given: dict[str, Any]) -> Document | None:
    if command.argument is None:
        return None
    body, key = given.pop("body", None), given.pop(_KEY, "")
    if body is not None:
        given.update({name: getattr(body, name) for name in body.model_fields_set})
    if key:
        given["key"] = key
    try:
        return command.argument.model_validate(given)
    except ValidationError as error:
        raise RequestValidationError(error.errors()) from error


def _make_parameter(name: str, kind: Any, default: Any = inspect.Parameter.empty) -> inspect.Parameter:
    return inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, annotation=kind, default=default)


def _get_kind(info: FieldInfo) -> Any:
    return Annotated[(info.annotation, *info.metadata)] if info.metadata else info.annotation


def _make_body_model(argument: type[Document], body: dict[str, FieldInfo]) -> Any:
    """The argument without what stands in the path."""
    fields: dict[str, Any] = {name: (info.annotation, info) for name, info in body.items()}
    more = cast("Any", argument.model_config.get("json_schema_extra"))
    part = create_model(argument.__name__, __doc__=inspect.getdoc(argument), __base__=Document, **fields)
    if more is not None:
        part.model_config["json_schema_extra"] = more
        part.model_rebuild(force=True)
    return part


def _make_response(value: BaseModel, status: int = 200) -> Response:
    return Response(value.model_dump_json(), status, media_type="application/json")


def _make_list_response(values: Iterable[BaseModel]) -> Response:
    return Response("[" + ",".join(each.model_dump_json() for each in values) + "]", media_type="application/json")


# What was raised -> the answer's status; the first that fits.
_STATUS: tuple[tuple[type[Exception], int], ...] = (
    (Missing, 404),
    (Forbidden, 403),
    (Conflict, 409),
    (StandTripped, 409),
    (ConfigError, 422),
    (DeviceError, 502),
    (SessionError, 409),
    (StandError, 409),
    (NoAnswer, 504),
)
_DESCRIPTION = (
    "Reads and operates a thermal test stand. Instants are ns since the epoch on the stand's clock; a state's "
    'utc_offset_ns makes them UTC. Whatever is refused is answered with {"error": sentence}.'
)


def make_app(
    bridge: Bridge,
    stream: Stream,
    access: Access,
    interface: Interface,
    failed: Callable[[Exception], None],
) -> App:
    """The ASGI application behind the one check of who may ask. `failed` is called with errors that should not
    happen."""
    app = FastAPI(
        title="thermostand",
        version=importlib.metadata.version("thermostand"),
        description=_DESCRIPTION,
        docs_url=None,  # pages of another site
        redoc_url=None,
        redirect_slashes=False,
        responses=dict.fromkeys(_REFUSED, _ERROR),
    )
    app.include_router(make_read_routes(bridge, stream, access, interface.url))
    app.include_router(make_command_routes(bridge))
    app.include_router(make_session_routes(bridge, interface.sessions))
    app.include_router(make_overview_routes(interface.stands))
    for routes in interface.extra_routes:
        app.include_router(routes(bridge))
    for kind, status in _STATUS:
        app.add_exception_handler(kind, _make_handler(status))
    app.add_exception_handler(Exception, _handle_failure)
    app.add_exception_handler(RequestValidationError, _handle_validation_error)
    app.add_exception_handler(HTTPException, _handle_http_error)
    return Gatekeeper(cast("App", app), access, failed)


# By who may ask (401, 403, 408, 411, 413), by what was asked (400, 422), and by _STATUS.
_REFUSED = sorted({400, 401, 403, 408, 411, 413, 422, 503, *(status for _, status in _STATUS)})
_ERROR: dict[str, Any] = {
    "description": "What is wrong, in a sentence",
    "content": {
        "application/json": {
            "schema": {"type": "object", "properties": {"error": {"type": "string"}}, "required": ["error"]}
        }
    },
}


def _make_handler(status: int) -> Callable[[Request, Exception], Response]:
    return lambda _, error: _make_error(status, str(error))


def _handle_http_error(request: Request, error: Exception) -> Response:
    refused = cast("HTTPException", error)
    more = {404: "there is no such address; /openapi.json has those there are", 405: "this is not done at this address"}
    text = more.get(refused.status_code, str(refused.detail))
    headers = {"Allow": ", ".join(_list_allowed_methods(request))} if refused.status_code == 405 else refused.headers
    return _make_error(refused.status_code, text, headers)


def _list_allowed_methods(request: Request) -> list[str]:
    """Return what is done at this address, by any of its routes; HEAD is answered where GET is."""
    scope = {"type": "http", "path": request.scope["path"], "root_path": "", "headers": []}

    def is_done(method: str) -> bool:
        return any(route.matches({**scope, "method": method})[0] is Match.FULL for route in request.app.routes)

    found = {method for method in ("DELETE", "GET", "PATCH", "POST", "PUT") if is_done(method)}
    return sorted(found | ({"HEAD"} if "GET" in found else set()))


def _handle_failure(_: Request, error: Exception) -> Response:
    """Return what should not happen; the gatekeeper gets it as well."""
    return _make_error(500, FAILED.format(type(error).__name__))


_SENTENCES = {
    "extra_forbidden": "there is no such field; /openapi.json has those there are",
    "model_attributes_type": "send a JSON object, with the header content-type: application/json",
    "dict_type": "send a JSON object, with the header content-type: application/json",
    "missing": "is needed",
}


def _handle_validation_error(_: Request, error: Exception) -> Response:
    """Where, and what is wrong there; not what was sent, which may be secret or long."""
    faults = cast("RequestValidationError", error).errors()
    sentences: list[str] = []
    for fault in faults[:5]:
        if fault["type"] == "json_invalid":
            sentences.append(f"the body: is no JSON from character {int(fault['loc'][-1]) + 1} on")
            continue
        where = format_path(part for part in fault["loc"] if part not in ("body", "query", "path", "header"))
        sentences.append(f"{where or 'the body'}: {_SENTENCES.get(fault['type'], fault['msg'])}")
    return _make_error(422, "; ".join(sentences) or "the request is not understood")


def _make_error(status: int, sentence: str, headers: Mapping[str, str] | None = None) -> Response:
    text = sentence.encode("utf-8", "replace").decode()
    return Response(make_json({"error": text}), status, dict(headers or {}), "application/json")
