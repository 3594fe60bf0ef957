"""What the segments of a session's two series have in common."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from mcap.writer import CompressionType

from foundation.clock import seconds_ns
from recording.format.images import CAMERA_IMAGE, IMAGE_CLASS
from recording.format.layout import FRAMES, TELEMETRY
from recording.writing.segment import SeriesForm, Topic
from recording.writing.settings import RecordingSettings
from recording.writing.writers import TelemetryEncoder

TELEMETRY_RESERVE_BYTES = 16_000_000  # hours of it, so that it continues when frames or others fill the disk


@dataclass(frozen=True, slots=True)
class SessionForm:
    """metadata: of the session; attachments: texts by name; devices: name -> kind."""

    metadata: Mapping[str, str]
    attachments: Mapping[str, str]
    devices: Mapping[str, str]
    settings: RecordingSettings

    def frames(self) -> SeriesForm:
        """Of the frames: PNG does not shrink further, and raw frames are chosen for speed."""
        settings = self.settings
        return SeriesForm(
            FRAMES,
            (Topic(CAMERA_IMAGE, IMAGE_CLASS[settings.frame_encoding]),),
            CompressionType.NONE,
            self.metadata,
            self.attachments,
            settings.segment_bytes,
            seconds_ns(settings.segment_s),
            reserve_bytes=settings.segment_bytes,
            keep_free_bytes=settings.stop_frames_below_bytes,
        )

    def telemetry(self) -> SeriesForm:
        """Of the telemetry: many small commits, merged when a segment is full."""
        return SeriesForm(
            TELEMETRY,
            TelemetryEncoder(self.devices).topics(),
            CompressionType.ZSTD,
            self.metadata,
            self.attachments,
            self.settings.segment_bytes,
            seconds_ns(self.settings.segment_s),
            reserve_bytes=TELEMETRY_RESERVE_BYTES,
            merge_chunks=True,
        )
