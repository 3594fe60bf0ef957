"""The camera driver against the stock Aravis fake camera (arv-fake-gv-camera), in a process of its own.

That camera has no temperature, no gain in dB, no time stamp latch and no resend, and takes any value; its image is a
diagonal ramp: pixel = (x + y + frame) mod 255 at 10 ms of exposure.
"""

import asyncio

import numpy as np
import pytest

from tests.stock_camera import ADDRESS, SERIAL
from thermostand.drivers.devices.cameras.camera_gige import AravisCamera
from thermostand.drivers.framing.aravis_library import DEVICE_ERRORS, GENICAM_ERRORS, AravisError
from thermostand.drivers.wires.camera_errors import device_error
from thermostand.drivers.wires.camera_settings import GigeCameraSettings, TemperatureFeature
from thermostand.drivers.wires.frame_count import FrameCount
from thermostand.foundation.clock import NS_PER_S, WallClock, to_ns
from thermostand.foundation.errors import DeviceError, Refused, Unreachable
from thermostand.foundation.readings import Quality

EXPOSURE_S = 0.01
TEST_REGISTER = 0x1F0  # 0x12345678 in its XML


def settings(**changes: object) -> GigeCameraSettings:
    usual: dict[str, object] = {"width_px": 320, "height_px": 240, "exposure_s": EXPOSURE_S}
    return GigeCameraSettings.model_validate({"address": ADDRESS, **usual, **changes})


class Opened:
    """async with Opened(...) as camera: opened, and closed whatever happens."""

    def __init__(self, **changes: object) -> None:
        self.camera = AravisCamera("camera", settings(**changes), WallClock())

    async def __aenter__(self) -> AravisCamera:
        await self.camera.open()
        return self.camera

    async def __aexit__(self, *error: object) -> None:
        await self.camera.close()


async def refusal(asked: GigeCameraSettings) -> str:
    camera = AravisCamera("camera", asked, WallClock())
    with pytest.raises(Refused) as caught:
        await camera.open()
    await camera.close()
    return str(caught.value)


@pytest.mark.parametrize(
    ("domain", "code", "kind", "hint"),
    [
        (DEVICE_ERRORS, 2, Unreachable, ""),
        (DEVICE_ERRORS, 5, Unreachable, ""),
        (DEVICE_ERRORS, 6, Unreachable, ""),
        (DEVICE_ERRORS, 8, Unreachable, ""),
        (DEVICE_ERRORS, 9, Unreachable, ""),
        (DEVICE_ERRORS, 18, Unreachable, ""),
        (DEVICE_ERRORS, 10, Refused, "another client controls the camera"),
        (DEVICE_ERRORS, 17, Refused, "another client controls the camera"),
        (DEVICE_ERRORS, 1, Refused, "error 1"),
        (GENICAM_ERRORS, 8, Refused, "GenICam error 8"),
        ("Aravis", 11, Refused, "description cannot be evaluated"),
        ("g-io-error-quark", 38, Unreachable, "g-io-error-quark 38"),
    ],
)
def test_errors_say_who_is_to_blame(domain: str, code: int, kind: type[DeviceError], hint: str):
    error = device_error("eye", AravisError(domain, code, "what Aravis says"))
    assert type(error) is kind
    assert error.device == "eye"
    assert str(error).startswith("eye: what Aravis says")
    assert hint in str(error)


def test_the_frame_count_rises_over_the_wrap_of_16_bit_ids_and_over_a_restart():
    count = FrameCount()
    assert [count.advance(i) for i in (1, 2, 5)] == [1, 2, 5]
    assert [count.advance(i) for i in (65534, 65535, 1, 2)] == [65534, 65535, 65536, 65537]
    count.restart()
    assert [count.advance(i) for i in (1, 3)] == [65538, 65540]


@pytest.mark.parametrize(
    "changes",
    [{"pixel_format": "BayerRG8"}, {"exposure_s": 0.0}, {"frame_rate_hz": 0.0}, {"buffers": 0}, {"heartbeat_s": 1.0}],
)
def test_settings_no_camera_could_take_are_refused_at_once(changes: dict[str, object]):
    with pytest.raises(ValueError, match=next(iter(changes))):
        settings(**changes)


@pytest.mark.parametrize(
    "changes",
    [
        {"feature": None},
        {"feature": "A", "register_address": 4},
        {"feature": "A", "selector": "B", "entry": None},
        {"feature": "A", "selector": None, "entry": "C"},
        {"register_address": 4, "selector": "B"},
    ],
)
def test_a_temperature_is_one_place(changes: dict[str, object]):
    with pytest.raises(ValueError, match=r"exactly one of|go together"):
        TemperatureFeature.model_validate(changes)


@pytest.mark.usefixtures("stock_camera")
async def test_an_open_camera_tells_who_it_is_and_what_it_took():
    async with Opened(packet_size=8000, heartbeat_s=2.5) as camera:
        assert camera.identity.vendor == "Aravis"
        assert camera.identity.serial_number == SERIAL
        effective = camera.effective
    assert (effective.width_px, effective.height_px, effective.pixel_format) == (320, 240, "Mono8")
    assert effective.payload_bytes == 320 * 240
    assert (effective.exposure_s, effective.gain_dB) == (EXPOSURE_S, 0.0)
    assert (effective.packet_size, effective.heartbeat_s) == (8000, 2.5)


