"""The fake camera on its sockets: against a small client of our own, and against Aravis' arv-tool."""

import os
import shutil
import socket
import struct
import subprocess
import threading
import time
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from drivers.sim.gige import gvcp, gvsp
from drivers.sim.gige.camera import FakeCamera
from drivers.sim.gige.genicam import features
from drivers.sim.gige.gvcp import Ack, Command, Request, Resend, Status
from drivers.sim.gige.gvsp import Kind, Packet
from drivers.sim.gige.gvsp_sender import CameraFaults, StreamSender
from foundation.clock import FollowedClock, seconds_ns
from tests.addresses import camera_address
from tests.sim.gvcp_client import decode_ack, decode_leader, pack_read_memory, pack_words

ADDRESS = camera_address()
WIDTH, HEIGHT = 320, 240
START_NS = seconds_ns(1_700_000_000.0)
FEATURES = {feature.name: feature for feature in features(WIDTH, HEIGHT, "SN1")}
WAIT_s = 5.0
SILENCE_s = 0.1


class StubPlant:
    def __init__(self) -> None:
        self.lock = threading.RLock()
        self.sensor_degC = 41.37
        self.body_degC = 33.1
        self.camera_powered = True
        self.camera_power_on_ns: int | None = START_NS

    def advance(self, now_ns: int) -> None:
        pass


def render(time_ns: int, exposure_s: float, gain_dB: float, rows: int = HEIGHT) -> NDArray[np.uint8]:
    """Another pattern for every instant, exposure and gain."""
    seed = (time_ns, round(exposure_s * 1e6), round(gain_dB * 10))
    return np.random.default_rng(seed).integers(0, 256, (HEIGHT, WIDTH), dtype=np.uint8)[:rows]


class Client:
    """The other end of both protocols, with nothing but sockets and codecs."""

    def __init__(self) -> None:
        self.control = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.control.bind(("127.0.0.1", 0))
        self.stream = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.stream.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 20)
        self.stream.bind(("127.0.0.1", 0))
        self.req_id = 0

    def ask(self, command: int, payload: bytes) -> Ack:
        """The acknowledge of one command; TimeoutError when there is none."""
        self.req_id += 1
        self.control.settimeout(WAIT_s)
        self.control.sendto(Request(command, self.req_id, payload).encode(), (ADDRESS, gvcp.PORT))
        return decode_ack(self.control.recv(1024))

    def is_ignored(self) -> bool:
        self.control.settimeout(SILENCE_s)
        self.control.sendto(Request(Command.DISCOVERY, 0xFFFF).encode(), (ADDRESS, gvcp.PORT))
        try:
            self.control.recv(1024)
        except TimeoutError:
            return True
        return False

    def set(self, name: str, value: float) -> int:
        feature = FEATURES[name]
        data = struct.pack(">d", value) if feature.kind == "float" else int(value).to_bytes(4, "big")
        return self.ask(Command.WRITEMEM, gvcp.pack_write_memory(feature.address, data)).status

    def get(self, name: str) -> float:
        feature = FEATURES[name]
        payload = pack_read_memory(feature.address, feature.length)
        ack = self.ask(Command.READMEM, payload)
        assert ack.status == Status.OK
        data = ack.payload[4:]
        return struct.unpack(">d", data)[0] if feature.kind == "float" else int.from_bytes(data, "big")

    def connect(self, packet_size: int = 1500) -> None:
        """Take control and open the stream."""
        assert self.set("GevCCP", 2) == Status.OK
        assert self.set("GevSCDA", 0x7F000001) == Status.OK
        assert self.set("GevSCPHostPort", self.stream.getsockname()[1]) == Status.OK
        assert self.set("GevSCPSPacketSize", packet_size) == Status.OK

    def arm(self, exposure_us: float = 100_000.0) -> None:
        """Wait for software triggers."""
        self.set("ExposureTime", exposure_us)
        self.set("TriggerMode", 1)
        self.set("AcquisitionStart", 1)

    def resend(self, block_id: int, first: int, last: int, extended: bool = False) -> None:
        request = Resend(block_id, first, last, extended).request(1)
        self.control.sendto(request.encode(), (ADDRESS, gvcp.PORT))

    def packet(self, wait_s: float = WAIT_s) -> Packet:
        self.stream.settimeout(wait_s)
        return gvsp.decode(self.stream.recv(65536))

    def packets(self) -> list[Packet]:
        """All packets up to a trailer."""
        packets = [self.packet()]
        while packets[-1].kind != Kind.TRAILER:
            packets.append(self.packet())
        return packets

    def stream_is_silent(self) -> bool:
        try:
            self.packet(SILENCE_s)
        except TimeoutError:
            return True
        return False

    def close(self) -> None:
        self.control.close()
        self.stream.close()


