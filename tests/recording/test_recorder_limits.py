"""A recorder whose disk, queue or encoder fails it."""

import asyncio
import random
from dataclasses import replace

import pytest

from tests.recording.disks import limit_files
from tests.recording.recordings import (
    SETTINGS,
    START_NS,
    committed_event_texts,
    frame,
    record,
    start,
    stop,
)
from thermostand.foundation.clock import NS_PER_S
from thermostand.foundation.errors import SessionError
from thermostand.foundation.items import Event
from thermostand.recording.reading.session import Session
from thermostand.recording.writing.notices import FrameLosses, format_ranges
from thermostand.recording.writing.recorder import Saved


@pytest.fixture
def files_limited():
    """`files_limited(size_bytes, seconds)` gives a `between` for `record`: the limit holds in these seconds."""
    yield lambda size_bytes, seconds: lambda index: limit_files(size_bytes if index in seconds else None)
    limit_files()


async def test_frames_beyond_the_queue_are_dropped_counted_and_reported(tmp_path):
    def burst(time_ns, index):
        for block_id in range(30 if index == 0 else 0):
            yield frame(time_ns + block_id, block_id)

    await record(tmp_path / "s", 2, items=burst)
    session = Session.open(tmp_path / "s")
    assert session.frame_count == 20
    (event,) = session.events()
    assert (event.level, event.kind) == ("error", "frames_dropped")
    assert event.data["blocks"] == [[20, 29]]
    assert (event.data["steps"], event.data["total"]) == (["capture-1"], 10)


def notes(time_ns, index):
    yield Event(time_ns, "info", "note", f"second {index} {random.Random(index).randbytes(100).hex()}")


async def test_after_a_disk_error_the_next_segment_goes_on_and_nothing_is_missing(tmp_path, files_limited):
    events = await record(tmp_path / "s", 32, items=notes, between=files_limited(9_000, range(1, 30)))
    assert {event.kind for event in events} == {"note", "segment_given_up"}
    session = Session.open(tmp_path / "s")
    assert [path.name for path in session.incomplete] == ["0000.mcap.part"]
    texts = list(committed_event_texts(tmp_path / "s"))
    assert [text.split()[1] for text in texts if text.startswith("second")] == [str(k) for k in range(32)]


async def test_telemetry_waits_in_memory_while_the_disk_takes_nothing(tmp_path, files_limited):
    events = await record(tmp_path / "s", 10, items=notes, between=files_limited(100, range(2, 6)))
    kinds = [event.kind for event in events if event.kind != "note"]
    assert kinds.count("telemetry_not_saved") == kinds.count("telemetry_saved_again") == 1
    texts = list(committed_event_texts(tmp_path / "s"))
    assert sorted(int(text.split()[1]) for text in texts if text.startswith("second")) == list(range(10))
    assert sorted(path.name for path in (tmp_path / "s" / "telemetry").iterdir()) == ["0000.mcap.part", "0001.mcap"]


async def test_a_frame_the_disk_refuses_is_reported_and_telemetry_goes_on(tmp_path, files_limited):
    def items(time_ns, index):
        yield frame(time_ns, index, (200, 200) if index == 1 else (8, 8))
        yield from notes(time_ns, index)

    events = await record(tmp_path / "s", 4, items=items, between=files_limited(30_000, range(4)))
    (reported,) = [event.text for event in events if event.kind == "frames_dropped"]
    assert reported.startswith("frames lost: 1 (block 1 of step capture-1), 1 in all; [Errno 27]")
    session = Session.open(tmp_path / "s")
    assert len([event for event in session.events() if event.kind == "note"]) == 4
    assert [got.block_id for got in session.frames()] == [2, 3]  # block 0 waits in the part that was given up
    assert [path.name for path in session.incomplete] == ["0000.mcap.part"]


async def test_a_telemetry_segment_that_cannot_be_finished_is_not_passed_over(tmp_path, files_limited):
    with pytest.raises(SessionError, match="telemetry stays unfinished"):
        await record(tmp_path / "s", 4, items=notes, between=files_limited(9_000, range(4)))
    texts = list(committed_event_texts(tmp_path / "s"))
    assert [text.split()[1] for text in texts] == ["0", "1", "2", "3"]


