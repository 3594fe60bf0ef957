"""The commands for a stand that `stand serve` owns: submit a run, tell a device something by hand."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from typing import Annotated, cast
from urllib.parse import quote

import typer

from foundation.command_app import App
from foundation.errors import ConfigError
from foundation.output import show
from foundation.usage import one_line
from stand.commands.reached import on_stand
from stand.commands.submitted import submit_recipe
from stand.serving.client import API, Answer, Server
from stand.serving.desk import DeviceState

app = App()

_LIMIT_S = 60.0  # a device may move for so long


@app.command()
@on_stand(by_option=True)
def submit(
    server: Server,
    recipe: Annotated[str, typer.Argument(help="A recipe file, or the name of an installed one.")],
    attended: Annotated[bool, typer.Option("--attended", help="Somebody does what the plan prompts for.")] = False,
    key: Annotated[str, typer.Option(help="Your own word for this run: given again, nothing is queued twice.")] = "",
) -> None:
    """Queue a run of the stand's daemon, as the recipe is now. Prints its number.

    Example: stand submit night.yaml --key monday
    """
    run = submit_recipe(server, recipe, attended=attended, key=key)
    show(run.model_dump(mode="json"), [run.id])


@app.command()
@on_stand(by_option=True)
def device(
    server: Server,
    name: Annotated[str, typer.Argument(help="The device; without one all are listed, with what they take.")] = "",
    verb: Annotated[str, typer.Argument(help="What it is told.")] = "",
    arguments: Annotated[
        list[str] | None, typer.Argument(metavar="[NAME=VALUE]...", help="What the verb takes.")
    ] = None,
) -> None:
    """Tell a device something by hand, between runs, through the same gate as a run.

    Example: stand device flap open
    """
    if not verb:
        _show_devices(server, name)
        return
    body: dict[str, object] = {"arguments": dict(map(_argument, arguments or ()))}
    path = f"{API}/devices/{quote(name, safe='')}/{quote(verb, safe='')}"
    answer = cast("Answer", server.request("POST", path, body, _LIMIT_S))
    show(answer, [one_line(answer["text"] or f"{name}: {verb}")])


def _show_devices(server: Server, name: str) -> None:
    found = cast("list[object]", server.request("GET", f"{API}/devices"))
    devices = [each for each in map(DeviceState.model_validate, found) if name in ("", each.name)]
    if not devices:
        raise ConfigError(f"there is no device {name}; `stand device` lists them")
    show([each.model_dump(mode="json") for each in devices], _device_lines(devices))


def _device_lines(devices: Sequence[DeviceState]) -> Iterator[str]:
    for each in devices:
        yield one_line(f"{each.name} ({each.kind})" + (f": {each.refused}" if each.refused else ""))
        for verb in each.verbs:
            takes = " ".join(
                f"{one.name}={_range(one.minimum, one.maximum, one.choices, one.unit)}" for one in verb.arguments
            )
            yield one_line(f"  {verb.verb} {takes}".rstrip() + f"    {verb.text}")


def _range(minimum: float | None, maximum: float | None, choices: tuple[str, ...], unit: str) -> str:
    if choices:
        return "|".join(choices)
    low, high = ("" if value is None else f"{value:g}" for value in (minimum, maximum))
    return f"{low}..{high}{unit}" if low or high else (unit or "VALUE").upper()


def _argument(text: str) -> tuple[str, object]:
    """`setpoint_degC=20`: a number, true or false where it is one, else a text."""
    name, is_given, value = text.partition("=")
    if not is_given or not name:
        raise ConfigError(f"{text}: expected NAME=VALUE")
    try:
        found: object = json.loads(value)
    except ValueError:
        return name, value
    return name, found if isinstance(found, bool | int | float) else value
