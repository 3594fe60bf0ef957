import asyncio

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.clock import NS_PER_S, FollowedClock, VirtualClock, WallClock, block_until, seconds_ns


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


async def test_the_simulator_is_told_before_the_sleeper_wakes():
    told: list[int] = []

    async def advance(time_ns: int) -> None:
        told.append(time_ns)

    clock = VirtualClock(0, advance)

    async def sleeper() -> None:
        await clock.sleep_until(3 * NS_PER_S)
        assert told == [3 * NS_PER_S]

    await driven(clock, sleeper())


async def test_a_cancelled_sleeper_does_not_move_time():
    clock = VirtualClock(0)
    task = asyncio.create_task(clock.sleep_until(NS_PER_S))
    await asyncio.sleep(0)
    task.cancel()
    await driven(clock, clock.sleep_until(2))
    assert clock.now_ns() == 2


@given(st.lists(st.integers(0, 50), min_size=1, max_size=20))
@settings(max_examples=30, deadline=None)
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
    await clock.sleep_until(before_ns + seconds_ns(0.001))
    assert clock.now_ns() >= before_ns + seconds_ns(0.001)
    await clock.sleep_until(0)  # a past deadline returns


def test_a_thread_waits_for_an_instant_but_never_for_virtual_time():
    clock = WallClock()
    due_ns = clock.now_ns() + seconds_ns(0.005)
    block_until(clock, due_ns)
    assert clock.now_ns() >= due_ns
    block_until(VirtualClock(5), 5)
    with pytest.raises(ValueError, match="virtual time does not pass"):
        block_until(VirtualClock(5), 6)


def test_a_followed_clock_refuses_to_go_back():
    clock = FollowedClock(10)
    clock.follow(20)
    assert clock.now_ns() == 20
    with pytest.raises(ValueError, match="cannot go back"):
        clock.follow(19)
