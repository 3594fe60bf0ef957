"""Unfinished and damaged segments become finished ones: nothing valid is lost, nothing invalid is delivered.

What proves itself (recording/reading/segment_scan.py) is copied message by message into a segment of the usual form,
with a metadata record `repair` that says from what. The copy is written as `NNNN.mcap.tmp`, synced and renamed; only
then the original goes. It goes when the copy holds all of it but a block that was being written and never acknowledged;
else it stays, as `NNNN.mcap.damaged`. A valid segment that another program has written is left alone. A repair that is
killed is repeated, and one of a recording that is still under way (its recorder holds a lock on the segment) leaves
that alone.
"""

from __future__ import annotations

import errno
import fcntl
import os
from collections import Counter
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from filecmp import cmp
from hashlib import blake2b
from itertools import chain, count
from pathlib import Path
from shutil import copyfile
from typing import BinaryIO

from mcap.records import Attachment, Channel, Schema
from mcap.writer import CompressionType

from thermostand.foundation.errors import SessionError
from thermostand.foundation.files import sync_folder
from thermostand.recording.format.damage import DAMAGE
from thermostand.recording.format.images import IMAGE_SCHEMA, META_SCHEMA, ZSTD_LEVEL
from thermostand.recording.format.inventory import SegmentState, explain_changed_names, list_segments
from thermostand.recording.format.layout import (
    DAMAGED,
    FINISHED,
    FRAMES,
    SALVAGE_METADATA,
    SEGMENT_METADATA,
    SESSION_METADATA,
    TELEMETRY,
    TEMPORARY,
    UNFINISHED,
    make_segment_metadata,
)
from thermostand.recording.format.manifest import MANIFEST_NAME, Manifest, Sealed, read_manifest
from thermostand.recording.format.mcap_bytes import Source
from thermostand.recording.format.mcap_contents import McapContents
from thermostand.recording.format.messages import decode_frame_meta
from thermostand.recording.format.records import find_strangers
from thermostand.recording.reading.segment_check import check_segment, judge_rewritten
from thermostand.recording.reading.segment_scan import (
    SegmentScan,
    Span,
    StoredMessage,
    read_stored_messages,
    scan_segment,
)
from thermostand.recording.writing.locks import lock
from thermostand.recording.writing.manifest_file import complete_manifest
from thermostand.recording.writing.mcap_writer import McapWriter
from thermostand.recording.writing.segment import CHUNK_BYTES, FrameTable

# What a salvaged copy begins with: the segment's own opening and, where that is damaged, its siblings'.
#
# Every segment of a session repeats the session's metadata and attachments, every segment of a series the schemas and
# channels. A sibling is a segment of the same session directory that contradicts nothing that is known of the damaged
# one: same session id, same attachments, same channels. Where no sibling helps, nothing is guessed.
#
# Metadata has no CRC. So the record `session` is voted on: the one that most segments have is taken, a finished
# segment's vote before the own and the own before an unfinished one's when they are equally many.

_GREATEST = 999_999_999  # a number beyond is none that a recorder has given
SIBLINGS_PER_SERIES = 4  # enough for a vote, few enough for a session of hundreds
SESSION_ID = "session_id"


@dataclass(frozen=True, slots=True)
class SegmentOpening:
    """Metadata `session`, attachments by name, schemas and channels by number."""

    session: Mapping[str, str]
    attachments: Mapping[str, Attachment]
    schemas: Mapping[int, Schema]
    channels: Mapping[int, Channel]

    def knows(self, channel: int) -> bool:
        """Return whether messages of that channel can be delivered."""
        return channel in self.channels and self.channels[channel].schema_id in self.schemas


@dataclass(frozen=True, slots=True)
class _Sibling:
    path: Path
    found: SegmentScan


_MANIFEST_PART = f".{MANIFEST_NAME}.*.part"  # as foundation/files.py names what is not yet in its place


