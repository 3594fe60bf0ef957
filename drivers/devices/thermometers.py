"""Contact thermometers: Pt100 sensors on one multi-channel module, each with its own calibration."""

from __future__ import annotations

import statistics
from collections.abc import Iterator, Mapping, Sequence
from datetime import date
from typing import Annotated, Literal, get_args

from pydantic import Field

from thermostand.drivers.devices.device_check import DeviceCheck, Finding
from thermostand.drivers.devices.kinds import DeviceKind, DriverContext, MapOf, OfSection
from thermostand.drivers.devices.protocols import Sensor
from thermostand.drivers.settings import Identity, Line, OnBus, Range
from thermostand.drivers.wires.bus import Bus
from thermostand.drivers.wires.modbus_unit import ModbusUnit, Sample
from thermostand.drivers.wires.registers import RegisterMap
from thermostand.foundation.clock import Clock, to_ns
from thermostand.foundation.documents import Document
from thermostand.foundation.errors import ConfigError, DeviceError, Unreachable
from thermostand.foundation.readings import Channel, Quality, Reading, bad_reading

PLAUSIBLE_DEGC = (-40.0, 100.0)  # wider than the stand's set-points, so that a broken wire is outside

Role = Literal["air", "granite_inside", "granite_outside", "artifact", "laboratory", "safety"]
PLACES: tuple[Role, ...] = get_args(Role)[:-1]


class Calibration(Document):
    """The calibration of one sensor against a certificate.

    T = t + offset_K + sum_k polynomial[k] * t**k, where t is what the instrument says, in degC. A calibrated value
    outside plausible_degC is no measurement. certificate: its number, and when (calibrated) it was made; uncertainty_K:
    the expanded one (k = 2) that it states. All three are recorded with every session and stand in its reports.
    """

    offset_K: float = Field(default=0.0, ge=-10, le=10)  # a Pt100 that is further off is broken
    polynomial: tuple[float, ...] = Field(default=(), max_length=8)
    certificate: Line = ""
    calibrated: date | None = None
    uncertainty_K: float | None = Field(default=None, gt=0, le=5)
    plausible_degC: Range = PLAUSIBLE_DEGC

    def calibrated_degC(self, indicated_degC: float) -> float:
        """The temperature for an indication."""
        correction_K = 0.0
        for coefficient in reversed(self.polynomial):  # Horner
            correction_K = correction_K * indicated_degC + coefficient
        return indicated_degC + self.offset_K + correction_K

    def reading(self, channel: str, indicated_degC: float, now_ns: int, suspicion: str = "") -> Reading:
        """The reading of an indication: BAD outside plausible_degC, STALE when there is a suspicion."""
        T_degC, (low_degC, high_degC) = self.calibrated_degC(indicated_degC), self.plausible_degC
        if not low_degC <= T_degC <= high_degC:
            return bad_reading(channel, "degC", now_ns, f"{T_degC:g} degC is outside {low_degC:g}..{high_degC:g} degC")
        return Reading(channel, T_degC, "degC", now_ns, Quality.STALE if suspicion else Quality.GOOD, suspicion)


class ThermometerSettings(Calibration):
    """One sensor; channel: its terminal, 0 is the first of the first module, and counted on through further ones.

    role: where it is, which rules, reports and recordings ask for: a place is read and recorded as that, whatever the
    sensor's own name; by default the place it is named after, if any. safety: any number of them, each under its own
    name, that guard the heat in addition to the air's.
    """

    channel: int = Field(ge=0, le=63)
    role: Role | None = None

    @property
    def is_safety(self) -> bool:
        """Whether it guards the heat."""
        return self.role == "safety"


def list_by_channel(thermometers: Mapping[str, ThermometerSettings]) -> dict[str, ThermometerSettings]:
    """The sensors by what they are read as: their place, or their own names."""
    # By role, which models, reports and other programs look for in every session; its own name is in the stand's file.
    return {name if each.role is None or each.is_safety else each.role: each for name, each in thermometers.items()}


class ThermometerModuleSettings(OnBus):
    """The RTD module. further_units: the numbers on the bus of more of the same kind, whose channels are counted on:
    with six channels a module, 6 is the first of the second one."""

    further_units: tuple[Annotated[int, Field(ge=1, le=247)], ...] = Field(default=(), max_length=7)

    @property
    def units(self) -> tuple[int, ...]:
        """All of them."""
        return (self.unit, *self.further_units)


