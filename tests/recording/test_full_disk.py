"""A recording on a disk of 64 MB: what was acknowledged is readable, what was not is reported, telemetry continues."""

import asyncio
from contextlib import suppress

import numpy as np
import pytest
from mcap.records import Message
from mcap.stream_reader import StreamReader

from tests.recording.disks import tmpfs
from thermostand.foundation.clock import NS_PER_S, VirtualClock
from thermostand.foundation.hub import Hub
from thermostand.foundation.items import Event
from thermostand.foundation.readings import Frame
from thermostand.recording.format.images import decode_image
from thermostand.recording.reading.gaps import list_reported_blocks
from thermostand.recording.reading.session import Session
from thermostand.recording.writing.recorder import Recorder, RecordingSettings, SessionInfo

START_NS = 1_767_290_400 * NS_PER_S
INFO = SessionInfo("cycle-1", "warm_up", "DA1234567", "", "0.1.0", "virtual")
SMALL_SEGMENTS = RecordingSettings("raw", segment_bytes=8_000_000, stop_frames_below_bytes=0, alert_below_fraction=0.0)


@pytest.fixture
def disk(tmp_path):
    with tmpfs(tmp_path / "disk", "64m") as folder:
        yield folder


class RecordedRun:
    """A recorder on a virtual clock; each second one frame of 1 MB and one event are published."""

    def __init__(self, directory, settings):
        self.clock, self.hub, self.events = VirtualClock(START_NS), Hub(), []
        self.recorder = Recorder(directory, INFO, {}, {}, self.hub, self.clock, settings=settings)
        self.hub.subscribe(lambda item: self.events.append(item) if isinstance(item, Event) else None)
        self.published = 0

    async def __aenter__(self):
        self.recorder.start()
        self._tasks = [asyncio.create_task(work) for work in (self.recorder.run(), self.clock.run())]
        return self

    async def __aexit__(self, *_):
        self._tasks[0].cancel()
        with suppress(asyncio.CancelledError):
            await self._tasks[0]
        await self.recorder.finish()
        self._tasks[1].cancel()

    async def seconds(self, count):
        for _ in range(count):
            time_ns = START_NS + self.published * NS_PER_S
            await self.clock.sleep_until(time_ns)
            self.hub.publish(frame(time_ns, self.published))
            self.hub.publish(Event(time_ns, "info", "note", f"second {self.published}"))
            self.published += 1
        await self.recorder.flush()

    def reported(self, kind):
        return [event.text for event in self.events if event.kind == kind]


def frame(time_ns, block_id):
    image = np.random.default_rng(block_id).integers(0, 255, (1000, 1000), np.uint8)
    return Frame("camera.image", image, time_ns, 0.1, 0.0, 40.0, block_id, block_id, step_id="soak-1")


def readable_blocks(directory):
    """The blocks of all whole images in all frame segments, finished or not, pixels compared with what was sent."""
    for path in sorted((directory / "frames").iterdir()):
        messages = []
        with path.open("rb") as file, suppress(Exception):  # an unfinished file ends anywhere
            for record in StreamReader(file, validate_crcs=True).records:
                if isinstance(record, Message) and len(record.data) > 1000:
                    messages.append(record)
        for message in messages:
            sent = frame(message.log_time, message.sequence)
            np.testing.assert_array_equal(decode_image(message.data), sent.image)
            yield message.sequence


def lost_blocks(recorded):
    """The block ids that the events name."""
    for blocks in list_reported_blocks(recorded.events):
        yield from blocks


async def test_a_full_disk_loses_no_frame_it_has_acknowledged_and_no_telemetry(disk):
    async with RecordedRun(disk / "s", SMALL_SEGMENTS) as recorded:
        await recorded.seconds(60)
        full = recorded.recorder.saved
        assert 45 <= full.frames <= 51  # 67 MB, 16 of them the telemetry's
        assert full.frames + full.frames_lost == 60
        assert sorted(readable_blocks(disk / "s")) == list(range(full.frames))
        assert full.telemetry >= 60 * 2  # the frame's description, the event, and its log message
        await recorded.seconds(20)
        assert recorded.recorder.saved.frames == full.frames
        for path in sorted((disk / "s" / "frames").glob("*.mcap"))[:2]:
            path.unlink()
        await recorded.seconds(5)
        assert recorded.recorder.saved.frames == full.frames + 5
    session = Session.open(disk / "s")
    assert [path.name for path in session.incomplete] == [f"{full.frames // 8:04d}.mcap.part"]
    assert len(session.events()) == len(recorded.events)
    assert recorded.reported("note") == [f"second {k}" for k in range(85)]
    assert list(lost_blocks(recorded)) == list(range(full.frames, 80))
    assert all("No space left" in text for text in recorded.reported("frames_dropped"))
    assert recorded.reported("telemetry_not_saved") == []
    assert recorded.recorder.frames_lost == 80 - full.frames
    kept = [got.block_id for got in session.frames()]
    assert set(kept) | set(readable_blocks(disk / "s")) == set(range(16, full.frames)) | set(range(80, 85))


async def test_frames_leave_the_end_of_the_disk_to_the_telemetry_and_come_back(disk):
    settings = RecordingSettings(
        "raw", segment_bytes=8_000_000, stop_frames_below_bytes=30_000_000, alert_below_fraction=0.6
    )
    async with RecordedRun(disk / "s", settings) as recorded:
        await recorded.seconds(30)
        assert 18 <= recorded.recorder.saved.frames <= 22  # 67 MB, 16 the telemetry's, 30 left, looked at once a second
        assert not list((disk / "s" / "frames").glob("*.part"))  # nothing is open, and nothing reserved
        (disk / "ballast").write_bytes(bytes(9_000_000))
        await recorded.seconds(10)
        for path in [*sorted((disk / "s" / "frames").glob("*.mcap"))[:2], disk / "ballast"]:
            path.unlink()
        await recorded.seconds(5)
    assert [len(recorded.reported(kind)) for kind in ("disk_nearly_full", "frames_stopped", "frames_resumed")] == [
        1,
        1,
        1,
    ]
    lost = list(lost_blocks(recorded))
    assert len(lost) == recorded.recorder.frames_lost == 45 - recorded.recorder.saved.frames
    assert lost == list(range(lost[0], lost[-1] + 1))
    assert all("0.0 GB free" in text for text in recorded.reported("frames_dropped"))
    assert [got.block_id for got in Session.open(disk / "s").frames()][-5:] == [40, 41, 42, 43, 44]
    assert not Session.open(disk / "s").incomplete


async def test_frames_take_no_more_than_is_left_above_the_threshold(disk):
    """A segment that may have 1 GB begins on a disk of 64 MB."""
    settings = RecordingSettings("raw", stop_frames_below_bytes=20_000_000, alert_below_fraction=0.0)
    async with RecordedRun(disk / "s", settings) as recorded:
        await recorded.seconds(3)
        assert recorded.recorder.saved.frames == 3
    assert recorded.reported("frames_dropped") == []
