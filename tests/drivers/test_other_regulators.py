"""Regulators of other makes, by their register maps alone, over the wire of a fake of each."""

from __future__ import annotations

from collections.abc import AsyncGenerator, Callable
from contextlib import asynccontextmanager
from pathlib import Path

import pytest
import yaml

from tests.drivers.other_regulators import DEGC, FakeBinder, FakeEurotherm, FakeEzZone, FakeF4t, float_words
from thermostand.drivers.devices.regulators.regulator import Regulator
from thermostand.drivers.sim.physics.plant import Plant, PlantSpec
from thermostand.drivers.sim.units.modbus import TcpEngine
from thermostand.drivers.sim.wire import LinkFaults, TcpWire
from thermostand.drivers.wires.bus import Bus, BusSettings
from thermostand.drivers.wires.registers import RegisterMap, load_register_map
from thermostand.foundation.clock import FollowedClock, WallClock, to_ns
from thermostand.foundation.documents import parse_document
from thermostand.foundation.errors import ConfigError, DeviceFault, Refused, Unreachable
from thermostand.foundation.readings import Quality, Reading
from thermostand.stand.config.stand_config import find_packaged

START_NS = 1_700_000_000_000_000_000
Fake = FakeEurotherm | FakeEzZone | FakeF4t | FakeBinder
FAKES: dict[str, type[Fake]] = {
    "eurotherm-3200": FakeEurotherm,
    "watlow-ez-zone": FakeEzZone,
    "watlow-f4t": FakeF4t,
    "binder-mk53": FakeBinder,
}
WITHOUT_OUTPUTS = ("binder-mk53",)  # a chamber's own controller, which does not tell them


class Bench:
    """The unit in the simulated chamber, and its driver."""

    def __init__(self, make: str) -> None:
        self.plant = Plant(PlantSpec(laboratory_swing_K=0.0), START_NS)
        self.plant.heater_enabled = True
        self.clock = FollowedClock(START_NS)
        self.fake = FAKES[make](self.plant, self.clock, 1)
        if isinstance(self.fake, FakeEzZone):
            self.fake.comms_unit = DEGC

    def wait(self, duration_s: float) -> None:
        self.clock.follow(self.clock.now_ns() + to_ns(duration_s))
        self.fake.handle(b"\x03\x00\x01\x00\x01")


@asynccontextmanager
async def driven(bench: Bench, register_map: RegisterMap) -> AsyncGenerator[Regulator]:
    wire = TcpWire("127.0.0.1", 0, lambda: TcpEngine([bench.fake]), LinkFaults())
    bus = Bus("bus", BusSettings(address=wire.address, timeout_s=0.3), WallClock())
    await bus.open()
    try:
        yield Regulator("regulator", bus, register_map, WallClock())
    finally:
        await bus.close()
        wire.close()


def map_of(make: str, change: Callable[[str], str] = lambda text: text) -> RegisterMap:
    return parse_document(change(find_packaged("registers", make).read_text()), RegisterMap, make)


def by_name(readings: tuple[Reading, ...]) -> dict[str, Reading]:
    return {reading.channel.removeprefix("regulator."): reading for reading in readings}


@pytest.mark.parametrize("make", FAKES)
async def test_another_make_heats_to_its_set_point_and_stops(make: str):
    bench = Bench(make)
    async with driven(bench, map_of(make)) as regulator:
        await regulator.open()
        await regulator.stop()
        assert by_name(await regulator.read())["running"].value == 0
        await regulator.set_temperature(40.0)
        await regulator.run()
        for _ in range(360):
            bench.wait(5.0)
            if bench.plant.now_ns % to_ns(60) == 0:
                await regulator.read()
            elif make == "eurotherm-3200":
                await regulator.read()  # which refreshes its remote set point
        found = by_name(await regulator.read())
        assert found["pv"].value == pytest.approx(40.0, abs=2.6)  # half of the fake's proportional band
        assert found["pv"].value > 35
        assert found["sp"].value == 40.0
        if make not in WITHOUT_OUTPUTS:
            assert 0 < found["mv_heat"].value <= 100
            assert found["mv_cool"].value == 0
        assert (found["running"].value, found["fault"].value) == (1, 0)
        await regulator.make_safe()
        found = by_name(await regulator.read())
        assert found["running"].value == 0
        assert ("mv_heat" in found) == (make not in WITHOUT_OUTPUTS)
        assert "mv_heat" not in found or found["mv_heat"].value == 0
        bench.wait(1.0)
        assert bench.plant.heater_on_fraction == 0


