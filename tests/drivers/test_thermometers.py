"""The thermometer driver against pymodbus servers with the words of an M-7015."""

from __future__ import annotations

from collections.abc import AsyncIterator, Awaitable, Callable
from pathlib import Path
from typing import Any

import pytest
from pymodbus.constants import ExcCodes
from pymodbus.simulator import DataType, SimData, SimDevice

from thermostand.drivers.devices.thermometers import Thermometers, ThermometerSettings
from thermostand.drivers.wires.bus import Bus, BusSettings
from thermostand.drivers.wires.registers import load_register_map
from thermostand.foundation.clock import WallClock
from thermostand.foundation.errors import ConfigError, DeviceFault, Unreachable
from thermostand.foundation.readings import Quality, Reading

Serve = Callable[..., Awaitable[str]]  # the fixture serve_modbus

MAPS = Path(__file__).parents[2] / "configs" / "registers"
M7015 = load_register_map(MAPS / "icpdas-m7015.yaml")
UNIT = 3
SENSORS = {
    "granite_inside": ThermometerSettings(channel=0),
    "air": ThermometerSettings(channel=3, offset_K=-0.05, polynomial=(0.01, 0.001), certificate="T-17"),
    "laboratory": ThermometerSettings(channel=5, plausible_degC=(5.0, 40.0)),
}


class Module:
    """Six words, six fault bits, six type codes and the data format of an M-7015."""

    def __init__(self) -> None:
        self.words = [round(degC / 100 * 32767) for degC in (24.0, 0.0, 0.0, 25.0, 0.0, 21.5)]
        self.faults = [False] * 6
        self.types = [0x20] * 6
        self.unreadable: set[int] = set()  # function codes that get an exception
        self.unplugged = False
        self.requests: list[int] = []

    def device(self) -> SimDevice:
        return SimDevice(
            UNIT,
            simdata=(
                [SimData(0x100, values=[False] * 16, datatype=DataType.BITS)],
                [SimData(0x80, values=[False] * 16, datatype=DataType.BITS)],
                [SimData(0x100, count=6, datatype=DataType.REGISTERS)],
                [SimData(0, count=6, datatype=DataType.REGISTERS)],
            ),
            action=self.act,
        )

    async def act(
        self, function: int, start: int, address: int, count: int, registers: list[int], values: Any
    ) -> ExcCodes | None:
        self.requests.append(function)
        if self.unplugged:
            return ExcCodes.GATEWAY_NO_RESPONSE
        if function in self.unreadable:
            return ExcCodes.DEVICE_FAILURE
        match function:
            case 2:
                registers[0] = sum(fault << channel for channel, fault in enumerate(self.faults))
            case 3:
                registers[:6] = self.types
            case 4:
                registers[:6] = [word & 0xFFFF for word in self.words]
        return None


@pytest.fixture
def module() -> Module:
    return Module()


@pytest.fixture
async def thermometers(serve_modbus: Serve, module: Module) -> AsyncIterator[Thermometers]:
    """Not yet opened."""
    bus = Bus(
        "rs485", BusSettings(address=await serve_modbus([module.device()], []), timeout_s=0.5, gap_s=0.0), WallClock()
    )
    await bus.open()
    yield Thermometers("thermometers", bus, M7015, SENSORS, WallClock())
    await bus.close()


async def readings(thermometers: Thermometers) -> dict[str, Reading]:
    return {reading.channel.removeprefix("thermometers."): reading for reading in await thermometers.read()}


async def test_temperatures_are_scaled_and_calibrated_and_the_raw_words_kept(
    thermometers: Thermometers, module: Module
) -> None:
    await thermometers.open()
    found = await readings(thermometers)
    assert list(found) == ["granite_inside", "granite_inside_raw", "air", "air_raw", "laboratory", "laboratory_raw"]
    assert found["granite_inside"].value == pytest.approx(24.0, abs=0.0016)  # half a count
    assert found["air"].value == pytest.approx(25.0 - 0.05 + 0.01 + 0.001 * 25.0, abs=0.0016)
    assert found["laboratory"].unit == "degC"
    assert found["air_raw"].value == module.words[3]
    assert {reading.quality for reading in found.values()} == {Quality.GOOD}


async def test_below_zero_and_at_the_calibration_points(thermometers: Thermometers, module: Module) -> None:
    await thermometers.open()
    for degC in (-39.9, -10.0, 0.0, 52.0, 99.9):
        module.words[0] = round(degC / 100 * 32767)
        assert (await readings(thermometers))["granite_inside"].value == pytest.approx(degC, abs=0.0016)


async def test_a_poll_is_one_read_of_words_and_one_of_bits(thermometers: Thermometers, module: Module) -> None:
    await thermometers.open()
    module.requests.clear()
    await thermometers.read()
    assert module.requests == [4, 2]


@pytest.mark.parametrize(("word", "reason"), [(0x7FFF, "over range or open"), (-0x8000, "under range")])
async def test_a_fault_word_spoils_its_own_sensor_only(
    thermometers: Thermometers, module: Module, word: int, reason: str
) -> None:
    await thermometers.open()
    module.words[3] = word
    found = await readings(thermometers)
    assert (found["air"].quality, found["air"].reason) == (Quality.BAD, reason)
    assert found["granite_inside"].quality is found["laboratory"].quality is Quality.GOOD


async def test_an_open_wire_bit_spoils_its_own_sensor_only(thermometers: Thermometers, module: Module) -> None:
    await thermometers.open()
    module.faults[5] = True
    found = await readings(thermometers)
    assert (found["laboratory"].quality, found["laboratory"].reason) == (Quality.BAD, "open_5")
    assert found["granite_inside"].quality is found["air"].quality is Quality.GOOD


async def test_an_implausible_temperature_is_bad(thermometers: Thermometers, module: Module) -> None:
    await thermometers.open()
    module.words[5] = round(0.5 * 32767)
    assert "is outside 5..40 degC" in (await readings(thermometers))["laboratory"].reason


async def test_values_are_stale_while_the_fault_bits_cannot_be_read(thermometers: Thermometers, module: Module) -> None:
    await thermometers.open()
    module.unreadable = {2}
    found = await readings(thermometers)
    assert found["air"].quality is Quality.STALE
    assert found["air"].value == pytest.approx(24.985, abs=0.0016)
    assert "fault bits unreadable" in found["air"].reason


async def test_another_type_code_is_refused(thermometers: Thermometers, module: Module) -> None:
    module.types[3] = 0x2E
    with pytest.raises(DeviceFault, match=r"thermometers: type_code_3 is 46 .* 32"):
        await thermometers.open()
    with pytest.raises(DeviceFault, match="type_code_3"):
        await thermometers.read()


async def test_a_module_exchanged_while_unreachable_is_found_out(thermometers: Thermometers, module: Module) -> None:
    await thermometers.open()
    module.unplugged = True
    with pytest.raises(Unreachable):
        await thermometers.read()
    module.unplugged = False
    module.types = [0x2E] * 6
    with pytest.raises(DeviceFault, match="type_code_0"):
        await thermometers.read()


def test_a_sensor_on_a_channel_the_module_has_not_is_a_config_error() -> None:
    bus = Bus("rs485", BusSettings(address="tcp:localhost:502"), WallClock())
    with pytest.raises(ConfigError, match=r"thermometers\.air: register map M-7015 has no value_6"):
        Thermometers("thermometers", bus, M7015, {"air": ThermometerSettings(channel=6)}, WallClock())
