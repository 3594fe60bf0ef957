"""A session that is killed again and again goes on each time where it was, in one session, over every wire."""

import asyncio
import random
import shutil
from collections import Counter
from collections.abc import Callable, Coroutine
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import pytest

from tests.daemon_queries import ask, ask_status
from tests.journals import lines_with, read_lines
from tests.system.conftest import SHORT_RECIPE
from tests.system.resume_process import Daemon
from tests.system.test_run import at_step, fault
from thermostand.experiments.steps import Capture
from thermostand.foundation.errors import SessionError, StandTripped, Unreachable
from thermostand.foundation.hub import Hub
from thermostand.foundation.items import StepState
from thermostand.recording.format.capture_restarts import find_restart_times, is_superseded
from thermostand.recording.format.messages import FRAME_META_CLASS
from thermostand.recording.reading.run_status import Files, RunOutcome
from thermostand.recording.reading.scan import scan, verify
from thermostand.recording.reading.session import Session
from thermostand.stand.assembly.simulator import ControlSocket
from thermostand.stand.running.memory.entries import Gap, Soaked, StepChanged
from thermostand.stand.running.memory.journal import JOURNAL_NAME
from thermostand.stand.running.order import Order
from thermostand.stand.running.resume import Interruption, load_interruption
from thermostand.stand.service.run import Interrupted, resume, run_virtual

RECIPE = SHORT_RECIPE.replace("600", "300").replace("frames_per_point: 1", "band_K: 0\n      frames_per_point: 6")
ONE_SET_POINT = RECIPE.replace("[30, 20, 24]", "[30]").replace("[20]", "[]")
ITEMS_PER_LIFE = 400  # about a set-point's worth: with fewer the session would hardly get on


async def end_laboratory(order: Order) -> None:
    """End what a daemon that was killed has left; it is gone when this returns."""
    simulation = order.config.simulation
    assert simulation is not None
    is_present = True
    while is_present:
        control = ControlSocket(simulation.control)
        try:
            await control.open()
        except Unreachable:
            is_present = False
        else:
            with suppress(Unreachable):  # it may be gone before it has answered
                await control.request({"do": "quit"})
        await control.close()


PV = "regulator.pv"


def findable(before: Interruption) -> Interruption:
    """The run with its laboratory at the configured addresses."""
    return replace(before, order=replace(before.order, at_configured_addresses=True))


def revived(order: Order, out: Path) -> Daemon:
    """The next daemon: it resumes the session, or begins one when none had begun."""
    sessions = [path.parent for path in out.glob(f"*/{JOURNAL_NAME}") if path.stat().st_size]
    if sessions:
        return Daemon(None, sessions[0])
    shutil.rmtree(out, ignore_errors=True)
    asyncio.run(end_laboratory(order))
    return Daemon(order, out)


def killed_and_resumed(order: Order, out: Path, lives: list[tuple[int, str]]) -> tuple[Path, list[int]]:
    """The session of a session whose daemons lived for so many items of a kind each, the last to the end; and the
    frames that were acknowledged at any time."""
    daemon, acknowledged = Daemon(order, out), list[int]()
    for items, kind in lives:
        if not daemon.lives_for(items, kind):
            break  # the session was shorter
        daemon.kill()
        acknowledged += daemon.acknowledged
        daemon = revived(order, out)
    assert daemon.wait() == 0
    (directory,) = out.iterdir()
    return directory, acknowledged + daemon.acknowledged


def check(directory: Path, order: Order, acknowledged: list[int]) -> Session:
    """One sound session with every step done once and every frame there, of which nothing is left to do."""
    session, plan = Session.open(directory), tuple(order.recipe.plan())
    assert (session.incomplete, session.damaged) == ((), ())
    found = verify(directory)
    assert (found.run, found.files) == (RunOutcome.COMPLETE, Files.SOUND), found.findings
    assert (scan(directory).run, scan(directory).files) == (found.run, found.files)
    assert [hole for hole in session.holes if not hole.excused] == []
    done = Counter(mark.step_id for mark in session.steps() if mark.state is StepState.DONE)
    assert done == Counter(planned.step_id for planned in plan)
    times_ns = set(session.frame_times_ns.tolist())
    assert set(acknowledged) <= times_ns
    begins_ns = find_restart_times(session.events())
    described = Counter(
        meta.step_id for meta in session.frame_metas() if not is_superseded(meta.time_ns, meta.step_id, begins_ns)
    )
    assert described == {p.step_id: p.step.frames for p in plan if isinstance(p.step, Capture)}
    found = verify(directory, lambda done, text: None)
    assert found.is_sound, found.findings
    with pytest.raises(SessionError, match="is complete"):
        load_interruption(directory)
    return session


def check_soaks(directory: Path, order: Order) -> None:
    """Each soak was earned in slices of at most a minute without a break since it was last begun again."""
    entries = read_lines((directory / JOURNAL_NAME).read_bytes())[0]
    durations_s = {p.step_id: getattr(p.step, "duration_s", 0.0) for p in order.recipe.plan()}
    soaked_s: dict[str, float] = {}
    for entry in entries:
        if isinstance(entry, Soaked):
            gained_s = entry.soaked_s - soaked_s.get(entry.step_id, 0.0)
            assert entry.soaked_s == 0.0 or 0.0 <= gained_s <= 60.0 + 1e-9
            soaked_s[entry.step_id] = entry.soaked_s
        if isinstance(entry, StepChanged) and entry.state == "done" and entry.step_id in soaked_s:
            assert soaked_s[entry.step_id] == durations_s[entry.step_id]
    assert soaked_s == {step_id: duration_s for step_id, duration_s in durations_s.items() if duration_s}


