"""A part of a recorded session as a session of its own.

Messages are copied as they are, images undecoded, in the order of the recording. What is added at the start makes
the part stand alone: an event that says where it was cut from, the mark of the step that was under way, and the offset
of the stand's clock to UTC when there was one.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from itertools import chain
from pathlib import Path

from mcap.writer import CompressionType

from thermostand.foundation.clock import NS_PER_S, to_ns
from thermostand.foundation.errors import SessionError
from thermostand.foundation.events import TRIMMED
from thermostand.foundation.files import create_folder
from thermostand.foundation.items import StepMark, StepState
from thermostand.recording.exporting.topics import iterate_recorded_messages, list_topics
from thermostand.recording.format import messages
from thermostand.recording.format.holes import format_holes
from thermostand.recording.format.images import ZSTD_LEVEL, name_frame_topics
from thermostand.recording.format.layout import FRAMES, TELEMETRY
from thermostand.recording.format.manifest import Sealed
from thermostand.recording.format.records import FramePlace, list_frame_places, read_frame
from thermostand.recording.format.utc_offsets import make_offset_event
from thermostand.recording.reading.run_status import Extent, parse_extent
from thermostand.recording.reading.session import Session
from thermostand.recording.writing.manifest_file import write_manifest
from thermostand.recording.writing.recorder import RecordingSettings
from thermostand.recording.writing.segment import MessageRecord, SeriesSpec, Topic
from thermostand.recording.writing.series import Series
from thermostand.recording.writing.session_spec import make_frames_topic

# Telemetry is committed in blocks of this much: many messages per disk sync, many blocks per segment.
BLOCK_NS = 60 * NS_PER_S
BLOCK_BYTES = 1 << 20  # as a recording commits; not measured


def trim(session: Session, out: Path, begin_ns: int, end_ns: int) -> Path:
    """Write what was recorded in a range of time as a new session.

    Attachments, channels, sequence numbers, instants and order stay, and so do the metadata, which state the extent of
    the part and what was already missing in the session. The first messages are an event of kind
    TRIMMED, when a step had started and not ended before `begin_ns` its mark again, and when UTC was not the stand's
    time an event that says so, all at the instant of the first message kept: a frame's step can be looked up, and
    nothing lies before the part.

    Parameters
    ----------
    session
        The session, which is not changed.
    out
        The new session's folder, which must not exist.
    begin_ns, end_ns
        The range [begin_ns, end_ns), ns of the session's clock.

    Returns
    -------
    Path
        `out`.

    Raises
    ------
    SessionError
        When nothing was recorded in the range, or reading or writing fails; `out` then does not appear.
    """
    places = [place for place in _iterate_places(session) if begin_ns <= place.time_ns < end_ns]
    kept = _select_records(session, begin_ns, end_ns)
    first = next(kept, None)
    if first is None and not places:
        raise SessionError(
            f"{session.path}: has nothing from {session.utc.date_time(begin_ns)} to {session.utc.local_text(end_ns)}; "
            f"{_describe_range(session)}"
        )
    first_ns = first.time_ns if first is not None else places[0].time_ns
    telemetry = chain(_make_opening(session, first_ns, begin_ns, end_ns), [] if first is None else [first], kept)
    metadata = _make_metadata(session, begin_ns, end_ns)
    with create_folder(out) as folder:
        _write_telemetry(session, metadata, folder / TELEMETRY, telemetry, first_ns)
        _write_frames(session, metadata, folder / FRAMES, places)
        write_manifest(folder)
    return out


def _make_metadata(session: Session, begin_ns: int, end_ns: int) -> dict[str, str]:
    """The session's record, with the extent and the holes of the part."""
    before = parse_extent(session.metadata)
    if before is not None:  # a part of a part is one of the whole
        begin_ns, end_ns = max(begin_ns, before.begin_ns), min(end_ns, before.end_ns)
    extent = Extent(session.metadata.get("session_id", session.path.name), begin_ns, end_ns, session.run)
    holes = [part for hole in session.holes if (part := hole.clip(begin_ns, end_ns)) is not None]
    extra = {"extent": extent.record(), "holes": format_holes(holes)}
    return {**session.metadata, **{name: text for name, text in extra.items() if text}}


def _iterate_places(session: Session) -> Iterator[FramePlace]:
    """The frames in the order of the recording."""
    for path in session.frame_segments:
        yield from list_frame_places(path)


def _read_telemetry(session: Session) -> Iterator[MessageRecord]:
    for message in iterate_recorded_messages(session):
        yield MessageRecord(message.topic, message.time_ns, message.data, message.sequence)


def _select_records(session: Session, begin_ns: int, end_ns: int) -> Iterator[MessageRecord]:
    return (record for record in _read_telemetry(session) if begin_ns <= record.time_ns < end_ns)


