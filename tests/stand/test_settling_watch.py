"""Soaks until the camera has settled, through pauses, interlocks and kills, on a stand in memory."""

import asyncio
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from tests.compensation.renderer import Scene, photograph, render
from tests.stand.small_stand import Life
from thermostand.experiments.steps import SoakUntilSettled, StartChamber, StopChamber, number_steps
from thermostand.foundation.clock import NS_PER_S
from thermostand.foundation.items import Batch, Event, StepMark, StepState
from thermostand.foundation.readings import Reading
from thermostand.stand.safety.gate import INTERLOCK, OPERATOR

SOAK = SoakUntilSettled(1800.0, 60.0, 240.0, 60.0, 0.2, 0.003, 0.1, 24.0)
PLAN = tuple(number_steps([StartChamber(24.0), SOAK, StopChamber()]))
START_NS = 1_767_290_400 * NS_PER_S
# Looks begin 60 s after the soak, and are those of a window when that has passed; each takes 2 s.
SOONEST_S, LATEST_S = 300.0, 330.0


@pytest.fixture(scope="module")
def image() -> np.ndarray:
    """The target, small."""
    scene = Scene(size=(612, 512), f_px=1750.0)
    return photograph(scene, render(scene), seed=1)


@pytest.fixture
def life(tmp_path: Path, image: np.ndarray):
    """begin(chamber_degC) -> a daemon, polled, that soaks; the last one is ended with the test."""
    lives: list[Life] = []
    disk: list[object] = []

    def begin(chamber_degC: float = 24.0, start_ns: int = START_NS) -> Life:
        begun = Life(tmp_path, PLAN, start_ns, disk, chamber_degC)
        begun.stand.image = image
        begun.pv_degC = chamber_degC
        begun.call(lambda: setattr(begun, "polling", asyncio.create_task(poll(begun))))
        lives.append(begun)
        return begun

    yield begin
    if not lives[-1].loop.is_closed():
        lives[-1].call(lives[-1].polling.cancel)
        lives[-1].kill()


async def poll(life: Life) -> None:
    while True:
        await life.clock.sleep_until(life.clock.now_ns() + 5 * NS_PER_S)
        now_ns = life.clock.now_ns()
        for channel, value in (("regulator.pv", life.pv_degC), ("camera.temperature", 41.25)):
            life.hub.publish(Batch("device", now_ns, (Reading(channel, value, "degC", now_ns),)))


def killed(life: Life) -> int:
    life.call(life.polling.cancel)
    return life.kill()


def soaked_s(life: Life) -> float | None:
    """How long the soak took in this life, None while it is not done."""
    marks = [item for item in life.reported if isinstance(item, StepMark) and item.kind == "soak_until_settled"]
    ends = [mark.time_ns for mark in marks if mark.state is StepState.DONE]
    return (ends[0] - marks[0].time_ns) / NS_PER_S if ends else None


def reported(life: Life) -> list[str]:
    return [item.text for item in life.reported if isinstance(item, Event) and item.kind in ("settled", "not_settled")]


def test_a_camera_at_rest_is_settled_when_a_window_has_been_seen(life: Callable[..., Life]):
    here = life()
    here.passes(400.0)
    assert SOONEST_S < soaked_s(here) < LATEST_S
    assert reported(here)[0].startswith("settled after 5 min: camera +0.000")
    assert here.wrong == []


def test_looks_wait_for_the_chamber(life: Callable[..., Life]):
    here = life(20.0)
    here.passes(600.0)
    assert not [item for item in here.reported if isinstance(item, Event)]
    here.pv_degC = 24.1
    here.passes(400.0)
    assert 600.0 + SOONEST_S - 60.0 < soaked_s(here) < 600.0 + LATEST_S


def test_a_pause_keeps_the_soak_time_but_begins_a_new_window(life: Callable[..., Life]):
    here = life()
    here.passes(200.0)
    here.call(lambda: here.stand.gate.hold(OPERATOR))
    here.passes(60.0)
    assert soaked_s(here) is None
    here.call(lambda: here.stand.gate.clear(OPERATOR))
    here.passes(400.0)
    assert 260.0 + SOONEST_S - 60.0 < soaked_s(here) < 260.0 + LATEST_S
    assert reported(here)[0].startswith("settled after 8 min")  # 200 s and a new window of looks


def test_an_interlock_begins_a_new_window(life: Callable[..., Life]):
    here = life()
    here.passes(200.0)
    here.interlock()
    here.passes(30.0)
    here.call(lambda: here.stand.gate.clear(INTERLOCK))
    here.passes(240.0)
    assert soaked_s(here) is None
    here.passes(200.0)
    assert soaked_s(here) is not None
    assert here.wrong == []


def test_a_killed_soak_goes_on_with_its_soak_time_and_a_new_window(life: Callable[..., Life]):
    first = life()
    first.passes(200.0)
    second = life(start_ns=killed(first))
    second.passes(250.0)
    assert soaked_s(second) is None
    second.passes(200.0)
    assert soaked_s(second) is not None
    assert reported(second)[0].startswith("settled after 8 min")


def test_a_missing_target_lets_the_soak_end_at_its_longest(life: Callable[..., Life]):
    here = life()
    here.stand.image = np.full((512, 612), 120, np.uint8)
    here.passes(1900.0)
    assert 1800.0 <= soaked_s(here) < 1810.0
    text = "not settled after 30 min: the target was not seen often enough (the target was not found: "
    assert reported(here)[0].startswith(text)


def test_a_look_that_fails_begins_a_new_window(life: Callable[..., Life], image: np.ndarray):
    here = life()
    here.passes(200.0)
    here.stand.image = np.full((512, 612), 120, np.uint8)
    here.passes(60.0)
    here.stand.image = image
    here.passes(200.0)
    assert soaked_s(here) is None
    here.passes(200.0)
    assert soaked_s(here) is not None
