"""The regulator driver against pymodbus servers that hold the E5CC's registers and act on its operation commands."""

from __future__ import annotations

from collections.abc import AsyncIterator, Awaitable, Callable
from pathlib import Path
from typing import Any

import pytest
from pymodbus.constants import ExcCodes
from pymodbus.simulator import DataType, SimData, SimDevice

from thermostand.drivers.devices.regulators.regulator import Regulator
from thermostand.drivers.wires.bus import Bus, BusSettings
from thermostand.drivers.wires.registers import load_register_map
from thermostand.foundation.clock import WallClock, to_ns
from thermostand.foundation.errors import ConfigError, DeviceFault, Occupied, Refused, Unreachable
from thermostand.foundation.readings import Quality, Reading

Serve = Callable[..., Awaitable[str]]  # the fixture serve_modbus

MAP = load_register_map(Path(__file__).parents[2] / "configs" / "registers" / "omron-e5cc.yaml")

PV, STATUS_LOW, MV_HEAT, MV_COOL, SP = 0x2000, 0x2001, 0x2004, 0x2005, 0x2103
STATUS_0, STATUS_16, DECIMAL_POINT, MV_AT_PV_ERROR = 0x2406, 0x2407, 0x2410, 0x2711
MV_AT_STOP = 0x270F
RAM_MODE, AUTOTUNE, STOPPED, WRITING, MANUAL = 1 << 4, 1 << 7, 1 << 8, 1 << 9, 1 << 10  # of STATUS_16
AD_ERROR, SENSOR_BREAK = 1 << 2, 1 << 6  # of STATUS_LOW


class E5cc:
    """The unit as H175 describes it: operation commands at address 0, status bits, writing that must be enabled."""

    def __init__(self) -> None:
        self.words = {0: 0, PV: 235, STATUS_LOW: 0, 0x2002: 250, 0x2003: 0, MV_HEAT: 425, MV_COOL: 0, SP: 250}
        self.words |= {STATUS_0: 0, STATUS_16: STOPPED, DECIMAL_POINT: 1, MV_AT_PV_ERROR: 0, MV_AT_STOP: 0}
        self.words |= {0x2710: 0, 0x2E06: 1, 0x2E07: 2}
        self.commands: list[int] = []
        self.requests = 0
        self.eeprom_writes = 0
        self.ignores: set[int] = set()  # commands acknowledged without effect
        self.largest_sp = 0xFFFF
        self.unplugged = False

    def device(self) -> SimDevice:
        data = [SimData(address, values=0, datatype=DataType.REGISTERS) for address in sorted(self.words)]
        return SimDevice(1, simdata=data, action=self.act)

    async def act(
        self, function: int, start: int, address: int, count: int, registers: list[int], values: Any
    ) -> ExcCodes | None:
        if self.unplugged:
            return ExcCodes.GATEWAY_NO_RESPONSE
        self.requests += values is not None or function in (3, 4)
        refusal = None if values is None else self._write(address, values)
        if function == 3:  # the reply to a write repeats what was sent
            for known, word in self.words.items():
                registers[known - start] = word
        return refusal

    def _write(self, address: int, values: list[int]) -> ExcCodes | None:
        if address == 0:
            return self._command(values[0])
        if not self.words[STATUS_16] & WRITING:
            return ExcCodes.DEVICE_FAILURE
        self.eeprom_writes += not self.words[STATUS_16] & RAM_MODE
        self.words[address] = min(values[0], self.largest_sp)
        return None

    def _command(self, value: int) -> ExcCodes | None:
        self.commands.append(value)
        if value != 0x0001 and not self.words[STATUS_16] & WRITING:
            return ExcCodes.DEVICE_FAILURE
        on = {0x0001: WRITING, 0x0401: RAM_MODE, 0x0101: STOPPED}.get(value, 0)
        off = {0x0000: WRITING, 0x0400: RAM_MODE, 0x0100: STOPPED}.get(value, 0)
        if value not in self.ignores:
            self.words[STATUS_16] = (self.words[STATUS_16] | on) & ~off
        return None

    def power_cycle(self) -> None:
        self.words[STATUS_16] &= ~(WRITING | RAM_MODE)
        self.words[SP] = 200  # what the EEPROM holds


class SettableClock(WallClock):
    """Wall time that can be set forward."""

    ahead_ns = 0

    def now_ns(self) -> int:
        return super().now_ns() + self.ahead_ns


