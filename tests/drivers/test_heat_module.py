"""Heat through an analog output, over its wire: what it gives, what ends it without us, and who else writes to it."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncGenerator, Callable
from contextlib import asynccontextmanager, suppress

import pytest
from pydantic import ValidationError

from thermostand.drivers.devices.regulators.heat_module import HeatModule, HeatModuleSettings
from thermostand.drivers.sim.physics.plant import Plant, PlantSpec
from thermostand.drivers.sim.units import heat_module as fake_module
from thermostand.drivers.sim.units.heat_module import TRIPPED, FakeHeatModule
from thermostand.drivers.sim.units.modbus import RtuEngine, TcpEngine, crc16
from thermostand.drivers.sim.wire import LinkFaults, TcpWire
from thermostand.drivers.wires.bus import Bus, BusSettings
from thermostand.drivers.wires.modbus_unit import ModbusUnit
from thermostand.drivers.wires.registers import RegisterMap, load_register_map
from thermostand.foundation.clock import VirtualClock, to_ns
from thermostand.foundation.documents import parse_document
from thermostand.foundation.errors import ConfigError, DeviceFault, Unreachable
from thermostand.foundation.readings import Quality
from thermostand.stand.config.stand_config import find_packaged

START_NS = 1_700_000_000_000_000_000
UNIT = 4
SETTINGS = HeatModuleSettings(registers="icpdas-m7024", unit=UNIT, channel=1, watchdog_s=5.0)
MAP = load_register_map(find_packaged("registers", "icpdas-m7024"))


class Bench:
    def __init__(self) -> None:
        self.clock = VirtualClock(START_NS)
        self.plant = Plant(PlantSpec(laboratory_swing_K=0.0), START_NS)
        self.plant.heater_enabled = True
        self.fake = FakeHeatModule(self.plant, self.clock, UNIT, channel=1)

    async def wait(self, duration_s: float) -> None:
        await self.clock.sleep_until(self.clock.now_ns() + to_ns(duration_s))

    def heater_W(self) -> float:
        with self.plant.lock:
            self.plant.advance(self.clock.now_ns())
        return self.plant.heater_W


@asynccontextmanager
async def driven(
    bench: Bench, settings: HeatModuleSettings = SETTINGS, register_map: RegisterMap = MAP
) -> AsyncGenerator[HeatModule]:
    wire = TcpWire("127.0.0.1", 0, lambda: TcpEngine([bench.fake]), LinkFaults())
    bus = Bus("bus", BusSettings(address=wire.address, timeout_s=0.3), bench.clock)
    time = asyncio.create_task(bench.clock.run())
    await bus.open()
    try:
        yield HeatModule(ModbusUnit("heat_module", bus, register_map), settings, bench.clock)
    finally:
        await bus.close()
        wire.close()
        time.cancel()
        with suppress(asyncio.CancelledError):
            await time


async def heating(bench: Bench, module: HeatModule, percent: float, duration_s: float = 10.0) -> None:
    for _ in range(round(duration_s / 2)):
        await module.give(percent)
        await bench.wait(2.0)


async def test_the_current_follows_the_output_and_ends_with_it():
    bench = Bench()
    async with driven(bench) as module:
        await module.open()
        assert "0x702400" in str(module.identity)
        await module.arm()
        await heating(bench, module, 25)
        assert bench.fake.output_mA() == pytest.approx(8.0)
        assert bench.heater_W() == pytest.approx(500.0)
        assert [(each.channel, each.unit) for each in await module.read()] == [
            ("heat_module.output", "mA"),
            ("heat_module.tripped", "1"),
        ]
        await module.give(120)
        assert bench.fake.output_mA() == 20.0
        await module.give(float("nan"))
        assert bench.fake.output_mA() == 4.0
        await module.give(50)
        await module.off()
        assert bench.fake.output_mA() == 4.0
        await bench.wait(60)
        assert bench.fake.trips == 0  # nobody watches what gives nothing


async def test_left_alone_it_goes_to_its_safe_value_in_its_watchdogs_time():
    """As when the process dies: no request comes any more, though its last one was full heat."""
    bench = Bench()
    async with driven(bench) as module:
        await module.arm()
        await heating(bench, module, 100)
        assert bench.heater_W() == pytest.approx(2000)
        await bench.wait(3.5)
        assert bench.heater_W() == 0.0
        assert bench.fake.output_mA() == 4.0
        with pytest.raises(DeviceFault, match=r"watchdog has tripped \(5\.5 s after .* 4\.00 mA"):
            await module.give(100)
        with pytest.raises(DeviceFault, match="has tripped"):  # not cleared by itself
            await module.give(100)
        bench.fake.power_cycle()
        assert (await module.read())[1].value == 1  # which no power cycle clears
        await module.off()
        await module.arm()  # somebody starts control again
        await module.give(10)
        assert bench.fake.output_mA() == pytest.approx(5.6)


async def test_reading_it_does_not_keep_alive_what_its_law_has_left():
    bench = Bench()
    async with driven(bench) as module:
        await module.arm()
        await module.give(100)
        for _ in range(6):
            await module.read()
            await bench.wait(1.0)
        assert bench.heater_W() == 0.0


async def test_what_it_gave_last_is_not_shown_as_fresh_when_the_law_cannot_ask_it_or_does_not():
    """A lost law is not asked for by our polls, so what they show has a time, and a reason from the watchdog's on."""
    bench = Bench()
    async with driven(bench) as module:
        await module.arm()
        await heating(bench, module, 50, 4.0)
        assert [each.quality for each in await module.read()] == [Quality.GOOD] * 2
        bench.fake.silent = True
        with pytest.raises(Unreachable):
            await module.give(50)
        (output, _) = await module.read()
        assert (output.quality, output.value) == (Quality.STALE, 12.0)
        assert "no reply" in output.reason
        bench.fake.silent = False
        await module.give(50)
        (output, _) = await module.read()
        assert (output.quality, output.time_ns) == (Quality.GOOD, bench.clock.now_ns())
        await bench.wait(6.0)
        (output, _) = await module.read()
        assert output.quality == Quality.STALE
        assert "6 s" in output.reason


