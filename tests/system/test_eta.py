"""The time left that a run shows, against the truth, over the wire in virtual time; and what a run teaches the next."""

import os
import signal
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.system.conftest import CORNER, SHORT_RECIPE
from thermostand.experiments.steps import Soak
from thermostand.foundation.clock import NS_PER_S
from thermostand.foundation.hub import Hub
from thermostand.foundation.items import Batch, Event, Item, StepMark, StepState
from thermostand.recording.reading.session import Session
from thermostand.stand.config.stand_config import find_packaged
from thermostand.stand.estimating.estimate import price_plan
from thermostand.stand.estimating.eta import Eta
from thermostand.stand.estimating.learned_durations import learn_durations, load_learned_durations
from thermostand.stand.running.order import Order
from thermostand.stand.running.resume import load_interruption
from thermostand.stand.service.run import Interrupted, resume, run_virtual


def fed(eta: Eta) -> Callable[[Item], None]:
    """A subscriber that tells it what it wants to know."""

    def follow(item: Item) -> None:
        if isinstance(item, StepMark):
            eta.mark(item)
        elif isinstance(item, Event):
            eta.event(item)

    return follow


def following(eta: Eta) -> tuple[Callable[[Hub], None], list[tuple[int, float]]]:
    """A watch, and (instant, time left in s as it was shown then) each time something was published after a set-point
    was reached, that is after a dwell."""
    left: list[tuple[int, float]] = []

    def watch(hub: Hub) -> None:
        reached: list[Item] = []

        def look(item: Item) -> None:
            if isinstance(item, StepMark) and item.kind.startswith("soak") and item.state is StepState.DONE:
                reached.append(item)
            if reached and isinstance(item, Batch | StepMark):
                left.append((item.time_ns, eta.left_s(item.time_ns)))

        hub.subscribe(fed(eta))
        hub.subscribe(look)

    return watch, left


async def followed(order: Order, out: Path, seed: int | None = None) -> tuple[Path, list[tuple[int, float]]]:
    """The session, and the time left as `following` has it, by what earlier runs in that folder have taught."""
    steps = price_plan(order.recipe.plan(), order.config, load_learned_durations(out))
    watch, left = following(Eta(steps))
    return await run_virtual(order, out, seed, watch), left


def worst_share(left: list[tuple[int, float]], session: Path) -> float:
    """The largest error of the time left, as a share of the true one."""
    end_ns = Session.open(session).steps()[-1].time_ns
    truth = [(left_s, (end_ns - time_ns) / NS_PER_S) for time_ns, left_s in left if time_ns < end_ns]
    return max(abs(left_s - true_s) / true_s for left_s, true_s in truth)


def is_true(left: list[tuple[int, float]], session: Path, within_s: float) -> bool:
    """Whether the time left was at any time true within 5 %, or at the end `within_s`."""
    end_ns = Session.open(session).steps()[-1].time_ns
    truth = [(left_s, (end_ns - time_ns) / NS_PER_S) for time_ns, left_s in left]
    return all(abs(left_s - true_s) <= max(0.05 * true_s, within_s) for left_s, true_s in truth)


async def test_the_time_left_is_true_from_the_first_set_point_on(tmp_path: Path, order: Callable[..., Order]):
    ordered = order(SHORT_RECIPE.replace("soak_s: 600", "soak_s: 2700"))  # the first cooling takes more than 600 s
    session, left = await followed(ordered, tmp_path)
    assert len(left) > 100
    assert worst_share(left, session) < 0.05

    learned = learn_durations(tmp_path, ordered.config)
    steps = Session.open(session).steps()
    truth_s = (steps[-1].time_ns - steps[0].time_ns) / NS_PER_S
    plan = price_plan(ordered.recipe.plan(), ordered.config, learned)
    assert sum(step.duration_s for step in plan) == pytest.approx(truth_s, abs=0.5)
    assert (learned.chamber.heating_ramps, learned.chamber.cooling_ramps) == (2, 1)
    arrivals_s = [step.in_band_after_s for step in plan if step.planned.index > 6 and step.in_band_after_s is not None]
    assert all(100 < arrival_s < 2700 for arrival_s in arrivals_s)
    assert len(arrivals_s) == 3


async def test_the_time_left_of_a_run_that_goes_on_is_true(tmp_path: Path, order: Callable[..., Order]):
    ordered = order(SHORT_RECIPE.replace("soak_s: 600", "soak_s: 1500"))
    third = [planned.step_id for planned in ordered.recipe.plan() if isinstance(planned.step, Soak)][2]

    def stop(item: Item) -> None:
        if isinstance(item, StepMark) and item.step_id == third:
            os.kill(os.getpid(), signal.SIGINT)

    with pytest.raises(Interrupted):
        await run_virtual(ordered, tmp_path / "out", None, lambda hub: hub.subscribe(stop))
    (directory,) = (tmp_path / "out").iterdir()
    before = load_interruption(directory)
    steps = price_plan(ordered.recipe.plan(), ordered.config)
    done, soaked_s = before.kept.done, before.kept.soaked_s
    watch, left = following(Eta(steps, done, soaked_s))
    await resume(before, watch)
    assert len(left) > 100
    assert is_true(left, directory, 5.0)


@pytest.mark.nightly
async def test_the_time_left_of_dwells_that_end_when_settled_is_true_once_a_run_has_taught_it(
    tmp_path: Path, order: Callable[..., Order]
):
    recipe = SHORT_RECIPE.replace("[30, 20, 24]", "[28, 24]").replace("held_out_degC: [20]", "held_out_degC: []")
    # Looks are 2 min apart. A camera that is all but as slow as is asked for settles at this look or at the next, by
    # chance; at 0.0034 px/min all seeds do at the same one: those before and at it see 3.8 and at most 3.1 mpx/min.
    settled = "soak_s: 3600\n      until: {settled: {drift_px_per_min: 0.0034}}"
    ordered = order(recipe.replace("soak_s: 600", settled))
    await followed(ordered, tmp_path, 3)
    learn_durations(tmp_path, ordered.config)
    session, left = await followed(ordered, tmp_path, 4)
    assert len(left) > 100
    assert is_true(left, session, 60.0)


@pytest.mark.nightly
async def test_the_time_left_is_true_over_the_whole_demo_session(tmp_path: Path, order: Callable[..., Order]):
    session, left = await followed(order(find_packaged("recipes", "demo").read_text(), camera=CORNER), tmp_path)
    assert len(left) > 10_000
    assert worst_share(left, session) < 0.05


def test_no_time_is_gained_in_a_pause(order: Callable[..., Order]):
    ordered = order()
    steps = price_plan(ordered.recipe.plan(), ordered.config)
    eta = Eta(steps)
    follow = fed(eta)
    soak = next(step.planned for step in steps if isinstance(step.planned.step, Soak))
    follow(StepMark(0, soak.step_id, soak.index, "soak", StepState.STARTED))
    follow(Event(100 * NS_PER_S, "warning", "held", "", {"reason": "operator"}))
    left_s = eta.left_s(100 * NS_PER_S)
    assert eta.left_s(4000 * NS_PER_S) == left_s
    follow(Event(4000 * NS_PER_S, "info", "released", "", {"reason": "operator"}))
    assert eta.left_s(4050 * NS_PER_S) == left_s - 50
