"""The camera driver, through Aravis, against our own GigE Vision camera on a loopback address."""

import asyncio
import math
import os
import subprocess
import sys
import threading
from collections.abc import AsyncGenerator, Generator, Iterator
from contextlib import asynccontextmanager, contextmanager
from typing import Literal

import numpy as np
import pytest
from numpy.typing import NDArray

from drivers.devices.cameras.camera_gige import Camera
from drivers.framing.aravis_library import library
from drivers.sim.gige.camera import FakeCamera
from drivers.wires import camera_connection
from drivers.wires.camera_settings import GigeCameraSettings, TemperatureFeature
from foundation.clock import NS_PER_S, FollowedClock, VirtualClock, WallClock, seconds_ns
from foundation.errors import DeviceFault, Refused, StandError, Unreachable
from foundation.readings import Quality
from tests.addresses import usual_camera_address

SERIAL = "C0061"
WIDTH_px, HEIGHT_px = 640, 480
START_NS = 1_700_000_000 * NS_PER_S
EXPOSURE_S = 0.05


@pytest.fixture(autouse=True, scope="module")
def aravis() -> None:
    try:
        library()
    except StandError as error:
        if os.environ.get("CI") == "true":
            raise
        pytest.skip(str(error))


class WarmPlant:
    """As much of a plant as a camera sees."""

    def __init__(self, now_ns: int) -> None:
        self.sensor_degC = 41.5
        self.body_degC = 38.0
        self.camera_power_on_ns: int | None = now_ns
        self.camera_powered = True
        self.lock = threading.RLock()

    def advance(self, now_ns: int) -> None:
        """Nothing changes here."""

    def switch_camera(self, now_ns: int, *, on: bool) -> None:
        with self.lock:
            self.camera_powered = on
            if on:
                self.camera_power_on_ns = now_ns


def noise(time_ns: int, exposure_s: float, gain_dB: float, rows: int = HEIGHT_px) -> NDArray[np.uint8]:
    """An image that belongs to one instant only."""
    return np.random.default_rng(time_ns).integers(0, 256, (HEIGHT_px, WIDTH_px), dtype=np.uint8)[:rows]


@contextmanager
def simulated(clock: WallClock | FollowedClock, plant: WarmPlant, serial: str = SERIAL) -> Generator[FakeCamera]:
    real_time = isinstance(clock, WallClock)
    fake = FakeCamera(
        plant,
        clock,
        noise,
        usual_camera_address(),
        serial,
        size_px=(WIDTH_px, HEIGHT_px),
        real_time=real_time,
        boot_s=0.2,
    )
    fake.start()
    try:
        yield fake
    finally:
        fake.close()


@pytest.fixture
def plant() -> WarmPlant:
    return WarmPlant(START_NS)


@pytest.fixture
def fake(plant: WarmPlant) -> Iterator[FakeCamera]:
    """A camera in real time."""
    with simulated(WallClock(), plant) as camera:
        yield camera


def settings(**changes: object) -> GigeCameraSettings:
    usual: dict[str, object] = {"serial_number": SERIAL, "exposure_s": EXPOSURE_S, "heartbeat_s": 1.5}
    return GigeCameraSettings.model_validate({"address": usual_camera_address(), **usual, **changes})


@asynccontextmanager
async def opened(clock: WallClock | VirtualClock | None = None, **changes: object) -> AsyncGenerator[Camera]:
    camera = Camera("camera", settings(**changes), clock or WallClock())
    try:
        await camera.open()
        yield camera
    finally:
        await camera.close()


@asynccontextmanager
async def virtual(plant: WarmPlant) -> AsyncGenerator[tuple[VirtualClock, FakeCamera]]:
    """A simulated camera that follows a virtual clock."""
    followed = FollowedClock(START_NS)
    with simulated(followed, plant) as fake:

        async def advance(time_ns: int) -> None:
            followed.follow(time_ns)
            fake.advance(time_ns)

        clock = VirtualClock(START_NS, advance)
        running = asyncio.create_task(clock.run())
        yield clock, fake
        running.cancel()


