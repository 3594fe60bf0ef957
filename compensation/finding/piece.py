"""The unit of work: the markers in the frames of one segment within a range of time.

A piece names its frames and never holds one. It begins with a search and then tracks from frame to frame, so its
result depends on the file, the range, the target and the noise alone: it is the same to the bit in any process, on any
machine, and after any other piece.
"""

from __future__ import annotations

from collections.abc import Generator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields
from operator import attrgetter
from pathlib import Path
from typing import cast

import numpy as np
from numpy.typing import NDArray

from thermostand.compensation.camera_selection import find_channel
from thermostand.foundation.errors import SessionError
from thermostand.foundation.instants import format_local
from thermostand.markers.detection import (
    Detection,
    DetectionError,
    Noise,
    detect,
    follow,
    make_empty_detection,
    predict_rows,
)
from thermostand.markers.target import Target
from thermostand.recording.format.damage import name_file_in_errors
from thermostand.recording.format.images import ImageArray, decode_image
from thermostand.recording.format.records import FramePlace, list_frame_places, read_frame
from thermostand.recording.reading.session import Session

Float = NDArray[np.float64]

# The search then costs 8 % of a piece; with half as many frames 16.
FRAMES_PER_PIECE = 64
"""A search costs as much as five tracked frames, and several workers should have something to do in a short session."""


@dataclass(frozen=True, slots=True)
class Piece:
    """`frames` frames of a camera's channel in `segment`, in order of time from its number `first` (from 0) on."""

    segment: Path
    channel: str
    first: int
    frames: int
    target: Target
    noise: Noise | None

    def select_places(self, places: Sequence[FramePlace]) -> list[FramePlace]:
        """Return this piece's own places among the segment's frames, which are in order of time."""
        own = [place for place in places if place.meta.channel == self.channel]
        return own[self.first : self.first + self.frames]


@dataclass(frozen=True, slots=True, eq=False)
class FoundMarkers:
    """K frames with N markers. time_ns (K,) int64 and block (K,) int64 (low 32 bits of the block id) name the frames;
    size_px (K, 2): width and height. centres_px (K, N, 2), covariance_px2 (K, N, 2, 2), chi (K, N): NaN for a marker
    without a centre. flags (K, N) uint8: of markers.Flag. homography (K, 3, 3): target mm -> px, NaN when the target
    was not found. suspect (K,): the noise model does not describe the frame. reason (K) str: why the target was not
    found, else ""."""

    time_ns: NDArray[np.int64]
    block: NDArray[np.int64]
    size_px: NDArray[np.int64]
    centres_px: Float
    covariance_px2: Float
    chi: Float
    flags: NDArray[np.uint8]
    homography: Float
    suspect: NDArray[np.bool_]
    reason: NDArray[np.str_]


def split_into_pieces(
    session: Session, target: Target, noise: Noise | None = None, frames_per_piece: int = FRAMES_PER_PIECE
) -> list[Piece]:
    """All the frames of a session's (leading) camera: its segments in order, each in order of time."""
    pieces: list[Piece] = []
    channel = find_channel(session)
    for segment in session.frame_segments:
        count = sum(place.meta.channel == channel for place in list_frame_places(segment))
        for first in range(0, count, frames_per_piece):
            part = min(frames_per_piece, count - first)
            pieces.append(Piece(segment.resolve(), channel, first, part, target, noise))
    return pieces


def find_markers(piece: Piece) -> FoundMarkers:
    """Find the target in every frame of the piece; SessionError, with the frame's time, for one that cannot be read."""
    nothing = make_empty_detection(piece.target)
    rows: list[tuple[FramePlace, tuple[int, int], Detection, str]] = []
    previous: Detection | None = None
    image: ImageArray | None = None
    for place in piece.select_places(list_frames_in_order(piece.segment)):
        detection, reason = None, ""
        before, image = image, _read_frame_image(place)
        if before is None or image.shape != before.shape:
            previous = None
        if previous is not None and image.dtype == np.uint8:  # of other depths only all pixels say how large one can be
            wanted = predict_rows(previous, piece.target, len(image))
            detection = follow(cast(NDArray[np.uint8], image), wanted, piece.target, previous, piece.noise)
        if detection is None:
            try:
                detection = detect(image, piece.target, previous, piece.noise)
            except DetectionError as error:
                reason = str(error)
        previous = detection or previous
        height, width = image.shape
        rows.append((place, (width, height), detection or nothing, reason))
    found = [row[2] for row in rows]
    return FoundMarkers(
        time_ns=np.array([row[0].time_ns for row in rows], np.int64),
        block=np.array([row[0].sequence for row in rows], np.int64),
        size_px=np.array([row[1] for row in rows], np.int64),
        centres_px=np.array([detection.centres_px for detection in found]),
        covariance_px2=np.array([detection.covariance_px2 for detection in found]),
        chi=np.array([detection.chi for detection in found]),
        flags=np.array([detection.flags for detection in found], np.uint8),
        homography=np.array([detection.homography for detection in found]),
        suspect=np.array([detection.is_suspect for detection in found], bool),
        reason=np.array([row[3] for row in rows], np.str_),
    )


def concatenate_markers(parts: list[FoundMarkers]) -> FoundMarkers:
    """The frames of several pieces of one session, in order of time."""
    order = np.argsort(np.concatenate([part.time_ns for part in parts]), kind="stable")
    names = [field.name for field in fields(FoundMarkers)]
    return FoundMarkers(**{name: np.concatenate([getattr(part, name) for part in parts])[order] for name in names})


def _read_frame_image(place: FramePlace) -> ImageArray:
    """Read a frame's pixels; SessionError, with the frame's time, when it cannot be read."""
    with _name_frame_in_errors(place):
        return decode_image(read_frame(place).image)


@contextmanager
def _name_frame_in_errors(place: FramePlace) -> Generator[None]:
    """Errors say which frame it was."""
    try:
        with name_file_in_errors(place.path):
            yield
    except SessionError as error:
        raise SessionError(f"{error}; this was the frame of {format_local(place.time_ns)}") from error


def list_frames_in_order(segment: Path) -> list[FramePlace]:
    """The segment's frames in order of time, of all cameras."""
    return sorted(list_frame_places(segment), key=attrgetter("time_ns"))
