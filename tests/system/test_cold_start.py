"""Warm-ups that are interrupted begin again from a cold camera; prompts that somebody attends to are waited for."""

import asyncio
import itertools
from collections import Counter
from collections.abc import Awaitable, Callable
from dataclasses import replace
from pathlib import Path

import pytest

from tests.daemon_queries import ask
from tests.system.conftest import AS_INSTALLED
from tests.system.resume_process import Daemon
from tests.system.test_guard_run import Watcher
from tests.system.test_resume import end_laboratory
from tests.system.test_run import fault
from thermostand.experiments.steps import Capture, PowerCamera, Prompt
from thermostand.foundation.clock import NS_PER_S
from thermostand.foundation.hub import Hub
from thermostand.foundation.items import Event, Item, StepMark, StepState
from thermostand.foundation.readings import Frame
from thermostand.recording.format.capture_restarts import find_restart_times, is_superseded
from thermostand.recording.reading.session import Session
from thermostand.stand.running.executing.actions import find_cold_start_steps
from thermostand.stand.running.memory.entries import StepChanged
from thermostand.stand.running.memory.fold import fold
from thermostand.stand.running.order import Order
from thermostand.stand.running.resume import load_interruption
from thermostand.stand.service.run import run_virtual

WARM_UP = """
name: warm
experiments:
  - warm_up: {table_position: {linear: 10, rotary: 0}, frames: 8, interval_s: 30, band_K: 2}
"""


def test_a_warm_up_that_was_killed_begins_again_from_a_cold_camera(tmp_path: Path, order: Callable[..., Order]):
    ordered = order(WARM_UP)
    daemon = Daemon(ordered, tmp_path / "out")
    assert daemon.lives_for(5, "Frame")
    daemon.kill()
    (directory,) = (tmp_path / "out").iterdir()
    daemon = Daemon(None, directory)
    assert daemon.lives_for(2, "Frame")  # once more, in the warm-up that was begun again
    daemon.kill()
    assert Daemon(None, directory).wait() == 0

    session = Session.open(directory)
    (capture,) = (planned for planned in ordered.recipe.plan() if isinstance(planned.step, Capture))
    restarts = [event for event in session.events() if event.kind == "capture_restarted"]
    assert len(restarts) == 2
    begins_ns = find_restart_times(session.events())
    assert begins_ns == {capture.step_id: restarts[-1].time_ns}
    frames = [
        frame
        for frame in session.frames()
        if frame.step_id and not is_superseded(frame.time_ns, frame.step_id, begins_ns)
    ]
    assert len(frames) == 8
    assert session.frame_count > 8
    assert frames[0].camera_degC < 27.0
    assert frames[-1].camera_degC > frames[0].camera_degC + 1.0
    marks = [mark for mark in session.steps() if mark.kind == "cool_down" and mark.state is StepState.DONE]
    assert len(marks) == 3
    assert marks[-1].time_ns > begins_ns[capture.step_id]


def again(plan, done, begun):
    """What is done again of a warm-up that was interrupted when so much was done and begun."""
    entries = [StepChanged(0, step_id, "started") for step_id in begun] + [
        StepChanged(0, step_id, "done") for step_id in done
    ]
    return find_cold_start_steps(fold(plan, entries))


def test_only_what_follows_from_a_warm_camera_is_done_again(order: Callable[..., Order]):
    plan = tuple(order(WARM_UP).recipe.plan())
    ids = [planned.step_id for planned in plan]
    off = next(planned.index for planned in plan if planned.step == PowerCamera(False))
    on = next(planned.index for planned in plan if planned.step == PowerCamera(True))
    assert again(plan, ids[:on], ids[:on]) == ()  # killed while the camera cooled: it is off
    steps = again(plan, ids[:on], ids[: on + 1])  # killed while it was switched on
    assert [planned.index for planned in steps] == list(range(off, on + 2))
    assert again(plan, ids[: on + 1], ids[: on + 2]) == steps
    assert again(plan, ids[: on + 2], ids[: on + 2]) == ()


