"""What `stand check` finds: does a device answer, which one is it, how is it set, what does it read?

Each kind says what is looked at; what most of them have in common is here. Nothing moves.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass, field
from itertools import groupby
from typing import Any, Literal

from thermostand.drivers.devices.protocols import Controller, Device, Sensor
from thermostand.drivers.settings import OnBus
from thermostand.drivers.wires.bus import Bus
from thermostand.drivers.wires.modbus_unit import ModbusUnit, Sample
from thermostand.drivers.wires.registers import RegisterMap
from thermostand.foundation.clock import Clock
from thermostand.foundation.errors import DeviceError, GarbledReply, Refused, StandError, Unreachable
from thermostand.foundation.readings import Quality, Reading

Verdict = Literal["ok", "unverified", "warning", "failed"]
_RISING: tuple[Verdict, ...] = ("ok", "unverified", "warning", "failed")
_SHOWN = 6  # readings of one device in a line


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing that was looked at. device: its configured name, or bus, disk, clock. what: link, identity, settings,
    reading, a register point, or a move. unverified: it could not be decided from here, `advice` says how a person
    does. data: JSON-able figures, units in their names."""

    device: str
    what: str
    verdict: Verdict
    text: str
    advice: str = ""
    data: Mapping[str, object] = field(default_factory=dict[str, object])


Add = Callable[[Finding], None]


def find_worst(findings: Iterable[Finding]) -> Verdict:
    """ok when there is none."""
    found = {finding.verdict for finding in findings}
    for verdict in reversed(_RISING):
        if verdict in found:
            return verdict
    return "ok"


@dataclass(frozen=True, slots=True, kw_only=True)
class DeviceCheck:
    """A look at one device. settings: None where it is a stand-in. advise: what a person does about an error. made: all
    devices of the stand, by name; opened: the names of those that answer. of_section, map_of: as `kinds.Around` has
    them. is_powered_later: cameras without supply are looked at once they have it."""

    device: Any
    settings: Any
    section: str
    advise: Callable[[DeviceError], str]
    clock: Clock
    modbus: Bus
    is_bus_up: bool
    made: Mapping[str, Sensor]
    opened: set[str]
    of_section: Callable[[str], Any]
    map_of: Callable[[str, OnBus], RegisterMap]
    add: Add
    is_powered_later: bool = False

    @property
    def name(self) -> str:
        """The device's."""
        return self.device.name

    def found(
        self, what: str, verdict: Verdict, text: str, advice: str = "", data: Mapping[str, object] | None = None
    ) -> None:
        """One thing more of this device."""
        self.add(Finding(self.name, what, verdict, text, advice, data or {}))

    def warn(self, text: str, advice: str) -> None:
        """Add a warning about the state in which the device is."""
        self.found("state", "warning", text, advice)

    async def open_and_read(self) -> dict[str, float]:
        """Open it, as a run does; identity and a reading. The values by channel without the device's name, {} when it
        does not answer."""
        if isinstance(self.settings, OnBus) and not self.is_bus_up:
            self.found("link", "failed", "not asked, since the bus is not open", "see bus")
            return {}
        try:
            await self.device.open()
            self.opened.add(self.name)
            self.add(check_identity(self.device))
            readings: tuple[Reading, ...] = await self.device.read()
        except DeviceError as error:
            what = "reading" if self.name in self.opened else _classify_error(error)
            self.opened.discard(self.name)
            self.found(what, "failed", error.text, self._advice(error))
            return {}
        for finding in _check_readings(self.name, readings):
            self.add(finding)
        return {reading.channel.partition(".")[2]: reading.value for reading in readings}

    async def check_points(self, used: Iterable[str] | None = None) -> None:
        """Check a unit on the bus that answers: the points of its register map that were never seen on a unit; those of
        `used` only, when given."""
        if self.name in self.opened:
            for finding in await check_unverified_points(
                self.name, self.modbus, self.map_of(self.section, self.settings), used
            ):
                self.add(finding)

    def _advice(self, error: DeviceError) -> str:
        """Return what to look at; for a unit on the bus it is the line that matters most."""
        if not isinstance(self.settings, OnBus):
            return self.advise(error)
        bus, unit = self.of_section("bus"), self.settings
        line = f"{bus.baud} baud, parity {bus.parity}, {bus.stopbits} stop bit{'s' * (bus.stopbits - 1)}"
        gateway = "; does the gateway speak Modbus TCP, not RTU over TCP?" if bus.address.startswith("tcp:") else ""
        if isinstance(error, GarbledReply):
            text = f"is the unit set to {line}, is the line terminated, and does no other unit have the number"
            return f"{text} {unit.unit}?{gateway}"
        if isinstance(error, Unreachable):
            text = f"is it powered, its number {unit.unit} and its line {line}, and are A and B the right way round?"
            return f"{text}{gateway}"
        return f"set the unit as its register map {unit.registers} says, or take the map of the unit that is there"


async def check_answers(look: DeviceCheck) -> None:
    """Check what most devices have in common."""
    await look.open_and_read()


