"""What a session holds, message by message: items of the hub to protobuf and back, and what belongs to a frame.

Own messages are in package `thermostand`, one file each, made here at run time (no protoc); where Foxglove has a
schema its name is used. Readings are in recording/format/batches.py, images in recording/format/images.py.

Field numbers follow the order of the tables here. They are the file format: append, never reorder.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from itertools import chain
from operator import attrgetter
from typing import Any, cast

from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.Log_pb2 import Log
from foxglove_schemas_protobuf.Pose_pb2 import Pose
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from foxglove_schemas_protobuf.Quaternion_pb2 import Quaternion
from foxglove_schemas_protobuf.Vector3_pb2 import Vector3
from google.protobuf import descriptor_pool
from google.protobuf.descriptor_pb2 import FieldDescriptorProto, FileDescriptorProto
from google.protobuf.message import DecodeError, Message
from google.protobuf.message_factory import GetMessageClass
from google.protobuf.timestamp_pb2 import Timestamp

from thermostand.foundation.clock import NS_PER_S
from thermostand.foundation.errors import SessionError
from thermostand.foundation.items import Event, Original, StepMark, StepState
from thermostand.foundation.readings import Cause, Quality, Reading

TABLE_POSE = "/table/pose"
STEP = "/experiment/step"
EVENT = "/experiment/event"
LOG = "/log"
ORIGINAL = "/imager/original"

DOUBLE = FieldDescriptorProto.TYPE_DOUBLE
BYTES = FieldDescriptorProto.TYPE_BYTES
STRING = FieldDescriptorProto.TYPE_STRING
INT32 = FieldDescriptorProto.TYPE_INT32
UINT64 = FieldDescriptorProto.TYPE_UINT64
INSTANT = FieldDescriptorProto.TYPE_SFIXED64
ENUM = FieldDescriptorProto.TYPE_ENUM
MESSAGE = FieldDescriptorProto.TYPE_MESSAGE

QUALITY_NUMBER = {Quality.GOOD: 1, Quality.STALE: 2, Quality.BAD: 3}
QUALITY_OF_NUMBER = {number: quality for quality, number in QUALITY_NUMBER.items()}
ABSENT = 0

_pool = descriptor_pool.Default()


def make_field(
    name: str, number: int, kind: FieldDescriptorProto.Type.ValueType, type_name: str = ""
) -> FieldDescriptorProto:
    """One singular field; `type_name` for an enum or a message."""
    label = FieldDescriptorProto.LABEL_OPTIONAL
    return FieldDescriptorProto(name=name, number=number, type=kind, label=label, type_name=type_name or None)


def make_repeated_field(name: str, number: int, type_name: str) -> FieldDescriptorProto:
    """Any number of messages."""
    found = make_field(name, number, MESSAGE, type_name)
    found.label = FieldDescriptorProto.LABEL_REPEATED
    return found


def _make_class(name: str, fields: list[FieldDescriptorProto], *needs: str) -> type[Message]:
    """The class of `thermostand.<name>` with these fields, of messages of our own files that it needs."""
    file = FileDescriptorProto(name=f"thermostand/{name}.proto", package="thermostand", syntax="proto3")
    file.message_type.add(name=name, field=fields)
    file.dependency.extend(f"thermostand/{each}.proto" for each in needs)
    _pool.Add(file)
    return GetMessageClass(_pool.FindMessageTypeByName(f"thermostand.{name}"))


def _make_plain_class(name: str, fields: Mapping[str, FieldDescriptorProto.Type.ValueType]) -> type[Message]:
    """A message of scalar fields, numbered from 1 in order."""
    return _make_class(name, [make_field(each, number, kind) for number, (each, kind) in enumerate(fields.items(), 1)])


def _make_reading_file() -> FileDescriptorProto:
    """A reading in full, and its quality."""
    file = FileDescriptorProto(name="thermostand/Reading.proto", package="thermostand", syntax="proto3")
    fields = [
        make_field("channel", 1, STRING),
        make_field("value", 2, FieldDescriptorProto.TYPE_DOUBLE),
        make_field("unit", 3, STRING),
        make_field("time_ns", 4, INSTANT),
        make_field("quality", 5, FieldDescriptorProto.TYPE_ENUM, ".thermostand.Quality"),
        make_field("reason", 6, STRING),
        make_field("cause", 7, STRING),
    ]
    file.message_type.add(name="Reading", field=fields)
    quality = file.enum_type.add(name="Quality")
    for text, number in (("ABSENT", ABSENT), *((q.name, n) for q, n in QUALITY_NUMBER.items())):
        quality.value.add(name=text, number=number)
    return file


READING_FILE = _make_reading_file()
_pool.Add(READING_FILE)
_FRAME_META: Mapping[str, FieldDescriptorProto.Type.ValueType] = {
    "channel": STRING,
    "time_ns": INSTANT,  # middle of the exposure
    "published_ns": INSTANT,
    "step_id": STRING,
    "role": STRING,
    "chamber_degC": DOUBLE,
    "block_id": UINT64,
    "camera_ticks": UINT64,
    "exposure_s": DOUBLE,
    "gain_dB": DOUBLE,
    "camera_degC": DOUBLE,
    "dropped": UINT64,
    "flags": STRING,  # with a comma between them
    "width": INT32,
    "height": INT32,
    "significant_bits": INT32,
    "windows": BYTES,  # x, y, width, height of each, 32 bits, low byte first
}


# The description of a frame, and with it the last reading of each temperature and position of the stand.
FRAME_META_CLASS = _make_class(
    "FrameMeta",
    [
        *(make_field(name, number, kind) for number, (name, kind) in enumerate(_FRAME_META.items(), 1)),
        make_repeated_field("readings", len(_FRAME_META) + 1, ".thermostand.Reading"),
    ],
    "Reading",
)
_FrameTable = _make_class("FrameTable", [make_repeated_field("frames", 1, ".thermostand.FrameMeta")], "FrameMeta")
_Step = _make_plain_class(
    "Step", {"step_id": STRING, "index": INT32, "kind": STRING, "state": STRING, "parameters_json": STRING}
)
_Event = _make_plain_class("Event", {"level": STRING, "kind": STRING, "text": STRING, "data_json": STRING})

# Topic of the telemetry series, but for the readings of devices -> message class.
CLASSES: Mapping[str, type[Message]] = {
    TABLE_POSE: PoseInFrame,
    STEP: _Step,
    EVENT: _Event,
    LOG: Log,
    ORIGINAL: CompressedImage,
}

CAUSES: Mapping[str, Cause] = {"wire": "wire", "device": "device", "alarm": "alarm", "suspect": "suspect"}
LOG_LEVEL = {"info": Log.INFO, "warning": Log.WARNING, "error": Log.ERROR}


def canonicalise(value: float) -> float:
    """One bit pattern for every NaN: equal readings are equal bytes."""
    return math.nan if value != value else value


def decode_remark(remark: Any) -> Reading:
    """The inverse of remark_of; SessionError when it is none."""
    cause = CAUSES.get(remark.cause, "")
    return make_reading(
        remark.channel, remark.value, remark.unit, remark.time_ns, remark.quality, reason=remark.reason, cause=cause
    )


def make_reading(
    channel: str, value: float, unit: str, time_ns: int, quality: int, *, reason: str = "", cause: Cause = ""
) -> Reading:
    """A recorded reading; SessionError when its value does not fit its quality."""
    try:
        return Reading(channel, value, unit, time_ns, QUALITY_OF_NUMBER[quality], reason, cause)
    except (KeyError, ValueError) as error:
        raise SessionError(f"{channel}: the recorded value {value} does not fit its quality {quality}") from error


@dataclass(frozen=True, slots=True)
class FrameMeta:
    """A frame without its image: see foundation.readings.Frame. published_ns: when it was published. role,
    chamber_degC: what for, and the set-point, as its step says; "" and NaN when no step does. width, height: px.
    significant_bits: of a sample. windows: as in Frame, as bytes, b"" when all of the image is there."""

    channel: str
    time_ns: int
    published_ns: int
    step_id: str
    role: str
    chamber_degC: float
    block_id: int
    camera_ticks: int
    exposure_s: float
    gain_dB: float
    camera_degC: float
    dropped: int
    flags: tuple[str, ...]
    width: int
    height: int
    significant_bits: int
    windows: bytes


# Thousands are listed at once: the fields in the order of both tables, without a look-up of each name.
_FLAGS_PLACE = list(_FRAME_META).index("flags")
_BEFORE_FLAGS = attrgetter(*list(_FRAME_META)[:_FLAGS_PLACE])
_BEHIND_FLAGS = attrgetter(*list(_FRAME_META)[_FLAGS_PLACE + 1 :])


def encode_frame_meta(meta: FrameMeta, readings: Iterable[Reading] = ()) -> bytes:
    """The description as a message, with what the stand read last before the frame was published."""
    fields: dict[str, Any] = {name: getattr(meta, name) for name in _FRAME_META}
    fields |= {name: canonicalise(fields[name]) for name in ("chamber_degC", "camera_degC", "exposure_s", "gain_dB")}
    fields |= {"flags": ",".join(meta.flags), "readings": list(map(encode_remark, readings))}
    return FRAME_META_CLASS(**fields).SerializeToString()


def decode_frame_meta(data: bytes) -> FrameMeta:
    """The inverse of encode_frame_meta; SessionError when it is not one."""
    try:
        return _build_frame_meta(FRAME_META_CLASS.FromString(data))
    except DecodeError as error:
        raise SessionError(f"a frame's description cannot be read ({error})") from error


def _build_frame_meta(message: Message) -> FrameMeta:
    before, flags, behind = _BEFORE_FLAGS(message), _get(message, "flags"), _BEHIND_FLAGS(message)
    values: list[Any] = [*before, tuple(flags.split(",")) if flags else (), *behind]
    return FrameMeta(*values)


def encode_frame_table(descriptions: Iterable[bytes]) -> bytes:
    """The descriptions of a segment's frames, in their order, as one message."""
    parts = ((b"\x0a", encode_varint(len(description)), description) for description in descriptions)
    return b"".join(chain.from_iterable(parts))