@pytest.mark.parametrize("wanted", [SERIAL, None], ids=["of a configured number", "of any number"])
async def test_another_camera_at_the_address_of_the_first_gets_no_setting(plant: WarmPlant, wanted: str | None):
    """Control is taken, which Aravis does when it opens one; nothing else is written."""
    with simulated(WallClock(), plant):
        camera = Camera("camera", settings(serial_number=wanted), WallClock())
        await camera.open()
    with simulated(WallClock(), plant, "C9999") as stranger:
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
    async with opened(gain_dB=6.0, packet_size=8000, packet_delay_ns=1000) as camera:
        assert camera.identity.serial_number == SERIAL
        effective = camera.effective
    assert (effective.width_px, effective.height_px, effective.payload_bytes) == (640, 480, 640 * 480)
    assert effective.exposure_s == pytest.approx(EXPOSURE_S, abs=50e-6)
    assert effective.gain_dB == pytest.approx(6.0, abs=0.5)
    assert (effective.packet_size, effective.packet_delay_ns, effective.heartbeat_s) == (8000, 1000, 1.5)


@pytest.mark.usefixtures("fake")
async def test_aravis_finds_a_packet_size_larger_than_an_ethernet_frame_on_loopback():
    async with opened() as camera:
        assert camera.effective.packet_size > 8000


async def test_under_virtual_time_a_trigger_stamps_the_middle_of_the_exposure_to_the_nanosecond(plant: WarmPlant):
    async with virtual(plant) as (clock, _), opened(clock) as camera:
        for number in range(3):
            await clock.sleep_until(START_NS + number * 600 * NS_PER_S)
            frame = await camera.grab()
            assert clock.now_ns() == START_NS + number * 600 * NS_PER_S
            assert frame.time_ns == clock.now_ns() + seconds_ns(frame.exposure_s / 2)
            assert (frame.image == noise(frame.time_ns, frame.exposure_s, 0.0)).all()
            assert (frame.block_id, frame.dropped, frame.camera_degC) == (number + 1, 0, 41.5)


async def test_under_virtual_time_a_free_run_gives_the_next_frame_and_never_an_old_one(plant: WarmPlant):
    async with virtual(plant) as (clock, _):
        started_ns = START_NS + 5 * NS_PER_S
        await clock.sleep_until(started_ns)  # or the camera's clock would still show 0: no time stamps
        async with opened(clock, trigger="free_run", frame_rate_hz=2.0) as camera:
            await camera.start()
            for after_s in (0.0, 0.4, 3.3, 2700.1, 2700.9):
                await clock.sleep_until(started_ns + seconds_ns(after_s))
                frame = await camera.grab()
                number = math.ceil(2 * after_s)
                assert frame.time_ns == started_ns + number * NS_PER_S // 2 + seconds_ns(frame.exposure_s / 2)
                assert (frame.block_id, frame.dropped) == (number + 1, 0)
                assert (frame.image == noise(frame.time_ns, frame.exposure_s, 0.0)).all()
            assert camera.counters().get("missed", 0) == 0


@pytest.mark.usefixtures("fake")
async def test_in_real_time_a_free_run_is_stamped_by_the_cameras_clock():
    clock = WallClock()
    async with opened(clock, trigger="free_run", frame_rate_hz=10.0) as camera:
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
    async with opened(clock, trigger="free_run", frame_rate_hz=10.0) as camera:
        await camera.grab()
        fake.faults.silent_gvsp = True
        grabbing = asyncio.create_task(camera.grab())
        await clock.sleep_until(clock.now_ns() + seconds_ns(0.4))
        fake.faults.silent_gvsp = False
        frame = await grabbing
        assert frame.dropped >= 2
        assert (await camera.grab()).dropped == 0


