"""The queue is worked with runs that do as they are asked."""

import asyncio
import fcntl
import signal
import sys
from pathlib import Path

import pytest

from tests import fork_server
from tests.stand.killed_queue import work
from thermostand.foundation.clock import FollowedClock
from thermostand.foundation.errors import DeviceFault, InUse, SessionError, StandTripped, Unreachable
from thermostand.stand.running.opening.stop import Interrupted
from thermostand.stand.running.order import load_order
from thermostand.stand.service import queue
from thermostand.stand.service.queue_file import QueueEntry, lock_worker
from thermostand.stand.service.queue_worker import MOST_FRUITLESS_STARTS, Halt, RunNotes, Stopped

ORDER = load_order("warm-up", "simulated")


class Runs:
    """Run functions whose ends are given: a sentence of `raises` for each run, None for one that goes well."""

    def __init__(self, directory: Path, *ends: BaseException | None, session_first: bool = True) -> None:
        self.directory = directory
        self.ends = list(ends)
        self.session_first = session_first
        self.lines: list[str] = []
        self.seen: list[tuple[int, str]] = []
        for _ in ends:
            queue.append(directory, queue.make_entry(ORDER, "simulated", 1))

    async def run(self, entry: QueueEntry, notes: RunNotes) -> Path:
        self.seen.append((entry.id, entry.session))
        session = self.directory / f"session-{entry.id}"
        if self.session_first:
            await notes.begun(session)
        await asyncio.sleep(0)
        end = self.ends.pop(0)
        if end is not None:
            raise end
        return session

    async def work(self) -> None:
        await work(self.directory, self.run, FollowedClock(7), self.lines.append)

    def entries(self) -> list[tuple[str, str, str]]:
        return [(entry.state, entry.session, entry.reason) for entry in queue.load_queue(self.directory).entries]


async def test_all_that_is_queued_is_run_in_turn(tmp_path: Path):
    runs = Runs(tmp_path, None, None)
    queue.move(tmp_path, 2, 1)
    await runs.work()
    assert runs.seen == [(2, ""), (1, "")]
    assert runs.entries() == [("done", "session-2", ""), ("done", "session-1", "")]
    assert runs.lines[:2] == ["run 2 (warm-up) begins", "run 2 (warm-up) done"]
    assert queue.load_queue(tmp_path).entries[0].ended_ns == 7
    await runs.work()  # nothing is left


async def test_what_is_added_while_a_run_is_under_way_has_its_turn(tmp_path: Path):
    runs = Runs(tmp_path, None)

    async def run(entry: QueueEntry, notes: RunNotes) -> Path:
        if entry.id == 1:
            queue.append(tmp_path, queue.make_entry(ORDER, "simulated", 1))
        return tmp_path / str(entry.id)

    await work(tmp_path, run, FollowedClock(7), runs.lines.append)
    assert [entry[0] for entry in runs.entries()] == ["done", "done"]


@pytest.mark.parametrize("session_first", [False, True])
async def test_a_stand_that_another_run_has_ends_the_work_and_fails_no_run(tmp_path: Path, session_first: bool):
    """Nothing was touched, so nobody has to look: the next start tries again."""
    runs = Runs(tmp_path, InUse("bus", "is by session night (pid 7)"), None, session_first=session_first)
    with pytest.raises(InUse, match="by session night"):
        await runs.work()
    assert [entry[0] for entry in runs.entries()] == ["interrupted", "waiting"]
    assert queue.load_queue(tmp_path).halted == ""
    runs.ends.append(None)
    await runs.work()
    assert [entry[0] for entry in runs.entries()] == ["done", "done"]


@pytest.mark.parametrize("error", [SessionError("5 frames were lost"), DeviceFault("linear", "jammed")])
async def test_a_run_that_fails_does_not_keep_the_next_from_its_turn(tmp_path: Path, error: Exception):
    runs = Runs(tmp_path, error, None)
    await runs.work()
    assert runs.entries() == [("failed", "session-1", str(error)), ("done", "session-2", "")]


@pytest.mark.parametrize(
    "error", [StandTripped("air is too warm"), Halt("x; NOT SAFE: relays"), ZeroDivisionError("a mistake")]
)
async def test_a_trip_halts_the_queue_until_an_operator_clears_it(tmp_path: Path, error: Exception):
    runs = Runs(tmp_path, error, None)
    with pytest.raises(type(error), match=str(error)):
        await runs.work()
    assert [entry[0] for entry in runs.entries()] == ["failed", "waiting"]
    with pytest.raises(StandTripped, match="halted: run 1: "):
        await runs.work()
    queue.reset(tmp_path)
    await runs.work()
    assert [entry[0] for entry in runs.entries()] == ["failed", "done"]