def test_a_session_killed_at_three_random_moments_is_one_whole_session(tmp_path: Path, order: Callable[..., Order]):
    ordered, rng = order(RECIPE), random.Random(3)
    lives = [(rng.randrange(1, ITEMS_PER_LIFE), "") for _ in range(3)]
    directory, acknowledged = killed_and_resumed(ordered, tmp_path / "out", lives)
    session = check(directory, ordered, acknowledged)
    check_soaks(directory, ordered)
    gaps = [entry for entry in read_lines((directory / JOURNAL_NAME).read_bytes())[0] if isinstance(entry, Gap)]
    assert len(gaps) == len([event for event in session.events() if event.kind == "gap"]) == 3
    for gap in gaps:
        assert not any(gap.from_ns < time_ns < gap.time_ns for time_ns in session.readings("regulator.pv")[0])


def test_a_capture_that_was_killed_is_completed_at_its_temperature(tmp_path: Path, order: Callable[..., Order]):
    """In the second capture, at 30 degC: the chamber that the next daemon finds has to soak again first."""
    ordered = order(ONE_SET_POINT)
    directory, acknowledged = killed_and_resumed(ordered, tmp_path / "out", [(2 + 3, "Frame")])
    session = check(directory, ordered, acknowledged)
    kinds = [event.kind for event in session.events()]
    assert kinds.index("gap") < kinds.index("run.resume") < kinds.index("soak_restarted") < kinds.index("restored")
    labels = {mark.step_id: mark.parameters.get("chamber_degC") for mark in session.steps() if mark.kind == "capture"}
    killed = [image for image in session.images() if labels.get(image.meta.step_id, 30) == 30]
    assert len(killed) >= 6
    for image in killed:  # what was read last stands in the frame itself: the telemetry of the killed one came later
        (pv,) = (each for each in FRAME_META_CLASS.FromString(image.description).readings if each.channel == PV)
        assert abs(pv.value - 30) <= 1.0


async def test_a_session_that_was_paused_stopped_and_tripped_goes_on_when_it_may(
    tmp_path: Path, order: Callable[..., Order]
):
    ordered, out = order(ONE_SET_POINT), tmp_path / "out"
    tasks: list[asyncio.Task[None]] = []

    async def pause_and_stop() -> None:
        (directory,) = out.iterdir()
        assert (await asyncio.to_thread(ask, directory, "pause"))["reasons"] == ["operator"]
        status = await asyncio.to_thread(ask_status, directory)
        assert (status.state, status.reasons, status.recipe, status.frames_lost) == ("held", ("operator",), "short", 0)
        with pytest.raises(SessionError, match="is running this session"):
            load_interruption(directory)
        assert (await asyncio.to_thread(ask, directory, "continue"))["reasons"] == []
        await asyncio.to_thread(ask, directory, "stop")

    def start(work: Callable[[], Coroutine[None, None, None]]) -> Callable[[Hub], None]:
        return at_step("soak", lambda: tasks.append(asyncio.create_task(work())))

    with pytest.raises(Interrupted, match="stopped by the operator"):
        await run_virtual(ordered, out, None, start(pause_and_stop))
    (directory,) = out.iterdir()
    kinds = [event.kind for event in Session.open(directory).events()]
    assert kinds.index("held") < kinds.index("released") < kinds.index("run.end")

    with pytest.raises(StandTripped, match=r"thermometers\.air is BAD"):
        await resume(findable(load_interruption(directory)), start(lambda: fault(ordered, "thermometer.open", "air")))
    with pytest.raises(SessionError, match=r"tripped: thermometers\.air is BAD.*resume with --reset"):
        load_interruption(directory)
    assert await resume(load_interruption(directory, reset=True), lambda hub: None) == directory
    await asyncio.gather(*tasks)
    session = check(directory, ordered, [])
    check_soaks(directory, ordered)
    ends = [event.text.split(":")[0] for event in session.events() if event.kind == "run.end"]
    assert ends == ["aborted", "aborted", "complete"]


def test_a_session_whose_files_or_journal_are_not_its_own_is_not_resumed(tmp_path: Path, order: Callable[..., Order]):
    ordered = order(RECIPE)
    daemon = Daemon(ordered, tmp_path / "out")
    assert daemon.lives_for(1, "StepMark")
    daemon.kill()
    (directory,) = (tmp_path / "out").iterdir()
    journal = directory / JOURNAL_NAME
    begun = read_lines(journal.read_bytes())[0][0]
    journal.write_bytes(lines_with([replace(begun, texts={**begun.texts, "recipe.yaml": "0"})]))
    with pytest.raises(SessionError, match="attached files"):
        load_interruption(directory)
    journal.write_bytes(lines_with([replace(begun, plan="0")]))
    with pytest.raises(SessionError, match="makes another plan"):
        load_interruption(directory)
    journal.write_bytes(b"")
    with pytest.raises(SessionError, match="had not begun"):
        load_interruption(directory)
    journal.unlink()
    with pytest.raises(SessionError, match="no journal"):
        load_interruption(directory)
    asyncio.run(end_laboratory(ordered))


@pytest.mark.nightly
def test_a_hundred_kills_at_random_moments_lose_nothing(tmp_path: Path, order: Callable[..., Order]):
    rng, kills = random.Random(100), 0
    for trial in range(100):
        ordered = order(RECIPE)
        lives = [(rng.randrange(1, ITEMS_PER_LIFE), "") for _ in range(min(4, 100 - kills))]
        directory, acknowledged = killed_and_resumed(ordered, tmp_path / f"{trial}", lives)
        session = check(directory, ordered, acknowledged)
        check_soaks(directory, ordered)
        kills += len([event for event in session.events() if event.kind == "gap"])
        shutil.rmtree(tmp_path / f"{trial}")
        if kills >= 100:
            return
    pytest.fail(f"only {kills} kills")
