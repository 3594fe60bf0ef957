"""Three cameras that expose together in real time behind one simulated switch with a small buffer."""

import asyncio
from collections.abc import Generator, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest

from tests.system.conftest import require_aravis
from tests.system.test_several_cameras import simulated
from thermostand.drivers.sim.gige.gvsp_sender import Switch
from thermostand.foundation.clock import WallClock, to_ns
from thermostand.foundation.hub import Hub
from thermostand.foundation.readings import Frame
from thermostand.stand.assembly.assemble import assemble
from thermostand.stand.assembly.simulator import Simulator, describe_laboratory, relocate
from thermostand.stand.config.stand_config import StandConfig


def test_what_a_switch_cannot_hold_is_lost():
    switch = Switch(125.0, buffer_bytes=10_000)
    assert [switch.passes(4000, now_s=1.0) for _ in range(3)] == [True, True, False]
    assert switch.passes(4000, now_s=1.0001)  # 12.5 kB have left meanwhile
    assert switch.lost == 1


@contextmanager
def three_of(*, still: bool, **size_px: int) -> Generator[StandConfig]:
    """Three cameras of a size, by default of the whole sensor; still: their pictures are rendered before."""
    require_aravis()
    data: dict[str, Any] = simulated()
    size = {"packet_size": 8000, "boot_s": 0.2, "poll_s": 5.0, **size_px}
    data["cameras"]["camera"] |= size
    for number, name in enumerate(["left", "right"]):
        data["cameras"][name] = {"address": f"127.0.0.{41 + number}", "serial_number": f"TS-{number}", **size}
    config = StandConfig.model_validate(data)
    laboratory: dict[str, Any] = describe_laboratory(config, virtual=False, seed=None, is_anywhere=True)
    for name in config.cameras:
        laboratory["devices"][name]["settings"]["still"] = still
    simulator = Simulator(laboratory)
    try:
        yield relocate(config, simulator.addresses)
    finally:
        simulator.stop()


@pytest.fixture
def three() -> Iterator[StandConfig]:
    with three_of(still=False, width_px=1224, height_px=1024) as config:
        yield config


async def together(config: StandConfig, frames: int, period_s: float = 0.0) -> tuple[int, int, float]:
    """Frames that came and frames that were lost, of three cameras; by how much the last were late, s."""
    assembly = assemble(config, Hub(), WallClock())
    supply, cameras = assembly.stand.imaging.supply, assembly.devices.cameras
    await assembly.bus.open()
    await assembly.devices.relays.open()
    await supply.switch_on()
    await asyncio.gather(*(camera.grab() for camera in cameras.values()))  # the first opens the stream
    begin_ns, came = assembly.clock.now_ns(), list[list[Frame]]()
    for number in range(1, frames + 1):
        due_ns = begin_ns + number * to_ns(period_s)
        came.append(await asyncio.gather(*(camera.grab(None, due_ns) for camera in cameras.values())))
    late_s = max(frame.time_ns for frame in came[-1]) / 1e9 - (begin_ns / 1e9 + frames * period_s)
    await supply.switch_off()
    await assembly.bus.close()
    shots = [frame for each in came for frame in each]
    size = config.cameras["camera"].height_px or 2048, config.cameras["camera"].width_px or 2448
    assert all(np.asarray(frame.image).shape == size for frame in shots)
    return len(shots), sum(frame.dropped for frame in shots), late_s


async def test_three_cameras_that_leave_time_for_each_other_lose_nothing(three: StandConfig):
    assert (await together(three, frames=4))[:2] == (12, 0)


@pytest.mark.nightly
async def test_three_cameras_of_5_MP_at_two_frames_a_second_lose_nothing_and_keep_the_time():
    with three_of(still=True) as config:
        came, lost, late_s = await together(config, frames=40, period_s=0.5)
    assert (came, lost) == (120, 0)
    assert late_s < 0.5
