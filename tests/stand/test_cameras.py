"""Several cameras as one: frames of all or of none, and whichever was lost."""

import asyncio
from collections.abc import AsyncIterator
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
import pytest

from thermostand.foundation.clock import VirtualClock, WallClock, to_ns
from thermostand.foundation.errors import ConfigError, Unreachable
from thermostand.foundation.readings import Frame
from thermostand.stand.imaging.cameras import Cameras
from thermostand.stand.imaging.imaging import grab_together


@dataclass
class Camera:
    name: str
    clock: VirtualClock
    is_usable: bool = True
    restarted: str = ""
    opened: int = 0

    async def open(self) -> None:
        self.opened += 1
        self.is_usable = True

    async def close(self) -> None:
        self.is_usable = False

    async def grab(self, exposure_s: float | None = None, due_ns: int = 0) -> Frame:
        if not self.is_usable:
            raise Unreachable(self.name, "lost")
        image = np.zeros((2, 3), np.uint8)
        return Frame(f"{self.name}.image", image, self.clock.now_ns() + due_ns, exposure_s or 0.1, 0.0, 40.0, 1, 0)


@pytest.fixture
async def pair() -> AsyncIterator[tuple[Camera, Camera, Cameras]]:
    clock = VirtualClock(0)
    one, other = Camera("camera", clock), Camera("side", clock)
    time = asyncio.create_task(clock.run())
    yield one, other, Cameras(cast("Any", {"camera": one, "side": other}))
    time.cancel()


async def test_each_gives_a_frame_of_the_instant_that_is_due(
    pair: tuple[Camera, Camera, Cameras],
):
    frames = await grab_together(cast("Any", pair[:2]), cast("Any", pair[0].clock), 0.2, due_ns=500)
    assert [(frame.channel, frame.time_ns, frame.exposure_s) for frame in frames] == [
        ("camera.image", 500, 0.2),
        ("side.image", 500, 0.2),
    ]


async def test_in_real_time_they_expose_together():
    meeting = asyncio.Barrier(2)

    class Together(Camera):
        async def grab(self, exposure_s: float | None = None, due_ns: int = 0) -> Frame:
            await asyncio.wait_for(meeting.wait(), 5)  # each waits for the other: one after the other would never end
            return Frame(f"{self.name}.image", np.zeros((2, 3), np.uint8), due_ns, 0.1, 0.0, 40.0, 1, 0)

    clock = WallClock()
    cameras = [Together(name, cast("Any", clock)) for name in ("camera", "side")]
    due_ns = clock.now_ns() + to_ns(1.0)
    frames = await grab_together(cast("Any", cameras), clock, 0.1, due_ns)
    assert [frame.time_ns - due_ns for frame in frames] == [0, 0]


async def test_when_one_is_lost_no_frames_are_taken_until_all_are_open_again(
    pair: tuple[Camera, Camera, Cameras],
):
    one, other, cameras = pair
    other.is_usable = False
    assert not cameras.is_usable
    with pytest.raises(Unreachable, match="side"):
        await grab_together(cast("Any", pair[:2]), one.clock, 0.2)
    await cameras.open()
    assert (cameras.is_usable, len(await grab_together(cast("Any", pair[:2]), one.clock, 0.2))) == (True, 2)
    assert (one.opened, other.opened) == (1, 1)


async def test_whichever_has_restarted_is_reported(pair: tuple[Camera, Camera, Cameras]):
    one, other, cameras = pair
    assert cameras.restarted == ""
    one.restarted, other.restarted = "one", "other"
    assert cameras.restarted == "one; other"


async def test_without_any_opening_is_refused_with_a_sentence():
    none = Cameras({})
    await none.close()
    with pytest.raises(ConfigError, match="name it under cameras"):
        await none.open()
