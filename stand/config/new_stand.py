"""The text of a new stand's file: an installed one, with what is connected to this computer written into it."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

from thermostand.foundation.errors import ConfigError
from thermostand.stand.config.stand_config import Folder, find_packaged

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
