"""The flap driver against a fake controller behind pyusb and a TCP connection, on a USB bus that is sound and one that
is not; time is virtual."""

import asyncio
import threading
from collections.abc import AsyncIterator

import pytest

from thermostand.drivers.devices.motion.flap import Flap
from thermostand.drivers.sim.motion.flap import (
    ERROR_FEEDBACK_DISCONNECT,
    ERROR_HARD_OVER_CURRENT,
    ERROR_NO_POWER,
    ERROR_SOFT_OVER_CURRENT,
)
from thermostand.drivers.sim.usb import Stall, TimedOut, UsbServer
from thermostand.foundation.clock import WallClock
from thermostand.foundation.errors import DeviceError, DeviceFault, GarbledReply, Refused, Superseded, Unreachable
from thermostand.foundation.readings import Quality, Reading

from .flap_bench import (
    GET_RAM_SETTINGS,
    GET_VARIABLES,
    OTHER,
    OURS,
    SET_TARGET,
    SETTINGS,
    STOP_MOTOR,
    T0,
    Bench,
    running_bench,
)


@pytest.fixture
async def bench() -> AsyncIterator[Bench]:
    async with running_bench() as bench:
        yield bench


@pytest.fixture
async def flap(bench: Bench) -> Flap:
    await bench.flap.open()
    return bench.flap


# Opening and closing


async def test_it_opens_and_closes_and_confirms_each(bench: Bench, flap: Flap) -> None:
    """The whole way of 3000 counts takes 1 s; then come up to three looks, 0.05 s apart."""
    assert await bench.position() == Reading("flap.position", 0.0, "1", T0)
    await flap.move_open()
    assert bench.openness == 1
    assert bench.now_s == pytest.approx(1.1, abs=0.06)
    assert await bench.position() == Reading("flap.position", 1.0, "1", bench.clock.now_ns())
    await flap.move_closed()
    assert bench.openness == 0
    assert (await bench.position()).value == 0


async def test_where_it_is_already_it_is_confirmed_at_once(bench: Bench, flap: Flap) -> None:
    await flap.move_closed()
    assert bench.now_s == pytest.approx(0.15)


async def test_a_moving_flap_is_read_half_open_with_its_current(bench: Bench, flap: Flap) -> None:
    readings: list[Reading] = []

    async def look() -> None:
        readings.extend(await flap.read())

    await asyncio.gather(flap.move_open(), bench.after(0.5, look))
    assert [reading.value for reading in readings] == [pytest.approx(0.5, abs=0.001), 150]


async def test_the_flap_is_left_where_it_is_when_it_is_opened_and_closed_as_a_device(bench: Bench, flap: Flap) -> None:
    await flap.move_open()
    await flap.close()
    await flap.close()
    with pytest.raises(Unreachable, match=r"^flap: not open$"):
        await flap.read()
    await flap.open()
    assert (await bench.position()).value == 1


# Jams and errors of the drive


@pytest.mark.parametrize("max_duty", [600, 300])
@pytest.mark.parametrize("opening", [True, False])
async def test_a_jam_on_the_way_is_found_within_half_a_second_and_the_motor_stopped(
    bench: Bench, flap: Flap, max_duty: int, opening: bool
) -> None:
    """Reached after 0.5 s at full duty, 1 s at half; found 0.5 s later, to one look of 0.05 s."""
    if not opening:
        await flap.move_open()
    bench.set_max_duty(max_duty)
    bench.fake.jam_position = 2000
    begun_s = bench.now_s
    move = flap.move_open if opening else flap.move_closed
    with pytest.raises(DeviceFault, match=r"^flap: jammed at 2000 on the way to \d+; the motor is stopped$"):
        await move()
    assert bench.now_s - begun_s == pytest.approx(300 / max_duty + 0.5, abs=0.051)
    assert bench.fake.requests[-1] == (STOP_MOTOR, 0)
    assert (await flap.read())[1].value == 0
    bench.fake.jam_position = None
    await move()
    assert bench.openness == opening


async def test_a_jam_from_the_start_is_found_after_half_a_second(bench: Bench, flap: Flap) -> None:
    bench.fake.jam_position = 500
    with pytest.raises(DeviceFault, match="jammed at 500"):
        await flap.move_open()
    assert bench.now_s == pytest.approx(0.5, abs=1e-6)
    await flap.make_safe()


