"""Images and their descriptions compared: which lack the other, and for what reason."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass

from thermostand.recording.format.layout import FRAMES, TELEMETRY
from thermostand.recording.reading.contents import FrameKey
from thermostand.recording.reading.coverage import Coverage


@dataclass(frozen=True, slots=True)
class FrameAccount:
    """Keys of frames. bare: images without a description; gone: descriptions without an image, in both cases without
    a reason. bare_torn, gone_torn: lost when the recorder was killed. gone_reported: lost by the recorder, as it
    said."""

    bare: tuple[FrameKey, ...]
    bare_torn: tuple[FrameKey, ...]
    gone: tuple[FrameKey, ...]
    gone_reported: tuple[FrameKey, ...]
    gone_torn: tuple[FrameKey, ...]


def frame_account(
    images: Counter[FrameKey],
    block_ids: Mapping[FrameKey, int],
    described: Counter[FrameKey],
    reported: Iterable[range],
    coverage: Coverage,
    is_damaged_at: Callable[[str, int], bool] = lambda series, time_ns: False,
) -> FrameAccount:
    """`reported`: blocks that the recorder reported as lost. What was not read, is damaged (`is_damaged_at`) or is
    missing by the session's own record may have what is looked for: such frames are in none of the lists."""

    def unexplained(keys: Iterable[FrameKey], series: str) -> list[FrameKey]:
        unread = coverage.unread(series)
        return [
            key
            for key in keys
            if not is_damaged_at(series, key[0])
            and not coverage.is_reported(series, key[0])
            and not any(begin < key[0] < end for begin, end in unread)
        ]

    bare = unexplained(images - described, TELEMETRY)
    gone = unexplained(described - images, FRAMES)
    reported = tuple(reported)
    bare_torn = tuple(key for key in bare if coverage.is_torn_at(TELEMETRY, key[0]))
    gone_reported = tuple(key for key in gone if any(block_ids[key] in blocks for blocks in reported))
    gone_torn = tuple(key for key in gone if key not in gone_reported and coverage.is_torn_at(FRAMES, key[0]))
    return FrameAccount(
        tuple(key for key in bare if key not in bare_torn),
        bare_torn,
        tuple(key for key in gone if key not in {*gone_reported, *gone_torn}),
        gone_reported,
        gone_torn,
    )
