"""A session as one MCAP file: mcap's own reader finds the same messages, in order of time, with what is attached."""

import pytest
from mcap.reader import make_reader

from tests.recording.full_session import ATTACHMENTS, images, record, telemetry
from thermostand.foundation.errors import SessionError
from thermostand.recording.exporting.mcap_export import export_mcap
from thermostand.recording.format.images import FrameEncoding
from thermostand.recording.reading.notes import add_note
from thermostand.recording.reading.session import Session


def silent(done, text):
    assert 0.0 <= done <= 1.0


async def exported(tmp_path, encoding: FrameEncoding = "zstd", **choices):
    await record(tmp_path / "s", encoding=encoding)
    add_note(tmp_path / "s", "windy", "eva", 1)
    session = Session.open(tmp_path / "s")
    export_mcap(session, tmp_path / "cycle.mcap", report=silent, **choices)
    return session, tmp_path / "cycle.mcap"


def found(path):
    """(topic, time, sequence, data) of each message, the summary, attachments and metadata, by mcap's reader."""
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        messages = [
            (channel.topic, message.log_time, message.sequence, message.data)
            for _, channel, message in reader.iter_messages(log_time_order=False)
        ]
        attachments = {each.name: each.data for each in reader.iter_attachments()}
        metadata = {each.name: each.metadata for each in reader.iter_metadata()}
        return messages, reader.get_summary(), attachments, metadata


FRAMES = ("/camera/meta", "/camera/image")


def frames_of(messages):
    """Description and image of each frame, as `images` has them."""
    data = [data for topic, _, _, data in messages if topic in FRAMES]
    return list(zip(data[::2], data[1::2], strict=True))


def keys(messages):
    return [(message.topic, message.time_ns, message.sequence, message.data) for message in messages]


@pytest.mark.parametrize("encoding", ["zstd", "raw"])
async def test_every_message_is_given_once_in_order_of_time(tmp_path, encoding):
    session, path = await exported(tmp_path, encoding)
    messages, summary, attachments, metadata = found(path)
    assert [each for each in messages if each[0] not in FRAMES] == keys(telemetry(session))
    assert frames_of(messages) == images(session)
    of_frames = [message for message in messages if message[0] == "/camera/image"]
    assert [time_ns for _, time_ns, _, _ in of_frames] == session.frame_times_ns.tolist()
    assert summary.statistics.message_count == len(messages)
    assert metadata["session"] == session.metadata
    assert attachments.keys() == {*ATTACHMENTS, "notes.jsonl", "session.json"}
    assert list(tmp_path.glob("*.part")) == []


async def test_without_images_it_is_the_telemetry_compressed(tmp_path):
    session, path = await exported(tmp_path, frames=False)
    messages, summary, _, _ = found(path)
    assert messages == keys(telemetry(session))
    assert {chunk.compression for chunk in summary.chunk_indexes} == {"zstd"}


async def test_without_telemetry_it_is_the_images(tmp_path):
    session, path = await exported(tmp_path, telemetry=False)
    assert frames_of(found(path)[0]) == images(session)


async def test_of_a_damaged_session_nothing_appears(tmp_path):
    session, path = await exported(tmp_path)
    path.unlink()
    segment = session.frame_segments[0]
    data = bytearray(segment.read_bytes())
    data[len(data) // 2] ^= 1
    segment.write_bytes(data)
    with pytest.raises(SessionError):
        export_mcap(Session.open(session.path), path, report=silent)
    assert sorted(each.name for each in tmp_path.iterdir()) == ["s"]


async def test_existing_files_are_not_overwritten(tmp_path):
    session, path = await exported(tmp_path)
    with pytest.raises(SessionError, match="is in the way"):
        export_mcap(session, path, report=silent)
