"""Packets, answers and time stamps that a camera should not send, through Aravis: never a wrong pixel, never a frame
lost without need, never a wrong instant."""

import threading
from collections.abc import AsyncGenerator

import pytest

from tests.still_plant import StillPlant
from tests.system.camera_bench import noise, open_camera, run_simulated_camera, run_virtual_camera
from thermostand.drivers.devices.cameras.camera_gige import AravisCamera
from thermostand.drivers.sim.gige.camera import FakeCamera
from thermostand.drivers.sim.gige.gvsp_sender import StreamSender
from thermostand.drivers.wires import camera_connection
from thermostand.foundation.clock import NS_PER_S, VirtualClock, WallClock
from thermostand.foundation.errors import Unreachable
from thermostand.foundation.readings import Frame

FRAMES = 5


@pytest.fixture
async def wired(plant: StillPlant) -> AsyncGenerator[tuple[VirtualClock, FakeCamera]]:
    async with run_virtual_camera(plant) as both:
        yield both


def is_right(frame: Frame) -> bool:
    return bool((frame.image == noise(frame.time_ns, frame.exposure_s, 0.0)).all())


async def grabbed(camera: AravisCamera, clock: VirtualClock, count: int = FRAMES) -> list[Frame]:
    frames = list[Frame]()
    for _ in range(count):
        frames.append(await camera.grab())
        await clock.sleep_until(clock.now_ns() + NS_PER_S)
    return frames


async def test_a_frame_that_a_busy_machine_holds_up_half_way_is_waited_for_in_virtual_time(
    wired: tuple[VirtualClock, FakeCamera], monkeypatch: pytest.MonkeyPatch
):
    """Longer than a frame's period: a session must not tell how busy the machine was."""
    clock, _ = wired
    pace, holds_s = StreamSender._pace, [0.7]

    def pace_and_hold(sender: StreamSender, size_bytes: int, packets: int) -> None:
        pace(sender, size_bytes, packets)
        if holds_s:
            threading.Event().wait(holds_s.pop())

    async with open_camera(clock, packet_size=1500) as camera:
        monkeypatch.setattr(StreamSender, "_pace", pace_and_hold)
        frames = await grabbed(camera, clock, 2)
    assert holds_s == []
    assert [(frame.block_id, frame.dropped) for frame in frames] == [(1, 0), (2, 0)]
    assert all(map(is_right, frames))


@pytest.mark.parametrize("fault", ["doubled", "reordered"])
async def test_packets_that_come_twice_or_late_make_the_same_frame(wired: tuple[VirtualClock, FakeCamera], fault: str):
    clock, fake = wired
    async with open_camera(clock, packet_size=1500) as camera:
        setattr(fake.faults, fault, 0.2)
        assert all(map(is_right, await grabbed(camera, clock)))
        assert camera.counters().get("lost", 0) == 0


@pytest.mark.parametrize("fault", ["leader_early_s", "stretch_s"])
async def test_a_frame_is_waited_for_until_the_next_one_is_due(plant: StillPlant, fault: str):
    """In real time: Aravis' own patience, 0.1 s behind the last packet, would give up a camera that sends its leader
    with the begin of the exposure."""
    with run_simulated_camera(WallClock(), plant) as fake:
        async with open_camera(packet_size=1500, frame_rate_hz=0.5) as camera:
            setattr(fake.faults, fault, 0.4)
            assert (await camera.grab()).dropped == 0
            counters = camera.counters()
    assert {name: count for name, count in counters.items() if name.startswith(("incomplete", "lost", "miss"))} == {}


async def test_a_frame_with_a_packet_cut_short_is_never_used(wired: tuple[VirtualClock, FakeCamera]):
    clock, fake = wired
    async with open_camera(clock, packet_size=1500) as camera:
        await grabbed(camera, clock, 1)
        fake.faults.truncated = 0.01  # one or two of a frame's 220 packets
        frames = list[Frame]()
        for _ in range(FRAMES):
            try:
                frames.append(await camera.grab())
            except Unreachable:
                await camera.open()
            await clock.sleep_until(clock.now_ns() + NS_PER_S)
        assert all(map(is_right, frames))
        assert camera.counters()["lost"] + sum(frame.dropped for frame in frames) > 0
        fake.faults.truncated = 0.0
        assert all(map(is_right, await grabbed(camera, clock, 1)))


async def test_frames_larger_than_the_camera_has_announced_are_counted_and_never_used(
    wired: tuple[VirtualClock, FakeCamera],
):
    clock, fake = wired
    fake.faults.payload_short_bytes = 5000
    async with open_camera(clock, packet_size=1500, height_px=64) as camera:
        with pytest.raises(Unreachable):
            await camera.grab()
        counted = camera.counters()
        assert counted.get("incomplete_size_mismatch", 0) + counted.get("wrong_size", 0) > 0, counted
        fake.faults.payload_short_bytes = 0
        await camera.close()
    async with open_camera(clock, packet_size=1500, height_px=32) as camera:
        frame = await camera.grab()
        assert (frame.image == noise(frame.time_ns, frame.exposure_s, 0.0)[:32]).all()


@pytest.mark.parametrize(("fault", "value"), [("acks_twice", True), ("pending", 1)])
async def test_answers_that_come_twice_or_are_announced_as_late_are_taken_once(
    wired: tuple[VirtualClock, FakeCamera], fault: str, value: int
):
    clock, fake = wired
    async with open_camera(clock, heartbeat_s=3.0) as camera:
        await grabbed(camera, clock, 1)
        setattr(fake.faults, fault, value)
        (frame,) = await grabbed(camera, clock, 1)
        assert is_right(frame)
        assert frame.dropped == 0
        assert (fake.faults.pending, fake.counts.blocks) == (0, 2)  # the trigger was not executed again
        (reading,) = await camera.read()
        assert reading.value == pytest.approx(41.5)
        assert camera.counters().get("lost", 0) == 0


@pytest.mark.parametrize("stamp", ["zero", "backwards"])
async def test_a_time_stamp_that_cannot_be_is_counted_and_the_frame_has_the_triggers_instant(
    wired: tuple[VirtualClock, FakeCamera], stamp: str, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(camera_connection, "VIRTUAL_TIMEOUT_S", 1.0)  # after a jump back one frame seems stale
    clock, fake = wired
    async with open_camera(clock) as camera:
        await grabbed(camera, clock, 2)
        await clock.sleep_until(clock.now_ns() + 60 * NS_PER_S)
        fake.faults.stamp = stamp  # pyright: ignore[reportAttributeAccessIssue] - one of the two
        assert all(map(is_right, await grabbed(camera, clock, 3)))
        assert camera.counters()["bad_time_stamps"] == 3
        fake.faults.stamp = None
        assert all(map(is_right, await grabbed(camera, clock, 2)))
        assert camera.counters()["bad_time_stamps"] == 3
        assert camera.counters().get("lost", 0) == 0


async def test_a_camera_whose_clock_does_not_tick_is_used_by_the_stands_clock(
    wired: tuple[VirtualClock, FakeCamera],
):
    clock, fake = wired
    fake.faults.no_ticks = True
    async with open_camera(clock) as camera:
        assert all(map(is_right, await grabbed(camera, clock, 2)))
        assert camera.restarted == ""


async def test_an_unpaced_burst_at_the_kernels_usual_buffer_comes_whole(wired: tuple[VirtualClock, FakeCamera]):
    clock, fake = wired
    fake.faults.unpaced = True
    async with open_camera(clock, packet_size=1500) as camera:
        assert all(map(is_right, await grabbed(camera, clock)))
        assert camera.effective.receive_buffer_bytes > 0
