"""A run goes on although lines of its journal are damaged: the lines after them and the recording say the rest."""

import asyncio
import os
import shutil
import signal
from collections import Counter
from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest

from tests.journals import read_lines
from tests.system.resume_process import Daemon
from tests.system.test_resume import end_laboratory
from tests.system.test_run import at_step, fault, ignore
from tests.system.test_run_ends import SHORTER
from thermostand.foundation.errors import SessionError, StandTripped
from thermostand.foundation.items import StepState
from thermostand.recording.format.journal_lines import JOURNAL_NAME
from thermostand.recording.reading.run_status import Files, RunOutcome
from thermostand.recording.reading.scan import scan, verify
from thermostand.recording.reading.session import Session, open_whole
from thermostand.recording.repair.salvage import salvage_session
from thermostand.stand.running.memory.entries import Tripped
from thermostand.stand.running.order import Order
from thermostand.stand.running.resume import load_interruption
from thermostand.stand.service.run import Interrupted, resume, run_virtual


def flip(directory: Path, *numbers: int) -> int:
    """Flip a bit in these lines of the journal, from 0, or from its end; how many lines it has."""
    path = directory / JOURNAL_NAME
    lines = path.read_bytes().splitlines(keepends=True)
    for number in numbers:
        lines[number] = lines[number][:30] + bytes([lines[number][30] ^ 4]) + lines[number][31:]
    path.write_bytes(b"".join(lines))
    return len(lines)


async def test_a_stopped_run_goes_on_without_the_first_line_of_its_journal_and_others(
    tmp_path: Path, order: Callable[..., Order]
):
    ordered, out = order(SHORTER), tmp_path / "out"
    with pytest.raises(Interrupted):
        await run_virtual(ordered, out, 7, at_step("capture", lambda: os.kill(os.getpid(), signal.SIGINT)))
    (directory,) = out.iterdir()
    assert (scan(directory).run, verify(directory).files) == (RunOutcome.STOPPED, Files.SOUND)
    count = flip(directory, 0, 2, -1)
    assert (verify(directory).run, verify(directory).files) == (RunOutcome.STOPPED, Files.DAMAGED)
    before = await asyncio.to_thread(load_interruption, directory)
    assert before.seed == 7
    await resume(before, ignore)
    session, plan = Session.open(directory), tuple(ordered.recipe.plan())
    done = Counter(mark.step_id for mark in session.steps() if mark.state is StepState.DONE)
    assert done == Counter(planned.step_id for planned in plan)
    (damage,) = [event for event in session.events() if event.kind == "journal_damaged"]
    assert damage.text.startswith(f"journal.jsonl: line 1 and 2 more of {count} are damaged")
    assert len((directory / "journal.jsonl.damaged").read_bytes().splitlines()) == count
    assert (verify(directory).run, verify(directory).files) == (RunOutcome.COMPLETE, Files.DAMAGED)


async def test_a_run_whose_end_its_journal_has_lost_is_ended_by_the_recording(
    tmp_path: Path, order: Callable[..., Order]
):
    directory = await run_virtual(order(SHORTER), tmp_path / "out", None, ignore)
    assert (verify(directory).run, verify(directory).files) == (RunOutcome.COMPLETE, Files.SOUND)
    copy = Path(shutil.copytree(directory, tmp_path / "copy"))
    flip(copy, -1)
    assert (scan(copy).run, verify(copy).files) == (RunOutcome.COMPLETE, Files.DAMAGED)
    with pytest.raises(SessionError, match="its run is complete"):
        await asyncio.to_thread(load_interruption, copy)
    info = [event.data for event in Session.open(directory).events() if event.kind == "run.start"]
    assert [(data["steps"], data["frames"]) for data in info] == [
        (len(tuple(order(SHORTER).recipe.plan())), Session.open(directory).frame_count)
    ]


@pytest.mark.parametrize(("items", "kind"), [(1, "Frame"), (80, ""), (3, "StepMark")])
def test_a_killed_run_is_interrupted_and_once_salvaged_its_files_are_sound(
    tmp_path: Path, order: Callable[..., Order], items: int, kind: str
):
    ordered = order(SHORTER)
    daemon = Daemon(ordered, tmp_path / "out")
    assert daemon.lives_for(items, kind)
    daemon.kill()
    asyncio.run(end_laboratory(ordered))
    (directory,) = (tmp_path / "out").iterdir()
    assert (scan(directory).run, verify(directory).files) == (RunOutcome.INTERRUPTED, Files.INCOMPLETE)
    salvage_session(directory)
    found = verify(directory)
    assert (found.run, found.files) == (RunOutcome.INTERRUPTED, Files.SOUND), found.findings
    assert (scan(directory).run, scan(directory).files) == (found.run, found.files)
    assert all(hole.excused for hole in open_whole(directory).holes)


async def test_a_trip_that_the_journal_has_lost_still_wants_an_operator(tmp_path: Path, order: Callable[..., Order]):
    ordered, tasks = order(SHORTER, guard={"safe_limit_s": 5}), list[asyncio.Task[None]]()
    break_sensor = at_step("soak", lambda: tasks.append(asyncio.create_task(fault(ordered, "thermometer.open", "air"))))
    with pytest.raises(StandTripped):
        await run_virtual(ordered, tmp_path / "out", None, break_sensor)
    await asyncio.gather(*tasks)
    (directory,) = (tmp_path / "out").iterdir()
    assert (verify(directory).run, verify(directory).files) == (RunOutcome.TRIPPED, Files.SOUND)
    data = (directory / JOURNAL_NAME).read_bytes()
    entries = read_lines(data)[0]
    lines = data.splitlines(keepends=True)
    last = next(number for number, entry in enumerate(entries) if isinstance(entry, Tripped))
    copy = Path(shutil.copytree(directory, tmp_path / "copy"))
    (copy / JOURNAL_NAME).write_bytes(b"".join(lines[:last]))  # as a disk that has lost its last flushes
    with pytest.raises(SessionError, match=r"the stand tripped: .* then resume with --reset"):
        await asyncio.to_thread(load_interruption, copy)
    flip(directory, -1, *(number for number, entry in enumerate(entries) if isinstance(entry, Tripped)))
    assert (verify(directory).run, verify(directory).files) == (RunOutcome.TRIPPED, Files.DAMAGED)
    for _ in range(2):  # also when the last line has been cut off
        with pytest.raises(SessionError, match=r"the stand tripped: .* then resume with --reset"):
            await asyncio.to_thread(load_interruption, directory)
    before = await asyncio.to_thread(partial(load_interruption, directory, reset=True))
    assert before.state.tripped
    before.release()
