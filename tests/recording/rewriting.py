"""Segments as other programs write them: with mcap's own Writer, in all the forms that the format allows."""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from mcap.reader import make_reader
from mcap.writer import CompressionType, IndexType, Writer

TOOL = "other-tool 2.1"


@dataclass(frozen=True)
class Form:
    """writer: arguments of mcap's Writer. texts_last: attachments and metadata stand behind the messages, as tools that
    copy messages first write them. by_time: in order of log time. keep: which messages (topic, message)."""

    writer: dict[str, Any] = field(default_factory=dict)
    texts_last: bool = False
    by_time: bool = False
    keep: Callable[[str, Any], bool] = lambda topic, message: True
    change: Callable[[str, bytes], bytes] = lambda topic, data: data


NO_INDEX = {"index_types": IndexType.NONE, "use_statistics": False, "use_summary_offsets": False}
NO_SUMMARY = {**NO_INDEX, "repeat_channels": False, "repeat_schemas": False}
FORMS = {
    "zstd": Form({"compression": CompressionType.ZSTD}),
    "lz4": Form({"compression": CompressionType.LZ4}),
    "not compressed": Form({"compression": CompressionType.NONE, "chunk_size": 700}),
    "one large chunk": Form({"chunk_size": 1 << 30}),
    "unchunked": Form({"use_chunking": False}),
    "without CRCs": Form({"enable_crcs": False}),
    "with a CRC of the data": Form({"enable_data_crcs": True}),
    "without index": Form(NO_INDEX),
    "unchunked, without any summary or CRC": Form({**NO_SUMMARY, "use_chunking": False, "enable_crcs": False}),
    "lz4, one chunk, no CRC, no summary": Form(
        {**NO_SUMMARY, "compression": CompressionType.LZ4, "chunk_size": 1 << 30, "enable_crcs": False}
    ),
    "texts behind the messages, by time": Form(texts_last=True, by_time=True),
}


def rewrite(path: Path, form: Form = FORMS["zstd"], library: str = TOOL) -> None:
    """The segment, written again by another program."""
    with path.open("rb") as file:
        reader = make_reader(file)
        attachments, metadata = list(reader.iter_attachments()), list(reader.iter_metadata())
        found = list(reader.iter_messages(log_time_order=form.by_time))
    new = path.with_suffix(".new")
    with new.open("wb") as file:
        writer = Writer(file, **form.writer)
        writer.start(library=library)
        if not form.texts_last:
            _write_texts(writer, attachments, metadata)
        schemas, channels = {}, {}
        for schema, channel, message in found:
            if not form.keep(channel.topic, message):
                continue
            if channel.id not in channels:
                if schema.id not in schemas:
                    schemas[schema.id] = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.id] = writer.register_channel(
                    channel.topic, channel.message_encoding, schemas[schema.id], channel.metadata
                )
            data = form.change(channel.topic, message.data)
            writer.add_message(channels[channel.id], message.log_time, data, message.publish_time, message.sequence)
        if form.texts_last:
            _write_texts(writer, attachments, metadata)
        writer.finish()
    new.replace(path)


def _write_texts(writer, attachments, metadata):
    for one in attachments:
        writer.add_attachment(one.create_time, one.log_time, one.name, one.media_type, one.data)
    for one in metadata:
        writer.add_metadata(one.name, one.metadata)


def rewrite_all(session: Path, form: Form = FORMS["zstd"]) -> None:
    """Every segment of a session."""
    for path in sorted(session.glob("*/*.mcap")):
        rewrite(path, form)
