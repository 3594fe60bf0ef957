"""The routes of the commands, made from their table, and what can be asked about them. Each is called on the control
loop."""

from __future__ import annotations

import inspect
from collections.abc import Iterable
from typing import Annotated, Any, cast

from fastapi import APIRouter, Header, Path, Request, Response
from fastapi.exceptions import RequestValidationError
from pydantic import BaseModel, JsonValue, ValidationError, create_model
from pydantic.fields import FieldInfo

from thermostand.foundation.documents import Document
from thermostand.stand.serving.api.bridge import Bridge
from thermostand.stand.serving.api_models import DeviceState, PlanCheck, PlanRequest, QueuedRun, SimulatedFaults, Who
from thermostand.stand.serving.commands import STOP, Command

API = "/api/v1"
_KEY = "idempotency_key"  # the header that does what a field `key` does


class CommandInfo(BaseModel):
    """A command: its name, what a button for it is called, what it does, how it is given, and the JSON Schema of what
    it takes, {} for nothing."""

    name: str
    title: str
    text: str
    method: str
    path: str
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
        )

    @router.get("/commands", response_model=list[CommandInfo])
    async def known() -> Response:
        """What may be ordered, and how."""
        return _make_list_response(
            CommandInfo(
                name=each.name,
                title=each.title,
                text=each.summary,
                method=each.http,
                path=f"{API}{each.path}",
                argument={} if each.argument is None else each.argument.model_json_schema(),
            )
            for each in bridge.commands.values()
        )

    # Asked of the stand by the page: rules written again in JavaScript would differ from those that count.
    @router.post("/run/plan/check", response_model=PlanCheck)
    async def check_edit(body: PlanRequest) -> Response:
        """What replacing these steps would say, step by step; changes nothing."""
        return _make_response(await bridge.check_edit(body.from_index, body.steps))

    @router.get("/queue", response_model=list[QueuedRun])
    async def queue() -> Response:
        """What has ended, the run under way, and those to be done in their order."""
        return _make_list_response(bridge.snapshot.state.queue)

    @router.get("/devices", response_model=list[DeviceState])
    async def devices() -> Response:
        """What there is, and which commands it takes by hand between runs."""
        return _make_list_response(await bridge.ask(lambda service: service.devices()))

    @router.get("/simulator/faults", response_model=SimulatedFaults)
    async def faults() -> Response:
        """What can be broken in the simulated laboratory, and what is; 409 for a real stand."""
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
        who = cast("Who", request.state.who)
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
