"""Thermometers of other makes over their wires: an ADAM-4015 on the bus, a reference thermometer, a hygrometer."""

from __future__ import annotations

from collections.abc import AsyncIterator
from pathlib import Path
from typing import Literal

import pytest

from thermostand.drivers.devices.probes import Probe, ProbeSettings
from thermostand.drivers.devices.thermometers import Calibration, Thermometers, ThermometerSettings
from thermostand.drivers.sim.physics.plant import Plant, PlantSpec
from thermostand.drivers.sim.units.modbus import TcpEngine
from thermostand.drivers.sim.units.probes import FakeProbe
from thermostand.drivers.sim.units.thermometers import FakeAdam4015
from thermostand.drivers.sim.wire import LinkFaults, PtyWire, TcpWire
from thermostand.drivers.wires.bus import Bus, BusSettings
from thermostand.drivers.wires.registers import load_register_map
from thermostand.foundation.clock import FollowedClock, WallClock
from thermostand.foundation.errors import DeviceFault, GarbledReply, Refused, Unreachable
from thermostand.foundation.readings import Quality, Reading

MAPS = Path(__file__).parents[2] / "configs" / "registers"
START_NS = 1_700_000_000_000_000_000


def plant() -> Plant:
    return Plant(PlantSpec(laboratory_swing_K=0.0, initial_degC=30.0), START_NS)


class AdamBench:
    """The module with three sensors and its driver."""

    def __init__(self) -> None:
        self.plant, clock = plant(), FollowedClock(START_NS)
        channels = {"air": 0, "granite_inside": 1, "laboratory": 5}
        self.fake = FakeAdam4015(self.plant, clock, 3, channels, seed=1)
        self.wire = TcpWire("127.0.0.1", 0, lambda: TcpEngine([self.fake]), LinkFaults())
        self.bus = Bus("bus", BusSettings(address=self.wire.address, timeout_s=0.2), WallClock())
        register_map = load_register_map(MAPS / "adam-4015.yaml").at_unit(3)
        settings = {name: ThermometerSettings(channel=number) for name, number in channels.items()}
        self.driver = Thermometers("thermometers", self.bus, register_map, settings, WallClock())

    async def read(self) -> dict[str, Reading]:
        return {each.channel.partition(".")[2]: each for each in await self.driver.read()}


@pytest.fixture
async def adam() -> AsyncIterator[AdamBench]:
    bench = AdamBench()
    await bench.bus.open()
    yield bench
    await bench.bus.close()
    bench.wire.close()


async def test_an_adam_4015_reads_its_places(adam: AdamBench):
    await adam.driver.open()
    found = await adam.read()
    assert found["air"].value == pytest.approx(adam.plant.air_degC, abs=0.02)
    assert found["laboratory"].value == pytest.approx(adam.plant.laboratory_degC, abs=0.02)
    adam.fake.open_channels, adam.fake.shorted_channels = {0}, {1}
    found = await adam.read()
    assert (found["air"].reason, found["granite_inside"].reason) == ("over range or open", "under range or shorted")
    assert found["laboratory"].quality is Quality.GOOD


async def test_an_adam_4015_of_another_range_or_name_is_refused(adam: AdamBench):
    adam.fake.type_codes[4] = 0x24
    with pytest.raises(DeviceFault, match="type_code_4"):
        await adam.driver.open()
    adam.fake.type_codes[4], adam.fake.name = 0x20, (0x40, 0x17)
    with pytest.raises(DeviceFault, match="name_low"):
        await adam.driver.open()


class ProbeBench:
    """An instrument on its wire and its driver."""

    def __init__(self, kind: Literal["hart", "vaisala"], folder: Path, serial: bool) -> None:
        self.plant = plant()
        self.fake = FakeProbe(self.plant, FollowedClock(START_NS), kind, "B71234", seed=1)
        self.faults = LinkFaults(seed=2)
        self.wire: PtyWire | TcpWire = (
            PtyWire(folder / kind, self.fake.engine(), self.faults)
            if serial
            else TcpWire("127.0.0.1", 0, self.fake.engine, self.faults)
        )
        calibration = Calibration(offset_K=0.5, certificate="T-9", uncertainty_K=0.012)
        settings = ProbeSettings(
            protocol=kind,
            address=self.wire.address,
            serial_number="B71234" if kind == "hart" else None,
            timeout_s=0.15,
            calibration=calibration,
        )
        self.driver = Probe("probe", settings, WallClock())


@pytest.fixture(params=[("hart", True), ("vaisala", False)], ids=["hart", "vaisala"])
async def probe(request: pytest.FixtureRequest, tmp_path: Path) -> AsyncIterator[ProbeBench]:
    kind, is_checked = request.param
    bench = ProbeBench(kind, tmp_path, is_checked)
    yield bench
    await bench.driver.close()
    bench.wire.close()


@pytest.mark.parametrize("echo", [False, True])
async def test_an_instrument_tells_what_it_is_and_what_it_measures(probe: ProbeBench, echo: bool):
    probe.fake.echo = echo
    await probe.driver.open()
    temperature, *others = await probe.driver.read()
    assert temperature.value == pytest.approx(probe.plant.laboratory_degC + 0.5, abs=0.06)
    if probe.driver.identity is not None and probe.driver.identity.serial_number:
        assert str(probe.driver.identity) == "HART 1504, serial number B71234, version 1.02"
    else:
        assert [(each.channel, each.unit, round(each.value)) for each in others] == [("probe.humidity", "%", 45)]


async def test_an_instrument_that_shows_no_number_measures_nothing(probe: ProbeBench):
    await probe.driver.open()
    probe.fake.failed = True
    assert {each.quality for each in await probe.driver.read()} == {Quality.BAD}


async def test_an_instrument_set_to_fahrenheit_is_refused(probe: ProbeBench):
    probe.fake.fahrenheit = True
    with pytest.raises(GarbledReply, match="not in degC"):
        await probe.driver.open()


async def test_an_instrument_that_falls_silent_is_lost_and_back_and_another_one_is_refused(probe: ProbeBench):
    await probe.driver.open()
    probe.fake.silent = True
    with pytest.raises(Unreachable):
        await probe.driver.read()
    probe.fake.silent = False
    assert (await probe.driver.read())[0].quality is Quality.GOOD
    if probe.driver.identity is None or not probe.driver.identity.serial_number:
        return
    probe.wire.close()
    with pytest.raises(Unreachable):
        await probe.driver.read()
    probe.fake.serial_number = "B99999"
    assert isinstance(probe.wire, PtyWire)
    probe.wire.plug()
    with pytest.raises(Refused, match="serial number B99999 answers, expected B71234"):
        await probe.driver.read()