def test_what_the_operator_did_is_not_asked_for_again(order: Callable[..., Order]):
    plan = tuple(order(WARM_UP.replace("band_K: 2", "band_K: 2, rolls_deg: [20]")).recipe.plan())
    ids = [planned.step_id for planned in plan]
    assert any(isinstance(planned.step, Prompt) for planned in plan)
    steps = again(plan, ids[:-3], ids[:-3])
    assert isinstance(steps[-1].step, Capture)
    assert not any(isinstance(planned.step, Prompt) for planned in steps)


@pytest.mark.parametrize("attended", [True, False])
async def test_a_prompt_that_somebody_attends_to_holds_the_run(
    tmp_path: Path, order: Callable[..., Order], attended: bool
):
    recipe = WARM_UP.replace("frames: 8", "frames: 2, cool_down_max_s: 10, rolls_deg: [20]")
    ordered, out = replace(order(recipe), attended=attended), tmp_path / "out"
    kinds, tasks = list[str](), list[asyncio.Task[None]]()

    async def done() -> None:
        (directory,) = out.iterdir()
        assert (await asyncio.to_thread(ask, directory, "continue"))["reasons"] == []
        kinds.append("continued")

    def watch(hub: Hub) -> None:
        def follow(item: Item) -> None:
            if isinstance(item, Event):
                kinds.append(item.kind)
            if isinstance(item, StepMark):
                kinds.append(f"{item.kind} {item.state}")
            if isinstance(item, Event) and item.kind == "held":
                tasks.append(asyncio.create_task(done()))

        hub.subscribe(follow)

    session = Session.open(await run_virtual(ordered, out, None, watch))
    await asyncio.gather(*tasks)
    counted = Counter(kinds)
    assert (counted["prompt"], counted["prompt_skipped"]) == (1, 0 if attended else 1)
    assert counted["held"] == counted["released"] == counted["continued"] == int(attended)
    if attended:
        assert kinds.index("prompt") < kinds.index("held") < kinds.index("released") < kinds.index("prompt done")
    assert len(session.frame_metas()) == 2


def test_nothing_is_superseded_in_a_run_that_was_not_interrupted(tmp_path: Path, order: Callable[..., Order]):
    ordered = order(WARM_UP.replace("frames: 8", "frames: 2, cool_down_max_s: 10"))
    daemon = Daemon(ordered, tmp_path / "out")
    assert daemon.lives_for(1, "StepMark")
    daemon.kill()
    (directory,) = (tmp_path / "out").iterdir()
    before = load_interruption(directory)
    assert find_cold_start_steps(before.state) == ()
    before.release()
    assert find_restart_times(Session.open(directory).events()) == {}
    asyncio.run(end_laboratory(ordered))


def acting(actions: dict[int, Callable[[], Awaitable[object]]], answer: Callable[[str], Awaitable[object]]):
    """A watch: after so many frames an action is done, and `answer(reason)` when something holds the run; all that is
    still to end is in the second of the pair, and what the run said in the third."""
    tasks, items, frames = list[asyncio.Task[object]](), list[Event | StepMark](), list[int]()

    def follow(item: Item) -> None:
        if isinstance(item, Frame):
            frames.append(item.time_ns)
            if len(frames) in actions:
                tasks.append(asyncio.ensure_future(actions[len(frames)]()))
        if isinstance(item, Event | StepMark):
            items.append(item)
        if isinstance(item, Event) and item.kind == "held":
            tasks.append(asyncio.ensure_future(answer(item.text)))

    return (lambda hub: hub.subscribe(follow)), tasks, items


