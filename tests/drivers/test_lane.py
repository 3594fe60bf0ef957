import asyncio
import importlib
import socket
import subprocess
import sys
import threading
from collections.abc import Callable

import pytest

from thermostand.foundation.clock import Clock, VirtualClock, WallClock
from thermostand.foundation.workers import WorkerConnection, WorkerThread, answer_all


@pytest.fixture(params=[WallClock(), VirtualClock(0)], ids=["real", "virtual"])
def lane(request: pytest.FixtureRequest) -> WorkerThread:
    clock: Clock = request.param
    return WorkerThread("test", clock)


async def test_a_lane_runs_calls_in_order_and_passes_exceptions_on(lane: WorkerThread):
    order: list[int] = []
    await asyncio.gather(*(lane.call(order.append, number) for number in range(10)))
    assert order == list(range(10))
    with pytest.raises(ZeroDivisionError):
        await lane.call(lambda: 1 // 0)
    lane.close()
    lane.close()


async def test_real_time_keeps_the_loop_free_and_virtual_time_needs_no_thread():
    real, virtual = WorkerThread("test", WallClock()), WorkerThread("test", VirtualClock(0))
    assert await real.call(threading.get_ident) != threading.get_ident()
    assert await virtual.call(threading.get_ident) == threading.get_ident()
    real.close()


async def test_a_cancelled_caller_waits_until_its_call_has_ended():
    lane = WorkerThread("test", WallClock())
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


async def test_where_nothing_bounds_a_call_its_caller_may_leave_and_the_call_goes_on():
    lane = WorkerThread("test", WallClock(), patient=False)
    begun, release, ended = threading.Event(), threading.Event(), threading.Event()

    def commit() -> None:
        begun.set()
        release.wait(5)
        ended.set()

    caller = asyncio.create_task(lane.call(commit))
    await asyncio.to_thread(begun.wait, 5)
    caller.cancel()
    with pytest.raises(asyncio.CancelledError):
        await caller
    waiting = asyncio.create_task(lane.call(int))
    await asyncio.sleep(0)
    lane.abandon()
    with pytest.raises(TimeoutError, match="test has not answered"):
        await waiting
    with pytest.raises(TimeoutError):
        await lane.call(int)
    assert not ended.is_set()
    release.set()
    assert await asyncio.to_thread(ended.wait, 5)


HANGS = """
import asyncio, threading
from thermostand.foundation.clock import WallClock
from thermostand.foundation.workers import WorkerThread, WorkerConnection, answer_all

async def main():
    asyncio.create_task(WorkerThread("hangs", WallClock(), patient=False).call(threading.Event().wait))
    await asyncio.sleep(0.05)

asyncio.run(main())
"""


def test_a_call_that_never_ends_does_not_keep_the_process_from_its_end():
    assert subprocess.run([sys.executable, "-c", HANGS], timeout=30, check=False).returncode == 0


async def test_a_thread_that_memory_does_not_suffice_for_fails_its_calls_and_the_loop_goes_on(
    monkeypatch: pytest.MonkeyPatch,
):
    monkeypatch.setattr("thermostand.foundation.workers._BEGIN_LIMIT_S", 0.01)
    monkeypatch.setattr("_thread.start_new_thread", lambda function, args: 0)  # it ends before its first step
    died = WorkerThread("disk", WallClock())
    with pytest.raises(MemoryError, match="the thread of disk"):
        await died.call(int)

    def refuse(function: object, args: object) -> int:
        raise RuntimeError("can't start new thread")

    monkeypatch.setattr("_thread.start_new_thread", refuse)
    with pytest.raises(MemoryError, match="no thread for bus"):
        await WorkerThread("bus", WallClock()).call(int)
    monkeypatch.undo()
    assert await died.call(int) == 0
    died.close()


class Moved:
    """Of a module that another version of the program has no more."""

    def __reduce__(self) -> tuple[Callable[[str], object], tuple[str]]:
        return importlib.import_module, ("thermostand.foundation.missing",)


def moved(_: object) -> Moved:
    return Moved()


@pytest.mark.parametrize(
    ("function", "argument", "why"),
    [
        (len, Moved(), "ModuleNotFoundError"),
        (memoryview, b"x", "TypeError: cannot pickle"),
        (moved, None, "ModuleNotFoundError"),
    ],
    ids=["request", "result", "answer"],
)
def test_what_cannot_be_handed_over_is_answered_and_the_line_lives(
    function: Callable[..., object], argument: object, why: str
):
    ours, theirs = socket.socketpair()
    serving = threading.Thread(target=answer_all, args=(theirs, {}), daemon=True)
    serving.start()
    line = WorkerConnection(ours, "the process has ended")
    with pytest.raises(OSError, match=f"another process failed .{why}"):
        line.run(function, argument)
    assert line.run(len, "abc") == 3
    line.close()
    serving.join(5)
    assert not serving.is_alive()