@pytest.fixture
def plant() -> StubPlant:
    return StubPlant()


@pytest.fixture
def clock() -> FollowedClock:
    return FollowedClock(START_NS)


@pytest.fixture
def faults() -> CameraFaults:
    return CameraFaults()


@pytest.fixture
def camera(plant: StubPlant, clock: FollowedClock, faults: CameraFaults) -> Iterator[FakeCamera]:
    camera = FakeCamera(plant, clock, render, ADDRESS, "SN1", size_px=(WIDTH, HEIGHT), faults=faults)
    camera.start()
    yield camera
    camera.close()


@pytest.fixture
def client(camera: FakeCamera) -> Iterator[Client]:
    client = Client()
    yield client
    client.close()


def image_of(packets: list[Packet]) -> NDArray[np.uint8]:
    leader = decode_leader(packets[0].data)
    pixels = b"".join(packet.data for packet in packets if packet.kind == Kind.PAYLOAD)
    return np.frombuffer(pixels, np.uint8).reshape(leader.height, leader.width)


def expected(start_s: float, exposure_s: float = 0.1, gain_dB: float = 0.0) -> NDArray[np.uint8]:
    return render(START_NS + seconds_ns(start_s + exposure_s / 2), exposure_s, gain_dB)


# ------------------------------------------------------------------------------------------------------------- images


@pytest.mark.parametrize("packet_size", [576, 1500, 8000])
def test_a_triggered_frame_is_the_rendered_array_bit_for_bit(
    client: Client, clock: FollowedClock, packet_size: int
) -> None:
    client.connect(packet_size)
    client.set("Gain", 6.0)
    client.arm()
    clock.follow(START_NS + seconds_ns(2.0))
    client.set("TriggerSoftware", 1)
    packets = client.packets()
    np.testing.assert_array_equal(image_of(packets), expected(2.0, gain_dB=6.0))
    assert [packet.packet_id for packet in packets] == list(range(len(packets)))
    assert {packet.block_id for packet in packets} == {1}
    assert {len(packet.data) + 36 for packet in packets[1:-2]} == {packet_size}
    assert decode_leader(packets[0].data).timestamp == seconds_ns(2.0)


def test_every_trigger_gives_one_frame_with_the_next_id(client: Client, clock: FollowedClock) -> None:
    client.connect()
    client.arm()
    for count in (1, 2, 3):
        clock.follow(START_NS + seconds_ns(count))
        client.set("TriggerSoftware", 1)
        packets = client.packets()
        assert packets[0].block_id == count
        np.testing.assert_array_equal(image_of(packets), expected(count))
    assert client.stream_is_silent()


def test_a_free_run_in_virtual_time_sends_only_the_latest_frame(
    client: Client, camera: FakeCamera, clock: FollowedClock
) -> None:
    client.connect()
    client.set("ExposureTime", 100_000.0)
    client.set("AcquisitionFrameRate", 2.0)
    client.set("AcquisitionFrameRateEnable", 1)
    client.set("AcquisitionStart", 1)
    clock.follow(START_NS + seconds_ns(1.3))
    camera.advance(clock.now_ns())
    packets = client.packets()
    assert packets[0].block_id == 3
    assert decode_leader(packets[0].data).timestamp == seconds_ns(1.0)
    np.testing.assert_array_equal(image_of(packets), expected(1.0))
    camera.advance(clock.now_ns())
    assert client.stream_is_silent()


def test_a_region_is_cut_from_the_sensor(client: Client) -> None:
    client.connect()
    for name, value in (("Width", 64), ("Height", 32), ("OffsetX", 8), ("OffsetY", 4)):
        assert client.set(name, value) == Status.OK
    assert client.get("PayloadSize") == 64 * 32
    client.arm()
    client.set("TriggerSoftware", 1)
    packets = client.packets()
    leader = decode_leader(packets[0].data)
    assert (leader.width, leader.height, leader.offset_x, leader.offset_y) == (64, 32, 8, 4)
    np.testing.assert_array_equal(image_of(packets), expected(0.0)[4:36, 8:72])


def test_mono12_carries_the_grey_value_in_the_upper_8_of_12_bits(client: Client) -> None:
    client.connect()
    client.set("PixelFormat", gvsp.PixelFormat.MONO12)
    assert client.get("PayloadSize") == 2 * WIDTH * HEIGHT
    client.arm()
    client.set("TriggerSoftware", 1)
    pixels = b"".join(packet.data for packet in client.packets() if packet.kind == Kind.PAYLOAD)
    np.testing.assert_array_equal(np.frombuffer(pixels, "<u2"), expected(0.0).ravel().astype("<u2") * 16)


