"""The queue is worked with runs that do as they are told."""

import asyncio
from collections.abc import Callable
from pathlib import Path

import pytest

from drivers.clock import FollowedClock
from drivers.interface import DeviceFault, SessionError, StandTripped, Unreachable
from stand import queue
from stand.queue_file import Entry, working
from stand.queue_work import Halt, work
from stand.stop import Interrupted

ORDER = queue.load_order("warm-up", "simulated")


class Runs:
    """Run functions whose ends are given: a sentence of `raises` for each run, None for one that goes well."""

    def __init__(self, directory: Path, *ends: BaseException | None, session_first: bool = True) -> None:
        self.directory = directory
        self.ends = list(ends)
        self.session_first = session_first
        self.lines: list[str] = []
        self.seen: list[tuple[int, str]] = []
        for _ in ends:
            queue.add(directory, ORDER, "simulated", 1)

    async def run(self, entry: Entry, begun: Callable[[Path], None]) -> Path:
        self.seen.append((entry.id, entry.session))
        session = self.directory / f"session-{entry.id}"
        if self.session_first:
            begun(session)
        await asyncio.sleep(0)
        end = self.ends.pop(0)
        if end is not None:
            raise end
        return session

    async def work(self) -> None:
        await work(self.directory, self.run, FollowedClock(7), self.lines.append)

    def entries(self) -> list[tuple[str, str, str]]:
        return [(entry.state, entry.session, entry.reason) for entry in queue.queued(self.directory).entries]


async def test_all_that_is_queued_is_run_in_turn(tmp_path: Path):
    runs = Runs(tmp_path, None, None)
    queue.move(tmp_path, 2, 1)
    await runs.work()
    assert runs.seen == [(2, ""), (1, "")]
    assert runs.entries() == [("done", "session-2", ""), ("done", "session-1", "")]
    assert runs.lines[:2] == ["run 2 (warm-up) begins", "run 2 (warm-up) done"]
    assert queue.queued(tmp_path).entries[0].ended_ns == 7
    await runs.work()  # nothing is left


async def test_what_is_added_while_a_run_is_under_way_has_its_turn(tmp_path: Path):
    runs = Runs(tmp_path, None)

    async def run(entry: Entry, begun: Callable[[Path], None]) -> Path:
        if entry.id == 1:
            queue.add(tmp_path, ORDER, "simulated", 1)
        return tmp_path / str(entry.id)

    await work(tmp_path, run, FollowedClock(7), runs.lines.append)
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
    with pytest.raises(StandTripped, match="the queue was halted: run 1: "):
        await runs.work()
    queue.clear(tmp_path)
    await runs.work()
    assert [entry[0] for entry in runs.entries()] == ["failed", "done"]


async def test_a_stand_that_cannot_be_opened_does_not_use_up_the_queue(tmp_path: Path):
    runs = Runs(tmp_path, Unreachable("regulator", "no answer"), None, session_first=False)
    with pytest.raises(Unreachable):
        await runs.work()
    assert runs.entries() == [("failed", "", "regulator: no answer"), ("waiting", "", "")]
    assert queue.queued(tmp_path).halted == "run 1: regulator: no answer"


@pytest.mark.parametrize("error", [Interrupted("stopped; the stand is safe"), asyncio.CancelledError()])
async def test_a_run_that_an_operator_stops_is_resumed_first_next_time(tmp_path: Path, error: BaseException):
    runs = Runs(tmp_path, error, None, None)
    with pytest.raises(type(error)):
        await runs.work()
    assert [entry[0] for entry in runs.entries()] == ["interrupted", "waiting", "waiting"]
    queue.remove(tmp_path, 3)
    await runs.work()
    assert runs.seen == [(1, ""), (1, "session-1"), (2, "")]
    assert runs.lines[2] == "run 1 (warm-up) goes on in session-1"
    assert [entry[0] for entry in runs.entries()] == ["done", "done"]


async def test_a_queue_that_cannot_be_noted_in_does_not_end_a_run(tmp_path: Path):
    runs = Runs(tmp_path, None)

    async def run(entry: Entry, begun: Callable[[Path], None]) -> Path:
        good = (tmp_path / "queue.json").read_bytes()
        (tmp_path / "queue.json").write_bytes(b"")
        begun(tmp_path / "night")
        (tmp_path / "queue.json").write_bytes(good)
        return tmp_path / "night"

    await work(tmp_path, run, FollowedClock(7), runs.lines.append)
    assert any("cannot be noted" in line for line in runs.lines)
    assert runs.entries() == [("done", "night", "")]


async def test_a_second_worker_is_refused(tmp_path: Path):
    runs = Runs(tmp_path, None)
    with working(tmp_path), pytest.raises(SessionError, match="being worked already"):
        await runs.work()
