"""Contact thermometers: Pt100 sensors on one multi-channel module, each with its own calibration."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from datetime import date
from typing import Annotated, Literal, get_args

from pydantic import Field

from thermostand.drivers.settings import Identity, Line, OnBus, Range
from thermostand.drivers.wires.bus import Bus
from thermostand.drivers.wires.modbus_unit import ModbusUnit, Sample
from thermostand.drivers.wires.registers import RegisterMap
from thermostand.foundation.clock import Clock
from thermostand.foundation.documents import Document
from thermostand.foundation.errors import ConfigError, DeviceError, Unreachable
from thermostand.foundation.readings import Quality, Reading, bad_reading

PLAUSIBLE_DEGC = (-40.0, 100.0)

Role = Literal["air", "granite_inside", "granite_outside", "artifact", "laboratory", "safety"]
PLACES: tuple[Role, ...] = get_args(Role)[:-1]


class Calibration(Document):
    """Of one sensor against a certificate.

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

    def reading(self, channel: str, indicated_degC: float, now_ns: int, doubt: str = "") -> Reading:
        """Of an indication; BAD outside plausible_degC, STALE with a doubt."""
        T_degC, (low_degC, high_degC) = self.calibrated_degC(indicated_degC), self.plausible_degC
        if not low_degC <= T_degC <= high_degC:
            return bad_reading(channel, "degC", now_ns, f"{T_degC:g} degC is outside {low_degC:g}..{high_degC:g} degC")
        return Reading(channel, T_degC, "degC", now_ns, Quality.STALE if doubt else Quality.GOOD, doubt)


class ThermometerSettings(Calibration):
    """One sensor; channel: its terminal, 0 is the first of the first module, and counted on through further ones.

    role: where it is, which rules, reports and recordings ask for: a place is read and recorded as that, whatever the
    sensor's own name; by default the place it is named after, if any. safety: any number of them, each under its own
    name, that guard the heat beside the air's.
    """

    channel: int = Field(ge=0, le=63)
    role: Role | None = None

    @property
    def is_safety(self) -> bool:
        """Whether it guards the heat."""
        return self.role == "safety"


def by_channel(thermometers: Mapping[str, ThermometerSettings]) -> dict[str, ThermometerSettings]:
    """The sensors by what they are read as: their place, or their own names."""
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
    def identity(self) -> Identity | None:
        """Which module has answered; None before `open`."""
        return self._unit.identity

    async def open(self) -> None:
        """Check identity, data format and type codes; DeviceFault when they are not the map's."""
        await self._probe()

    async def close(self) -> None:
        """Nothing to let go of."""

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
            for reading in self._readings(sensor, values.samples[point], self._alarms(point, bits), unconfirmed, now_ns)
        )

    async def _probe(self) -> None:
        await self._unit.probe()
        self._probe_due = False

    def _alarms(self, point: str, bits: Mapping[str, bool]) -> str:
        return ", ".join(bit for bit in self._unit.map.points[point].bad_if if bits.get(bit))

    def _readings(self, sensor: str, sample: Sample, alarms: str, unconfirmed: str, now_ns: int) -> Iterator[Reading]:
        channel = f"{self.name}.{sensor}"
        yield self._calibrated(channel, self._channels[sensor], sample, alarms, unconfirmed, now_ns)
        yield Reading(f"{channel}_raw", float(sample.raw), "1", now_ns)

    def _calibrated(
        self, channel: str, sensor: ThermometerSettings, sample: Sample, alarms: str, unconfirmed: str, now_ns: int
    ) -> Reading:
        if reason := sample.reason or alarms:
            return bad_reading(channel, "degC", now_ns, reason)
        return sensor.reading(channel, sample.value, now_ns, unconfirmed)


class SeveralModules:
    """Thermometers on several modules under one name, of which each is polled by itself. identity: of the first."""

    def __init__(self, modules: Sequence[Thermometers]) -> None:
        self.name = modules[0].name
        self.modules = tuple(modules)

    @property
    def identity(self) -> Identity | None:
        """Which module has answered as the first; None before `open`."""
        return self.modules[0].identity

    async def open(self) -> None:
        """As of each module."""
        for module in self.modules:
            await module.open()

    async def close(self) -> None:
        """Nothing to let go of."""

    async def read(self) -> tuple[Reading, ...]:
        """Of all modules; DeviceError when one cannot be read."""
        return tuple([reading for module in self.modules for reading in await module.read()])
