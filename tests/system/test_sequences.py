"""A warm-up, a calibration and a validation, shortened, over every wire in virtual time."""

from collections.abc import Callable
from pathlib import Path

import pytest

from tests.system.conftest import WHOLE_SENSOR
from thermostand.compensation.observations import observe
from thermostand.experiments.steps import Role
from thermostand.foundation.items import Event, StepMark, StepState
from thermostand.foundation.progress import progress
from thermostand.recording.reading.session import Session
from thermostand.stand.running.order import Order
from thermostand.stand.service.run import run_virtual

RECIPE = """
name: sequences
experiments:
  - warm_up:
      table_position: {linear: 10, rotary: 0}
      frames: 3
      interval_s: 60
      rolls_deg: [0, 20]
  - calibration:
      equilibrium_s: 120
      linear_mm: [10, 30]
      rotary_deg: [-5, 5]
      left_out: [{linear_mm: 30, rotary_deg: 5}]
      frames_per_position: 1
      settle_s: 90
  - validation:
      temperatures_degC: [24, 27]
      positions: [{linear_mm: 20, rotary_deg: 0}, {linear_mm: 25, rotary_deg: 4}]
      equilibrium_s: 120
      soak_s: 120
      reference_frames: 2
      frames_per_position: 1
      check_home_every: 1
"""
HOME_CHECKS = 4 + 6  # both axes: twice in the calibration, three times in the validation


@pytest.mark.usefixtures("compiled_fit")
async def test_the_sequences_run_over_the_wire_and_leave_what_the_paper_needs(
    tmp_path: Path, order: Callable[..., Order]
):
    session = Session.open(
        await run_virtual(order(RECIPE, camera=WHOLE_SENSOR), tmp_path / "sessions", 3, lambda _: None)
    )
    check_frames(session)
    check_events(session.events())
    check_warm_up(session)
    check_places(session)
    check_relaxed_stages_came_back(session)
    check_no_drift_is_fitted_to_them(session)


def captures(session: Session) -> list[tuple[StepMark, StepMark]]:
    """Beginning and end of each capture."""
    marks = [mark for mark in session.steps() if mark.kind == "capture"]
    assert [mark.state for mark in marks] == [StepState.STARTED, StepState.DONE] * (len(marks) // 2)
    return list(zip(marks[::2], marks[1::2], strict=True))


def check_frames(session: Session) -> None:
    roles = [str(begin.parameters["role"]) for begin, _ in captures(session)]
    assert roles == [
        *[Role.WARM_UP] * 2,
        *[Role.CALIBRATION] * 3,
        *([Role.POSE] * 2 + [Role.REPEATABILITY]) * 2,
    ]
    assert session.frame_count == 2 * 3 + 3 + 3 * 2 + 3
    assert all(frame.image.max() > 150 for frame in session.frames())  # the flap was open


def check_events(events: list[Event]) -> None:
    kinds = [event.kind for event in events]
    assert kinds.count("prompt") == kinds.count("prompt_skipped") == 1
    assert kinds.count("home_residual") == HOME_CHECKS
    assert "home_residual_large" not in kinds
    assert "homed" not in kinds
    assert kinds.count("cooled_down") == 2


def check_warm_up(session: Session) -> None:
    """The second time the camera is warm before, and at the air's temperature when it is switched on again."""
    marks = [mark for mark in session.steps() if mark.kind == "cool_down"]
    waits_s = [(end.time_ns - begin.time_ns) / 1e9 for begin, end in zip(marks[::2], marks[1::2], strict=True)]
    assert waits_s[0] < 60.0 < waits_s[1]
    begins = {begin.step_id for begin, _ in captures(session)[:2]}
    own = [(meta.time_ns, meta) for meta in session.frame_metas() if meta.step_id in begins]
    cold_degC = [own[0][1].camera_degC, own[3][1].camera_degC]
    assert max(cold_degC) < 26.0
    # At once: from the camera's start to its first frame no more than its boot.
    starts_ns = [
        mark.time_ns
        for mark in session.steps()
        if mark.kind == "power_camera" and mark.parameters["on"] and mark.state is StepState.STARTED
    ]
    for start_ns, (time_ns, _) in zip(starts_ns, (own[0], own[3]), strict=True):
        assert (time_ns - start_ns) / 1e9 < 8.0


def check_places(session: Session) -> None:
    """The moves before each capture are where the recipe wants the target."""
    table: dict[str, float] = {}
    places: list[tuple[float, float]] = []
    for mark in session.steps():
        if mark.state is not StepState.DONE:
            continue
        if mark.kind == "move_to":
            table[str(mark.parameters["axis"])] = float(str(mark.parameters["position"]))
        if mark.kind == "capture":
            places.append((table["linear"], table["rotary"]))
    poses = [(20.0, 0.0), (25.0, 4.0), (20.0, 0.0)]
    assert places == [(10.0, 0.0)] * 2 + [(10.0, -5.0), (10.0, 5.0), (30.0, -5.0)] + poses * 2


def check_relaxed_stages_came_back(session: Session) -> None:
    """90 s after its move the linear stage has no current: those captures approach again; the rotary one has some."""
    texts = [event.text for event in session.events() if event.kind == "re-approached"]
    assert len(texts) == 3
    assert all(text.startswith("linear: motor off") for text in texts)


def check_no_drift_is_fitted_to_them(session: Session) -> None:
    """A search for the frames of the drift finds none, but the warm-up's."""
    observed = observe([session.path], progress)
    cycle = (Role.REFERENCE, Role.FIT, Role.VALIDATION)
    assert observed.of(*cycle).sum() == 0
    elsewhere = (Role.CALIBRATION, Role.POSE, Role.REPEATABILITY)
    assert (observed.of(Role.WARM_UP).sum(), observed.of(*elsewhere).sum()) == (6, 12)
    assert observed.of(Role.OTHER).sum() == 0