def find_opening(path: Path, own: SegmentScan) -> SegmentOpening | None:
    """The opening for the segment at `path`, of which `own` proved itself; None when its session is not known."""
    siblings = [sibling for sibling in _iterate_siblings(path) if _is_same_session(own, sibling.found)]
    session = _vote_session(own, siblings)
    if session is None:
        return None
    attachments = dict(own.attachments)
    schemas, channels = own.schemas, own.channels
    if not own.is_opening_whole:
        for sibling in siblings:
            attachments = sibling.found.attachments | attachments
    if own.messages.keys() - own.channels.keys():
        schemas, channels = _complete_tables(
            own, [sibling.found for sibling in siblings if sibling.path.parent == path.parent]
        )
    return SegmentOpening(session, attachments, schemas, channels)


def list_segment_files(series: Path) -> list[Path]:
    """The finished and unfinished segments in a folder; none when there is no such folder."""
    strangers = find_strangers(series.parent)
    files = (file for file in list_segments(series.parent) if file.series == series.name and file.name not in strangers)
    return [file.path for file in files if file.state is not SegmentState.DAMAGED and file.number <= _GREATEST]


def _iterate_siblings(path: Path) -> Iterator[_Sibling]:
    """The nearest other segments of the session, each read to its first chunk."""
    number = _parse_number(path)
    for series in (path.parent.parent / TELEMETRY, path.parent.parent / FRAMES):
        segments = [other for other in list_segment_files(series) if other != path]
        segments.sort(key=lambda other: (abs(_parse_number(other) - number), other.name))
        for other in segments[:SIBLINGS_PER_SERIES]:
            with suppress(OSError):  # what cannot be read does not help
                yield _Sibling(other, _scan_opening(other))


def _parse_number(path: Path) -> int:
    return int(path.name.partition(".")[0])


def _scan_opening(path: Path) -> SegmentScan:
    fd = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    try:
        return scan_segment(Source(fd), to_first_chunk=True)
    finally:
        os.close(fd)


def _get_identity(session: Mapping[str, str]) -> tuple[str, str]:
    return session.get(SESSION_ID, ""), session.get("uid", "")


def _is_same_session(one: SegmentScan, other: SegmentScan) -> bool:
    """Return whether nothing that is known of both says that they are of different sessions."""
    if one.session and other.session and _get_identity(one.session) != _get_identity(other.session):
        return False
    both = one.attachments.keys() & other.attachments.keys()
    return all(one.attachments[name].data == other.attachments[name].data for name in both)


def _vote_session(own: SegmentScan, siblings: list[_Sibling]) -> Mapping[str, str] | None:
    """The session's metadata by vote; None when no segment has it, or the siblings are of several sessions."""
    finished = [sibling.found.session for sibling in siblings if sibling.path.name.endswith(FINISHED)]
    unfinished = [sibling.found.session for sibling in siblings if not sibling.path.name.endswith(FINISHED)]
    votes = [session for session in (*finished, own.session, *unfinished) if session]
    if len({_get_identity(session) for session in votes}) != 1:
        return None
    ((winner, _),) = Counter(tuple(session.items()) for session in votes).most_common(1)
    return dict(winner)


def _complete_tables(
    own: SegmentScan, siblings: Iterable[SegmentScan]
) -> tuple[Mapping[int, Schema], Mapping[int, Channel]]:
    """Schemas and channels completed from the siblings of the series, if these are of one mind and do not contradict
    the own; else the own."""
    tables = [(sibling.schemas, sibling.channels) for sibling in siblings if sibling.channels]
    if not tables or any(table != tables[0] for table in tables):
        return own.schemas, own.channels
    schemas, channels = tables[0]
    if schemas | own.schemas != own.schemas | schemas or channels | own.channels != own.channels | channels:
        return own.schemas, own.channels
    return schemas | own.schemas, channels | own.channels


# How much of the files of a repair has been read.

ReportShare = Callable[[float, str], None]
"""Gets the share that is done, 0 to 1, and the file at hand."""


