import asyncio
from dataclasses import replace

import numpy as np
import pytest

from tests.recording.disks import tmpfs
from tests.recording.full_session import (
    ATTACHMENTS,
    DEVICES,
    MS,
    START_NS,
    frame_key,
    images,
    item_key,
    make_half_second,
    record,
    telemetry,
)
from thermostand.foundation.clock import NS_PER_S, VirtualClock
from thermostand.foundation.errors import SessionError
from thermostand.foundation.hub import Hub
from thermostand.foundation.items import Batch
from thermostand.foundation.readings import Frame
from thermostand.recording.exporting.replay import ReplayClock, replay, replay_and_record
from thermostand.recording.exporting.topics import list_topics
from thermostand.recording.reading.recorded_devices import recorded_devices
from thermostand.recording.reading.session import Session


async def play(session, clock, driver=None):
    """(instant of the clock, item) of everything published."""
    hub, got = Hub(), []
    hub.subscribe(lambda item: got.append((clock.now_ns(), item)))
    running = [] if driver is None else [asyncio.create_task(driver.run())]
    await replay(session, hub, clock)
    for task in running:
        task.cancel()
    return got


async def test_subscribers_see_the_items_as_they_were_published(tmp_path):
    published = await record(tmp_path / "s")
    clock = VirtualClock(START_NS)
    got = await play(Session.open(tmp_path / "s"), clock, clock)
    assert [item_key(item) for _, item in got] == [item_key(item) for item in published]
    assert len(got) == 12 * 8
    for now_ns, item in got:
        assert now_ns - item.time_ns == (50 * MS if isinstance(item, Frame) else 0)


def deep(time_ns, index):
    yield from make_half_second(time_ns, index, np.uint16)


@pytest.mark.parametrize(("items", "encoding"), [(make_half_second, "zstd"), (make_half_second, "raw"), (deep, "zstd")])
async def test_a_recorded_replay_is_the_same_session(tmp_path, items, encoding):
    await record(tmp_path / "s", items=items, encoding=encoding)
    original = Session.open(tmp_path / "s")
    assert len(original.segments) >= 6
    assert await replay_and_record(original, tmp_path / "copies" / "r", None) == tmp_path / "copies" / "r"
    copy = Session.open(tmp_path / "copies" / "r")
    assert telemetry(copy) == telemetry(original)
    assert images(copy) == images(original)
    assert list(map(frame_key, copy.frames())) == list(map(frame_key, original.frames()))
    assert copy.metadata == original.metadata
    assert dict(copy.attachments) == ATTACHMENTS
    assert copy.channels() == original.channels()
    assert list_topics(copy) == list_topics(original)
    assert [path.name for path in (tmp_path / "copies").iterdir()] == ["r"]


async def test_frames_of_which_only_windows_are_real_stay_so(tmp_path):
    def items(time_ns, index):
        for item in make_half_second(time_ns, index):
            if isinstance(item, Frame) and index % 2:
                windows = np.array([[3, 4, 10, 11]], np.int32)
                image = np.full_like(item.image, 90)
                image[4:15, 3:13] = item.image[4:15, 3:13]
                fields = {name: getattr(item, name) for name in Frame.__dataclass_fields__}
                yield Frame(**{**fields, "image": image, "windows": windows})
            else:
                yield item

    await record(tmp_path / "s", items=items)
    await replay_and_record(Session.open(tmp_path / "s"), tmp_path / "r", None)
    copy = list(Session.open(tmp_path / "r").frames())
    assert list(map(frame_key, copy)) == list(map(frame_key, Session.open(tmp_path / "s").frames()))
    assert [frame.windows is None for frame in copy] == [True, False] * 6


async def test_a_paced_replay_keeps_the_times(tmp_path):
    await record(tmp_path / "s")
    wall = VirtualClock(7 * NS_PER_S)
    clock = ReplayClock(START_NS, 2.0, wall)
    hub, got = Hub(), []
    hub.subscribe(lambda item: got.append((wall.now_ns() - 7 * NS_PER_S, item)))
    running = asyncio.create_task(wall.run())
    await replay(Session.open(tmp_path / "s"), hub, clock)
    running.cancel()
    for at_ns, item in got:
        if isinstance(item, Batch):
            assert at_ns == (item.time_ns - START_NS) // 2
    assert wall.now_ns() == 7 * NS_PER_S + 11 * NS_PER_S // 4


