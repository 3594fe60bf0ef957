"""A recording on the host's clock, on a disk that stands still for seconds: nothing waits for it but the recording."""

import asyncio
import re
from contextlib import suppress

import numpy as np
import pytest

from tests.recording.device_declarations import declare_devices
from tests.recording.disks import ext4, run
from thermostand.foundation.clock import NS_PER_S, WallClock
from thermostand.foundation.hub import Hub
from thermostand.foundation.items import Batch, Event
from thermostand.foundation.readings import Frame, Reading
from thermostand.recording.reading.session import Session
from thermostand.recording.writing.recorder import Recorder, RecordingSettings, SessionInfo

INFO = SessionInfo("cycle-1", "warm_up", "DA1234567", "", "0.1.0", "wall")
SETTINGS = RecordingSettings(
    "raw", telemetry_commit_s=0.2, queue_frames=5, stop_frames_below_bytes=0, alert_below_fraction=0.0
)
PERIOD_NS = NS_PER_S // 100
FROZEN_TICKS = 200
IMAGE = np.random.default_rng(1).integers(0, 255, (200, 300), np.uint8)


@pytest.fixture
def disk(tmp_path):
    with ext4(tmp_path / "disk", 64 << 20) as folder:
        yield folder


async def publish(hub, clock, begin, count):
    """Each 10 ms a batch, each 50 ms a frame, as acquisition and guard would; returns how late each tick was, s."""
    late_s = []
    due_ns = clock.now_ns()
    for tick in range(begin, begin + count):
        due_ns += PERIOD_NS
        await clock.sleep_until(due_ns)
        now_ns = clock.now_ns()
        late_s.append((now_ns - due_ns) / NS_PER_S)
        hub.publish(Batch("camera", now_ns, (Reading("camera.temperature", float(tick), "degC", now_ns),)))
        if tick % 5 == 0:
            hub.publish(Frame("camera.image", IMAGE, now_ns, 0.1, 0.0, 40.0, tick // 5, now_ns, step_id="soak-1"))
    return late_s


async def test_a_frozen_disk_costs_counted_frames_and_neither_telemetry_nor_time(disk):
    clock, hub, events = WallClock(), Hub(), []
    hub.subscribe(lambda item: events.append(item) if isinstance(item, Event) else None)
    recorder = Recorder(disk / "s", INFO, {}, declare_devices({"camera": "camera"}), hub, clock, settings=SETTINGS)
    recorder.start()
    recording = asyncio.create_task(recorder.run())
    await publish(hub, clock, 0, 50)
    await recorder.flush()
    run("fsfreeze", "-f", disk)
    try:
        late_s = await publish(hub, clock, 50, FROZEN_TICKS)
        reported_meanwhile = [event.text for event in events]
        saved_meanwhile = recorder.saved
    finally:
        run("fsfreeze", "-u", disk)
    await publish(hub, clock, 50 + FROZEN_TICKS, 50)
    await recorder.flush()
    saved = recorder.saved
    recording.cancel()
    with suppress(asyncio.CancelledError):
        await recording
    await recorder.finish()

    assert np.median(late_s) < 0.05  # a busy machine; what waits for the disk is late by 1 s in the median
    assert max(late_s) < 1.0
    assert any("did not take them" in text for text in reported_meanwhile)
    published = (50 + FROZEN_TICKS + 50) // 5
    assert saved_meanwhile.frames == 10
    assert saved.frames + saved.frames_lost == published
    session = Session.open(disk / "s")
    assert session.readings("camera.temperature")[1].tolist() == [float(tick) for tick in range(300)]
    blocks = [frame.block_id for frame in session.frames()]
    assert len(blocks) == saved.frames == published - recorder.frames_lost
    assert recorder.frames_lost >= FROZEN_TICKS // 5 - SETTINGS.queue_frames - 1
    lost = [block for event in events for block in blocks_of(event)]
    assert sorted(blocks + lost) == list(range(published))


def blocks_of(event):
    """The block ids an event names as lost."""
    named = re.match(r"frames lost: \d+ \(blocks? ([\d, to]+) of step soak-1\)", event.text)
    for first, last in re.findall(r"(\d+)(?: to (\d+))?", named[1] if named else ""):
        yield from range(int(first), int(last or first) + 1)