async def test_a_jam_within_the_tolerance_is_good_enough(bench: Bench, flap: Flap) -> None:
    bench.fake.jam_position = 3465
    await flap.move_open()
    assert (await bench.position()).value == pytest.approx(1.0, abs=0.02)


async def test_a_flap_too_slow_for_its_time_is_stopped(bench: Bench, flap: Flap) -> None:
    bench.set_max_duty(100)  # 6 s for the whole way
    with pytest.raises(DeviceFault, match="not at 3500, after 5 s"):
        await flap.move_open()
    assert bench.now_s == pytest.approx(5.05, abs=0.051)
    assert 0.7 < bench.openness < 0.9


async def test_a_jam_that_cannot_be_stopped_says_both(bench: Bench, flap: Flap) -> None:
    bench.fake.jam_position = 2000
    bench.fake.failures = [(STOP_MOTOR, TimedOut()), (STOP_MOTOR, TimedOut())]
    with pytest.raises(DeviceFault, match=r"jammed at 2000 .*\(flap: USB: "):
        await flap.move_open()


ERRORS = [
    (ERROR_NO_POWER, "no power"),
    (ERROR_SOFT_OVER_CURRENT, "soft over-current"),
    (ERROR_HARD_OVER_CURRENT, "hard over-current"),
    (ERROR_NO_POWER | ERROR_SOFT_OVER_CURRENT, "no power, soft over-current"),
]


@pytest.mark.parametrize(("bits", "names"), ERRORS)
async def test_an_error_of_the_drive_ends_the_move_and_stays_in_the_readings(
    bench: Bench, flap: Flap, bits: int, names: str
) -> None:
    def strike() -> None:
        bench.fake.active_errors = bits

    with pytest.raises(DeviceFault, match=f"^flap: the motor stopped: {names}$"):
        await asyncio.gather(flap.move_open(), bench.after(0.5, strike))
    position = await bench.position()
    assert (position.quality, position.value) == (Quality.STALE, pytest.approx(0.5, abs=0.001))
    assert position.reason.endswith(names)
    with pytest.raises(DeviceFault, match=names):
        await flap.make_safe()


@pytest.mark.parametrize(("bits", "names"), ERRORS)
async def test_when_the_cause_is_gone_the_flap_closes_though_the_error_is_latched(
    bench: Bench, flap: Flap, bits: int, names: str
) -> None:
    await flap.move_open()
    bench.fake.active_errors = bits
    bench.fake.active_errors = 0
    assert (await bench.position()).reason.endswith(names)
    await flap.make_safe()
    assert bench.openness == 0
    assert (await bench.position()).quality is Quality.GOOD


async def test_a_disconnected_feedback_is_a_bad_reading_and_ends_the_move(bench: Bench, flap: Flap) -> None:
    def cut() -> None:
        bench.fake.active_errors = ERROR_FEEDBACK_DISCONNECT

    with pytest.raises(DeviceFault, match="feedback disconnect"):
        await asyncio.gather(flap.move_open(), bench.after(0.5, cut))
    position = await bench.position()
    assert (position.quality, position.reason) == (Quality.BAD, "feedback disconnect")
    bench.fake.active_errors = 0
    await flap.move_closed()
    assert (await bench.position()).value == 0


async def test_old_errors_are_cleared_only_after_the_new_target_is_set(bench: Bench, flap: Flap) -> None:
    """Else the motor would start towards the old one."""
    await flap.move_open()
    bench.fake.requests.clear()
    await flap.move_closed()
    target, clearing = bench.fake.requests.index((SET_TARGET, 500)), bench.fake.requests.index((GET_VARIABLES, 1))
    assert target < clearing


# The controller restarts, or is set otherwise


async def test_a_restart_while_open_shows_in_the_readings_and_closing_works(bench: Bench, flap: Flap) -> None:
    assert (await bench.position()).quality is Quality.GOOD  # awaiting a command is normal before the first one
    await flap.move_open()
    bench.fake.restart()
    position = await bench.position()
    assert (position.value, position.quality) == (1.0, Quality.STALE)
    assert "awaiting command" in position.reason
    await flap.make_safe()
    assert bench.openness == 0
    assert (await bench.position()).quality is Quality.GOOD


async def test_a_restart_on_the_way_ends_the_move(bench: Bench, flap: Flap) -> None:
    with pytest.raises(DeviceFault, match="awaiting command"):
        await asyncio.gather(flap.move_open(), bench.after(0.5, bench.fake.restart))


