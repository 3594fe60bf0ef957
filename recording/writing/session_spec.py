"""What the segments of a session's two series have in common: their topics, metadata, sizes and reserves."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from mcap.writer import CompressionType

from thermostand.foundation.clock import to_ns
from thermostand.recording.format import messages
from thermostand.recording.format.batches import BatchSchema, RecordedDevice, make_batch_schema
from thermostand.recording.format.images import ZSTD_LEVEL
from thermostand.recording.format.journal_lines import hash_text
from thermostand.recording.format.layout import FRAMES, TELEMETRY
from thermostand.recording.format.manifest import Manifest
from thermostand.recording.writing.recorder_settings import RecordingSettings
from thermostand.recording.writing.segment import SeriesSpec, Topic

_TABLE_UNITS = ("mm", "deg")  # of the table's positions along, and around
TELEMETRY_RESERVE_BYTES = 16_000_000  # hours of it, so that it continues when frames or others fill the disk


@dataclass(frozen=True, slots=True)
class SessionSpec:
    """metadata: of the session; attachments: texts by name; devices: by name."""

    metadata: Mapping[str, str]
    attachments: Mapping[str, str]
    devices: Mapping[str, RecordedDevice]
    settings: RecordingSettings

    def make_manifest(self) -> Manifest:
        """Return what is known of the session when it begins."""
        texts = {name: hash_text(text) for name, text in self.attachments.items()}
        devices = {name: describe_device(name, kind) for name, kind in self.devices.items()}
        return Manifest(dict(self.metadata), devices, texts)

    def frames(self) -> SeriesSpec:
        """The specification of the frames' series: raw ones are chosen for speed."""
        settings = self.settings
        return SeriesSpec(
            name=FRAMES,
            topics=(),
            compression=CompressionType.NONE if settings.frame_encoding == "raw" else CompressionType.ZSTD,
            session=self.metadata,
            attachments=self.attachments,
            segment_bytes=settings.segment_bytes,
            segment_ns=to_ns(settings.segment_s),
            reserve_bytes=settings.segment_bytes,
            keep_free_bytes=settings.stop_frames_below_bytes,
            topic_of=make_frames_topic,
            level=ZSTD_LEVEL,
        )

    def make_telemetry_spec(self) -> SeriesSpec:
        """Make the specification of the telemetry's series: many small commits, merged when a segment is full."""
        return SeriesSpec(
            name=TELEMETRY,
            topics=list_telemetry_topics(self.devices),
            topic_of=_known_topic,
            compression=CompressionType.ZSTD,
            session=self.metadata,
            attachments=self.attachments,
            segment_bytes=self.settings.segment_bytes,
            segment_ns=to_ns(self.settings.segment_s),
            reserve_bytes=TELEMETRY_RESERVE_BYTES,
            merge_chunks=True,
        )


def describe_device(device: str, recorded: RecordedDevice) -> dict[str, object]:
    """Return what the manifest says of a device: its kind, its channels, each with its unit, and whether it is opened
    with the stand."""
    channels = {f"{device}.{each.name}": each.unit for each in recorded.channels}
    return {"kind": recorded.kind, "channels": channels, "is_opened": recorded.is_opened}


def list_telemetry_topics(devices: Mapping[str, RecordedDevice]) -> tuple[Topic, ...]:
    """One for the readings of each of these devices, by name, and those every session has. That of an imager's pictures
    begins with the first of them."""
    own = (make_readings_topic(make_batch_schema(name, device)) for name, device in devices.items())
    pose = [messages.TABLE_POSE] * (len(list_stages(devices)) == len(_TABLE_UNITS))
    return (*own, *map(_known_topic, (*pose, messages.STEP, messages.EVENT, messages.LOG)))


def list_stages(devices: Mapping[str, RecordedDevice]) -> dict[str, str]:
    """Device -> channel of the table's position along, and around: the first that declares one in mm, and in deg."""
    by_unit: dict[str, tuple[str, str]] = {}
    for name, device in devices.items():
        for each in device.channels:
            if each.kind == "position" and each.unit in _TABLE_UNITS:
                by_unit.setdefault(each.unit, (name, f"{name}.{each.name}"))
    return dict(by_unit.values())


def _known_topic(name: str) -> Topic:
    """The topic of that name that is not of a device; KeyError when there is none."""
    return Topic(name, messages.CLASSES[name])


def make_readings_topic(form: BatchSchema) -> Topic:
    """The topic of a device."""
    return Topic(form.topic, form.message, form.metadata)


def make_frames_topic(name: str) -> Topic:
    """The topic of that name (images.FrameTopics)."""
    return Topic(name, messages.FRAME_META_CLASS if name.endswith("/meta") else RawImage)
