import random
import shutil

import numpy as np
import pytest
from mcap.writer import CompressionType

from tests.recording.device_declarations import form as declared_form
from tests.recording.frame_records import CAMERA_TOPICS, make_frame_records
from thermostand.foundation.clock import NS_PER_S
from thermostand.foundation.errors import SessionError
from thermostand.foundation.items import Batch, Event, StepMark, StepState
from thermostand.foundation.readings import Frame, Reading
from thermostand.recording.format import messages
from thermostand.recording.format.layout import FORMAT, FRAMES, TELEMETRY
from thermostand.recording.reading.session import Session
from thermostand.recording.writing.segment import MessageRecord, SeriesSpec, Topic
from thermostand.recording.writing.series import Series
from thermostand.recording.writing.session_spec import make_readings_topic

START_NS = 1_767_290_400 * NS_PER_S
METADATA = {"format": str(FORMAT), "session_id": "cycle-1", "operator": "J. Krukowski"}
ATTACHMENTS = {"config.yaml": "a: 1\n", "target.yaml": "rows: 6\n"}
ENCODER = declared_form("thermometers")
TELEMETRY_TOPICS = (
    make_readings_topic(ENCODER),
    *(Topic(name, messages.CLASSES[name]) for name in (messages.STEP, messages.EVENT)),
)


def form(name, topics, compression, metadata=METADATA):
    return SeriesSpec(name, topics, compression, metadata, ATTACHMENTS, 1_000_000_000, 600 * NS_PER_S)


def telemetry_of(second):
    """The records of one second; temperatures 20.0, 20.5, ... degC."""
    time_ns = START_NS + second * NS_PER_S
    air = Reading("thermometers.air", 20 + second / 2, "degC", time_ns)
    yield MessageRecord(ENCODER.topic, time_ns, ENCODER.encode(Batch("thermometers", time_ns, (air,))))
    yield MessageRecord(messages.STEP, time_ns, messages.encode_step(mark(second)))
    yield MessageRecord(messages.EVENT, time_ns, messages.encode_event(event(second)))


def mark(second):
    return StepMark(START_NS + second * NS_PER_S, f"soak-{second}", second, "soak", StepState.DONE, {"soak_s": 2700.0})


def event(second):
    return Event(START_NS + second * NS_PER_S, "info", "note", f"second {second}")


def frame(second):
    image = np.random.default_rng(second).integers(0, 255, (30, 40), np.uint8)
    return Frame("camera.image", image, START_NS + second * NS_PER_S, 0.1, 0.0, 41.0, second, 7 * second)


def write_series(folder, seconds, series_form, records_of):
    folder.mkdir(parents=True, exist_ok=True)
    series = Series(folder, series_form)
    for second in seconds:
        series.commit(list(records_of(second)), START_NS + second * NS_PER_S)
    series.finish()


def write_frames(directory, seconds, metadata=METADATA):
    series_form = form(FRAMES, CAMERA_TOPICS, CompressionType.ZSTD, metadata)
    write_series(directory / FRAMES, seconds, series_form, lambda k: make_frame_records(frame(k)))


def write_telemetry(directory, seconds, metadata=METADATA):
    write_series(
        directory / TELEMETRY, seconds, form(TELEMETRY, TELEMETRY_TOPICS, CompressionType.ZSTD, metadata), telemetry_of
    )


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """Eight seconds in two segments per series; not to be changed."""
    directory = tmp_path_factory.mktemp("sessions") / "whole"
    for seconds in (range(4), range(4, 8)):
        write_telemetry(directory, seconds)
        write_frames(directory, seconds)
    return directory


@pytest.fixture
def copy(whole, tmp_path):
    return shutil.copytree(whole, tmp_path / "copy")


def read_all(directory):
    """Everything in the session, comparable."""
    session = Session.open(directory)
    times_ns, values = session.readings("thermometers.air")
    frames = [(got.time_ns, got.camera_degC, got.block_id, got.image.tobytes()) for got in session.frames()]
    return (
        times_ns.tolist(),
        values.tolist(),
        session.steps(),
        session.events(),
        frames,
        session.attachment("config.yaml"),
    )


def test_segments_are_read_as_one_session(whole):
    times_ns, values, steps, events, frames, config = read_all(whole)
    assert times_ns == [START_NS + k * NS_PER_S for k in range(8)]
    assert values == [20 + k / 2 for k in range(8)]
    assert steps == [mark(k) for k in range(8)]
    assert events == [event(k) for k in range(8)]
    assert frames == [(frame(k).time_ns, 41.0, k, frame(k).image.tobytes()) for k in range(8)]
    assert config == "a: 1\n"


def test_a_session_tells_what_it_is_without_reading_its_messages(whole):
    session = Session.open(whole)
    assert session.metadata == METADATA
    assert session.attachment("recipe.yaml") is None
    assert session.frame_count == 8
    assert session.frame_times_ns.dtype == np.int64
    assert session.frame_times_ns.tolist() == [START_NS + k * NS_PER_S for k in range(8)]
    assert session.channels() == ["thermometers.air"]
    assert session.incomplete == ()


