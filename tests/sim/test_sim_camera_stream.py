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
    WAIT_s,
    address,
    expected,
    image_of,
    render,
)
from tests.sim.gvcp_client import decode_leader, pack_words
from tests.still_plant import StillPlant
from thermostand.drivers.sim.gige import gvsp
from thermostand.drivers.sim.gige.camera import FakeCamera
from thermostand.drivers.sim.gige.gvcp import GvcpCommand, Resend
from thermostand.drivers.sim.gige.gvsp import PacketKind
from thermostand.drivers.sim.gige.gvsp_sender import CameraFaults, StreamSender
from thermostand.foundation.clock import FollowedClock, to_ns


@pytest.mark.parametrize("packet_size", [576, 1500, 8000])
def test_a_triggered_frame_is_the_rendered_array_bit_for_bit(
    client: Client, clock: FollowedClock, packet_size: int
) -> None:
    client.connect(packet_size)
    client.set("Gain", 6.0)
    client.arm()
    clock.follow(START_NS + to_ns(2.0))
    client.set("TriggerSoftware", 1)
    packets = client.packets()
    np.testing.assert_array_equal(image_of(packets), expected(2.0, gain_dB=6.0))
    assert [packet.packet_id for packet in packets] == list(range(len(packets)))
    assert {packet.block_id for packet in packets} == {1}
    assert {len(packet.data) + 36 for packet in packets[1:-2]} == {packet_size}
    assert decode_leader(packets[0].data).timestamp == to_ns(2.0)


def test_every_trigger_gives_one_frame_with_the_next_id(client: Client, clock: FollowedClock) -> None:
    client.connect()
    client.arm()
    for count in (1, 2, 3):
        clock.follow(START_NS + to_ns(count))
        client.set("TriggerSoftware", 1)
        packets = client.packets()
        assert packets[0].block_id == count
        np.testing.assert_array_equal(image_of(packets), expected(count))
    assert client.stream_is_silent()


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


def test_a_packet_may_be_asked_for_again_as_soon_as_it_has_come(
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
