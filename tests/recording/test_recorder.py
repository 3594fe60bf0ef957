import asyncio
import math
import random
from contextlib import suppress
from dataclasses import replace

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.records import Message
from mcap.stream_reader import StreamReader
from mcap_protobuf.decoder import DecoderFactory

from foundation.clock import NS_PER_S, VirtualClock
from foundation.errors import SessionError
from foundation.hub import Hub
from foundation.items import Batch, Event, StepMark, StepState
from foundation.readings import Frame, Reading, bad_reading
from recording.format.images import encode_image
from recording.reading.session import Session
from recording.writing.notices import Losses, ranges
from recording.writing.recorder import Recorder, RecordingSettings, Saved, SessionInfo
from tests.recording.disks import limit_files

START_NS = 1_767_290_400 * NS_PER_S
INFO = SessionInfo("night-1", "thermal_cycle", "DA1234567", "M. Adamczyk", "0.1.0", "virtual")
ATTACHMENTS = {"config.yaml": "camera:\n  gain_dB: 0.0\n", "target.yaml": "rows: 6  # µm\n"}
SETTINGS = RecordingSettings(stop_frames_below_bytes=0, alert_below_fraction=0.0)  # whatever this disk has
DEVICES = {
    "thermometers": "thermometers",
    "regulator": "regulator",
    "relays": "relays",
    "camera": "camera",
    "linear": "axis",
    "rotary": "axis",
    "flap": "flap",
}


def batch(device, time_ns, **values):
    units = {"position": {"linear": "mm", "rotary": "deg"}.get(device, "1"), "current": "mA", "mv_heat": "%"}
    flags = ("moving", "homed", "running", "compressor")
    readings = []
    for name, value in values.items():
        unit = "1" if name in flags else units.get(name, "degC")
        channel = f"{device}.{name}"
        broken = math.isnan(value)
        readings.append(
            bad_reading(channel, unit, time_ns, "sensor break") if broken else Reading(channel, value, unit, time_ns)
        )
    return Batch(device, time_ns, tuple(readings))


def frame(time_ns, block_id, shape=(40, 60)):
    image = np.random.default_rng(block_id).integers(0, 255, shape, np.uint8)
    return Frame("camera.image", image, time_ns, 0.1, 0.0, 40.0 + block_id, block_id, 1000 * block_id, 0, "capture-1")


def one_second(time_ns, index):
    """What a stand publishes in a second."""
    yield batch("thermometers", time_ns, air=20 + index / 10, artifact=math.nan if index == 3 else 21.0)
    yield batch("regulator", time_ns, pv=20.0, sp=25.0, mv_heat=12.5, running=1.0)
    yield batch("linear", time_ns, position=100.0 + index, moving=0.0, homed=1.0)
    yield batch("rotary", time_ns, position=30.0, moving=0.0, homed=1.0)
    yield batch("flap", time_ns, position=1.0, current=35.0)
    yield StepMark(time_ns, f"step-{index}", index, "Capture", StepState.STARTED, {"frames": 1, "interval_s": 0.5})
    yield frame(time_ns, index)
    yield Event(time_ns, "info", "note", f"second {index}")