def no_report(share: float, text: str) -> None:
    """Show no progress."""


class ShareProgress:
    """The progress over `paths`; each is read from its begin to its end, perhaps more than once."""

    def __init__(self, paths: Iterable[Path], report: ReportShare) -> None:
        self._sizes = {path: _get_size(path) for path in paths}
        self._total = max(1, sum(self._sizes.values()))
        self._report = report
        self._done = 0

    def within(self, path: Path) -> Callable[[int], None]:
        """Return what is to be called with how many bytes of `path` have been read."""
        return lambda read_bytes: self._report(min(1.0, (self._done + read_bytes) / self._total), path.name)

    def finished(self, path: Path) -> None:
        """All that is to be done with `path` is done."""
        self._done += self._sizes.pop(path, 0)
        self._report(min(1.0, self._done / self._total), path.name)


def _get_size(path: Path) -> int:
    with suppress(OSError):
        return path.stat().st_size
    return 0


BEING_RECORDED = "is being recorded"
_NO_LINKS = (errno.EPERM, errno.ENOTSUP, errno.ENOSYS, errno.EMLINK, errno.EACCES)
# Telemetry is small and read often: zstd's usual level. Frames are as the recorder writes them.
LEVELS = {FRAMES: ZSTD_LEVEL, TELEMETRY: 3}  # of zstd


@dataclass(frozen=True, slots=True)
class Salvaged:
    """What became of one segment.

    source: what was repaired. path: the finished segment, None when nothing could be recovered. messages: how many of
    `source` are in it. lost_bytes: in its damaged places; a block that was never acknowledged is not lost. reason:
    what was wrong, BEING_RECORDED when it was left alone. kept: the original, when something of it is not in the copy.
    is_rewritten: another program has written the segment, which is valid and left alone; `reason` says what it holds.
    """

    source: Path
    path: Path | None
    messages: int
    lost_bytes: int
    reason: str
    kept: Path | None
    is_rewritten: bool = False


def salvage_session(directory: Path, report: ReportShare = no_report) -> list[Salvaged]:
    """Finish every unfinished segment and every finished one that is damaged. SessionError when there is no session,
    or when the disk refuses: then the segment at hand is as it was and those before it are salvaged."""
    folders = [directory / series for series in (TELEMETRY, FRAMES) if (directory / series).is_dir()]
    why = "" if list_segments(directory) else explain_changed_names(directory)
    if why or not folders:
        raise SessionError(f"{directory}: not a session: {why or f'it has neither {TELEMETRY} nor {FRAMES}'}")
    return [*_salvage_folders(folders, True, report), *_update_manifest(directory)]


def salvage_unfinished(root: Path, report: ReportShare = no_report) -> list[Salvaged]:
    """Finish the unfinished segments of every session below `root`, without a look at the finished ones. SessionError
    as above."""
    for part in root.glob(f"*/{_MANIFEST_PART}"):
        _remove_manifest_part(part)
    left = {path.parent for pattern in (UNFINISHED, TEMPORARY) for path in root.glob(f"*/*/*{pattern}")}
    folders = [folder for folder in sorted(left, reverse=True) if folder.name in LEVELS]  # telemetry is first
    found = _salvage_folders(folders, False, report)
    return [
        *found,
        *chain.from_iterable(_update_manifest(directory) for directory in sorted({f.parent for f in folders})),
    ]


def _update_manifest(directory: Path) -> Iterator[Salvaged]:
    """`session.json` lists what has been salvaged; reported where it had to be made again."""
    files = list_segments(directory)
    if any(file.state is SegmentState.RECORDING for file in files) or all(
        file.state is SegmentState.DAMAGED for file in files
    ):
        return  # its recorder writes it, or there is nothing to list
    for part in directory.glob(_MANIFEST_PART):
        _remove_manifest_part(part)
    path = directory / MANIFEST_NAME
    with _convert_disk_errors(path), suppress(SessionError):
        if reason := complete_manifest(directory):
            yield Salvaged(path, path, 0, 0, reason, None)