UNSAFE: list[tuple[Callable[[FakeHeatModule], object], str]] = [
    (lambda fake: fake.safe_mA.__setitem__(1, 12.0), "gives 12 mA when it is left alone (safe_1), not 4, and does"),
    (lambda fake: fake.type_codes.__setitem__(1, 0x32), "type_code_1 is 0x32, which is no range of mA"),
    (lambda fake: fake.coils.update({268: False}), "data_format is 0 where the register map expects 1"),
    (lambda fake: fake.coils.update({259: True}), "watchdog_mode is 1 where the register map expects 0"),
]


@pytest.mark.parametrize(("spoil", "text"), UNSAFE, ids=["safe value", "range", "format", "watchdog mode"])
async def test_one_that_would_not_be_safe_without_us_is_refused(spoil: Callable[[FakeHeatModule], object], text: str):
    bench = Bench()
    bench.fake.safe_fixed = True
    spoil(bench.fake)
    async with driven(bench) as module:
        with pytest.raises(DeviceFault) as refused:
            await module.open()
        assert text in refused.value.text


async def test_safe_and_power_on_values_are_set_where_they_differ():
    bench = Bench()
    bench.fake.safe_mA[1], bench.fake.power_on_mA[1] = 20.0, 12.0
    async with driven(bench) as module:
        await module.open()
    assert (bench.fake.safe_mA[1], bench.fake.power_on_mA[1]) == (4.0, 4.0)
    assert bench.fake.output_mA() == 4.0


@pytest.mark.parametrize("refreshed_by", ["requests", "writes"])
async def test_a_watchdog_that_trips_and_is_kept_by_what_we_write_is_relied_upon(refreshed_by: str):
    bench = Bench()
    bench.fake.refreshed_by = refreshed_by  # type: ignore[assignment] - one of its words
    async with driven(bench) as module:
        await module.test_dead_man()
        assert (bench.fake.trips, bench.fake.output_mA(), bench.heater_W()) == (1, 4.0, 0.0)


