"""The fake camera's control, power and temperature: against a small client of our own, and against Aravis' arv-tool."""

import os
import shutil
import subprocess

import pytest

from tests.sim.camera_client import (
    FEATURES,
    HEIGHT,
    START_NS,
    WIDTH,
    Client,
    WAIT_s,
    address,
)
from tests.sim.gvcp_client import decode_ack, pack_read_memory
from tests.still_plant import StillPlant
from thermostand.drivers.sim.gige import gvcp
from thermostand.drivers.sim.gige.camera import FakeCamera
from thermostand.drivers.sim.gige.gvcp import GvcpCommand, GvcpRequest, GvcpStatus
from thermostand.drivers.sim.gige.gvsp_sender import CameraFaults
from thermostand.foundation.clock import FollowedClock, to_ns


def test_a_stop_ends_the_frames_and_unlocks_the_settings(client: Client, camera: FakeCamera) -> None:
    client.connect()
    client.arm()
    assert client.set("Width", 64) == GvcpStatus.ACCESS_DENIED
    client.set("AcquisitionStop", 1)
    assert not camera.streaming
    assert client.set("Width", 64) == GvcpStatus.OK
    client.set("TriggerSoftware", 1)
    assert client.stream_is_silent()


def test_ids_begin_at_1_again_with_every_acquisition(client: Client) -> None:
    client.connect(8000)
    for _ in range(2):
        client.arm()
        client.set("TriggerSoftware", 1)
        assert client.packets()[0].block_id == 1
        client.set("AcquisitionStop", 1)


def test_giving_up_control_stops_the_stream(client: Client, camera: FakeCamera) -> None:
    client.connect()
    client.arm()
    client.set("GevCCP", 0)
    assert not camera.streaming
    assert client.get("GevSCPHostPort") == 0


def test_without_power_the_camera_is_dead_and_comes_back_with_its_defaults(
    client: Client, camera: FakeCamera, plant: StillPlant, clock: FollowedClock
) -> None:
    client.connect()
    client.arm()
    plant.camera_powered = False
    assert client.is_ignored()
    assert not camera.streaming
    clock.follow(START_NS + to_ns(10.0))
    plant.camera_powered, plant.camera_power_on_ns = True, clock.now_ns()
    camera.advance(clock.now_ns())
    clock.follow(START_NS + to_ns(12.9))
    assert client.is_ignored()
    clock.follow(START_NS + to_ns(13.0))
    assert client.get("GevCCP") == 0
    assert client.get("ExposureTime") == 10_000.0
    assert client.set("Gain", 1.0) == GvcpStatus.ACCESS_DENIED
    client.connect()
    client.set("GevTimestampControlLatch", 2)
    assert client.get("GevTimestampValue") == to_ns(3.0)


def test_a_dip_of_the_supply_that_nobody_saw_costs_everything_too(
    client: Client, plant: StillPlant, clock: FollowedClock
) -> None:
    client.connect()
    plant.camera_power_on_ns = START_NS + 1
    assert client.is_ignored()
    clock.follow(START_NS + 1 + to_ns(3.0))
    assert client.get("GevCCP") == 0


def test_a_reset_is_acknowledged_and_followed_by_a_boot(
    client: Client, clock: FollowedClock, camera: FakeCamera
) -> None:
    client.connect()
    assert client.set("DeviceReset", 1) == GvcpStatus.OK
    assert client.is_ignored()
    clock.follow(START_NS + to_ns(3.0))
    assert client.get("GevCCP") == 0


def test_the_temperature_is_that_of_the_selected_place_in_quarters_of_a_kelvin(
    client: Client, plant: StillPlant
) -> None:
    assert client.get("DeviceTemperature") == 41.25
    client.connect()
    client.set("DeviceTemperatureSelector", 1)
    assert client.get("DeviceTemperature") == 33.0
    plant.body_degC = -12.4
    assert client.get("DeviceTemperature") == -12.5


