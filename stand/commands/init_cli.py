"""`stand init`: a folder for a new stand, with what is connected to this computer."""

from __future__ import annotations

import asyncio
import re
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, TypeVar

import typer

from thermostand.drivers.wires.discovery import SerialPort, UsbDevice, find_cameras, list_serial_ports, list_usb_devices
from thermostand.foundation.command_app import App
from thermostand.foundation.errors import ConfigError
from thermostand.foundation.output import say, show
from thermostand.foundation.usage import escape_line
from thermostand.stand.config.stand_config import Folder, find_packaged
from thermostand.stand.estimating.run_estimate import estimate_plan
from thermostand.stand.running.order import load_order

# The text of a new stand's file: an installed one, with what is connected to this computer written into it.

_SCHEMA = re.compile(r"\$schema=\S+/([a-z-]+\.json)")
_README = """\
In this order:

    stand check --config stand.yaml                 # does each device answer, and is it the right one?
    stand plan recipe.yaml --config stand.yaml      # what a run takes; nothing moves
    stand run recipe.yaml --config stand.yaml --virtual-time        # a rehearsal in a simulated laboratory
    stand serve stand.yaml --port 8080              # the stand for days; its page is http://127.0.0.1:8080/
    stand run recipe.yaml --config stand.yaml       # one run, from the command line

`stand config schema --out schema` writes the JSON Schemas that their first lines name: an editor checks them by these.
"""


@dataclass(frozen=True, slots=True)
class ConnectedAxis:
    """A stage: the address of its controller, which is asked for its serial number before anything moves."""

    name: str
    address: str
    serial_number: int


@dataclass(frozen=True, slots=True)
class Connected:
    """What a real stand is made of; "" and empty: stays as the installed file has it, to be edited. bus: the address of
    regulator, relays and thermometers, `serial:PATH` or, of a Modbus gateway, `tcp:HOST:PORT`. flap: the controller's
    USB serial number. camera: its address, and the serial number that must answer there."""

    bus: str = ""
    flap: str = ""
    camera: str = ""
    camera_serial: str = ""
    axes: Sequence[ConnectedAxis] = ()


def make_stand_files(name: str, connected: Connected | None) -> dict[str, str]:
    """The files of a stand's folder by name; the simulated stand's without `connected`."""
    own = {"name": _quote(name), "target": "target.yaml"}
    text = _read_installed("", "simulated" if connected is None else "laboratory")
    for key, value in own.items():
        text = _substitute(text, rf"^{key}: *\S+", f"{key}: {_escape_replacement(value)}")
    if connected is not None:
        text = _insert_devices(text, connected)
    recipe = "demo" if connected is None else "thermal-cycle"
    return {
        "stand.yaml": text,
        "recipe.yaml": _read_installed("recipes", recipe),
        "target.yaml": _read_installed("targets", "paper-9x6"),
        "README.md": f"# {name}\n\n{_README}",
    }


def _insert_devices(text: str, connected: Connected) -> str:
    if connected.bus:
        text = _substitute(text, r"(?<=^bus:)(.*\n  address: )\S+", rf"\g<1>{_escape_replacement(connected.bus)}")
    if connected.flap:
        text = _substitute(
            text, r"(?<=^flap:)(.*\n  serial_number: )\S+", rf"\g<1>{_escape_replacement(_quote(connected.flap))}"
        )
    if connected.camera:
        text = _substitute(text, r"(?m)(^    address: )\d\S+", rf"\g<1>{_escape_replacement(connected.camera)}")
    if connected.camera_serial:
        text = _substitute(
            text, r"(?m)(^    serial_number: )\S+", rf"\g<1>{_escape_replacement(_quote(connected.camera_serial))}"
        )
    for axis in connected.axes:
        wanted = rf'\g<1>{{address: "serial:{_escape_replacement(axis.address)}", serial_number: {axis.serial_number},'
        text = _substitute(text, rf"(^  {re.escape(axis.name)}: )\{{address: \S+ serial_number: \d+,", wanted)
    return text


def _substitute(text: str, pattern: str, by: str) -> str:
    found, count = re.subn(pattern, by, text, count=1, flags=re.MULTILINE)
    if not count:
        raise ConfigError(f"the installed stand's file has no place for {by}; give its name as it is there")
    return found