def test_extended_ids_carry_the_same_image(plant: StubPlant, clock: FollowedClock) -> None:
    camera = FakeCamera(plant, clock, render, ADDRESS, "SN1", size_px=(WIDTH, HEIGHT), extended_ids=True)
    camera.start()
    client = Client()
    try:
        client.connect()
        client.arm()
        client.set("TriggerSoftware", 1)
        packets = client.packets()
        assert {packet.extended for packet in packets} == {True}
        np.testing.assert_array_equal(image_of(packets), expected(0.0))
        client.resend(1, 2, 2, extended=True)
        assert client.packet().data == packets[2].data
    finally:
        client.close()
        camera.close()


# -------------------------------------------------------------------------------------------------------- the network


def test_a_frame_with_a_third_of_its_packets_lost_is_completed_by_resends(
    client: Client, camera: FakeCamera, faults: CameraFaults
) -> None:
    faults.loss = 0.3
    client.connect(576)
    client.arm()
    client.set("TriggerSoftware", 1)
    whole = gvsp.Block(1, gvsp.Leader(0, 0, WIDTH, HEIGHT), memoryview(bytes(WIDTH * HEIGHT)), 576)
    got: dict[int, Packet] = {}
    while len(got) <= whole.trailer_id:
        try:
            packet = client.packet(SILENCE_s)
            got.setdefault(packet.packet_id, packet)
        except TimeoutError:
            for packet_id in set(range(whole.trailer_id + 1)) - set(got):
                client.resend(1, packet_id, packet_id)
    np.testing.assert_array_equal(image_of([got[packet_id] for packet_id in sorted(got)]), expected(0.0))
    assert camera.counts.lost > 10
    assert camera.counts.resent > 10
    assert gvsp.RESENT in {packet.status for packet in got.values()}


