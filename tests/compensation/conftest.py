"""A small recorded session: photographs of a target that moves with the temperature, through the stand's recorder."""

from __future__ import annotations

import asyncio
import fcntl
import itertools
import os
from collections.abc import AsyncIterator, Callable, Iterable, Iterator, Mapping
from contextlib import asynccontextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np
import pytest
from matplotlib.figure import Figure
from numpy.typing import NDArray

from tests.addresses import WORKER
from tests.recording.device_declarations import declare_devices
from thermostand.compensation.reporting.drawing import figures
from thermostand.foundation.clock import NS_PER_S, VirtualClock
from thermostand.foundation.hub import Hub
from thermostand.foundation.items import Batch, Event, Item, StepMark, StepState
from thermostand.foundation.readings import Frame, Reading
from thermostand.markers.compile_ahead import compile_ahead
from thermostand.recording.writing.recorder import Recorder, RecordingSettings, SessionInfo

from .renderer import Scene, compute_true_centres_px, photograph, render

START_NS = 1_767_290_400 * NS_PER_S
TARGET_YAML = "name: small\ncolumns: 9\nrows: 6\npitch_mm: 30\ndiameter_mm: 10\n"
SEQUENCE = (
    [("warm_up", 24.0)] * 3
    + [("reference", 24.0)] * 4
    + [("fit", degC) for degC in (10.0, 17.0, 31.0, 38.0, 45.0, 52.0, 24.0)]
    + [("validation", degC) for degC in (20.0, 34.0, 48.0)]
)
DARK = 9
"""This frame (a fit at 31 degC) shows nothing."""
GLARE = (11, 20)
"""In this frame a reflection lies on the edge of this marker (from 0)."""


@dataclass(frozen=True)
class Recorded:
    """A session on the disk and the truth about it: centres (F, 54, 2)."""

    path: Path
    true_px: NDArray[np.float64]


def scene_at(index: int) -> Scene:
    """The target drifts by 0.01 px/K along I and 0.03 px/K along J; in the warm-up by 0.3 px a frame along J."""
    role, chamber_degC = SEQUENCE[index]
    above_K = chamber_degC - 24 if role != "warm_up" else -30.0 + 10 * index
    return Scene(
        size=(640, 480), f_px=2000, distance_mm=1000, diameter_mm=10, shift_mm=(0.005 * above_K, 0.015 * above_K)
    )


def photo(index: int) -> NDArray[np.uint8] | NDArray[np.uint16]:
    clean = render(scene_at(index))
    if index == GLARE[0]:
        x, y = compute_true_centres_px(scene_at(index))[GLARE[1]].round().astype(int)
        clean[y - 3 : y + 3, x + 6 : x + 10] = 180
    return photograph(scene_at(index), clean, index)


def published(index: int, time_ns: int, bits: int = 8) -> Iterator[Item]:
    role, chamber_degC = SEQUENCE[index]
    parameters: dict[str, object] = {"frames": 1, "role": role, "chamber_degC": chamber_degC}
    image = np.full((480, 640), 3, np.uint8) if index == DARK else photo(index)
    if bits > 8:
        image = image.astype(np.uint16) * np.uint16(1 << (bits - 8))
    if index < len(SEQUENCE) - 1:
        air = Reading("thermometers.air", chamber_degC + 0.1, "degC", time_ns)
        yield Batch("thermometers", time_ns, (air,))
    yield StepMark(time_ns, f"step-{index}", index, "capture", StepState.STARTED, parameters)
    yield Frame("camera.image", image, time_ns, 0.1, 0.0, chamber_degC + 20, index, 0, 0, f"step-{index}")


STAND = {"thermometers": "thermometers", "camera": "camera"}


@asynccontextmanager
async def recording(
    directory: Path,
    devices: Mapping[str, str] = STAND,
    attachments: Mapping[str, str] = {"target.yaml": TARGET_YAML},
    *,
    session_id: str = "",
    recipe: str = "thermal-cycle",
    serials: str = "TS-0001",
) -> AsyncIterator[tuple[Hub, VirtualClock]]:
    """A recorder under way from START_NS on: what is published is on the disk at the end."""
    clock, hub = VirtualClock(START_NS), Hub()
    info = SessionInfo(session_id or directory.name, recipe, serials, "operator", "0.1.0", "virtual")
    settings = RecordingSettings(telemetry_commit_s=60.0)
    recorder = Recorder(directory, info, dict(attachments), declare_devices(devices), hub, clock, settings=settings)
    recorder.start()
    tasks = [asyncio.create_task(recorder.run()), asyncio.create_task(clock.run())]
    yield hub, clock
    await clock.sleep_until(clock.now_ns() + NS_PER_S)
    for task in tasks:
        task.cancel()
        with suppress(asyncio.CancelledError):
            await task
    await recorder.finish()


async def record_items(
    directory: Path, items: Callable[[int, int], Iterable[Item]], count: int, every_s: int, **how: Any
) -> None:
    """A session of what `items` gives for 0, 1, ... and the instant, ns, so often; how: as `recording` takes it."""
    async with recording(directory, **how) as (hub, clock):
        for index in range(count):
            await clock.sleep_until(START_NS + index * every_s * NS_PER_S)
            for item in items(index, clock.now_ns()):
                hub.publish(item)


async def record(
    directory: Path,
    attachments: dict[str, str],
    frames: int = len(SEQUENCE),
    events: Mapping[int, Event] | None = None,
    bits: int = 8,
) -> None:
    """The first frames of the sequence, one a minute; events come right after the frame of that index."""

    def items(index: int, time_ns: int) -> Iterator[Item]:
        yield from published(index, time_ns, bits)
        if events and index in events:
            yield events[index]

    await record_items(directory, items, frames, 60, attachments=attachments)


def compile_fit(lock: Path) -> None:
    """Find markers, one of them under glare: all that is compiled for it is then kept."""
    with lock.open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        compile_ahead(lambda: None)


@pytest.fixture(scope="session", autouse=True)
def _compiled(compiled_fit: None) -> None:
    """Any of these tests may find markers."""


@pytest.fixture(scope="session", autouse=True)
def _quick_layout() -> Iterator[None]:
    """Half of a figure's time is the search for a layout without overlaps; what it draws is drawn here, too."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(figures, "LAYOUT", None)
        yield


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Half of a report's time is to draw its figures, which other tests do: here their places stay empty."""

    def empty(figure: Figure, file: IO[str], **_: object) -> None:
        file.write("<svg></svg>")

    monkeypatch.setattr(Figure, "savefig", empty)


@pytest.fixture(scope="session")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Recorded:
    """The session, not to be changed. The first worker that needs it records it for all."""
    folder = tmp_path_factory.getbasetemp().parent if WORKER in os.environ else tmp_path_factory.mktemp("sessions")
    path, made = folder / "cycle", folder / "session is recorded"
    with (folder / "recording").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not made.exists():
            asyncio.run(record(path, {"target.yaml": TARGET_YAML}))
            made.touch()
    return Recorded(path, np.array([compute_true_centres_px(scene_at(index)) for index in range(len(SEQUENCE))]))


@pytest.fixture(autouse=True)
def _own_cache(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> None:
    """Markers that an earlier test, or the developer, has found are not those of this test."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.getbasetemp() / f"cache-{next(_numbers)}"))


_numbers = itertools.count()