def _remove_manifest_part(part: Path) -> None:
    """Remove a manifest that was killed before it had its name; not what a recorder that lives is writing."""
    if not any(file.state is SegmentState.RECORDING for file in list_segments(part.parent)):
        with _convert_disk_errors(part):
            part.unlink(missing_ok=True)


def _salvage_folders(folders: Iterable[Path], finished_too: bool, report: ReportShare) -> list[Salvaged]:
    found = [(folder, list_segment_files(folder)) for folder in folders]
    wanted = [path for _, paths in found for path in paths if finished_too or path.name.endswith(UNFINISHED)]
    share = ShareProgress(wanted, report)
    return [done for folder, _ in found for done in _salvage_folder(folder, finished_too, share)]


def _salvage_folder(folder: Path, finished_too: bool, share: ShareProgress) -> Iterator[Salvaged]:
    for copy in folder.glob(f"*{TEMPORARY}"):
        _remove_left_over(copy)
    for number in sorted({int(path.name.partition(".")[0]) for path in list_segment_files(folder)}):
        yield from _salvage_number(folder / f"{number:04d}{FINISHED}", finished_too, share)


def _remove_left_over(copy: Path) -> None:
    """Remove what a killed repair has left; not what one that lives is writing."""
    with _convert_disk_errors(copy), _lock_file(copy) as fd:
        if fd is not None:
            copy.unlink()


def _salvage_number(finished: Path, finished_too: bool, share: ShareProgress) -> Iterator[Salvaged]:
    """The finished segment of a number first: the unfinished one next to it is compared with what it holds."""
    part = finished.with_name(finished.name.replace(FINISHED, UNFINISHED))
    has_part = part.is_file()
    if finished.is_file() and (finished_too or has_part):
        checked = check_segment(finished, lambda message: None, share.within(finished))
        if checked.damages:
            yield _salvage_segment(finished, share)
        elif checked.rewritten is not None and finished_too:
            yield _leave_rewritten(finished, checked.rewritten)
    share.finished(finished)
    if has_part:
        yield _salvage_segment(part, share)
        share.finished(part)


def _leave_rewritten(path: Path, found: McapContents) -> Salvaged:
    """A valid segment that another program has written is not touched."""
    judgement = judge_rewritten(found, _find_listed(path)).text
    return Salvaged(path, path, len(found), 0, judgement, None, is_rewritten=True)


def _find_listed(path: Path) -> Sealed | None:
    """Return what `session.json` lists of a finished segment."""
    stated = read_manifest(path.parent.parent)
    return stated.segments.get(f"{path.parent.name}/{path.name}") if isinstance(stated, Manifest) else None


@contextmanager
def _convert_disk_errors(path: Path) -> Generator[None]:
    """What the disk refuses inside becomes a SessionError that names the file."""
    try:
        yield
    except OSError as error:
        raise SessionError(f"{path}: cannot be repaired and is left as it was ({error})") from error


@contextmanager
def _lock_file(path: Path) -> Generator[int | None]:
    """The file, opened and locked; None when another process has it, or has just renamed it."""
    try:
        fd = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)  # a pipe of that name is never waited for
    except FileNotFoundError:
        yield None
        return
    try:
        try:
            lock(fd)
            is_ours = os.path.samestat(os.fstat(fd), path.stat())
        except (BlockingIOError, FileNotFoundError):
            is_ours = False
        yield fd if is_ours else None
    finally:
        os.close(fd)