async def test_a_watchdog_that_wants_another_protocol_is_reported():
    bench = Bench()
    bench.fake.refreshed_by = "nothing"
    async with driven(bench) as module:
        with pytest.raises(DeviceFault, match=r"trips though it is"):
            await module.test_dead_man()


async def test_a_watchdog_that_does_not_trip_is_reported():
    class Deaf(FakeHeatModule):
        def _watch(self, time_ns: int) -> None: ...

    bench = Bench()
    bench.fake = Deaf(bench.plant, bench.clock, UNIT, channel=1)
    async with driven(bench) as module:
        with pytest.raises(DeviceFault, match=r"does not trip after 7\.5 s"):
            await module.test_dead_man()


async def test_what_another_master_writes_is_found_and_set_to_zero():
    bench = Bench()
    async with driven(bench) as module:
        await module.open()
        bench.fake.write_mA(16.0)
        with pytest.raises(DeviceFault, match=r"gave 16\.00 mA unasked"):
            await module.read()
        assert bench.fake.output_mA() == 4.0
        await module.arm()
        await module.give(50)
        bench.fake.write_mA(20.0)
        with pytest.raises(DeviceFault, match=r"gave 20\.00 mA .* 12\.00 mA"):
            await module.give(50)
        assert bench.fake.output_mA() == 4.0


CHANGED: list[tuple[Callable[[FakeHeatModule], object], str]] = [
    (lambda fake: fake.safe_mA.__setitem__(1, 20.0), "it gives 20 mA when it is left alone"),
    (lambda fake: fake.coils.update({260: False}), "its host watchdog was switched off"),
    (lambda fake: setattr(fake, "timeout_tenths", 255), r"its watchdog_s is 25\.5"),
]


@pytest.mark.parametrize(("change", "text"), CHANGED, ids=["safe value", "watchdog off", "watchdog's time"])
async def test_what_would_heat_on_without_us_since_somebody_changed_it_gives_no_heat(
    change: Callable[[FakeHeatModule], object], text: str
):
    bench = Bench()
    async with driven(bench) as module:
        await module.arm()
        await heating(bench, module, 50)
        change(bench.fake)
        with pytest.raises(DeviceFault, match=f"{text}; somebody has changed that"):
            await heating(bench, module, 50, 14.0)
        assert bench.fake.output_mA() == 4.0
        with pytest.raises(DeviceFault, match=text):
            await module.give(50)
        assert bench.fake.output_mA() == 4.0
        await module.arm()  # somebody starts control again: what was changed is set again
        await heating(bench, module, 50)
        assert (bench.fake.safe_mA[1], bench.fake.coils[260], bench.fake.timeout_tenths) == (4.0, True, 50)
        assert bench.heater_W() > 0.0


async def test_an_output_that_stays_on_is_not_confirmed_off():
    bench = Bench()
    async with driven(bench) as module:
        await module.arm()
        await module.give(50)
        bench.fake.stuck_mA = 12.0
        with pytest.raises(DeviceFault, match=r"is not confirmed at 4 mA, it gives 12\.00 mA"):
            await module.off()


async def test_a_silent_module_gives_no_heat_and_says_so():
    bench = Bench()
    async with driven(bench) as module:
        await module.arm()
        await module.give(50)
        bench.fake.silent = True
        with pytest.raises(Unreachable):
            await module.off()
        await bench.wait(6.0)
        assert bench.heater_W() == 0.0
        bench.fake.silent = False
        with pytest.raises(DeviceFault, match="host watchdog has tripped"):
            await module.give(50)


def test_its_frames_are_those_of_the_manual():
    """Check vectors: enable the watchdog, set it to 5.0 s."""
    bench = Bench()
    bench.fake.unit = 1
    for vector in ("01 05 01 04 FF 00 CC 07", "01 06 01 E8 00 32 89 D7"):
        frame = bytes.fromhex(vector)
        assert crc16(frame[:-2]) == frame[-2:]
        assert RtuEngine([bench.fake]).feed(frame) == frame
    assert (bench.fake.coils[260], bench.fake.timeout_tenths) == (True, 50)
    assert (MAP.points["watchdog_on"].address, MAP.points["watchdog_s"].address) == (0x104, 0x1E8)


