"""A capture that is interrupted, whatever holds it: the flap is shut within a minute, a short pause costs nothing, and
after a long one all of its frames are taken again."""

import asyncio
from collections.abc import Awaitable, Callable
from pathlib import Path

import numpy as np
import pytest

from tests.daemon_queries import ask
from tests.recording.disks import limit_files
from tests.system.test_run import fault
from thermostand.experiments.steps import Capture
from thermostand.foundation.clock import NS_PER_S, to_ns
from thermostand.foundation.hub import Hub
from thermostand.foundation.items import Batch, Event, Item
from thermostand.foundation.readings import Frame
from thermostand.recording.format.capture_restarts import find_restart_times, is_superseded
from thermostand.recording.reading.session import Session
from thermostand.stand.running.order import Order
from thermostand.stand.service.run import run_virtual

RECIPE = """
name: interrupted
experiments:
  - calibration:
      equilibrium_s: 30
      linear_mm: [0]
      rotary_deg: [0]
      frames_per_position: 12
      interval_s: 7
"""
FRAMES, INTERRUPTED_AFTER = 12, 3


Action = Callable[[], Awaitable[object]]


class Interrupter:
    """A watch that does `begin` after three frames, and `end` so much of the stand's time later."""

    def __init__(self, begin: Action, end: Action, length_s: float) -> None:
        self.events: list[Event] = []
        self._begin, self._end, self._length_ns = begin, end, to_ns(length_s)
        self._frames, self._end_ns = 0, 0
        self._tasks: list[asyncio.Future[object]] = []

    def __call__(self, hub: Hub) -> None:
        hub.subscribe(self._follow)

    def _follow(self, item: Item) -> None:
        if isinstance(item, Event):
            self.events.append(item)
        if isinstance(item, Frame):
            self._frames += 1
            if self._frames == INTERRUPTED_AFTER:
                self._end_ns = item.time_ns + self._length_ns
                self._tasks.append(asyncio.ensure_future(self._begin()))
        if isinstance(item, Batch) and 0 < self._end_ns <= item.time_ns:
            self._end_ns = 0
            self._tasks.append(asyncio.ensure_future(self._end()))

    async def ended(self) -> None:
        await asyncio.gather(*self._tasks)

    def of(self, kind: str) -> list[Event]:
        return [event for event in self.events if event.kind == kind]

    def times_s(self, kind: str, reason: str | None = None) -> list[float]:
        """When events of a kind came; those of one reason, or all."""
        return [event.time_ns / NS_PER_S for event in self.of(kind) if reason in (None, event.data.get("reason"))]


def operator(out: Path, do: str) -> Action:
    async def act() -> None:
        (directory,) = out.iterdir()
        await asyncio.to_thread(ask, directory, do)

    return act


def disk(size_bytes: int | None) -> Action:
    async def act() -> None:
        limit_files(size_bytes)

    return act


async def interrupted(order: Order, out: Path, interrupter: Interrupter) -> Session:
    try:
        directory = await run_virtual(order, out, None, interrupter)
    finally:
        limit_files(None)
    await interrupter.ended()
    return Session.open(directory)


def counted_ns(session: Session) -> list[int]:
    """Instants of the frames that count."""
    begins_ns = find_restart_times(session.events())
    return [m.time_ns for m in session.frame_metas() if not is_superseded(m.time_ns, m.step_id, begins_ns)]


def check_again(session: Session, order: Order) -> None:
    """All frames of the capture, without a gap, through an open flap."""
    (capture,) = (planned for planned in order.recipe.plan() if isinstance(planned.step, Capture))
    times_ns = counted_ns(session)
    assert len(times_ns) == FRAMES
    assert max(np.diff(times_ns)) < 10 * NS_PER_S
    (restart,) = [event for event in session.events() if event.kind == "capture_restarted"]
    assert restart.data["step_id"] == capture.step_id
    assert isinstance(restart.data["frames"], int)
    assert restart.data["frames"] >= INTERRUPTED_AFTER
    levels = {frame.time_ns: float(np.mean(frame.image)) for frame in session.frames()}
    first = levels[min(levels)]
    assert all(levels[time_ns] == pytest.approx(first, rel=0.1) for time_ns in times_ns)
    # What is not recorded for long makes the stand safe, and ends by itself; nothing else objects.
    assert {event.kind for event in session.events() if event.kind.startswith("guard.")} <= {"guard.not_recorded"}


