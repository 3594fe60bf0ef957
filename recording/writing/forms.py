"""What the segments of a session's two series have in common: their topics, metadata, sizes and reserves."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from mcap.writer import CompressionType

from thermostand.foundation.clock import seconds_ns
from thermostand.recording.format import messages
from thermostand.recording.format.images import CAMERA_IMAGE, IMAGE_CLASS
from thermostand.recording.format.layout import FRAMES, TELEMETRY
from thermostand.recording.writing.recorder_settings import RecordingSettings
from thermostand.recording.writing.segment import SeriesForm, Topic

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
            telemetry_topics(self.devices),
            CompressionType.ZSTD,
            self.metadata,
            self.attachments,
            self.settings.segment_bytes,
            seconds_ns(self.settings.segment_s),
            reserve_bytes=TELEMETRY_RESERVE_BYTES,
            merge_chunks=True,
        )


def telemetry_topics(devices: Mapping[str, str]) -> tuple[Topic, ...]:
    """The topics that these devices (name -> kind) need, and those every session has."""
    kinds = set(devices.values())
    names = [kind.topic for name, kind in messages.KINDS.items() if name in kinds]
    names += [messages.TABLE_POSE] * ("axis" in kinds) + [messages.ORIGINAL] * ("imager" in kinds)
    names += [messages.CAMERA_META, messages.STEP, messages.EVENT, messages.LOG]
    on = {name: tuple(each for each, kind in devices.items() if messages.KINDS[kind].topic == name) for name in names}
    return tuple(Topic(name, messages.CLASSES[name], on[name]) for name in names)
