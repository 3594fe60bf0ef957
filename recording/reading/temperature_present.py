"""Whether any frame has the camera's own temperature, without which no drift over it can be fitted."""

from __future__ import annotations

import math
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

from thermostand.foundation.errors import SessionError
from thermostand.recording.format.messages import FrameMeta
from thermostand.recording.format.records import frame_places

NO_TEMPERATURE = "no frame has a good camera temperature"


def has_temperature(metas: Iterable[FrameMeta]) -> bool | None:
    """By the descriptions of the frames, as far as the first that has one; None without any description."""
    found = None
    for meta in metas:
        if not math.isnan(meta.camera_degC):
            return True
        found = False
    return found


def has_recorded_temperature(segments: Iterable[Path]) -> bool | None:
    """By these segments of the frames, as far as they can be read."""

    def metas() -> Iterable[FrameMeta]:
        for path in segments:
            with suppress(SessionError):
                yield from (place.meta for place in frame_places(path))

    return has_temperature(metas())