def decode_frame_table(data: bytes) -> list[FrameMeta]:
    """The inverse; SessionError when it is none."""
    try:
        return list(map(_build_frame_meta, _get(_FrameTable.FromString(data), "frames")))
    except DecodeError as error:
        raise SessionError(f"the table of frames cannot be read ({error})") from error


def encode_varint(number: int) -> bytes:
    """Protobuf's encoding of a length: seven bits a byte, the lowest first, the top bit set on all but the last."""
    encoded = bytearray()
    while number > 0x7F:
        encoded.append(number & 0x7F | 0x80)
        number >>= 7
    encoded.append(number)
    return bytes(encoded)


def encode_remark(reading: Reading) -> dict[str, object]:
    """A reading in full, as the fields of a message."""
    return {
        "channel": reading.channel,
        "value": canonicalise(reading.value),
        "unit": reading.unit,
        "time_ns": reading.time_ns,
        "quality": QUALITY_NUMBER[reading.quality],
        "reason": reading.reason,
        "cause": reading.cause,
    }


def encode_step(mark: StepMark) -> bytes:
    """A step mark; parameters as JSON with sorted keys, what JSON does not know as its text."""
    return _Step(
        step_id=mark.step_id,
        index=mark.index,
        kind=mark.kind,
        state=mark.state.value,
        parameters_json=json.dumps(mark.parameters, sort_keys=True, ensure_ascii=False, default=str),
    ).SerializeToString()