async def test_an_exposure_may_change_from_frame_to_frame_of_a_free_run(plant: WarmPlant):
    async with virtual(plant) as (clock, _):
        await clock.sleep_until(START_NS + 5 * NS_PER_S)
        async with opened(clock, trigger="free_run") as camera:
            for exposure_s in (0.05, 0.2, 0.02):
                await clock.sleep_until(clock.now_ns() + seconds_ns(7.3))
                called_ns = clock.now_ns()
                frame = await camera.grab(exposure_s)
                begin_ns = frame.time_ns - seconds_ns(frame.exposure_s / 2)
                assert frame.exposure_s == pytest.approx(exposure_s, abs=50e-6)
                assert 0 <= begin_ns - called_ns < NS_PER_S
                assert (frame.image == noise(frame.time_ns, frame.exposure_s, 0.0)).all()
            assert camera.counters().get("missed", 0) == 0


@pytest.mark.usefixtures("fake")
async def test_an_exposure_is_set_for_one_frame():
    async with opened() as camera:
        long = await camera.grab(2 * EXPOSURE_S)
        usual = await camera.grab()
    assert long.exposure_s == pytest.approx(2 * EXPOSURE_S, abs=50e-6)
    assert usual.exposure_s == pytest.approx(EXPOSURE_S, abs=50e-6)


@pytest.mark.usefixtures("fake")
async def test_a_clamped_exposure_is_refused_and_does_not_stay():
    async with opened() as camera:
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
    async with opened(temperature=temperature) as camera:
        (reading,) = await camera.read()
        frame = await camera.grab()
    assert (reading.channel, reading.value, reading.quality) == ("camera.temperature", value_degC, Quality.GOOD)
    assert frame.camera_degC == value_degC


async def test_a_broken_temperature_is_bad_and_the_frames_go_on(fake: FakeCamera):
    async with opened() as camera:
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
    with pytest.raises(Refused, match=r"a heartbeat of 1\.5 s was asked for, the camera took 0\.6 s"):
        async with opened():
            pass
    fake.faults.heartbeat_most_ms = 1300
    async with opened() as camera:
        assert camera.effective.heartbeat_s == 1.3


@pytest.mark.usefixtures("fake")
async def test_an_unknown_selector_entry_is_a_bad_reading():
    place = TemperatureFeature(entry="Lens")
    async with opened(temperature=place) as camera:
        (reading,) = await camera.read()
        await camera.grab()
    assert reading.quality is Quality.BAD
    assert "Lens" in reading.reason


@pytest.mark.parametrize(("loss", "burst"), [(0.05, 1), (0.01, 10)])
async def test_lost_packets_are_asked_for_again_and_no_bit_differs(plant: WarmPlant, loss: float, burst: int):
    async with virtual(plant) as (clock, fake), opened(clock, packet_size=1500) as camera:
        fake.faults.loss, fake.faults.burst = loss, burst
        for _ in range(3):
            frame = await camera.grab()
            assert (frame.image == noise(frame.time_ns, frame.exposure_s, 0.0)).all()
            await clock.sleep_until(clock.now_ns() + NS_PER_S)
        assert camera.counters()["n_resent_packets"] > 10


