"""The camera driver against a camera whose packets, frames or control are lost, and that is lost itself."""

import asyncio
import subprocess
import sys

import pytest

from tests.addresses import get_usual_camera_address
from tests.still_plant import StillPlant
from tests.system.camera_bench import (
    EXPOSURE_S,
    HEIGHT_px,
    WIDTH_px,
    noise,
    open_camera,
    run_virtual_camera,
    settings,
)
from tests.system.conftest import require_aravis
from thermostand.drivers.devices.cameras.camera_gige import AravisCamera
from thermostand.drivers.sim.gige.camera import FakeCamera
from thermostand.drivers.wires import camera_connection
from thermostand.foundation.clock import NS_PER_S, WallClock, to_ns
from thermostand.foundation.errors import Refused, Unreachable


@pytest.fixture(autouse=True, scope="module")
def aravis() -> None:
    require_aravis()


@pytest.mark.parametrize(("loss", "burst"), [(0.05, 1), (0.01, 10)])
async def test_lost_packets_are_asked_for_again_and_no_bit_differs(plant: StillPlant, loss: float, burst: int):
    async with run_virtual_camera(plant) as (clock, fake), open_camera(clock, packet_size=1500) as camera:
        fake.faults.loss, fake.faults.burst = loss, burst
        for _ in range(3):
            frame = await camera.grab()
            assert (frame.image == noise(frame.time_ns, frame.exposure_s, 0.0)).all()
            await clock.sleep_until(clock.now_ns() + NS_PER_S)
        assert camera.counters()["n_resent_packets"] > 10


