"""A camera that shows a wrong temperature around each capture: what is recorded, said, and left out of a fit."""

from collections import Counter
from collections.abc import Callable
from pathlib import Path

from tests.system.conftest import WHOLE_SENSOR
from tests.system.test_run_ends import break_now
from thermostand.compensation.observations import observe
from thermostand.foundation.hub import Hub
from thermostand.foundation.items import Batch, Item, StepMark, StepState
from thermostand.foundation.readings import TEMPERATURE_SUSPECT, Quality
from thermostand.recording.exporting.export import make_frames_rows
from thermostand.recording.reading.overview import summarise_session
from thermostand.recording.reading.session import Session
from thermostand.stand.running.order import Order
from thermostand.stand.service.run import run_virtual

OFFSET_K = 10.0
RECIPE = """
name: suspect
experiments:
  - thermal_cycle:
      table_position: {linear: 2, rotary: 1}
      equilibrium_s: 300
      set_points_degC: [30, 24]
      soak_s: 300
      reference_frames: 1
      frames_per_point: 1
"""


async def test_frames_of_a_camera_that_is_wrong_at_each_capture_say_so(tmp_path: Path, order: Callable[..., Order]):
    """It is wrong from the begin of each capture but the first on, before any reading has shown it."""
    ordered, captures = order(RECIPE, camera=WHOLE_SENSOR), list[str]()

    def follow(item: Item) -> None:
        if not isinstance(item, StepMark) or item.kind != "capture":
            return
        if item.state is StepState.STARTED:
            captures.append(item.step_id)
            break_now(ordered, "camera.temperature_offset_K", OFFSET_K if len(captures) > 1 else 0.0)
        elif len(captures) > 1:
            break_now(ordered, "camera.temperature_offset_K", 0.0)

    def watch(hub: Hub) -> None:
        hub.subscribe(follow)

    path = await run_virtual(ordered, tmp_path / "out", None, watch)
    session = Session.open(path)
    flags = [(meta.step_id != captures[0], meta.flags) for meta in session.frame_metas()]
    assert [flag for is_wrong, flag in flags if not is_wrong] == [()]
    assert {flag for is_wrong, flag in flags if is_wrong} == {(TEMPERATURE_SUSPECT,)}
    count = sum(is_wrong for is_wrong, _ in flags)
    assert count >= 2
    assert [frame.flags for frame in session.frames()] == [flag for _, flag in flags]
    assert Counter(session.frames_table().flags.tolist())[TEMPERATURE_SUSPECT] == count
    assert summarise_session(path).frames.flagged == {TEMPERATURE_SUSPECT: count}
    columns, rows = make_frames_rows(session, None)
    place = [column.name for column in columns].index("flags")
    assert Counter(row[place] for row in rows)[TEMPERATURE_SUSPECT] == count
    kinds = Counter(event.kind for event in session.events() if "channels" in event.data)
    assert kinds == {"guard.sensor_jumped": len(captures) - 1, "sensor_believed": len(captures) - 1}
    wrong_ns = {
        each.time_ns
        for item in session.items()
        if isinstance(item, Batch)
        for each in item.readings
        if each.channel == "camera.temperature" and each.quality is Quality.STALE and each.cause == "suspect"
    }
    assert (
        set(session.readings("camera.temperature")[0].tolist())
        - set(session.believed("camera.temperature")[0].tolist())
        == wrong_ns
    )
    observed = observe(path)
    assert Counter(observed.reasons)[""] == 1
    assert list(observed.left_out.values()) == [count]
