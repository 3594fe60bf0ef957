"""Each device by itself: does it answer, which one is it, does it take its settings, what does it read? Nothing moves.

A device is opened as a run opens it: a regulator gets its start-up commands, a camera its settings; neither heats.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterable
from dataclasses import asdict, is_dataclass
from typing import Any, cast

from thermostand.drivers.devices.protocols import Camera, Controller, Device, Sensor
from thermostand.drivers.devices.regulators.software_regulator import SoftwareRegulatorSettings
from thermostand.drivers.devices.relays import CAMERA_POWER, HEAT
from thermostand.drivers.settings import OnBus
from thermostand.foundation.errors import DeviceError, StandError, Unreachable
from thermostand.foundation.readings import Quality, Reading
from thermostand.stand.assembly import Assembly, register_map
from thermostand.stand.chamber.permits import WATCHED
from thermostand.stand.commissioning import advice
from thermostand.stand.commissioning.camera_line_check import packet_finding
from thermostand.stand.commissioning.finding import Add, Finding
from thermostand.stand.commissioning.imager import imager_finding
from thermostand.stand.commissioning.thermometer_comparison import each_other
from thermostand.stand.commissioning.unverified_points import unverified_points

_SHOWN = 6  # readings of one device in a line


class Links:
    """The devices of a stand, opened one after the other; what fails is a finding and keeps none of the others. opened:
    the names of those that answer."""

    def __init__(self, assembly: Assembly, add: Add) -> None:
        self.opened: set[str] = set()
        self._assembly = assembly
        self._add = add
        self._is_bus_up = False

    async def bus(self) -> None:
        """The line that regulator, relays and thermometers share."""
        bus = self._assembly.bus
        try:
            await bus.open()
        except DeviceError as error:
            is_simulated = self._assembly.config.simulation is not None
            self._add(Finding("bus", "link", "failed", error.text, advice.for_bus(error, is_simulated=is_simulated)))
            return
        self._is_bus_up = True
        self._add(Finding("bus", "link", "ok", f"{bus.address} is open"))

    async def regulator(self) -> None:
        """What holds the chamber's temperature."""
        assembly, regulator = self._assembly, self._assembly.devices.regulator
        unit, settings = assembly.config.regulator_unit, assembly.config.regulator
        if isinstance(settings, SoftwareRegulatorSettings):
            self.opened.add(regulator.name)
            by = f"relays.{HEAT}" if assembly.config.heat_module is None else "heat_module"
            text = f"this program itself: it measures thermometers.{settings.thermometer} and heats by {by}"
            self._add(Finding(regulator.name, "link", "ok", text, data=settings.model_dump(mode="json")))
            return
        if unit is None:
            readings = await self._device(regulator, advice.for_chamber)
        else:
            readings = await self._unit(regulator, unit)
            await self._points(regulator.name, "regulator", unit)
        if regulator.name in self.opened:
            await self._in_force(regulator)
        if readings.get(f"{regulator.name}.running") == 1:
            self._warn(
                regulator.name, "it controls, though no program has this stand", "stop it, unless you want it so"
            )

    async def _in_force(self, regulator: Controller) -> None:
        """Whether what is written to it is what it goes to, and how that is known."""
        try:
            found = await regulator.in_force()
        except DeviceError as error:
            self._add(Finding(regulator.name, "in force", "failed", error.text, "look at the unit"))
            return
        data, known = asdict(found), f"known by: {found.known_by}" if found.known_by else "not known: nothing tells it"
        if found.objections:
            text = f"its set-point is not in force: {'; '.join(found.objections)}"
            self._add(Finding(regulator.name, "in force", "failed", text, "nothing is heated until it is", data))
        elif found.not_told:
            self._add(
                Finding(regulator.name, "in force", "unverified", known, f"it does not tell {found.not_told}", data)
            )
        else:
            self._add(Finding(regulator.name, "in force", "ok", known, data=data))

    async def thermometers(self) -> None:
        """The module, each thermometer, and all of them against each other."""
        assembly, devices = self._assembly, self._assembly.devices
        config = assembly.config
        if await self._unit(devices.thermometers, config.thermometer_module):
            used = [f"value_{each.channel}" for each in config.thermometers.values()]
            await self._points(devices.thermometers.name, "thermometer_module", config.thermometer_module, used)
            pv = devices.regulator if devices.regulator.name in self.opened else None
            self._add(await each_other(devices.thermometers, pv, config.guard.sensors.warn_K, assembly.clock))

    async def relays(self) -> None:
        """The relay board, where there is one."""
        assembly, relays = self._assembly, self._assembly.devices.relays
        unit = assembly.config.relays
        if unit is None:
            self.opened.add(relays.name)
            text = "no relay board: nothing of this stand's own drops the heat"
            self._add(Finding(relays.name, "link", "ok", text, data={"has_timer": False}))
            return
        readings = await self._unit(relays, unit)
        await self._points(relays.name, "relays", unit)
        for channel in WATCHED:
            if readings.get(f"{relays.name}.{channel}") == 1:
                text = f"{channel} is on, though no program has this stand"
                self._warn(relays.name, text, "switch it off at the board, or with `stand check --moves`")

    async def heat_module(self) -> None:
        """The analog output that a regulator of ours heats by, where there is one; which opens it as a run does."""
        assembly = self._assembly
        module, unit = assembly.devices.heat_module, assembly.config.heat_module
        if module is None or unit is None:
            return
        await self._unit(module, unit)
        used = [f"{each}_{unit.channel}" for each in ("output", "present", "safe", "power_on", "type_code")]
        watchdog = ("watchdog_mode", "watchdog_on", "watchdog_s", "tripped", "data_format")
        await self._points(module.name, module.name, unit, (*used, *watchdog))

    async def inputs(self) -> None:
        """The contacts, where there are any."""
        assembly = self._assembly
        inputs, config = assembly.devices.inputs, assembly.config.inputs
        if inputs is None or config is None:
            return
        readings = await self._unit(inputs, config)
        for name, contact in config.contacts.items():
            closed = readings.get(f"{inputs.name}.{name}")
            if closed is not None and (closed == 1) == (contact.fault_when == "closed"):
                state = "closed" if closed == 1 else "open"
                text = f"{name} is {state}, which means {contact.means or 'a fault'}"
                self._warn(inputs.name, text, "is it so now? else exchange fault_when, or look at its wire")

    async def probe(self, name: str) -> None:
        """An instrument with a line of its own."""
        await self._device(self._assembly.devices.probes[name], lambda error: advice.for_probe(error, name))

    async def imager(self) -> None:
        """The folder of its pictures, where there is one."""
        if (settings := self._assembly.config.imager) is not None:
            self._add(await asyncio.to_thread(imager_finding, settings))

    async def flap(self) -> None:
        """Its controller, and where it stands."""
        if self._assembly.config.flap is None:
            text = "no flap: cameras see the target all the time"
            self._add(Finding(self._assembly.devices.flap.name, "link", "ok", text))
            return
        await self._device(self._assembly.devices.flap, advice.for_flap)

    async def axis(self, name: str) -> None:
        """A stage."""
        await self._device(self._assembly.devices.axes[name], lambda error: advice.for_axis(error, name))

    async def camera(self, name: str, *, is_switched_on_later: bool) -> None:
        """A camera; one without supply is left alone, and that is reported unless it gets it later."""
        assembly, camera = self._assembly, self._assembly.devices.cameras[name]
        if not await self._has_supply():
            if is_switched_on_later:
                return
            text = "its supply is off, so it was not asked"
            self._add(Finding(name, "link", "unverified", text, "`stand check --moves` switches it on"))
            return
        address = assembly.config.cameras[name].address
        is_known = assembly.devices.relays.name in self.opened

        def advise(error: DeviceError) -> str:
            return (
                advice.for_camera(error, name, address) if is_known else "mend the relays first: its supply may be off"
            )

        await self._device(camera, advise)
        if name in self.opened:
            await self.camera_settings(camera)

    async def camera_settings(self, camera: Camera) -> None:
        """What the camera made of its settings, and where it shows its temperature."""
        effective = cast("Any", getattr(camera, "effective", None))
        data: dict[str, object] = asdict(cast("Any", effective)) if is_dataclass(effective) else {}
        size = f"{data['width_px']} x {data['height_px']} {data['pixel_format']}, " if "width_px" in data else ""
        data["temperature_place"] = await camera.temperature_place()
        self._add(Finding(camera.name, "settings", "ok", f"{size}settings taken over and read back", data=data))
        packet_size = data.get("packet_size")
        if isinstance(packet_size, int) and packet_size:  # a USB3 camera has none
            self._add(packet_finding(camera.name, camera.settings.address, packet_size))

    async def _has_supply(self) -> bool:
        """As far as the relays tell."""
        relays = self._assembly.devices.relays
        if relays.name not in self.opened:
            return True
        try:
            readings = await relays.read()
        except DeviceError:
            return True
        return all(reading.value == 1 for reading in readings if reading.channel == f"{relays.name}.{CAMERA_POWER}")

    async def _unit(self, device: Sensor, unit: OnBus) -> dict[str, float]:
        if not self._is_bus_up:
            self._add(Finding(device.name, "link", "failed", "not asked, since the bus is not open", "see bus"))
            return {}
        return await self._device(device, lambda error: advice.for_unit(error, unit, self._assembly.config))

    async def _device(self, device: Sensor, advise: Callable[[DeviceError], str]) -> dict[str, float]:
        """Open, identity, a reading; the values by channel."""
        try:
            await device.open()
            self.opened.add(device.name)
            self._add(identity_finding(device))
            readings = await device.read()
        except DeviceError as error:
            what = "reading" if device.name in self.opened else _what(error)
            self.opened.discard(device.name)
            self._add(Finding(device.name, what, "failed", error.text, advise(error)))
            return {}
        for finding in _of_readings(device.name, readings):
            self._add(finding)
        return {reading.channel: reading.value for reading in readings}

    async def _points(self, device: str, key: str, unit: OnBus, used: Iterable[str] | None = None) -> None:
        if device in self.opened:
            for finding in await unverified_points(device, self._assembly.bus, register_map(key, unit), used):
                self._add(finding)

    def _warn(self, device: str, text: str, advice: str) -> None:
        self._add(Finding(device, "state", "warning", text, advice))


