"""The verbs of the command line that are commands of a stand's service: made from its table, thin clients of the HTTP
interface. Whatever they do, a program can do as well."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, Literal, cast, get_args, get_origin
from urllib.parse import quote

import typer
from pydantic import BaseModel
from pydantic.fields import FieldInfo

from thermostand.foundation.command_app import App, add_parameters
from thermostand.foundation.documents import read_document
from thermostand.foundation.output import show
from thermostand.foundation.usage import escape_line
from thermostand.stand.commands.endpoint import OPTIONS, DirectoryArgument, find_server
from thermostand.stand.service.stand_service import StandService
from thermostand.stand.serving.api_models import CommandAnswer
from thermostand.stand.serving.client import API, Answer, Server
from thermostand.stand.serving.commands import STOP, Command, Served, Typed, collect_commands

_LIMIT_S = 60.0  # what a command waits for: a device may move, or the stand's wires be asked


def make_app(service: type[Served], group: str = "", help_text: str | None = None) -> App:
    """The command line of a service, of the verbs that stand behind `group`, such as `queue`."""
    app = App(help_text, no_args_is_help=bool(group))
    for each in collect_commands(service).values():
        for words in (verb.split() for verb in each.verbs or ()):
            if words[:-1] == group.split():
                app.command(words[-1])(_make_verb(each))
    return app


def ask(server: Server, command: Command, **given: object) -> Answer:
    """Return what a stand answers to a command with these fields of its argument. SessionError as Server.request."""
    if command.name == STOP:
        return server.order(STOP)  # which has a way of its own
    path = command.path.format(**{name: quote(str(given.pop(name)), safe="") for name in command.in_path})
    return cast("Answer", server.request(command.http, f"{API}{path}", given or None, _LIMIT_S))


def order(server: Server, name: str, **given: object) -> Answer:
    """The same for a command of the stand's service, by its name."""
    return ask(server, COMMANDS[name], **given)


def make_recipe_request(recipe: str) -> dict[str, object]:
    """Return what asks for a recipe: a file's as it is now, or an installed one."""
    typed = _get_typed("recipe", _list_fields(COMMANDS["submit"])["recipe"])
    return dict([_get_field("recipe", typed, recipe)])


def _make_verb(command: Command) -> Callable[..., None]:
    fields = _list_fields(command)
    typed = {name: shown for name, info in fields.items() if (shown := _get_typed(name, info)).name}

    def verb(**given: Any) -> None:
        place = (given.pop("directory"), given.pop("config"), given.pop("url"), given.pop("token_file"))
        values = dict(
            _get_field(name, each, value)
            for name, each in typed.items()
            if (value := _convert_value(each, given[each.name])) not in (None, False, [])
        )
        server = find_server(*place, anywhere=command.anywhere)
        answer = ask(server, command, **values)
        show(answer, [_format_answer(server, command, answer)])

    verb.__name__, verb.__doc__ = command.method, command.text
    parameters = {each.name: _make_option(fields[name], each) for name, each in typed.items()}
    return add_parameters(verb, _take_nothing, {**parameters, "directory": (DirectoryArgument, None), **OPTIONS})


def _format_answer(server: Server, command: Command, answer: Answer) -> str:
    """A sentence of what came of it; of what is queued its number, for programs."""
    if command.answer is not CommandAnswer:
        return str(answer.get("id", ""))
    moving = ", ".join(map(escape_line, cast("list[str]", answer.get("moving", []))))
    text = str(answer.get("text") or command.name) + (f"; still moving: {moving}" if moving else "")
    return f"{server.name}: {escape_line(text)}"


def _list_fields(command: Command) -> dict[str, FieldInfo]:
    return {} if command.argument is None else cast("type[BaseModel]", command.argument).model_fields


def _take_nothing() -> None:
    """All parameters are added to those of this one."""


def _get_typed(name: str, info: FieldInfo) -> Typed:
    return next((each for each in info.metadata if isinstance(each, Typed)), Typed(name))


def _convert_value(typed: Typed, given: object) -> object:
    if typed.value is not None:
        return typed.value if given else None
    return float(str(given)) * typed.unit if typed.unit is not None and given is not None else given


def _get_field(name: str, typed: Typed, value: object) -> tuple[str, object]:
    """Return which field gets which argument."""
    if typed.text_in and (path := Path(str(value))).is_file():
        return typed.text_in, read_document(path)
    return name, value


def _make_option(info: FieldInfo, typed: Typed) -> tuple[Any, object]:
    """Return how typer sees a field: what is required is an argument, all else an option."""
    help_text = typed.help or info.description or ""
    kind: Any = info.annotation
    if typed.value is not None or kind is bool:
        return Annotated[bool, typer.Option(f"--{typed.name.replace('_', '-')}", help=help_text)], False
    if get_origin(kind) is tuple:
        return Annotated[list[str] | None, typer.Option(f"--{typed.name}", help=help_text)], None
    kind = str if get_origin(kind) is Literal and all(isinstance(each, str) for each in get_args(kind)) else kind
    if info.is_required() or typed.is_first:
        return Annotated[kind, typer.Argument(metavar=typed.name.upper(), help=help_text)], ...
    return Annotated[kind | None, typer.Option(help=help_text)], None


COMMANDS = collect_commands(StandService)
app = make_app(StandService)
