"""Whether every device of a stand answers and is the configured one, asked before a night is queued that no daemon has.

The stand's addresses are locked as for a run. Identities are read and nothing is written: no device gets its start-up
commands or settings, nobody takes control of a camera.
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Sequence
from functools import partial

from thermostand.drivers.devices.protocols import Controller
from thermostand.drivers.devices.relays import CAMERA_POWER
from thermostand.drivers.settings import OnBus
from thermostand.drivers.wires.camera_settings import GigeCameraSettings
from thermostand.drivers.wires.discovery import FoundCamera, cameras_at
from thermostand.drivers.wires.modbus_unit import ModbusUnit
from thermostand.foundation.errors import DeviceError, DeviceFault
from thermostand.stand.assembly import Assembly, register_map
from thermostand.stand.config.stand_config import StandConfig
from thermostand.stand.running.opening.open_stand import at_bench

COMMAND = "stand queue add"
_CAMERA_WAIT_S = 1.0  # for its answer to GVCP's discovery

Ask = Callable[[], Awaitable[object]]


async def not_answering(config: StandConfig) -> tuple[str, ...]:
    """What keeps a run of this stand from beginning now, a sentence for each device; () when nothing does.

    A camera without supply is not asked, since a run switches it on. InUse when another program has the stand: then
    nothing was asked. ConfigError as `assemble`.
    """
    async with at_bench(config, COMMAND) as assembly:
        alone: list[Ask] = []
        for each in assembly.equipment:
            device = assembly.devices.every[each.name]
            if each.kind.device == "regulator" and each.kind.address_key:
                alone.append(partial(_in_force, assembly.devices.regulator))
            elif each.kind.is_opened and each.kind.address_key and each.settings is not None:
                alone.append(device.open)
        others = asyncio.gather(*(_asked(ask) for ask in alone))
        (on_bus, is_supplied), lacking = await asyncio.gather(_of_bus(assembly), others)
        cameras = await _of_cameras(config) if is_supplied else ()
        return (*on_bus, *(lack for lacks in lacking for lack in lacks), *cameras)


async def _in_force(chamber: Controller) -> None:
    """DeviceFault when its set-point would not be in force."""
    await chamber.open()
    if objections := (await chamber.in_force()).objections:
        raise DeviceFault(chamber.name, f"its set-point is not in force: {'; '.join(objections)}")


async def _of_bus(assembly: Assembly) -> tuple[Sequence[str], bool]:
    """Of the units that share a line, which are asked one after the other; and whether the cameras have their supply,
    as far as the relays tell."""
    devices = assembly.devices
    if lacks := await _asked(assembly.bus.open):
        return lacks, False
    asks: list[Ask] = []
    for name, kind, settings in assembly.equipment:
        if not isinstance(settings, OnBus) or kind.section == "relays":
            continue
        probe = ModbusUnit(name, assembly.bus, register_map(kind.section, settings)).probe
        asks.append(devices.every[name].open if kind.asks_only else probe)
    lacks = [lack for ask in asks for lack in await _asked(ask)]
    try:
        await devices.relays.open()
        readings = await devices.relays.read()
    except DeviceError as error:
        return [*lacks, str(error)], False
    return lacks, all(each.value == 1 for each in readings if each.channel.endswith(f".{CAMERA_POWER}"))


async def _asked(ask: Ask) -> Sequence[str]:
    try:
        await ask()
    except DeviceError as error:
        return [str(error)]
    return []


async def _of_cameras(config: StandConfig) -> Sequence[str]:
    wanted = {name: each for name, each in config.cameras.items() if isinstance(each, GigeCameraSettings)}
    if not wanted:
        return ()
    try:
        answers = await cameras_at([each.address for each in wanted.values()], _CAMERA_WAIT_S)
    except OSError as error:
        return [f"cameras cannot be asked: {error.strerror}"]
    found = {each.address: each for each in answers}
    return [lack for name, settings in wanted.items() if (lack := _lack(name, settings, found.get(settings.address)))]


def _lack(name: str, settings: GigeCameraSettings, found: FoundCamera | None) -> str:
    if found is None:
        return f"{name}: no camera answers at {settings.address}"
    if settings.serial_number not in (None, found.serial):
        return f"{name}: serial number {settings.serial_number} is expected, {found.serial} answers"
    return ""
