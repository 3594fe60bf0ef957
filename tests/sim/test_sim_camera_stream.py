"""The fake camera's images on its sockets: bit for bit, and whole also over a network that loses packets."""

import threading
import time
from typing import Any

import numpy as np
import pytest

from tests.sim.camera_client import (
    HEIGHT,
    START_NS,
    WIDTH,
    Client,
    SILENCE_s,
    WAIT_s,
    address,
    expected,
    image_of,
    render,
)
from tests.sim.gvcp_client import Packet, decode_leader, pack_words
from tests.still_plant import StillPlant
from thermostand.drivers.sim.gige import gvsp
from thermostand.drivers.sim.gige.camera import FakeCamera
from thermostand.drivers.sim.gige.gvcp import GvcpCommand, GvcpStatus, Resend
from thermostand.drivers.sim.gige.gvsp import PacketKind
from thermostand.drivers.sim.gige.gvsp_sender import CameraFaults, StreamSender
from thermostand.foundation.clock import FollowedClock, seconds_ns


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
        assert client.set(name, value) == GvcpStatus.OK
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
    pixels = b"".join(packet.data for packet in client.packets() if packet.kind == PacketKind.PAYLOAD)
    np.testing.assert_array_equal(np.frombuffer(pixels, "<u2"), expected(0.0).ravel().astype("<u2") * 16)


def test_extended_ids_carry_the_same_image(plant: StillPlant, clock: FollowedClock) -> None:
    camera = FakeCamera(plant, clock, render, address(), "SN1", size_px=(WIDTH, HEIGHT), extended_ids=True)
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


def test_a_frame_with_a_third_of_its_packets_lost_is_completed_by_resends(
    client: Client, camera: FakeCamera, faults: CameraFaults
) -> None:
    faults.loss = 0.3
    client.connect(576)
    client.arm()
    client.set("TriggerSoftware", 1)
    whole = gvsp.ImageBlock(1, gvsp.Leader(0, 0, WIDTH, HEIGHT), memoryview(bytes(WIDTH * HEIGHT)), 576)
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


@pytest.mark.parametrize(
    ("fault", "missing"), [("drop_leader", PacketKind.LEADER), ("drop_trailer", PacketKind.TRAILER)]
)
def test_a_dropped_leader_or_trailer_comes_when_asked_for(
    client: Client, faults: CameraFaults, fault: str, missing: PacketKind
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
    assert client.ask(GvcpCommand.READREG, capability).payload[-1] & 0b100
    faults.no_resend = True
    assert not client.ask(GvcpCommand.READREG, capability).payload[-1] & 0b100
    client.connect(8000)
    client.arm()
    client.set("TriggerSoftware", 1)
    client.packets()
    client.resend(1, 0, 3)
    assert client.stream_is_silent()


def test_the_test_packet_has_exactly_the_packet_size(client: Client) -> None:
    client.connect(8000)
    client.ask(GvcpCommand.WRITEREG, pack_words([0x0D04, 1 << 31 | 8000]))
    client.stream.settimeout(WAIT_s)
    assert len(client.stream.recv(65536)) == 8000 - 28


def test_packets_leave_at_the_pace(plant: StillPlant, clock: FollowedClock) -> None:
    camera = FakeCamera(plant, clock, render, address(), "SN1", size_px=(WIDTH, HEIGHT), pace_MBps=0.4)
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