async def check_controller(look: DeviceCheck) -> None:
    """Check what holds the chamber's temperature: whether what is written to it is what it goes to, and how that is
    known; and that nothing controls now."""
    readings = await look.open_and_read()
    if isinstance(look.settings, OnBus):
        await look.check_points()
    if look.name in look.opened:
        await _check_in_force(look, look.device)
    if readings.get("running") == 1:
        look.warn("it controls, though no program has this stand", "stop it, unless you want it so")


async def _check_in_force(look: DeviceCheck, controller: Controller) -> None:
    try:
        found = await controller.in_force()
    except DeviceError as error:
        look.found("in force", "failed", error.text, "look at the unit")
        return
    data, known = asdict(found), f"known by: {found.known_by}" if found.known_by else "not known: nothing reports it"
    if found.objections:
        text = f"its set-point is not in force: {'; '.join(found.objections)}"
        look.found("in force", "failed", text, "nothing is heated until it is", data)
    elif found.not_reported:
        look.found("in force", "unverified", known, f"it does not tell {found.not_reported}", data)
    else:
        look.found("in force", "ok", known, data=data)


def _classify_error(error: StandError) -> str:
    """Classify the error of a device that was not opened: one that answers is another one, or is set otherwise."""
    return "link" if isinstance(error, Unreachable) else "identity"


def check_identity(device: Device) -> Finding:
    """Return what a device that answers reports of itself, and what it does not."""
    identity = device.identity
    if identity is None:
        return Finding(device.name, "identity", "ok", "answers; it does not tell what it is")
    text = str(identity) if identity.serial_number else f"{identity}; it reports no serial number"
    return Finding(device.name, "identity", "ok", text, data=asdict(identity))


def _check_readings(device: str, readings: Iterable[Reading]) -> Iterable[Finding]:
    """One for all that is well, and one for each that is not."""
    shown = [each for each in readings if not each.channel.endswith("_raw")]
    if any(each.channel == f"{device}.homed" and each.value == 0 for each in shown):
        yield Finding(device, "reading", "ok", "not homed yet, a run homes it first", data={"homed": 0})
        shown = [each for each in shown if each.channel != f"{device}.position" or each.cause]
        shown = [each for each in shown if each.quality is not Quality.GOOD]
    good = [each for each in shown if each.quality is Quality.GOOD]
    if good:
        data: dict[str, object] = {each.channel: each.value for each in good}
        texts = [_format_reading(each) for each in good[:_SHOWN]] + (
            [f"{len(good) - _SHOWN} more"] if good[_SHOWN:] else []
        )
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


def _format_reading(reading: Reading) -> str:
    name = reading.channel.partition(".")[2]
    return f"{name} {reading.value:.4g}{'' if reading.unit == '1' else f' {reading.unit}'}"


async def check_unverified_points(
    device: str, bus: Bus, register_map: RegisterMap, used: Iterable[str] | None = None
) -> tuple[Finding, ...]:
    """A finding for each remark `unverified` of the map, with what its points read; of the points `used` only, when
    given. A point that has an expected value is decided by it."""
    unit, points = ModbusUnit(device, bus, register_map), register_map.points
    wanted = set(points) if used is None else {*used, *(field.point for field in register_map.identity.values())}
    names = [name for name, point in points.items() if point.unverified and name in wanted]
    found: list[Finding] = []

    def remark_of(name: str) -> str:
        return points[name].unverified

    for remark, group in groupby(sorted(names, key=remark_of), remark_of):
        found.append(await _check_points(unit, tuple(group), remark))
    return tuple(found)


async def _check_points(unit: ModbusUnit, names: tuple[str, ...], remark: str) -> Finding:
    what = f"point{'' if len(names) == 1 else 's'} {', '.join(names)}"
    shown, data = list[str](), dict[str, object]()
    for name in names:
        point = unit.map.points[name]
        try:
            sample = (await unit.snapshot([name])).samples[name]
        except DeviceError as error:
            known = "has no such point" if isinstance(error, Refused) else "does not answer for it"
            advice = (
                f"correct {name} in the map {unit.map.model}, or take it out; it was never seen on a unit: {remark}"
            )
            text = f"the unit {known} ({point.space} {point.address:#06x}): {error.text}"
            is_needed = name not in {field.point for field in unit.map.identity.values()}
            verdict: Verdict = "failed" if is_needed else "warning"
            return Finding(unit.name, what, verdict, text, advice, data)
        data[name] = sample.raw
        shown.append(_format_point(unit.map, name, sample))
        expected = next((probe.expect for probe in unit.map.probe if probe.point == name), None)
        if expected is not None and sample.value == expected:
            text = f"{name} reads {shown[-1]}, as its map expects"
            return Finding(unit.name, what, "ok", text, data=data)
    text = f"reads {', '.join(shown)}"
    advice = f"never seen on a unit: {remark}; when it is right, take `unverified` out of the register map"
    return Finding(unit.name, what, "unverified", text, advice, data)


def _format_point(register_map: RegisterMap, name: str, sample: Sample) -> str:
    if sample.reason:
        return sample.reason
    if any(field.point == name and field.shown == "hex" for field in register_map.identity.values()):
        return f"{sample.raw:#x}"
    unit = register_map.points[name].unit
    return f"{sample.value:.4g}{'' if unit == '1' else f' {unit}'}"