@pytest.mark.usefixtures("stock_camera")
async def test_a_software_trigger_gives_one_frame_pixel_by_pixel():
    y, x = np.mgrid[:240, :320]
    clock = WallClock()
    async with Opened() as camera:
        frames = []
        for _ in range(3):
            before_ns = clock.now_ns()
            frame = await camera.grab()
            frames.append(frame)
            assert before_ns <= frame.time_ns - EXPOSURE_S / 2 * NS_PER_S <= clock.now_ns()
            assert (frame.image == (int(frame.image[0, 0]) + x + y) % 255).all()
            assert not frame.image.flags.writeable
        counters = camera.counters()
    assert frames[0].image.dtype == np.uint8
    assert [frame.block_id - frames[0].block_id for frame in frames] == [0, 1, 2]
    assert (counters["triggers"], counters["n_completed_buffers"]) == (3, 3)
    assert np.isnan(frames[0].camera_degC)


@pytest.mark.usefixtures("stock_camera")
async def test_a_due_trigger_waits_for_its_instant_with_everything_prepared():
    async with Opened() as camera:
        due_ns = WallClock().now_ns() + NS_PER_S // 5
        frame = await camera.grab(due_ns=due_ns)
        assert 0 <= frame.time_ns - to_ns(EXPOSURE_S / 2) - due_ns < NS_PER_S // 10


async def test_an_exposure_holds_for_one_frame():
    async with Opened() as camera:
        long = await camera.grab(2 * EXPOSURE_S)
        usual = await camera.grab()
    assert (long.exposure_s, usual.exposure_s) == (2 * EXPOSURE_S, EXPOSURE_S)
    assert long.image.max() == 255  # twice the ramp, clipped
    assert usual.image.max() == 254


@pytest.mark.usefixtures("stock_camera")
async def test_sixteen_bit_pixels_arrive_as_uint16():
    async with Opened(pixel_format="Mono16", width_px=64, height_px=32) as camera:
        frame = await camera.grab()
        assert camera.effective.payload_bytes == 2 * 64 * 32
    assert (frame.image.dtype, frame.image.shape) == (np.uint16, (32, 64))


@pytest.mark.usefixtures("stock_camera")
async def test_free_run_gives_frames_exposed_after_the_call():
    clock = WallClock()
    async with Opened(trigger="free_run", frame_rate_hz=20.0) as camera:
        await camera.start()
        await clock.sleep_until(clock.now_ns() + NS_PER_S // 2)  # stale frames fill the buffers
        before_ns = clock.now_ns()
        first = await camera.grab()
        second = await camera.grab()
        assert camera.counters()["stale"] >= 6
    assert before_ns < first.time_ns < second.time_ns < clock.now_ns()
    assert second.block_id > first.block_id


@pytest.mark.usefixtures("stock_camera")
async def test_acquisition_can_be_stopped_and_started_on_a_new_stream():
    async with Opened() as camera:
        first = await camera.grab()
        await camera.stop()
        await camera.start()
        second = await camera.grab()
    assert second.block_id > first.block_id


@pytest.mark.usefixtures("stock_camera")
async def test_what_the_camera_does_not_take_is_refused():
    assert "Mono12" in await refusal(settings(pixel_format="Mono12"))
    assert f"X is expected, {SERIAL} answers" in await refusal(settings(serial_number="X"))
    fast = settings(trigger="free_run").model_copy(update={"frame_rate_hz": 5000.0})  # more than a file may ask for
    assert "the camera gives 1000" in await refusal(fast)
    assert "no gain in dB" in await refusal(settings(gain_dB=3.0))


@pytest.mark.usefixtures("stock_camera")
async def test_a_missing_temperature_is_a_bad_reading_with_its_reason():
    async with Opened() as camera:
        (reading,) = await camera.read()
    assert (reading.channel, reading.unit, reading.quality) == ("camera.temperature", "degC", Quality.BAD)
    assert "DeviceTemperature" in reading.reason


@pytest.mark.usefixtures("stock_camera")
@pytest.mark.parametrize(
    ("register", "value", "reason"),
    [
        (TemperatureFeature(register_address=TEST_REGISTER, mask=0xFF, scale=0.5, offset=-10.0), 50.0, ""),
        (
            TemperatureFeature(register_address=TEST_REGISTER, mask=0xFF, scale=2.0),
            None,
            "240 degC is outside -40..120",
        ),
        (TemperatureFeature(register_address=TEST_REGISTER, mask=0), None, "the camera shows exactly 0 degC"),
    ],
)
async def test_a_temperature_register_is_scaled_and_checked(
    register: TemperatureFeature, value: float | None, reason: str
):
    async with Opened(temperature=register) as camera:
        (reading,) = await camera.read()
        frame = await camera.grab()
    assert reading.reason == reason
    if value is None:
        assert reading.quality is Quality.BAD
        assert np.isnan(frame.camera_degC)
    else:
        assert (reading.value, frame.camera_degC) == (value, value)


@pytest.mark.usefixtures("stock_camera")
async def test_a_closed_camera_is_unreachable_until_it_is_opened_again():
    camera = AravisCamera("camera", settings(), WallClock())
    await camera.close()
    with pytest.raises(Unreachable, match="not open"):
        await camera.grab()
    opening = asyncio.create_task(camera.open())
    await asyncio.sleep(0)  # a poll comes meanwhile
    (reading,) = await camera.read()
    assert (reading.quality, reading.reason) == (Quality.BAD, "the camera is closed")
    await opening
    await camera.open()
    await camera.grab()
    await camera.close()
    await camera.close()
    with pytest.raises(Unreachable, match="not open"):
        await camera.grab()
    (reading,) = await camera.read()
    assert (reading.quality, reading.reason) == (Quality.BAD, "the camera is closed")
    assert camera.counters()["opened"] == 2


async def test_an_address_where_nobody_answers_is_unreachable():
    camera = AravisCamera("camera", GigeCameraSettings(address="127.0.0.62"), WallClock())
    with pytest.raises(Unreachable, match=r"127\.0\.0\.62"):
        await camera.open()
    await camera.close()