def test_the_temperature_can_be_zero_stuck_or_refused(client: Client, plant: StillPlant, faults: CameraFaults) -> None:
    assert client.get("DeviceTemperature") == 41.25
    plant.sensor_degC = 50.0
    faults.temperature = "stuck"
    assert client.get("DeviceTemperature") == 41.25
    faults.temperature = "zero"
    assert client.get("DeviceTemperature") == 0.0
    faults.temperature = "access"
    payload = pack_read_memory(FEATURES["DeviceTemperature"].address, 8)
    assert client.ask(GvcpCommand.READMEM, payload).status == GvcpStatus.ACCESS_DENIED
    assert client.get("ExposureTime") == 10_000.0
    faults.temperature = None
    assert client.get("DeviceTemperature") == 50.0


def test_silence_can_be_had_on_either_channel_alone(client: Client, faults: CameraFaults) -> None:
    faults.silent_gvcp = True
    assert client.is_ignored()
    faults.silent_gvcp = False
    faults.silent_gvsp = True
    client.connect()
    client.arm()
    client.set("TriggerSoftware", 1)
    assert client.stream_is_silent()


# ----------------------------------------------------------------------------------------------------- Aravis' arv-tool


@pytest.fixture
def arv_tool(camera: FakeCamera) -> str:
    path = shutil.which("arv-tool-0.8")
    if path is None:
        if os.environ.get("CI") == "true":
            pytest.fail("arv-tool-0.8 is missing: install aravis-tools-cli")
        pytest.skip("arv-tool-0.8 is not installed")
    return path


def run(arv_tool: str, *arguments: str) -> str:
    done = subprocess.run(
        [arv_tool, "-a", address(), *arguments], capture_output=True, text=True, timeout=20, check=True
    )
    return done.stdout


def test_arv_tool_lists_the_features(arv_tool: str) -> None:
    listing = run(arv_tool, "features")
    for name, feature in FEATURES.items():
        if feature.category is not None:
            access = "RW" if feature.access == "RW" else "RO"
            assert f"[{access}] '{name}'" in listing


def test_arv_tool_reads_and_sets_features(arv_tool: str) -> None:
    answers = run(
        arv_tool,
        "control",
        "DeviceSerialNumber",
        "Width=64",
        "OffsetX=8",
        "PixelFormat=Mono12",
        "PayloadSize",
        "ExposureTime=20000",
        "AcquisitionFrameRateEnable=true",
        "AcquisitionFrameRate=2.5",
        "TriggerMode=On",
        "DeviceTemperature",
        "DeviceTemperatureSelector=Mainboard",
        "DeviceTemperature",
        "GevSCPSPacketSize=8000",
    ).splitlines()
    assert answers == [
        "DeviceSerialNumber = SN1",
        f"Width = 64 px min:16 max:{WIDTH} inc:4",
        f"OffsetX = 8 px min:0 max:{WIDTH - 64} inc:4",
        "PixelFormat = Mono12",
        f"PayloadSize = {64 * HEIGHT * 2} B min:0 max:4294967295",
        "ExposureTime = 20000 us min:20 max:1e+07",
        "AcquisitionFrameRateEnable = true",
        "AcquisitionFrameRate = 2.5 Hz min:0.01 max:14",
        "TriggerMode = On",
        "DeviceTemperature = 41.25 C min:-60 max:150",
        "DeviceTemperatureSelector = Mainboard",
        "DeviceTemperature = 33 C min:-60 max:150",
        "GevSCPSPacketSize = 8000 B min:220 max:16112 inc:4",
    ]


def test_arv_tool_learns_why_a_value_is_refused(arv_tool: str) -> None:
    assert "invalid-parameter" in run(arv_tool, "control", "Gain=99")


def test_datagrams_of_any_command_leave_the_camera_answering(client: Client) -> None:
    for command in (0x0000, 0x0001, 0x7FFF, 0xFFFE, 0xFFFF):
        client.control.sendto(GvcpRequest(command, 7).encode(), (address(), gvcp.PORT))
    client.control.settimeout(WAIT_s)
    client.req_id = 100
    while (ack := decode_ack(client.control.recv(1024))).command != 0xFFFE:
        assert ack.status != GvcpStatus.OK
    assert client.ask(GvcpCommand.DISCOVERY, b"").status == GvcpStatus.OK