async def test_without_resend_a_frame_with_holes_is_never_used(plant: StillPlant, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(camera_connection, "VIRTUAL_TIMEOUT_S", 4.0)  # what each of three frames is waited for
    monkeypatch.setattr(camera_connection, "FRAME_RETENTION_PERIODS", 0.4)  # a busy machine hears of it in time
    async with run_virtual_camera(plant) as (clock, fake):
        fake.faults.no_resend = True
        async with open_camera(clock, packet_size=1500) as camera:
            fake.faults.loss = 0.05
            with pytest.raises(Unreachable, match="3 software triggers"):
                await camera.grab()
            assert sum(count for name, count in camera.counters().items() if name.startswith("incomplete_")) == 3
            fake.faults.loss = 0.0
            await camera.open()
            frame = await camera.grab()
    assert (frame.image == noise(frame.time_ns, frame.exposure_s, 0.0)).all()


async def test_three_missing_frames_of_a_free_run_are_a_lost_camera(plant: StillPlant, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(camera_connection, "VIRTUAL_TIMEOUT_S", 0.5)  # what each of three frames is waited for
    async with (
        run_virtual_camera(plant) as (clock, fake),
        open_camera(clock, trigger="free_run", frame_rate_hz=2) as camera,
    ):
        await camera.grab()
        fake.faults.silent_gvsp = True
        with pytest.raises(Unreachable, match="3 frame periods"):
            await camera.grab()
        with pytest.raises(Unreachable, match="3 frame periods"):  # until it is opened again
            await camera.read()
        assert (camera.is_usable, camera.counters()["lost"]) == (False, 1)
        fake.faults.silent_gvsp = False
        await camera.open()
        assert (await camera.grab()).image.shape == (HEIGHT_px, WIDTH_px)


async def test_a_lost_frame_is_counted_and_the_next_trigger_brings_the_frame(fake: FakeCamera):
    async with open_camera() as camera:
        await camera.grab()
        fake.faults.silent_gvsp = True
        grabbing = asyncio.create_task(camera.grab())
        while camera.counters().get("missed", 0) < 1:
            await asyncio.sleep(0.01)
        fake.faults.silent_gvsp = False
        frame = await grabbing
    assert frame.dropped >= 1


async def test_a_trigger_executed_twice_does_not_leave_an_old_frame_behind(fake: FakeCamera):
    clock = WallClock()
    fake.faults.trigger_twice = True
    async with open_camera(clock) as camera:
        for _ in range(3):
            before_ns = clock.now_ns()
            frame = await camera.grab()
            begin_ns = frame.time_ns - to_ns(frame.exposure_s / 2)
            assert before_ns <= begin_ns < before_ns + NS_PER_S // 2
        assert camera.counters()["stale"] >= 1


async def test_after_a_power_cycle_open_makes_everything_new(fake: FakeCamera, plant: StillPlant):
    clock = WallClock()
    asked: dict[str, object] = {
        "gain_dB": 6.0,
        "width_px": 320,
        "height_px": 240,
        "offset_x_px": 16,
        "packet_size": 4000,
    }
    camera = AravisCamera("camera", settings(**asked, packet_delay_ns=1000, heartbeat_s=2.5), clock)
    await camera.open()
    before, had = await camera.grab(), camera.effective
    for on in (False, True):
        plant.switch_camera(clock.now_ns(), on=on)
        fake.advance(clock.now_ns())
    with pytest.raises(Unreachable):
        await camera.grab()
    with pytest.raises(Unreachable):
        await camera.read()
    await camera.open()
    after = await camera.grab()
    effective = camera.effective
    await camera.close()
    assert effective == had  # each read back from the camera, none of them its own at power-on
    assert (effective.width_px, effective.packet_size, effective.heartbeat_s) == (320, 4000, 2.5)
    assert effective.gain_dB == pytest.approx(6.0, abs=0.5)
    assert after.exposure_s == pytest.approx(EXPOSURE_S, abs=50e-6)
    assert after.block_id > before.block_id


async def test_a_camera_that_returns_without_a_stream_channel_is_unreachable_until_it_has_one(fake: FakeCamera):
    camera = AravisCamera("camera", settings(), WallClock())
    await camera.open()
    await camera.grab()
    await camera.stop()
    fake.faults.no_stream_channel = True
    fake.restart()
    clock = WallClock()
    await clock.sleep_until(clock.now_ns() + to_ns(0.3))  # it boots
    await camera.open()
    with pytest.raises(Unreachable, match="stream channel"):
        await camera.grab()
    fake.faults.no_stream_channel = False
    await camera.open()
    await camera.grab()
    await camera.close()


async def why_unreachable(camera: AravisCamera) -> str:
    try:
        await camera.read()
    except Unreachable as error:
        return str(error)
    return ""


async def test_a_camera_that_froze_past_its_heartbeat_is_lost_and_comes_back(fake: FakeCamera):
    clock = WallClock()
    async with open_camera(clock) as camera:
        await camera.grab()
        fake.faults.silent_gvcp = True
        await clock.sleep_until(clock.now_ns() + to_ns(2.0))
        fake.faults.silent_gvcp = False
        deadline_ns = clock.now_ns() + to_ns(8.0)
        reason = ""
        while not reason and clock.now_ns() < deadline_ns:
            reason = await why_unreachable(camera)
            await clock.sleep_until(clock.now_ns() + to_ns(0.05))
        assert "control lost" in reason
        assert camera.counters()["lost"] == 1
        await camera.open()
        await camera.grab()


@pytest.mark.usefixtures("fake")
async def test_while_another_client_controls_the_camera_open_is_refused():
    async with open_camera():
        other = AravisCamera("other", settings(), WallClock())
        with pytest.raises(Refused, match="another client controls"):
            await other.open()
        await other.close()


CRASH = """
import asyncio, os, sys
from thermostand.drivers.devices.cameras.camera_gige import Camera
from thermostand.drivers.wires.camera_settings import GigeCameraSettings
from thermostand.foundation.clock import WallClock
asyncio.run(Camera("camera", GigeCameraSettings(address=sys.argv[1], heartbeat_s=1.5), WallClock()).open())
os._exit(0)
"""


@pytest.mark.usefixtures("fake")
async def test_after_a_crash_of_our_own_open_waits_for_the_heartbeat():
    process = await asyncio.to_thread(
        subprocess.run, [sys.executable, "-c", CRASH, get_usual_camera_address()], check=True
    )
    assert process.returncode == 0
    async with open_camera() as camera:
        await camera.grab()