@dataclass(frozen=True, slots=True)
class _Original:
    """A segment under repair: what proved itself of it, and the opening for its copy (None: not known)."""

    path: Path
    finished: Path
    source: Source
    found: SegmentScan
    opening: SegmentOpening | None

    def messages(self) -> Iterator[tuple[Channel, StoredMessage]]:
        """Return what can be delivered, in order."""
        return chain.from_iterable(self.iterate_chunks())

    def iterate_chunks(self) -> Iterator[list[tuple[Channel, StoredMessage]]]:
        """The same, chunk by chunk."""
        opening = self.opening
        if opening is None:
            return
        for place in self.found.chunks:
            found = read_stored_messages(self.source, place)
            yield [(opening.channels[each.channel], each) for each in found if opening.knows(each.channel)]

    @property
    def delivered(self) -> int:
        """The number of `messages`."""
        opening = self.opening
        return sum(n for channel, n in self.found.messages.items() if opening is not None and opening.knows(channel))

    @property
    def unknown(self) -> int:
        """Messages that cannot be delivered, because no segment describes their channels."""
        return self.found.messages.total() - self.delivered

    @property
    def is_complete(self) -> bool:
        """Whether a copy holds all that was ever acknowledged; of a finished, damaged segment that is unknown."""
        return self.path != self.finished and not self.found.damages and not self.unknown


def _examine(path: Path, finished: Path, source: Source, report: Callable[[int], None]) -> _Original:
    found = scan_segment(source, report=report)
    opening = find_opening(path, found)
    if opening is not None and path.parent.name == FRAMES:
        _forget_foreign_chunks(source, found, opening)
    return _Original(path, finished, source, found, opening)


def _forget_foreign_chunks(source: Source, found: SegmentScan, opening: SegmentOpening) -> None:
    """A sound chunk that is not a frame is of another series: a disk has written its sector to the wrong place."""
    for place in tuple(found.chunks):
        messages = list(read_stored_messages(source, place))
        if all(opening.knows(each.channel) for each in messages) and not _is_frame(messages, opening):
            found.chunks.remove(place)
            found.messages -= Counter(each.channel for each in messages)
            found.damages.append(Span(place.offset, place.offset + place.length))
    found.damages.sort()


def _is_frame(messages: list[StoredMessage], opening: SegmentOpening) -> bool:
    """Return whether they are a description and its image."""
    names = [opening.schemas[opening.channels[each.channel].schema_id].name for each in messages]
    if names != [META_SCHEMA, IMAGE_SCHEMA]:
        return False
    try:
        time_ns = decode_frame_meta(bytes(messages[0].data)).time_ns
    except (SessionError, *DAMAGE):
        return False
    return all(each.log_time_ns == time_ns for each in messages)


def _salvage_segment(path: Path, share: ShareProgress) -> Salvaged:
    """One segment; SessionError when the disk refuses."""
    finished = path.with_name(f"{path.name.partition('.')[0]}{FINISHED}")
    with _convert_disk_errors(path), _lock_file(path) as fd:
        if fd is None:
            return Salvaged(path, None, 0, 0, BEING_RECORDED, None)
        source = Source(fd)
        original = _examine(path, finished, source, share.within(path))
        if path != finished and finished.exists():
            return _salvage_unfinished_pair(original)
        return _salvage_alone(original)


def _salvage_alone(original: _Original) -> Salvaged:
    if original.delivered or (original.opening is not None and _is_only_telemetry(original)):
        with _make_copy(original) as copy:
            return _settle(original, original.finished, copy)
    return _settle(original, None)


def _is_only_telemetry(original: _Original) -> bool:
    """Without any telemetry, empty or not, the session's frames could not be opened."""
    folder = original.path.parent
    frames = list_segment_files(folder.parent / FRAMES)
    return folder.name == TELEMETRY and bool(frames) and list_segment_files(folder) == [original.path]


def _salvage_unfinished_pair(part: _Original) -> Salvaged:
    """An unfinished segment whose finished one is there, too, and sound: whichever holds all the messages of both."""
    with part.finished.open("rb") as file:
        source = Source(file.fileno())
        finished = _examine(part.finished, part.finished, source, lambda read_bytes: None)
        ours, theirs = _count_digests(part), _count_digests(finished)
    if ours <= theirs:
        return _settle(part, part.finished)
    if theirs < ours:
        with _make_copy(part) as copy:
            return _settle(part, part.finished, copy)
    missing = (ours - theirs).total()
    kept = _keep(part)
    reason = f"holds {missing} messages that {part.finished.name} does not hold, and lacks some of that"
    part.path.unlink()
    sync_folder(kept.parent)
    return Salvaged(part.path, part.finished, ours.total() - missing, part.found.lost_bytes, reason, kept)