async def test_a_run_that_an_operator_ends_is_stopped_and_not_failed(tmp_path: Path):
    """The queue waits for an operator only where the run says so."""
    runs = Runs(tmp_path, Stopped("stopped by the operator", halts=False), Stopped("again", halts=True), None)
    with pytest.raises(Stopped, match="again"):
        await runs.work()
    assert [entry[0] for entry in runs.entries()] == ["stopped", "stopped", "waiting"]
    assert runs.entries()[0][2] == "stopped by the operator"
    assert queue.load_queue(tmp_path).halted == "run 2: again"
    queue.reset(tmp_path)
    await runs.work()
    assert [entry[0] for entry in runs.entries()] == ["stopped", "stopped", "done"]


async def test_a_stand_that_cannot_be_opened_does_not_use_up_the_queue(tmp_path: Path):
    runs = Runs(tmp_path, Unreachable("regulator", "no answer"), None, session_first=False)
    with pytest.raises(Unreachable):
        await runs.work()
    assert runs.entries() == [("failed", "", "regulator: no answer"), ("waiting", "", "")]
    assert queue.load_queue(tmp_path).halted == "run 1: regulator: no answer"


@pytest.mark.parametrize("error", [Interrupted("stopped; the stand is safe"), asyncio.CancelledError()])
async def test_a_run_that_an_operator_stops_is_resumed_first_next_time(tmp_path: Path, error: BaseException):
    runs = Runs(tmp_path, error, None, None)
    with pytest.raises(type(error)):
        await runs.work()
    assert [entry[0] for entry in runs.entries()] == ["interrupted", "waiting", "waiting"]
    queue.remove(tmp_path, 3)
    await runs.work()
    assert runs.seen == [(1, ""), (1, "session-1"), (2, "")]
    assert runs.lines[2] == "run 1 (warm-up) is resumed in session-1"
    assert [entry[0] for entry in runs.entries()] == ["done", "done"]


async def test_a_queue_that_cannot_be_noted_in_does_not_end_a_run(tmp_path: Path):
    runs = Runs(tmp_path, None)

    async def run(entry: QueueEntry, notes: RunNotes) -> Path:
        good = (tmp_path / "queue.json").read_bytes()
        (tmp_path / "queue.json").write_bytes(b"")
        await notes.begun(tmp_path / "cycle")
        (tmp_path / "queue.json").write_bytes(good)
        return tmp_path / "cycle"

    await work(tmp_path, run, FollowedClock(7), runs.lines.append)
    assert any("cannot be noted" in line for line in runs.lines)
    assert runs.entries() == [("done", "cycle", "")]


async def test_a_queue_that_cannot_be_reached_keeps_nobody_from_leaving(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """Its lock stands for a disk that hangs."""
    monkeypatch.setattr("thermostand.stand.service.queue_worker._NOTED_WITHIN_S", 0.1)
    runs = Runs(tmp_path, None)
    with (tmp_path / ".queue.lock").open("w") as lock:

        async def run(entry: QueueEntry, notes: RunNotes) -> Path:
            fcntl.flock(lock, fcntl.LOCK_EX)
            notes.step_done()
            raise Interrupted("stopped; the stand is safe")

        with pytest.raises(Interrupted):
            await work(tmp_path, run, FollowedClock(7), runs.lines.append)
    assert runs.lines[-1].endswith("not know it yet")
    assert runs.entries()[0][0] == "interrupted"


async def test_a_second_worker_is_refused(tmp_path: Path):
    runs = Runs(tmp_path, None)
    with lock_worker(tmp_path), pytest.raises(SessionError, match="running its queue"):
        await runs.work()


def worker_killed(directory: Path, steps_done: int) -> None:
    """A process that works the queue is killed when its run has finished so many steps."""
    command = [sys.executable, "-m", "tests.stand.killed_queue", str(directory), str(steps_done)]
    assert fork_server.run(command, timeout=60).returncode == -signal.SIGKILL


async def test_a_run_whose_daemon_dies_three_times_before_another_step_is_given_up(tmp_path: Path):
    runs = Runs(tmp_path, None)
    queue.append(tmp_path, queue.make_entry(ORDER, "simulated", 1))
    for steps_done in (0, 0, 2, 0, 0, 0):  # what the third has done begins the count again
        worker_killed(tmp_path, steps_done)
        assert runs.entries()[0] == ("interrupted", "cycle", "its daemon was killed")
    await runs.work()
    assert runs.seen == [(2, "")]
    failed, done = runs.entries()
    assert failed[:2] == ("failed", "cycle")
    assert "killed 3 times" in failed[2]
    assert f"`stand resume {tmp_path / 'cycle'}`" in failed[2]
    assert done == ("done", "session-2", "")
    assert runs.lines[0] == f"run 1 (warm-up) failed: {failed[2]}"


async def test_an_operator_may_stop_a_run_as_often_as_he_likes(tmp_path: Path):
    stops = [Interrupted("stopped; the stand is safe") for _ in range(MOST_FRUITLESS_STARTS + 1)]
    runs = Runs(tmp_path, *stops)
    for number in range(2, len(stops) + 1):
        queue.remove(tmp_path, number)
    for _ in stops:
        with pytest.raises(Interrupted):
            await runs.work()
    assert [entry[0] for entry in runs.entries()] == ["interrupted"]