@pytest.fixture
def unit() -> E5cc:
    return E5cc()


@pytest.fixture
def clock() -> SettableClock:
    return SettableClock()


@pytest.fixture
async def regulator(serve_modbus: Serve, unit: E5cc, clock: SettableClock) -> AsyncIterator[Regulator]:
    """Not yet opened."""
    address = await serve_modbus([unit.device()], [])
    bus = Bus("rs485", BusSettings(address=address, timeout_s=0.3, gap_s=0.0), clock)
    await bus.open()
    yield Regulator("regulator", bus, MAP, clock)
    await bus.close()


async def readings(regulator: Regulator) -> dict[str, Reading]:
    return {reading.channel: reading for reading in await regulator.read()}


async def test_open_enables_writing_and_ram_mode_and_does_not_run(regulator: Regulator, unit: E5cc) -> None:
    await regulator.open()
    assert unit.commands == [0x0001, 0x0401]
    assert unit.words[STATUS_16] == STOPPED | WRITING | RAM_MODE


async def test_a_poll_gives_every_channel_in_three_requests(regulator: Regulator, unit: E5cc) -> None:
    await regulator.open()
    unit.words[PV] = 0x10000 - 103
    before = unit.requests
    found = await readings(regulator)
    assert unit.requests - before == 3
    assert {channel: (round(reading.value, 9), reading.unit) for channel, reading in found.items()} == {
        "regulator.pv": (-10.3, "degC"),
        "regulator.sp": (25.0, "degC"),
        "regulator.mv_heat": (42.5, "%"),
        "regulator.mv_cool": (0.0, "%"),
        "regulator.running": (0.0, "1"),
        "regulator.fault": (0.0, "1"),
    }


@pytest.mark.parametrize(("bit", "reason"), [(SENSOR_BREAK, "sensor_break"), (AD_ERROR, "ad_error")])
async def test_a_broken_sensor_makes_pv_bad_and_is_a_fault(
    regulator: Regulator, unit: E5cc, bit: int, reason: str
) -> None:
    await regulator.open()
    unit.words[STATUS_LOW] |= bit
    found = await readings(regulator)
    assert (found["regulator.pv"].quality, found["regulator.pv"].reason) == (Quality.BAD, reason)
    assert (found["regulator.fault"].value, found["regulator.fault"].reason) == (1.0, reason)
    assert found["regulator.mv_heat"].quality is Quality.GOOD


async def test_a_pv_that_cannot_be_is_bad(regulator: Regulator, unit: E5cc) -> None:
    await regulator.open()
    unit.words[PV] = 8500
    assert (await readings(regulator))["regulator.pv"].reason == "850 degC is outside -40..120"


async def test_a_set_point_is_written_to_ram_and_read_back(regulator: Regulator, unit: E5cc) -> None:
    await regulator.open()
    await regulator.set_temperature(-7.26)
    assert unit.words[SP] == 0x10000 - 73
    assert unit.eeprom_writes == 0
    found = await readings(regulator)
    assert found["regulator.sp"].value == pytest.approx(-7.3)
    assert found["regulator.fault"].value == 0


async def test_a_set_point_outside_the_limits_is_refused_before_the_wire(regulator: Regulator, unit: E5cc) -> None:
    await regulator.open()
    with pytest.raises(Refused, match=r"^regulator: sp: 70\.1 degC .* -10\.\.70; nothing was sent$"):
        await regulator.set_temperature(70.1)
    assert unit.words[SP] == 250


async def test_a_clamped_set_point_is_an_error(regulator: Regulator, unit: E5cc) -> None:
    await regulator.open()
    unit.largest_sp = 500
    with pytest.raises(Refused, match="sp = 60 degC was acknowledged"):
        await regulator.set_temperature(60.0)


async def test_no_set_point_is_sent_while_ram_mode_is_not_confirmed(regulator: Regulator, unit: E5cc) -> None:
    await regulator.open()
    unit.words[STATUS_16] &= ~RAM_MODE
    unit.ignores = {0x0401}
    with pytest.raises(Refused, match="command ram_mode was acknowledged but"):
        await regulator.set_temperature(30.0)
    assert unit.words[SP] == 250
    assert unit.eeprom_writes == 0


