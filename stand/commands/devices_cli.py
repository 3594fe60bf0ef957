"""`stand devices`: what is connected to this computer, and what to write into a stand's file for it."""

from __future__ import annotations

import asyncio
from dataclasses import asdict
from typing import Annotated

import typer

from thermostand.drivers.wires.camera_settings import GigeCameraSettings
from thermostand.drivers.wires.discovery import (
    FoundCamera,
    SerialPort,
    UsbDevice,
    find_cameras,
    list_serial_ports,
    list_usb_devices,
)
from thermostand.foundation.command_app import App
from thermostand.foundation.errors import ConfigError
from thermostand.foundation.output import show
from thermostand.foundation.usage import escape_line
from thermostand.stand.config.stand_config import find_packaged, load_config

app = App()


@app.command()
def devices(
    config: Annotated[
        str | None, typer.Option("--config", help="A stand's file: its cameras are asked at their addresses.")
    ] = None,
    ask: Annotated[
        list[str] | None,
        typer.Option(
            metavar="ADDRESS", help="Ask for a camera there, too; a network's broadcast address asks all of it."
        ),
    ] = None,
    wait_s: Annotated[float, typer.Option(min=0.1, max=60.0, help="How long cameras have for their answer.")] = 1.0,
) -> None:
    """Serial ports, USB devices and GigE cameras, with the addresses that a stand's file takes. Nothing is opened or
    changed, and no network is asked that was not named.

    Example: stand devices --ask 169.254.255.255
    """
    addresses = list(ask or ())
    if config is not None:
        stand = load_config(find_packaged("", config))
        gige = (camera for camera in stand.cameras.values() if isinstance(camera, GigeCameraSettings))
        addresses += [camera.address for camera in gige]
    try:
        cameras = asyncio.run(find_cameras(addresses, wait_s)) if addresses else ()
    except (OSError, ValueError) as error:
        raise ConfigError(f"cameras cannot be asked at {', '.join(addresses)}: {error}") from error
    ports, usb = list_serial_ports(), list_usb_devices()
    found = {"serial": ports, "usb": usb, "cameras": cameras}
    data = {kind: [asdict(each) for each in some] for kind, some in found.items()}
    show(data, map(escape_line, _format_lines(ports, usb, cameras, addresses)))


def _format_lines(
    ports: tuple[SerialPort, ...], usb: tuple[UsbDevice, ...], cameras: tuple[FoundCamera, ...], asked: list[str]
) -> list[str]:
    lines = ["serial ports" + ("" if ports else ": none")]
    lines += [f"  serial:{each.address}  {each.what}{_format_serial(each.serial)}" for each in ports]
    lines.append("USB devices" + ("" if usb else ": none"))
    lines += [f"  {each.vendor:04x}:{each.product:04x}  {each.what}{_format_serial(each.serial)}" for each in usb]
    if not asked:
        return [*lines, "cameras: not asked for; `--ask ADDRESS` asks one, or a whole network at its broadcast address"]
    lines.append(
        "cameras" + ("" if cameras else f": none has answered at {', '.join(asked)} (without supply none does)")
    )
    lines += [
        f"  {each.address}  {each.make} {each.model}, firmware {each.firmware}{_format_serial(each.serial)}"
        for each in cameras
    ]
    silent = [address for address in asked if address not in {each.address for each in cameras}]
    if cameras and silent:
        lines.append(f"  no answer at {', '.join(silent)} (a broadcast address never answers itself)")
    return lines


def _format_serial(serial: str) -> str:
    return f', serial number "{serial}"' if serial else ""
