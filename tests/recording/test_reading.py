"""What a session gives beside its columns: items in order, single frames; and that it reads no more than it needs."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.opcode import Opcode
from mcap.writer import CompressionType

from tests.recording.device_declarations import KINDS, declare_devices, form
from tests.recording.frame_records import CAMERA_TOPICS, make_frame_records
from tests.recording.full_session import ATTACHMENTS, DEVICES, INFO, START_NS, images, item_key, record, telemetry
from tests.recording.segment_fuzzer import put_together, take_apart
from thermostand.foundation.clock import NS_PER_S, VirtualClock
from thermostand.foundation.errors import SessionError
from thermostand.foundation.hub import Hub
from thermostand.foundation.items import Batch, StepMark, StepState
from thermostand.foundation.readings import Channel, Frame, Quality, Reading, bad_reading
from thermostand.recording.exporting.export import export
from thermostand.recording.exporting.trim import trim
from thermostand.recording.format import messages
from thermostand.recording.format.batches import RecordedDevice
from thermostand.recording.format.images import name_frame_topics
from thermostand.recording.format.layout import FORMAT, FRAMES, TELEMETRY
from thermostand.recording.format.records import list_frame_places, read_telemetry_messages
from thermostand.recording.reading.recorded_devices import recorded_devices
from thermostand.recording.reading.session import Session
from thermostand.recording.writing.recorder import Recorder
from thermostand.recording.writing.segment import MessageRecord, SeriesSpec
from thermostand.recording.writing.series import Series
from thermostand.recording.writing.session_spec import list_telemetry_topics, make_frames_topic
from thermostand.recording.writing.telemetry import TelemetryEncoder

METADATA = {"format": str(FORMAT), "session_id": "cycle-1"}


def at(second):
    return START_NS + round(second * NS_PER_S)


def small_frame(second, block_id=None):
    image = np.full((4, 6), round(second), np.uint8)
    number = round(second) if block_id is None else block_id
    return Frame("camera.image", image, at(second), 0.1, 0.0, 41.0, number, 0)


def write(folder, topics, commits, compression=CompressionType.NONE, attachments=ATTACHMENTS):
    """One more segment in `folder`, a chunk for each commit."""
    folder.mkdir(parents=True, exist_ok=True)
    series = Series(folder, SeriesSpec(folder.name, topics, compression, METADATA, attachments, 1 << 40, 1 << 60))
    for records in commits:
        series.commit(records, START_NS)
    series.finish()


def write_items(directory, items, devices=DEVICES, **options):
    """A telemetry segment with these items, each in a chunk of its own."""
    encoder = TelemetryEncoder(devices)
    write(
        directory / TELEMETRY, list_telemetry_topics(devices), [list(encoder.encode(item)) for item in items], **options
    )


def write_images(directory, frames):
    write(directory / FRAMES, CAMERA_TOPICS, list(map(make_frame_records, frames)), CompressionType.ZSTD)


def air(value, second, **changes):
    return Reading("thermometers.air", value, "degC", at(second), **changes)


def batch(second, *readings):
    return Batch("thermometers", at(second), readings)


def comparable(item):
    """As item_key, with the readings of a batch sorted: a message keeps the order only in part."""
    if isinstance(item, Batch):
        item = replace(item, readings=tuple(sorted(item.readings, key=repr)))
    return item_key(item)


async def record_again(session, directory):
    hub = Hub()
    recorder = Recorder(directory, INFO, ATTACHMENTS, DEVICES, hub, VirtualClock(START_NS))
    recorder.start()
    for item in session.items():
        hub.publish(item)
    await recorder.finish()
    return Session.open(directory)


async def test_items_are_what_was_published_in_that_order(tmp_path):
    published = await record(tmp_path / "session")
    items = list(Session.open(tmp_path / "session").items())
    assert [comparable(item) for item in items] == [comparable(item) for item in published]


async def test_items_recorded_again_are_the_same_messages(tmp_path):
    await record(tmp_path / "first")
    first = Session.open(tmp_path / "first")
    second = await record_again(first, tmp_path / "second")
    assert telemetry(second) == telemetry(first)
    assert images(second) == images(first)


kinds = st.sampled_from(KINDS)


@st.composite
def batches(draw):
    """Any batch of a device: readings in any order, repeated, of other devices, with times and reasons of their own."""
    kind = draw(kinds)
    names = [(f"dev.{each.name}", each.unit) for each in form("dev", kind).device.channels] + [
        ("dev.new", "%"),
        ("x.y", "K"),
    ]
    time_ns = draw(st.sampled_from([1, START_NS]))
    readings = []
    for channel, unit in draw(st.lists(st.sampled_from(names), max_size=8)):
        value = draw(st.floats())
        quality = Quality.BAD if math.isnan(value) else draw(st.sampled_from([Quality.GOOD, Quality.STALE]))
        own_ns = draw(st.sampled_from([time_ns, time_ns, 0, START_NS - 1, -1]))
        readings.append(Reading(channel, value, unit, own_ns, quality, draw(st.sampled_from(["", "", "late"]))))
    return kind, Batch("dev", time_ns, tuple(readings))


@given(batches())
def test_a_batch_read_and_encoded_again_is_the_same_bytes_and_lost_nothing(case):
    kind, original = case
    encoder = form("dev", kind)
    data = encoder.encode(original)
    decoded = encoder.decode(data, original.time_ns)
    assert encoder.encode(decoded) == data
    assert comparable(decoded) == comparable(original)


def test_an_empty_batch_is_an_item_too(tmp_path):
    items = [batch(0), batch(1, air(20.0, 1)), batch(2)]
    write_items(tmp_path, items)
    assert list(Session.open(tmp_path).items()) == items


def test_a_frame_comes_behind_what_was_published_at_its_instant_and_before_the_end_of_its_step(tmp_path):
    ended = StepMark(at(2), "capture", 0, "capture", StepState.DONE)
    write_items(tmp_path, [batch(0), batch(2), ended, batch(3)])
    frames = [replace(small_frame(second), step_id=step_id) for second, step_id in ((1, ""), (2, "capture"), (4, ""))]
    write_images(tmp_path, frames)
    items = [(type(item).__name__, (item.time_ns - START_NS) / NS_PER_S) for item in Session.open(tmp_path).items()]
    order = [("Batch", 0), ("Frame", 1), ("Batch", 2), ("Frame", 2), ("StepMark", 2), ("Batch", 3), ("Frame", 4)]
    assert items == order


def test_frames_of_one_instant_are_distinguished_by_their_camera_and_number(tmp_path):
    write_items(tmp_path, [batch(1)])
    frames = [small_frame(1, 7), replace(small_frame(1, 7), channel="side.image"), small_frame(1, 8)]
    side = tuple(map(make_frames_topic, name_frame_topics("side.image")))
    write(tmp_path / FRAMES, (*CAMERA_TOPICS, *side), list(map(make_frame_records, frames)), CompressionType.ZSTD)
    session = Session.open(tmp_path)
    assert [(frame.channel, frame.block_id) for frame in session.frames()] == [
        ("camera.image", 7),
        ("side.image", 7),
        ("camera.image", 8),
    ]
    assert [session.frame(index).channel for index in range(3)] == ["camera.image", "side.image", "camera.image"]


def test_items_hold_one_image_at_a_time(tmp_path):
    write_items(tmp_path, [small_frame(second) for second in range(3)])
    write_images(tmp_path, [small_frame(second) for second in range(3)])
    items = Session.open(tmp_path).items()
    next(items)
    (tmp_path / FRAMES / "0000.mcap").write_bytes(b"")
    with pytest.raises(SessionError, match=r"frames/0000\.mcap"):
        next(items)


def test_a_frame_is_found_by_its_index_in_order_of_time(tmp_path):
    write_items(tmp_path, [small_frame(second) for second in range(7)])
    for seconds in ((0, 2, 1), (3,), (4, 6, 5)):
        write_images(tmp_path, [small_frame(second) for second in seconds])
    session = Session.open(tmp_path)
    assert [session.frame(index).block_id for index in (6, 0, 3, 1, 2, 5, 4)] == [6, 0, 3, 1, 2, 5, 4]
    assert session.frame(4).camera_degC == 41.0
    for index in (-1, 7):
        with pytest.raises(SessionError, match=f"has no frame {index}; it has 7"):
            session.frame(index)


def test_segments_that_overlap_in_time_are_one_order(tmp_path):
    write_items(tmp_path, [batch(0)])
    for seconds in ((0, 3), (1, 2), (4,)):
        write_images(tmp_path, [small_frame(second) for second in seconds])
    session = Session.open(tmp_path)
    assert [session.frame(index).block_id for index in range(5)] == [0, 1, 2, 3, 4]
    assert [image.meta.block_id for image in session.images()] == [0, 1, 2, 3, 4]
    assert session.frame_times_ns.tolist() == [at(second) for second in range(5)]


def test_images_come_as_they_were_recorded(tmp_path):
    write_items(tmp_path, [batch(0)])
    write_images(tmp_path, [small_frame(0)])
    (image,) = Session.open(tmp_path).images()
    assert (image.description, bytes(image.data)) == tuple(record.data for record in make_frame_records(small_frame(0)))
    assert (image.time_ns, image.meta.block_id, image.path) == (at(0), 0, tmp_path / FRAMES / "0000.mcap")


def test_the_table_of_frames_is_read_without_an_image(tmp_path):
    write_items(tmp_path, [batch(0)])
    write_images(tmp_path, [small_frame(second) for second in range(3)])
    path = tmp_path / FRAMES / "0000.mcap"
    (places, data) = list_frame_places(path), bytearray(path.read_bytes())
    for place in places:
        data[place.chunk.offset + place.chunk.length - 4] ^= 0xFF  # within the compressed image
    path.write_bytes(data)
    session = Session.open(tmp_path)
    assert [meta.block_id for meta in session.frame_metas()] == [0, 1, 2]
    with pytest.raises(SessionError, match="damaged"):
        session.frame(1)


def test_frames_that_another_writer_wrote_without_a_table_are_read(tmp_path):
    write_items(tmp_path, [batch(0)])
    write_images(tmp_path, [small_frame(second) for second in range(3)])

    def without_table(records):
        records[:] = [r for r in records if not (r.opcode == Opcode.ATTACHMENT and b"\x06\0\0\0frames" in r.content)]
        records[:] = [r for r in records if not (r.opcode == Opcode.ATTACHMENT_INDEX and b"frames" in r.content)]
        (statistics,) = (r for r in records if r.opcode == Opcode.STATISTICS)
        count = int.from_bytes(statistics.content[14:18], "little") - 1
        statistics.content = statistics.content[:14] + count.to_bytes(4, "little") + statistics.content[18:]

    rewrite(tmp_path / FRAMES / "0000.mcap", without_table)
    assert [frame.block_id for frame in Session.open(tmp_path).frames()] == [0, 1, 2]


def test_only_the_segments_that_are_needed_are_read(tmp_path):
    for second in range(4):
        write_items(tmp_path, [batch(second, air(20.0, second)), small_frame(second)])
        write_images(tmp_path, [small_frame(second)])
    (tmp_path / FRAMES / "0003.mcap").write_bytes(b"")
    session = Session.open(tmp_path)
    assert session.readings("thermometers.air")[0].shape == (4,)
    with pytest.raises(SessionError, match=r"frames/0003\.mcap"):
        session.frame(0)  # which one is the first needs the times of all
    (tmp_path / FRAMES / "0003.mcap").unlink()
    (tmp_path / TELEMETRY / "0003.mcap").write_bytes(b"")
    session = Session.open(tmp_path)
    assert session.frame_count == 3
    with pytest.raises(SessionError, match=r"telemetry/0003\.mcap"):
        session.readings("thermometers.air")


def test_segments_attachments_and_damaged_originals_are_listed(tmp_path):
    write_items(tmp_path, [batch(0)])
    write_images(tmp_path, [small_frame(0)])
    damaged = tmp_path / FRAMES / "0000.mcap.damaged"
    damaged.write_bytes(b"")
    session = Session.open(tmp_path)
    assert session.segments == (tmp_path / TELEMETRY / "0000.mcap", tmp_path / FRAMES / "0000.mcap")
    assert session.damaged == (damaged,)
    assert session.attachments == ATTACHMENTS


def test_columns_keep_the_order_of_the_files_where_times_are_equal(tmp_path):
    remarked = air(3.0, 1, quality=Quality.STALE, reason="not confirmed")
    write_items(tmp_path, [batch(1, air(2.0, 1)), batch(2, remarked), batch(1, air(4.0, 1)), batch(0, air(1.0, 0))])
    times_ns, values = Session.open(tmp_path).readings("thermometers.air")
    assert values.tolist() == [1.0, 2.0, 3.0, 4.0]
    assert times_ns.tolist() == [at(0), at(1), at(1), at(1)]
    assert (times_ns.dtype, values.dtype) == (np.int64, np.float64)


def test_columns_know_absent_bad_and_unforeseen_readings(tmp_path):
    humidity = Reading("thermometers.humidity", 45.0, "%", at(1))
    bad = bad_reading("thermometers.air", "degC", at(2), "")
    write_items(tmp_path, [batch(0), batch(1, humidity), batch(2, bad), batch(3, air(20.0, 3))])
    session = Session.open(tmp_path)
    assert session.channels() == ["thermometers.air", "thermometers.humidity"]
    assert session.readings("thermometers.humidity")[1].tolist() == [45.0]
    np.testing.assert_array_equal(session.readings("thermometers.air")[1], [np.nan, 20.0])


def test_a_device_that_joined_later_takes_nothing_from_the_first(tmp_path):
    def moved(device, unit, second):
        return Batch(device, at(second), (Reading(f"{device}.position", float(second), unit, at(second)),))

    write_items(tmp_path, [moved("linear", "mm", 0)], declare_devices({"linear": "axis"}))
    both = declare_devices({"linear": "axis", "rotary": "axis"})
    write_items(tmp_path, [moved("linear", "mm", 1), moved("rotary", "deg", 2)], both)
    session = Session.open(tmp_path)
    assert session.readings("rotary.position")[1].tolist() == [2.0]
    assert session.readings("linear.position")[1].tolist() == [0.0, 1.0]


def test_a_channel_whose_unit_has_changed_is_two(tmp_path):
    def lab(value, unit, second):
        return Batch("lab", at(second), (Reading("lab.pressure", value, unit, at(second)),))

    for second, (value, unit) in enumerate([(1013.0, "hPa"), (760.0, "mmHg")]):
        devices = {"lab": RecordedDevice("barometer", (Channel("pressure", unit, "pressure"),))}
        write_items(tmp_path / "s", [lab(value, unit, second)], devices)
    session = Session.open(tmp_path / "s")
    assert session.units() == {"lab.pressure": "hPa", "lab.pressure (mmHg)": "mmHg"}
    assert session.readings("lab.pressure")[1].tolist() == [1013.0]
    assert session.readings("lab.pressure (mmHg)")[1].tolist() == [760.0]
    part = Session.open(trim(session, tmp_path / "part", START_NS, at(9)))
    assert part.units() == session.units()
    assert list(recorded_devices(part.telemetry_segments).values()) == list(
        recorded_devices(session.telemetry_segments).values()
    )
    assert [item.readings for item in part.items() if isinstance(item, Batch)] == [
        item.readings for item in session.items()
    ]
    export(session, tmp_path / "out", report=lambda done, text: None)
    (header, *rows) = (tmp_path / "out/telemetry/lab.csv").read_text().splitlines()
    assert header.split(",")[2::2] == ["pressure_hPa", "pressure_mmHg", "remarks"]
    assert [row.split(",")[2:6] for row in rows] == [["1013.0", "good", "", ""], ["", "", "760.0", "good"]]


def rewrite(path, change):
    """The segment with its records changed and its CRCs right."""
    records = take_apart(path.read_bytes())
    change(records)
    path.write_bytes(put_together(records))


def chunks(records):
    return [record for record in records if record.opcode == Opcode.CHUNK]


def value_with_a_bad_quality(records):
    message = chunks(records)[0].inner[-1]
    good = form("thermometers").message.FromString(message.content[22:])
    good.air_degC_quality = 3
    message.content = message.content[:22] + good.SerializeToString()


def unknown_quality(records):
    message = chunks(records)[0].inner[-1]
    good = form("thermometers").message.FromString(message.content[22:])
    good.air_degC_quality = 9
    message.content = message.content[:22] + good.SerializeToString()


def message_removed(records):
    chunks(records)[1].inner.pop()


def attachment_without_end(records):
    attachment = next(record for record in records if record.opcode == Opcode.ATTACHMENT)
    text = ATTACHMENTS["config.yaml"].encode()
    length = len(text).to_bytes(8, "little")
    assert length + text in attachment.content
    attachment.content = attachment.content.replace(length + text, b"\xff" * 8 + text)


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (value_with_a_bad_quality, r"thermometers\.air: the recorded value 20\.0 does not fit its quality 3"),
        (unknown_quality, "does not fit its quality 9"),
        (message_removed, r"0000\.mcap: damaged .*it does not hold the messages that its index lists"),
        (attachment_without_end, r"0000\.mcap: damaged .*OverflowError"),
    ],
)
def test_wrong_content_under_right_crcs_is_reported(tmp_path, change, sentence):
    write_items(tmp_path, [batch(0, air(20.0, 0)), batch(1, air(21.0, 1))])
    rewrite(tmp_path / TELEMETRY / "0000.mcap", change)
    with pytest.raises(SessionError, match=sentence):
        Session.open(tmp_path).readings("thermometers.air")


def test_a_step_nested_deeper_than_python_goes_is_reported(tmp_path):
    step = messages.CLASSES[messages.STEP](state="done", parameters_json="[" * 200_000).SerializeToString()
    write(tmp_path / TELEMETRY, list_telemetry_topics({}), [[MessageRecord(messages.STEP, START_NS, step)]])
    with pytest.raises(SessionError, match="a recorded step"):
        Session.open(tmp_path).steps()


def test_a_chunk_in_the_place_of_another_is_refused(tmp_path):
    write_items(tmp_path, [batch(second, air(20.0 + second, second)) for second in range(3)])
    path = tmp_path / TELEMETRY / "0000.mcap"
    data = path.read_bytes()
    times = [at(second).to_bytes(8, "little") for second in (1, 2)]
    heads = [data.index(2 * time) - 9 for time in times]  # a chunk's record begins with its first and last time
    lengths = [int.from_bytes(data[head + 1 : head + 9], "little") for head in heads]
    assert lengths[0] == lengths[1], "else this is no test"
    chunk = data[heads[0] : heads[0] + 9 + lengths[0]]
    path.write_bytes(data[: heads[1]] + chunk + data[heads[1] + len(chunk) :])
    with pytest.raises(SessionError, match="points to another chunk"):
        Session.open(tmp_path).readings("thermometers.air")


def test_metadata_that_changed_is_seen_even_in_a_session_of_one_segment(tmp_path):
    write_items(tmp_path, [batch(0)])
    path = tmp_path / TELEMETRY / "0000.mcap"
    data = path.read_bytes()
    path.write_bytes(data.replace(b"cycle-1", b"cycle-7"))
    with pytest.raises(SessionError, match=r"metadata .* CRC"):
        Session.open(tmp_path)


def test_compressed_chunks_are_read_message_by_message(tmp_path):
    write_items(tmp_path, [batch(second, air(20.0, second)) for second in range(20)], compression=CompressionType.ZSTD)
    path = tmp_path / TELEMETRY / "0000.mcap"
    assert [m.time_ns for m in read_telemetry_messages(path, lambda channel: True)] == [
        at(second) for second in range(20)
    ]
    assert list(read_telemetry_messages(path, lambda channel: False)) == []
