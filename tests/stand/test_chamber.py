"""The chamber's verbs over devices in memory: order of commands, permissions, limits; time is virtual."""

import asyncio

import pytest

from tests.stand.memory_devices import run_memory_stand, trip
from thermostand.foundation.clock import to_ns
from thermostand.foundation.errors import ConfigError, DeviceFault, GarbledReply, Occupied, StandTripped, Unreachable
from thermostand.foundation.readings import Reading
from thermostand.foundation.tasks import cancel_all
from thermostand.stand.chamber.chamber import ChamberOrder
from thermostand.stand.chamber.permits import HEATER
from thermostand.stand.safety.fault import Fault
from thermostand.stand.safety.interlock import Interlocked


async def test_heat_is_permitted_after_the_set_point_and_before_the_regulator_runs():
    async with run_memory_stand() as here:
        await here.stand.chamber.start(45.0)
        assert here.calls == ["regulator sp 45", f"relays {HEATER} held", "regulator run"]
        assert here.stand.chamber.permits.is_granted
        await here.stand.chamber.stop()
        assert here.calls[3:] == ["regulator stop", "relays make_safe"]
        assert not here.stand.chamber.permits.is_granted


async def test_what_was_ordered_is_known_while_the_regulator_does_not_answer_and_until_it_is_stopped():
    async with run_memory_stand() as here:
        chamber = here.stand.chamber
        await chamber.set_temperature(30.0)  # permits nothing
        assert chamber.ordered is None
        await chamber.start(45.0)
        first = chamber.ordered
        assert first == ChamberOrder(45.0, to_ns(2))  # the set-point is there after a second each
        here.regulator.failures.append(Unreachable("regulator", "its wire is gone"))
        with pytest.raises(Unreachable):
            await chamber.set_temperature(20.0)
        assert chamber.ordered == first
        await chamber.start(40.0)
        await chamber.set_temperature(50.0)
        assert chamber.ordered == ChamberOrder(50.0, first.since_ns)
        await chamber.stop()
        assert chamber.ordered is None
        await chamber.start(25.0)
        here.stand.safety.demand()
        assert chamber.ordered is None


async def test_a_regulator_that_does_not_run_leaves_no_permission_to_heat():
    async with run_memory_stand() as here:
        starting = asyncio.create_task(here.stand.chamber.start(45.0))
        await here.passes(1.5)
        here.regulator.failures.append(DeviceFault("regulator", "it gives heat unasked"))
        with pytest.raises(DeviceFault, match="it gives heat"):
            await starting
        assert here.relays.on == set()
        assert not here.stand.chamber.permits.is_granted


async def test_a_regulator_that_does_not_stop_does_not_keep_the_heaters_relay_on():
    async with run_memory_stand() as here:
        await here.stand.chamber.start(45.0)
        here.regulator.failures.append(DeviceFault("regulator", "it gives heat unasked"))
        with pytest.raises(DeviceFault, match="it gives heat"):
            await here.stand.chamber.stop()
        assert here.relays.on == set()


@pytest.mark.parametrize("setpoint_degC", [-10.1, 60.1, float("nan")])
async def test_a_set_point_outside_the_limits_reaches_no_device(setpoint_degC: float):
    async with run_memory_stand() as here:
        with pytest.raises(ConfigError, match=r"outside limits.chamber_degC -10.0..60.0"):
            await here.stand.chamber.start(setpoint_degC)
        assert here.calls == []


async def test_a_fault_between_set_point_and_permission_leaves_no_heat():
    async with run_memory_stand() as here:
        starting = asyncio.create_task(here.stand.chamber.start(45.0))
        await here.passes(0.5)
        trip(here.stand, Fault("air_hot", "the air is too hot"))
        with pytest.raises(StandTripped, match="too hot"):
            await starting
        assert here.calls == ["regulator sp 45"]
        assert here.relays.on == set()


async def test_an_interlock_while_the_relay_is_armed_keeps_the_regulator_from_running():
    async with run_memory_stand() as here:
        starting = asyncio.create_task(here.stand.chamber.start(45.0))
        await here.passes(1.5)
        here.stand.latch.trip(Fault("air_hot", "the air is too hot"))
        here.stand.latch.hold_gate()
        here.stand.safety.demand()
        with pytest.raises(Interlocked):
            await starting
        assert "regulator run" not in here.calls


async def test_a_regulator_that_is_autotuned_is_waited_for_and_that_is_an_event():
    async with run_memory_stand() as here:
        here.regulator.failures += [Occupied("regulator", "autotuning is active")] * 2
        await here.stand.chamber.set_temperature(30.0)
        assert here.clock.now_ns() / 1e9 == pytest.approx(3 + 2 * 5)
        assert here.kinds == ["regulator_occupied"]