def decode_step(data: bytes, time_ns: int) -> StepMark:
    """The inverse of encode_step; SessionError when it is not one."""
    m = _parse(STEP, data)
    parameters = _parse_json_object(_get(m, "parameters_json"), "step")
    try:
        state = StepState(_get(m, "state"))
    except ValueError as error:
        raise SessionError(f"a recorded step cannot be read ({error})") from error
    return StepMark(time_ns, _get(m, "step_id"), _get(m, "index"), _get(m, "kind"), state, parameters)


def _parse_json_object(text: str, what: str) -> dict[str, object]:
    """The keys and values of a JSON text; SessionError when it is none."""
    try:
        found = json.loads(text)
    except (ValueError, RecursionError) as error:  # JSON may be nested deeper than Python goes
        raise SessionError(f"a recorded {what} cannot be read ({error})") from error
    if not isinstance(found, dict):
        raise SessionError(f"a recorded {what} has JSON that is not keys and values")
    return cast("dict[str, object]", found)


def encode_event(event: Event) -> bytes:
    """An event of the stand; its data as JSON with sorted keys, "" when there is none."""
    data_json = json.dumps(dict(event.data), sort_keys=True, ensure_ascii=False, default=str) if event.data else ""
    return _Event(level=event.level, kind=event.kind, text=event.text, data_json=data_json).SerializeToString()


