"""How long what was published has waited for the disk, and what is done when the session's folder is lost."""

import asyncio
import resource
import shutil
from contextlib import asynccontextmanager, contextmanager
from dataclasses import replace

import numpy as np
import pytest
from mcap.reader import make_reader

from tests.recording.device_declarations import declare_devices
from tests.recording.disks import ext4, limit_files, run, tmpfs
from thermostand.foundation.clock import NS_PER_S, VirtualClock, WallClock
from thermostand.foundation.errors import SessionError
from thermostand.foundation.hub import Hub
from thermostand.foundation.items import Batch, Event
from thermostand.foundation.readings import Frame, Reading
from thermostand.recording.reading.session import Session
from thermostand.recording.writing.recorder import Recorder, RecordingSettings, SessionInfo

START_NS = 1_767_290_400 * NS_PER_S
INFO = SessionInfo("cycle-1", "warm_up", "DA1234567", "", "0.1.0", "virtual")
ATTACHMENTS = {"config.yaml": "camera:\n  gain_dB: 0.0\n"}
SETTINGS = RecordingSettings("raw", segment_s=2.0, stop_frames_below_bytes=0, alert_below_fraction=0.0)
DEVICES = declare_devices({"thermometers": "thermometers"})


class Stand:
    """What publishes: a batch and an event each second, a frame where wanted; tells how old what waits is."""

    def __init__(self, directory, settings, clock):
        self.clock, self.hub, self.events, self.second = clock, Hub(), [], 0
        self.recorder = Recorder(directory, INFO, ATTACHMENTS, DEVICES, self.hub, clock, settings=settings)
        self.hub.subscribe(lambda item: self.events.append(item) if isinstance(item, Event) else None)

    async def seconds(self, count, frames=False):
        """Live on; returns the age of what waits (s), 0 for nothing, at the end of each second."""
        ages_s = []
        for _ in range(count):
            await self.clock.sleep_until(START_NS + self.second * NS_PER_S + NS_PER_S // 4)
            self.publish(self.clock.now_ns(), frames)
            self.second += 1
            await self.clock.sleep_until(START_NS + self.second * NS_PER_S + 1)  # behind the tick
            ages_s.append(self.age_s())
        return ages_s

    def publish(self, time_ns, frames):
        self.hub.publish(Batch("thermometers", time_ns, (Reading("thermometers.air", 20.0, "degC", time_ns),)))
        self.hub.publish(Event(time_ns, "info", "note", f"second {self.second}"))
        if frames:
            image = np.full((100, 100), self.second % 256, np.uint8)
            self.hub.publish(
                Frame("camera.image", image, time_ns, 0.1, 0.0, 40.0, self.second, self.second, step_id="a1")
            )

    def age_s(self):
        since_ns = self.recorder.waiting_since_ns
        return 0.0 if since_ns is None else (self.clock.now_ns() - since_ns) / NS_PER_S

    def reported(self, kind):
        return [event for event in self.events if event.kind == kind]


@asynccontextmanager
async def recording(directory, settings=SETTINGS):
    """A Stand that is recorded in virtual time."""
    stand = Stand(directory, settings, VirtualClock(START_NS))
    stand.recorder.start()
    tasks = [asyncio.create_task(stand.recorder.run()), asyncio.create_task(stand.clock.run())]
    try:
        yield stand
        tasks[0].cancel()
        await asyncio.wait(tasks[:1])
        await stand.recorder.finish()
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)


@contextmanager
def read_only(disk):
    run("mount", "-o", "remount,ro", disk)
    try:
        yield
    finally:
        run("mount", "-o", "remount,rw", disk)


@contextmanager
def files_limited(disk):
    limit_files(100)
    try:
        yield
    finally:
        limit_files()


