import asyncio
import threading

import pytest

from drivers.clock import Clock, VirtualClock, WallClock
from drivers.lane import Lane


@pytest.fixture(params=[WallClock(), VirtualClock(0)], ids=["real", "virtual"])
def lane(request: pytest.FixtureRequest) -> Lane:
    clock: Clock = request.param
    return Lane("test", clock)


async def test_a_lane_runs_calls_in_order_and_passes_exceptions_on(lane: Lane):
    order: list[int] = []
    await asyncio.gather(*(lane.call(order.append, number) for number in range(10)))
    assert order == list(range(10))
    with pytest.raises(ZeroDivisionError):
        await lane.call(lambda: 1 // 0)
    lane.close()
    lane.close()


async def test_real_time_keeps_the_loop_free_and_virtual_time_needs_no_thread():
    real, virtual = Lane("test", WallClock()), Lane("test", VirtualClock(0))
    assert await real.call(threading.get_ident) != threading.get_ident()
    assert await virtual.call(threading.get_ident) == threading.get_ident()
    real.close()


async def test_a_cancelled_caller_waits_until_its_call_has_ended():
    lane = Lane("test", WallClock())
    begun, release, ended = threading.Event(), threading.Event(), threading.Event()

    def transaction() -> None:
        begun.set()
        release.wait(5)
        ended.set()

    caller = asyncio.create_task(lane.call(transaction))
    await asyncio.to_thread(begun.wait, 5)
    caller.cancel()
    await asyncio.sleep(0)
    assert not caller.done()
    release.set()
    with pytest.raises(asyncio.CancelledError):
        await caller
    assert ended.is_set()
    lane.close()
