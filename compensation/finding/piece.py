"""The unit of work: the markers in the frames of one segment within a range of time.

A piece names its frames and never holds one. It begins with a search and then tracks from frame to frame, so its
result depends on the file, the range, the target and the noise alone: it is the same to the bit in any process, on any
machine, and after any other piece.
"""

from __future__ import annotations

from collections.abc import Generator, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields
from operator import attrgetter
from pathlib import Path
from typing import cast

import numpy as np
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from google.protobuf.message import DecodeError
from numpy.typing import NDArray

from thermostand.compensation.finding.png_rows import decode_rows
from thermostand.compensation.one_camera import others_ns
from thermostand.foundation.errors import SessionError
from thermostand.foundation.instants import local_text
from thermostand.markers.detection import (
    Detection,
    DetectionError,
    Noise,
    detect,
    follow,
    nothing_found,
    rows_to_follow,
)
from thermostand.markers.pixels import Mask
from thermostand.markers.target import Target
from thermostand.recording.format.damage import naming
from thermostand.recording.format.images import ImageArray, decode_image
from thermostand.recording.format.records import FramePlace, Message, frame_places, read_frame
from thermostand.recording.reading.session import Session

Float = NDArray[np.float64]

FRAMES_PER_PIECE = 64
"""A search costs as much as five tracked frames, and several workers should have something to do in a short night."""


@dataclass(frozen=True, slots=True)
class Piece:
    """The `frames` frames of `segment` whose middles of exposure lie in [begin_ns, end_ns], without those at
    `others_ns`, which are other cameras'."""

    segment: Path
    begin_ns: int
    end_ns: int
    frames: int
    target: Target
    noise: Noise | None
    others_ns: frozenset[int] = frozenset()

    def places_of(self, places: Sequence[FramePlace]) -> list[FramePlace]:
        """Its own among the segment's frames."""
        return [
            place
            for place in places
            if self.begin_ns <= place.time_ns <= self.end_ns and place.time_ns not in self.others_ns
        ]


@dataclass(frozen=True, slots=True, eq=False)
class FoundMarkers:
    """K frames with N markers. time_ns (K,) int64 and block (K,) int64 (low 32 bits of the block id) name the frames;
    size_px (K, 2): width and height. centres_px (K, N, 2), covariance_px2 (K, N, 2, 2), chi (K, N): NaN for a marker
    without a centre. flags (K, N) uint8: of markers.Flag. homography (K, 3, 3): target mm -> px, NaN when the target
    was not found. doubtful (K,): the noise model does not describe the frame. reason (K) str: why the target was not
    found, else ""."""

    time_ns: NDArray[np.int64]
    block: NDArray[np.int64]
    size_px: NDArray[np.int64]
    centres_px: Float
    covariance_px2: Float
    chi: Float
    flags: NDArray[np.uint8]
    homography: Float
    doubtful: NDArray[np.bool_]
    reason: NDArray[np.str_]


def pieces_of(
    session: Session, target: Target, noise: Noise | None = None, frames_per_piece: int = FRAMES_PER_PIECE
) -> list[Piece]:
    """All the frames of a session's (leading) camera: its segments in order, each in order of time."""
    pieces: list[Piece] = []
    others = others_ns(session)
    for segment in session.frame_segments:
        places = [place for place in frames_in_order(segment) if place.time_ns not in others]
        for first in range(0, len(places), frames_per_piece):
            part = places[first : first + frames_per_piece]
            begin_ns, end_ns = part[0].time_ns, part[-1].time_ns
            theirs = frozenset(time_ns for time_ns in others if begin_ns <= time_ns <= end_ns)
            pieces.append(Piece(segment.resolve(), begin_ns, end_ns, len(part), target, noise, theirs))
    return pieces


