"""What a run does when a step fails, is interrupted or has to be made ready again; on a stand in memory."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.stand.small_stand import Life
from thermostand.experiments.steps import (
    Capture,
    CloseFlap,
    CoolDown,
    OpenFlap,
    Role,
    SetTemperature,
    Soak,
    StartChamber,
    StopChamber,
    number_steps,
)
from thermostand.foundation.clock import NS_PER_S
from thermostand.foundation.errors import DeviceError, Unreachable
from thermostand.foundation.items import Batch, Event, Item, StepMark
from thermostand.foundation.readings import Frame, Reading
from thermostand.stand.running.executing.camera_gap import OffsetGap
from thermostand.stand.safety.gate import INTERLOCK

CAPTURE = Capture(20, 5.0, 0.1, Role.FIT, 24.0)
PLAN = tuple(
    number_steps(
        [
            StartChamber(24.0),
            Soak(150.0),
            OpenFlap(),
            CAPTURE,
            CloseFlap(),
            SetTemperature(30.0),
            CoolDown(2.0, 100.0, 500.0),
            StopChamber(),
        ]
    )
)
ID = [planned.step_id for planned in PLAN]
START_NS = 1_767_290_400 * NS_PER_S


class Here:
    """A life that runs PLAN, and what it has published."""

    def __init__(self, folder: Path, **options: Any) -> None:
        self.life = Life(folder, PLAN, START_NS, list[object](), 24.0, **options)
        self.items: list[Item] = self.life.reported

    def passes_until(self, kind: str, late_s: float = 0.0) -> None:
        """Until a step of that kind is under way, and so much longer."""
        for _ in range(5000):
            if any(isinstance(item, StepMark) and item.kind == kind for item in self.items):
                break
            self.life.passes(0.5)
        self.life.passes(late_s)

    def kinds(self, *wanted: str) -> list[str]:
        return [item.kind for item in self.items if isinstance(item, Event) and item.kind in wanted]

    def became(self, kind: str) -> list[str]:
        return [str(item.state) for item in self.items if isinstance(item, StepMark) and item.kind == kind]

    def frames(self, since_ns: int = 0) -> int:
        return sum(isinstance(item, Frame) and item.time_ns >= since_ns for item in self.items)


@pytest.fixture
def begun(tmp_path: Path) -> Iterator[Callable[..., Here]]:
    made: list[Here] = []

    def begin(**options: Any) -> Here:
        made.append(Here(tmp_path, **{"follows": True, **options}))
        return made[-1]

    yield begin
    for here in made:
        if not here.life.loop.is_closed():
            here.life.kill()
        assert here.life.wrong == []


def reset(here: Here) -> None:
    here.life.call(lambda: here.life.stand.gate.clear(INTERLOCK))


@pytest.mark.parametrize(("chamber_degC", "is_restarted"), [(24.0, False), (20.0, True)])
def test_a_capture_that_was_held_shortly_is_taken_again_only_if_making_ready_takes_long(
    begun: Callable[..., Here], chamber_degC: float, is_restarted: bool
):
    """The chamber has left its band meanwhile: its soak is soaked again, in which no frame is taken."""
    here = begun(follows=False)
    here.passes_until("capture", 22.0)
    before = here.frames()
    here.life.interlock()
    here.life.publish_pv(chamber_degC)
    here.life.passes(10.0)
    reset(here)
    here.life.passes(2.0)
    here.life.publish_pv(24.0)
    here.life.passes(600.0)
    restarted = [item for item in here.items if isinstance(item, Event) and item.kind == "capture_restarted"]
    assert before >= 4
    assert here.kinds("soak_restarted", "soak_credited") == ["soak_restarted" if is_restarted else "soak_credited"]
    assert [(event.data["step_id"], event.data["frames"]) for event in restarted] == [(ID[3], before)] * is_restarted
    assert here.frames() == CAPTURE.frames + before * is_restarted
    assert here.became("capture") == ["started", "done"]


def test_a_device_error_of_a_step_that_the_guard_holds_for_is_met_once_and_the_step_done_again(
    begun: Callable[..., Here],
):
    met: list[DeviceError] = []
    lives: list[Here] = []

    def meet(error: DeviceError) -> None:
        met.append(error)
        lives[0].life.stand.gate.hold(INTERLOCK)
        lives[0].life.stand.safety.demand()

    lives.append(here := begun(meet=meet))
    here.passes_until("open_flap", 0.0)
    here.life.stand.broken = True
    here.life.passes(20.0)
    assert [type(error) for error in met] == [Unreachable]
    assert not here.life.run.done()
    reset(here)
    here.life.passes(1000.0)
    assert here.life.run.done()
    assert here.life.run.exception() is None
    assert here.frames() == CAPTURE.frames
    assert len(met) == 1


def test_work_of_a_step_that_fails_ends_an_unguarded_run_and_the_step_has_failed(begun: Callable[..., Here]):
    here = begun()

    async def fails(*_: object) -> None:
        raise Unreachable("camera", "no answer")

    here.life.stand.cool_down = fails
    here.passes_until("cool_down", 5.0)
    assert here.became("cool_down") == ["started", "failed"]
    assert here.life.run.done()
    assert isinstance(here.life.run.exception(), Unreachable)


def test_a_set_point_is_set_and_a_camera_that_was_off_is_waited_for(begun: Callable[..., Here]):
    here = begun()
    here.passes_until("capture", 12.0)
    here.life.call(here.life.stand.drop_supply)
    here.life.passes(600.0)
    assert here.became("capture") == ["started", "done"]
    begun_ns = next(
        item.time_ns for item in here.items if isinstance(item, StepMark) and item.kind == "set_temperature"
    )
    assert 0 <= here.life.stand.set_ns - begun_ns <= 2 * NS_PER_S


def test_what_the_camera_gives_off_is_compared_at_the_first_frame_after_a_soak(begun: Callable[..., Here]):
    here = begun(gap=OffsetGap({24.0: 15.0}, 7, 9))
    clock, hub = here.life.clock, here.life.hub

    def publish() -> None:
        for channel, degC in (("camera.temperature", 39.0), ("thermometers.air", 24.0)):
            hub.publish(Batch("device", clock.now_ns(), (Reading(channel, degC, "degC", clock.now_ns()),)))

    for _ in range(40):
        here.life.call(publish)
        here.life.passes(5.0)
    assert here.frames() > 2
    assert here.kinds("camera_offset_same", "camera_offset_changed") == ["camera_offset_same"]
