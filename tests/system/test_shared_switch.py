"""Three cameras that expose together in real time behind one simulated switch with a small buffer."""

import asyncio
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from drivers.sim.gige.switch import Switch
from foundation.clock import WallClock
from foundation.hub import Hub
from stand.assembly import assemble
from stand.config.stand_config import StandConfig
from stand.simulator import Simulator, laboratory_of, relocated
from tests.system.conftest import require_aravis
from tests.system.test_several_cameras import simulated


def test_what_a_switch_cannot_hold_is_lost():
    switch = Switch(125.0, buffer_bytes=10_000)
    assert [switch.passes(4000, now_s=1.0) for _ in range(3)] == [True, True, False]
    assert switch.passes(4000, now_s=1.0001)  # 12.5 kB have left meanwhile
    assert switch.lost == 1


@pytest.fixture
def three() -> Iterator[StandConfig]:
    require_aravis()
    data = simulated()
    size = {"width_px": 1224, "height_px": 1024, "packet_size": 8000, "boot_s": 0.2, "poll_s": 5.0}
    data["cameras"]["camera"] |= size
    for number, name in enumerate(["left", "right"]):
        data["cameras"][name] = {"address": f"127.0.0.{41 + number}", "serial_number": f"TS-{number}", **size}
    config = StandConfig.model_validate(data)
    simulator = Simulator(laboratory_of(config, virtual=False, seed=None, is_anywhere=True))
    yield relocated(config, simulator.addresses)
    simulator.stop()


async def together(config: StandConfig, tmp_path: Path, frames: int) -> tuple[int, int]:
    """Frames that came and frames that were lost, of three cameras."""
    assembly = assemble(config, Hub(), WallClock())
    supply, cameras = assembly.stand.imaging.supply, assembly.devices.cameras
    await assembly.bus.open()
    await assembly.devices.relays.open()
    await supply.switch_on()
    came = [await asyncio.gather(*(camera.grab() for camera in cameras.values())) for _ in range(frames)]
    await supply.switch_off()
    await assembly.bus.close()
    shots = [frame for each in came for frame in each]
    assert all(np.asarray(frame.image).shape == (1024, 1224) for frame in shots)
    return len(shots), sum(frame.dropped for frame in shots)


async def test_three_cameras_that_leave_room_for_each_other_lose_nothing(three: StandConfig, tmp_path: Path):
    assert await together(three, tmp_path, frames=4) == (12, 0)
