import asyncio
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.host import Host
from thermostand.foundation.clock import (
    NS_PER_S,
    FollowedClock,
    VirtualClock,
    WallClock,
    block_until,
    boot_time_ns,
    get_boot,
    to_ns,
)
from thermostand.foundation.errors import Unreachable


async def driven(clock: VirtualClock, *work: object) -> None:
    driver = asyncio.create_task(clock.run())
    try:
        await asyncio.gather(*work)  # type: ignore[arg-type]
    finally:
        driver.cancel()


async def test_virtual_time_jumps_to_each_sleeper_in_order():
    clock = VirtualClock(0)
    seen: list[tuple[str, int]] = []

    async def sleeper(name: str, time_ns: int) -> None:
        await clock.sleep_until(time_ns)
        seen.append((name, clock.now_ns()))

    await driven(clock, sleeper("late", 5 * NS_PER_S), sleeper("early", NS_PER_S), sleeper("middle", 2 * NS_PER_S))
    assert seen == [("early", NS_PER_S), ("middle", 2 * NS_PER_S), ("late", 5 * NS_PER_S)]


async def test_virtual_time_stands_still_while_it_is_held():
    clock = VirtualClock(0)
    release = asyncio.get_running_loop().create_future()
    times: list[int] = []

    async def holder() -> None:
        with clock.hold():
            await release
            times.append(clock.now_ns())

    async def sleeper() -> None:
        await clock.sleep_until(NS_PER_S)
        times.append(clock.now_ns())

    async def releaser() -> None:
        for _ in range(100):
            await asyncio.sleep(0)
        release.set_result(None)

    await driven(clock, holder(), sleeper(), releaser())
    assert times == [0, NS_PER_S]


async def test_a_chain_of_hand_overs_comes_to_rest_before_time_moves():
    clock = VirtualClock(0)
    queues: list[asyncio.Queue[int]] = [asyncio.Queue() for _ in range(51)]
    arrived: list[int] = []

    async def relay(source: asyncio.Queue[int], target: asyncio.Queue[int]) -> None:
        await target.put(await source.get())

    async def start() -> None:
        await clock.sleep_until(NS_PER_S)
        await queues[0].put(1)

    async def end() -> None:
        await queues[50].get()
        arrived.append(clock.now_ns())

    await driven(clock, start(), clock.sleep_until(2 * NS_PER_S), end(), *map(relay, queues, queues[1:]))
    assert arrived == [NS_PER_S]


async def test_time_stands_still_as_long_as_the_loop_has_anything_to_run():
    clock = VirtualClock(0)
    ended: list[int] = []

    async def busy() -> None:
        await clock.sleep_until(NS_PER_S)
        for _ in range(100):
            await asyncio.sleep(0)
        ended.append(clock.now_ns())

    await driven(clock, busy(), clock.sleep_until(2 * NS_PER_S))
    assert ended == [NS_PER_S]


async def test_the_simulator_gets_the_time_before_the_sleeper_wakes():
    reported: list[int] = []

    async def advance(time_ns: int) -> None:
        reported.append(time_ns)

    clock = VirtualClock(0, advance)

    async def sleeper() -> None:
        await clock.sleep_until(3 * NS_PER_S)
        assert reported == [3 * NS_PER_S]

    await driven(clock, sleeper())


async def test_a_cancelled_sleeper_does_not_move_time():
    clock = VirtualClock(0)
    task = asyncio.create_task(clock.sleep_until(NS_PER_S))
    await asyncio.sleep(0)
    task.cancel()
    await driven(clock, clock.sleep_until(2))
    assert clock.now_ns() == 2


@given(st.lists(st.integers(0, 50), min_size=1, max_size=20))
@settings(max_examples=30, deadline=None, derandomize=True)
def test_sleepers_with_any_deadlines_wake_sorted_and_ties_keep_their_order(deadlines: list[int]):
    async def run() -> list[tuple[int, int]]:
        clock = VirtualClock(0)
        woken: list[tuple[int, int]] = []

        async def sleeper(number: int, deadline: int) -> None:
            await clock.sleep_until(deadline)
            woken.append((deadline, number))

        await driven(clock, *(sleeper(number, deadline) for number, deadline in enumerate(deadlines)))
        return woken

    assert asyncio.run(run()) == sorted((deadline, number) for number, deadline in enumerate(deadlines))


async def test_the_wall_clock_never_goes_back_and_sleeps_to_a_deadline():
    clock = WallClock()
    before_ns = clock.now_ns()
    await clock.sleep_until(before_ns + to_ns(0.001))
    assert clock.now_ns() >= before_ns + to_ns(0.001)
    await clock.sleep_until(0)  # a past deadline returns


def test_a_thread_waits_for_an_instant_but_never_for_virtual_time():
    clock = WallClock()
    due_ns = clock.now_ns() + to_ns(0.005)
    block_until(clock, due_ns)
    assert clock.now_ns() >= due_ns
    block_until(VirtualClock(5), 5)
    with pytest.raises(ValueError, match="does not pass"):
        block_until(VirtualClock(5), 6)


