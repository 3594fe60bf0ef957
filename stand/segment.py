"""One series of a session on the disk: a folder of MCAP segments, each written so that what is acknowledged survives.

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
import re
from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from google.protobuf.message import Message
from mcap.well_known import MessageEncoding
from mcap.writer import CompressionType, Writer
from mcap_protobuf.schema import register_schema

FRAMES = "frames"
TELEMETRY = "telemetry"
FINISHED = ".mcap"
UNFINISHED = ".mcap.part"
SESSION_METADATA = "session"
SEGMENT_METADATA = "segment"
DEVICES = "devices"  # key of a channel's metadata: the names of the devices on its topic, with commas between

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


class CommitSink:
    """A new file that grows by whole blocks; a block is on the disk when `append` returns."""

    def __init__(self, path: Path) -> None:
        self._fd = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o644)
        self.committed_bytes = 0

    def append(self, block: bytes) -> None:
        """Write and sync; on OSError the file is cut back to the blocks before and the error raised."""
        try:
            rest = memoryview(block)
            while rest:  # a nearly full disk takes a part of the block before it refuses
                rest = rest[os.pwrite(self._fd, rest, self.committed_bytes + len(block) - len(rest)) :]
            os.fdatasync(self._fd)
        except OSError:
            with suppress(OSError):
                os.ftruncate(self._fd, self.committed_bytes)
            raise
        self.committed_bytes += len(block)

    def close(self) -> None:
        """Sync size and times, too, and close; raises OSError, also when it is closed already."""
        fd, self._fd = self._fd, -1  # the number may belong to another file by the next call
        try:
            os.fsync(fd)
        finally:
            os.close(fd)


def sync_folder(folder: Path) -> None:
    """Make the folder's names durable."""
    fd = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        os.fsync(fd)
    finally:
        os.close(fd)


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


class Series:
    """The segments of one folder, one open at a time. Blocking; used from one thread."""

    def __init__(self, folder: Path, form: SeriesForm) -> None:
        self._folder = folder
        self._form = form
        self._segment: Segment | None = None
        self.troubles: deque[str] = deque()  # errors that were overcome, as sentences; another thread may take them

    def open(self, time_ns: int) -> Segment:
        """The open segment, begun when there is none; raises OSError."""
        if self._segment is None:
            self._segment = Segment(self._folder, next_number(self._folder), self._form, time_ns)
        return self._segment

    def commit(self, records: Sequence[Record], time_ns: int) -> None:
        """All of `records` on the disk when this returns, in a new segment when the present one is full or fails;
        OSError when the new one fails, too. `time_ns` (now) decides whether a segment is old enough to be closed."""
        if self._is_full(time_ns):
            self.finish()
        try:
            self._commit(records, time_ns)
        except OSError as error:
            self.troubles.append(f"a segment of {self._form.name} was given up ({error}); the next one was begun")
            self._commit(records, time_ns)

    def _commit(self, records: Sequence[Record], time_ns: int) -> None:
        segment = self.open(time_ns)
        try:
            segment.commit(records)
        except OSError:
            segment.abandon()
            self._segment = None
            raise

    def _is_full(self, time_ns: int) -> bool:
        segment = self._segment
        return segment is not None and (
            segment.committed_bytes >= self._form.segment_bytes or time_ns - segment.begun_ns >= self._form.segment_ns
        )

    def finish(self) -> bool:
        """Close the open segment, if any; False when it cannot be finished: it stays `.part`, and that is a trouble."""
        segment, self._segment = self._segment, None
        if segment is None:
            return True
        try:
            segment.finish()
        except OSError as error:
            segment.abandon()
            self.troubles.append(f"a segment of {self._form.name} stays unfinished ({error})")
            return False
        return True


def next_number(folder: Path) -> int:
    """The number after the highest segment in `folder`, finished or not; 0 in an empty one."""
    numbers = [
        int(match[1]) for path in folder.iterdir() if (match := re.fullmatch(r"(\d{4,})\.mcap(\.part)?", path.name))
    ]
    return max(numbers, default=-1) + 1
