"""The application: every route of the HTTP interface, and how what goes wrong is answered."""

from __future__ import annotations

import importlib.metadata
from collections.abc import Callable, Mapping
from typing import Any, cast

from fastapi import FastAPI, Request, Response
from fastapi.exceptions import RequestValidationError
from starlette.exceptions import HTTPException
from starlette.routing import Match

from thermostand.foundation.document_faults import format_path
from thermostand.foundation.errors import ConfigError, DeviceError, SessionError, StandError, StandTripped
from thermostand.stand.serving.api.access import FAILED, Access, App, Gatekeeper
from thermostand.stand.serving.api.bridge import Bridge, NoAnswer
from thermostand.stand.serving.api.listeners import Interface
from thermostand.stand.serving.api.order_routes import make_command_routes
from thermostand.stand.serving.api.read_routes import make_read_routes
from thermostand.stand.serving.api.session_routes import make_session_routes
from thermostand.stand.serving.api.stream import Stream, make_json
from thermostand.stand.serving.api_models import Conflict, Missing

# What was raised -> the answer's status; the first that fits.
_STATUS: tuple[tuple[type[Exception], int], ...] = (
    (Missing, 404),
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
    """What is done at this address, by any of its routes; HEAD is answered where GET is."""
    scope = {"type": "http", "path": request.scope["path"], "root_path": "", "headers": []}

    def is_done(method: str) -> bool:
        return any(route.matches({**scope, "method": method})[0] is Match.FULL for route in request.app.routes)

    found = {method for method in ("DELETE", "GET", "PATCH", "POST", "PUT") if is_done(method)}
    return sorted(found | ({"HEAD"} if "GET" in found else set()))


def _handle_failure(_: Request, error: Exception) -> Response:
    """What should not happen; the gatekeeper gets it as well."""
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
