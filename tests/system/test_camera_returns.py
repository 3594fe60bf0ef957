"""A camera that restarts in a capture and is not ready at once when it answers again."""

from collections.abc import Callable
from pathlib import Path

from tests.system.test_run_ends import SHORTER, break_now
from thermostand.foundation.hub import Hub
from thermostand.foundation.items import Event, Item
from thermostand.foundation.readings import Frame
from thermostand.recording.format.capture_restarts import find_restart_times, is_superseded
from thermostand.recording.reading.session import Session
from thermostand.stand.running.order import Order
from thermostand.stand.service.run import run_virtual


async def test_a_camera_that_returns_without_a_stream_channel_is_tried_until_it_has_one(
    tmp_path: Path, order: Callable[..., Order]
):
    # It answers at once: a camera that is absent costs Aravis 10 s of real time.
    ordered, lost, frames = order(SHORTER, camera={"boot_s": 0}), list[str](), list[Frame]()

    def follow(item: Item) -> None:
        if isinstance(item, Frame):
            frames.append(item)
            if len(frames) == 1:
                break_now(ordered, "camera.no_stream_channel", True)
        elif isinstance(item, Event) and item.kind == "camera_lost":
            lost.append(item.text)
        elif isinstance(item, Event) and item.kind == "flap_shut_in_hold":
            break_now(ordered, "camera.no_stream_channel", False)

    def watch(hub: Hub) -> None:
        hub.subscribe(follow)

    session = Session.open(await run_virtual(ordered, tmp_path / "out", None, watch))
    assert session.events()[-1].text == "complete"
    begins_ns = find_restart_times(session.events())
    assert (
        len([meta for meta in session.frame_metas() if not is_superseded(meta.time_ns, meta.step_id, begins_ns)]) == 3
    )
    kinds = [event.kind for event in session.events()]
    assert "camera_equilibrium_lost" in kinds  # it has restarted: the frame before is taken again when it has soaked
    assert kinds.index("camera_equilibrium") > kinds.index("camera_equilibrium_lost")
    assert len(lost) == 2  # one hold until it gives frames, not one for each try: the flap is shut in it
    assert "stream channel" in lost[-1]
