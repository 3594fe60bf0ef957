"""What the relays read is compared with what they were commanded: over the wire, with another master and brown-outs."""

import asyncio
from collections.abc import AsyncIterator, Callable
from typing import Any

import pytest

from tests.system.conftest import AS_INSTALLED
from tests.system.test_guard_wire import Bench, Start, bench_of, write_by_another_master
from thermostand.foundation.clock import to_ns
from thermostand.foundation.errors import DeviceFault, Unreachable
from thermostand.foundation.hub import Hub
from thermostand.stand.assembly.assemble import Assembly, assemble
from thermostand.stand.imaging.camera_recovery import CameraRecovery
from thermostand.stand.running.order import Order

POLLED = AS_INSTALLED

HEATER, COMPRESSOR = 0, 1  # coils
RELAYS, REGULATOR = 2, 1  # units
OFF, ON = 0x0000, 0xFF00


@pytest.fixture
async def bench(order: Callable[..., Order], simulator: Start) -> AsyncIterator[Bench]:
    async with bench_of(order(), simulator) as bench:
        yield bench


async def another_master(bench: Bench, unit: int, function: int, address: int, value: int) -> None:
    with bench.clock.hold():
        await asyncio.to_thread(write_by_another_master, bench.order, unit, function, address, value)


def kinds(bench: Bench, *wanted: str) -> list[str]:
    return [event.kind for event in bench.events if event.kind in wanted]


async def seconds_until(bench: Bench, quantity: str, value: float, limit_s: float) -> float:
    """How long the plant's quantity takes to read that, in steps of 0.5 s."""
    begin_ns = bench.clock.now_ns()
    while await bench.plant(quantity) != value:
        assert bench.clock.now_ns() - begin_ns < to_ns(limit_s), f"{quantity} is not {value} within {limit_s} s"
        await bench.wait(0.5)
    return (bench.clock.now_ns() - begin_ns) / 1e9


async def test_a_compressor_whose_relay_is_dropped_by_somebody_else_has_stopped_and_rests(bench: Bench):
    await bench.start(10, 320)
    assert await bench.plant("compressor_on") == 1
    for how in ("another master", "a brown-out"):
        if how == "another master":
            await another_master(bench, RELAYS, 5, COMPRESSOR, OFF)
        else:
            await bench.fault("relays.brown_out", True)
        assert await bench.plant("compressor_on") == 0
        assert await seconds_until(bench, "compressor_on", 1, 400) >= 300
        dropped = [event for event in bench.events if event.kind == "compressor_dropped"]
        assert dropped[-1].data["relay"] == "compressor"
        assert "before its time" in dropped[-1].text
        bench.events.clear()
        await bench.wait(60)
    await bench.end()


async def test_a_brown_out_of_the_board_drops_the_heater_and_it_is_permitted_again_and_reported(bench: Bench):
    await bench.start(26, 60)
    await bench.fault("relays.brown_out", True)
    await seconds_until(bench, "heater_enabled", 1, 10)
    assert kinds(bench, "heater_enable_dropped") == ["heater_enable_dropped"]
    await bench.end()


async def test_a_heater_relay_that_does_not_come_on_again_is_reported(bench: Bench):
    await bench.start(26, 60)
    await bench.fault("relays.lost_writes", True)
    await bench.fault("relays.brown_out", True)
    await bench.wait(14)
    assert kinds(bench, "heater_enable_dropped", "heater_enable_not_on")[:2] == [
        "heater_enable_dropped",
        "heater_enable_not_on",
    ]
    assert len(kinds(bench, "heater_enable_dropped")) == 1
    await bench.fault("relays.lost_writes", False)
    await bench.end()


async def test_heat_that_the_timer_of_a_silent_board_ends_is_known_as_ended_until_it_is_renewed(
    order: Callable[..., Order], simulator: Start
):
    async with bench_of(order(bus={"timeout_s": 0.05}), simulator) as bench:
        permits, begin_ns = bench.assembly.stand.chamber.permits, bench.clock.now_ns()
        await bench.start(26, 60)
        assert permits.ended_ns is None
        await bench.fault("relays.silent", True)
        await seconds_until(bench, "heater_enabled", 0, 20)
        await bench.wait(1)
        assert bench.trips == []
        assert permits.ended_ns is not None
        assert begin_ns + to_ns(60) < permits.ended_ns < bench.clock.now_ns()
        await bench.fault("relays.silent", False)
        await seconds_until(bench, "heater_enabled", 1, 20)
        assert permits.ended_ns is None


async def test_permits_that_are_renewed_in_time_are_never_taken_for_dropped(bench: Bench):
    await bench.start(10, 900)
    assert kinds(bench, "compressor_dropped", "heater_enable_dropped", "switched_off", "guard_late") == []
    assert await bench.plant("compressor_on") == 1
    await bench.end()