@pytest.mark.parametrize("make", FAKES)
async def test_no_set_point_wears_the_memory(make: str):
    """The F4T and a Binder cannot be asked not to save: the same set-point again is not sent."""
    bench = Bench(make)
    async with driven(bench, map_of(make)) as regulator:
        await regulator.open()
        for _ in range(20):
            await regulator.set_temperature(30.0)
        assert bench.fake.eeprom_writes == (1 if make in ("watlow-f4t", "binder-mk53") else 0)


@pytest.mark.parametrize("make", FAKES)
async def test_a_make_that_is_silent_says_what_to_look_at(make: str):
    bench = Bench(make)
    bench.fake.silent = True
    async with driven(bench, map_of(make)) as regulator:
        with pytest.raises(Unreachable, match=r"; is |Modbus"):
            await regulator.read()


async def test_a_stop_of_which_the_second_write_is_lost_is_sent_again_whole():
    """Manual is confirmed by its bit, and begins with the output that automatic had: that bit alone is no stop."""
    bench = Bench("eurotherm-3200")
    async with driven(bench, map_of("eurotherm-3200")) as regulator:
        await regulator.open()
        await regulator.set_temperature(60.0)
        await regulator.run()
        bench.wait(5.0)
        assert by_name(await regulator.read())["mv_heat"].value == 100
        assert isinstance(bench.fake, FakeEurotherm)
        bench.fake.lost = 3
        await regulator.stop()
        bench.wait(5.0)
        assert by_name(await regulator.read())["mv_heat"].value == 0
        assert bench.plant.heater_on_fraction == 0


async def test_a_loop_break_is_reported():
    bench = Bench("eurotherm-3200")
    async with driven(bench, map_of("eurotherm-3200")) as regulator:
        await regulator.open()
        assert isinstance(bench.fake, FakeEurotherm)
        bench.fake.loop_break = True
        assert by_name(await regulator.read())["fault"].reason.startswith("loop_break")


async def test_an_open_door_is_a_fault():
    bench = Bench("binder-mk53")
    async with driven(bench, map_of("binder-mk53")) as regulator:
        await regulator.open()
        assert isinstance(bench.fake, FakeBinder)
        bench.fake.door_open = True
        assert by_name(await regulator.read())["fault"].reason == "door_open"


async def test_a_remote_set_point_that_is_not_refreshed_is_given_up_for_the_local_one():
    """What keeps the chamber safe when the computer dies; shown by a bit while it lives."""
    bench = Bench("eurotherm-3200")
    async with driven(bench, map_of("eurotherm-3200")) as regulator:
        await regulator.open()
        await regulator.set_temperature(40.0)
        await regulator.run()
        for _ in range(10):
            bench.wait(5.0)
            found = by_name(await regulator.read())
            assert found["fault"].value == 0
        bench.wait(1800.0)  # the computer is dead
        assert bench.plant.chamber_degC < 40.0
        bench.wait(5.0)
        assert bench.plant.heater_on_fraction == 0  # its local set-point is 20 degC
        found = by_name(await regulator.read())
        assert found["fault"].reason.startswith("remote_sp_fail, another set-point acts")


@pytest.mark.parametrize(
    ("make", "name", "value"),
    [
        ("eurotherm-3200", "rate_K_per_min", 0.5),
        ("watlow-f4t", "profile_degC", 60.0),
        ("binder-mk53", "profile_degC", 60.0),
        ("watlow-ez-zone", "comms_unit", 30),
    ],
)
async def test_a_set_point_that_is_not_the_one_that_acts_stops_what_was_started(make: str, name: str, value: float):
    bench = Bench(make)
    async with driven(bench, map_of(make)) as regulator:
        await regulator.open()
        await regulator.stop()
        await regulator.set_temperature(30.0)
        found = await regulator.in_force()
        assert (found.objections, bool(found.known_by), bool(found.not_reported)) == ((), True, True)
        setattr(bench.fake, name, value)
        bench.wait(5.0)
        with pytest.raises(DeviceFault, match="not in force: "):
            await regulator.run()
        bench.wait(1.0)
        assert bench.plant.heater_on_fraction == 0
        setattr(bench.fake, name, DEGC if name == "comms_unit" else None)
        await regulator.set_temperature(30.0)
        await regulator.run()
        assert by_name(await regulator.read())["fault"].value == 0
        setattr(bench.fake, name, value)
        bench.wait(5.0)
        assert by_name(await regulator.read())["fault"].value == 1


