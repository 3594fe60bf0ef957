"""What the frames of a resumed run are compared with: the reference that the run had before."""

import asyncio
from collections.abc import AsyncGenerator, Callable
from contextlib import asynccontextmanager
from pathlib import Path

import numpy as np
import pytest

from tests.recording.full_session import MS, START_NS, record
from thermostand.foundation.clock import WallClock
from thermostand.foundation.hub import Hub
from thermostand.foundation.items import Event, StepMark, StepState
from thermostand.foundation.readings import Frame
from thermostand.stand.serving.page_data import PageData
from thermostand.stand.serving.preview import Preview, Setup
from thermostand.stand.serving.recorded_drift import find_run_references
from thermostand.stand.serving.shot import FrameShot

TARGET = (Path(__file__).parents[2] / "configs" / "targets" / "paper-9x6.yaml").read_text("utf-8")
ROLES = ("warm_up", "reference", "reference", "fit", "calibration", "reference", "fit")
LAST_REFERENCE = 5  # each series of reference frames is a new beginning


IMAGE = np.zeros((4, 6), np.uint8)


def moment(time_ns: int, index: int, role: str | None = None):
    """A capture of one frame."""
    step = f"capture-{index}"
    parameters: dict[str, object] = {"role": role or ROLES[index]}
    yield StepMark(time_ns, step, index, "capture", StepState.STARTED, parameters)
    yield Frame("camera.image", IMAGE, time_ns, 0.1, 0.0, 40.0, index + 1, 1000 * index, 0, step)
    yield StepMark(time_ns, step, index, "capture", StepState.DONE, parameters)


@pytest.fixture
async def session(tmp_path: Path) -> Path:
    """An interrupted run."""
    await record(tmp_path / "cycle", len(ROLES), moment)
    return tmp_path / "cycle"


class Looking:
    """Finds no markers, and remembers which frame it was asked to count drift from (as Previewer does)."""

    def __init__(self) -> None:
        self._reference_ns: int | None = None

    def look(self, shot: FrameShot) -> Preview:
        if shot.as_reference or self._reference_ns is None:
            self._reference_ns = shot.time_ns
        setup = Setup((), 0.0, 0.0)
        return Preview(shot.camera, shot.time_ns, 6, 4, shot.role, setup, reference_ns=self._reference_ns)


class InProcess:
    """The process that looks at frames, without a process."""

    def __init__(self) -> None:
        self._made: dict[str, object] = {}

    def line(self, _: str) -> "InProcess":
        return self

    def run(self, function: Callable[..., object], *args: object) -> object:
        return function(*args)

    def make(self, name: str, function: Callable[..., object], *args: object) -> None:
        self._made[name] = function(*args)

    def call(self, name: str, method: str, *args: object) -> object:
        return getattr(self._made[name], method)(*args)

    def close(self) -> None:
        """Nothing to end."""


@asynccontextmanager
async def viewing(session: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> AsyncGenerator[tuple[PageData, Hub]]:
    monkeypatch.setattr("thermostand.stand.serving.page_data.WorkerProcess", lambda *_: InProcess())
    monkeypatch.setattr("thermostand.stand.serving.page_data.make_previewer", lambda _: Looking())
    hub = Hub()
    found = PageData(hub, WallClock(), folder, TARGET)
    running = asyncio.create_task(found.run(lambda: session))
    yield found, hub
    running.cancel()
    await asyncio.gather(running, return_exceptions=True)


async def looked_at(found: PageData, hub: Hub, time_ns: int, role: str):
    for item in moment(time_ns, 9, role):
        hub.publish(item)
    async with asyncio.timeout(60):
        while "camera" not in found.previews or found.previews["camera"].time_ns != time_ns:
            await asyncio.sleep(0.02)
    return found.previews["camera"]


def test_the_reference_of_a_session_is_that_of_its_last_series(session: Path):
    (recalled,) = find_run_references(session)
    assert recalled.shot.time_ns == START_NS + LAST_REFERENCE * 500 * MS
    assert (recalled.shot.as_reference, recalled.last_role) == (True, "fit")


async def test_after_a_restart_drift_is_shown_against_the_runs_own_reference(
    session: Path, monkeypatch: pytest.MonkeyPatch
):
    async with viewing(str(session), session.parent, monkeypatch) as (found, hub):
        hub.publish(Event(0, "info", "run.resume", "resumed"))
        preview = await looked_at(found, hub, START_NS + 100_000 * MS, "fit")
        assert preview.reference_ns == START_NS + LAST_REFERENCE * 500 * MS
        again = await looked_at(found, hub, START_NS + 200_000 * MS, "reference")  # a new series is a new beginning
        assert again.reference_ns == START_NS + 200_000 * MS


async def test_a_session_that_cannot_be_read_is_reported_and_frames_are_looked_at(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    reported: list[str] = []
    async with viewing(str(tmp_path / "nothing"), tmp_path, monkeypatch) as (found, hub):
        hub.subscribe(lambda item: reported.append(item.text) if isinstance(item, Event) else None)
        await looked_at(found, hub, START_NS, "fit")
        assert reported == []  # of a run that begins nothing is recorded yet
        hub.publish(Event(0, "info", "run.resume", "resumed"))
        preview = await looked_at(found, hub, START_NS + 1, "fit")
        assert preview.reference_ns == START_NS
        await asyncio.sleep(0)
    assert "is not found" in reported[-1]