async def test_what_somebody_switches_on_in_a_hold_is_off_within_5_s_and_latched_when_it_comes_again(bench: Bench):
    await bench.start(26, 60)
    await bench.fault("regulator.set_point_degC", 45)
    while not bench.trips:
        await bench.wait(1)
    await bench.wait(10)
    bench.trips.clear()
    await another_master(bench, RELAYS, 5, HEATER, ON)
    assert await seconds_until(bench, "heater_enabled", 0, 20) <= 5
    (reported,) = [event for event in bench.events if event.kind == "switched_off"]
    assert (reported.level, reported.data["relay"]) == ("warning", "heater_enable")
    await another_master(bench, REGULATOR, 6, 0x0000, 0x0100)  # run
    await bench.wait(5.5)
    readings = {reading.channel: reading.value for reading in await bench.assembly.devices.regulator.read()}
    assert readings["regulator.running"] == 0
    assert len(kinds(bench, "switched_off")) == 2
    assert bench.assembly.stand.chamber.permits.intrusions == 2
    assert await bench.plant("heater_W") == 0
    await bench.end()


async def test_another_master_that_switches_heat_on_twice_without_permission_holds_the_run(bench: Bench):
    """Idle, before the chamber is started or after it was stopped; nothing else is wrong."""
    await bench.start(26, 60)
    await bench.assembly.stand.chamber.stop()
    for _ in range(2):
        assert bench.trips == []
        await another_master(bench, RELAYS, 5, COMPRESSOR, ON)
        assert await seconds_until(bench, "compressor_on", 0, 20) <= 5
        await bench.wait(5)
    assert [trip.rule for trip in bench.trips] == ["switched_on_without_permission"]
    await bench.end()


async def test_a_board_that_is_suited_passes_the_test_of_its_timer(bench: Bench):
    await bench.assembly.stand.chamber.permits.switch_off_left_on()
    await bench.assembly.stand.chamber.test_dead_man()
    (reported,) = [event for event in bench.events if event.kind == "dead_man_tested"]
    assert (reported.level, reported.data["rearmed"], reported.data["dropped"]) == ("info", True, True)
    assert await bench.plant("heater_enabled") == 0


@pytest.mark.parametrize(
    ("name", "reason"),
    [("relays.no_rearm", "does not start its time again"), ("relays.no_timer", "does not drop by itself")],
)
async def test_a_board_that_is_not_suited_is_refused_with_the_reason(bench: Bench, name: str, reason: str):
    await bench.fault(name, True)
    await bench.assembly.stand.chamber.permits.switch_off_left_on()
    with pytest.raises(DeviceFault, match=reason):
        await bench.assembly.stand.chamber.test_dead_man()
    assert await bench.plant("heater_enabled") == 0
    (reported,) = [event for event in bench.events if event.kind == "dead_man_tested"]
    assert reported.level == "error"


class SilentCamera:
    """Nobody answers at its address."""

    name = "camera"

    async def open(self) -> None:
        raise Unreachable(self.name, "no answer")


def with_exchanged_relays(bench: Bench) -> Assembly:
    """The same stand by a configuration in which heater and camera have each other's relay."""
    relays = bench.order.config.relays
    exchanged = {**relays.channels, "heater_enable": 2, "camera_power": 0}
    config = bench.order.config.model_copy(update={"relays": relays.model_copy(update={"channels": exchanged})})
    theirs = assemble(config, Hub(), bench.clock)
    camera: Any = SilentCamera()
    theirs.stand.imaging.supply.recovery = CameraRecovery(
        camera, theirs.hub, bench.clock, lambda: False, lambda why: None
    )
    return theirs


async def test_relays_exchanged_in_the_configuration_leave_the_heaters_relay_off(bench: Bench):
    """Taken for the camera's it is only held for some seconds at a time, and switched off when no camera answers."""
    theirs = with_exchanged_relays(bench)
    await theirs.bus.open()
    powering = asyncio.create_task(theirs.stand.imaging.supply.switch_on())
    await bench.wait(4.5)
    assert await bench.plant("heater_enabled") == 1
    with pytest.raises(Unreachable):
        await powering
    assert await bench.plant("heater_enabled") == 0
    await theirs.bus.close()


async def test_a_program_that_dies_while_it_powers_an_exchanged_relay_leaves_it_to_the_boards_timer(bench: Bench):
    theirs = with_exchanged_relays(bench)
    await theirs.bus.open()
    powering = asyncio.create_task(theirs.stand.imaging.supply.switch_on())
    await bench.wait(4.5)
    await theirs.bus.close()  # as for a dead program, nothing goes out any more
    assert await seconds_until(bench, "heater_enabled", 0, 30) <= 15
    powering.cancel()
    await asyncio.wait([powering])