async def test_no_set_point_is_sent_while_autotuning(regulator: Regulator, unit: E5cc) -> None:
    await regulator.open()
    unit.words[STATUS_16] |= AUTOTUNE
    with pytest.raises(Occupied, match="autotuning"):
        await regulator.set_temperature(30.0)
    assert unit.words[SP] == 250


async def test_after_a_power_cycle_the_next_poll_starts_it_up_and_sends_the_set_point_again(
    regulator: Regulator, unit: E5cc
) -> None:
    await regulator.open()
    await regulator.set_temperature(40.0)
    unit.power_cycle()
    found = await readings(regulator)
    assert found["regulator.sp"].value == 40.0
    assert unit.eeprom_writes == 0
    assert regulator.start_ups == 2
    assert 0x0100 not in unit.commands  # it never runs by itself


async def test_after_being_unreachable_the_start_up_runs_again_even_when_the_bits_stand(
    regulator: Regulator, unit: E5cc
) -> None:
    await regulator.open()
    await regulator.set_temperature(40.0)
    unit.unplugged = True
    with pytest.raises(Unreachable, match="behind the gateway"):
        await regulator.read()
    unit.unplugged = False
    unit.words[SP] = 200
    assert (await readings(regulator))["regulator.sp"].value == 40.0
    assert regulator.start_ups == 2


@pytest.mark.parametrize(
    ("address", "value", "complaint"),
    [
        (DECIMAL_POINT, 0, "decimal_point is 0 where the register map expects 1"),
        (MV_AT_PV_ERROR, 300, "mv_at_pv_error is 30 where"),
        (MV_AT_STOP, 250, "mv_at_stop is 25 where"),
        (0x2E07, 1, "output_2 is 1 where"),
    ],
)
async def test_a_unit_that_is_not_what_the_map_says_is_not_used(
    regulator: Regulator, unit: E5cc, address: int, value: int, complaint: str
) -> None:
    unit.words[address] = value
    with pytest.raises(DeviceFault, match=complaint):
        await regulator.open()
    assert unit.commands == []
    with pytest.raises(DeviceFault, match=complaint):
        await regulator.read()


async def test_the_decimal_point_is_looked_at_again_every_thirty_seconds(
    regulator: Regulator, unit: E5cc, clock: SettableClock
) -> None:
    await regulator.open()
    unit.words[DECIMAL_POINT] = 0
    await regulator.read()
    clock.ahead_ns = to_ns(31)
    with pytest.raises(DeviceFault, match="decimal_point"):
        await regulator.read()


async def test_run_and_stop_are_confirmed_by_the_stop_bit(regulator: Regulator, unit: E5cc) -> None:
    await regulator.open()
    await regulator.run()
    assert (await readings(regulator))["regulator.running"].value == 1.0
    await regulator.stop()
    assert (await readings(regulator))["regulator.running"].value == 0.0
    unit.ignores = {0x0100}
    with pytest.raises(Refused, match="command run was acknowledged"):
        await regulator.run()


async def test_make_safe_stops_also_a_unit_that_was_power_cycled_while_running(
    regulator: Regulator, unit: E5cc
) -> None:
    await regulator.open()
    await regulator.run()
    unit.power_cycle()
    await regulator.make_safe()
    assert unit.words[STATUS_16] & STOPPED


async def test_make_safe_that_cannot_be_confirmed_says_so(regulator: Regulator, unit: E5cc) -> None:
    await regulator.open()
    await regulator.run()
    unit.ignores = {0x0101}
    with pytest.raises(Refused, match="command stop"):
        await regulator.make_safe()
    unit.unplugged = True
    with pytest.raises(Unreachable):
        await regulator.make_safe()


async def test_keys_pressed_at_the_unit_are_reported(regulator: Regulator, unit: E5cc) -> None:
    await regulator.open()
    await regulator.set_temperature(40.0)
    unit.words[SP] = 450
    unit.words[STATUS_16] |= MANUAL
    fault = (await readings(regulator))["regulator.fault"]
    assert fault.value == 1.0
    assert fault.reason.startswith("manual, set point changed")
    assert unit.words[SP] == 450  # reported, not fought


def test_a_map_without_what_a_regulator_needs_is_refused() -> None:
    bus = Bus("rs485", BusSettings(address="tcp:localhost:502"), WallClock())
    with pytest.raises(ConfigError, match="lacks run, stop"):
        Regulator("regulator", bus, MAP.model_copy(update={"commands": {}}), WallClock())