def _what(error: StandError) -> str:
    """Of a device that was not opened: one that answers is another one, or is set otherwise."""
    return "link" if isinstance(error, Unreachable) else "identity"


def identity_finding(device: Device) -> Finding:
    """What a device that answers tells of itself, and what it does not."""
    identity = device.identity
    if identity is None:
        return Finding(device.name, "identity", "ok", "answers; it does not tell what it is")
    text = str(identity) if identity.serial_number else f"{identity}; it tells no serial number"
    return Finding(device.name, "identity", "ok", text, data=asdict(identity))


def _of_readings(device: str, readings: Iterable[Reading]) -> Iterable[Finding]:
    """One for all that is well, and one for each that is not."""
    shown = [each for each in readings if not each.channel.endswith("_raw")]
    if any(each.channel == f"{device}.homed" and each.value == 0 for each in shown):
        yield Finding(device, "reading", "ok", "not homed yet, a run homes it first", data={"homed": 0})
        shown = [each for each in shown if each.channel != f"{device}.position" or each.cause]
        shown = [each for each in shown if each.quality is not Quality.GOOD]
    good = [each for each in shown if each.quality is Quality.GOOD]
    if good:
        data: dict[str, object] = {each.channel: each.value for each in good}
        texts = [_shown(each) for each in good[:_SHOWN]] + ([f"{len(good) - _SHOWN} more"] if good[_SHOWN:] else [])
        yield Finding(device, "reading", "ok", ", ".join(texts), data=data)
    for each in shown:
        name = each.channel.partition(".")[2]
        if each.quality is Quality.BAD:
            text = f"{name} reads nothing: {each.reason}"
            yield Finding(device, "reading", "failed", text, "look at the sensor, its wires and its channel")
        elif each.quality is Quality.STALE:
            yield Finding(device, "reading", "warning", f"{name} {each.value:.4g} {each.unit}: {each.reason}")
        elif each.reason:
            yield Finding(device, "state", "warning", f"{name}: {each.reason}", "look at the unit")


def _shown(reading: Reading) -> str:
    name = reading.channel.partition(".")[2]
    return f"{name} {reading.value:.4g}{'' if reading.unit == '1' else f' {reading.unit}'}"
