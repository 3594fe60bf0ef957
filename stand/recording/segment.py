"""One MCAP segment of a series (frames or telemetry) of a session, written so that what is acknowledged survives.

`NNNN.mcap.part` grows by whole blocks of records: one pwrite, one fdatasync, then it is acknowledged. A finished
segment gets its index, is synced and renamed to `NNNN.mcap`. Metadata (`session`, `segment`) and attachments are the
first records of every segment, so each is readable alone. Chunks have a CRC; a commit ends the chunk, so the frames
series has one frame per chunk and the chunk index is its frame index.

After any OSError the file is cut back to its last whole block and left as `.part`; its Writer is never used again,
because its index would name chunks that were not written.
"""

from __future__ import annotations

import io
import os
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from google.protobuf.message import Message
from mcap.well_known import MessageEncoding
from mcap.writer import CompressionType, Writer
from mcap_protobuf.schema import register_schema

from stand.recording.layout import DEVICES, FINISHED, SEGMENT_METADATA, SESSION_METADATA, UNFINISHED
from stand.recording.sink import CommitSink, sync_folder

CHUNK_BYTES = 1024 * 1024


class Record(NamedTuple):
    """One encoded message; log and publish time are both `time_ns`."""

    topic: str
    time_ns: int
    data: bytes
    sequence: int = 0


@dataclass(frozen=True, slots=True)
class Topic:
    """A topic of a series, the class of its messages and the devices that publish on it."""

    name: str
    message: type[Message]
    devices: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class SeriesForm:
    """What every segment of a series has in common."""

    name: str
    topics: tuple[Topic, ...]
    compression: CompressionType
    session: Mapping[str, str]
    attachments: Mapping[str, str]
    segment_bytes: int
    segment_ns: int


class _Block(io.BytesIO):
    """What the Writer has written since the last commit; `tell` is the place in the file."""

    def __init__(self) -> None:
        super().__init__()
        self._taken_bytes = 0

    def tell(self) -> int:
        return self._taken_bytes + super().tell()

    def take(self) -> bytes:
        """The bytes so far; the next ones begin a new block."""
        block = self.getvalue()
        self._taken_bytes += len(block)
        self.seek(0)
        self.truncate()
        return block


class Segment:
    """One file of a series, from creation to finish; after an OSError of any method only `abandon` is left."""

    def __init__(self, folder: Path, number: int, form: SeriesForm, time_ns: int) -> None:
        self.begun_ns = time_ns
        self._part = folder / f"{number:04d}{UNFINISHED}"
        self._finished = folder / f"{number:04d}{FINISHED}"
        self._block = _Block()
        self._writer = Writer(self._block, chunk_size=CHUNK_BYTES, compression=form.compression)
        self._sink = CommitSink(self._part)
        self._opening_bytes = 0  # what stands before the first message
        try:
            sync_folder(folder)
            self._channels = self._begin(form, number)
            self._sink.append(self._block.take())
        except OSError:
            self.abandon()
            raise
        self._opening_bytes = self._sink.committed_bytes

    def _begin(self, form: SeriesForm, number: int) -> dict[str, int]:
        """Header, attachments, metadata; schemas and channels go into the first chunk. Returns topic -> channel id."""
        self._writer.start()
        for name, text in form.attachments.items():
            media_type = "application/yaml" if name.endswith(".yaml") else "text/plain"
            self._writer.add_attachment(0, self.begun_ns, name, media_type, text.encode())
        previous = f"{number - 1:04d}" if number else ""
        self._writer.add_metadata(SESSION_METADATA, dict(form.session))
        self._writer.add_metadata(
            SEGMENT_METADATA, {"series": form.name, "number": f"{number:04d}", "previous": previous}
        )
        return {topic.name: self._register(topic) for topic in form.topics}

    def _register(self, topic: Topic) -> int:
        schema = register_schema(self._writer, topic.message)
        devices = {DEVICES: ",".join(topic.devices)} if topic.devices else {}
        return self._writer.register_channel(topic.name, MessageEncoding.Protobuf, schema, devices)

    def commit(self, records: Iterable[Record]) -> None:
        """All of `records` on the disk when this returns."""
        for record in records:
            self._writer.add_message(
                self._channels[record.topic], record.time_ns, record.data, record.time_ns, record.sequence
            )
        self._writer.flush()
        self._sink.append(self._block.take())

    @property
    def committed_bytes(self) -> int:
        """Size of the file."""
        return self._sink.committed_bytes

    def finish(self) -> None:
        """Index, sync, rename: the segment is complete and stays so."""
        self._writer.finish()
        self._sink.append(self._block.take())
        self._sink.close()
        os.replace(self._part, self._finished)
        sync_folder(self._part.parent)

    def abandon(self) -> None:
        """Let go after an error: what was committed stays as `.part`; a file without a message is removed."""
        with suppress(OSError):
            self._sink.close()
        if self._sink.committed_bytes <= self._opening_bytes:
            with suppress(OSError):
                self._part.unlink()
