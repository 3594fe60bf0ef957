"""Operators who press everything at any time, several at once, over the control socket of a real run."""

import asyncio
import random
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import pytest

from tests.daemon_queries import ask, ask_status
from tests.journals import read_lines
from tests.system.test_attended import PROMPTED
from tests.system.test_guard_run import check_safe
from tests.system.test_resume import ONE_SET_POINT, check, check_soaks
from thermostand.foundation.errors import SessionError, StandError
from thermostand.foundation.hub import Hub
from thermostand.foundation.items import Event, Item, StepMark, StepState
from thermostand.recording.reading.session import Session
from thermostand.stand.running.memory.entries import Held
from thermostand.stand.running.memory.journal import JOURNAL_NAME
from thermostand.stand.running.order import Order
from thermostand.stand.service.run import Interrupted, run_virtual


def pressed(directory: Path, do: str) -> object:
    return ask_status(directory) if do == "status" else ask(directory, do)


async def press(out: Path, run: asyncio.Task[Path], seed: int, news: asyncio.Event) -> list[object]:
    """Any request, from before the run is there on; what came back. Nobody leaves a pause behind."""
    rng, answers = random.Random(seed), list[object]()
    while not run.done() and len(answers) < 90:
        waiting = asyncio.create_task(news.wait())
        await asyncio.wait([run, waiting], return_when=asyncio.FIRST_COMPLETED)
        waiting.cancel()
        news.clear()
        for directory in out.glob("*/"):
            for do in (rng.choice(["pause", "pause", "reset", "status"]), "status", "continue"):
                try:
                    answers.append(await asyncio.to_thread(pressed, directory, do))
                except SessionError as error:
                    answers.append(str(error))
    return answers


async def test_a_session_with_two_restless_operators_is_whole(tmp_path: Path, order: Callable[..., Order]):
    ordered, out = order(ONE_SET_POINT), tmp_path / "out"
    news = asyncio.Event(), asyncio.Event()  # virtual time stands still as long as somebody has something to do

    def watch(hub: Hub) -> None:
        for heard in news:
            hub.subscribe(lambda item, heard=heard: heard.set())

    run = asyncio.create_task(run_virtual(ordered, out, None, watch))
    answers = await asyncio.gather(*(press(out, run, seed, heard) for seed, heard in enumerate(news, 1)))
    directory = await run
    check(directory, ordered, [])
    check_soaks(directory, ordered)
    held = [entry for entry in read_lines((directory / JOURNAL_NAME).read_bytes())[0] if isinstance(entry, Held)]
    assert len(held) > 10
    assert [entry.held for entry in held] == [True, False] * (len(held) // 2)
    assert all(entry.reason == "operator" for entry in held)
    refused = {answer for answers_ in answers for answer in answers_ if isinstance(answer, str)}
    assert any("nothing to reset" in text for text in refused)
    assert all(text.count("\n") == 0 for text in refused)


PHASES = ("opening", "prompt", "cool_down", "capture", "held", "run.end")


@pytest.mark.parametrize("phase", PHASES)
async def test_stop_pressed_twice_in_any_phase_leaves_the_stand_safe(
    tmp_path: Path, order: Callable[..., Order], phase: str
):
    """While the stand is opened there is no run yet to be asked; when it ends, there is nothing left to stop."""
    ordered, out = replace(order(PROMPTED), attended=phase == "prompt"), tmp_path / "out"
    pressed, answers = list[asyncio.Task[None]](), list[object]()

    async def press_stop(directory: Path) -> None:
        for do in ("stop", "pause", "stop", "continue"):
            asked = asyncio.create_task(asyncio.to_thread(ask, directory, do))
            while do == "stop" and not asked.done():
                await asyncio.sleep(0)  # virtual time stands still, or the run could end before the stop arrives
            try:
                answers.append(await asked)
            except StandError as error:
                answers.append(str(error))

    async def pause(directory: Path) -> None:
        with suppress(SessionError):  # the stop that follows at once may take the answer with it
            await asyncio.to_thread(ask, directory, "pause")

    def follow(item: Item) -> None:
        begins = isinstance(item, StepMark) and item.state is StepState.STARTED and item.kind == phase
        if phase == "held" and isinstance(item, StepMark) and item.kind == "cool_down":
            pressed.append(asyncio.create_task(pause(next(out.iterdir()))))
        if begins or (isinstance(item, Event) and item.kind == phase):
            pressed.append(asyncio.create_task(press_stop(next(out.iterdir()))))

    def watch(hub: Hub) -> None:
        hub.subscribe(follow)
        if phase == "opening":
            pressed.append(asyncio.create_task(press_stop(out)))

    with suppress(Interrupted):
        await run_virtual(ordered, out, None, watch)
    await asyncio.gather(*pressed)
    (directory,) = out.iterdir()
    session = Session.open(directory)
    check_safe(session)
    (end,) = [event.text.partition(":")[0] for event in session.events() if event.kind == "run.end"]
    stopped = phase not in ("opening", "run.end")
    assert end == ("aborted" if stopped else "complete")
    kinds = [event.kind for event in session.events()]
    assert "held" not in kinds[kinds.index("run.end") :]  # a run that has ended cannot be held
    assert answers
    assert session.incomplete == ()
