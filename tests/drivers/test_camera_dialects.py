"""Cameras of other makes: the simulated camera shows another camera's GenICam file, and the driver gets along with it,
or refuses it by the name of what is missing. Small files of our own are always tried; `$GENICAM` is a folder of real
ones (27 of 12 makes: etc/genicam of the public repository areaDetector/aravisGigE)."""

import asyncio
import os
from collections.abc import Generator
from contextlib import asynccontextmanager, contextmanager
from pathlib import Path
from typing import cast

import numpy as np
import pytest
from numpy.typing import NDArray

from tests.addresses import get_usual_camera_address
from tests.dialects import (
    DIALECTS,
    EXPOSURE,
    HEIGHT,
    IIDC,
    IMAGE,
    SOURCE,
    STANDARD,
    TRIGGER,
    WIDTH,
    Dialect,
    choice,
    floating,
    integer,
    register,
)
from tests.still_plant import StillPlant
from tests.system.conftest import require_aravis
from thermostand.drivers.devices.cameras.camera_gige import AravisCamera
from thermostand.drivers.framing.aravis_library import DEVICE_ERRORS, AravisError
from thermostand.drivers.sim.gige.camera import FakeCamera
from thermostand.drivers.sim.gige.camera_registers import ControlChannel, Registers
from thermostand.drivers.sim.gige.genicam_file import GenicamFile, read_genicam
from thermostand.drivers.sim.gige.gvcp import Ack, GvcpRequest, GvcpStatus, Nack
from thermostand.drivers.wires import camera_connection
from thermostand.drivers.wires.aravis import GigeDevice
from thermostand.drivers.wires.camera_connection import NoTemperature, find_temperature
from thermostand.drivers.wires.camera_settings import GigeCameraSettings, TemperatureFeature
from thermostand.foundation.clock import WallClock
from thermostand.foundation.errors import ConfigError, Refused
from thermostand.foundation.readings import Quality

BITS = {"Mono8": 8, "Mono10": 10, "Mono12": 12, "Mono16": 16, "Mono10Packed": 10, "Mono12Packed": 12}
BITS |= {"Mono10p": 10, "Mono12p": 12}
FOLDER = os.environ.get("GENICAM", "")


def scene(rows: int, width: int) -> NDArray[np.uint8]:
    y, x = np.mgrid[:rows, :width]
    return ((x + 3 * y) % 251).astype(np.uint8)


@contextmanager
def dressed(file: GenicamFile | None, size_px: tuple[int, int] = (WIDTH, HEIGHT)) -> Generator[Registers]:
    def render(time_ns: int, exposure_s: float, gain_dB: float, rows: int) -> NDArray[np.uint8]:
        return scene(rows, size_px[0])

    camera = FakeCamera(
        StillPlant(0, sensor=41.5, body=33.0),
        WallClock(),
        render,
        get_usual_camera_address(),
        "SN1",
        size_px=size_px,
        real_time=True,
        boot_s=0,
        genicam=file,
    )
    camera.start()
    try:
        yield camera._registers  # pyright: ignore[reportPrivateUsage] - what the client has written
    finally:
        camera.close()


@asynccontextmanager
async def opened(**changes: object):
    usual = {"address": get_usual_camera_address(), "exposure_s": 0.01, "packet_size": 1500}
    camera = AravisCamera("eye", GigeCameraSettings.model_validate({**usual, **changes}), WallClock())
    try:
        await camera.open()
        yield camera
    finally:
        await camera.close()


def test_a_camera_of_another_make_counts_longer_than_four_seconds():
    with dressed(of(DIALECTS["abs"], "abs")) as registers:  # ns in 32 bits end there; a camera's have 64
        registers.put("GevTimestampValue", 5_000_000_000)
        assert registers.integer("GevTimestampValue") == 5_000_000_000


def of(dialect: Dialect, name: str) -> GenicamFile:
    require_aravis()
    return GenicamFile(dialect.xml(name), name)


@pytest.mark.parametrize("name", [name for name, dialect in DIALECTS.items() if not dialect.missing])
async def test_a_camera_that_has_what_is_needed_is_set_and_grabs(name: str):
    dialect = DIALECTS[name]
    with dressed(of(dialect, name)):
        async with opened(**dict(dialect.settings)) as camera:
            frame = await camera.grab()
            (reading,) = await camera.read()
            features = camera.effective.features
            used = (features["exposure"], features["gain"], features["trigger"] or features["frame_rate"])
            place = (await camera.describe_temperature_place()).partition(";")[0]
            assert camera.identity.vendor == "Dialects"
    expected = scene(HEIGHT, WIDTH).astype(np.uint16) * (1 if frame.image.dtype == np.uint8 else 16)
    assert (frame.image == expected).all()
    assert frame.exposure_s == pytest.approx(0.01, rel=1e-3)
    assert (", ".join(used), place) == (dialect.used, dialect.temperature)
    if dialect.temperature:
        assert reading.value == pytest.approx(41.5, abs=0.6)  # some show whole degrees
    else:
        assert reading.quality is Quality.BAD


