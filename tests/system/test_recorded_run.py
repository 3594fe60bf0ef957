"""What a run records, and what it does first with what an earlier one has left."""

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np

from tests.system.conftest import WHOLE_SENSOR
from thermostand.compensation.observations import observe_session, read_session_target
from thermostand.foundation.hub import Hub
from thermostand.foundation.items import Event
from thermostand.recording.reading.session import Session
from thermostand.stand.running.order import Order
from thermostand.stand.service.run import run_virtual

RECIPE = """
name: short
experiments:
  - thermal_cycle:
      table_position: {linear: 2, rotary: 1}
      equilibrium_s: 60
      set_points_degC: [24]
      held_out_degC: []
      soak_s: 60
      reference_frames: 3
      frames_per_point: 2
"""


async def test_roi_keeps_the_markers_and_a_whole_frame_of_each_capture(tmp_path: Path, order: Callable[..., Order]):
    directory = await run_virtual(
        order(RECIPE, camera=WHOLE_SENSOR, recording={"frame_encoding": "roi"}),
        tmp_path / "out",
        None,
        lambda hub: None,
    )
    session = Session.open(directory)
    windows = [frame.windows for frame in session.frames()]
    assert [0 if window is None else len(window) for window in windows] == [0, 54, 54, 0, 54]
    observed = observe_session(session, read_session_target(session))
    assert observed.usable.all()
    assert not np.isnan(observed.centres_px).any()
    sizes = [image.stored_bytes for image in session.images()]
    assert max(sizes[1], sizes[2], sizes[4]) < min(sizes[0], sizes[3]) / 4


async def test_a_run_first_salvages_what_a_killed_one_has_left(tmp_path: Path, order: Callable[..., Order]):
    ordered, events = order(RECIPE, camera=WHOLE_SENSOR), []
    whole = await run_virtual(ordered, tmp_path / "first", None, lambda hub: None)
    left = tmp_path / "out" / "killed"
    shutil.copytree(whole, left)
    frames = left / "frames" / "0000.mcap"
    frames.rename(left / "frames" / "0000.mcap.part")
    with (left / "frames" / "0000.mcap.part").open("r+b") as file:
        file.truncate(file.seek(0, 2) - 3_000_000)  # in the last frame: the index and a part of the image are gone

    def watch(hub: Hub) -> None:
        hub.subscribe(lambda item: events.append(item) if isinstance(item, Event) else None)

    await run_virtual(ordered, tmp_path / "out", None, watch)
    assert "repaired" in [event.kind for event in events]
    assert events[0].kind == "repaired"
    assert "killed/frames/0000.mcap" in events[0].text
    assert Session.open(left).frame_count == Session.open(whole).frame_count - 2
