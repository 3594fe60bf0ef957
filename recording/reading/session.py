"""Reads a recorded session: metadata, readings, frames, steps, events. It needs no device and changes nothing.

A topic of the telemetry is read only when asked for, and then kept; frames are decoded one at a time. Anything
wrong with a session is a SessionError with a sentence.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from functools import cached_property
from itertools import accumulate, chain, pairwise
from operator import attrgetter
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, TypeVar

import numpy as np
from mcap.records import Channel
from numpy.typing import NDArray

from thermostand.foundation.errors import NotFound, SessionError
from thermostand.foundation.extras import import_extra
from thermostand.foundation.items import Event, Item, Original, StepMark, StepState
from thermostand.foundation.readings import Frame
from thermostand.recording.format import messages
from thermostand.recording.format.batches import READINGS
from thermostand.recording.format.damage import FileDamaged, name_file_in_errors
from thermostand.recording.format.decoded_items import (
    RecordedImage,
    decode_event_item,
    decode_frame,
    decode_item,
    decode_step_item,
    is_item_channel,
    read_recorded_image,
)
from thermostand.recording.format.holes import Hole
from thermostand.recording.format.inventory import SegmentState, explain_changed_names, is_misplaced, list_segments
from thermostand.recording.format.layout import (
    FINISHED,
    FRAMES,
    TELEMETRY,
    explain_unknown_format,
)
from thermostand.recording.format.manifest import MANIFEST_NAME
from thermostand.recording.format.records import (
    FramePlace,
    Head,
    RecordedMessage,
    find_strangers,
    list_frame_places,
    read_head,
    read_telemetry_messages,
)
from thermostand.recording.format.utc_offsets import UtcOffsets, collect_offsets
from thermostand.recording.reading.columns import ChannelColumn, ReadingColumns
from thermostand.recording.reading.frames_table import FramesTable, build_frames_table
from thermostand.recording.reading.run_status import Files, RunOutcome
from thermostand.recording.reading.scan import Depth, Scan, format_planned_frames, scan

if TYPE_CHECKING:
    from thermostand.recording.reading.lazy_arrays import SessionArrays

T = TypeVar("T")
_UNFINISHED = (SegmentState.UNFINISHED, SegmentState.RECORDING)
_MOST = 6  # holes in a sentence before the rest is only counted
Say = Callable[[str], None]


class Session:
    """A recorded session, read from its folder.

    Attributes
    ----------
    incomplete
        Segments that were not finished; they are not read.
    damaged
        Segments that were replaced by what could be recovered from them; they are not read.
    camera
        The name of the camera whose frames are meant where those of one camera are; the leading one's unless it is set.
    """

    camera = "camera"

    def __init__(self, path: Path, telemetry: list[Path], frames: list[Path]) -> None:
        self.path = path
        files = list_segments(path)
        self.incomplete = tuple(file.path for file in files if file.state in _UNFINISHED)
        self.damaged = tuple(file.path for file in files if file.state is SegmentState.DAMAGED)
        self._telemetry = telemetry
        self._frames = frames
        head = read_head(telemetry[0])
        self.metadata = head.session
        self._attachments = head.attachments
        if text := explain_unknown_format(self.metadata):
            raise SessionError(f"{path}: {text}")
        self._heads: dict[Path, Head] = {}  # of the segments that are known to belong here
        for segment in (*telemetry, *frames):  # metadata has no CRC, but a second copy in the others
            with suppress(_Unreadable):  # it is reported when it is read
                self._check(segment)
        self._columns: dict[str, dict[str, ChannelColumn]] = {}  # device -> channel -> column
        self._all_columns_read = False
        self._units: dict[str, str] = {}
        self._uncertain: dict[str, list[int]] = {}
        self._places_of: dict[Path, list[FramePlace]] = {}

    @classmethod
    def open(cls, path: Path | str) -> Session:
        """The session in `path`, the directory that holds `telemetry` and `frames`; SessionError when there is none."""
        path = Path(path)
        files, strangers = list_segments(path), find_strangers(path)
        finished = [file for file in files if file.state is SegmentState.FINISHED and file.name not in strangers]
        telemetry, frames = ([file.path for file in finished if file.series == name] for name in (TELEMETRY, FRAMES))
        if not telemetry and not path.is_dir():
            raise NotFound(f"{path}: {'is a file, not a folder' if path.exists() else 'no such folder'}")
        if not telemetry:
            count = sum(file.state in _UNFINISHED for file in files)
            unfinished = f", only {count} unfinished ones" if count else ""
            kind = SessionError if count else NotFound
            why = explain_changed_names(path) or f"there is no finished segment in {path / TELEMETRY}{unfinished}"
            raise kind(f"{path}: not a session: {why}")
        return cls(path, telemetry, frames)

    @property
    def attachments(self) -> Mapping[str, str]:
        """The attached files: name -> text."""
        return MappingProxyType(self._attachments)

    def attachment(self, name: str) -> str | None:
        """The text of an attached file (`config.yaml`), None when there is none of that name."""
        return self._attachments.get(name)

    @property
    def segments(self) -> tuple[Path, ...]:
        """The finished segments, those of the telemetry first."""
        return (*self._telemetry, *self._frames)

    @property
    def telemetry_segments(self) -> tuple[Path, ...]:
        """The finished segments of the telemetry, in order."""
        return tuple(self._telemetry)

    @property
    def frame_segments(self) -> tuple[Path, ...]:
        """The finished segments with the images, in order."""
        return tuple(self._frames)

    def channels(self) -> list[str]:
        """The channels that have readings, sorted."""
        return sorted(self._read_all_columns())

    def units(self) -> Mapping[str, str]:
        """The unit of each channel that has readings. One whose unit was another one before has it in its name,
        `lab.pressure (mbar)`."""
        return {channel: self._units[channel] for channel in self.channels()}

    def readings(self, channel: str) -> ChannelColumn:
        """Return the readings of a channel.

        Parameters
        ----------
        channel
            Its name, one of `channels()`.

        Returns
        -------
        ChannelColumn
            (time_ns, value), both of shape (n,), in order of time; NaN where the reading was BAD. `.to_pandas()` is a
            Series.

        Raises
        ------
        SessionError
            When the session has no such channel.
        """
        device = channel.partition(".")[0]
        if device not in self._columns and not self._all_columns_read:
            self._columns[device] = self._read_columns(device).get(device, {})
        found = self._columns.get(device, {}).get(channel) or self._read_all_columns().get(channel)
        if found is None:
            raise SessionError(f"{self.path}: has no channel {channel}; there are {', '.join(self.channels())}")
        return found

    def believed(self, channel: str) -> ChannelColumn:
        """Return readings as `readings` does, without those that were recorded as suspect (cause "suspect")."""
        times_ns, values = self.readings(channel)
        kept = ~np.isin(times_ns, self._uncertain.get(channel, []))
        return ChannelColumn(times_ns[kept], values[kept])

    def _read_all_columns(self) -> dict[str, ChannelColumn]:
        if not self._all_columns_read:
            self._columns = self._read_columns(None)
            self._all_columns_read = True
        return {channel: column for columns in self._columns.values() for channel, column in columns.items()}

    def _read_columns(self, device: str | None) -> dict[str, dict[str, ChannelColumn]]:
        """Device -> channel -> column, of `device` alone (None: of all)."""
        found = ReadingColumns()

        def is_wanted(channel: Channel) -> bool:
            return channel.topic.startswith(READINGS) and device in (None, channel.topic.removeprefix(READINGS))

        for _ in self._decode(is_wanted, found.add):
            pass
        with name_file_in_errors(self.path / TELEMETRY):
            columns = found.columns()
        self._units |= found.units
        self._uncertain |= found.suspect
        return columns

    def steps(self) -> list[StepMark]:
        """Every step mark, in order of time."""
        found = self._decode(lambda channel: channel.topic == messages.STEP, decode_step_item)
        return sorted(found, key=attrgetter("time_ns"))

    def events(self) -> list[Event]:
        """Every event, in order of time."""
        found = self._decode(lambda channel: channel.topic == messages.EVENT, decode_event_item)
        return sorted(found, key=attrgetter("time_ns"))

    def originals(self) -> Iterator[Original]:
        """The thermal imager's pictures as their files were, in the order of the recording, each read when asked."""
        return self._decode(
            lambda channel: channel.topic == messages.ORIGINAL,
            lambda message: messages.decode_original(message.data, message.time_ns),
        )

    @cached_property
    def utc(self) -> UtcOffsets:
        """The offsets from the session's instants to UTC, as the host's system clock had it."""
        return collect_offsets(self.events())

    @property
    def frame_count(self) -> int:
        """How many frames were recorded."""
        return sum(self._frames_in_segments)

    @property
    def frame_times_ns(self) -> NDArray[np.int64]:
        """The middle of the exposure of each frame, shape (frame_count,), ascending."""
        return np.array([place.time_ns for place in self._iterate_places()], np.int64)

    def frames_table(self) -> FramesTable:
        """Return what is known of each frame as columns; no image is decoded."""
        return build_frames_table(self, list(self._iterate_places()))

    def to_xarray(self) -> SessionArrays:
        """The frames of each camera as a Dataset with a lazy dask array, and `telemetry` as another; only the tables of
        the frames are read now. SessionError when xarray or dask is not installed (extra `arrays`)."""
        for package in ("xarray", "dask.array"):
            import_extra(package, "arrays")
        from thermostand.recording.reading.lazy_arrays import SessionArrays  # a program that has none need not wait

        return SessionArrays(self, list(self._iterate_places()), lambda: self.utc)

    def frame(self, index: int) -> Frame:
        """Return one frame, decoded.

        Parameters
        ----------
        index
            Counted from 0 in order of time.

        Raises
        ------
        SessionError
            When the session has no frame of that index, or it cannot be read.
        """
        if not 0 <= index < self.frame_count:
            raise SessionError(f"{self.path}: has no frame {index}; it has {self.frame_count}, counted from 0")
        if not self._is_in_order:
            return decode_frame(read_recorded_image(self._sorted_places[index]))
        ends = list(accumulate(self._frames_in_segments))
        number = bisect_right(ends, index)
        places = self._list_places_in(self._frames[number])
        return decode_frame(read_recorded_image(places[index - ends[number]]))  # counted from the segment's end

    def frames(self) -> Iterator[Frame]:
        """The frames in order of time, each read and decoded when asked for."""
        return map(decode_frame, self.images())

    def images(self) -> Iterator[RecordedImage]:
        """The images in order of time as they were recorded, each read when asked for and not decoded."""
        return map(read_recorded_image, self._iterate_places())

    def items(self) -> Iterator[Item]:
        """Every batch, frame, step mark and event in the order of their publication, each read when asked for.
        Publishing the items to a recorder gives the same messages again."""
        return (item for _, item in self.published())

    def published(self) -> Iterator[tuple[int, Item]]:
        """Iterate as `items` does, with the instants of their publication. A frame comes behind what was published at
        its instant, but before the end of its step."""
        frames = iter(sorted(self._iterate_places(), key=attrgetter("meta.published_ns")))
        place = next(frames, None)
        for item in self._decode(is_item_channel, decode_item):
            ended = item.step_id if isinstance(item, StepMark) and item.state is not StepState.STARTED else None
            while place is not None and (
                place.meta.published_ns < item.time_ns
                or (place.meta.published_ns == item.time_ns and place.meta.step_id == ended)
            ):
                yield place.meta.published_ns, decode_frame(read_recorded_image(place))
                place = next(frames, None)
            yield item.time_ns, item
        while place is not None:
            yield place.meta.published_ns, decode_frame(read_recorded_image(place))
            place = next(frames, None)

    def frame_metas(self) -> list[messages.FrameMeta]:
        """The description of every frame, in order of time."""
        return [place.meta for place in self._iterate_places()]

    @property
    def _frames_in_segments(self) -> list[int]:
        """How many frames each segment has: two messages are one."""
        return [self._check(path).span.count // 2 for path in self._frames]

    @cached_property
    def _is_in_order(self) -> bool:
        """Whether each segment's frames are all later than those before: then one frame needs one segment's index."""
        spans = [span for path in self._frames if (span := self._check(path).span).count]
        return all(earlier.last_ns <= later.first_ns for earlier, later in pairwise(spans))

    def _iterate_places(self) -> Iterator[FramePlace]:
        """The frames in order of time."""
        if self._is_in_order:
            return chain.from_iterable(map(self._list_places_in, self._frames))
        return iter(self._sorted_places)

    @cached_property
    def _sorted_places(self) -> list[FramePlace]:
        return sorted(chain.from_iterable(map(self._list_places_in, self._frames)), key=attrgetter("time_ns"))

    def _list_places_in(self, segment: Path) -> list[FramePlace]:
        """The frames of one segment in order of time."""
        if segment not in self._places_of:
            self._check(segment)
            self._places_of[segment] = sorted(list_frame_places(segment), key=attrgetter("time_ns"))
        return self._places_of[segment]

    def _decode(self, wanted: Callable[[Channel], bool], decode: Callable[[RecordedMessage], T]) -> Iterator[T]:
        """The telemetry of the wanted channels in the order of the files, each message decoded."""
        for path in self._telemetry:
            self._check(path)
            for message in read_telemetry_messages(path, wanted):
                with name_file_in_errors(path):
                    item = decode(message)
                yield item

    @cached_property
    def scanned(self) -> Scan:
        """What is wrong with the session or missing, by its steps and frames. Reads the telemetry once."""
        return scan(self.path, Depth.STEPS)

    @property
    def holes(self) -> tuple[Hole, ...]:
        """What of the session is not there, of the telemetry first; those that are excused make it no less whole.
        SessionError when a segment cannot be read, for it may have had that."""
        for finding in self.scanned.findings:
            if finding.files is Files.DAMAGED and finding.where.endswith(FINISHED):
                raise FileDamaged(f"{self.path}/{finding.sentence}")
        return self.scanned.holes

    @property
    def run(self) -> RunOutcome:
        """How its run ended, as far as it is recorded."""
        return self.scanned.run

    def is_rewritten(self, segment: Path) -> bool:
        """Return whether another program has written a segment of the session."""
        with suppress(SessionError):
            return segment in self.segments and self._check(segment).rewritten is not None
        return False

    def _check(self, segment: Path) -> Head:
        """Return the head of a segment; SessionError when that is not of this session, or not of this place in it."""
        if segment in self._heads:
            return self._heads[segment]
        try:
            head = read_head(segment)
        except SessionError as error:
            raise _Unreadable(str(error)) from error
        if head.session != self.metadata:
            raise SessionError(f"{segment}: belongs to another session than {self._telemetry[0]}; move it away")
        if head.attachments != self._attachments:
            raise SessionError(
                f"{segment}: has other texts attached than {self._telemetry[0]}; one of them was changed"
            )
        if head.place and is_misplaced(segment.parent.name, _parse_number(segment), head.place, head.session):
            where = f"{head.place.get('series')}/{head.place.get('number')}{FINISHED}"
            raise SessionError(f"{segment}: was recorded as {where}; give it that name again, or move it away")
        self._heads[segment] = head
        return head


def _parse_number(segment: Path) -> int:
    return int(segment.name.partition(".")[0])


class _Unreadable(FileDamaged):
    """The head of a segment cannot be read."""


def open_whole(path: Path | str, incomplete: Say | None = None) -> Session:
    """Open the session in `path` if it is whole.

    Frames that were never acknowledged, or that the recorder itself reported as lost, do not count as missing.

    Parameters
    ----------
    path : path
        The folder of the session.
    incomplete : callable, optional
        Accept a session that is not whole; it gets the sentence that says what is missing.

    Returns
    -------
    Session
        The session, read from its folder.

    Raises
    ------
    SessionError
        When something is missing or was never finished, and `incomplete` is not given.
    """
    session = Session.open(path)
    check_whole(session, incomplete)
    return session


def check_whole(session: Session, incomplete: Say | None = None) -> None:
    """Check as `open_whole` does that a session that is open is whole."""
    path = session.path
    _check_finished(path, incomplete)
    rewritten = {file.name for file in session.scanned.inventory if session.is_rewritten(file.path)}
    missing = [hole.text(session.utc) for hole in session.holes if not hole.excused]
    for finding in session.scanned.findings:
        if finding.files is Files.DAMAGED and finding.where in ("", MANIFEST_NAME):
            raise SessionError(f"{path}: {finding.sentence}; take the session from its archive")
        if finding.files in (Files.INCOMPLETE, Files.UNKNOWN) and finding.where == MANIFEST_NAME:
            missing.append(finding.sentence)
        if finding.where in rewritten and finding.files is not Files.SOUND:
            if incomplete is None:
                raise SessionError(f"{path}/{finding.sentence}")
            incomplete(f"{path}/{finding.sentence}")
    if not missing:
        return
    more = [f"{len(missing) - _MOST} more"] if len(missing) > _MOST else []
    plan = (
        format_planned_frames(session.scanned.planned, session.frame_count)
        if session.run is RunOutcome.COMPLETE
        else ""
    )
    sentence = f"{path}: is incomplete; missing: {'; '.join([*missing[:_MOST], *more])}{plan}"
    if incomplete is None:
        raise SessionError(f"{sentence}; use --incomplete to read the rest")
    incomplete(f"{sentence}; only the rest is used")


def _check_finished(path: Path, incomplete: Say | None) -> None:
    """Segments that a killed recorder has left are not read: a repair finishes them."""
    left = [file.name for file in list_segments(path) if file.state is SegmentState.UNFINISHED]
    if not left:
        return
    sentence = f"{path}: {left[0]} {'is' if len(left) == 1 else f'and {len(left) - 1} more are'} not finished and"
    if incomplete is None:
        raise SessionError(f"{sentence} would be left out; `stand session repair {path}` first")
    incomplete(f"{sentence} left out; `stand session repair {path}` recovers what is in it")
