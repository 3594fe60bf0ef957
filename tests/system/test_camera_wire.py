"""The camera driver, through Aravis, against our own GigE Vision camera: settings, frames, temperatures."""

import asyncio
import math
from typing import Literal

import numpy as np
import pytest

from tests.still_plant import StillPlant
from tests.system.camera_bench import (
    EXPOSURE_S,
    SERIAL,
    START_NS,
    noise,
    open_camera,
    run_simulated_camera,
    run_virtual_camera,
    settings,
)
from tests.system.conftest import require_aravis
from thermostand.drivers.devices.cameras.camera_gige import AravisCamera
from thermostand.drivers.sim.gige.camera import FakeCamera
from thermostand.drivers.wires.camera_settings import TemperatureFeature
from thermostand.foundation.clock import NS_PER_S, WallClock, to_ns
from thermostand.foundation.errors import DeviceFault, Refused
from thermostand.foundation.readings import Quality


@pytest.fixture(autouse=True, scope="module")
def aravis() -> None:
    require_aravis()


@pytest.mark.parametrize("wanted", [SERIAL, None], ids=["of a configured number", "of any number"])
async def test_another_camera_at_the_address_of_the_first_gets_no_setting(plant: StillPlant, wanted: str | None):
    """Control is taken, which Aravis does when it opens one; nothing else is written."""
    with run_simulated_camera(WallClock(), plant):
        camera = AravisCamera("camera", settings(serial_number=wanted), WallClock())
        await camera.open()
    with run_simulated_camera(WallClock(), plant, "C9999") as stranger:
        before = {name: stranger._registers.integer(name) for name in ("GevSCPSPacketSize", "GevSCPD", "PixelFormat")}
        for _ in range(2):
            with pytest.raises((DeviceFault, Refused), match=f"C9999 answers|C9999, version .* where .* {SERIAL}"):
                await camera.open()
        assert stranger._registers.real("ExposureTime") == 10_000.0
        assert {name: stranger._registers.integer(name) for name in before} == before
        assert not stranger.streaming
    await camera.close()


@pytest.mark.usefixtures("fake")
async def test_all_settings_are_taken_and_read_back():
    async with open_camera(gain_dB=6.0, packet_size=8000, packet_delay_ns=1000) as camera:
        assert camera.identity.serial_number == SERIAL
        effective = camera.effective
    assert (effective.width_px, effective.height_px, effective.payload_bytes) == (640, 480, 640 * 480)
    assert effective.exposure_s == pytest.approx(EXPOSURE_S, abs=50e-6)
    assert effective.gain_dB == pytest.approx(6.0, abs=0.5)
    assert (effective.packet_size, effective.packet_delay_ns, effective.heartbeat_s) == (8000, 1000, 1.5)


@pytest.mark.usefixtures("fake")
async def test_aravis_finds_a_packet_size_larger_than_an_ethernet_frame_on_loopback():
    async with open_camera() as camera:
        assert camera.effective.packet_size > 8000


async def test_under_virtual_time_a_trigger_stamps_the_middle_of_the_exposure_to_the_nanosecond(plant: StillPlant):
    async with run_virtual_camera(plant) as (clock, _), open_camera(clock) as camera:
        for number in range(3):
            await clock.sleep_until(START_NS + number * 600 * NS_PER_S)
            frame = await camera.grab()
            assert clock.now_ns() == START_NS + number * 600 * NS_PER_S
            assert frame.time_ns == clock.now_ns() + to_ns(frame.exposure_s / 2)
            assert (frame.image == noise(frame.time_ns, frame.exposure_s, 0.0)).all()
            assert (frame.block_id, frame.dropped, frame.camera_degC) == (number + 1, 0, 41.5)


async def test_under_virtual_time_a_free_run_gives_the_next_frame_and_never_an_old_one(plant: StillPlant):
    async with run_virtual_camera(plant) as (clock, _):
        started_ns = START_NS + 5 * NS_PER_S
        await clock.sleep_until(started_ns)  # or the camera's clock would still show 0: no time stamps
        async with open_camera(clock, trigger="free_run", frame_rate_hz=2.0) as camera:
            await camera.start()
            for after_s in (0.0, 0.4, 3.3, 2700.1, 2700.9):
                await clock.sleep_until(started_ns + to_ns(after_s))
                frame = await camera.grab()
                number = math.ceil(2 * after_s)
                assert frame.time_ns == started_ns + number * NS_PER_S // 2 + to_ns(frame.exposure_s / 2)
                assert (frame.block_id, frame.dropped) == (number + 1, 0)
                assert (frame.image == noise(frame.time_ns, frame.exposure_s, 0.0)).all()
            assert camera.counters().get("missed", 0) == 0


