"""A plan that an operator changes in a run over every wire: the run does it, the session tells it, and a resumed run
knows it."""

import asyncio
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.daemon_queries import ask
from tests.system.conftest import SHORT_RECIPE
from thermostand.experiments.steps import Capture, CloseFlap, OpenFlap, Role, SetTemperature, Soak, StopChamber
from thermostand.foundation.errors import ConfigError
from thermostand.foundation.hub import Hub
from thermostand.foundation.items import Item, StepMark, StepState
from thermostand.recording.reading.overview import summarise_session
from thermostand.recording.reading.run_status import Files, RunOutcome
from thermostand.recording.reading.scan import verify
from thermostand.recording.reading.session import Session
from thermostand.stand.running.executing.executor import Executor
from thermostand.stand.running.order import Order
from thermostand.stand.running.resume import load_interruption
from thermostand.stand.service.run import Interrupted, resume, run_virtual

RECIPE = SHORT_RECIPE.replace("600", "300").replace("frames_per_point: 1", "frames_per_point: 6")


@pytest.fixture
def executors(monkeypatch: pytest.MonkeyPatch) -> list[Executor]:
    """The one of each run."""
    found: list[Executor] = []

    class Kept(Executor):
        def __init__(self, *args, **options) -> None:
            super().__init__(*args, **options)
            found.append(self)

    monkeypatch.setattr("thermostand.stand.running.run.Executor", Kept)
    return found


async def test_a_plan_that_was_changed_is_recorded_and_goes_on_changed_after_a_stop(
    tmp_path: Path, order: Callable[..., Order], executors: list[Executor]
):
    ordered, out, tasks = order(RECIPE), tmp_path / "out", list[asyncio.Task[None]]()
    plan = tuple(ordered.recipe.plan())
    soak, other = [planned for planned in plan if isinstance(planned.step, Soak)][:2]
    first, second = [planned for planned in plan if isinstance(planned.step, Capture)][:2]
    rest = [OpenFlap(), Capture(2, 1.0, 0.02, Role.FIT, 30.0), CloseFlap(), StopChamber()]

    async def change() -> None:
        (executor,) = executors
        await executor.skip(first.step_id)
        await executor.extend(soak.step_id, 60.0)
        with pytest.raises(ConfigError, match=r"step 10: a set-point of 99 degC"):
            await executor.edit(9, [SetTemperature(99.0)])
        with pytest.raises(ConfigError, match="step 11: the flap"):
            await executor.edit(9, [SetTemperature(24.0), rest[1]])
        await executor.edit(other.index + 1, rest)
        (directory,) = out.iterdir()
        await asyncio.to_thread(ask, directory, "stop")

    def watch(hub: Hub) -> None:
        def follow(item: Item) -> None:
            if isinstance(item, StepMark) and item.step_id == soak.step_id and item.state is StepState.STARTED:
                tasks.append(asyncio.create_task(change()))

        hub.subscribe(follow)

    with pytest.raises(Interrupted):
        await run_virtual(ordered, out, None, watch)
    await asyncio.gather(*tasks)
    (directory,) = out.iterdir()
    state = executors[0]._log.state
    before = load_interruption(directory)
    assert (before.state.plan, before.state.changes) == (state.plan, state.changes)
    await resume(before, lambda hub: None)

    session = Session.open(directory)
    found = verify(directory)
    assert (found.run, found.files) == (RunOutcome.COMPLETE, Files.SOUND), found.findings
    assert session.attachments["recipe.yaml"] == RECIPE
    assert [event.data["change"] for event in session.events() if event.kind == "plan_changed"] == [
        "Skipped",
        "Extended",
        "Edited",
    ]
    marks = [(mark.index, mark.kind, mark.state) for mark in session.steps() if mark.state is not StepState.STARTED]
    ends = [(index, kind) for index, kind, state in marks if state is StepState.DONE]
    assert (first.index, "capture", StepState.SKIPPED) in marks
    expected = [(p.index, p.step.kind) for p in plan[: other.index + 1] if p != first]
    assert ends == expected + [(other.index + 1 + index, step.kind) for index, step in enumerate(rest)]
    soaked = next(mark for mark in session.steps() if mark.step_id == soak.step_id and mark.state is StepState.DONE)
    assert soaked.parameters["duration_s"] == 360.0
    assert session.frame_count == 2
    assert summarise_session(directory).planned_steps == len(ends)
    assert second.step_id not in {mark.step_id for mark in session.steps()}
