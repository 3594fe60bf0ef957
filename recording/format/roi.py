"""Records the parts of an image that matter, and now and then all of it.

What is left out is evidence (dust, glare, a marker that was taken for another), so this is a choice and not the
default. A partial frame is a PNG of full size whose pixels outside the windows have one value; the windows are noted
in it (recording/format/images.py) and come back as Frame.windows.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from thermostand.foundation.clock import seconds_ns
from thermostand.foundation.readings import Frame
from thermostand.recording.format.images import ImageArray, Windows, encode_image

FindWindows = Callable[[ImageArray], Windows | None]

FILL_STEP_px = 4  # the median is taken of every fourth pixel of every fourth row


@dataclass(frozen=True, slots=True, eq=False)
class _Whole:
    """Result of the last whole frame that was searched; windows: None when none were found. fill_DN: its median, so
    that the edges of the windows do not look like edges of markers."""

    time_ns: int
    step_id: str
    shape: tuple[int, ...]
    dtype: np.dtype[np.uint8] | np.dtype[np.uint16]
    windows: Windows | None
    fill_DN: int


class RoiEncoder:
    """Frames in order of time to messages, one thread at a time.

    A frame is recorded whole and searched for windows when it is the first one of its channel, of another size, type
    or step than that channel's before, or `whole_every_s` after the last search (on the frames' own time). When
    windows were found, the frames up to the next search keep only those; else they are whole.
    """

    def __init__(self, find_windows: FindWindows, whole_every_s: float = 60.0) -> None:
        self.tell: Callable[[str], None] = lambda text: None  # of a search that failed; set by the recording
        self._find_windows = find_windows
        self._whole_every_ns = seconds_ns(whole_every_s)
        self._wholes: dict[str, _Whole] = {}  # channel -> its last whole frame

    def __call__(self, frame: Frame) -> bytes:
        """The frame's message; ValueError when the image is none, or a window is not within it. A frame that is
        partial already is recorded as it is."""
        if frame.windows is not None:
            return encode_image(frame, "roi")
        whole = self._wholes.get(frame.channel)
        if whole is None or not self._holds(whole, frame):
            data = encode_image(frame, "roi")
            self._wholes[frame.channel] = self._searched(frame)
            return data
        if whole.windows is None:
            return encode_image(frame, "roi")
        return encode_image(_partial(frame, whole.windows, whole.fill_DN), "roi")

    def _holds(self, whole: _Whole, frame: Frame) -> bool:
        image = frame.image
        before = (whole.step_id, whole.shape, whole.dtype)
        now = (frame.step_id, image.shape, image.dtype)
        return before == now and 0 <= frame.time_ns - whole.time_ns < self._whole_every_ns

    def _searched(self, frame: Frame) -> _Whole:
        image = frame.image
        return _Whole(
            time_ns=frame.time_ns,
            step_id=frame.step_id,
            shape=image.shape,
            dtype=image.dtype,
            windows=self._windows_in(image),
            fill_DN=int(np.median(image[::FILL_STEP_px, ::FILL_STEP_px])),
        )

    def _windows_in(self, image: ImageArray) -> Windows | None:
        try:
            return self._find_windows(image)
        except Exception as error:  # noqa: BLE001 - the frames stay whole, and that is never wrong
            self.tell(f"frames are recorded whole: the search for markers failed ({type(error).__name__}: {error})")
            return None


def _partial(frame: Frame, windows: Windows, fill_DN: int) -> Frame:
    """The frame with `fill_DN` in every pixel outside the windows."""
    image = np.full_like(frame.image, fill_DN)
    for x, y, width, height in windows.tolist():
        image[y : y + height, x : x + width] = frame.image[y : y + height, x : x + width]
    return replace(frame, image=image, windows=windows)
