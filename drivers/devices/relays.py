"""Relay board: on, off, and "on for a time", which is what a dead-man is made of."""

from __future__ import annotations

import asyncio
from collections.abc import Iterable, Iterator, Mapping
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from thermostand.drivers.devices.device_check import DeviceCheck
from thermostand.drivers.devices.kinds import Absence, DeviceKind, DriverContext, MapOf, OfSection
from thermostand.drivers.settings import Identity, OnBus, PollPeriod_s
from thermostand.drivers.wires.bus import Bus
from thermostand.drivers.wires.modbus_unit import ModbusUnit
from thermostand.drivers.wires.registers import Point, RegisterMap
from thermostand.foundation.clock import Clock, to_ns
from thermostand.foundation.errors import ConfigError, DeviceError, DeviceFault, Refused, Unreachable
from thermostand.foundation.readings import Channel, Reading

COIL_ON = 0xFF00
COIL_OFF = 0x0000
MAX_PULSE_COUNTS = 0x7FFF
HEATER_ENABLE, COMPRESSOR = "heater_enable", "compressor"
CAMERA_POWER = "camera_power"  # stays on by default: a warm camera is hours of work, and harmless
HEAT = "heat"  # the output of a software regulator, in pulses


WATCHED = (HEATER_ENABLE, COMPRESSOR, HEAT)  # must be off without permission

RelayName = Literal["heater_enable", "compressor", "camera_power", "heat"]


class RelaysSettings(OnBus):
    """The relay board: which relay does what (0 is the first); camera_power is that of all cameras, heat the output of
    a software regulator. Without compressor nothing cools. self_test_s: of the timed-on with which the board's timer is
    tested, once at the start of each run; the test takes 2.2 times as long."""

    channels: dict[RelayName, Annotated[int, Field(ge=0, le=31)]]
    poll_s: PollPeriod_s = 5.0
    self_test_s: float = Field(default=3.0, ge=0.6, le=10)

    @model_validator(mode="after")
    def _complete(self) -> Self:
        if "heater_enable" not in self.channels:
            raise ValueError("channels lacks heater_enable")
        if len(set(self.channels.values())) < len(self.channels):
            raise ValueError("two channels share one relay")
        return self


class Relays:
    """Named relays of one board. `channels`: name -> relay number, 0 being the first (point relay_0 of the map)."""

    has_timer = True

    def __init__(self, name: str, bus: Bus, register_map: RegisterMap, channels: Mapping[str, int]) -> None:
        self.name = name
        self._unit = ModbusUnit(name, bus, register_map)
        self._points = {channel: f"relay_{number}" for channel, number in channels.items()}
        self._safe_off = tuple(channel for channel in channels if channel != CAMERA_POWER)
        self._clock = bus.clock
        self._lock = asyncio.Lock()  # a write and its read-back stay together
        self._probe_due = True
        for channel, point in self._points.items():
            if point not in register_map.points:
                raise ConfigError(f"{name}.{channel}: register map {register_map.model} has no {point}")
            if channel != CAMERA_POWER and register_map.points[point].pulse is None:
                raise ConfigError(
                    f"{name}.{channel}: register map {register_map.model} knows no timed-on of {point}, without "
                    "which nothing drops the heat when this computer dies; take a board with one"
                )

    @property
    def identity(self) -> Identity | None:
        """The board that has answered; None before `open`."""
        return self._unit.identity

    async def open(self) -> None:
        """See that the board answers, and which it is; no relay changes."""
        await self._read_same_board()

    async def close(self) -> None:
        """Do nothing. Relays stay as they are (a timed one drops by itself)."""

    async def read(self) -> tuple[Reading, ...]:
        """Every named relay as the board reports it, 1 on, 0 off; raises DeviceError, also when another board than
        before answers."""
        states = await self._read_same_board()
        now_ns = self._clock.now_ns()
        return tuple(Reading(f"{self.name}.{channel}", float(on), "1", now_ns) for channel, on in states.items())

    async def switch(self, channel: str, on: bool) -> None:
        """Turn a relay on or off and read it back; Refused when the board reports otherwise."""
        await self._write(channel, self._point(channel).address, COIL_ON if on else COIL_OFF, on)

    async def hold_on(self, channel: str, duration_s: float) -> None:
        """Turn a relay on for `duration_s` from now, after which the board itself drops it; read back."""
        pulse = self._point(channel).pulse
        if pulse is None:
            raise ConfigError(f"{self.name}.{channel}: register map {self._unit.map.model} knows no timed-on")
        counts = round(duration_s / pulse.step_s)
        if not 1 <= counts <= MAX_PULSE_COUNTS:
            raise ValueError(f"{duration_s} s is not 1..{MAX_PULSE_COUNTS} x {pulse.step_s} s")
        await self._write(channel, pulse.address, counts, True)

    async def make_safe(self) -> None:
        """Turn off every relay but the cameras', confirmed. All are tried, those not confirmed once more, then
        DeviceFault names those that still are not."""
        failures = await self._turn_off(self._safe_off)
        if failures:
            failures = await self._turn_off(failures)
        if failures:
            raise DeviceFault(self.name, f"not confirmed off: {'; '.join(failures.values())}")

    async def _turn_off(self, channels: Iterable[str]) -> dict[str, str]:
        """Channel -> why it is not confirmed off."""
        failures: dict[str, str] = {}
        for channel in channels:
            try:
                await self.switch(channel, False)
            except DeviceError as error:
                failures[channel] = f"{channel} ({error})"
        return failures

    async def _write(self, channel: str, address: int, raw_value: int, on: bool) -> None:
        async def send() -> None:
            await self._unit.write_coil(address, raw_value)

        async def holds() -> bool:
            return (await self._read_states())[channel] == on

        async with self._lock:
            if on:  # off is never withheld, even from a unit of another identity
                await self._read_same_board()
            await self._unit.send_and_check(send, holds, f"{channel} {'on' if on else 'off'}")

    async def _read_same_board(self) -> dict[str, bool]:
        """The states of a board that is the one of before."""
        if self._probe_due:
            await self._unit.probe()
            self._probe_due = False
        return await self._read_states()

    async def _read_states(self) -> dict[str, bool]:
        try:
            snapshot = await self._unit.snapshot(self._points.values())
        except Unreachable:
            self._probe_due = True  # another board may stand there when something answers again
            raise
        return {channel: snapshot.bits[point] for channel, point in self._points.items()}

    def _point(self, channel: str) -> Point:
        if channel not in self._points:
            raise ValueError(f"{self.name} has no relay {channel}")
        return self._unit.map.points[self._points[channel]]