async def test_on_the_hosts_clock_twice_as_fast_is_half_the_time(tmp_path):
    await record(tmp_path / "s", 4, period_ns=100 * MS)
    session, begun = Session.open(tmp_path / "s"), asyncio.get_running_loop().time()
    clock = ReplayClock(START_NS, 2.0)
    got = await play(session, clock)
    took_s = asyncio.get_running_loop().time() - begun
    assert 0.15 <= took_s < 10.0
    assert all(0 <= now_ns - item.time_ns < 10 * NS_PER_S for now_ns, item in got if isinstance(item, Batch))


async def test_a_paced_replay_is_recorded_whole(tmp_path):
    published = await record(tmp_path / "s", 4, period_ns=100 * MS)
    seen = []
    await replay_and_record(
        Session.open(tmp_path / "s"), tmp_path / "r", 2.0, watch=lambda hub: hub.subscribe(seen.append)
    )
    assert telemetry(Session.open(tmp_path / "r")) == telemetry(Session.open(tmp_path / "s"))
    assert images(Session.open(tmp_path / "r")) == images(Session.open(tmp_path / "s"))
    assert [item_key(item) for item in seen] == [item_key(item) for item in published]


def test_a_clock_of_another_speed_reads_and_waits_in_session_time():
    wall = VirtualClock(0)
    clock, slow = ReplayClock(START_NS, 3.0, wall), ReplayClock(START_NS, 0.25, wall)

    async def wait():
        running = asyncio.create_task(wall.run())
        await clock.sleep_until(START_NS + NS_PER_S)
        running.cancel()

    asyncio.run(wait())
    assert wall.now_ns() == 333_333_334
    assert clock.now_ns() == START_NS + NS_PER_S + 2, "not before the instant that was waited for"
    assert slow.now_ns() == START_NS + round(wall.now_ns() / 4)


@pytest.mark.parametrize("speed", [0.0, -1.0, float("nan"), float("inf")])
def test_a_speed_that_is_none_is_a_programming_mistake(speed):
    with pytest.raises(ValueError, match="a positive number"):
        ReplayClock(START_NS, speed)


async def test_a_session_that_breaks_off_leaves_no_copy(tmp_path):
    await record(tmp_path / "s")
    session = Session.open(tmp_path / "s")
    damaged = session.segments[-1]
    content = bytearray(damaged.read_bytes())
    content[len(content) // 2] ^= 1
    damaged.write_bytes(content)
    with pytest.raises(SessionError, match="damaged"):
        await replay_and_record(session, tmp_path / "r", None)
    assert [path.name for path in tmp_path.iterdir()] == ["s"]


async def test_nothing_is_overwritten_by_a_replay(tmp_path):
    await record(tmp_path / "s", 2)
    session = Session.open(tmp_path / "s")
    with pytest.raises(SessionError, match="exists already"):
        await replay_and_record(session, tmp_path / "s", None)


async def test_a_session_tells_which_devices_it_recorded(tmp_path):
    await record(tmp_path / "s", 1)
    devices = recorded_devices(Session.open(tmp_path / "s").telemetry_segments)
    assert devices == DEVICES
    assert [name for name, device in devices.items() if device.kind == "axis"] == ["rotary", "linear"]


async def test_a_session_without_items_cannot_be_replayed(tmp_path):
    await record(tmp_path / "s", 0)
    with pytest.raises(SessionError, match="could be replayed"):
        await replay_and_record(Session.open(tmp_path / "s"), tmp_path / "r", None)


async def test_a_copy_on_a_disk_that_is_nearly_full_is_the_same_session(tmp_path):
    await record(tmp_path / "s")
    session = Session.open(tmp_path / "s")
    with tmpfs(tmp_path / "disk", "24m") as disk:
        (disk / "ballast").write_bytes(bytes(22_000_000))
        copy = Session.open(await replay_and_record(session, disk / "r", None))
        assert telemetry(copy) == telemetry(session)
        assert images(copy) == images(session)


async def test_a_copy_that_would_lack_frames_does_not_appear(tmp_path):
    def items(time_ns, index):
        for item in make_half_second(time_ns, index):
            noise = np.random.default_rng(index).integers(0, 255, (400, 500), np.uint8)
            yield replace(item, image=noise) if isinstance(item, Frame) else item

    await record(tmp_path / "s", items=items, encoding="raw")
    with tmpfs(tmp_path / "disk", "24m") as disk:
        (disk / "ballast").write_bytes(bytes(24 * 2**20 - 1_600_000))
        with pytest.raises(SessionError, match=r"r: \d frames could not"):
            await replay_and_record(Session.open(tmp_path / "s"), disk / "r", None)
        assert [path.name for path in disk.iterdir()] == ["ballast"]