def test_a_followed_clock_refuses_to_go_back():
    clock = FollowedClock(10)
    clock.follow(20)
    assert clock.now_ns() == 20
    with pytest.raises(ValueError, match="cannot go back"):
        clock.follow(19)


def test_the_time_of_a_suspend_has_passed_and_a_step_of_the_system_clock_has_not():
    host = Host()
    clock = host.clock()
    begin_ns = clock.now_ns()
    assert begin_ns == host.utc_ns()
    host.suspended_ns += to_ns(40)
    assert clock.now_ns() == host.utc_ns() == begin_ns + to_ns(40)
    assert (clock.suspended_ns(), clock.utc_offset_ns()) == (to_ns(40), 0)
    host.step(-3600)
    assert clock.now_ns() == begin_ns + to_ns(40)
    assert clock.utc_offset_ns() == to_ns(-3600)


def test_a_clock_begins_no_earlier_than_the_one_before_it_ended():
    host = Host()
    reached_ns = host.clock().now_ns()
    host.step(-3600)
    clock = host.clock(reached_ns + 1)
    assert clock.now_ns() == reached_ns + 1
    assert clock.utc_offset_ns() == to_ns(-3600) - 1
    host.step(7200)
    assert host.clock(reached_ns).utc_offset_ns() == 0


def test_an_instant_is_found_again_by_its_boot_time_whatever_the_system_clock_says():
    host = Host()
    before = host.clock()
    off_ns = before.boot.time_ns(before.now_ns())
    host.awake_ns += to_ns(23)
    host.step(3600)
    after = host.clock()
    assert after.boot.id == before.boot.id
    assert after.now_ns() - after.boot.stand_ns(off_ns) == to_ns(23)
    assert get_boot(after) is after.boot
    assert get_boot(VirtualClock(0)) is None


def test_a_process_that_is_kept_from_running_between_two_clocks_looks_again():
    host, late_ns = Host(), [0, 0, to_ns(5), 0, 0, 0]

    def utc_ns() -> int:
        host.awake_ns += late_ns.pop() if late_ns else 0  # stopped just before the system clock is read ...
        found_ns = host.utc_ns()
        host.awake_ns += late_ns.pop() if late_ns else 0  # ... or just after
        return found_ns

    clock = WallClock(0, host.boot_ns, utc_ns, lambda: host.awake_ns)
    assert clock.utc_offset_ns() == 0
    assert not late_ns


async def test_a_sleeper_is_late_by_no_more_than_a_second_after_a_suspend(monkeypatch: pytest.MonkeyPatch):
    """The event loop's timers stand still in a suspend: the second piece of this sleep is one."""
    host, pieces_s = Host(), []

    async def pass_awake(piece_s: float) -> None:
        pieces_s.append(piece_s)
        host.awake_ns += to_ns(piece_s)
        host.suspended_ns += to_ns(40) if len(pieces_s) == 3 else 0

    clock = host.clock()
    due_ns = clock.now_ns() + to_ns(30)
    monkeypatch.setattr("thermostand.foundation.clock.asyncio.sleep", pass_awake)
    await clock.sleep_until(due_ns)
    assert pieces_s == [0, 1, 1]
    assert clock.now_ns() == due_ns + to_ns(12)


def test_a_thread_that_waits_is_late_by_no_more_than_a_second_after_a_suspend(monkeypatch: pytest.MonkeyPatch):
    host, pieces_s = Host(), []

    def pass_awake(piece_s: float) -> None:
        pieces_s.append(piece_s)
        host.suspended_ns += to_ns(40)

    monkeypatch.setattr("thermostand.foundation.clock.time.sleep", pass_awake)
    clock = host.clock()
    block_until(clock, clock.now_ns() + to_ns(30))
    assert pieces_s == [1]


def test_boot_time_is_that_of_the_kernel():
    before_ns = boot_time_ns()
    uptime_ns = to_ns(float(Path("/proc/uptime").read_text().split()[0]))
    assert before_ns - to_ns(0.011) <= uptime_ns <= boot_time_ns()  # which is given to 10 ms


async def test_what_sleeps_is_woken_also_when_nobody_can_be_notified_of_the_time():
    """A run whose simulated laboratory has died ends, and what ends it sleeps."""

    async def advance(time_ns: int) -> None:
        raise Unreachable("simulator", "it is gone")

    clock = VirtualClock(0, advance)
    driver = asyncio.create_task(clock.run())
    async with asyncio.timeout(10):
        await clock.sleep_until(NS_PER_S)
        await clock.sleep_until(2 * NS_PER_S)
    assert clock.now_ns() == 2 * NS_PER_S
    with pytest.raises(Unreachable, match="it is gone"):
        await driver