def _read_installed(folder: Folder, name: str) -> str:
    """The text of an installed file. Its schema is named relative to it, so that the folder may go to any computer."""
    return _SCHEMA.sub(r"$schema=schema/\1", find_packaged(folder, name).read_text("utf-8"))


def _escape_replacement(text: str) -> str:
    """Escape the text that a pattern is replaced by."""
    return text.replace("\\", r"\\")


def _quote(text: str) -> str:
    """A number in quotes stays a text."""
    return '"' + text.replace("\\", "\\\\").replace('"', '\\"') + '"'


app = App()

Found = TypeVar("Found")

_AXES = ("linear", "rotary")
_WAIT_S = 1.0  # for cameras to answer; not measured
_CONTROLLER = re.compile(r"/dev/ximc/([0-9A-Fa-f]{8})")
_POLOLU = 0x1FFB


@app.command("init")
def init(
    directory: Annotated[
        Path, typer.Argument(metavar="DIR", help="The folder of the stand; made when it is not there.")
    ],
    *,
    name: Annotated[str, typer.Option(help="Of the stand; else the folder's.")] = "",
    simulated: Annotated[bool, typer.Option("--simulated", help="The simulated stand: nothing is asked.")] = False,
    bus: Annotated[
        str,
        typer.Option(metavar="PORT|tcp:HOST:PORT", help="Of regulator, relays and thermometers: RS-485 or a gateway."),
    ] = "",
    flap: Annotated[str, typer.Option(metavar="SERIAL", help="USB serial number of the flap's controller.")] = "",
    camera: Annotated[str, typer.Option(metavar="ADDRESS", help="Of the GigE camera; asked who it is.")] = "",
    axis: Annotated[
        list[str] | None, typer.Option(metavar="NAME=PORT:SERIAL", help="A stage's controller; linear or rotary.")
    ] = None,
    ask: Annotated[bool, typer.Option("--ask/--no-ask", help="Ask for what is not given, at a terminal.")] = True,
) -> None:
    """Write a stand's folder: configuration, recipe and target, from what is connected. What is there stays as it is.

    Example: stand init my-stand --bus /dev/serial/by-id/usb-FTDI-port0 --camera 192.168.10.2
    """
    given = Connected(_parse_bus(bus), flap, camera, "", tuple(map(_parse_axis, axis or ())))
    if simulated and given != Connected():
        raise ConfigError("--simulated has devices of its own; leave --bus, --flap, --camera and --axis out")
    is_asked = ask and not simulated and _is_terminal()
    connected = None if simulated else _identify_camera(_ask_missing(given) if is_asked else given)
    texts = make_stand_files(name or directory.absolute().name, connected)
    _check(texts)
    written = _write(directory, texts)
    show({"written": written}, written)
    for what in _list_missing(connected):
        say(f"{directory / 'stand.yaml'}: {what} is still to be written; `stand devices` shows what there is")
    say(f"now: stand plan {directory / 'recipe.yaml'} --config {directory / 'stand.yaml'}")


def _is_terminal() -> bool:
    return sys.stdin.isatty()


def _ask_missing(given: Connected) -> Connected:
    """What is not given is chosen among what is connected; an empty answer leaves it out."""
    ports, usb = list_serial_ports(), list_usb_devices()
    controllers = [port for port in ports if _CONTROLLER.fullmatch(port.address)]
    others = [port for port in ports if port not in controllers]
    axes = list(given.axes)
    for name in _AXES:
        if all(one.name != name for one in axes) and controllers:
            port = _choose(f"controller of the {name} stage", controllers, _format_port)
            axes += [_parse_axis(f"{name}={port.address}:{_parse_serial_number(port)}")] if port is not None else []
    bus = given.bus or _get_address(
        _choose("RS-485 adapter of regulator, relays and thermometers", others, _format_port)
    )
    bus = bus or _parse_bus(
        str(typer.prompt("address of their Modbus TCP gateway (empty: none)", default="", err=True))
    )
    flaps = [device for device in usb if device.vendor == _POLOLU]
    chosen = None if given.flap else _choose("controller of the flap", flaps, _format_usb)
    flap = given.flap or ("" if chosen is None else chosen.serial)
    camera = given.camera or str(typer.prompt("address of the GigE camera (empty: none)", default="", err=True))
    return Connected(bus, flap, camera, "", tuple(axes))