async def record(directory, seconds=5, items=one_second, settings=SETTINGS, info=INFO, between=None):
    """Publish `items(time_ns, index)` each virtual second; `between(index)` may do something to the disk. Returns all
    events published, the recorder's own among them."""
    clock, hub, events = VirtualClock(START_NS), Hub(), []
    hub.subscribe(lambda item: events.append(item) if isinstance(item, Event) else None)
    recorder = Recorder(directory, info, ATTACHMENTS, DEVICES, hub, clock, settings)
    recorder.start()
    tasks = [asyncio.create_task(recorder.run()), asyncio.create_task(clock.run())]
    try:
        for index in range(seconds):
            await clock.sleep_until(START_NS + index * NS_PER_S + NS_PER_S // 2)
            if between is not None:
                between(index)
            for item in items(clock.now_ns(), index):
                hub.publish(item)
        await clock.sleep_until(START_NS + seconds * NS_PER_S + 1)
        tasks[0].cancel()
        with suppress(asyncio.CancelledError):
            await tasks[0]
        await recorder.finish()
    finally:
        limit_files()  # before pytest writes its own output, which may be a longer file
    tasks[1].cancel()
    return events


def contents(directory):
    return {str(path.relative_to(directory)): path.read_bytes() for path in directory.rglob("*") if path.is_file()}


@pytest.fixture
def files_limited():
    """`files_limited(size_bytes, seconds)` gives a `between` for `record`: the limit holds in these seconds."""
    yield lambda size_bytes, seconds: lambda index: limit_files(size_bytes if index in seconds else None)
    limit_files()


async def test_what_was_published_is_read_back(tmp_path):
    await record(tmp_path / "s")
    session = Session.open(tmp_path / "s")
    times_ns, air_degC = session.readings("thermometers.air")
    np.testing.assert_array_equal(times_ns, [START_NS + k * NS_PER_S + NS_PER_S // 2 for k in range(5)])
    np.testing.assert_allclose(air_degC, [20.0, 20.1, 20.2, 20.3, 20.4], rtol=0, atol=1e-12)
    assert np.isnan(session.readings("thermometers.artifact")[1]).tolist() == [False, False, False, True, False]
    assert session.readings("linear.position")[1].tolist() == [100.0, 101.0, 102.0, 103.0, 104.0]
    assert session.steps()[2] == StepMark(
        int(times_ns[2]), "step-2", 2, "Capture", StepState.STARTED, {"frames": 1, "interval_s": 0.5}
    )
    assert [event.text for event in session.events()] == [f"second {k}" for k in range(5)]
    assert session.frame_count == 5
    for index, got in enumerate(session.frames()):
        sent = frame(int(times_ns[index]), index)
        np.testing.assert_array_equal(got.image, sent.image)
        for name in (
            "channel",
            "time_ns",
            "exposure_s",
            "gain_dB",
            "camera_degC",
            "block_id",
            "camera_ticks",
            "step_id",
        ):
            assert getattr(got, name) == getattr(sent, name)


async def test_the_same_items_are_the_same_bytes_on_any_host(tmp_path):
    await record(tmp_path / "a", 4, info=replace(INFO, host="laboratory"))
    await record(tmp_path / "b", 4, info=replace(INFO, host="laptop"))
    assert contents(tmp_path / "a") == contents(tmp_path / "b")
    assert sorted(contents(tmp_path / "a")) == ["frames/0000.mcap", "telemetry/0000.mcap"]
    await record(tmp_path / "c", 4, info=replace(INFO, clock_source="wall", host="laboratory"))
    assert contents(tmp_path / "c") != contents(tmp_path / "a")


async def test_a_reader_no_one_here_wrote_decodes_every_message(tmp_path):
    await record(tmp_path / "s")
    seen = {}
    for path in (tmp_path / "s").rglob("*.mcap"):
        with path.open("rb") as file:
            reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
            assert reader.get_header().library.startswith("mcap-python/")
            for schema, channel, message, _ in reader.iter_decoded_messages():
                seen.setdefault((channel.topic, schema.name), []).append(message.log_time)
    assert {name: len(times) for name, times in seen.items()} == {
        ("/camera/image", "foxglove.CompressedImage"): 5,
        ("/camera/meta", "thermostand.FrameMeta"): 5,
        ("/sensors/temperature", "thermostand.Temperatures"): 5,
        ("/chamber/state", "thermostand.ChamberState"): 5,
        ("/table/state", "thermostand.TableState"): 10,
        ("/table/pose", "foxglove.PoseInFrame"): 9,  # none before both axes have shown where they are
        ("/flap/state", "thermostand.FlapState"): 5,
        ("/experiment/step", "thermostand.Step"): 5,
        ("/experiment/event", "thermostand.Event"): 5,
        ("/log", "foxglove.Log"): 5,
    }


@pytest.mark.parametrize("settings", [replace(SETTINGS, segment_bytes=2000), replace(SETTINGS, segment_s=1.0)])
async def test_each_segment_stands_alone(tmp_path, settings):
    await record(tmp_path / "s", settings=settings)
    assert len(list((tmp_path / "s" / "frames").iterdir())) == 5
    telemetry = sorted((tmp_path / "s" / "telemetry").iterdir())
    assert len(telemetry) >= 4
    for number, path in enumerate(telemetry):
        with path.open("rb") as file:
            reader = make_reader(file, validate_crcs=True)
            metadata = {record.name: record.metadata for record in reader.iter_metadata()}
            assert {record.name: record.data.decode() for record in reader.iter_attachments()} == ATTACHMENTS
        assert metadata["session"] == INFO.metadata()
        previous = f"{number - 1:04d}" if number else ""
        place = {"series": "telemetry", "number": f"{number:04d}", "previous": previous}
        assert metadata["segment"].items() > place.items()
    session = Session.open(tmp_path / "s")
    assert session.frame_count == len(session.events()) == 5


async def test_raw_frames_are_read_back(tmp_path):
    await record(tmp_path / "s", 2, settings=replace(SETTINGS, frame_encoding="raw"))
    images = [got.image for got in Session.open(tmp_path / "s").frames()]
    np.testing.assert_array_equal(images[1], frame(0, 1).image)


async def test_frames_beyond_the_queue_are_dropped_counted_and_reported(tmp_path):
    def burst(time_ns, index):
        for block_id in range(30 if index == 0 else 0):
            yield frame(time_ns + block_id, block_id)

    await record(tmp_path / "s", 2, items=burst)
    session = Session.open(tmp_path / "s")
    assert session.frame_count == 20
    (event,) = session.events()
    assert (event.level, event.kind) == ("error", "frames_dropped")
    assert event.text == "frames lost: 10 (blocks 20 to 29 of step capture-1), 10 in all; the disk is too slow"


def committed_event_texts(directory):
    """The events in all telemetry segments, finished or not, with a reader that needs no index."""
    decoder = DecoderFactory()
    for path in sorted((directory / "telemetry").iterdir()):
        schemas, channels = {}, {}
        with path.open("rb") as file, suppress(Exception):  # an unfinished file ends anywhere
            for part in StreamReader(file, validate_crcs=True).records:
                if isinstance(part, Message) and channels[part.channel_id].topic == "/experiment/event":
                    schema = schemas[channels[part.channel_id].schema_id]
                    yield decoder.decoder_for("protobuf", schema)(part.data).text
                elif type(part).__name__ == "Schema":
                    schemas[part.id] = part
                elif type(part).__name__ == "Channel":
                    channels[part.id] = part


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


async def test_a_second_run_continues_the_session(tmp_path):
    await record(tmp_path / "s", 2)
    await record(tmp_path / "s", 2)
    assert sorted(contents(tmp_path / "s")) == [f"{s}/000{k}.mcap" for s in ("frames", "telemetry") for k in (0, 1)]
    assert Session.open(tmp_path / "s").frame_count == 4


def test_mistakes_in_the_wiring_are_value_errors(tmp_path):
    hub, clock = Hub(), VirtualClock(START_NS)
    with pytest.raises(ValueError, match="no device kind toaster"):
        Recorder(tmp_path, INFO, {}, {"kitchen": "toaster"}, hub, clock)
    Recorder(tmp_path / "s", INFO, {}, DEVICES, hub, clock).start()
    with pytest.raises(ValueError, match="humidity is not among"):
        hub.publish(Batch("humidity", START_NS, ()))


def test_a_place_where_nothing_can_be_written_is_a_session_error(tmp_path):
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(SessionError, match="no session can be recorded here"):
        Recorder(tmp_path / "file", INFO, {}, DEVICES, Hub(), VirtualClock(START_NS)).start()


async def start(directory, settings, encode=None):
    """A recorder that runs on a virtual clock; returns it, its clock, its hub and its tasks."""
    clock, hub = VirtualClock(START_NS), Hub()
    recorder = Recorder(directory, INFO, ATTACHMENTS, DEVICES, hub, clock, settings, encode)
    recorder.start()
    return recorder, clock, hub, [asyncio.create_task(recorder.run()), asyncio.create_task(clock.run())]


async def stop(tasks):
    for task in tasks:
        task.cancel()
    await asyncio.gather(*tasks, return_exceptions=True)


async def test_flushed_returns_when_all_before_it_is_on_the_disk_without_a_wait_for_the_tick(tmp_path):
    recorder, clock, hub, tasks = await start(tmp_path / "s", replace(SETTINGS, telemetry_commit_s=60.0))
    assert recorder.saved == Saved(0, 0, 0)
    for index in range(12):
        hub.publish(frame(START_NS + index, index))
        hub.publish(Event(START_NS + index, "info", "note", f"second {index}"))
    assert recorder.saved == Saved(0, 0, 0)
    await recorder.flushed()
    assert recorder.saved == Saved(12, 36, 0)  # a description for each frame; two messages for each event
    assert clock.now_ns() == START_NS
    assert len(list(committed_event_texts(tmp_path / "s"))) == 12
    await recorder.flushed()
    await stop(tasks)
    await recorder.finish()
    assert Session.open(tmp_path / "s").frame_count == 12


async def test_flushed_waits_for_telemetry_the_disk_refuses(tmp_path, files_limited):
    at = files_limited(100, {1})
    recorder, clock, hub, tasks = await start(tmp_path / "s", SETTINGS)
    at(1)
    hub.publish(Event(START_NS, "info", "note", "kept in memory"))
    waiting = asyncio.create_task(recorder.flushed())
    await clock.sleep_until(START_NS + 3 * NS_PER_S)
    assert not waiting.done()
    at(2)
    await waiting
    assert next(committed_event_texts(tmp_path / "s")) == "kept in memory"
    await stop(tasks)
    await recorder.finish()


async def test_frames_that_did_not_fit_the_queue_are_described_all_the_same(tmp_path):
    recorder, _, hub, tasks = await start(tmp_path / "s", replace(SETTINGS, queue_frames=3))
    for index in range(10):
        hub.publish(frame(START_NS + index, index))
    await recorder.flushed()
    assert recorder.saved == Saved(3, 10, 7)
    await stop(tasks)
    await recorder.finish()


async def test_a_frame_that_cannot_be_encoded_is_lost_and_the_next_one_is_not(tmp_path):
    def encode(got):
        if got.block_id == 1:
            raise ValueError("no marker in sight")
        return encode_image(got, "png")

    recorder, _, hub, tasks = await start(tmp_path / "s", SETTINGS, encode)
    for index in range(3):
        hub.publish(frame(START_NS + index, index))
    await recorder.flushed()
    assert recorder.saved == Saved(2, 3, 1)
    await stop(tasks)
    await recorder.finish()
    session = Session.open(tmp_path / "s")
    assert [got.block_id for got in session.frames()] == [0, 2]
    (event,) = session.events()
    assert event.text == "frames lost: 1 (block 1 of step capture-1), 1 in all; ValueError: no marker in sight"


async def test_frames_are_finished_in_time_also_when_no_more_come(tmp_path):
    recorder, clock, hub, tasks = await start(tmp_path / "s", replace(SETTINGS, segment_s=10.0))
    hub.publish(frame(START_NS, 0))
    await recorder.flushed()
    assert [path.name for path in (tmp_path / "s" / "frames").iterdir()] == ["0000.mcap.part"]
    await clock.sleep_until(START_NS + 12 * NS_PER_S)
    assert [path.name for path in (tmp_path / "s" / "frames").iterdir()] == ["0000.mcap"]
    await stop(tasks)
    await recorder.finish()


async def test_on_a_nearly_full_disk_not_even_the_first_frame_is_taken(tmp_path):
    """The disk is looked at before a segment is begun, not only on ticks."""
    nearly_full = replace(SETTINGS, telemetry_commit_s=60.0, stop_frames_below_bytes=10**18)
    recorder, clock, hub, tasks = await start(tmp_path / "s", nearly_full)
    hub.publish(frame(START_NS, 0))
    await clock.sleep_until(START_NS + NS_PER_S)
    assert recorder.saved == Saved(0, 0, 1)
    await stop(tasks)
    await recorder.finish()
    assert [(event.level, event.kind, event.text) for event in Session.open(tmp_path / "s").events()] == [
        ("error", "frames_stopped", f"frames are not recorded any more: less than {10**9}.0 GB free on the disk"),
        (
            "error",
            "frames_dropped",
            f"frames lost: 1 (block 0 of step capture-1), 1 in all; less than {10**9}.0 GB free on the disk",
        ),
    ]


async def test_finish_goes_to_its_end_also_when_its_caller_is_cancelled(tmp_path):
    recorder, _, hub, tasks = await start(tmp_path / "s", SETTINGS)
    for index in range(15):
        hub.publish(frame(START_NS + index, index))
    await stop(tasks)
    finishing = asyncio.create_task(recorder.finish())
    await asyncio.sleep(0)
    finishing.cancel()
    with pytest.raises(asyncio.CancelledError):
        await finishing
    assert Session.open(tmp_path / "s").frame_count == 15
    assert not Session.open(tmp_path / "s").incomplete
    await recorder.finish()


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
    assert ranges(blocks) == text


def test_losses_are_reported_by_reason_and_step():
    losses = Losses()
    for block_id, step_id, reason in [(1, "a", "slow"), (2, "a", "slow"), (4, "b", "slow"), (5, "", "full")]:
        losses.count(replace(frame(START_NS, block_id), step_id=step_id), reason)
    assert losses.total == 4
    slow, full = losses.take()
    assert slow.text == "frames lost: 3 (blocks 1 to 2 of step a and block 4 of step b), 4 in all; slow"
    assert slow.data == {"blocks": [[1, 2], [4, 4]], "steps": ["a", "b"], "total": 4, "reason": "slow"}
    assert full.text == "frames lost: 1 (block 5), 4 in all; full"
    assert losses.take() == []
    assert losses.total == 4
