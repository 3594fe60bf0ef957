"""Flap, frames and the camera's supply over devices in memory; time is virtual."""

import asyncio
from typing import Any, cast

import pytest

from tests.stand.memory_devices import Camera, MemoryStand, run_memory_stand, trip
from thermostand.drivers.devices.relays import CAMERA_POWER
from thermostand.foundation.clock import NS_PER_S
from thermostand.foundation.errors import StandTripped, Unreachable
from thermostand.foundation.readings import Frame
from thermostand.stand.imaging.camera_recovery import LOST_LIMIT_S
from thermostand.stand.safety.fault import Fault
from thermostand.stand.safety.gate import CAMERA_LOST
from thermostand.stand.safety.interlock import Interlocked

HELD, ON, OFF = (f"relays {CAMERA_POWER} {how}" for how in ("held", "on", "off"))


def lost() -> Unreachable:
    return Unreachable("camera", "no answer")


async def with_camera(here: MemoryStand) -> None:
    await here.stand.imaging.supply.switch_on()
    here.calls.clear()
    here.items.clear()


async def test_a_frame_carries_the_step_that_asked_for_it():
    async with run_memory_stand() as here:
        await with_camera(here)
        assert await here.stand.imaging.take_frame(0.01, "capture-1")
        assert [frame.step_id for frame in here.frames] == ["capture-1"]


async def test_of_two_cameras_those_that_are_named_expose_and_no_other():
    async with run_memory_stand() as here:
        cast("dict[str, Any]", here.stand.devices.cameras)["side"] = Camera("side", here.clock, here.calls)
        await with_camera(here)
        assert await here.stand.imaging.take_frame(0.01, "capture-1", cameras=("side",))
        assert await here.stand.imaging.take_frame(0.01, "capture-2")
        assert [frame.channel for frame in here.frames] == ["side.image", "camera.image", "side.image"]


async def test_of_two_captures_one_after_the_other_each_is_exposed_at_an_instant_of_its_own():
    """A frame is found again by its instant."""
    async with run_memory_stand() as here:
        await with_camera(here)
        assert await here.stand.imaging.take_frame(8.0, "capture-1")
        assert await here.stand.imaging.take_frame(8.0, "capture-2")
        first, second = (frame.time_ns for frame in here.frames)
        assert second - first >= 4_000_000_000


async def test_a_lost_camera_holds_the_gate_until_it_is_open_and_gives_no_frame():
    async with run_memory_stand() as here:
        await with_camera(here)
        here.camera.failures += [lost()] * 3  # the frame, and two openings
        taking = asyncio.create_task(here.stand.imaging.take_frame(0.01, "capture-1"))
        await here.passes(3)
        assert here.stand.gate.reasons == {CAMERA_LOST}
        assert not await taking
        assert not here.stand.gate.reasons
        assert (here.frames, here.kinds) == ([], ["camera_lost", "camera_back"])


async def test_a_camera_that_opens_and_never_gives_a_frame_ends_the_run_after_half_an_hour_of_waiting(
    monkeypatch: pytest.MonkeyPatch,
):
    """In one hold of the gate, not in one for each try."""

    async def gives_none(*_: object) -> Frame:
        raise lost()

    async with run_memory_stand() as here:
        await with_camera(here)
        monkeypatch.setattr(here.camera, "grab", gives_none)
        assert not await here.stand.imaging.take_frame(0.01, "capture-1")
        begin_ns = here.clock.now_ns()
        with pytest.raises(Unreachable):
            await here.stand.imaging.take_frame(0.01, "capture-1")
        assert (here.clock.now_ns() - begin_ns) / NS_PER_S == pytest.approx(LOST_LIMIT_S, abs=15)
        assert here.kinds == ["camera_lost", "camera_back", "camera_lost"]


async def test_a_look_opens_the_flap_for_its_frame_only_also_when_the_camera_is_lost():
    async with run_memory_stand() as here:
        await with_camera(here)
        frame = await here.stand.imaging.look(0.01, "soak-1")
        assert frame is not None
        assert (here.calls, frame.step_id) == (["flap open", "camera grab", "flap closed"], "soak-1")
        here.camera.failures += [lost()]
        assert await here.stand.imaging.look(0.01, "soak-1") is None
        assert not here.stand.imaging.flap_open


async def test_after_a_trip_the_flap_closes_and_does_not_open():
    async with run_memory_stand() as here:
        trip(here.stand, Fault("air_hot", "the air is too hot"))
        with pytest.raises(StandTripped):
            await here.stand.imaging.open_flap()
        await here.stand.imaging.close_flap()
        assert here.calls == ["flap closed"]


async def test_a_supply_that_was_off_is_held_in_time_until_the_camera_answers():
    async with run_memory_stand() as here:
        await here.stand.imaging.supply.switch_on()
        assert here.calls == [HELD, "camera open", ON]
        assert (here.stand.imaging.supply.was_on, here.stand.imaging.supply.is_on) == (False, True)
        await here.stand.imaging.supply.switch_off()
        assert here.calls[3:] == ["camera close", OFF]
        assert not here.stand.imaging.supply.is_on


async def test_a_supply_that_was_on_is_never_interrupted():
    async with run_memory_stand() as here:
        here.relays.on.add(CAMERA_POWER)
        await here.stand.imaging.supply.switch_on()
        assert here.calls == [ON, "camera open"]
        assert here.stand.imaging.supply.was_on


async def test_a_camera_that_never_answers_leaves_its_relay_off():
    async with run_memory_stand() as here:
        here.camera.failures += [lost()] * 100
        with pytest.raises(Unreachable, match=r"relays\.camera_power was on") as lost_one:
            await here.stand.imaging.supply.switch_on()
        assert str(lost_one.value).endswith("if it is not")
        assert here.calls[-1] == OFF
        assert CAMERA_POWER not in here.relays.on


async def test_a_supply_that_dropped_is_restored_with_the_gate_held():
    async with run_memory_stand() as here:
        await with_camera(here)
        supply = here.stand.imaging.supply
        supply.compare({CAMERA_POWER: False})
        assert supply.equilibrium.is_lost
        here.relays.on.clear()
        restoring = asyncio.create_task(supply.restore())
        await here.passes(1)
        assert here.stand.gate.reasons == {CAMERA_LOST}
        await restoring
        assert (supply.is_on, here.stand.gate.reasons) == (True, frozenset())


async def test_a_supply_that_was_cut_goes_off_with_every_demand_and_is_confirmed():
    async with run_memory_stand() as here:
        await with_camera(here)
        here.stand.latch.trip(Fault("air_hot", "the air is too hot"))
        here.stand.latch.hold_gate()
        here.stand.cut_camera()
        assert not here.stand.imaging.supply.is_on
        assert await here.stand.safety.wait_until_confirmed(60)
        assert OFF in here.calls
        with pytest.raises(Interlocked):
            await here.stand.imaging.supply.switch_on()
        here.stand.cut_camera()
        assert await here.stand.safety.wait_until_confirmed(60)
        here.stand.latch.reset()
        here.stand.safety.cancel_pending()
        await here.stand.imaging.supply.switch_on()
        here.calls.clear()
        here.stand.safety.demand()
        assert await here.stand.safety.wait_until_confirmed(60)
        assert OFF not in here.calls, "an operator has looked: it is on again for good"