async def test_a_wrong_input_mode_is_refused_when_opened(bench: Bench) -> None:
    bench.fake.input_mode = 1
    with pytest.raises(Refused, match=r"is 1, it must be 0 \(serial\)"):
        await bench.flap.open()


async def test_an_input_mode_changed_since_is_found_before_the_target_is_sent(bench: Bench, flap: Flap) -> None:
    bench.fake.input_mode = 2
    with pytest.raises(Refused, match="input mode is 2"):
        await flap.move_open()
    assert bench.fake.targets == []


# Safety


async def test_make_safe_closes(bench: Bench, flap: Flap) -> None:
    await flap.move_open()
    await flap.make_safe()
    assert bench.openness == 0


async def test_make_safe_turns_an_opening_flap_round(bench: Bench, flap: Flap) -> None:
    opening = asyncio.create_task(flap.move_open())
    await bench.after(0.5, flap.make_safe)
    assert bench.openness == 0
    with pytest.raises(Superseded, match=r"^flap: superseded"):
        await opening
    assert bench.fake.targets == [3500, 500]


async def test_a_target_that_somebody_else_has_sent_ends_the_move(bench: Bench, flap: Flap) -> None:
    def interfere() -> None:
        bench.fake.control_transfer(0x40, SET_TARGET, 700, 0, b"")

    with pytest.raises(DeviceFault, match="by someone else"):
        await asyncio.gather(flap.move_open(), bench.after(0.5, interfere))


async def test_closed_by_two_at_once_it_closes_for_both(bench: Bench, flap: Flap) -> None:
    """The run closes it after a frame while it is made safe."""
    await flap.move_open()
    await asyncio.gather(flap.move_closed(), bench.after(0.2, flap.make_safe), bench.after(0.4, flap.move_closed))
    assert bench.openness == 0
    assert bench.fake.requests.count((STOP_MOTOR, 0)) == 0


async def test_once_made_safe_it_is_not_opened_until_it_is_allowed_again(bench: Bench, flap: Flap) -> None:
    await flap.make_safe()
    with pytest.raises(Superseded, match="nothing was sent"):
        await flap.move_open()
    assert bench.fake.targets == [500]
    await flap.move_closed()
    flap.allow()
    await flap.move_open()
    assert bench.openness == 1


async def test_made_safe_while_its_settings_are_read_an_opening_sends_no_target(bench: Bench) -> None:
    """In real time: calls wait for each other in the lane's thread, and the stop comes before the target is sent."""
    flap = Flap("flap", SETTINGS, WallClock(), bench.backend)
    await flap.open()
    loop, made_safe, begun = asyncio.get_running_loop(), list[asyncio.Task[None]](), threading.Event()
    transfer = bench.fake.control_transfer

    def hold_back(kind: int, request: int, value: int, index: int, length_or_data: int | bytes) -> bytes:
        if request == GET_RAM_SETTINGS and not begun.is_set():
            loop.call_soon_threadsafe(lambda: made_safe.append(asyncio.ensure_future(flap.make_safe())))
            loop.call_soon_threadsafe(lambda: loop.call_soon(begun.set))
            begun.wait(10)
        return transfer(kind, request, value, index, length_or_data)

    bench.fake.control_transfer = hold_back
    with pytest.raises(Superseded):
        await flap.move_open()
    await made_safe[0]
    assert bench.fake.targets == [500]
    await flap.close()


# Time that passes unwatched


async def test_a_stop_that_comes_while_time_is_being_moved_is_no_jam(bench: Bench, flap: Flap) -> None:
    """A signal is served whenever it comes: here while the simulator is set to a time 2 s ahead. The flap, asked to
    close at that time, still stands open then, and has had no time to move."""
    await flap.move_open()
    await bench.act_while_time_moves(2.0, flap.make_safe)
    assert bench.openness == 0
    assert bench.fake.requests.count((STOP_MOTOR, 0)) == 0


async def test_make_safe_that_jams_is_a_fault_with_the_motor_stopped(bench: Bench, flap: Flap) -> None:
    await flap.move_open()
    bench.fake.jam_position = 1000
    with pytest.raises(DeviceFault, match="jammed at 1000"):
        await flap.make_safe()
    assert bench.fake.requests[-1] == (STOP_MOTOR, 0)


# A USB bus that loses, withholds and delays; and finding the right controller on it


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