def decode_event(data: bytes, time_ns: int) -> Event:
    """The inverse of encode_event; SessionError when it is not one."""
    message = _parse(EVENT, data)
    fields = _parse_json_object(_get(message, "data_json") or "{}", "event")
    return Event(time_ns, _get(message, "level"), _get(message, "kind"), _get(message, "text"), fields)


def encode_log(event: Event) -> bytes:
    """The event as foxglove.Log, for the viewers' log panels."""
    level = LOG_LEVEL.get(event.level, Log.UNKNOWN)
    return Log(
        timestamp=make_timestamp(event.time_ns), level=level, name=event.kind, message=event.text
    ).SerializeToString()


def encode_original(original: Original) -> bytes:
    """A picture as its file was, as foxglove.CompressedImage whose frame is `device/name`."""
    stamp, frame = make_timestamp(original.time_ns), f"{original.device}/{original.name}"
    return CompressedImage(timestamp=stamp, frame_id=frame, data=original.data, format="jpeg").SerializeToString()


def decode_original(data: bytes, time_ns: int) -> Original:
    """The inverse of encode_original; SessionError when it is not one."""
    message = _parse(ORIGINAL, data)
    device, _, name = str(_get(message, "frame_id")).partition("/")
    return Original(time_ns, device, name, _get(message, "data"))


def encode_table_pose(time_ns: int, linear_mm: float, rotary_deg: float) -> bytes:
    """Encode where the table is, as foxglove.PoseInFrame in `stand`: x along the linear axis in m, rotation about z."""
    pose = _make_table_pose(linear_mm, rotary_deg)
    return PoseInFrame(timestamp=make_timestamp(time_ns), frame_id="stand", pose=pose).SerializeToString()


@lru_cache(1)
def _make_table_pose(linear_mm: float, rotary_deg: float) -> Pose:
    """A table stands still most of the time."""
    half_rad = math.radians(rotary_deg) / 2
    return Pose(
        position=Vector3(x=linear_mm / 1000), orientation=Quaternion(z=math.sin(half_rad), w=math.cos(half_rad))
    )


def make_timestamp(time_ns: int) -> Timestamp:
    """An instant in Foxglove's messages."""
    seconds, nanos = divmod(time_ns, NS_PER_S)
    return Timestamp(seconds=seconds, nanos=nanos)


def _get(message: Message, field: str) -> Any:
    """A field of a class made at run time, which has no static type."""
    return getattr(message, field)


def _parse(topic: str, data: bytes) -> Message:
    try:
        return CLASSES[topic].FromString(data)
    except DecodeError as error:
        raise SessionError(f"a message on {topic} is not a {CLASSES[topic].DESCRIPTOR.full_name} ({error})") from error