@pytest.mark.parametrize(("fault", "missing"), [("drop_leader", Kind.LEADER), ("drop_trailer", Kind.TRAILER)])
def test_a_dropped_leader_or_trailer_comes_when_asked_for(
    client: Client, faults: CameraFaults, fault: str, missing: Kind
) -> None:
    setattr(faults, fault, True)
    client.connect(8000)
    client.arm()
    client.set("TriggerSoftware", 1)
    last_id = -(-WIDTH * HEIGHT // 7964) + 1
    packets = [client.packet() for _ in range(last_id)]
    assert missing not in {packet.kind for packet in packets}
    client.resend(1, 0, 0xFFFFFF)
    again = [client.packet() for _ in range(last_id + 1)]
    assert [packet.packet_id for packet in again] == list(range(last_id + 1))


def test_a_packet_may_be_asked_for_again_as_soon_as_it_is_there(
    client: Client, faults: CameraFaults, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The client may be quicker than the thread that has sent it."""
    faults.drop_trailer = True
    last_id, asked = -(-WIDTH * HEIGHT // 7964) + 1, threading.Event()
    transmit, resend = StreamSender._transmit, StreamSender.resend

    def transmit_and_wait(sender: StreamSender, *sent: Any) -> None:
        transmit(sender, *sent)
        if sender.counts.packets == last_id:
            asked.wait(WAIT_s)

    def resend_and_say(sender: StreamSender, request: Resend) -> None:
        resend(sender, request)
        asked.set()

    monkeypatch.setattr(StreamSender, "_transmit", transmit_and_wait)
    monkeypatch.setattr(StreamSender, "resend", resend_and_say)
    client.connect(8000)
    client.arm()
    client.set("TriggerSoftware", 1)
    for _ in range(last_id):
        client.packet()
    client.resend(1, 0, 0xFFFFFF)
    assert [client.packet().packet_id for _ in range(last_id + 1)] == list(range(last_id + 1))


def test_only_the_last_four_frames_can_be_asked_for_again(client: Client, camera: FakeCamera) -> None:
    client.connect(8000)
    client.arm()
    for _ in range(5):
        client.set("TriggerSoftware", 1)
        client.packets()
    client.resend(1, 3, 4)
    refused = client.packet()
    assert (refused.status, refused.block_id, refused.packet_id) == (gvsp.UNAVAILABLE, 1, 3)
    client.resend(2, 3, 3)
    assert (client.packet().status, camera.counts.unavailable) == (gvsp.RESENT, 1)


def test_a_camera_without_resend_says_so_and_ignores_requests(client: Client, faults: CameraFaults) -> None:
    capability = pack_words([0x0934])
    assert client.ask(Command.READREG, capability).payload[-1] & 0b100
    faults.no_resend = True
    assert not client.ask(Command.READREG, capability).payload[-1] & 0b100
    client.connect(8000)
    client.arm()
    client.set("TriggerSoftware", 1)
    client.packets()
    client.resend(1, 0, 3)
    assert client.stream_is_silent()


def test_the_test_packet_has_exactly_the_packet_size(client: Client) -> None:
    client.connect(8000)
    client.ask(Command.WRITEREG, pack_words([0x0D04, 1 << 31 | 8000]))
    client.stream.settimeout(WAIT_s)
    assert len(client.stream.recv(65536)) == 8000 - 28


def test_packets_leave_at_the_pace(plant: StubPlant, clock: FollowedClock) -> None:
    camera = FakeCamera(plant, clock, render, ADDRESS, "SN1", size_px=(WIDTH, HEIGHT), pace_MBps=0.4)
    camera.start()
    client = Client()
    try:
        client.connect(8000)
        client.arm()
        begin_s = time.monotonic()
        client.set("TriggerSoftware", 1)
        client.packets()
        assert time.monotonic() - begin_s > 0.12  # 77 kB in bursts of 40 kB at 0.4 MB/s: the last leaves after 0.2 s
    finally:
        client.close()
        camera.close()


# ----------------------------------------------------------------------------------------- control, power, temperature


def test_a_stop_ends_the_frames_and_unlocks_the_settings(client: Client, camera: FakeCamera) -> None:
    client.connect()
    client.arm()
    assert client.set("Width", 64) == Status.ACCESS_DENIED
    client.set("AcquisitionStop", 1)
    assert not camera.streaming
    assert client.set("Width", 64) == Status.OK
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
    client: Client, camera: FakeCamera, plant: StubPlant, clock: FollowedClock
) -> None:
    client.connect()
    client.arm()
    plant.camera_powered = False
    assert client.is_ignored()
    assert not camera.streaming
    clock.follow(START_NS + seconds_ns(10.0))
    plant.camera_powered, plant.camera_power_on_ns = True, clock.now_ns()
    camera.advance(clock.now_ns())
    clock.follow(START_NS + seconds_ns(12.9))
    assert client.is_ignored()
    clock.follow(START_NS + seconds_ns(13.0))
    assert client.get("GevCCP") == 0
    assert client.get("ExposureTime") == 10_000.0
    assert client.set("Gain", 1.0) == Status.ACCESS_DENIED
    client.connect()
    client.set("GevTimestampControlLatch", 2)
    assert client.get("GevTimestampValue") == seconds_ns(3.0)


def test_a_dip_of_the_supply_that_nobody_saw_costs_everything_too(
    client: Client, plant: StubPlant, clock: FollowedClock
) -> None:
    client.connect()
    plant.camera_power_on_ns = START_NS + 1
    assert client.is_ignored()
    clock.follow(START_NS + 1 + seconds_ns(3.0))
    assert client.get("GevCCP") == 0


def test_a_reset_is_acknowledged_and_followed_by_a_boot(
    client: Client, clock: FollowedClock, camera: FakeCamera
) -> None:
    client.connect()
    assert client.set("DeviceReset", 1) == Status.OK
    assert client.is_ignored()
    clock.follow(START_NS + seconds_ns(3.0))
    assert client.get("GevCCP") == 0


def test_the_temperature_is_that_of_the_selected_place_in_quarters_of_a_kelvin(
    client: Client, plant: StubPlant
) -> None:
    assert client.get("DeviceTemperature") == 41.25
    client.connect()
    client.set("DeviceTemperatureSelector", 1)
    assert client.get("DeviceTemperature") == 33.0
    plant.body_degC = -12.4
    assert client.get("DeviceTemperature") == -12.5


def test_the_temperature_can_be_zero_stuck_or_refused(client: Client, plant: StubPlant, faults: CameraFaults) -> None:
    assert client.get("DeviceTemperature") == 41.25
    plant.sensor_degC = 50.0
    faults.temperature = "stuck"
    assert client.get("DeviceTemperature") == 41.25
    faults.temperature = "zero"
    assert client.get("DeviceTemperature") == 0.0
    faults.temperature = "access"
    payload = pack_read_memory(FEATURES["DeviceTemperature"].address, 8)
    assert client.ask(Command.READMEM, payload).status == Status.ACCESS_DENIED
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


def test_a_trigger_executed_twice_gives_two_frames(client: Client, faults: CameraFaults) -> None:
    faults.trigger_twice = True
    client.connect(8000)
    client.arm()
    client.set("TriggerSoftware", 1)
    assert [client.packets()[0].block_id for _ in range(2)] == [1, 2]


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
    done = subprocess.run([arv_tool, "-a", ADDRESS, *arguments], capture_output=True, text=True, timeout=20, check=True)
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
        client.control.sendto(Request(command, 7).encode(), (ADDRESS, gvcp.PORT))
    client.control.settimeout(WAIT_s)
    client.req_id = 100
    while (ack := decode_ack(client.control.recv(1024))).command != 0xFFFE:
        assert ack.status != Status.OK
    assert client.ask(Command.DISCOVERY, b"").status == Status.OK
