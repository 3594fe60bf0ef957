"""Autotuning that somebody starts at the regulator: held like manual mode, and the session goes on after `reset`."""

import asyncio
from collections.abc import Callable, Coroutine
from pathlib import Path

import pytest

from tests.daemon_queries import ask, ask_status
from tests.nightly import mark_nightly
from tests.system.conftest import SHORT_RECIPE
from tests.system.test_guard_run import Watcher, check_safe
from tests.system.test_run import at_step
from tests.system.test_run_ends import break_now
from thermostand.foundation.hub import Hub
from thermostand.recording.reading.session import Session
from thermostand.stand.running.order import Order
from thermostand.stand.service.run import run_virtual


async def operated(run: Coroutine[None, None, Path], operate: Coroutine[None, None, None]) -> Path:
    """What the run returns; it ends, too, when what somebody does meanwhile fails."""
    running, operating = asyncio.create_task(run), asyncio.create_task(operate)
    await asyncio.wait([running, operating], return_when=asyncio.FIRST_COMPLETED)
    if operating.done() and operating.exception() is not None:
        running.cancel()
        await asyncio.wait([running])
    await operating
    return await running


@pytest.mark.parametrize("step", ["soak", mark_nightly("set_temperature")])
async def test_autotuning_is_held_and_the_run_goes_on_after_clear(
    tmp_path: Path, order: Callable[..., Order], step: str
):
    """In a soak the heater swings; at a set-point the regulator takes none: the run waits for the guard's hold."""
    ordered, out, watcher = order(SHORT_RECIPE), tmp_path / "out", Watcher()
    press = at_step(step, lambda: break_now(ordered, "regulator.autotune", True))

    def watch(hub: Hub) -> None:
        press(hub)
        hub.subscribe(watcher)

    async def operate() -> None:
        await watcher.until(lambda: watcher.now_ns > 0)
        trip = await watcher.event("guard.device_fault", 4000)
        assert trip.text.startswith("regulator.fault: autotune, for 30 s")
        (directory,) = out.iterdir()
        await watcher.wait(60)
        status = await asyncio.to_thread(ask_status, directory)
        assert (status.state, status.reasons) == ("held", ("interlock",))
        await asyncio.to_thread(ask, directory, "reset")
        await watcher.event("restored", 60)

    session = Session.open(await operated(run_virtual(ordered, out, None, watch), operate()))
    check_safe(session)
    events = session.events()
    assert events[-1].text == "complete"
    assert session.frame_count == 5
    (held_ns,) = [event.time_ns for event in events if event.kind == "guard.device_fault"]
    (begun_ns, *_) = [mark.time_ns for mark in session.steps() if mark.kind == step]
    assert held_ns - begun_ns <= 60e9
    assert len([event for event in events if event.kind == "regulator_occupied"]) == (step == "set_temperature")


async def test_autotuning_that_ends_before_it_is_held_costs_only_the_wait(tmp_path: Path, order: Callable[..., Order]):
    ordered, out, watcher = order(SHORT_RECIPE), tmp_path / "out", Watcher()
    press = at_step("set_temperature", lambda: break_now(ordered, "regulator.autotune", True))

    def watch(hub: Hub) -> None:
        press(hub)
        hub.subscribe(watcher)

    async def operate() -> None:
        await watcher.until(lambda: watcher.now_ns > 0)
        await watcher.event("regulator_occupied", 4000)
        await asyncio.to_thread(break_now, ordered, "regulator.autotune", False)

    session = Session.open(await operated(run_virtual(ordered, out, None, watch), operate()))
    assert not [event for event in session.events() if event.kind.startswith("guard.")]
    assert session.frame_count == 5