def check_shut(interrupter: Interrupter, session: Session, begin_s: float, end_s: float) -> None:
    """Within a minute of the hold, and until its end."""
    shut_s = interrupter.times_s("flap_shut_in_hold")
    assert len(shut_s) <= 1  # or the guard has shut it before
    assert all(each_s - begin_s <= 60.0 for each_s in shut_s)
    flap_ns, openness = session.readings("flap.position")
    during = (flap_ns > (begin_s + 61.0) * NS_PER_S) & (flap_ns < end_s * NS_PER_S)
    assert during.any()
    assert openness[during].max() < 0.02


async def test_a_long_pause_shuts_the_flap_and_the_capture_is_taken_again(tmp_path: Path, order: Callable[..., Order]):
    ordered, out = order(RECIPE), tmp_path / "out"
    interrupter = Interrupter(operator(out, "pause"), operator(out, "continue"), 300.0)
    session = await interrupted(ordered, out, interrupter)
    check_again(session, ordered)
    (begin_s,), (end_s,) = interrupter.times_s("held", "operator"), interrupter.times_s("released", "operator")
    check_shut(interrupter, session, begin_s, end_s)


async def test_a_short_pause_leaves_the_flap_open_and_the_capture_goes_on(tmp_path: Path, order: Callable[..., Order]):
    ordered, out = order(RECIPE), tmp_path / "out"
    interrupter = Interrupter(operator(out, "pause"), operator(out, "continue"), 30.0)
    session = await interrupted(ordered, out, interrupter)
    assert len(counted_ns(session)) == session.frame_count == FRAMES
    assert interrupter.times_s("held", "operator")
    assert interrupter.times_s("flap_shut_in_hold") == interrupter.times_s("capture_restarted") == []
    flap_ns, openness = session.readings("flap.position")
    times_ns = counted_ns(session)
    assert openness[(flap_ns > times_ns[0]) & (flap_ns < times_ns[-1])].min() > 0.9


@pytest.mark.nightly  # each try to reach it takes real seconds
async def test_a_camera_that_is_lost_for_long_does_not_leave_the_flap_open(tmp_path: Path, order: Callable[..., Order]):
    ordered, out = order(RECIPE, camera={"heartbeat_s": 1.5}), tmp_path / "out"
    lost, back = (lambda: fault(ordered, "camera.silent", True)), (lambda: fault(ordered, "camera.silent", False))
    interrupter = Interrupter(lost, back, 200.0)
    session = await interrupted(ordered, out, interrupter)
    check_again(session, ordered)
    begin_s, end_s = interrupter.times_s("held", "camera_lost"), interrupter.times_s("released", "camera_lost")
    check_shut(interrupter, session, begin_s[0], end_s[0])


async def test_a_disk_that_refuses_some_frames_costs_neither_the_run_nor_a_frame(
    tmp_path: Path, order: Callable[..., Order]
):
    """For so short a time that nothing is held: the capture is taken again when the disk takes frames again."""
    ordered, out = order(RECIPE), tmp_path / "out"
    interrupter = Interrupter(disk(4096), disk(None), 20.0)
    session = await interrupted(ordered, out, interrupter)
    check_again(session, ordered)
    (dropped,) = interrupter.of("frames_dropped")
    (restart,) = interrupter.of("capture_restarted")
    assert dropped.time_ns < restart.time_ns
    assert "the disk has lost" in restart.text


async def test_a_disk_that_refuses_for_long_costs_neither_the_run_nor_a_frame(
    tmp_path: Path, order: Callable[..., Order]
):
    """Longer than the guard lets the flap be open: nobody has to reset anything."""
    ordered, out = order(RECIPE, guard={"flap_capture_s": 150.0}), tmp_path / "out"
    interrupter = Interrupter(disk(4096), disk(None), 300.0)
    session = await interrupted(ordered, out, interrupter)
    check_again(session, ordered)
    begin_s, end_s = interrupter.times_s("held"), interrupter.times_s("released")
    check_shut(interrupter, session, begin_s[0], end_s[0])
