"""A session as one MCAP file, for viewers that take one: the same messages, in order of time."""

from __future__ import annotations

import heapq
import os
from collections.abc import Callable, Iterator
from operator import attrgetter
from pathlib import Path

from mcap.well_known import MessageEncoding
from mcap.writer import CompressionType, Writer
from mcap_protobuf.schema import register_schema

from thermostand.foundation.errors import SessionError
from thermostand.foundation.files import make_durable_folder, name_part, sync_folder
from thermostand.recording.exporting.state import describe_state
from thermostand.recording.exporting.topics import iterate_recorded_messages, list_topics
from thermostand.recording.format.images import name_frame_topics
from thermostand.recording.format.journal_lines import JOURNAL_NAME
from thermostand.recording.format.layout import SEQUENCE_MASK, SESSION_METADATA
from thermostand.recording.format.manifest import MANIFEST_NAME
from thermostand.recording.format.mcap_contents import EXPORT_LIBRARY
from thermostand.recording.format.records import RecordedMessage
from thermostand.recording.reading.notes import NOTES_NAME
from thermostand.recording.reading.session import Session
from thermostand.recording.writing.segment import Topic
from thermostand.recording.writing.session_spec import make_frames_topic

# With them `stand session import` makes the same session again.
_FILES = {
    JOURNAL_NAME: "application/jsonl",
    NOTES_NAME: "application/jsonl",
    MANIFEST_NAME: "application/json",
}
_CHUNK_BYTES = 1 << 22  # round number; nothing was measured


def export_mcap(
    session: Session,
    out: Path,
    *,
    frames: bool = True,
    telemetry: bool = True,
    report: Callable[[float, str], None],
) -> None:
    """Write `session` as the file `out`, which must not exist; memory stays flat. Everything is compressed.

    `report` gets the share of the messages that is done (0 to 1). SessionError when the session cannot be read or `out`
    not be written; `out` then does not appear.
    """
    part = name_part(out)
    try:
        make_durable_folder(out.parent)
        with part.open("wb") as file:
            writer = Writer(file, _CHUNK_BYTES, CompressionType.ZSTD)
            _write(session, writer, _merge_messages(session, frames, telemetry), report)
            file.flush()
            os.fsync(file.fileno())
        part.rename(out)
        sync_folder(out.parent)
    except OSError as error:
        raise SessionError(f"{out}: cannot be written ({error})") from error
    finally:
        part.unlink(missing_ok=True)


def _write(
    session: Session,
    writer: Writer,
    found: Iterator[RecordedMessage],
    report: Callable[[float, str], None],
) -> None:
    writer.start(library=EXPORT_LIBRARY)
    for name, text in session.attachments.items():
        writer.add_attachment(0, 0, name, "application/yaml" if name.endswith(".yaml") else "text/plain", text.encode())
    for name, media_type in _FILES.items():
        path = session.path / name
        if path.is_file() and not path.is_symlink():
            writer.add_attachment(0, 0, name, media_type, path.read_bytes())
    writer.add_metadata(SESSION_METADATA, session.metadata)
    state = describe_state(session)
    writer.add_metadata("export", {"files": state.files, "findings": "\n".join(state.findings)})
    topics = {topic.name: topic for topic in list_topics(session)}
    channels: dict[str, int] = {}
    times = session.frame_times_ns
    begin_ns, end_ns = (int(times[0]), int(times[-1])) if len(times) else (0, 0)
    for message in found:
        topic = message.topic
        if topic not in channels:
            channels[topic] = _register_channel(writer, topics.get(topic) or make_frames_topic(topic))
        published_ns = message.published_ns or message.time_ns
        writer.add_message(channels[topic], message.time_ns, message.data, published_ns, message.sequence)
        if end_ns > begin_ns:
            report(min(1.0, max(0.0, (message.time_ns - begin_ns) / (end_ns - begin_ns))), "messages")
    writer.finish()


def _register_channel(writer: Writer, topic: Topic) -> int:
    schema = register_schema(writer, topic.message)
    return writer.register_channel(topic.name, MessageEncoding.Protobuf, schema, {**topic.metadata})


def _merge_messages(session: Session, frames: bool, telemetry: bool) -> Iterator[RecordedMessage]:
    """Merge the messages in order of time, as far as each series is in order."""
    of_telemetry = iterate_recorded_messages(session) if telemetry else iter(())
    of_frames = _iterate_frame_messages(session) if frames else iter(())
    return heapq.merge(of_telemetry, of_frames, key=attrgetter("time_ns"))


def _iterate_frame_messages(session: Session) -> Iterator[RecordedMessage]:
    for image in session.images():
        topics, meta = name_frame_topics(image.meta.channel), image.meta
        for topic, data in ((topics.meta, image.description), (topics.image, bytes(image.data))):
            yield RecordedMessage(
                topic, meta.block_id & SEQUENCE_MASK, image.time_ns, data, published_ns=meta.published_ns
            )