class Thermometers:
    """Named sensors on one module, points value_<n> of the map; a broken one never spoils the others.

    Identity and type codes are probed before first use and after every loss. Each sensor gives two readings: `air` in
    degC, calibrated, and `air_raw`, the module's word, from which the value before calibration follows.
    """

    def __init__(
        self,
        name: str,
        bus: Bus,
        register_map: RegisterMap,
        channels: Mapping[str, ThermometerSettings],
        clock: Clock,
    ) -> None:
        self.name = name
        self._unit = ModbusUnit(name, bus, register_map)
        self._channels = dict(channels)
        self._points = {sensor: f"value_{channel.channel}" for sensor, channel in channels.items()}
        for sensor, point in self._points.items():
            if point not in register_map.points:
                raise ConfigError(f"{name}.{sensor}: register map {register_map.model} has no {point}")
        self._fault_bits = [bit for point in self._points.values() for bit in register_map.points[point].bad_if]
        self._clock = clock
        self._probe_due = True
        self.modules = (self,)

    @property
    def unit(self) -> int:
        """The module's number on the bus."""
        return self._unit.map.transport.unit

    @property
    def identity(self) -> Identity | None:
        """The module that has answered; None before `open`."""
        return self._unit.identity

    async def open(self) -> None:
        """Check identity, data format and type codes; DeviceFault when they are not the map's."""
        await self._probe()

    async def close(self) -> None:
        """Do nothing: it holds no line of its own."""

    async def read(self) -> tuple[Reading, ...]:
        """Calibrated and raw readings of every sensor; raises DeviceError when the values could not be read.

        Open or out of range: that sensor BAD. Fault bits unreadable: STALE, for the values may be of broken sensors.
        """
        try:
            if self._probe_due:
                await self._probe()
            values = await self._unit.snapshot(self._points.values())
        except Unreachable:
            self._probe_due = True  # another module may stand there when something answers again
            raise
        now_ns = self._clock.now_ns()
        unconfirmed, bits = "", dict[str, bool]()
        try:
            bits.update((await self._unit.snapshot(self._fault_bits)).bits)
        except DeviceError as error:
            self._probe_due = isinstance(error, Unreachable)
            unconfirmed = f"fault bits unreadable ({error})"
        return tuple(
            reading
            for sensor, point in self._points.items()
            for reading in self._readings(
                sensor, values.samples[point], self._describe_alarms(point, bits), unconfirmed, now_ns
            )
        )

    async def _probe(self) -> None:
        await self._unit.probe()
        self._probe_due = False

    def _describe_alarms(self, point: str, bits: Mapping[str, bool]) -> str:
        return ", ".join(bit for bit in self._unit.map.points[point].bad_if if bits.get(bit))

    def _readings(self, sensor: str, sample: Sample, alarms: str, unconfirmed: str, now_ns: int) -> Iterator[Reading]:
        channel = f"{self.name}.{sensor}"
        yield self._make_calibrated_reading(channel, self._channels[sensor], sample, alarms, unconfirmed, now_ns)
        yield Reading(f"{channel}_raw", float(sample.raw), "1", now_ns)

    def _make_calibrated_reading(
        self, channel: str, sensor: ThermometerSettings, sample: Sample, alarms: str, unconfirmed: str, now_ns: int
    ) -> Reading:
        if reason := sample.reason or alarms:
            return bad_reading(channel, "degC", now_ns, reason)
        return sensor.reading(channel, sample.value, now_ns, unconfirmed)


class ThermometerModules:
    """Thermometers on several modules under one name, of which each is polled by itself. identity: of the first."""

    def __init__(self, modules: Sequence[Thermometers]) -> None:
        self.name = modules[0].name
        self.modules = tuple(modules)

    @property
    def identity(self) -> Identity | None:
        """The module that has answered as the first; None before `open`."""
        return self.modules[0].identity

    async def open(self) -> None:
        """Open each module."""
        for module in self.modules:
            await module.open()

    async def close(self) -> None:
        """Do nothing: it holds no line of its own."""

    async def read(self) -> tuple[Reading, ...]:
        """Read all modules; DeviceError when one cannot be read."""
        return tuple([reading for module in self.modules for reading in await module.read()])