async def test_without_resend_a_frame_with_holes_is_never_used(plant: WarmPlant, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(camera_connection, "VIRTUAL_TIMEOUT_S", 4.0)  # what each of three frames is waited for
    monkeypatch.setattr(camera_connection, "FRAME_RETENTION_PERIODS", 0.4)  # a busy machine hears of it in time
    async with virtual(plant) as (clock, fake):
        fake.faults.no_resend = True
        async with opened(clock, packet_size=1500) as camera:
            fake.faults.loss = 0.05
            with pytest.raises(Unreachable, match="3 software triggers brought no complete frame"):
                await camera.grab()
            assert sum(count for name, count in camera.counters().items() if name.startswith("incomplete_")) == 3
            fake.faults.loss = 0.0
            await camera.open()
            frame = await camera.grab()
    assert (frame.image == noise(frame.time_ns, frame.exposure_s, 0.0)).all()


async def test_three_missing_frames_of_a_free_run_are_a_lost_camera(plant: WarmPlant, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(camera_connection, "VIRTUAL_TIMEOUT_S", 0.5)  # what each of three frames is waited for
    async with virtual(plant) as (clock, fake), opened(clock, trigger="free_run", frame_rate_hz=2) as camera:
        await camera.grab()
        fake.faults.silent_gvsp = True
        with pytest.raises(Unreachable, match="3 frame periods brought no complete frame"):
            await camera.grab()
        with pytest.raises(Unreachable, match="3 frame periods"):  # until it is opened again
            await camera.read()
        assert (camera.is_usable, camera.counters()["lost"]) == (False, 1)
        fake.faults.silent_gvsp = False
        await camera.open()
        assert (await camera.grab()).image.shape == (HEIGHT_px, WIDTH_px)


async def test_a_lost_frame_is_counted_and_the_next_trigger_brings_the_frame(fake: FakeCamera):
    async with opened() as camera:
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
    async with opened(clock) as camera:
        for _ in range(3):
            before_ns = clock.now_ns()
            frame = await camera.grab()
            begin_ns = frame.time_ns - seconds_ns(frame.exposure_s / 2)
            assert before_ns <= begin_ns < before_ns + NS_PER_S // 2
        assert camera.counters()["stale"] >= 1


async def test_after_a_power_cycle_open_makes_everything_new(fake: FakeCamera, plant: WarmPlant):
    clock = WallClock()
    asked: dict[str, object] = {
        "gain_dB": 6.0,
        "width_px": 320,
        "height_px": 240,
        "offset_x_px": 16,
        "packet_size": 4000,
    }
    camera = Camera("camera", settings(**asked, packet_delay_ns=1000, heartbeat_s=2.5), clock)
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
    camera = Camera("camera", settings(), WallClock())
    await camera.open()
    await camera.grab()
    await camera.stop()
    fake.faults.no_stream_channel = True
    fake.restart()
    clock = WallClock()
    await clock.sleep_until(clock.now_ns() + seconds_ns(0.3))  # it boots
    await camera.open()
    with pytest.raises(Unreachable, match="stream channel"):
        await camera.grab()
    fake.faults.no_stream_channel = False
    await camera.open()
    await camera.grab()
    await camera.close()


async def why_unreachable(camera: Camera) -> str:
    try:
        await camera.read()
    except Unreachable as error:
        return str(error)
    return ""


async def test_a_camera_that_froze_past_its_heartbeat_is_lost_and_comes_back(fake: FakeCamera):
    clock = WallClock()
    async with opened(clock) as camera:
        await camera.grab()
        fake.faults.silent_gvcp = True
        await clock.sleep_until(clock.now_ns() + seconds_ns(2.0))
        fake.faults.silent_gvcp = False
        deadline_ns = clock.now_ns() + seconds_ns(8.0)
        reason = ""
        while not reason and clock.now_ns() < deadline_ns:
            reason = await why_unreachable(camera)
            await clock.sleep_until(clock.now_ns() + seconds_ns(0.05))
        assert "control lost" in reason
        assert camera.counters()["lost"] == 1
        await camera.open()
        await camera.grab()


@pytest.mark.usefixtures("fake")
async def test_while_another_client_controls_the_camera_open_is_refused():
    async with opened():
        other = Camera("other", settings(), WallClock())
        with pytest.raises(Refused, match="another client controls the camera"):
            await other.open()
        await other.close()


CRASH = """
import asyncio, os, sys
from drivers.devices.cameras.camera_gige import Camera
from drivers.wires.camera_settings import GigeCameraSettings
from foundation.clock import WallClock
asyncio.run(Camera("camera", GigeCameraSettings(address=sys.argv[1], heartbeat_s=1.5), WallClock()).open())
os._exit(0)
"""


@pytest.mark.usefixtures("fake")
async def test_after_a_crash_of_our_own_open_waits_for_the_heartbeat():
    process = await asyncio.to_thread(subprocess.run, [sys.executable, "-c", CRASH, usual_camera_address()], check=True)
    assert process.returncode == 0
    async with opened() as camera:
        await camera.grab()