def _count_digests(original: _Original) -> Counter[bytes]:
    """The messages, small and comparable."""
    digests: Counter[bytes] = Counter()
    for channel, message in original.messages():
        key = f"{channel.topic} {message.sequence} {message.log_time_ns} {message.publish_time_ns}"
        digests[blake2b(message.data, digest_size=16, key=blake2b(key.encode()).digest()).digest()] += 1
    return digests


@contextmanager
def _make_copy(original: _Original) -> Generator[Path]:
    """All that can be delivered, finished and on the disk as NNNN.mcap.tmp; it is locked until the block ends, and
    removed again when the disk refuses."""
    copy = original.finished.with_name(original.finished.name.replace(FINISHED, TEMPORARY))
    with suppress(OSError):
        os.truncate(original.path, original.source.size)  # gives back what a dead recorder had reserved behind its end
    with _create_file(copy) as file:
        try:
            _write(file, original)
            file.flush()
            os.fsync(file.fileno())
            yield copy
        except BaseException:
            with suppress(OSError):
                copy.unlink()
            raise


def _create_file(path: Path) -> BinaryIO:
    """A file that was not there, locked. Another repair may take it for left over until it is: then there is another
    one; FileExistsError when that is another's."""
    while True:
        file = path.open("xb")
        fcntl.flock(file, fcntl.LOCK_EX)
        if os.fstat(file.fileno()).st_nlink:
            return file
        file.close()


def _write(file: BinaryIO, original: _Original) -> None:
    """The copy, in the form of recording/writing/segment.py: the opening first, one frame per chunk."""
    series = original.path.parent.name
    writer = McapWriter(CompressionType.ZSTD, CHUNK_BYTES, LEVELS[series])
    table = FrameTable(writer)
    channels = _write_opening(writer, table, original)
    for messages in original.iterate_chunks():
        for channel, message in messages:
            number = channels[channel.id]
            writer.add_message(number, message.log_time_ns, message.publish_time_ns, message.sequence, message.data)
            table.note(number, message.data)
        if series == FRAMES:
            writer.end_chunk()
        file.writelines(writer.take())
    table.write(0)
    writer.finish()
    file.writelines(writer.take())


def _write_opening(writer: McapWriter, table: FrameTable, original: _Original) -> Mapping[int, int]:
    """Attachments, metadata, schemas and channels; channel numbers of the original -> of the copy."""
    opening = original.opening
    if opening is None:
        raise ValueError("a copy needs an opening")
    for attachment in opening.attachments.values():
        writer.add_attachment(attachment)
    number = int(original.finished.name.partition(".")[0])
    writer.add_metadata(SESSION_METADATA, dict(opening.session))
    place = make_segment_metadata(original.path.parent.name, number, opening.session)
    writer.add_metadata(SEGMENT_METADATA, place)
    writer.add_metadata(SALVAGE_METADATA, _make_salvage_metadata(original))
    schemas = {
        schema.id: writer.add_schema(schema.name, schema.encoding, schema.data)
        for _, schema in sorted(opening.schemas.items())
    }
    channels: dict[int, int] = {}
    for _, channel in sorted(opening.channels.items()):
        if opening.knows(channel.id):
            schema = schemas[channel.schema_id]
            number = writer.add_channel(channel.topic, channel.message_encoding, schema, channel.metadata)
            table.know(number, opening.schemas[channel.schema_id].name)
            channels[channel.id] = number
    return channels