async def test_a_map_that_does_not_say_what_is_in_force_is_known_as_such():
    def without(text: str) -> str:
        document = yaml.safe_load(text)
        del document["in_force"], document["unverified"]
        return yaml.safe_dump(document)

    async with driven(Bench("watlow-f4t"), map_of("watlow-f4t", without)) as regulator:
        await regulator.open()
        found = await regulator.in_force()
        assert found.known_by == ""
        assert "in_force" in found.not_reported


async def test_eurotherm_sensor_break_makes_the_pv_bad():
    bench = Bench("eurotherm-3200")
    async with driven(bench, map_of("eurotherm-3200")) as regulator:
        await regulator.open()
        assert isinstance(bench.fake, FakeEurotherm)
        bench.fake.sensor_break = True
        found = by_name(await regulator.read())
        assert (found["pv"].quality, found["pv"].reason) == (Quality.BAD, "sensor_break")


async def test_a_unit_that_speaks_degrees_fahrenheit_is_refused():
    bench = Bench("watlow-ez-zone")
    assert isinstance(bench.fake, FakeEzZone)
    bench.fake.comms_unit = 30
    async with driven(bench, map_of("watlow-ez-zone")) as regulator:
        with pytest.raises(DeviceFault, match=r"comms_unit is 30 .* 15"):
            await regulator.open()


@pytest.mark.parametrize("make", ["watlow-ez-zone", "watlow-f4t", "binder-mk53"])
async def test_exchanged_words_are_no_temperature(make: str):
    bench = Bench(make)
    assert not isinstance(bench.fake, FakeEurotherm)
    bench.fake.high_first = True
    bench.fake.stuck_pv_degC = 25.0  # 41C8 0000: a round number is next to nothing the other way round
    async with driven(bench, map_of(make)) as regulator:
        await regulator.open()
        pv = by_name(await regulator.read())["pv"]
        assert (pv.quality, "word_order" in pv.reason) == (Quality.BAD, True)
    async with driven(bench, map_of(make, lambda text: text.replace("low_first", "high_first"))) as regulator:
        await regulator.open()
        assert by_name(await regulator.read())["pv"].value == 25.0


async def test_a_set_point_that_the_unit_clamps_is_an_error():
    bench = Bench("watlow-f4t")
    assert isinstance(bench.fake, FakeF4t)
    bench.fake.limits_degC = (0.0, 35.0)
    async with driven(bench, map_of("watlow-f4t")) as regulator:
        await regulator.open()
        with pytest.raises(Refused, match="reads back otherwise"):
            await regulator.set_temperature(40.0)


def test_floats_are_those_of_the_manuals():
    """F4T 25.0: 01 10 0A DE 00 02 04 00 00 41 C8; PM 75.0: .. 00 00 42 96."""
    assert float_words(25.0) == [0x0000, 0x41C8]
    assert float_words(75.0) == [0x0000, 0x4296]


def test_the_generic_map_shows_every_kind_of_entry_and_loads():
    register_map = load_register_map(find_packaged("registers", "generic-modbus"))
    assert [len(command.steps) for command in register_map.commands.values()] == [1, 2]


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        ({"address": 1}, "a command is `address` and `value`, or `writes`"),
        ({"writes": [], "confirm": {"point": "status", "bit": "running"}}, "a command is `address`"),
        ({"confirm": {"point": "status"}}, "confirmed by a bit, or by what its point equals"),
        ({"confirm": {"point": "none", "equals": 1}}, "no point none"),
    ],
)
def test_a_command_that_is_none_is_refused(change: dict[str, object], complaint: str):
    data = yaml.safe_load(find_packaged("registers", "generic-modbus").read_text())
    data["commands"]["stop"] |= change
    with pytest.raises(ConfigError, match=complaint):
        parse_document(yaml.safe_dump(data), RegisterMap, "generic")


async def test_what_confirms_a_command_has_to_be_read_at_each_poll(tmp_path: Path):
    data = yaml.safe_load(find_packaged("registers", "watlow-f4t").read_text())
    del data["points"]["mode"]["poll"]
    bench = Bench("watlow-f4t")
    with pytest.raises(ConfigError, match=r"mode, .* needs poll: fast"):
        async with driven(bench, parse_document(yaml.safe_dump(data), RegisterMap, "f4t")):
            pass
