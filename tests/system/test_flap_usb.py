"""The flap driver on a USB bus that loses, withholds and delays; and finding the right controller on it."""

import asyncio
from collections.abc import AsyncIterator

import pytest

from thermostand.drivers.devices.motion.flap import Flap
from thermostand.drivers.sim.usb import Stall, TimedOut, UsbServer
from thermostand.foundation.errors import DeviceError, GarbledReply, Refused, Unreachable

from .flap_bench import GET_VARIABLES, OTHER, OURS, SET_TARGET, Bench, running_bench


@pytest.fixture
async def bench() -> AsyncIterator[Bench]:
    async with running_bench() as bench:
        yield bench


@pytest.fixture
async def flap(bench: Bench) -> Flap:
    await bench.flap.open()
    return bench.flap


@pytest.mark.parametrize("moment", ["at rest", "on the way"])
async def test_unplugged_and_plugged_in_again_it_is_found_by_its_serial_number(
    bench: Bench, flap: Flap, moment: str
) -> None:
    def unplug() -> None:
        bench.fake.unplugged = True

    if moment == "at rest":
        await flap.move_open()
        unplug()
    else:
        with pytest.raises(Unreachable, match=r"^flap: "):
            await asyncio.gather(flap.move_open(), bench.after(0.5, unplug))
    for _ in range(2):
        with pytest.raises(Unreachable, match=r"^flap: "):
            await flap.read()
    with pytest.raises(Unreachable, match=f"^flap: no Jrk G2 with serial number {OURS} is connected, only {OTHER}$"):
        await flap.make_safe()
    await bench.wait(1.0)  # the motor obeys its last target all the same
    bench.fake.unplugged = False
    assert (await bench.position()).value == 1
    await flap.make_safe()
    assert bench.openness == 0
    assert bench.other.targets == []


async def test_a_replug_between_two_calls_costs_one_reading(bench: Bench, flap: Flap) -> None:
    bench.fake.unplugged = True
    bench.fake.unplugged = False
    with pytest.raises(Unreachable, match="request 0xE5"):
        await flap.read()
    assert (await bench.position()).value == 0


async def test_a_replug_before_a_move_costs_nothing(bench: Bench, flap: Flap) -> None:
    bench.fake.unplugged = True
    bench.fake.unplugged = False
    await flap.move_open()
    assert bench.openness == 1


async def test_without_any_controller_it_says_none(bench: Bench) -> None:
    bench.fake.unplugged = bench.other.unplugged = True
    with pytest.raises(Unreachable, match=f"serial number {OURS} is connected"):
        await bench.flap.open()


async def test_another_controller_that_keeps_its_serial_number_to_itself_does_not_hide_ours(bench: Bench) -> None:
    del bench.other.strings[3]
    await bench.flap.open()
    await bench.flap.move_open()
    assert bench.fake.targets == [3500]
    bench.fake.unplugged = True
    for _ in range(2):
        with pytest.raises(Unreachable):
            await bench.flap.read()
    with pytest.raises(Unreachable, match="Pipe error"):
        await bench.flap.read()


async def test_another_controller_that_may_not_be_opened_does_not_hide_ours(bench: Bench) -> None:
    bench.backend.forbidden = {0}
    await bench.flap.open()
    await bench.flap.move_open()
    assert bench.fake.targets == [3500]


async def test_without_permission_it_is_refused_with_the_remedy(bench: Bench) -> None:
    bench.backend.forbidden = {1}
    with pytest.raises(Refused, match=r"^flap: no permission"):
        await bench.flap.open()
    bench.backend.forbidden = set()
    await bench.flap.open()


@pytest.mark.parametrize(
    ("fault", "error"), [("stall", Refused), ("timeout", Unreachable), ("short_read", GarbledReply)]
)
async def test_a_failing_transfer_has_its_own_error_and_the_next_read_recovers(
    bench: Bench, flap: Flap, fault: str, error: type[DeviceError]
) -> None:
    setattr(bench.fake, fault, True)
    for verb in (flap.read, flap.move_open, flap.read):
        with pytest.raises(error, match=r"^flap: "):
            await verb()
    assert bench.fake.targets == []
    setattr(bench.fake, fault, False)
    assert (await bench.position()).value == 0
    await flap.move_open()


async def test_a_read_cut_short_once_is_read_again(bench: Bench, flap: Flap) -> None:
    bench.fake.short = 1
    assert (await bench.position()).value == 0
    bench.fake.short = 2
    with pytest.raises(GarbledReply, match="request 0xE5 gave 52 of 53 bytes"):
        await flap.read()


@pytest.mark.parametrize("request_number", [0xEA, SET_TARGET, GET_VARIABLES])
async def test_a_target_that_timed_out_is_sent_once_more(bench: Bench, flap: Flap, request_number: int) -> None:
    bench.fake.failures = [(request_number, TimedOut())]
    await flap.move_open()
    assert bench.openness == 1
    bench.fake.requests.clear()
    bench.fake.failures = [(request_number, TimedOut()), (request_number, TimedOut())]
    with pytest.raises(Unreachable, match=f"request 0x{request_number:02X} failed"):
        await flap.move_closed()
    assert len(bench.fake.targets) <= 2


async def test_a_stalled_target_is_not_repeated(bench: Bench, flap: Flap) -> None:
    bench.fake.failures = [(SET_TARGET, Stall())]
    with pytest.raises(Refused, match="stalled request 0x84"):
        await flap.move_open()
    assert bench.fake.targets == [3500]


async def test_a_time_out_while_it_is_looked_for_leaves_no_unchecked_device_behind(bench: Bench) -> None:
    bench.fake.input_mode = 1
    bench.fake.failures = [(0xEA, TimedOut())]
    with pytest.raises(Unreachable):
        await bench.flap.open()
    with pytest.raises(Refused, match="input mode is 1"):
        await bench.flap.read()


async def test_a_simulator_that_was_gone_is_found_again(bench: Bench, flap: Flap) -> None:
    port = bench.server.port
    bench.server.close()
    for _ in range(2):
        with pytest.raises(Unreachable, match=r"^flap: "):
            await flap.read()
    bench.server = UsbServer("127.0.0.1", port, [bench.other, bench.fake])
    assert (await bench.position()).value == 0