def _choose(what: str, found: Sequence[Found], text: Callable[[Found], str]) -> Found | None:
    """Asked by number; None for none."""
    if not found:
        return None
    for number, each in enumerate(found, 1):
        typer.echo(escape_line(f"  {number}  {text(each)}"), err=True)
    answer = int(typer.prompt(f"{what} (0: none of these)", type=int, default=1 if len(found) == 1 else 0, err=True))
    return found[answer - 1] if 1 <= answer <= len(found) else None


def _format_port(port: SerialPort) -> str:
    return f"{port.address}  {port.what}"


def _format_usb(device: UsbDevice) -> str:
    return f"{device.what}, serial number {device.serial}"


def _get_address(port: SerialPort | None) -> str:
    return "" if port is None else f"serial:{port.address}"


def _parse_bus(text: str) -> str:
    """Parse a bus as the stand's file has it: a device file is a serial port, anything else a gateway, whose usual port
    is 502."""
    text = text.strip()
    if not text or text.startswith(("serial:", "tcp:")):
        return text
    if text.startswith("/") or "/" in text:
        return f"serial:{text}"
    return f"tcp:{text}" if ":" in text else f"tcp:{text}:502"


def _parse_serial_number(port: SerialPort) -> int:
    """The controller's serial number is its name in /dev/ximc, in hexadecimal."""
    found = _CONTROLLER.fullmatch(port.address)
    return int(found[1], 16) if found else 0


def _parse_axis(text: str) -> ConnectedAxis:
    name, _, rest = text.partition("=")
    address, _, serial = rest.rpartition(":")
    if name not in _AXES or not address or not serial.isdecimal():
        raise ConfigError(f"--axis {text}: expected linear=PORT:SERIAL or rotary=PORT:SERIAL")
    return ConnectedAxis(name, address, int(serial))


def _identify_camera(connected: Connected) -> Connected:
    """Add the serial number of the camera that answers; ConfigError when the address cannot be asked."""
    if not connected.camera:
        return connected
    try:
        found = asyncio.run(find_cameras([connected.camera], _WAIT_S))
    except (OSError, ValueError) as error:
        raise ConfigError(f"--camera {connected.camera}: cannot be asked: {error}") from error
    if not found:
        say(f"no camera answers at {connected.camera}; its serial_number is still to be written")
    serial = next((each.serial for each in found), "")
    return Connected(connected.bus, connected.flap, connected.camera, serial, connected.axes)


def _check(texts: Mapping[str, str]) -> None:
    """ConfigError when what would be written could not be run."""
    with tempfile.TemporaryDirectory() as folder:
        _write(Path(folder), texts)
        try:
            order = load_order(str(Path(folder) / "recipe.yaml"), str(Path(folder) / "stand.yaml"))
        except ConfigError as error:  # of a file that nobody will see
            raise ConfigError(f"nothing is written: {str(error).replace(f'{folder}/', '')}") from error
        estimate_plan(tuple(order.recipe.plan()), order.config, Path(folder))


def _write(directory: Path, texts: Mapping[str, str]) -> list[Path]:
    """All of them; ConfigError, and none written, when one is there already."""
    paths = {directory / name: text for name, text in texts.items()}
    if remote := [path for path in paths if path.exists() or path.is_symlink()]:
        raise ConfigError(f"{remote[0]}: is there already, and stays as it is; choose another folder")
    try:
        directory.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(f"{directory}: cannot be made ({error.strerror}); choose another folder") from error
    for path, text in paths.items():
        with path.open("x", encoding="utf-8") as file:
            file.write(text)
    return list(paths)


def _list_missing(connected: Connected | None) -> list[str]:
    if connected is None:
        return []
    stages = {axis.name for axis in connected.axes}
    values = {"bus.address": connected.bus, "flap.serial_number": connected.flap, "the camera": connected.camera_serial}
    return [what for what, value in values.items() if not value] + [f"axes.{one}" for one in _AXES if one not in stages]