def _make(name: str, settings: ThermometerModuleSettings, around: DriverContext) -> Thermometers | ThermometerModules:
    """Each sensor on the module that has its channel."""
    sensors = list_by_channel(around.of_section("thermometers"))
    first = around.map_of("thermometer_module", settings)
    count = sum(point.startswith("value_") for point in first.points)
    if not count:
        raise ConfigError(
            f"thermometer_module: register map {first.model} lacks value_0; it is of no thermometer module"
        )
    modules: list[Thermometers] = []
    for number, unit in enumerate(settings.units):
        here = {
            sensor: each.model_copy(update={"channel": each.channel - number * count})
            for sensor, each in sensors.items()
            if each.channel // count == number or (each.channel // count > number and unit == settings.units[-1])
        }
        if not here:
            raise ConfigError(f"thermometer_module: no thermometer has a channel of unit {unit}")
        modules.append(Thermometers(name, around.bus, first.at_unit(unit), here, around.clock))
    return modules[0] if len(modules) == 1 else ThermometerModules(modules)


_LOOKS, _PERIOD_S = 5, 0.3  # of stand check: some conversions of the module; not measured


async def _compare_thermometers(thermometers: Sensor, regulator: Sensor | None, warn_K: float, clock: Clock) -> Finding:
    """Return how far each is from the median of all, the regulator's own value among them; a warning beyond `warn_K`.
    In a chamber that has been at rest overnight they all show the same."""
    seen: dict[str, list[float]] = {}
    try:
        for _ in range(_LOOKS):
            readings = [*await thermometers.read(), *(await regulator.read() if regulator is not None else ())]
            for reading in readings:
                device, _, name = reading.channel.partition(".")
                is_pv = device != thermometers.name
                if reading.unit == "degC" and reading.quality is Quality.GOOD and (not is_pv or name == "pv"):
                    seen.setdefault(f"{device} {name}" if is_pv else name, []).append(reading.value)
            await clock.sleep_until(clock.now_ns() + to_ns(_PERIOD_S))
    except DeviceError as error:
        return Finding(thermometers.name, "each other", "failed", error.text, "check again once it answers")
    if len(seen) < 2:
        text = "fewer than two of them read, so nothing can be compared"
        return Finding(thermometers.name, "each other", "unverified", text)
    means = {name: statistics.fmean(values) for name, values in seen.items()}
    median_degC = statistics.median(means.values())
    apart_K = {name: mean_degC - median_degC for name, mean_degC in means.items()}
    data: dict[str, object] = {
        "median_degC": round(median_degC, 3),
        "apart_K": {name: round(value, 4) for name, value in apart_K.items()},
        "noise_K": {name: round(statistics.pstdev(values), 4) for name, values in seen.items()},
    }
    farthest = max(apart_K, key=lambda name: abs(apart_K[name]))
    text = f"{farthest} is {apart_K[farthest]:+.2f} K from the median of all ({median_degC:.2f} degC)"
    if abs(apart_K[farthest]) > warn_K:
        advice = "is the chamber at rest? else are two channels exchanged, or is its offset_K wrong?"
        return Finding(thermometers.name, "each other", "warning", text, advice, data)
    return Finding(thermometers.name, "each other", "ok", text, data=data)


async def _check(look: DeviceCheck) -> None:
    """The module, each thermometer, and all of them against each other."""
    if await look.open_and_read():
        await look.check_points(f"value_{each.channel}" for each in look.of_section("thermometers").values())
        pv = look.made["regulator"] if "regulator" in look.opened else None
        look.add(await _compare_thermometers(look.device, pv, look.of_section("guard").sensors.warn_K, look.clock))


def _channels(settings: ThermometerModuleSettings, of_section: OfSection, map_of: MapOf) -> Iterator[Channel]:
    """The temperature of each sensor, and the module's word for it."""
    for name in list_by_channel(of_section("thermometers")):
        yield Channel(name, "degC", "temperature")
        yield Channel(f"{name}_raw", "1", "count")


KIND = DeviceKind(
    name="thermometers",
    settings=ThermometerModuleSettings,
    make=_make,
    channels=_channels,
    section="thermometer_module",
    device="thermometers",
    rank=30,
    address_key="",
    simulated_map="icpdas-m7015",
    check=_check,
)