async def test_flushed_waits_for_telemetry_the_disk_refuses(tmp_path, files_limited):
    at = files_limited(100, {1})
    recorder, clock, hub, tasks = await start(tmp_path / "s", SETTINGS)
    at(1)
    hub.publish(Event(START_NS, "info", "note", "kept in memory"))
    waiting = asyncio.create_task(recorder.flush())
    await clock.sleep_until(START_NS + 3 * NS_PER_S)
    assert not waiting.done()
    at(2)
    await waiting
    assert next(committed_event_texts(tmp_path / "s")) == "kept in memory"
    await stop(tasks)
    await recorder.finish()


async def test_frames_that_did_not_fit_the_queue_are_lost(tmp_path):
    recorder, _, hub, tasks = await start(tmp_path / "s", replace(SETTINGS, queue_frames=3))
    for index in range(10):
        hub.publish(frame(START_NS + index, index))
    await recorder.flush()
    assert recorder.saved == Saved(3, 0, 7)
    await stop(tasks)
    await recorder.finish()


async def test_a_frame_that_cannot_be_encoded_is_lost_and_the_next_one_is_not(tmp_path):
    def prepare(got):
        if got.block_id == 1:
            raise ValueError("no marker in sight")
        return got

    recorder, _, hub, tasks = await start(tmp_path / "s", SETTINGS, prepare)
    for index in range(3):
        hub.publish(frame(START_NS + index, index))
    await recorder.flush()
    assert recorder.saved == Saved(2, 0, 1)
    await stop(tasks)
    await recorder.finish()
    session = Session.open(tmp_path / "s")
    assert [got.block_id for got in session.frames()] == [0, 2]
    (event,) = session.events()
    assert event.data["blocks"] == [[1, 1]]
    assert event.data["reason"].startswith("ValueError: ")


async def test_on_a_nearly_full_disk_not_even_the_first_frame_is_taken(tmp_path):
    """The disk is looked at before a segment is begun, not only on ticks."""
    nearly_full = replace(SETTINGS, telemetry_commit_s=60.0, stop_frames_below_bytes=10**18)
    recorder, clock, hub, tasks = await start(tmp_path / "s", nearly_full)
    hub.publish(frame(START_NS, 0))
    await clock.sleep_until(START_NS + NS_PER_S)
    assert recorder.saved == Saved(0, 0, 1)
    await stop(tasks)
    await recorder.finish()
    stopped, dropped = Session.open(tmp_path / "s").events()
    assert (stopped.level, stopped.kind) == ("error", "frames_stopped")
    assert (dropped.level, dropped.kind, dropped.data["blocks"]) == ("error", "frames_dropped", [[0, 0]])
    assert all(f"{10**9}.0 GB free" in event.text for event in (stopped, dropped))


@pytest.mark.parametrize(
    ("blocks", "text"),
    [
        ([3], "block 3"),
        ([12, 13, 14, 17], "blocks 12 to 14, 17"),
        ([1, 2, 5, 7, 8], "blocks 1 to 2, 5, 7 to 8"),
        ([5, 4], "blocks 5, 4"),
    ],
)
def test_every_lost_block_is_named(blocks, text):
    assert format_ranges(blocks) == text


def test_losses_are_reported_by_reason_and_step():
    losses = FrameLosses()
    for block_id, step_id, reason in [(1, "a", "slow"), (2, "a", "slow"), (4, "b", "slow"), (5, "", "full")]:
        losses.count(replace(frame(START_NS, block_id), step_id=step_id), reason)
    assert losses.total == 4
    slow, full = losses.take()
    assert "(blocks 1 to 2 of step a" in slow.text
    assert "block 4 of step b)" in slow.text
    assert slow.data == {"blocks": [[1, 2], [4, 4]], "steps": ["a", "b"], "total": 4, "reason": "slow"}
    assert full.text == "frames lost: 1 (block 5), 4 in all; full"
    assert losses.take() == []
    assert losses.total == 4