def test_frames_are_decoded_one_at_a_time(copy):
    frames = Session.open(copy).frames()
    assert next(frames).block_id == 0
    damaged = copy / FRAMES / "0001.mcap"
    damaged.write_bytes(damaged.read_bytes()[:-9])
    assert [next(frames).block_id for _ in range(3)] == [1, 2, 3]
    with pytest.raises(SessionError, match=r"frames/0001\.mcap: ends"):
        next(frames)


def test_messages_written_late_are_read_in_order_of_time(tmp_path):
    write_telemetry(tmp_path, [2, 0, 1])
    session = Session.open(tmp_path)
    assert session.readings("thermometers.air")[1].tolist() == [20.0, 20.5, 21.0]
    assert session.steps() == [mark(0), mark(1), mark(2)]


def test_a_session_without_frames_has_none(tmp_path):
    write_telemetry(tmp_path, [0])
    session = Session.open(tmp_path)
    assert session.frame_count == 0
    assert session.frame_times_ns.shape == (0,)
    assert list(session.frames()) == []


def test_unfinished_segments_are_reported_and_left_alone(copy):
    part = copy / TELEMETRY / "0002.mcap.part"
    part.write_bytes(b"\x89MCAP0\r\nhalf a record")
    session = Session.open(copy)
    assert session.incomplete == (part,)
    assert session.readings("thermometers.air")[0].shape == (8,)


def test_an_unknown_channel_is_answered_with_the_existing_ones(whole):
    with pytest.raises(SessionError, match=r"has no channel camera\.temperature; there are thermometers\.air"):
        Session.open(whole).readings("camera.temperature")


def empty_directory(directory):
    shutil.rmtree(directory / TELEMETRY)


def only_a_part(directory):
    (directory / TELEMETRY / "0001.mcap").unlink()
    (directory / TELEMETRY / "0000.mcap").rename(directory / TELEMETRY / "0000.mcap.part")


def empty_file(directory):
    (directory / TELEMETRY / "0000.mcap").write_bytes(b"")


def text_file(directory):
    (directory / TELEMETRY / "0000.mcap").write_text("time,temperature\n" * 50)


def magic_only(directory):
    (directory / TELEMETRY / "0000.mcap").write_bytes(b"\x89MCAP0\r\n")


def cut_short(directory):
    path = directory / FRAMES / "0001.mcap"
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def segment_of_another_session(directory):
    write_frames(directory, [9], {"session_id": "cycle-2"})


@pytest.mark.parametrize(
    ("damage", "sentence"),
    [
        (empty_directory, "not a session: there is no finished segment"),
        (only_a_part, "only 1 unfinished"),
        (empty_file, "not an MCAP file"),
        (text_file, "not an MCAP file"),
        (magic_only, "ends in the middle"),
        (cut_short, "ends in the middle"),
        (segment_of_another_session, "belongs to another session"),
    ],
)
def test_what_is_no_sound_session_is_refused_with_a_sentence(copy, damage, sentence):
    damage(copy)
    with pytest.raises(SessionError, match=sentence) as raised:
        read_all(copy)
    assert str(copy) in str(raised.value)


def test_a_directory_that_does_not_exist_is_refused(tmp_path):
    with pytest.raises(SessionError, match="no such folder"):
        Session.open(tmp_path / "missing")


def test_foreign_messages_on_a_topic_of_ours_are_refused(tmp_path):
    topics = (Topic(ENCODER.topic, messages.CLASSES[messages.EVENT], ENCODER.metadata),)
    data = messages.encode_event(event(0))
    write_series(
        tmp_path / TELEMETRY,
        [0],
        form(TELEMETRY, topics, CompressionType.ZSTD),
        lambda k: [MessageRecord(ENCODER.topic, START_NS, data)],
    )
    with pytest.raises(SessionError, match=r"/readings/thermometers holds thermostand\.Event"):
        Session.open(tmp_path).readings("thermometers.air")


@pytest.mark.parametrize("series", [TELEMETRY, FRAMES])
def test_a_changed_byte_is_refused_or_harmless_and_never_wrong_data(whole, copy, series):
    expected = read_all(whole)
    path = copy / series / "0000.mcap"
    sound = path.read_bytes()
    rng = random.Random(4)
    refused = 0
    for _ in range(150):
        damaged = bytearray(sound)
        damaged[rng.randrange(len(sound))] ^= 1 << rng.randrange(8)
        path.write_bytes(damaged)
        try:
            got = read_all(copy)
        except SessionError:
            refused += 1
        else:
            assert got == expected
    assert refused > 40  # the rest hit what is written twice or not used


@pytest.mark.parametrize("series", [TELEMETRY, FRAMES])
def test_a_file_cut_anywhere_is_refused(copy, series):
    path = copy / series / "0000.mcap"
    sound = path.read_bytes()
    for size in random.Random(5).sample(range(len(sound)), 60):
        path.write_bytes(sound[:size])
        with pytest.raises(SessionError):
            read_all(copy)