class NoRelays:
    """Stands in place of a relay board: the climate chamber enables heat and cold by itself, the cameras always have
    power.

    A permission to heat is remembered for as long as it was given, so that the guard's rules compare the chamber with
    it; no wire follows it. camera_power always reads on."""

    has_timer = False
    identity = None

    def __init__(self, name: str, clock: Clock) -> None:
        self.name = name
        self._clock = clock
        self._until_ns: dict[str, int | None] = {}  # None: for good

    async def open(self) -> None:
        """Do nothing: there is no device to connect to."""

    async def close(self) -> None:
        """Do nothing: it holds no line."""

    async def read(self) -> tuple[Reading, ...]:
        """heater_enable, compressor, camera_power; 1 on, 0 off."""
        now_ns = self._clock.now_ns()
        # As a board would read, so that rules, keeper and runs have one path for a climate chamber, too.
        states = {HEATER_ENABLE: self._is_on(HEATER_ENABLE), COMPRESSOR: self._is_on(COMPRESSOR), CAMERA_POWER: True}
        return tuple(Reading(f"{self.name}.{channel}", float(on), "1", now_ns) for channel, on in states.items())

    async def switch(self, channel: str, on: bool) -> None:
        """Remember it; Refused for a camera that is to be switched off."""
        if channel == CAMERA_POWER and not on:
            raise Refused(self.name, "no relay switches the cameras: this stand has no relay board")
        if on:
            self._until_ns[channel] = None
        else:
            self._until_ns.pop(channel, None)

    async def hold_on(self, channel: str, duration_s: float) -> None:
        """Remember it for `duration_s` from now."""
        self._until_ns[channel] = self._clock.now_ns() + to_ns(duration_s)

    async def make_safe(self) -> None:
        """Withdraw every permission."""
        self._until_ns.clear()

    def _is_on(self, channel: str) -> bool:
        until_ns = self._until_ns.get(channel, 0)
        return until_ns is None or self._clock.now_ns() < until_ns


def _make(name: str, settings: RelaysSettings, around: DriverContext) -> Relays:
    channels = {str(channel): number for channel, number in settings.channels.items()}
    return Relays(name, around.bus, around.map_of("relays", settings), channels)


async def _check(look: DeviceCheck) -> None:
    """Check the board's points, and that nothing is on that should not be."""
    if look.settings is None:
        look.opened.add(look.name)
        text = "no relay board: nothing of this stand's own drops the heat"
        look.found("link", "ok", text, data={"has_timer": False})
        return
    readings = await look.open_and_read()
    await look.check_points()
    for channel in WATCHED:
        if readings.get(channel) == 1:
            text = f"{channel} is on, though no program has this stand"
            look.warn(text, "switch it off at the board, or with `stand check --moves`")


def _channels(settings: RelaysSettings | None, of_section: OfSection, map_of: MapOf) -> Iterator[Channel]:
    """Each relay; without a board those that are remembered in its place."""
    names = (HEATER_ENABLE, COMPRESSOR, CAMERA_POWER) if settings is None else settings.channels
    return (Channel(str(name), "1", "flag") for name in names)


KIND = DeviceKind(
    name="relays",
    settings=RelaysSettings,
    make=_make,
    channels=_channels,
    section="relays",
    device="relays",
    rank=10,
    address_key="",
    simulated_map="waveshare-relay",
    stand_in=NoRelays,
    stand_in_s=5.0,
    missing=Absence("relay board", "nothing of the stand's own ends the heat, and cameras stay on"),
    check=_check,
)
