"""One device by hand while no daemon has the stand: `stand device NAME VERB` at the bench.

The stand's addresses are locked as for a run, the device and what it needs are opened, commands go through the
verbs of the stand, so through its gate and limits, and at the end what was moved is made safe: the flap is shut, stages
stand still, the cameras' supply is as it was. Nothing is heated: heat needs a recording and the guard.
"""

from __future__ import annotations

import math
from collections.abc import AsyncGenerator, Callable, Iterator, Mapping, Sequence
from contextlib import AsyncExitStack, asynccontextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import cast

from pydantic import JsonValue

from thermostand.drivers.devices.protocols import Actuator, Sensor
from thermostand.drivers.settings import OnBus
from thermostand.drivers.wires.modbus_unit import ModbusUnit
from thermostand.foundation.clock import WallClock, to_ns
from thermostand.foundation.errors import ConfigError, DeviceError, StandTripped
from thermostand.foundation.files import write_bytes_atomically
from thermostand.foundation.hub import Hub
from thermostand.foundation.readings import Reading
from thermostand.foundation.repeat_limit import RepeatLimit
from thermostand.recording.format.images import encode_png
from thermostand.stand.assembly.assemble import Assembly, assemble, load_unit_map
from thermostand.stand.config.stand_config import StandConfig
from thermostand.stand.running.opening.open_stand import make_safe, open_bench
from thermostand.stand.running.opening.stop import Stop
from thermostand.stand.service.manual_control import ManualControl
from thermostand.stand.serving.api_models import Argument, Conflict, DeviceState, DeviceVerb

COMMAND = "stand device"
READ, REGISTERS, GRAB = "read", "registers", "grab"
_OPEN_S = 10.0  # that a flap stays open


@dataclass(frozen=True, slots=True)
class BenchResult:
    """What came of it: lines for people, and the same as data."""

    lines: Sequence[str]
    data: object


def list_devices(config: StandConfig) -> tuple[DeviceState, ...]:
    """Return what there is, and what it takes; nothing is opened."""
    devices = ManualControl(assemble(config, Hub(RepeatLimit()), WallClock()), _refuse_heat).devices("")
    return tuple(each.model_copy(update={"verbs": (*_list_read_verbs(config, each), *each.verbs)}) for each in devices)


def _list_read_verbs(config: StandConfig, device: DeviceState) -> Iterator[DeviceVerb]:
    """Return what a device takes by hand besides what it takes of a daemon."""
    yield DeviceVerb(verb=READ, text="what it reads")
    if any(each.name == device.name and isinstance(each.settings, OnBus) for each in config.equipment):
        yield DeviceVerb(verb=REGISTERS, text="every point of its register map")
    if device.kind == "camera":
        exposure, flap = Argument(name="exposure_s", unit="s"), Argument(name="flap", choices=("open",))
        yield DeviceVerb(verb=GRAB, text="one frame, kept with -o FILE", arguments=(exposure, flap))


async def run_device_verb(
    config: StandConfig, name: str, verb: str, arguments: Mapping[str, JsonValue], out: Path | None, tell: Tell
) -> BenchResult:
    """Do it. ConfigError and Missing for what the device does not know, Conflict for what needs a daemon, InUse when
    another program has the stand: then nothing was touched."""
    arguments = dict(arguments)
    open_s = float(str(arguments.pop("open_s", _OPEN_S))) if verb == "open" else 0.0
    async with _open_bench(config) as hands:
        hands.check(name, verb)
        device = await hands.opened(name)
        match verb:
            case "read":
                return _make_readings_result(await device.read())
            case "registers":
                return await _read_registers(hands.assembly, name)
            case "grab":
                return await hands.grab(name, arguments, out)
            case _:
                await ManualControl(hands.assembly, _refuse_heat).work(name, verb, arguments)
        if verb == "open":
            tell(f"{name} is open, and closes in {open_s:g} s")
            clock = hands.assembly.clock
            await clock.sleep_until(clock.now_ns() + to_ns(open_s))
        done = _make_readings_result(await device.read())
        return BenchResult([f"{name}: {verb}", *done.lines], done.data)


Tell = Callable[[str], None]


