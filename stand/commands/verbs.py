"""The verbs of the command line that are commands of a stand's service: made from its table, thin clients of the HTTP
interface. Whatever they do, a program can do as well."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Any, Literal, cast, get_args, get_origin
from urllib.parse import quote

import typer
from pydantic.fields import FieldInfo

from thermostand.foundation.command_app import App, with_parameters
from thermostand.foundation.output import show
from thermostand.foundation.usage import one_line
from thermostand.stand.commands.reached import OPTIONS, DirectoryArgument, reached
from thermostand.stand.service import StandService
from thermostand.stand.serving.client import API, Answer
from thermostand.stand.serving.commands import STOP, Command, Served, Typed, commands_of

_LIMIT_S = 60.0  # what a command waits for: a device may move, or the stand's wires be asked


def app_of(service: type[Served]) -> App:
    """The command line of a service."""
    app = App()
    for each in commands_of(service).values():
        if each.has_verb:
            app.command(each.name)(_verb(each))
    return app


def _verb(command: Command) -> Callable[..., None]:
    fields = {} if command.argument is None else command.argument.model_fields
    typed = {name: _typed(name, info) for name, info in fields.items()}

    def verb(**given: Any) -> None:
        place = (given.pop("directory"), given.pop("config"), given.pop("url"), given.pop("token_file"))
        values = {name: value for name in fields if (value := _value(typed[name], given[typed[name].name])) is not None}
        server = reached(*place, anywhere=command.anywhere)
        if command.name == STOP:
            answer = server.order(STOP)  # which has a way of its own
        else:
            path = command.path.format(**{name: quote(str(values.pop(name)), safe="") for name in command.in_path})
            answer = cast("Answer", server.request(command.http, f"{API}{path}", values or None, _LIMIT_S))
        moving = ", ".join(map(one_line, cast("list[str]", answer.get("moving", []))))
        text = str(answer.get("text") or command.name) + (f"; still moving: {moving}" if moving else "")
        show(answer, [f"{server.name}: {one_line(text)}"])

    verb.__name__, verb.__doc__ = command.method, command.text
    parameters = {typed[name].name: _option(info, typed[name]) for name, info in fields.items()}
    return with_parameters(verb, _nothing, {**parameters, "directory": (DirectoryArgument, None), **OPTIONS})


def _nothing() -> None:
    """All parameters are added to those of this one."""


def _typed(name: str, info: FieldInfo) -> Typed:
    return next((each for each in info.metadata if isinstance(each, Typed)), Typed(name))


def _value(typed: Typed, given: object) -> object:
    if typed.value is not None:
        return typed.value if given else None
    return float(str(given)) * typed.unit if typed.unit is not None and given is not None else given


def _option(info: FieldInfo, typed: Typed) -> tuple[Any, object]:
    """How typer sees a field: what is required is an argument, all else an option."""
    help_text = typed.help or info.description or ""
    if typed.value is not None:
        return Annotated[bool, typer.Option(f"--{typed.name.replace('_', '-')}", help=help_text)], False
    kind: Any = info.annotation
    kind = str if get_origin(kind) is Literal and all(isinstance(each, str) for each in get_args(kind)) else kind
    if info.is_required():
        return Annotated[kind, typer.Argument(metavar=typed.name.upper(), help=help_text)], ...
    return Annotated[kind | None, typer.Option(help=help_text)], None


app = app_of(StandService)