@pytest.mark.usefixtures("fake")
async def test_in_real_time_a_free_run_is_stamped_by_the_cameras_clock():
    clock = WallClock()
    async with open_camera(clock, trigger="free_run", frame_rate_hz=10.0) as camera:
        await camera.start()
        await clock.sleep_until(clock.now_ns() + NS_PER_S)
        before_ns = clock.now_ns()
        frames = [await camera.grab() for _ in range(4)]
    times_s = [(frame.time_ns - before_ns) / NS_PER_S for frame in frames]
    assert EXPOSURE_S / 2 - 0.02 <= times_s[0] <= 0.1 + EXPOSURE_S / 2 + 0.02
    steps = np.diff(times_s) / 0.1
    assert steps == pytest.approx(np.diff([frame.block_id for frame in frames]), abs=0.01)


async def test_in_a_free_run_the_periods_without_a_frame_are_counted(fake: FakeCamera):
    clock = WallClock()
    async with open_camera(clock, trigger="free_run", frame_rate_hz=10.0) as camera:
        await camera.grab()
        fake.faults.silent_gvsp = True
        grabbing = asyncio.create_task(camera.grab())
        await clock.sleep_until(clock.now_ns() + to_ns(0.4))
        fake.faults.silent_gvsp = False
        frame = await grabbing
        assert frame.dropped >= 2
        assert (await camera.grab()).dropped == 0


async def test_an_exposure_may_change_from_frame_to_frame_of_a_free_run(plant: StillPlant):
    async with run_virtual_camera(plant) as (clock, _):
        await clock.sleep_until(START_NS + 5 * NS_PER_S)
        async with open_camera(clock, trigger="free_run") as camera:
            for exposure_s in (0.05, 0.2, 0.02):
                await clock.sleep_until(clock.now_ns() + to_ns(7.3))
                called_ns = clock.now_ns()
                frame = await camera.grab(exposure_s)
                begin_ns = frame.time_ns - to_ns(frame.exposure_s / 2)
                assert frame.exposure_s == pytest.approx(exposure_s, abs=50e-6)
                assert 0 <= begin_ns - called_ns < NS_PER_S
                assert (frame.image == noise(frame.time_ns, frame.exposure_s, 0.0)).all()
            assert camera.counters().get("missed", 0) == 0


@pytest.mark.usefixtures("fake")
async def test_an_exposure_is_set_for_one_frame():
    async with open_camera() as camera:
        long = await camera.grab(2 * EXPOSURE_S)
        usual = await camera.grab()
    assert long.exposure_s == pytest.approx(2 * EXPOSURE_S, abs=50e-6)
    assert usual.exposure_s == pytest.approx(EXPOSURE_S, abs=50e-6)


@pytest.mark.usefixtures("fake")
async def test_a_clamped_exposure_is_refused_and_does_not_stay():
    async with open_camera() as camera:
        with pytest.raises(Refused, match="ExposureTime"):
            await camera.grab(10_000.0)
        frame = await camera.grab()
    assert frame.exposure_s == pytest.approx(EXPOSURE_S, abs=50e-6)


@pytest.mark.parametrize(
    ("temperature", "value_degC"),
    [
        (None, 41.5),
        (TemperatureFeature(entry="Mainboard"), 38.0),
    ],
)
@pytest.mark.usefixtures("fake")
async def test_the_temperature_is_a_reading_and_belongs_to_each_frame(
    temperature: TemperatureFeature | None, value_degC: float
):
    async with open_camera(temperature=temperature) as camera:
        (reading,) = await camera.read()
        frame = await camera.grab()
    assert (reading.channel, reading.value, reading.quality) == ("camera.temperature", value_degC, Quality.GOOD)
    assert frame.camera_degC == value_degC


async def test_a_broken_temperature_is_bad_and_the_frames_go_on(fake: FakeCamera):
    async with open_camera() as camera:
        faults: dict[Literal["zero", "access", "nan"], str] = {
            "zero": "exactly 0 degC",
            "access": "DeviceTemperature",
            "nan": "nan degC is outside -40..120",
        }
        for fault, reason in faults.items():
            fake.faults.temperature = fault
            (reading,) = await camera.read()
            assert reading.quality is Quality.BAD
            assert reason in reading.reason
            assert np.isnan((await camera.grab()).camera_degC)
        fake.faults.temperature = None
        assert (await camera.grab()).camera_degC == 41.5


async def test_a_camera_that_would_free_itself_between_two_requests_is_refused(fake: FakeCamera):
    fake.faults.heartbeat_most_ms = 600
    with pytest.raises(Refused, match=r"1\.5 s was asked .* 0\.6 s"):
        async with open_camera():
            pass
    fake.faults.heartbeat_most_ms = 1300
    async with open_camera() as camera:
        assert camera.effective.heartbeat_s == 1.3


@pytest.mark.usefixtures("fake")
async def test_an_unknown_selector_entry_is_a_bad_reading():
    place = TemperatureFeature(entry="Lens")
    async with open_camera(temperature=place) as camera:
        (reading,) = await camera.read()
        await camera.grab()
    assert reading.quality is Quality.BAD
    assert "Lens" in reading.reason