class _Bench:
    """What is open."""

    def __init__(self, assembly: Assembly) -> None:
        self.assembly = assembly
        self._equipment = {each.name: each for each in assembly.equipment}

    def check(self, name: str, verb: str) -> None:
        """ConfigError when there is no such device, or it does not know that; nothing was opened then."""
        known = {each.name: each for each in list_devices(self.assembly.config)}
        if name not in known:
            raise ConfigError(f"this stand has no device {name}; there are {', '.join(known)}")
        verbs = [each.verb for each in known[name].verbs]
        if verb not in (*verbs, REGISTERS, GRAB):  # which say more themselves
            raise ConfigError(f"{name} does not know {verb}; it takes {', '.join(verbs)}")

    async def opened(self, name: str) -> Sensor:
        """The device, with what it needs."""
        assembly, (_, kind, _) = self.assembly, self._equipment[name]
        if not kind.address_key or kind.section == "cameras":
            await assembly.bus.open()
        if kind.section == "cameras":
            await assembly.devices.relays.open()
            supply = assembly.stand.imaging.supply
            await supply.switch_on()
            if supply.was_on is False:
                assembly.stand.safety.take(supply)
            return assembly.devices.cameras[name]
        device = assembly.devices.every[name]
        await device.open()
        if kind.address_key and kind.device != "regulator" and hasattr(device, "make_safe"):
            assembly.stand.opened(cast("Actuator", device))
        return device

    async def grab(self, name: str, arguments: Mapping[str, JsonValue], out: Path | None) -> BenchResult:
        """One frame, as a PNG in `out` when that is given; flap=open: through the flap, which is shut again."""
        camera = self.assembly.devices.cameras.get(name)
        if camera is None:
            raise ConfigError(f"{name} is no camera; {', '.join(self.assembly.devices.cameras) or 'there is none'}")
        exposure, imaging = arguments.get("exposure_s"), self.assembly.stand.imaging
        if arguments.get("flap") == "open":
            await self.opened("flap")
            await imaging.open_flap()
        frame = await camera.grab(None if exposure is None else float(str(exposure)))
        height, width = frame.image.shape
        data = {
            "width_px": width,
            "height_px": height,
            "mean_grey": round(float(frame.image.mean()), 2),
            "darkest": int(frame.image.min()),
            "brightest": int(frame.image.max()),
            "exposure_s": frame.exposure_s,
            "camera_degC": None if math.isnan(frame.camera_degC) else round(frame.camera_degC, 2),
            "file": None if out is None else str(out),
        }
        if out is not None:
            write_bytes_atomically(out, encode_png(frame.image))
        kept = "; -o FILE keeps it" if out is None else f", {out}"
        text = (
            f"{name}: {width} x {height}, grey {data['darkest']} to {data['brightest']}, mean {data['mean_grey']}{kept}"
        )
        return BenchResult([text], data)


@asynccontextmanager
async def _open_bench(config: StandConfig) -> AsyncGenerator[_Bench]:
    """Locked, and safe at the end."""
    async with AsyncExitStack() as stack:
        stop = await stack.enter_async_context(Stop())
        assembly = await stack.enter_async_context(open_bench(config, COMMAND))
        stack.push_async_callback(_make_safe, assembly, stop)
        stop.watch(assembly.stand)
        yield _Bench(assembly)


async def _make_safe(assembly: Assembly, stop: Stop) -> None:
    if unsafe := await make_safe(assembly, stop):
        raise StandTripped(f"NOT SAFE: {'; '.join(unsafe)}; look at the stand now")


def _refuse_heat() -> None:
    raise Conflict("heat needs a recording and a guard that look after it: `stand serve`, then the same command again")


def _make_readings_result(readings: Sequence[Reading]) -> BenchResult:
    lines = [
        f"{each.channel:<28}{each.value:>12.5g} {'' if each.unit == '1' else each.unit:<6}{each.quality.name.lower()}"
        f"{f': {each.reason}' if each.reason else ''}"
        for each in readings
    ]
    return BenchResult(lines or ["it reads nothing"], [asdict(each) for each in readings])


async def _read_registers(assembly: Assembly, name: str) -> BenchResult:
    """Every point of the unit's register map, read one by one; what cannot be read says why."""
    _, kind, settings = next(each for each in assembly.equipment if each.name == name)
    if not isinstance(settings, OnBus):
        raise ConfigError(f"{name} has no registers; the units on the bus have")
    found = load_unit_map(kind.section, settings)
    unit = ModbusUnit(name, assembly.bus, found)
    lines: list[str] = []
    data: dict[str, object] = {}
    for point_name, point in found.points.items():
        where = f"{point_name:<18}{point.space:<9}{point.address:#06x}"
        remark = f"   unverified: {point.unverified}" if point.unverified else ""
        try:
            sample = (await unit.snapshot([point_name])).samples[point_name]
        except DeviceError as error:
            lines.append(f"{where}  not read: {error.text}{remark}")
            data[point_name] = None
            continue
        shown = sample.reason or f"{sample.value:g}{'' if point.unit == '1' else f' {point.unit}'}"
        lines.append(f"{where}  {sample.raw:#06x}  {shown}{remark}")
        data[point_name] = {"raw": sample.raw, "value": None if math.isnan(sample.value) else sample.value}
    return BenchResult(lines, data)
