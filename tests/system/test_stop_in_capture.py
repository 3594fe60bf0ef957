"""A stop that arrives while a frame is taken: the flap, which is open, closes and nothing is taken for a jam."""

import asyncio
import os
import signal
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.system.conftest import SHORT_RECIPE
from thermostand.foundation.hub import Hub
from thermostand.foundation.items import Item
from thermostand.foundation.readings import Frame
from thermostand.recording.reading.session import Session
from thermostand.stand.running.order import Order
from thermostand.stand.service.run import Interrupted, run_virtual

SHORTER = SHORT_RECIPE.replace("600", "60").replace("[30, 20, 24]", "[26]").replace("held_out_degC: [20]", "")
SEVERAL = SHORTER.replace("reference_frames: 2", "reference_frames: 5")


@pytest.mark.parametrize("again_after_s", [None, 0.0, 0.02])
async def test_a_stop_during_a_grab_closes_the_flap_and_reports_no_jam(
    tmp_path: Path, order: Callable[..., Order], again_after_s: float | None
):
    """The signals come from outside of virtual time: they are served whatever the clock is doing."""
    frames: list[Item] = []

    def follow(item: Item) -> None:
        if isinstance(item, Frame):
            frames.append(item)
            if len(frames) == 2:
                os.kill(os.getpid(), signal.SIGTERM)
                if again_after_s is not None:
                    loop = asyncio.get_running_loop()
                    loop.call_later(again_after_s, os.kill, os.getpid(), signal.SIGTERM)

    def watch(hub: Hub) -> None:
        hub.subscribe(follow)

    with pytest.raises(Interrupted, match="stopped by the operator"):
        await run_virtual(order(SEVERAL), tmp_path / "out", None, watch)
    (directory,) = (tmp_path / "out").iterdir()
    session = Session.open(directory)
    assert [event.text for event in session.events() if event.level == "error" and event.kind != "run.end"] == []
    assert session.readings("flap.position")[1][-1] == pytest.approx(0, abs=0.02)
