"""How runs end that nobody stopped: somebody is warned, what was before the recording is in it, and nothing is left."""

import asyncio
import gc
import json
import os
import signal
import socket
import sys
import threading
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from types import FrameType
from typing import get_args

import pytest

from tests.installed import install
from tests.system.conftest import SHORT_RECIPE
from tests.system.resume_process import Daemon
from tests.system.test_resume import end_laboratory
from tests.system.test_run import at_step, ignore
from thermostand.foundation import workers
from thermostand.foundation.errors import NotReset, StandTripped
from thermostand.foundation.events import AlertCause
from thermostand.foundation.items import Event, Item, StepMark, StepState
from thermostand.recording.reading.session import Session
from thermostand.stand.assembly.simulator import Simulator
from thermostand.stand.config.stand_config import StandConfig
from thermostand.stand.running.order import Order
from thermostand.stand.service.run import Interrupted, run_real, run_virtual
from thermostand.stand.serving.alerts import AlertMessage, AlertTracker

SHORTER = SHORT_RECIPE.replace("600", "60").replace("[30, 20, 24]", "[26]").replace("held_out_degC: [20]", "")


def break_now(order: Order, name: str, value: object) -> None:
    """As `fault`, done when this returns."""
    assert order.config.simulation is not None
    host, port = order.config.simulation.control.removeprefix("tcp:").rsplit(":", 1)
    with socket.create_connection((host, int(port))) as control, control.makefile("rwb") as lines:
        lines.write(json.dumps({"do": "fault", "name": name, "value": value}).encode() + b"\n")
        lines.flush()
        assert b"error" not in lines.readline()


async def test_a_session_says_which_package_has_made_steps_of_its_plan(
    tmp_path: Path, order: Callable[..., Order], monkeypatch: pytest.MonkeyPatch
):
    module = (
        "from thermostand.experiments.steps import CloseFlap\nfrom pydantic import BaseModel\n"
        "class P(BaseModel): pass\ndef shut(p: P): yield CloseFlap()\n"
    )
    install(tmp_path, "acme", {"acme": module}, {"thermostand.experiments": "shut = acme:shut"}, "1.2")
    monkeypatch.syspath_prepend(tmp_path)
    ordered = order("name: shut\nexperiments: [shut: {}]\n")
    session = Session.open(await run_virtual(ordered, tmp_path / "out", None, ignore))
    (start,) = [event for event in session.events() if event.kind == "run.start"]
    assert start.data["packages"] == ["acme 1.2"]


def messages(events: Sequence[Event]) -> list[AlertMessage]:
    """What receivers of all causes get of a session's events."""
    book = AlertTracker("lab", get_args(AlertCause), 0, 1000)
    return [each for event in events for each in (*book.receive(event, event.time_ns), *book.due(event.time_ns))]


async def test_people_are_alerted_of_a_step_that_fails_and_of_the_run_that_ends_because_nobody_came(
    tmp_path: Path, order: Callable[..., Order]
):
    ordered = order(SHORTER)
    watch = at_step("soak", lambda: break_now(ordered, "flap.jam", 500))
    with pytest.raises(NotReset):
        await run_virtual(ordered, tmp_path / "out", None, watch)
    (directory,) = (tmp_path / "out").iterdir()
    events = Session.open(directory).events()
    (trip,) = [event for event in events if event.kind == "guard.device_fault"]
    found = messages(events)
    assert trip.text in [message.text for message in found if message.cause == "hold"]
    assert found[-1].cause == "run_aborted"


async def test_a_stand_that_is_not_confirmed_safe_after_the_last_step_is_no_complete_run(
    tmp_path: Path, order: Callable[..., Order]
):
    ordered = order(SHORTER, bus={"timeout_s": 0.05}, guard={"safe_limit_s": 2})
    last = list(ordered.recipe.plan())[-1].step_id

    def follow(item: Item) -> None:
        if isinstance(item, StepMark) and item.step_id == last and item.state is StepState.DONE:
            break_now(ordered, "bus.silent", True)

    with pytest.raises(StandTripped, match=r"NOT SAFE: .*regulator did not confirm"):
        await run_virtual(ordered, tmp_path / "out", None, lambda hub: hub.subscribe(follow))
    (directory,) = (tmp_path / "out").iterdir()
    assert "trip" in [message.cause for message in messages(Session.open(directory).events())]


