"""A camera that is lost in a soak, when no frame asks for it: opened again at once, and soaked again when it has
restarted meanwhile."""

import asyncio
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from tests.system.conftest import FAST
from tests.system.test_run import fault
from tests.system.test_unrecorded_heat import SOAK, happens, heating
from thermostand.foundation.items import Batch
from thermostand.recording.reading.session import Session
from thermostand.stand.running.order import Order


def temperatures_good(directory: Path) -> list[bool]:
    session = Session.open(directory)
    batches = [item for item in session.items() if isinstance(item, Batch)]
    values = [each.value for batch in batches for each in batch.readings if each.channel == "camera.temperature"]
    return [not np.isnan(value) for value in values]


async def test_a_camera_that_was_cut_off_in_a_soak_is_opened_again_and_keeps_its_soak(
    tmp_path: Path, order: Callable[..., Order], simulator: Callable[..., object]
):
    # A camera that was switched on a second ago could not be distinguished from one that has started again meanwhile.
    ordered = order(SOAK, **{**FAST, "camera": {"poll_s": 0.5, "boot_s": 2.5}})
    await asyncio.to_thread(simulator, ordered.config, False)
    async with heating(ordered, tmp_path / "out") as (_, watcher):
        await fault(ordered, "camera.silent", True)
        await happens(watcher, "device_lost")
        await fault(ordered, "camera.silent", False)
        await happens(watcher, "camera_back")
        await happens(watcher, "device_back")
        assert [event.text for event in watcher.events if event.kind == "camera_equilibrium_lost"] == []
    good = temperatures_good(next((tmp_path / "out").glob("2*")))
    assert good[0]
    assert good[-2]  # the last one is of a stand that is taken down
    assert not all(good)


@pytest.mark.nightly  # a minute of real time
async def test_a_camera_that_restarted_by_itself_in_a_soak_is_soaked_again(
    tmp_path: Path, order: Callable[..., Order], simulator: Callable[..., object]
):
    ordered = order(SOAK, **FAST)
    await asyncio.to_thread(simulator, ordered.config, False)
    async with heating(ordered, tmp_path / "out") as (_, watcher):
        await fault(ordered, "camera.restart", True)
        await happens(watcher, "camera_equilibrium_lost")
        await happens(watcher, "camera_back")
        (lost,) = [event for event in watcher.events if event.kind == "camera_equilibrium_lost"]
        assert "has restarted" in lost.data["reason"]
        await happens(watcher, "restored")  # the run goes on; the soak that follows waits for the equilibrium