def _make_salvage_metadata(original: _Original) -> dict[str, str]:
    """Return what the record `repair` says. listed: how many messages its recorder listed of the segment."""
    known = _find_listed(original.finished)
    listed = {} if known is None else {"listed": str(sum(known.messages.values()))}
    return {
        "source": original.path.name,
        "reason": _explain(original),
        "messages": str(original.delivered),
        "lost_bytes": str(original.found.lost_bytes),
        "damaged_places": str(len(original.found.damages)),
        **listed,
    }


def _explain(original: _Original) -> str:
    found = original.found
    reasons: list[str] = []
    if found.damages:
        places = "1 damaged place" if len(found.damages) == 1 else f"{len(found.damages)} damaged places"
        reasons.append(f"{places} of {found.lost_bytes} bytes, the first at byte {found.damages[0].begin}")
    if found.partial_write_bytes:
        reasons.append(f"a block of {found.partial_write_bytes} bytes was being written at its end")
    if found.is_session_wrong:
        reasons.append("its metadata do not fit their CRC")
    if original.opening is None:
        reasons.append("no segment records which session it belongs to")
    elif original.unknown:
        reasons.append(f"{original.unknown} messages are of channels that no segment describes")
    if not reasons:
        reasons.append("its index is damaged" if original.path == original.finished else "it was not finished")
    return "; ".join(reasons)


def _settle(original: _Original, path: Path | None, copy: Path | None = None) -> Salvaged:
    """Put the copy, if there is one, in its place and the original out of the way. Each step leaves a state from
    which a repair can continue."""
    folder = original.path.parent
    kept = None if original.is_complete else _keep(original)
    if copy is not None:
        os.replace(copy, original.finished)
        sync_folder(folder)
    if original.path != path:
        original.path.unlink()
        sync_folder(folder)
    return Salvaged(original.path, path, original.delivered, original.found.lost_bytes, _explain(original), kept)


def _keep(original: _Original) -> Path:
    """A second name for the original, on the disk: NNNN.mcap.damaged, or NNNN.2.mcap.damaged when that is taken."""
    number = original.finished.name.removesuffix(FINISHED)
    names = (f"{number}{DAMAGED}" if n == 1 else f"{number}.{n}{DAMAGED}" for n in count(1))
    for path in (original.path.with_name(name) for name in names):
        if path.exists() and (path.samefile(original.path) or cmp(path, original.path, shallow=False)):
            return path
        if not path.exists():
            _link_or_copy(original.path, path)
            sync_folder(path.parent)
            return path
    raise ValueError("counting ends")


def _link_or_copy(source: Path, target: Path) -> None:
    """A second name for a file, or where the file system has none (exFAT, CIFS), a copy on the disk."""
    try:
        os.link(source, target)
    except OSError as error:
        if error.errno not in _NO_LINKS:
            raise
        growing = target.with_name(f".{target.name}.copying")
        try:
            copyfile(source, growing)
            with growing.open("rb") as file:
                os.fsync(file.fileno())
            growing.rename(target)
        except OSError as failed:
            growing.unlink(missing_ok=True)
            raise OSError(
                failed.errno, f"its file system has no hard links, and a copy failed: {failed.strerror}"
            ) from failed


def format_salvaged(salvaged: Salvaged) -> str:
    """Return what became of a segment, which is named with its session."""
    source = "/".join(salvaged.source.absolute().parts[-3:])
    if salvaged.reason == BEING_RECORDED:
        return f"{source}: left alone, it is being recorded"
    if salvaged.is_rewritten:
        return f"{source}: {salvaged.reason}"
    if salvaged.source.name == MANIFEST_NAME:
        return f"{source}: made of the segments that are there ({salvaged.reason})"
    outcome = f"{salvaged.messages} messages in {salvaged.path.name}" if salvaged.path else "nothing could be recovered"
    lost = f", {salvaged.lost_bytes} bytes lost" if salvaged.lost_bytes else ""
    kept = f", the original is kept as {salvaged.kept.name}" if salvaged.kept else ""
    return f"{source}: {outcome}{lost}{kept} ({salvaged.reason})"
