"""Whether the bytes of one record prove that they are what the writer wrote.

A chunk and an attachment prove themselves by their CRC (our writer always makes one, so a CRC of 0 is a CRC), the
records without one by being, byte for byte, what the writer makes of what they say; a message index by its chunk.
"""

from __future__ import annotations

from collections import Counter
from typing import NamedTuple

from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, DataEnd, Header, MessageIndex, Metadata, Schema

from thermostand.recording.format.mcap_bytes import (
    MESSAGE,
    MESSAGE_INDEX,
    MESSAGE_INDEX_ENTRY,
    RECORD,
    RECORD_LIMIT_BYTES,
    bytes_of,
    check_attachment,
    chunk_content,
    records,
    stream,
)


class Contents(NamedTuple):
    """What a chunk holds. places: log time and offset of each message, by channel."""

    schemas: list[Schema]
    channels: list[Channel]
    messages: Counter[int]
    places: dict[int, list[tuple[int, int]]]

    def indexes(self) -> set[bytes]:
        """What the message indexes behind the chunk say."""
        return {bytes_of(MessageIndex(*each))[RECORD.size :] for each in self.places.items()}


class Claim(NamedTuple):
    """What a record's head says; the length is that of its content."""

    opcode: int
    length: int


def claim_of(head: bytes) -> Claim | None:
    """What a record's head says it is; None when that is no record of the data section."""
    if len(head) < RECORD.size:
        return None
    opcode, length = RECORD.unpack_from(head)
    return Claim(opcode, length) if opcode in OPCODES and length <= RECORD_LIMIT_BYTES else None


_EXACT: dict[int, type[Header | Metadata | DataEnd]] = {
    Opcode.HEADER: Header,
    Opcode.METADATA: Metadata,
    Opcode.DATA_END: DataEnd,
}
OPCODES = {*_EXACT, Opcode.CHUNK, Opcode.MESSAGE_INDEX, Opcode.ATTACHMENT}


def proven(opcode: int, content: bytes) -> Contents | Metadata | Attachment | DataEnd | None:
    """What the record says; one of DAMAGE when it does not prove itself."""
    if opcode == Opcode.CHUNK:
        _, data = chunk_content(memoryview(content))
        return _contents(data)
    if opcode == Opcode.ATTACHMENT:
        check_attachment(content)
        return Attachment.read(stream(content))
    if opcode == Opcode.MESSAGE_INDEX:
        _, entries_bytes = MESSAGE_INDEX.unpack_from(content)
        if len(content) != MESSAGE_INDEX.size + entries_bytes or entries_bytes % MESSAGE_INDEX_ENTRY.size:
            raise ValueError("a message index is damaged")
        return None
    record = _EXACT[opcode].read(stream(content))
    if bytes_of(record)[RECORD.size :] != content or not _is_text(record):
        raise ValueError("a record is damaged")
    return None if isinstance(record, Header) else record


def _is_text(record: Header | Metadata | DataEnd) -> bool:
    """No text has a NUL; a lost block of the disk reads as zeros."""
    if isinstance(record, Metadata):
        texts = [record.name, *record.metadata.keys(), *record.metadata.values()]
        return not any("\0" in text for text in texts)
    return True


def _contents(data: memoryview) -> Contents:
    contents, offset = Contents([], [], Counter(), {}), 0
    for opcode, record in records(data):
        if opcode == Opcode.MESSAGE:
            channel, _, time_ns, _ = MESSAGE.unpack_from(record)
            contents.messages[channel] += 1
            contents.places.setdefault(channel, []).append((time_ns, offset))
        elif opcode == Opcode.SCHEMA:
            contents.schemas.append(Schema.read(stream(record)))
        elif opcode == Opcode.CHANNEL:
            contents.channels.append(Channel.read(stream(record)))
        else:
            raise ValueError(f"a chunk holds a record of kind {opcode}")
        offset += RECORD.size + len(record)
    return contents
