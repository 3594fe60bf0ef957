"""What the segments of a session's two series have in common: their topics, metadata, sizes and reserves."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from mcap.writer import CompressionType

from thermostand.foundation.clock import seconds_ns
from thermostand.recording.format import messages
from thermostand.recording.format.batches import BatchForm, RecordedDevice, batch_form
from thermostand.recording.format.images import ZSTD_LEVEL, frame_topics
from thermostand.recording.format.journal_lines import text_hash
from thermostand.recording.format.layout import FRAMES, TELEMETRY
from thermostand.recording.format.manifest import Manifest
from thermostand.recording.writing.recorder_settings import RecordingSettings
from thermostand.recording.writing.segment import SeriesForm, Topic

TELEMETRY_RESERVE_BYTES = 16_000_000  # hours of it, so that it continues when frames or others fill the disk


@dataclass(frozen=True, slots=True)
class SessionForm:
    """metadata: of the session; attachments: texts by name; devices: by name."""

    metadata: Mapping[str, str]
    attachments: Mapping[str, str]
    devices: Mapping[str, RecordedDevice]
    settings: RecordingSettings

    def manifest(self) -> Manifest:
        """What is known of the session when it begins."""
        texts = {name: text_hash(text) for name, text in self.attachments.items()}
        devices = {name: declared(name, kind) for name, kind in self.devices.items()}
        return Manifest(dict(self.metadata), devices, texts)

    def frames(self) -> SeriesForm:
        """Of the frames: raw ones are chosen for speed."""
        settings = self.settings
        return SeriesForm(
            name=FRAMES,
            topics=frames_topics(self.devices),
            compression=CompressionType.NONE if settings.frame_encoding == "raw" else CompressionType.ZSTD,
            session=self.metadata,
            attachments=self.attachments,
            segment_bytes=settings.segment_bytes,
            segment_ns=seconds_ns(settings.segment_s),
            reserve_bytes=settings.segment_bytes,
            keep_free_bytes=settings.stop_frames_below_bytes,
            topic_of=frames_topic,
            level=ZSTD_LEVEL,
        )

    def telemetry(self) -> SeriesForm:
        """Of the telemetry: many small commits, merged when a segment is full."""
        return SeriesForm(
            name=TELEMETRY,
            topics=telemetry_topics(self.devices),
            compression=CompressionType.ZSTD,
            session=self.metadata,
            attachments=self.attachments,
            segment_bytes=self.settings.segment_bytes,
            segment_ns=seconds_ns(self.settings.segment_s),
            reserve_bytes=TELEMETRY_RESERVE_BYTES,
            merge_chunks=True,
        )


def declared(device: str, recorded: RecordedDevice) -> dict[str, object]:
    """What the manifest says of a device: its kind, and its channels, each with its unit."""
    return {"kind": recorded.kind, "channels": {f"{device}.{each.name}": each.unit for each in recorded.channels}}


def telemetry_topics(devices: Mapping[str, RecordedDevice]) -> tuple[Topic, ...]:
    """One for the readings of each of these devices, by name, and those every session has."""
    kinds = {device.kind for device in devices.values()}
    names = [messages.TABLE_POSE] * ("axis" in kinds) + [messages.ORIGINAL] * ("imager" in kinds)
    names += [messages.STEP, messages.EVENT, messages.LOG]
    own = (readings_topic(batch_form(name, device)) for name, device in devices.items())
    return (*own, *(Topic(name, messages.CLASSES[name]) for name in names))


def readings_topic(form: BatchForm) -> Topic:
    """The topic of a device."""
    return Topic(form.topic, form.message, form.metadata)


def frames_topics(devices: Mapping[str, RecordedDevice]) -> tuple[Topic, ...]:
    """Of the cameras among these devices; one that is not among them gets its topics with its first frame."""
    cameras = [name for name, device in devices.items() if device.kind == "camera"]
    return tuple(frames_topic(name) for camera in cameras for name in frame_topics(f"{camera}.image"))


def frames_topic(name: str) -> Topic:
    """The topic of that name (images.FrameTopics)."""
    return Topic(name, messages.FRAME_META_CLASS if name.endswith("/meta") else RawImage)
