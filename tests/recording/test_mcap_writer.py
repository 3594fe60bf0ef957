"""What our writer of MCAP records writes is what mcap's own writes, byte for byte."""

import io

import pytest
from mcap.reader import make_reader
from mcap.records import Attachment
from mcap.writer import CompressionType, Writer

from thermostand.recording.format.mcap_contents import LIBRARY
from thermostand.recording.writing.mcap_writer import McapWriter

CHUNK_BYTES = 1000
MESSAGES = [
    (1, 50, b"a" * 400),
    (2, 40, b""),  # earlier than the one before
    (1, 60, b"b" * 590),  # ends a chunk by its size
    None,  # ends none: nothing was added
    (2, 0, bytes(5000)),
    (1, 70, b"c"),
    None,
    (2, 80, b"d" * 30),
]


def by_mcap(compression, messages):
    stream = io.BytesIO()
    writer = Writer(stream, CHUNK_BYTES, compression)
    writer.start(library=LIBRARY)
    writer.add_attachment(5, 6, "config.yaml", "application/yaml", b"a: 1")
    writer.add_metadata("session", {"id": "x", "host": "y"})
    for number in (1, 2):
        schema = writer.register_schema(f"schema-{number}", "protobuf", bytes(700 * number))
        writer.register_channel(f"/topic/{number}", "protobuf", schema, {"devices": "a"})
    for sequence, message in enumerate(messages):
        if message is None:
            writer.flush()
        else:
            channel, time_ns, data = message
            writer.add_message(channel, time_ns, data, time_ns + 1, sequence)
    writer.finish()
    return stream.getvalue()


def by_ours(compression, messages):
    writer, blocks = McapWriter(compression, CHUNK_BYTES), []
    writer.add_attachment(Attachment(5, 6, "config.yaml", "application/yaml", b"a: 1"))
    writer.add_metadata("session", {"id": "x", "host": "y"})
    for number in (1, 2):
        schema = writer.add_schema(f"schema-{number}", "protobuf", bytes(700 * number))
        writer.add_channel(f"/topic/{number}", "protobuf", schema, {"devices": "a"})
    for sequence, message in enumerate(messages):
        if message is None:
            writer.end_chunk()
        else:
            channel, time_ns, data = message
            writer.add_message(channel, time_ns, time_ns + 1, sequence, data)
        blocks += writer.take()
    writer.finish()
    return b"".join(blocks + writer.take())


@pytest.mark.parametrize("compression", [CompressionType.NONE, CompressionType.ZSTD])
@pytest.mark.parametrize("messages", [MESSAGES, MESSAGES[:1], []])
def test_a_file_is_that_of_mcaps_own_writer(compression, messages):
    written = by_ours(compression, messages)
    assert written == by_mcap(compression, messages)
    read = make_reader(io.BytesIO(written), validate_crcs=True).iter_messages(log_time_order=False)
    assert [(message.channel_id, message.log_time, message.data) for _, _, message in read] == [
        message for message in messages if message is not None
    ]


def test_a_message_is_handed_over_as_the_object_it_is():
    writer = McapWriter(CompressionType.NONE, CHUNK_BYTES)
    data = bytes(5000)
    writer.add_channel("/topic", "protobuf", 0, {})
    writer.add_message(1, 1, 1, 1, data)
    assert any(part is data for part in writer.take())
