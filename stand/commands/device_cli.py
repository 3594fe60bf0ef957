"""`stand device`: one device by hand, by the daemon that has the stand, or opened for this command."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated, cast

import typer
from pydantic import JsonValue

from thermostand.foundation.command_app import App
from thermostand.foundation.errors import ConfigError, SessionError
from thermostand.foundation.output import say, show
from thermostand.foundation.usage import escape_line
from thermostand.stand.commands.endpoint import (
    ConfigOption,
    DirectoryOption,
    TokenOption,
    UrlOption,
    find_server,
)
from thermostand.stand.commands.verbs import order
from thermostand.stand.serving.api_models import DeviceState, StandState
from thermostand.stand.serving.client import API, Server, list_running_sessions

app = App()


@app.command()
def device(
    name: Annotated[str, typer.Argument(help="The device; without one all are listed, with what they take.")] = "",
    *,
    verb: Annotated[str, typer.Argument(help="What it is to do.")] = "",
    arguments: Annotated[
        list[str] | None, typer.Argument(metavar="[NAME=VALUE]...", help="What the verb takes.")
    ] = None,
    out: Annotated[Path | None, typer.Option("-o", metavar="FILE", help="The PNG for a frame that is grabbed.")] = None,
    directory: DirectoryOption = None,
    config: ConfigOption = "simulated",
    url: UrlOption = "",
    token_file: TokenOption = None,
) -> None:
    """Command one device by hand, between runs, through the same gate as a run. Without a daemon the device is
    opened for it, and made safe and closed at the end; it then knows read, registers and grab, too.

    Example: stand device flap open
    """
    given = dict(map(_parse_argument, arguments or ()))
    try:
        server = find_server(directory, config, url, token_file)
    except SessionError:
        if url or directory is not None:
            raise
        _order_bench(config, name, verb, given, out)
        return
    _order_daemon(server, name, verb, given)


def _order_daemon(server: Server, name: str, verb: str, arguments: dict[str, object]) -> None:
    if not verb:
        _show_devices(server, name)
        return
    if verb == "read":
        state = StandState.model_validate(server.request("GET", f"{API}/state"))
        found = {channel: each for channel, each in state.readings.items() if channel.startswith(f"{name}.")}
        lines = (
            f"{channel:<28}{each.value} {each.unit} {each.quality} {each.reason}" for channel, each in found.items()
        )
        show({channel: each.model_dump(mode="json") for channel, each in found.items()}, map(escape_line, lines))
        return
    if verb in ("registers", "grab"):
        raise ConfigError(f"{verb} is for a stand that no daemon has; the daemon takes a frame by `{name} frame`")
    answer = order(server, "device", device=name, verb=verb, arguments=arguments)
    show(answer, [escape_line(answer["text"] or f"{name}: {verb}")])


def _order_bench(config: str, name: str, verb: str, arguments: dict[str, object], out: Path | None) -> None:
    # Opening devices takes half a second of imports, which a client of the daemon need not wait for.
    from thermostand.stand.config.stand_config import find_packaged, load_config
    from thermostand.stand.service.bench import list_devices, run_device_verb

    stand = load_config(find_packaged("", config))
    others = ", ".join(map(str, list_running_sessions()))
    elsewhere = f"; one runs at {others}: `--dir` names it, if it has this stand" if others else ""
    note = f"no daemon runs in {stand.recording.directory}{elsewhere}"
    if verb:
        say(f"{note}; {name} is opened for this command")
        values = cast("dict[str, JsonValue]", arguments)
        done = asyncio.run(run_device_verb(stand, name, verb, values, out, say))
        show(done.data, map(escape_line, done.lines))
        return
    devices = [each for each in list_devices(stand) if name in ("", each.name)]
    if not devices:
        raise ConfigError(f"there is no device {name}; `stand device` lists them")
    note = f"{note}: a device is opened for each command, and left safe at its end"
    show([each.model_dump(mode="json") for each in devices], [escape_line(note), *_format_device_lines(devices)])


def _show_devices(server: Server, name: str) -> None:
    found = cast("list[object]", server.request("GET", f"{API}/devices"))
    devices = [each for each in map(DeviceState.model_validate, found) if name in ("", each.name)]
    if not devices:
        raise ConfigError(f"there is no device {name}; `stand device` lists them")
    show([each.model_dump(mode="json") for each in devices], _format_device_lines(devices))


def _format_device_lines(devices: Sequence[DeviceState]) -> Iterator[str]:
    for each in devices:
        yield escape_line(f"{each.name} ({each.kind})" + (f": {each.refused}" if each.refused else ""))
        for verb in each.verbs:
            takes = " ".join(
                f"{one.name}={_format_range(one.minimum, one.maximum, one.choices, one.unit)}" for one in verb.arguments
            )
            yield escape_line(f"  {verb.verb} {takes}".rstrip() + f"    {verb.text}")


def _format_range(minimum: float | None, maximum: float | None, choices: tuple[str, ...], unit: str) -> str:
    if choices:
        return "|".join(choices)
    low, high = ("" if value is None else f"{value:g}" for value in (minimum, maximum))
    return f"{low}..{high}{unit}" if low or high else (unit or "VALUE").upper()


def _parse_argument(text: str) -> tuple[str, object]:
    """`setpoint_degC=20`: a number, true or false where it is one, else a text."""
    name, is_given, value = text.partition("=")
    if not is_given or not name:
        raise ConfigError(f"{text}: expected NAME=VALUE; `stand device` lists what each verb takes")
    try:
        found: object = json.loads(value)
    except ValueError:
        return name, value
    return name, found if isinstance(found, bool | int | float) else value
