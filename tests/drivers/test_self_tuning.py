"""The simulated E5CC and its driver: it tunes itself, and goes elsewhere than to the set-point that was written."""

from __future__ import annotations

from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager

import pytest

from thermostand.drivers.devices.regulators.regulator import Regulator
from thermostand.drivers.sim.physics.plant import Plant, PlantSpec
from thermostand.drivers.sim.units.modbus import TcpEngine
from thermostand.drivers.sim.units.regulator import FakeRegulator
from thermostand.drivers.sim.wire import LinkFaults, TcpWire
from thermostand.drivers.wires.bus import Bus, BusSettings
from thermostand.drivers.wires.registers import load_register_map
from thermostand.foundation.clock import FollowedClock, WallClock, to_ns
from thermostand.foundation.errors import DeviceFault, Occupied
from thermostand.stand.config.stand_config import find_packaged

START_NS = 1_700_000_000_000_000_000
CONSTANTS = (0x2A00, 0x2A01, 0x2A02)  # proportional band, integral and derivative time of the heat


@asynccontextmanager
async def driven() -> AsyncGenerator[tuple[Plant, FollowedClock, FakeRegulator, Regulator]]:
    plant, clock = Plant(PlantSpec(laboratory_swing_K=0.0), START_NS), FollowedClock(START_NS)
    plant.heater_enabled = True
    fake = FakeRegulator(plant, clock, 1)
    wire = TcpWire("127.0.0.1", 0, lambda: TcpEngine([fake]), LinkFaults())
    bus = Bus("bus", BusSettings(address=wire.address, timeout_s=0.3), WallClock())
    await bus.open()
    try:
        yield (
            plant,
            clock,
            fake,
            Regulator("regulator", bus, load_register_map(find_packaged("registers", "omron-e5cc")), WallClock()),
        )
    finally:
        await bus.close()
        wire.close()


@pytest.mark.parametrize(("name", "value"), [("acting_degC", 60.0), ("ramp_K_per_min", 0.5)])
async def test_a_set_point_that_is_not_the_internal_one_is_a_fault_and_is_stopped_before_it_heats(
    name: str, value: float
):
    async with driven() as (plant, clock, fake, regulator):
        await regulator.set_temperature(30.0)
        await regulator.run()
        clock.follow(clock.now_ns() + to_ns(3600))
        found = {each.channel: each for each in await regulator.read()}
        assert found["regulator.fault"].value == 0
        setattr(fake, name, value)
        await regulator.stop()
        await regulator.set_temperature(40.0)
        with pytest.raises(DeviceFault, match="another set-point acts"):
            await regulator.run()
        clock.follow(clock.now_ns() + to_ns(60))
        found = {each.channel: each for each in await regulator.read()}
        assert (found["regulator.running"].value, plant.heater_on_fraction) == (0, 0)


async def test_a_real_self_tuning_takes_no_set_point_ends_by_itself_and_holds_better_after_it():
    async with driven() as (_, clock, fake, regulator):

        def word(address: int) -> int:
            reply = fake.handle(bytes([3, *address.to_bytes(2, "big"), 0, 1])) or b""
            return int.from_bytes(reply[2:], "big")

        async def pass_s(duration_s: float) -> dict[str, float | str]:
            clock.follow(clock.now_ns() + to_ns(duration_s))
            found = {each.channel.removeprefix("regulator."): each for each in await regulator.read()}
            return {"pv": found["pv"].value, "mv_heat": found["mv_heat"].value, "fault": found["fault"].reason}

        await regulator.set_temperature(45.0)
        await regulator.run()
        await pass_s(3600)
        before = [word(address) for address in CONSTANTS]
        fake.press_autotune(on=True)
        looks = [await pass_s(5)]
        with pytest.raises(Occupied, match="autotuning is active"):
            await regulator.set_temperature(40.0)
        while looks[-1]["fault"] == "autotune" and len(looks) < 720:
            looks.append(await pass_s(5))
        assert looks[-1]["fault"] == ""  # it has ended by itself
        assert 24 < len(looks) < 720  # minutes, not hours
        assert {look["mv_heat"] for look in looks[:-1]} == {0.0, 100.0}
        after = [word(address) for address in CONSTANTS]
        assert all(new != old for new, old in zip(after, before, strict=True))
        assert after[1] == pytest.approx(4 * after[2], abs=4)  # integral and derivative time, of one period
        await regulator.set_temperature(44.0)
        await pass_s(3600)
        assert [abs(float((await pass_s(10))["pv"]) - 44.0) <= 0.2 for _ in range(30)] == [True] * 30
