"""Segments of which is known which bytes hold which messages, and ways to damage them."""

import shutil
import struct
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from mcap.reader import make_reader
from mcap.writer import CompressionType

from tests.recording.device_declarations import form as declared_form
from tests.recording.frame_records import CAMERA_TOPICS, make_frame_records
from thermostand.foundation.clock import NS_PER_S
from thermostand.foundation.items import Batch, Event
from thermostand.foundation.readings import Frame, Reading
from thermostand.recording.format import messages
from thermostand.recording.format.images import name_frame_topics
from thermostand.recording.format.journal_lines import hash_text
from thermostand.recording.format.layout import FORMAT, FRAMES, TELEMETRY
from thermostand.recording.format.manifest import MANIFEST_NAME, Manifest, read_manifest
from thermostand.recording.format.records import list_frame_places, read_frame, read_telemetry_messages
from thermostand.recording.writing.manifest_file import complete_manifest
from thermostand.recording.writing.segment import MessageRecord, SeriesSpec, Topic
from thermostand.recording.writing.series import Series
from thermostand.recording.writing.session_spec import make_readings_topic

START_NS = 1_767_290_400 * NS_PER_S
METADATA = {"format": str(FORMAT), "session_id": "cycle-1", "operator": "Zoë"}
ATTACHMENTS = {"config.yaml": "camera: {gain_dB: 0.0}\n" * 20, "recipe.yaml": "name: cycle\n"}
ENCODER = declared_form("thermometers")
TOPICS = {
    TELEMETRY: (
        make_readings_topic(ENCODER),
        Topic(messages.EVENT, messages.CLASSES[messages.EVENT]),
    ),
    FRAMES: CAMERA_TOPICS,
}
COMPRESSION = {TELEMETRY: CompressionType.ZSTD, FRAMES: CompressionType.ZSTD}


def form(series, metadata=METADATA, attachments=ATTACHMENTS, topics=None, segment_bytes=1 << 40):
    topics = TOPICS[series] if topics is None else topics
    return SeriesSpec(series, topics, COMPRESSION[series], metadata, attachments, segment_bytes, 1 << 60)


def frame(index):
    image = np.random.default_rng(index).integers(0, 255, (40, 60), np.uint8)
    return Frame("camera.image", image, START_NS + index * NS_PER_S, 0.1, 0.0, 41.0, index, 7 * index)


def telemetry_of(index):
    time_ns = START_NS + index * NS_PER_S
    air = Reading("thermometers.air", 20 + index / 2, "degC", time_ns)
    yield MessageRecord(ENCODER.topic, time_ns, ENCODER.encode(Batch("thermometers", time_ns, (air,))))
    for event in range(index % 3):  # alike, so that they compress
        yield MessageRecord(
            messages.EVENT, time_ns, messages.encode_event(Event(time_ns, "info", "note", f"{event} " * 40))
        )


def frame_of(index):
    yield from make_frame_records(frame(index))


RECORDS_OF = {TELEMETRY: telemetry_of, FRAMES: frame_of}


@dataclass(frozen=True)
class Block:
    """Bytes [begin, end) of a file are the chunk with these messages."""

    begin: int
    end: int
    messages: tuple[MessageRecord, ...]


@dataclass(frozen=True)
class Written:
    """A segment as it was written: `data` up to the end of the last commit, or finished."""

    series: str
    data: bytes
    blocks: tuple[Block, ...]

    @property
    def opening_bytes(self):
        return self.blocks[0].begin

    @property
    def messages(self):
        return [message for block in self.blocks for message in block.messages]

    def untouched(self, damaged):
        """The messages of the chunks that are in `damaged` as they were."""
        whole = (
            block for block in self.blocks if damaged[block.begin : block.end] == self.data[block.begin : block.end]
        )
        return [message for block in whole for message in block.messages]


def write_segment(folder, series, indices, finish=False, **changes):
    """A segment with a commit per index, as a killed recorder leaves it, or finished."""
    folder.mkdir(parents=True, exist_ok=True)
    recording = Series(folder, form(series, **changes))
    recording.open(0)
    (part,) = folder.glob("*.mcap.part")
    blocks = []
    for index in indices:
        begin = part.stat().st_size
        records = tuple(RECORDS_OF[series](index))
        recording.commit(records, 0)
        with part.open("rb") as file:
            file.seek(begin)
            (length,) = struct.unpack("<xQ", file.read(9))
        blocks.append(Block(begin, begin + 9 + length, records))
    data = part.read_bytes()
    recording.finish()
    finished = folder / part.name.removesuffix(".part")
    if not finish:
        finished.unlink()
        part.write_bytes(data)
    list_segments(folder.parent, changes)
    return Written(series, finished.read_bytes() if finish else data, tuple(blocks))


def list_segments(directory, changes):
    """The session's manifest, as its recorder would have begun it, with the finished segments."""
    texts = {name: hash_text(text) for name, text in changes.get("attachments", ATTACHMENTS).items()}
    if not (directory / MANIFEST_NAME).exists():
        begun = Manifest(changes.get("metadata", METADATA), texts=texts)
        (directory / MANIFEST_NAME).write_bytes(begun.encode())
    complete_manifest(directory)


def unlist(path):
    """Take a segment out of its session's manifest, as when its recorder was killed before it was finished."""
    directory = path.parent.parent
    listed = read_manifest(directory)
    segments = {name: each for name, each in listed.segments.items() if name != f"{path.parent.name}/{path.name[:9]}"}
    (directory / MANIFEST_NAME).write_bytes(replace(listed, segments=segments, ended=False).encode())


def read_segment(path):
    """The messages of a finished segment, read strictly."""
    if path.parent.name == FRAMES:
        return [record for place in list_frame_places(path) for record in records_at(place)]
    read = list(read_telemetry_messages(path, lambda channel: True))
    return [MessageRecord(message.topic, message.time_ns, message.data, message.sequence) for message in read]


def records_at(place):
    """The two messages of a recorded frame."""
    topics, frame, stamps = (
        name_frame_topics(place.meta.channel),
        read_frame(place),
        (place.sequence, place.meta.published_ns),
    )
    yield MessageRecord(topics.meta, place.time_ns, frame.meta, *stamps)
    yield MessageRecord(topics.image, place.time_ns, bytes(frame.image), *stamps)


def names(directory: Path):
    """Every file below `directory`."""
    return sorted(str(path.relative_to(directory)) for path in directory.rglob("*") if path.is_file())


def truncate(data, offset, _rng):
    return data[:offset]


def zero_tail(data, offset, _rng):
    return data[:offset] + bytes(len(data) - offset)


def overwrite_tail(data, offset, rng):
    return data[:offset] + rng.randbytes(len(data) - offset)


def zero_block(data, offset, _rng):
    end = min(len(data), offset + 4096)
    return data[:offset] + bytes(end - offset) + data[end:]


DAMAGES = (truncate, zero_tail, overwrite_tail, zero_block)


def copy_session(source, target):
    """A copy of the session `source` in place of whatever is at `target`."""
    shutil.rmtree(target, ignore_errors=True)
    return shutil.copytree(source, target)


def hole(begin, end):
    return lambda data: data[:begin] + bytes(end - begin) + data[end:]


def metadata_of(path, name):
    with path.open("rb") as file:
        return next(record.metadata for record in make_reader(file).iter_metadata() if record.name == name)