@pytest.mark.parametrize("name", [name for name, dialect in DIALECTS.items() if dialect.missing])
async def test_a_camera_that_lacks_something_is_refused_by_its_name(name: str):
    dialect = DIALECTS[name]
    with dressed(of(dialect, name)), pytest.raises(Refused) as refused:
        async with opened(**dict(dialect.settings)):
            pass
    assert dialect.missing in str(refused.value)


async def test_a_region_is_what_is_asked_for_and_a_new_exposure_is_taken():
    with dressed(of(DIALECTS["abs"], "abs")):
        async with opened(width_px=32, height_px=16) as camera:
            frame = await camera.grab(0.02)
    assert (frame.image == scene(HEIGHT, WIDTH)[:16, :32]).all()
    assert frame.exposure_s == pytest.approx(0.02)


async def test_binned_pixels_are_the_mean_of_those_of_the_sensor():
    binning = integer("BinningHorizontal", 0xA090) + integer("BinningVertical", 0xA094)
    with dressed(GenicamFile(Dialect(STANDARD + TRIGGER + SOURCE + EXPOSURE + binning).xml("binned"), "binned")):
        async with opened(binning=2, width_px=WIDTH // 2, height_px=HEIGHT // 2) as camera:
            frame = await camera.grab()
    four = scene(HEIGHT, WIDTH).reshape(HEIGHT // 2, 2, WIDTH // 2, 2)
    assert (frame.image == four.mean(axis=(1, 3)).round()).all()


async def test_our_own_camera_gives_every_pixel_format_that_a_stand_may_ask_for():
    require_aravis()
    with dressed(None):
        for pixel_format, bits in BITS.items():
            async with opened(pixel_format=pixel_format, width_px=32, height_px=16, offset_x_px=8) as camera:
                frame = await camera.grab()
            expected = scene(HEIGHT, WIDTH)[:16, 8:40].astype(np.uint16) << bits - 8
            assert (frame.image == expected).all(), pixel_format


async def test_a_selector_that_the_camera_refuses_costs_the_temperature_and_not_the_camera(
    monkeypatch: pytest.MonkeyPatch,
):
    """Whether there is one is in a register that cannot be read; the camera works otherwise."""
    selector = choice("DeviceTemperatureSelector", 0xA0A0, {"Sensor": 0}, "<pIsImplemented>Inquiry</pIsImplemented>")
    body = STANDARD + TRIGGER + SOURCE + EXPOSURE + selector + register("Inquiry", 0xA0B0, "RO")
    body += floating("DeviceTemperature", 0xA060)
    with dressed(GenicamFile(Dialect(body).xml("refusing"), "refusing")) as registers:
        read = registers.read

        def refusing(address: int, count: int) -> bytes:
            if address == 0xA0B0:
                raise Nack(GvcpStatus.ACCESS_DENIED, "not now")
            return read(address, count)

        monkeypatch.setattr(registers, "read", refusing)
        async with opened() as camera:
            (reading,) = await camera.read()
            await camera.grab()
    assert reading.quality is Quality.BAD
    assert "cannot be read ([DeviceTemperatureSelector]" in reading.reason


@pytest.mark.nightly  # the three seconds for which Aravis asks again
async def test_a_selector_that_the_camera_never_answers_for_costs_the_temperature_and_not_the_camera(
    monkeypatch: pytest.MonkeyPatch,
):
    body = STANDARD + TRIGGER + SOURCE + EXPOSURE + floating("DeviceTemperature", 0xA060)
    body += choice("DeviceTemperatureSelector", 0xA0A0, {"Sensor": 0})
    execute = ControlChannel._execute  # pyright: ignore[reportPrivateUsage] - it is heard, and not answered
    is_silent = True

    def unanswered(self: ControlChannel, request: GvcpRequest, peer: tuple[str, int], now_s: float) -> Ack | None:
        is_asked = request.payload[:4] == (0xA0A0).to_bytes(4, "big")
        return None if is_asked and is_silent else execute(self, request, peer, now_s)

    monkeypatch.setattr(ControlChannel, "_execute", unanswered)
    monkeypatch.setattr(camera_connection, "TEMPERATURE_AGAIN_S", 0.5)
    with dressed(GenicamFile(Dialect(body).xml("silent"), "silent")):
        async with opened() as camera:
            (reading,) = await camera.read()
            frame = await camera.grab()
            is_silent = False
            await asyncio.sleep(0.5)
            (again,) = await camera.read()
    assert (reading.quality, reading.cause) == (Quality.BAD, "wire")
    assert "DeviceTemperature of DeviceTemperatureSelector 'Sensor' cannot be read" in reading.reason
    assert (frame.image == scene(HEIGHT, WIDTH)).all()
    assert again.value == pytest.approx(41.5, abs=0.6)


class Asked:
    """A camera that has a temperature behind a selector, for which it answers as prepared."""

    def __init__(self, selector: int, others: int = 0) -> None:
        self._selector, self._others = selector, others

    def available(self, feature: str) -> bool:
        return feature == "DeviceTemperature"

    def entries(self, feature: str) -> tuple[str, ...]:
        return ()

    def set_string(self, feature: str, value: str) -> None:
        if self._selector:
            raise AravisError(DEVICE_ERRORS, self._selector, "as prepared")

    def read_register(self, address: int) -> int:
        if self._others:
            raise AravisError(DEVICE_ERRORS, self._others, "nobody there")
        return 0x00010002


@pytest.mark.parametrize(("code", "cause"), [(5, "wire"), (17, "device")])
def test_whether_it_is_the_selector_alone_that_is_not_answered_for_decides(code: int, cause: str):
    wanted = TemperatureFeature(feature="DeviceTemperature", selector="Where", entry="Sensor")
    assert find_temperature(cast("GigeDevice", Asked(0)), wanted) == wanted
    found = find_temperature(cast("GigeDevice", Asked(code)), wanted)
    assert isinstance(found, NoTemperature)
    assert (found.cause, found.reason) == (
        cause,
        "DeviceTemperature of Where 'Sensor' cannot be read (as prepared)",
    )
    with pytest.raises(AravisError, match="as prepared"):
        find_temperature(cast("GigeDevice", Asked(5, others=5)), wanted)


async def test_a_rate_of_the_cameras_own_choice_is_switched_off_once_the_rate_exists():
    """As Point Grey's: the automatic is offered with the rate enabled only."""
    automatic = choice(
        "AcquisitionFrameRateAuto",
        0xF0F00A00,
        {"Off": 0, "Continuous": 1},
        "<pIsAvailable>AcquisitionFrameRateEnabled</pIsAvailable>",
    )
    file = GenicamFile(Dialect(IMAGE + IIDC + automatic).xml("auto"), "auto")
    with dressed(file) as registers:
        registers.write(0xF0F00A00, (1).to_bytes(4, "big"))
        async with opened(trigger="free_run", frame_rate_hz=10.0):
            assert int.from_bytes(registers.read(0xF0F00A00, 4), "big") == 0


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        (b"no camera at all", "is no GenICam file"),
        (b"<RegisterDescription", "is no GenICam file"),
        (b"<html></html>", "it begins with <html>, not <RegisterDescription>"),
    ],
)
def test_what_is_no_genicam_file_is_refused_with_a_sentence(text: bytes, sentence: str, tmp_path: Path):
    path = tmp_path / "camera.xml"
    path.write_bytes(text)
    with pytest.raises(ConfigError, match=sentence):
        read_genicam(path)
    with pytest.raises(ConfigError, match="cannot be read"):
        read_genicam(tmp_path / "none.xml")


# Of the makes that are known: what is missing from those that cannot be used.
REFUSED = {
    "JAI_RM-6740GE": "no ExposureTime and no ExposureTimeAbs and no ExposureTimeRaw",
    "Photonic_Science_FDI3": "its ExposureTimeRaw states no unit; give exposure_step_s",
    "Photonic_Science_LC_SCMOS": "its ExposureTimeRaw states no unit; give exposure_step_s",
    "Sony_CVC_EH6300": "no PixelFormat Mono8",
}


@pytest.mark.skipif(not FOLDER, reason="$GENICAM names no folder of GenICam files")
@pytest.mark.parametrize("path", sorted(Path(FOLDER).glob("*.xml")) if FOLDER else [], ids=lambda path: path.stem)
async def test_real_files_open_and_grab_or_are_refused_by_the_name_of_what_is_missing(path: Path):
    require_aravis()
    with dressed(read_genicam(path), (640, 480)):
        if path.stem in REFUSED:
            with pytest.raises(Refused, match=REFUSED[path.stem]):
                async with opened():
                    pass
            return
        async with opened() as camera:
            frame = await camera.grab()
    assert (frame.image[:480, :640] == scene(480, 640)[: frame.image.shape[0], : frame.image.shape[1]]).all()
