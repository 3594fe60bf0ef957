import asyncio
from dataclasses import replace

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

from tests.recording.recordings import (
    ATTACHMENTS,
    DEVICES,
    INFO,
    SETTINGS,
    START_NS,
    committed_event_texts,
    frame,
    record,
    start,
    stop,
)
from thermostand.foundation.clock import NS_PER_S, VirtualClock
from thermostand.foundation.errors import SessionError
from thermostand.foundation.hub import Hub
from thermostand.foundation.items import Batch, Event, StepMark, StepState
from thermostand.foundation.readings import Channel
from thermostand.recording.format.batches import RecordedDevice
from thermostand.recording.format.manifest import MANIFEST_NAME, read_manifest
from thermostand.recording.format.mcap_contents import LIBRARY
from thermostand.recording.reading.session import Session
from thermostand.recording.writing.recorder import Recorder, Saved


def contents(directory):
    return {str(path.relative_to(directory)): path.read_bytes() for path in directory.rglob("*") if path.is_file()}


async def test_what_was_published_is_read_back(tmp_path):
    await record(tmp_path / "s")
    session = Session.open(tmp_path / "s")
    times_ns, air_degC = session.readings("thermometers.air")
    np.testing.assert_array_equal(times_ns, [START_NS + k * NS_PER_S + NS_PER_S // 2 for k in range(5)])
    np.testing.assert_allclose(air_degC, [20.0, 20.1, 20.2, 20.3, 20.4], rtol=0, atol=1e-12)
    assert np.isnan(session.readings("thermometers.artifact")[1]).tolist() == [False, False, False, True, False]
    assert session.readings("linear.position")[1].tolist() == [100.0, 101.0, 102.0, 103.0, 104.0]
    assert session.steps()[2] == StepMark(
        int(times_ns[2]), "step-2", 2, "capture", StepState.STARTED, {"frames": 1, "interval_s": 0.5}
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
    assert sorted(contents(tmp_path / "a")) == ["frames/0000.mcap", "session.json", "telemetry/0000.mcap"]
    await record(tmp_path / "c", 4, info=replace(INFO, clock_source="wall", host="laboratory"))
    assert contents(tmp_path / "c") != contents(tmp_path / "a")


async def test_a_reader_no_one_here_wrote_decodes_every_message(tmp_path):
    await record(tmp_path / "s")
    seen = {}
    for path in (tmp_path / "s").rglob("*.mcap"):
        with path.open("rb") as file:
            reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
            assert reader.get_header().library == LIBRARY
            for schema, channel, message, _ in reader.iter_decoded_messages():
                seen.setdefault((channel.topic, schema.name), []).append(message.log_time)
    assert {name: len(times) for name, times in seen.items()} == {
        ("/camera/image", "foxglove.RawImage"): 5,
        ("/camera/meta", "thermostand.FrameMeta"): 5,
        ("/readings/thermometers", "thermostand.thermometers"): 5,
        ("/readings/regulator", "thermostand.regulator"): 5,
        ("/readings/linear", "thermostand.linear"): 5,
        ("/readings/rotary", "thermostand.rotary"): 5,
        ("/table/pose", "foxglove.PoseInFrame"): 9,  # none before both axes have shown where they are
        ("/readings/flap", "thermostand.flap"): 5,
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


async def test_a_second_run_continues_the_session(tmp_path):
    await record(tmp_path / "s", 2)
    await record(tmp_path / "s", 2)
    names = [f"{series}/000{number}.mcap" for series in ("frames", "telemetry") for number in (0, 1)]
    assert sorted(contents(tmp_path / "s")) == sorted([*names, MANIFEST_NAME])
    assert sorted(read_manifest(tmp_path / "s").segments) == names
    assert Session.open(tmp_path / "s").frame_count == 4


def test_mistakes_in_the_wiring_are_value_errors(tmp_path):
    hub, clock = Hub(), VirtualClock(START_NS)
    twice = RecordedDevice("toaster", (Channel("crust", "degC"), Channel("crust", "degC")))
    with pytest.raises(ValueError, match="kitchen declares"):
        Recorder(tmp_path, INFO, {}, {"kitchen": twice}, hub, clock)
    Recorder(tmp_path / "s", INFO, {}, DEVICES, hub, clock).start()
    with pytest.raises(ValueError, match="humidity is not among"):
        hub.publish(Batch("humidity", START_NS, ()))


def test_a_place_where_nothing_can_be_written_is_a_session_error(tmp_path):
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(SessionError, match="no session can"):
        Recorder(tmp_path / "file", INFO, {}, DEVICES, Hub(), VirtualClock(START_NS)).start()


async def test_flushed_returns_when_all_before_it_is_on_the_disk_without_a_wait_for_the_tick(tmp_path):
    recorder, clock, hub, tasks = await start(tmp_path / "s", replace(SETTINGS, telemetry_commit_s=60.0))
    assert recorder.saved == Saved(0, 0, 0)
    for index in range(12):
        hub.publish(frame(START_NS + index, index))
        hub.publish(Event(START_NS + index, "info", "note", f"second {index}"))
    assert recorder.saved == Saved(0, 0, 0)
    await recorder.flush()
    assert recorder.saved == Saved(12, 24, 0)  # two messages for each event
    assert clock.now_ns() == START_NS
    assert len(list(committed_event_texts(tmp_path / "s"))) == 12
    await recorder.flush()
    await stop(tasks)
    await recorder.finish()
    assert Session.open(tmp_path / "s").frame_count == 12


async def test_frames_are_finished_in_time_also_when_no_more_come(tmp_path):
    recorder, clock, hub, tasks = await start(tmp_path / "s", replace(SETTINGS, segment_s=10.0))
    hub.publish(frame(START_NS, 0))
    await recorder.flush()
    assert [path.name for path in (tmp_path / "s" / "frames").iterdir()] == ["0000.mcap.part"]
    await clock.sleep_until(START_NS + 12 * NS_PER_S)
    assert [path.name for path in (tmp_path / "s" / "frames").iterdir()] == ["0000.mcap"]
    await stop(tasks)
    await recorder.finish()


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
