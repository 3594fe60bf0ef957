"""A disk that fills during a capture holds the run until there is room again, and costs no frame."""

import os
import shutil
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from tests.system.conftest import require_aravis
from thermostand.experiments.steps import Capture
from thermostand.foundation.items import Event, Item
from thermostand.foundation.readings import Frame
from thermostand.recording.reading.session import Session
from thermostand.stand.running.order import Order
from thermostand.stand.service.run import run_virtual

RECIPE = """
name: disk
experiments:
  - calibration:
      equilibrium_s: 30
      linear_mm: [0]
      rotary_deg: [0]
      frames_per_position: 12
      interval_s: 7
"""
MEMORY = Path("/dev/shm")  # what others write to a disk would be seen
SPACE_GB = 0.25


@pytest.fixture
def memory() -> Iterator[Path]:
    require_aravis()
    if not MEMORY.is_dir():
        pytest.skip(f"needs {MEMORY}")
    with tempfile.TemporaryDirectory(dir=MEMORY) as folder:
        yield Path(folder)


async def test_a_disk_that_fills_during_a_capture_holds_it_and_costs_no_frame(
    memory: Path, order: Callable[..., Order]
):
    limit_GB = shutil.disk_usage(memory).free / 1e9 - SPACE_GB
    ordered = order(RECIPE, recording={"stop_frames_below_GB": limit_GB, "frame_encoding": "zstd"})
    ballast, frames, kinds = memory / "ballast", list[int](), list[str]()

    def follow(item: Item) -> None:
        if isinstance(item, Frame):
            frames.append(item.time_ns)
            if len(frames) == 3:
                with ballast.open("wb") as file:
                    os.posix_fallocate(file.fileno(), 0, round(2e9 * SPACE_GB))
        if isinstance(item, Event):
            kinds.append(f"{item.kind} {item.data['reason']}" if item.kind in ("held", "released") else item.kind)
            if kinds[-1] == "held disk_low":
                ballast.unlink()

    session = Session.open(await run_virtual(ordered, memory / "out", None, lambda hub: hub.subscribe(follow)))
    (capture,) = (planned.step for planned in ordered.recipe.plan() if isinstance(planned.step, Capture))
    assert session.frame_count == capture.frames == 12
    assert kinds.index("frames_stopped") < kinds.index("held disk_low") < kinds.index("released disk_low")
