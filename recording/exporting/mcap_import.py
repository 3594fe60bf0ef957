"""A session of one MCAP file: of one that `stand session export --format mcap` has written, also after another program
has rewritten it, or merged it of the segments."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path

from mcap.writer import CompressionType

from thermostand.foundation.errors import SessionError
from thermostand.foundation.files import create_folder, replace_file
from thermostand.recording.exporting.trim import commit, finish, open_series, split_into_blocks
from thermostand.recording.format import messages
from thermostand.recording.format.damage import FileDamaged, convert_damage
from thermostand.recording.format.images import IMAGE_SCHEMA, META_SCHEMA, ZSTD_LEVEL
from thermostand.recording.format.journal_lines import JOURNAL_NAME
from thermostand.recording.format.layout import FRAME_TABLE, FRAMES, SESSION_METADATA, TELEMETRY
from thermostand.recording.format.manifest import MANIFEST_NAME, Manifest, Sealed, read_manifest
from thermostand.recording.format.mcap_contents import McapContents, format_digest, read_contents
from thermostand.recording.format.records import (
    FramePlace,
    explain_stranger,
    find_batch_schema,
    iterate_rewritten,
    list_rewritten_frames,
    read_frame,
)
from thermostand.recording.reading.notes import NOTES_NAME
from thermostand.recording.writing.manifest_file import write_manifest
from thermostand.recording.writing.segment import MessageRecord, Topic
from thermostand.recording.writing.session_spec import make_frames_topic, make_readings_topic

_FILES = (JOURNAL_NAME, NOTES_NAME, MANIFEST_NAME)  # which are attached by an export, and lie next to the segments


def import_mcap(path: Path, out: Path, report: Callable[[float, str], None]) -> Path:
    """Make the session `out`, which must not exist, of what is in the MCAP file at `path`; return `out`.

    Messages, metadata, attachments, journal and notes are as they are in the file. `report` gets the share that is done
    (0 to 1).

    Raises
    ------
    SessionError
        When the file is no recording, is damaged, or `out` cannot be written; `out` then does not appear.
    """
    try:
        with convert_damage(path):
            found = read_contents(path)
            if SESSION_METADATA not in found.metadata:
                raise SessionError(f"{path}: {explain_stranger(found)}")
            frames, topics = list_rewritten_frames(found), _list_topics(found)
            texts = {
                name: each.data.decode()
                for name, each in found.attachments.items()
                if name not in (*_FILES, FRAME_TABLE)
            }
    except FileDamaged as error:
        raise SessionError(f"{error}; `mcap recover`, of the format's own tools, recovers what is sound") from error
    sealed: dict[str, Sealed] = {}
    session = found.metadata[SESSION_METADATA]
    with create_folder(out) as folder:
        series = open_series(
            texts, session, folder / TELEMETRY, topics[TELEMETRY], CompressionType.ZSTD, seal=sealed.__setitem__
        )
        for block in split_into_blocks(_iterate_telemetry(found)):
            commit(series, block, block[-1].time_ns)
        finish(series)
        if frames:
            series = open_series(
                texts, session, folder / FRAMES, topics[FRAMES], CompressionType.ZSTD, ZSTD_LEVEL, sealed.__setitem__
            )
            for number, place in enumerate(frames, 1):
                commit(series, make_records(found, place), place.time_ns)
                report(number / len(frames), f"frame {number} of {len(frames)}")
            finish(series)
        for name in _FILES:
            if name in found.attachments:
                replace_file(folder / name, found.attachments[name].data)
        _write_manifest(folder, sealed)
    return out


def _list_topics(found: McapContents) -> dict[str, tuple[Topic, ...]]:
    """List the topics of the two series; SessionError for one that no recording has."""
    topics: dict[str, dict[str, Topic]] = {TELEMETRY: {}, FRAMES: {}}
    for number, channel in found.channels.items():
        form = find_batch_schema(channel)
        if found.get_schema(number) in (META_SCHEMA, IMAGE_SCHEMA):
            series, topic = FRAMES, make_frames_topic(channel.topic)
        elif form is not None or channel.topic in messages.CLASSES:
            series = TELEMETRY
            topic = make_readings_topic(form) if form else Topic(channel.topic, messages.CLASSES[channel.topic])
        else:
            raise SessionError(f"{found.path}: its topic {channel.topic} is of no recording; write the file without it")
        if topics[series].setdefault(channel.topic, topic).metadata != topic.metadata:
            raise SessionError(f"{found.path}: {channel.topic} is declared twice, in two ways")
    return {series: tuple(each.values()) for series, each in topics.items()}


def _iterate_telemetry(found: McapContents) -> Iterator[MessageRecord]:
    for message in iterate_rewritten(found, lambda channel: True):
        yield MessageRecord(message.topic, message.time_ns, message.data, message.sequence)


def make_records(found: McapContents, place: FramePlace) -> list[MessageRecord]:
    """The two messages of a frame, as they are committed together."""
    stored = read_frame(place)
    stamps = place.sequence, place.meta.published_ns
    topics = (found.channels[number].topic for number in place.chunk.channels)
    return [MessageRecord(topic, place.time_ns, data, *stamps) for topic, data in zip(topics, stored, strict=True)]


def _write_manifest(folder: Path, sealed: dict[str, Sealed]) -> None:
    """The manifest of the session with its new segments. That nothing is missing is known when these have the messages
    of those that it listed."""
    before = read_manifest(folder)
    if not isinstance(before, Manifest):
        write_manifest(folder, remade=True)
        return
    is_whole = _sum_contents(before.segments) == _sum_contents(sealed)
    made = replace(before, segments=sealed, remade=before.remade or not is_whole)
    replace_file(folder / MANIFEST_NAME, made.encode())


def _sum_contents(segments: Mapping[str, Sealed]) -> str:
    return format_digest(sum(int(each.content or "0", 16) for each in segments.values()))