async def test_what_happened_before_the_recording_began_is_in_it(tmp_path: Path, order: Callable[..., Order]):
    ordered, out = order(SHORTER), tmp_path / "out"
    daemon = Daemon(ordered, out)
    assert daemon.lives_for(1, "StepMark")
    daemon.kill()
    await end_laboratory(ordered)
    (killed,) = out.iterdir()
    with pytest.raises(Interrupted):
        await run_virtual(order(SHORTER), out, None, at_step("soak", lambda: os.kill(os.getpid(), signal.SIGINT)))
    (directory,) = set(out.iterdir()) - {killed}
    events = Session.open(directory).events()
    assert [event.kind for event in events[:1]] == ["repaired"]
    assert killed.name in events[0].text
    assert events[0].time_ns < next(event.time_ns for event in events if event.kind == "run.start")


def held_now() -> Counter[str]:
    """What a run could leave behind: tasks, threads other than those of the loop's own pool, handlers of signals, and
    open files."""
    gc.collect()
    held = Counter[str](f"task {task.get_name()}" for task in asyncio.all_tasks() - {asyncio.current_task()})
    held.update(f"thread {each.name}" for each in threading.enumerate() if not each.name.startswith("asyncio_"))
    held.update("thread of a lane" for frame in sys._current_frames().values() if is_of_lane(frame))
    held.update(f"{number!r} {signal.getsignal(number)}" for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP))
    for number in os.listdir("/proc/self/fd"):
        with suppress(FileNotFoundError):  # of this listing itself
            held[f"file {os.readlink(f'/proc/self/fd/{number}').split(':')[0]}"] += 1
    return held


def is_of_lane(frame: FrameType | None) -> bool:
    """Whether the thread that is there now serves a lane; such threads are not the threading module's."""
    while frame is not None:
        if frame.f_code is workers._serve.__code__:
            return True
        frame = frame.f_back
    return False


def left_since(before: Counter[str]) -> Counter[str]:
    """What is held now and was not; what an earlier test has left, such as a thread of libaravis, may end meanwhile."""
    return held_now() - before


async def test_a_run_leaves_nothing_behind_however_it_ends(tmp_path: Path, order: Callable[..., Order]):
    ordered = order(SHORTER)
    interrupt = at_step("soak", lambda: os.kill(os.getpid(), signal.SIGINT))
    with pytest.raises(Interrupted):  # the first one loads what stays
        await run_virtual(ordered, tmp_path / "first", None, interrupt)
    before = held_now()
    await run_virtual(ordered, tmp_path / "complete", None, ignore)
    assert not left_since(before)
    stop = at_step("capture", lambda: os.kill(os.getpid(), signal.SIGINT))
    with pytest.raises(Interrupted):
        await run_virtual(ordered, tmp_path / "stopped", None, stop)
    assert not left_since(before)
    broken = at_step("soak", lambda: break_now(ordered, "flap.jam", 500))
    with pytest.raises(NotReset):
        await run_virtual(ordered, tmp_path / "failed", None, broken)
    assert not left_since(before)


@pytest.mark.nightly
async def test_a_run_in_real_time_leaves_no_thread_behind(
    tmp_path: Path, order: Callable[..., Order], simulator: Callable[[StandConfig, bool], Simulator]
):
    ordered = order(SHORTER, camera={"boot_s": 0.5})
    await asyncio.to_thread(simulator, ordered.config, False)
    stop = at_step("move_to", lambda: os.kill(os.getpid(), signal.SIGINT))
    with pytest.raises(Interrupted):
        await run_real(ordered, tmp_path / "first", stop)
    before = held_now()
    stop = at_step("move_to", lambda: os.kill(os.getpid(), signal.SIGINT))
    with pytest.raises(Interrupted):
        await run_real(ordered, tmp_path / "second", stop)
    assert not left_since(before)
    assert not [name for name in before if name.startswith("thread ") and name != "thread MainThread"]
