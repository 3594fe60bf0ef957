"""A finished segment of many small chunks, written anew with large ones: a reader pays for every chunk.

Telemetry is committed each second, so ten minutes are 600 chunks of a few messages each. The copy has the same header,
attachments, metadata, schemas, channels and messages in the same order, and the same input gives the same bytes. It is
made under a temporary name, which counts for nothing when it is found later, and is on the disk before it gets its own.
"""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path

from mcap.records import Attachment, Channel, DataEnd, McapRecord, Message, Metadata, Schema
from mcap.stream_reader import StreamReader
from mcap.writer import CompressionType, Writer

from foundation.sink import CommitSink, sync_folder
from recording.format.layout import FINISHED, TEMPORARY
from recording.writing.block import Block, chunk_writer


def merge_chunks(source: Path, target: Path, compression: CompressionType) -> None:
    """Copy the complete segment `source` to `target`, durably; one chunk is in memory at a time.

    On an error the temporary file is removed and `source` is as it was; OSError from the disk, others when the source
    does not read as it was written.
    """
    temporary = target.with_name(target.name.removesuffix(FINISHED) + TEMPORARY)
    sink = CommitSink(temporary)
    try:
        _copy(source, sink, compression)
        sink.settle()
        os.replace(temporary, target)
    except BaseException:
        with suppress(OSError):
            temporary.unlink()
        raise
    finally:
        sink.close()
    sync_folder(target.parent)


def _copy(source: Path, sink: CommitSink, compression: CompressionType) -> None:
    block = Block()
    writer = chunk_writer(block, compression)
    writer.start()
    with source.open("rb") as file:
        for record in StreamReader(file, validate_crcs=True, record_size_limit=source.stat().st_size).records:
            if isinstance(record, DataEnd):  # behind it is the index
                break
            _add(writer, record)
            if parts := block.take():
                sink.append(parts)
    writer.finish()
    sink.append(block.take())


def _add(writer: Writer, record: McapRecord) -> None:
    """One record of the source; schemas and channels get the numbers they had, because their order is the same."""
    match record:
        case Message():
            writer.add_message(record.channel_id, record.log_time, record.data, record.publish_time, record.sequence)
        case Channel():
            writer.register_channel(record.topic, record.message_encoding, record.schema_id, record.metadata)
        case Schema():
            writer.register_schema(record.name, record.encoding, record.data)
        case Metadata():
            writer.add_metadata(record.name, record.metadata)
        case Attachment():
            writer.add_attachment(record.create_time, record.log_time, record.name, record.media_type, record.data)
        case _:  # the header is the Writer's own, and so are the message indexes
            pass