@contextmanager
def no_descriptors(disk):
    """None of this process's is free. The segments that are open are written on, so they have to be at their end."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (3, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


async def test_nothing_waits_after_a_commit_and_what_waits_is_as_old_as_its_oldest(tmp_path):
    async with recording(tmp_path / "s", replace(SETTINGS, telemetry_commit_s=20.0)) as stand:
        assert stand.recorder.waiting_since_ns is None
        ages_s = await stand.seconds(60, frames=True)
        assert max(ages_s) == pytest.approx(18.75, abs=0.01)  # published at 0.25 s, looked at at 19 s
        assert ages_s[19] == ages_s[39] == ages_s[59] == 0.0
        stand.publish(stand.clock.now_ns(), True)
        await stand.recorder.flush()
        assert stand.recorder.waiting_since_ns is None
        assert stand.recorder.disk_free_bytes > 0


@pytest.mark.parametrize("frames", [False, True], ids=["telemetry only", "with frames"])
@pytest.mark.parametrize("refuses", [read_only, files_limited, no_descriptors])
async def test_what_a_disk_refuses_grows_old_and_recording_goes_on_by_itself(tmp_path, refuses, frames):
    """Free space is shown all the time."""
    with ext4(tmp_path / "disk", 64 << 20) as disk:
        async with recording(disk / "s") as stand:
            await stand.seconds(4, frames)
            stand.recorder._frames.series.finish()  # nothing open that could be written on
            stand.recorder._telemetry.series.finish()
            with refuses(disk):
                ages_s = await stand.seconds(10, frames)
            assert stand.recorder.disk_free_bytes > 10_000_000
            assert ages_s[-1] == pytest.approx(9.75, abs=0.01)
            assert sorted(ages_s) == ages_s
            assert max(await stand.seconds(2)) < 0.01  # the event that it is saved again
            assert stand.recorder.folder_lost == ""
        session = Session.open(disk / "s")
        notes = [event.text for event in session.events() if event.kind == "note"]
        assert notes == [f"second {second}" for second in range(16)]
        assert [event.kind for event in session.events() if event.kind.startswith("telemetry")] == [
            "telemetry_not_saved",
            "telemetry_saved_again",
        ]


async def test_frames_alone_that_are_refused_wait_until_one_could_be_written(tmp_path):
    """A held run takes no frames: whether they could be written is tried."""
    settings = replace(SETTINGS, segment_s=600.0)
    async with recording(tmp_path / "s", settings) as stand:
        await stand.seconds(2)
        limit_files(9_000)  # enough for telemetry, not for 10 kB of image
        try:
            await stand.seconds(1, frames=True)
            assert (await stand.seconds(5))[-1] == pytest.approx(5.75, abs=0.01)
        finally:
            limit_files()
        assert await stand.seconds(1) == [0.0]
        assert stand.recorder.saved.frames_lost == 1
        await stand.seconds(1, frames=True)
        assert stand.recorder.saved.frames == 1
    assert not list((tmp_path / "s").rglob("*.tmp"))


@pytest.mark.parametrize("which", ["", "telemetry", "frames"])
async def test_a_folder_that_was_removed_is_a_loss_at_once_and_none_is_made_again_unasked(tmp_path, which):
    directory = tmp_path / "s"
    async with recording(directory, SETTINGS) as stand:
        await stand.seconds(5, frames=True)
        before = stand.recorder.saved
        shutil.rmtree(directory / which)
        await stand.seconds(3, frames=True)
        assert "was removed while" in stand.recorder.folder_lost
        assert not (directory / which).exists()
        assert stand.age_s() > 2
        (reported,) = stand.reported("folder_lost")
        assert reported.level == "error"
        stand.recorder.recover_folder()
        assert stand.recorder.folder_lost == ""
        await stand.seconds(3, frames=True)
        assert stand.age_s() == 0
        assert stand.recorder.folder_lost == ""
        assert stand.recorder.saved.frames == 11
    (loss,) = stand.reported("recording_lost")
    what = [which] if which else ["telemetry", "frames"]
    assert loss.level == "error"
    assert loss.data["what"] == what
    assert loss.data["from_ns"] == START_NS
    counts = {"telemetry": before.telemetry, "frames": before.frames}
    assert loss.data["counts"] == {name: counts[name] for name in what}
    assert START_NS + 4 * NS_PER_S <= loss.data["to_ns"] <= START_NS + 5 * NS_PER_S
    numbers = {name: [int(path.name[:4]) for path in sorted((directory / name).iterdir())] for name in what}
    assert all(min(found) >= 1 for found in numbers.values())  # never 0000 again
    for path in (directory / what[0]).iterdir():
        with path.open("rb") as file:
            reader = make_reader(file, validate_crcs=True)
            attached = {record.name: record.data for record in reader.iter_attachments() if record.name != "frames"}
            assert {name: data.decode() for name, data in attached.items()} == ATTACHMENTS
    session = Session.open(directory)
    notes = [event.text for event in session.events() if event.kind == "note"]
    first = 0 if which == "frames" else 5
    assert notes == [f"second {second}" for second in range(first, 11)]
    assert session.frame_count == (11 if which == "telemetry" else 6)
    assert "recording_lost" in [event.kind for event in session.events()]


async def test_a_folder_that_was_renamed_is_continued_when_it_is_back(tmp_path):
    directory, other = tmp_path / "s", tmp_path / "other"
    async with recording(directory) as stand:
        await stand.seconds(3, frames=True)
        directory.rename(other)
        await stand.seconds(3, frames=True)
        assert f"it is {other}" in stand.recorder.folder_lost
        assert not directory.exists()
        other.rename(directory)
        stand.recorder.recover_folder()
        await stand.seconds(2, frames=True)
        assert (stand.age_s(), stand.recorder.folder_lost) == (0, "")
        assert stand.recorder.saved.frames == 8
    assert [event.kind for event in stand.events if event.kind.startswith(("folder", "recording"))] == [
        "folder_lost",
        "folder_back",
    ]
    session = Session.open(directory)
    assert session.frame_count == 8
    assert [event.text for event in session.events() if event.kind == "note"] == [f"second {k}" for k in range(8)]


async def test_a_renamed_folder_that_stays_away_keeps_what_it_has_and_another_one_goes_on(tmp_path):
    directory, other = tmp_path / "s", tmp_path / "other"
    async with recording(directory) as stand:
        await stand.seconds(3, frames=True)
        directory.rename(other)
        await stand.seconds(3, frames=True)
        stand.recorder.recover_folder()
        await stand.seconds(2, frames=True)
        assert (stand.age_s(), stand.recorder.folder_lost) == (0, "")
    (loss,) = stand.reported("recording_lost")
    assert str(other) in loss.text
    assert [got.block_id for got in Session.open(directory).frames()] == [3, 4, 5, 6, 7]
    names = [path.name for path in (directory / "frames").iterdir()] + [
        path.name for path in (other / "frames").iterdir()
    ]
    assert len({name[:4] for name in names}) == len(names)


async def test_a_folder_that_cannot_be_made_again_stays_a_loss(tmp_path):
    directory = tmp_path / "s"
    found = []

    async def lose():
        async with recording(directory) as stand:
            await stand.seconds(2)
            shutil.rmtree(directory)
            directory.write_text("in the way")
            await stand.seconds(2)
            stand.recorder.recover_folder()
            await stand.seconds(1)
            found.extend([stand.recorder.folder_lost, *stand.reported("folder_not_made")])

    with pytest.raises(SessionError, match="messages were not saved"):
        await lose()
    lost, reported = found
    assert "was removed" in lost
    assert "no folder can" in reported.text


async def test_readings_are_dropped_first_when_too_much_waits_and_that_is_reported(tmp_path):
    with tmpfs(tmp_path / "disk", "4m") as disk:
        async with recording(disk / "s", replace(SETTINGS, waiting_messages=30, segment_s=600.0)) as stand:
            await stand.seconds(2)
            (disk / "s").rename(disk / "t")
            await stand.seconds(30)
            (reported,) = stand.reported("readings_dropped")
            assert reported.level == "error"
            (disk / "t").rename(disk / "s")
            await stand.seconds(3)
        (lost,) = stand.reported("readings_lost")
        session = Session.open(disk / "s")
        assert [event.text for event in session.events() if event.kind == "note"] == [f"second {k}" for k in range(35)]
        assert len(session.readings("thermometers.air")[0]) == 35 - lost.data["readings"]
        assert lost.data["readings"] >= 15
        assert lost.data["from_ns"] < lost.data["to_ns"]


async def test_a_disk_that_hangs_does_not_keep_the_recorder_from_its_end(tmp_path):
    with ext4(tmp_path / "disk", 64 << 20) as disk:
        stand = Stand(disk / "s", replace(SETTINGS, telemetry_commit_s=0.05), clock := WallClock())
        stand.recorder.start()
        recording = asyncio.create_task(stand.recorder.run())
        stand.publish(clock.now_ns(), True)
        await stand.recorder.flush()
        run("fsfreeze", "-f", disk)
        try:
            stand.publish(clock.now_ns(), True)
            while stand.age_s() < 0.3:
                await asyncio.sleep(0.02)
            recording.cancel()
            begin_ns = clock.now_ns()
            await asyncio.wait([recording])
            with pytest.raises(SessionError, match="the session is unfinished"):
                await stand.recorder.finish(0.2)
            assert clock.now_ns() - begin_ns < 5 * NS_PER_S
        finally:
            run("fsfreeze", "-u", disk)
