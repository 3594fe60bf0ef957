"""An E5CC that tunes itself, and its driver: no set-point is sent meanwhile, and its own constants hold afterwards."""

from __future__ import annotations

import pytest

from drivers.devices.regulators.regulator import Regulator
from drivers.sim.faults import LinkFaults
from drivers.sim.physics.plant import Plant, PlantSpec
from drivers.sim.units.modbus import TcpEngine
from drivers.sim.units.regulator import FakeRegulator
from drivers.sim.wire import TcpWire
from drivers.wires.bus import Bus, BusSettings
from drivers.wires.registers import load_register_map
from foundation.clock import FollowedClock, WallClock, seconds_ns
from foundation.errors import Occupied
from stand.config.stand_config import packaged

START_NS = 1_700_000_000_000_000_000
CONSTANTS = (0x2A00, 0x2A01, 0x2A02)  # proportional band, integral and derivative time of the heat


async def test_a_real_self_tuning_takes_no_set_point_ends_by_itself_and_holds_better_after_it():
    plant, clock = Plant(PlantSpec(laboratory_swing_K=0.0), START_NS), FollowedClock(START_NS)
    plant.heater_enabled = True
    fake = FakeRegulator(plant, clock, 1)
    wire = TcpWire("127.0.0.1", 0, lambda: TcpEngine([fake]), LinkFaults())
    bus = Bus("bus", BusSettings(address=wire.address, timeout_s=0.3), WallClock())
    await bus.open()
    regulator = Regulator("regulator", bus, load_register_map(packaged("registers", "omron-e5cc")), WallClock())

    def word(address: int) -> int:
        reply = fake.handle(bytes([3, *address.to_bytes(2, "big"), 0, 1])) or b""
        return int.from_bytes(reply[2:], "big")

    async def pass_s(duration_s: float) -> dict[str, float | str]:
        clock.follow(clock.now_ns() + seconds_ns(duration_s))
        found = {each.channel.removeprefix("regulator."): each for each in await regulator.read()}
        return {"pv": found["pv"].value, "mv_heat": found["mv_heat"].value, "fault": found["fault"].reason}

    try:
        await regulator.set_temperature(45.0)
        await regulator.run()
        await pass_s(3600)
        before = [word(address) for address in CONSTANTS]
        fake.press_autotune(on=True)
        looks = [await pass_s(5)]
        with pytest.raises(Occupied, match="autotuning is active; no set point was sent"):
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
    finally:
        await bus.close()
        wire.close()
