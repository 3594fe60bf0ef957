"""Heat through an analog output: a current of 4..20 mA into a power controller, from a module with a host watchdog.

The module itself ends the heat when this program does: not written to for watchdog_s, it gives its safe value. So while
it heats nothing but the law writes to it or reads it: what goes on asking must not keep alive what has died.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from typing import NoReturn, Self

from pydantic import Field, model_validator

from thermostand.drivers.devices.device_check import DeviceCheck
from thermostand.drivers.devices.exclusive import Exclusive
from thermostand.drivers.devices.kinds import DeviceKind, DriverContext
from thermostand.drivers.devices.relays import COIL_OFF, COIL_ON
from thermostand.drivers.settings import Identity, OnBus
from thermostand.drivers.wires.modbus_unit import ModbusUnit
from thermostand.foundation.clock import NS_PER_S, Clock, to_ns
from thermostand.foundation.errors import ConfigError, DeviceError, DeviceFault, Refused, Unreachable
from thermostand.foundation.readings import Channel, Quality, Reading

# 0.6 % of the heat; one that reads back otherwise twice heats by a law of its own, and loses the relay in series.
_TOLERANCE_mA = 0.1  # of what reads back: the modules are good to 0.02 mA
_TOLERANCE_s = 0.05  # of its watchdog's time, which it keeps in tenths
_CHECKED_EVERY_S = 10.0  # that it would still end the heat by itself
# Whether a plain request keeps a module's watchdog alive is nowhere documented, so each run tests it.
_TESTED = 1.5  # watchdog_s, for which it is left alone, and then written to
_WATCHDOG, _TRIPPED, _TIME = "watchdog_on", "tripped", "watchdog_s"


class HeatModuleSettings(OnBus):
    """The module's output `channel`, 0 is the first: zero_mA no heat, full_mA all of it. safe_mA: what it must give
    when its watchdog has tripped, and after power-up; by default zero_mA. watchdog_s: how long it may be left alone."""

    channel: int = Field(default=0, ge=0, le=7)
    zero_mA: float = Field(default=4.0, ge=0, le=20)
    full_mA: float = Field(default=20.0, gt=0, le=20)
    safe_mA: float | None = Field(default=None, ge=0, le=20)
    watchdog_s: float = Field(default=5.0, ge=1, le=25.5)

    @model_validator(mode="after")
    def _safe(self) -> Self:
        if self.zero_mA >= self.full_mA:
            raise ValueError("zero_mA must be below full_mA: a power controller that heats at less current is not safe")
        if self.safe_mA is not None and self.safe_mA > self.zero_mA:
            raise ValueError("safe_mA is above zero_mA: it would heat when this computer has died")
        return self

    @property
    def tripped_mA(self) -> float:
        """What it must give when its watchdog has tripped."""
        return self.zero_mA if self.safe_mA is None else self.safe_mA


class HeatModule:
    """Points output_<n>, safe_<n>, power_on_<n>, watchdog_s and coils watchdog_on, tripped of the map; present_<n>
    (what it gives) and type_code_<n> where it has them. Not heated with before `arm`. uncontrolled: as of
    HeatOutput."""

    def __init__(self, wire: ModbusUnit, settings: HeatModuleSettings, clock: Clock) -> None:
        self.name = name = wire.name
        self._unit = wire
        self._settings = settings
        self._clock = clock
        points, place = wire.map.points, settings.channel
        self._output, self._safe, self._power_on = (f"{each}_{place}" for each in ("output", "safe", "power_on"))
        needed = (self._output, self._safe, self._power_on, _TIME, _WATCHDOG, _TRIPPED)
        if missing := [point for point in needed if point not in points]:
            raise ConfigError(
                f"{name}: register map {wire.map.model} has no {', '.join(missing)}, without which nothing ends "
                "the heat when this computer dies; take a module with a host watchdog, or a relay"
            )
        self._present = present if (present := f"present_{place}") in points else self._output
        self._type_code = type_code if (type_code := f"type_code_{place}") in points else None
        self._exclusive = Exclusive()
        self._is_safe = False  # whether its safe value has been read back
        self._armed_ns: int | None = None  # when its watchdog was last refreshed; None: it is off
        self._checked_ns = 0  # when its watchdog and safe value were last read
        self._left_mA: float | None = None  # by the last write that was confirmed
        self._trip = ""  # why it gives no heat until it is armed again
        self._differed = False  # at the last step it gave other than what it was left at
        self.uncontrolled = ""
        self._last: tuple[Reading, ...] = ()
        self._unread = ""  # why the last exchange has given no new one

    @property
    def identity(self) -> Identity | None:
        """The module that has answered; None before `open`."""
        return self._unit.identity

    async def open(self) -> None:
        """Check identity, range, and that what it gives without us is safe, which is set where it differs; DeviceFault
        when it stays otherwise. The output is not changed."""
        async with self._exclusive:
            await self._prepare()

    async def close(self) -> None:
        """Do nothing: there is nothing to release. A module that is left alone goes to its safe value."""

    async def read(self) -> tuple[Reading, ...]:
        """output (mA, what it gives), tripped; while it heats those of the law's last exchange, STALE when the law's
        next one has failed, or is overdue. DeviceError, and the output is at zero, when it gives heat though nothing
        does."""
        async with self._exclusive:
            # While it heats only the law speaks to the module: a poll would refresh the watchdog of a law that has
            # died.
            if self._armed_ns is not None and self._last:
                return self._exchange()
            await self._verify_identity()
            given_mA = await self._read_output_mA()
            if given_mA > self._settings.zero_mA + _TOLERANCE_mA:
                await self._set_zero()
                raise DeviceFault(self.name, f"gave {given_mA:.2f} mA unasked; it is at its zero again")
            return self._last

    def _exchange(self) -> tuple[Reading, ...]:
        age_s = (self._clock.now_ns() - self._last[0].time_ns) / NS_PER_S
        reason = self._unread
        if not reason and age_s > self._settings.watchdog_s:
            reason = f"the law has not asked it for {age_s:.0f} s"
        return (
            tuple(replace(each, quality=Quality.STALE, reason=reason) for each in self._last) if reason else self._last
        )

    async def arm(self) -> None:
        """Prepare it before control begins: safe values as configured, output at zero, watchdog on and not tripped, all
        read back. A trip is cleared: the program that starts control has seen it."""
        async with self._exclusive:
            self._armed_ns, self._left_mA = None, None
            await self._prepare()
            await self._unit.write(_TIME, self._settings.watchdog_s)
            await self._switch(_WATCHDOG, True)
            if await self._read_coil(_TRIPPED):
                await self._clear()
            await self._set_zero()
            if await self._read_coil(_TRIPPED):
                raise DeviceFault(self.name, "its host watchdog trips as soon as it is cleared")
            self._armed_ns = self._checked_ns = self._clock.now_ns()
            self._trip, self._differed, self.uncontrolled = "", False, ""

    async def give(self, percent: float, *, at_once: bool = False) -> None:
        """The heat from now on; at_once has no meaning here. Also refreshes the watchdog. DeviceFault when it does not
        give what it was left at, which ends with zero; or when it has tripped, somebody has changed what it does
        without us, or it is `uncontrolled`, which last until it is armed again."""
        async with self._exclusive:
            if self._armed_ns is None:
                raise DeviceFault(self.name, "gives no heat: it was not armed")
            if self._trip:
                raise DeviceFault(self.name, self._trip)
            await self._verify_identity()
            await self._compare()
            await self._check_dead_man()
            settings = self._settings
            wanted_mA = settings.zero_mA + (settings.full_mA - settings.zero_mA) * min(100.0, max(0.0, percent)) / 100
            self._left_mA = None  # until the write is confirmed
            try:
                self._left_mA = await self._unit.write(self._output, wanted_mA)
            except Refused as error:
                await self._end(f"does not take {wanted_mA:.2f} mA ({error.text})")
            self._armed_ns = self._clock.now_ns()

    async def off(self) -> None:
        """Stop all heat and confirm it; DeviceError when that fails. Its watchdog is off from then, unless it cannot be
        reached for that: then it trips, which is as safe."""
        async with self._exclusive:
            await self._set_zero()
            self.uncontrolled = ""
            with suppress(DeviceError):
                # On while nothing is given, it would trip in every idle hour.
                await self._switch(_WATCHDOG, False)
            self._armed_ns = None

    async def test_dead_man(self) -> None:
        """Test at zero output whether the watchdog trips when the module is left alone, and not while it is written to.
        DeviceFault when not: then it would heat on without us, or never for long."""
        await self.arm()
        try:
            await self._pause(_TESTED)
            if not await self._read_coil(_TRIPPED):
                text = f"its host watchdog does not trip after {_TESTED * self._settings.watchdog_s:g} s without us"
                raise DeviceFault(self.name, f"{text}; it would heat on when this computer has died")
            await self.arm()
            for _ in range(5):
                await self._pause(_TESTED / 5)
                await self.give(0.0)
        except DeviceFault as error:
            if not self._trip:
                raise
            text = "its host watchdog trips though it is written to; does it want the broadcast `~**` of DCON?"
            raise DeviceFault(self.name, text) from error
        finally:
            await self.off()

    async def _verify_identity(self) -> None:
        """Verify that it is the module that answered before, or it gets no heat; off is never withheld."""
        # Also after each loss of the line: a module that was exchanged in mid-run must not be heated with.
        if not self._exclusive.is_known:
            await self._unit.probe()
            self._exclusive.is_known = True

    async def _pause(self, share: float) -> None:
        await self._clock.sleep_until(self._clock.now_ns() + to_ns(share * self._settings.watchdog_s))

    async def _prepare(self) -> None:
        self._is_safe = False
        await self._unit.probe()
        self._exclusive.is_known = True
        if self._type_code is not None:
            sample = (await self._unit.snapshot([self._type_code])).samples[self._type_code]
            if sample.reason:
                text = f"{self._type_code} is {sample.raw:#x}, which is no range of mA; set its range at the module"
                raise DeviceFault(self.name, text)
        for point, when in ((self._safe, "when it is left alone"), (self._power_on, "after power-up")):
            await self._write_setting(point, when)
        self._is_safe = True

    async def _write_setting(self, point: str, when: str) -> None:
        """The value as configured, which is written only when it differs: it wears the module's memory."""
        wanted_mA = self._settings.tripped_mA
        if abs(await self._mA(point) - wanted_mA) <= _TOLERANCE_mA:
            return
        with suppress(Refused):
            await self._unit.write(point, wanted_mA)
        found_mA = await self._mA(point)
        if abs(found_mA - wanted_mA) > _TOLERANCE_mA:
            text = f"gives {found_mA:g} mA {when} ({point}), not {wanted_mA:g}, and does not take that"
            raise DeviceFault(self.name, f"{text}; set it at the module: it is not heated with")

    async def _compare(self) -> None:
        """Compare what it gives with what it was left at; the trip lasts."""
        age_s = (self._clock.now_ns() - (self._armed_ns or 0)) / NS_PER_S
        given_mA = await self._read_output_mA()
        if self._last[-1].value == 1:
            self._trip = (
                f"its host watchdog has tripped ({age_s:.1f} s after it was last written to): it gives {given_mA:.2f} "
                "mA until control is started again"
            )
            raise DeviceFault(self.name, self._trip)
        left_mA, differed = self._left_mA, self._differed
        self._differed = left_mA is not None and abs(given_mA - left_mA) > _TOLERANCE_mA
        if left_mA is not None and self._differed:
            text = f"gave {given_mA:.2f} mA where it was left at {left_mA:.2f} mA; does something else write to it"
            text += ", or is its slew rate not immediate?"
            await self._end(text, is_again=differed)

    async def _end(self, text: str, *, is_again: bool = False) -> NoReturn:
        """The heat, since the output is not what was commanded: DeviceFault with `text`. One that is not at zero
        after two tries, or that is_again so though it was, is not controlled any more."""
        try:
            try:
                await self._set_zero()
            except DeviceFault:
                await self._set_zero()
        except DeviceFault as error:
            self._raise_fault(f"{text}; it {error.text}")
        if is_again:
            self._raise_fault(text)
        raise DeviceFault(self.name, text)

    def _raise_fault(self, text: str) -> NoReturn:
        self._trip = self.uncontrolled = text
        raise DeviceFault(self.name, text)

    async def _check_dead_man(self) -> None:
        """Check now and then: would the module still end the heat when this program dies, as when it was armed?"""
        if self._clock.now_ns() - self._checked_ns < to_ns(_CHECKED_EVERY_S):
            return
        settings, found = self._settings, await self._unit.snapshot([_WATCHDOG, _TIME, self._safe])
        safe_mA, watchdog_s = (found.samples[point].value for point in (self._safe, _TIME))
        changes = [
            (not found.bits[_WATCHDOG], "its host watchdog was switched off"),
            (not abs(watchdog_s - settings.watchdog_s) <= _TOLERANCE_s, f"its {_TIME} is {watchdog_s:g}"),
            (not abs(safe_mA - settings.tripped_mA) <= _TOLERANCE_mA, f"it gives {safe_mA:g} mA when it is left alone"),
        ]
        if changed := [text for is_so, text in changes if is_so]:
            await self._set_zero()
            text = "; somebody has changed that: it gives no heat until control is started again"
            self._trip = f"{', '.join(changed)}{text}"
            raise DeviceFault(self.name, self._trip)
        self._checked_ns = self._clock.now_ns()

    async def _set_zero(self) -> None:
        """Confirmed by what it gives; a module that has tripped takes nothing, and gives its safe value."""
        zero_mA, error = self._settings.zero_mA, ""
        try:
            self._left_mA = await self._unit.write(self._output, zero_mA)
        except Unreachable:
            raise
        except DeviceError as failure:
            error = f" ({failure.text})"
        given_mA = await self._read_output_mA()
        is_tripped = self._last[-1].value == 1
        is_low = given_mA <= zero_mA + _TOLERANCE_mA
        if is_low if self._present != self._output or not is_tripped else self._is_safe:
            return
        raise DeviceFault(self.name, f"is not confirmed at {zero_mA:g} mA, it gives {given_mA:.2f} mA{error}")

    async def _read_output_mA(self) -> float:
        """Return what flows, mA, and whether it has tripped, which become the readings."""
        try:
            snapshot = await self._unit.snapshot([self._present, _TRIPPED])
            sample, now_ns = snapshot.samples[self._present], self._clock.now_ns()
            if sample.reason:
                raise DeviceFault(self.name, f"{self._present}: {sample.reason}")
        except DeviceError as error:
            self._unread = error.text
            raise
        self._unread = ""
        self._last = (
            Reading(f"{self.name}.output", sample.value, "mA", now_ns),
            Reading(f"{self.name}.tripped", float(snapshot.bits[_TRIPPED]), "1", now_ns),
        )
        return sample.value

    async def _mA(self, point: str) -> float:
        sample = (await self._unit.snapshot([point])).samples[point]
        if sample.reason:
            raise DeviceFault(self.name, f"{point}: {sample.reason}")
        return sample.value

    async def _read_coil(self, coil: str) -> bool:
        return (await self._unit.snapshot([coil])).bits[coil]

    async def _clear(self) -> None:
        async def send() -> None:
            await self._unit.write_coil(self._unit.map.points[_TRIPPED].address, COIL_ON)

        async def holds() -> bool:
            return not await self._read_coil(_TRIPPED)

        await self._unit.send_and_check(send, holds, "clearing the trip")

    async def _switch(self, coil: str, on: bool) -> None:
        async def send() -> None:
            await self._unit.write_coil(self._unit.map.points[coil].address, COIL_ON if on else COIL_OFF)

        async def holds() -> bool:
            return await self._read_coil(coil) == on

        await self._unit.send_and_check(send, holds, f"{coil} {'on' if on else 'off'}")


def _make(name: str, settings: HeatModuleSettings, around: DriverContext) -> HeatModule:
    unit = ModbusUnit(name, around.bus, around.map_of("heat_module", settings))
    return HeatModule(unit, settings, around.clock)


async def _check(look: DeviceCheck) -> None:
    """Opened as a run does it."""
    await look.open_and_read()
    places = ("output", "present", "safe", "power_on", "type_code")
    watchdog = ("watchdog_mode", _WATCHDOG, _TIME, _TRIPPED, "data_format")
    await look.check_points((*(f"{each}_{look.settings.channel}" for each in places), *watchdog))


KIND = DeviceKind(
    name="output",
    settings=HeatModuleSettings,
    make=_make,
    channels=(Channel("output", "mA", "current"), Channel("tripped", "1", "flag")),
    section="heat_module",
    device="heat_module",
    rank=15,
    is_opened=False,  # by the regulator that heats by it
    address_key="",
    simulated_map="icpdas-m7024",
    check=_check,
)