def _describe_range(session: Session) -> str:
    times_ns = [record.time_ns for record in _read_telemetry(session)] + [
        place.time_ns for place in _iterate_places(session)
    ]
    if not times_ns:
        return "it is empty"
    return f"it goes from {session.utc.date_time(min(times_ns))} to {session.utc.local_text(max(times_ns))}"


def _make_opening(session: Session, first_ns: int, begin_ns: int, end_ns: int) -> Iterator[MessageRecord]:
    """Make the messages that state where the part comes from, and the mark of the step under way."""
    name, utc = session.metadata.get("session_id", session.path.name), session.utc
    text = f"trimmed from session {name}: {utc.utc_text(begin_ns)} up to {utc.utc_text(end_ns)}, the end not included"
    mark = _find_step_under_way(session, begin_ns)
    if mark is not None:
        text += f"; the mark of step {mark.step_id}, started {utc.utc_text(mark.time_ns)}, is repeated at the start"
    event = TRIMMED.at(first_ns, text)
    yield MessageRecord(messages.EVENT, first_ns, messages.encode_event(event))
    yield MessageRecord(messages.LOG, first_ns, messages.encode_log(event))
    if mark is not None:
        yield MessageRecord(messages.STEP, first_ns, messages.encode_step(mark))
    if offset_ns := utc.at(first_ns):
        yield MessageRecord(messages.EVENT, first_ns, messages.encode_event(make_offset_event(first_ns, offset_ns)))


def _find_step_under_way(session: Session, begin_ns: int) -> StepMark | None:
    """The last step that started before `begin_ns` and did not end before it."""
    under_way: StepMark | None = None
    for mark in session.steps():
        if mark.time_ns >= begin_ns:
            break
        if mark.state is StepState.STARTED:
            under_way = mark
        elif under_way is not None and under_way.step_id == mark.step_id:
            under_way = None
    return under_way


def _write_telemetry(
    session: Session, metadata: Mapping[str, str], folder: Path, records: Iterator[MessageRecord], first_ns: int
) -> None:
    topics = {topic.name: topic for topic in list_topics(session)}
    for name in (messages.EVENT, messages.LOG, messages.STEP):
        topics.setdefault(name, Topic(name, messages.CLASSES[name]))
    series = open_series(session.attachments, metadata, folder, tuple(topics.values()), CompressionType.ZSTD)
    now_ns = first_ns
    for block in split_into_blocks(records):
        now_ns = max(now_ns, block[-1].time_ns)
        commit(series, block, now_ns)
    finish(series)


def split_into_blocks(records: Iterator[MessageRecord]) -> Iterator[list[MessageRecord]]:
    """Records of telemetry as they are committed together."""
    block: list[MessageRecord] = []
    size_bytes = 0
    for record in records:
        if block and (size_bytes >= BLOCK_BYTES or record.time_ns - block[0].time_ns >= BLOCK_NS):
            yield block
            block, size_bytes = [], 0
        block.append(record)
        size_bytes += len(record.data)
    if block:
        yield block


def _write_frames(session: Session, metadata: Mapping[str, str], folder: Path, places: list[FramePlace]) -> None:
    """One frame per commit, as a chunk holds one."""
    if not places:
        return
    channels = dict.fromkeys(place.meta.channel for place in places)
    topics = tuple(make_frames_topic(name) for channel in channels for name in name_frame_topics(channel))
    series = open_series(session.attachments, metadata, folder, topics, CompressionType.ZSTD, ZSTD_LEVEL)
    for place in places:
        names, stored, meta = name_frame_topics(place.meta.channel), read_frame(place), place.meta
        stamps = place.sequence, meta.published_ns
        records = [
            MessageRecord(names.meta, meta.time_ns, stored.meta, *stamps),
            MessageRecord(names.image, meta.time_ns, stored.image, *stamps),
        ]
        commit(series, records, place.time_ns)
    finish(series)


def open_series(
    attachments: Mapping[str, str],
    metadata: Mapping[str, str],
    folder: Path,
    topics: tuple[Topic, ...],
    compression: CompressionType,
    level: int = 3,
    seal: Callable[[str, Sealed], None] | None = None,
) -> Series:
    """A series of a copy in `folder`, which is made; `seal` is called with each segment."""
    folder.mkdir(exist_ok=True)
    usual = RecordingSettings()
    segment_ns = to_ns(usual.segment_s)
    form = SeriesSpec(
        name=folder.name,
        topics=topics,
        compression=compression,
        session=metadata,
        attachments=attachments,
        segment_bytes=usual.segment_bytes,
        segment_ns=segment_ns,
        level=level,
    )
    return Series(folder, form, seal)


def commit(series: Series, records: list[MessageRecord], now_ns: int) -> None:
    """Commit, or raise what a recorder would overcome: a copy that went half wrong is begun again, not mended."""
    series.commit(records, now_ns)
    if series.troubles:
        raise OSError(series.troubles.popleft())


def finish(series: Series) -> None:
    """Finish the last segment; OSError when the disk refuses."""
    if not series.finish():
        raise OSError(series.troubles.popleft())