def find_markers(piece: Piece) -> FoundMarkers:
    """Find the target in every frame of the piece; SessionError, with the frame's time, for one that cannot be read."""
    nothing = nothing_found(piece.target)
    rows: list[tuple[int, int, tuple[int, int], Detection, str]] = []
    previous: Detection | None = None
    image: ImageArray | None = None
    for frame in _frames(piece):
        detection, reason = None, ""
        if previous is not None and image is not None:
            image, detection = _followed(frame, image, piece, previous)
        if detection is None:
            before, image = image, frame.image(image)
            if before is None or image.shape != before.shape:
                previous = None
            try:
                detection = detect(image, piece.target, previous, piece.noise)
            except DetectionError as error:
                reason = str(error)
        previous = detection or previous
        height, width = cast(ImageArray, image).shape
        rows.append((frame.message.time_ns, frame.message.sequence, (width, height), detection or nothing, reason))
    found = [row[3] for row in rows]
    return FoundMarkers(
        time_ns=np.array([row[0] for row in rows], np.int64),
        block=np.array([row[1] for row in rows], np.int64),
        size_px=np.array([row[2] for row in rows], np.int64),
        centres_px=np.array([detection.centres_px for detection in found]),
        covariance_px2=np.array([detection.covariance_px2 for detection in found]),
        chi=np.array([detection.chi for detection in found]),
        flags=np.array([detection.flags for detection in found], np.uint8),
        homography=np.array([detection.homography for detection in found]),
        doubtful=np.array([detection.is_doubtful for detection in found], bool),
        reason=np.array([row[4] for row in rows], np.str_),
    )


def joined(parts: list[FoundMarkers]) -> FoundMarkers:
    """The frames of several pieces of one session, in order of time."""
    order = np.argsort(np.concatenate([part.time_ns for part in parts]), kind="stable")
    names = [field.name for field in fields(FoundMarkers)]
    return FoundMarkers(**{name: np.concatenate([getattr(part, name) for part in parts])[order] for name in names})


@dataclass(frozen=True, slots=True)
class _Frame:
    """A recorded frame, read and not yet decoded."""

    place: FramePlace
    message: Message

    def image(self, room: ImageArray | None = None, wanted: Mask | None = None) -> ImageArray:
        """Its pixels, in `room` where that is an image of its size, which is then gone; wanted: (height,), the rows
        that must be right. SessionError, with the frame's time, when it cannot be read."""
        is_room = room is not None and room.dtype == np.uint8 and room.flags.writeable
        with _naming(self.place):
            if self.place.schema != CompressedImage.DESCRIPTOR.full_name:
                return decode_image(self.place.schema, self.message.data).pixels
            try:
                png = CompressedImage.FromString(self.message.data).data
            except DecodeError as error:
                raise SessionError(f"an image message cannot be read ({error})") from error
            return decode_rows(png, cast(NDArray[np.uint8], room) if is_room else None, wanted)


def _frames(piece: Piece) -> Iterator[_Frame]:
    """Each frame as it is recorded."""
    for place in piece.places_of(frames_in_order(piece.segment)):
        with _naming(place):
            message = read_frame(place)
        yield _Frame(place, message)


@contextmanager
def _naming(place: FramePlace) -> Generator[None]:
    """Errors say which frame it was."""
    try:
        with naming(place.path):
            yield
    except SessionError as error:
        raise SessionError(f"{error}; this was the frame of {local_text(place.time_ns)}") from error


def _followed(
    frame: _Frame, before: ImageArray, piece: Piece, previous: Detection
) -> tuple[ImageArray, Detection | None]:
    """An image that is to be used again, and the markers found in those rows of the frame alone that it takes to go on
    from `previous`; None where it takes all of it. `before`: the image before, which is gone."""
    if before.dtype != np.uint8:  # of other depths only all pixels say how large one can be
        return before, None
    wanted = rows_to_follow(previous, piece.target, len(before))
    image = frame.image(before, wanted)
    if image.shape != before.shape or image.dtype != np.uint8:
        return before, None
    return image, follow(cast(NDArray[np.uint8], image), wanted, piece.target, previous, piece.noise)


def frames_in_order(segment: Path) -> list[FramePlace]:
    """The segment's frames in order of time, of all cameras."""
    return sorted(frame_places(segment), key=attrgetter("time_ns"))
