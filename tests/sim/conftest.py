"""A fake camera that answers at an address of its own, and its client; simulated stages on the bench."""

from collections.abc import Iterator

import pytest

from tests.sim.camera_client import HEIGHT, START_NS, WIDTH, Client, address, render, still_plant
from tests.sim.ximc_bench import Bench as StageBench
from tests.still_plant import StillPlant
from thermostand.drivers.sim.gige.camera import FakeCamera
from thermostand.drivers.sim.gige.gvsp_sender import CameraFaults
from thermostand.foundation.clock import FollowedClock


@pytest.fixture
def plant() -> StillPlant:
    return still_plant()


@pytest.fixture
def clock() -> FollowedClock:
    return FollowedClock(START_NS)


@pytest.fixture
def faults() -> CameraFaults:
    return CameraFaults()


@pytest.fixture
def camera(plant: StillPlant, clock: FollowedClock, faults: CameraFaults) -> Iterator[FakeCamera]:
    camera = FakeCamera(plant, clock, render, address(), "SN1", size_px=(WIDTH, HEIGHT), faults=faults)
    camera.start()
    yield camera
    camera.close()


@pytest.fixture
def client(camera: FakeCamera) -> Iterator[Client]:
    client = Client()
    yield client
    client.close()


@pytest.fixture
def linear() -> StageBench:
    return StageBench("linear")


@pytest.fixture
def rotary() -> StageBench:
    return StageBench("rotary")
