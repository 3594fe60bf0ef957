"""A daemon that leaves while its disk hangs: what waits for the disk has one budget, and the waits do not add up."""

import asyncio
import os
import selectors
import signal
from collections.abc import Callable, Coroutine
from pathlib import Path
from typing import Any, cast

import pytest

from thermostand.foundation.clock import WallClock
from thermostand.foundation.errors import SessionError
from thermostand.foundation.hub import Hub
from thermostand.foundation.items import Event
from thermostand.foundation.shutdown_deadline import BUDGET_S, LEAST_S, ShutdownDeadline
from thermostand.recording.writing.disk import FILES_LINE, QUEUE_LINE, DiskCalls, DiskProcess
from thermostand.recording.writing.recorder import FINISH_WITHIN_S, Recorder, RecordingSettings, SessionInfo
from thermostand.stand.chamber.compressor import CompressorFile, CompressorState
from thermostand.stand.running.memory.entries import Begun, Ended
from thermostand.stand.running.memory.journal import Journal, Logbook
from thermostand.stand.running.memory.state import RunState
from thermostand.stand.running.opening.stop import STOPPED, Interrupted, Stop
from thermostand.stand.service.counters import CountersFile, StoredCounters
from thermostand.stand.service.queue import append
from thermostand.stand.service.queue_file import QueueEntry
from thermostand.stand.service.queue_worker import RunNotes, drain

INFO = SessionInfo("cycle-1", "warm_up", "DA1234567", "", "0.1.0", "wall")
SETTINGS = RecordingSettings("raw", stop_frames_below_bytes=0, alert_below_fraction=0.0)


class Jumping(selectors.DefaultSelector):
    """While `jumps`, nobody sleeps: time goes on by as much at once. What threads have ready comes first."""

    jumps = False
    ahead_s = 0.0

    def select(self, timeout: float | None = None) -> list[Any]:
        if not self.jumps or not timeout:
            return super().select(timeout)
        ready = super().select(0.02)
        if not ready:
            self.ahead_s += timeout
        return ready


class JumpingLoop(asyncio.SelectorEventLoop):
    def __init__(self) -> None:
        self.jumping = Jumping()
        super().__init__(self.jumping)

    def time(self) -> float:
        return self.jumping.ahead_s


def took_s(work: Callable[[Callable[[], None]], Coroutine[Any, Any, None]]) -> float:
    """Of the loop's seconds, from the moment on when `work` calls what it is given: then no disk answers."""
    with asyncio.Runner(loop_factory=JumpingLoop) as runner:
        loop = cast("JumpingLoop", runner.get_loop())

        def hung() -> None:
            loop.jumping.jumps = True

        runner.run(work(hung))
        return loop.time()


def test_waits_one_after_the_other_end_with_their_budget():
    async def leave(hung: Callable[[], None]) -> None:
        hung()
        deadline, never = ShutdownDeadline(3.0), asyncio.get_running_loop().create_future()
        deadline.begin()
        for _ in range(5):
            assert not await deadline.wait(never, 2.0)
        deadline.begin()  # begins once
        assert deadline.limit_s(9.0) == LEAST_S

    assert took_s(leave) == pytest.approx(3.0 + 3 * LEAST_S)  # 2 s, 1 s, and the least of three more


def test_a_wait_under_way_ends_with_a_budget_that_begins_later():
    async def leave(hung: Callable[[], None]) -> None:
        hung()
        loop = asyncio.get_running_loop()
        deadline, never = ShutdownDeadline(3.0), loop.create_future()
        assert not await deadline.wait(never, 1.0)  # no budget yet: its own limit
        loop.call_later(10.0, deadline.begin)
        assert not await deadline.wait(never, 60.0)

    assert took_s(leave) == pytest.approx(1.0 + 10.0 + 3.0)


def test_what_has_ended_is_not_waited_for():
    async def leave(hung: Callable[[], None]) -> None:
        hung()
        deadline, work = ShutdownDeadline(), asyncio.get_running_loop().create_future()
        work.set_result(None)
        assert await deadline.wait(work, 0.0)
        assert await deadline.wait(asyncio.ensure_future(asyncio.sleep(0.5)), 9.0)

    assert took_s(leave) == pytest.approx(0.5)


def test_what_a_daemon_leaves_on_a_hung_disk_takes_one_budget(tmp_path: Path):
    """Journal, session, queue, its own files and the processes that hang: in the order in which a daemon ends them."""

    async def leave(hung: Callable[[], None]) -> None:
        hub, clock, stop = Hub(), WallClock(), Stop(has_signals=False)
        disk, own = DiskProcess(), DiskProcess()
        recorder = Recorder(tmp_path / "cycle-1", INFO, {}, {}, hub, clock, settings=SETTINGS, disk=disk)
        await recorder.begin(tuple)
        recording = asyncio.create_task(recorder.run())
        log, journal = Logbook(hub, clock, RunState(())), Journal.create(recorder.directory)
        await log.begin(journal, Begun(clock.now_ns(), "cycle-1", "0f", {}), disk=disk)
        queue, reported = DiskCalls(own, QUEUE_LINE, clock), []
        entry = QueueEntry(id=1, recipe="r", config="c", config_text="", recipe_text="", target_text="", added_ns=1)
        await queue.call(append, tmp_path, entry)
        kept = CountersFile(tmp_path, own.line(FILES_LINE).run, hub, clock)
        compressor = CompressorFile(tmp_path / "compressor.json", hub, clock)
        compressor.delegate_to(own.line(FILES_LINE).run)

        async def run_one(_: QueueEntry, __: RunNotes) -> Path:
            for each in (disk, own):
                os.kill(each.pid, signal.SIGSTOP)
            hung()
            hub.publish(Event(clock.now_ns(), "info", "note", "the last"))
            compressor.note(CompressorState(running=False, since_ns=1))
            stop.reason = STOPPED
            stop.end()
            with pytest.raises(SessionError, match="not in the journal"):
                await log.end(Ended(0, "stopped", "stopped"), stop.shutdown_deadline)
            recording.cancel()
            with pytest.raises(SessionError, match="disk has not answered"):
                await recorder.finish(FINISH_WITHIN_S, stop.shutdown_deadline)
            assert not await disk.end_within(stop.shutdown_deadline)
            raise Interrupted("the daemon was ended")

        try:
            with pytest.raises(Interrupted):
                await drain(tmp_path, run_one, clock, reported.append, queue, stop.shutdown_deadline)
            kept.note(StoredCounters())
            await kept.close(stop.shutdown_deadline)
            await compressor.close(stop.shutdown_deadline)
            assert not await own.end_within(stop.shutdown_deadline)
        finally:
            for each in (disk, own):
                os.kill(each.pid, signal.SIGKILL)
        assert reported[-1].endswith("not know it yet")

    assert BUDGET_S <= took_s(leave) < BUDGET_S + 6 * LEAST_S