async def test_a_warm_up_that_an_interlock_has_held_begins_again_from_a_cold_camera(
    tmp_path: Path, order: Callable[..., Order]
):
    ordered, out = order(WARM_UP), tmp_path / "out"

    async def operator(reason: str) -> None:
        await fault(ordered, "axis.alarm", None)
        (directory,) = out.iterdir()
        await asyncio.to_thread(ask, directory, "reset")

    act, tasks, items = acting({3: lambda: fault(ordered, "axis.alarm", "rotary")}, operator)

    directory = await run_virtual(ordered, out, None, act)
    await asyncio.gather(*tasks)
    session = Session.open(directory)
    (capture,) = (planned for planned in ordered.recipe.plan() if isinstance(planned.step, Capture))
    begins_ns = find_restart_times(session.events())
    (restart,) = [event for event in session.events() if event.kind == "capture_restarted"]
    assert begins_ns == {capture.step_id: restart.time_ns}
    counted = [meta for meta in session.frame_metas() if not is_superseded(meta.time_ns, meta.step_id, begins_ns)]
    superseded = len(session.frame_metas()) - 8
    assert superseded >= 3
    assert f"its {superseded} frames so far " in restart.text
    assert len(counted) == 8
    assert counted[0].camera_degC < 27.0
    assert counted[-1].camera_degC > counted[0].camera_degC + 1.0
    marks = [item for item in items if isinstance(item, StepMark) and item.kind in ("power_camera", "cool_down")]
    done = [mark.kind for mark in marks if mark.state is StepState.DONE]
    assert done == ["power_camera", "cool_down", "power_camera"] * 2


async def paused(order: Order, out: Path, pause_s: float) -> Session:
    """The session of a run that was paused for so long after its third frame."""
    watcher = Watcher()

    async def operator(reason: str) -> None:
        (directory,) = out.iterdir()
        await watcher.wait(pause_s)
        await asyncio.to_thread(ask, directory, "continue")

    async def pause() -> None:
        (directory,) = out.iterdir()
        await asyncio.to_thread(ask, directory, "pause")

    act, tasks, _ = acting({3: pause}, operator)

    def watch(hub: Hub) -> None:
        hub.subscribe(watcher)
        act(hub)

    directory = await run_virtual(order, out, None, watch)
    await asyncio.gather(*tasks)
    return Session.open(directory)


async def test_a_warm_up_that_is_paused_shortly_goes_on_and_says_what_was_not_seen(
    tmp_path: Path, order: Callable[..., Order]
):
    ordered = order(WARM_UP.replace("band_K: 2", "cool_down_max_s: 10").replace("interval_s: 30", "interval_s: 5"))
    session = await paused(ordered, tmp_path / "out", 35.0)
    assert len(session.frame_metas()) == 8
    (gap,) = [event for event in session.events() if event.kind == "warm_up_gap"]
    missing_s = float(gap.text.split(" for ")[1].split()[0])
    times_ns = [meta.time_ns for meta in session.frame_metas()]
    gaps_s = [(later - time_ns) / NS_PER_S for time_ns, later in itertools.pairwise(times_ns)]
    assert missing_s == pytest.approx(max(gaps_s), abs=1.0)
    assert missing_s > 35.0
    assert not [event for event in session.events() if event.kind == "capture_restarted"]


async def test_a_warm_up_that_is_paused_for_long_begins_again_from_its_cool_down(
    tmp_path: Path, order: Callable[..., Order]
):
    ordered = order(WARM_UP, **AS_INSTALLED)
    session = await paused(ordered, tmp_path / "out", 100.0)
    begins_ns = find_restart_times(session.events())
    counted = [meta for meta in session.frame_metas() if not is_superseded(meta.time_ns, meta.step_id, begins_ns)]
    assert len(counted) == 8
    held_ns = next(event.time_ns for event in session.events() if event.kind == "held")
    before = [meta.time_ns for meta in session.frame_metas() if meta.time_ns < held_ns + NS_PER_S]
    assert len(before) >= 3  # more on a busy machine: virtual time goes on until the pause is there
    assert len(session.frame_metas()) == 8 + len(before)
    assert counted[0].camera_degC < 27.0
    cooled = [mark for mark in session.steps() if mark.kind == "cool_down" and mark.state is StepState.DONE]
    assert len(cooled) == 2
    assert [event for event in session.events() if event.kind == "flap_shut_in_hold"]