# The fact sheet's numbers of the M-7024 (chambers.md, section 6; sister modules) and of its family's format coil.
NUMBERS = {
    "watchdog_mode": ("coil", 260),
    "watchdog_on": ("coil", 261),
    "data_format": ("coil", 269),
    "tripped": ("coil", 270),
    "output_0": ("holding", 40033),
    "safe_0": ("holding", 40097),
    "power_on_0": ("holding", 40193),
    "watchdog_s": ("holding", 40489),
}


def test_its_registers_are_those_of_the_fact_sheet_in_driver_and_fake_and_none_passes_as_seen():
    first = {"coil": 1, "holding": 40001}
    theirs = fake_module.WATCHDOG_MODE, fake_module.WATCHDOG_ENABLED, fake_module.ENGINEERING, fake_module.TRIPPED
    words = fake_module.VALUES, fake_module.SAFE_VALUES, fake_module.POWER_ON_VALUES, fake_module.TIMEOUT
    for (name, (space, number)), fake in zip(NUMBERS.items(), (*theirs, *words), strict=True):
        point = MAP.points[name]
        assert (point.space, point.address, fake) == (space, number - first[space], number - first[space]), name
        assert point.unverified, name
    assert fake_module.TRIPS == 40492 - 40001
    assert MAP.points["watchdog_s"].limits == (0.1, 25.5)
    assert {point.model_dump()["unverified"] != "" for point in MAP.points.values()} == {True}


def test_a_module_without_a_watchdog_that_can_be_read_is_refused():
    text = find_packaged("registers", "icpdas-m7024").read_text().replace("watchdog_s:", "other_s:")
    bus = Bus("bus", BusSettings(address="tcp:127.0.0.1:1"), VirtualClock(0))
    with pytest.raises(ConfigError, match="has no watchdog_s"):
        HeatModule(ModbusUnit("heat_module", bus, parse_document(text, RegisterMap, "map")), SETTINGS, VirtualClock(0))


@pytest.mark.parametrize(
    ("settings", "text"), [({"safe_mA": 8.0}, "it would heat when this computer has died"), ({"zero_mA": 20}, "below")]
)
def test_currents_that_would_heat_without_us_are_refused(settings: dict[str, float], text: str):
    with pytest.raises(ValidationError, match=text):
        HeatModuleSettings(registers="icpdas-m7024", unit=UNIT, **settings)  # type: ignore[arg-type] - floats


async def test_a_module_exchanged_while_it_was_silent_gets_no_heat():
    bench = Bench()
    async with driven(bench) as module:
        await module.open()
        await module.arm()
        await heating(bench, module, 50.0)
        bench.fake.silent = True
        with pytest.raises(Unreachable):
            await module.give(50.0)
        bench.fake.silent, bench.fake.name = False, 0x702800
        bench.fake.values_mA = [4.0] * 4
        bench.fake.coils[TRIPPED] = False
        for _ in range(2):
            with pytest.raises(DeviceFault, match=r"0x702800.* answers where .*0x702400.* answered before"):
                await module.give(50.0)
        assert bench.fake.values_mA == [4.0] * 4
        await module.off()  # which is never withheld


async def test_an_output_with_a_slew_rate_is_found_at_its_first_heat_and_gives_no_more():
    """By the slowest one it would go on heating for two minutes after it was switched off, or has tripped."""
    bench = Bench()
    async with driven(bench) as module:
        await module.open()
        await module.arm()
        bench.fake.slew_mA_per_s = 0.125
        with pytest.raises(DeviceFault, match=r"left at 12\.00 mA; .* slew rate"):
            await heating(bench, module, 50.0)
        assert module.uncontrolled
        await bench.wait(10.0)
        assert bench.heater_W() < 2000 * 0.02
