"""Moves of the stages over a stage in memory: homing, faults in between, and the approach before frames."""

import asyncio

import pytest

from tests.stand.memory_devices import run_memory_stand, trip
from thermostand.foundation.errors import ConfigError, StandTripped, Unreachable
from thermostand.stand.safety.fault import Fault


async def test_a_stage_without_its_scale_is_homed_first():
    async with run_memory_stand() as here:
        here.linear.has_scale = False
        moving = asyncio.create_task(here.stand.table.move_to("linear", 25.0))
        await here.passes(0.5)
        assert here.stand.motions.texts == ["linear homing, then to 25 mm"]
        await moving
        assert (here.calls, here.stand.motions.texts) == (["linear home", "linear to 25"], [])


async def test_an_order_to_a_stage_that_is_under_way_takes_its_place_and_nothing_is_left_moving():
    async with run_memory_stand() as here:
        here.linear.has_scale = False
        first = asyncio.create_task(here.stand.table.move_to("linear", 25.0))
        await here.passes(0.5)
        second = asyncio.create_task(here.stand.table.move_to("linear", 30.0))
        await here.passes(0.1)
        assert here.stand.motions.texts == ["linear homing, then to 30 mm"]
        await asyncio.gather(first, second)
        assert (here.stand.motions.texts, here.stand.motions.names) == ([], ())


async def test_a_fault_while_a_stage_homes_keeps_it_from_the_move():
    async with run_memory_stand() as here:
        here.linear.has_scale = False
        moving = asyncio.create_task(here.stand.table.move_to("linear", 25.0))
        await here.passes(0.5)
        trip(here.stand, Fault("door", "the door is open"))
        with pytest.raises(StandTripped):
            await moving
        assert here.calls == ["linear home"]


async def test_an_axis_that_the_stand_has_not_is_named_with_those_it_has():
    async with run_memory_stand() as here:
        with pytest.raises(ConfigError, match=r"axis rotary, .* has linear$"):
            await here.stand.table.move_to("rotary", 1.0)


async def test_a_home_check_goes_back_to_where_the_plan_put_the_stage():
    async with run_memory_stand() as here:
        await here.stand.table.check_home("linear")
        assert here.calls == ["linear home"]
        await here.stand.table.move_to("linear", 25.0)
        await here.stand.table.check_home("linear")
        assert here.calls == ["linear home", "linear to 25", "linear home", "linear to 25"]
        assert here.kinds == ["home_residual", "home_residual"]


async def test_before_frames_a_stage_without_current_is_approached_again_and_one_whose_move_failed_is_left():
    async with run_memory_stand() as here:
        await here.stand.table.move_to("linear", 25.0)
        await here.stand.table.approach_again()
        here.linear.reason = "motor without current"
        await here.stand.table.approach_again()
        assert here.calls == ["linear to 25", "linear to 25"]
        here.linear.failures.append(Unreachable("linear", "no answer"))
        with pytest.raises(Unreachable):
            await here.stand.table.move_to("linear", 30.0)
        await here.stand.table.approach_again()
        assert here.calls[2:] == ["linear to 30"]