async def test_a_stopped_regulator_that_gives_heat_fails_the_dead_mans_test():
    async with run_memory_stand() as here:
        here.regulator.mv_heat = 12.0
        with pytest.raises(DeviceFault, match="gives 12 % heat"):
            await here.stand.chamber.test_dead_man()
        assert here.calls == []


async def test_each_beat_shows_the_relays_to_who_watches_the_camera():
    async with run_memory_stand() as here:
        await here.stand.imaging.supply.switch_on()
        here.relays.on.clear()
        await here.stand.chamber.permit_renewer.renew_once()
        assert here.kinds == ["device_identity", "camera_supply_off", "camera_equilibrium_lost"]
        assert not here.stand.imaging.supply.is_on


def set_points(calls: list[str]) -> list[float]:
    return [float(call.split()[-1]) for call in calls if " sp " in call]


async def test_a_set_point_changes_no_faster_than_the_cameras_may():
    async with run_memory_stand(K_per_min=1.0) as here:
        began_ns = here.clock.now_ns()
        await here.stand.chamber.start(26.0)  # the air is at 24 degC
        assert set_points(here.calls) == [24.5, 25.0, 25.5, 26.0]
        assert here.calls.index("regulator run") < here.calls.index("regulator sp 25")
        assert (here.clock.now_ns() - began_ns) / 1e9 >= 3 * 30.0
        here.regulator.pv_degC = 25.9
        await here.stand.chamber.set_temperature(26.0)  # it is there
        assert set_points(here.calls)[4:] == [26.0]


@pytest.mark.parametrize("order", ["set_temperature", "stop"])
async def test_another_order_takes_over_from_a_set_point_on_its_way(order: str):
    async with run_memory_stand(K_per_min=1.0) as here:
        first = asyncio.create_task(here.stand.chamber.start(60.0))
        await here.passes(45.0)
        await (here.stand.chamber.stop() if order == "stop" else here.stand.chamber.set_temperature(23.0))
        reached = len(here.calls)
        await here.passes(300.0)
        assert here.calls[reached:] == []
        await first


async def test_a_set_point_on_its_way_goes_no_further_when_the_stand_trips():
    async with run_memory_stand(K_per_min=1.0) as here:
        walking = asyncio.create_task(here.stand.chamber.start(60.0))
        await here.passes(45.0)
        trip(here.stand, Fault("air_hot", "the air is too hot"))
        with pytest.raises(StandTripped, match="too hot"):
            await walking
        assert max(set_points(here.calls)) <= 25.5


async def test_permits_that_are_not_renewed_are_reported_once_for_each_reason():
    async with run_memory_stand() as here:
        keeper, clock = here.stand.chamber.permit_renewer, here.clock
        here.stand.chamber.permits.grant()
        here.relays.failures = [
            Unreachable("relays", "gone"),
            Unreachable("relays", "gone"),
            GarbledReply("relays", "x"),
        ]
        keeping = asyncio.create_task(keeper.run())
        await clock.sleep_until(clock.now_ns() + to_ns(10 * keeper.renew_s))
        await cancel_all([keeping])
        assert here.kinds.count("permit_not_renewed") == 2


@pytest.mark.parametrize("late_s", [(0.0, 1.5), (1.5, 0.0)])
async def test_a_board_that_does_not_rearm_is_refused_also_when_commands_reach_it_late(late_s: tuple[float, float]):
    """After the first one's time a second timed-on is a first one, which any board takes."""
    async with run_memory_stand() as here:
        until_ns, delays_s = 0, iter(late_s)

        async def hold_on(channel: str, duration_s: float) -> None:
            nonlocal until_ns
            await here.clock.sleep_until(here.clock.now_ns() + to_ns(next(delays_s, 0.0)))
            if here.clock.now_ns() >= until_ns:
                until_ns = here.clock.now_ns() + to_ns(duration_s)

        async def switch(channel: str, on: bool) -> None:
            nonlocal until_ns
            until_ns = 0

        async def read() -> tuple[Reading, ...]:
            now_ns = here.clock.now_ns()
            return (Reading(f"relays.{HEATER}", float(now_ns < until_ns), "1", now_ns),)

        here.relays.hold_on, here.relays.switch, here.relays.read = hold_on, switch, read
        with pytest.raises(DeviceFault, match="does not start"):
            await here.stand.chamber.test_dead_man()
        assert here.kinds.count("dead_man_late") == 1
