"""The readings of a device as messages, in a schema made of the channels that it declares.

Each device has a topic of its own, `/readings/NAME`, whose channel record says in its metadata which kind of device it
is and what it measures, each by its own name and unit. A message has one double per channel and its quality; a channel
that was not read is NaN and ABSENT, so that no viewer draws it as 0. `remarks` repeats in full each reading
that the fields cannot carry: it has a reason, an instant of its own, or was not declared.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, cast

from google.protobuf.descriptor_pb2 import FieldDescriptorProto, FileDescriptorProto
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message import DecodeError, Message
from google.protobuf.message_factory import GetMessageClass

from thermostand.foundation.errors import SessionError
from thermostand.foundation.items import Batch
from thermostand.foundation.readings import Channel, Quality, Reading
from thermostand.recording.format import messages

READINGS = "/readings/"  # with the device's name: its topic
_DEVICE, _KIND, _CHANNELS, _OPENED = "device", "kind", "channels", "opened"  # keys of a topic's metadata
_BY_USE = "by what uses it"  # the value of the last; there is none for a device that is opened with the stand
_UNIT_WORDS = {"%": "percent", "1": "", "": ""}
_DEVICE_NAME = re.compile(r"[a-z][a-z0-9_]{0,60}")


@dataclass(frozen=True, slots=True)
class RecordedDevice:
    """What is recorded of a device: its kind, and what it measures. is_opened: with the stand, and so read in each run;
    else by what uses it."""

    kind: str
    channels: tuple[Channel, ...]
    is_opened: bool = True


@dataclass(frozen=True, slots=True, eq=False)
class BatchSchema:
    """How the readings of the device `name` are recorded. fields: of each of its channels, in their order; message: the
    class of its messages."""

    name: str
    device: RecordedDevice
    fields: tuple[str, ...]
    message: type[Message]
    _field_of: Mapping[tuple[str, str], tuple[str, str]]  # channel and unit -> field of the value, of its quality
    _blank: Mapping[str, object]

    @property
    def topic(self) -> str:
        """The topic on which these batches are recorded."""
        return READINGS + self.name

    @property
    def metadata(self) -> dict[str, str]:
        """The metadata of the topic, from which `parse_batch_schema` makes the schema again."""
        channels = [[each.name, each.unit, each.kind] for each in self.device.channels]
        text = json.dumps(channels, ensure_ascii=False, separators=(",", ":"))
        opened = {} if self.device.is_opened else {_OPENED: _BY_USE}
        return {_DEVICE: self.name, _KIND: self.device.kind, _CHANNELS: text, **opened}

    def encode(self, batch: Batch) -> bytes:
        """The batch as one message; nothing of a reading is lost, for any channel, unit or time."""
        fields = {**self._blank}
        readings = batch.readings
        time_ns = (readings[0].time_ns if readings else 0) or batch.time_ns  # 0 in the message is the log time
        if time_ns != batch.time_ns:
            fields["time_ns"] = time_ns
        is_repeated = len({(reading.channel, reading.unit) for reading in readings}) < len(readings)
        remarks: list[dict[str, object]] = []
        for reading in readings:
            names = self._field_of.get((reading.channel, reading.unit))
            if names is not None:
                value = reading.value
                fields[names[0]] = value if value == value else math.nan
                fields[names[1]] = messages.QUALITY_NUMBER[reading.quality]
            if names is None or reading.reason or reading.cause or reading.time_ns != time_ns or is_repeated:
                remarks.append(messages.encode_remark(reading))
        if remarks:
            fields["remarks"] = remarks
        return self.message(**fields).SerializeToString()

    def decode(self, data: bytes, log_time_ns: int) -> Batch:
        """The batch of a message; SessionError when it is not one.

        Its readings are in order of the channels, behind them the remarks in the order they were published. Encoding it
        again gives the same bytes: the order between the two sorts is all that a message does not keep.
        """
        try:
            message: Any = self.message.FromString(data)
        except DecodeError as error:
            name = self.message.DESCRIPTOR.full_name
            raise SessionError(f"a message on {self.topic} is not a {name} ({error})") from error
        time_ns: int = message.time_ns or log_time_ns
        remarks = [messages.decode_remark(remark) for remark in message.remarks]
        known = {(reading.channel, reading.unit) for reading in remarks}
        readings: list[Reading] = []
        for (channel, unit), (field, of_quality) in self._field_of.items():
            quality: int = getattr(message, of_quality)
            if quality != messages.ABSENT and (channel, unit) not in known:
                readings.append(messages.make_reading(channel, getattr(message, field), unit, time_ns, quality))
        return Batch(self.name, log_time_ns, (*readings, *remarks))


@lru_cache(256)
def make_batch_schema(name: str, device: RecordedDevice) -> BatchSchema:
    """The form for the readings of a device; ValueError when it declares a channel twice."""
    keys = [(f"{name}.{each.name}", each.unit) for each in device.channels]
    if len(set(keys)) < len(keys):
        raise ValueError(f"{name} declares one of its channels twice")
    fields = name_fields(device.channels)
    pairs = [(field, f"{field}_quality") for field in fields]
    blank: dict[str, object] = {"device": name, **dict.fromkeys(fields, math.nan)}
    return BatchSchema(
        name, device, fields, _make_message_class(name, fields), dict(zip(keys, pairs, strict=True)), blank
    )


def parse_batch_schema(metadata: Mapping[str, str]) -> BatchSchema:
    """The form of a recorded topic, by its metadata; ValueError when they do not say it."""
    return _make_schema(*(metadata.get(key, "") for key in (_DEVICE, _KIND, _CHANNELS, _OPENED)))


@lru_cache(256)
def _make_schema(name: str, kind: str, text: str, opened: str) -> BatchSchema:
    if not _DEVICE_NAME.fullmatch(name):
        raise ValueError(f"{name!r} is not the name of a device")
    channels: object = json.loads(text)
    if not isinstance(channels, list):
        raise ValueError(f"what {name} measures is not a list")
    found: list[Channel] = []
    for each in cast("list[object]", channels):
        if not isinstance(each, list) or [type(part) for part in cast("list[object]", each)] != [str, str, str]:
            raise ValueError(f"{each!r} is not a channel of {name}")
        found.append(Channel(*cast("list[str]", each)))
    return make_batch_schema(name, RecordedDevice(kind, tuple(found), is_opened=opened != _BY_USE))


def name_fields(channels: Iterable[Channel]) -> tuple[str, ...]:
    """A name for each channel with its unit in it, as schemas and tables can have it: of letters, digits and _, each
    once."""
    taken = {"device", "remarks", "time_ns", "time_utc"}
    fields: list[str] = []
    for each in channels:
        parts = [re.sub(r"[^A-Za-z0-9]+", "_", part).strip("_") for part in (each.name, format_unit(each.unit))]
        plain = "_".join(part for part in parts if part) or "value"
        plain = plain if plain[0].isalpha() else f"of_{plain}"
        field, number = plain, 2
        while {field, f"{field}_quality"} & taken:
            field, number = f"{plain}_{number}", number + 1
        taken |= {field, f"{field}_quality"}
        fields.append(field)
    return tuple(fields)


def disambiguate_channel(channel: str, unit: str, first: str) -> str:
    """Return what a channel is called in a session in which it was recorded in the unit `first` before: its name, or
    with another unit `lab.pressure (mbar)`."""
    return channel if unit == first else f"{channel} ({unit})"


def format_unit(unit: str) -> str:
    """A unit as a part of a name: percent of %, l_per_min of l/min."""
    return _UNIT_WORDS.get(unit, unit.replace("%", "percent").replace("/", " per ").replace("µ", "u"))


@lru_cache(256)
def _make_message_class(name: str, fields: tuple[str, ...]) -> type[Message]:
    """device 1, remarks 2, time_ns 3 (of the readings; 0 when it is the log time), then value and quality of each
    channel. Each class is in a pool of its own: another session may have other channels of a device of that name."""
    own = [
        messages.make_field("device", 1, messages.STRING),
        messages.make_repeated_field("remarks", 2, ".thermostand.Reading"),
        messages.make_field("time_ns", 3, messages.INSTANT),
    ]
    for index, each in enumerate(fields):
        own.append(messages.make_field(each, 4 + 2 * index, FieldDescriptorProto.TYPE_DOUBLE))
        own.append(
            messages.make_field(
                f"{each}_quality", 5 + 2 * index, FieldDescriptorProto.TYPE_ENUM, ".thermostand.Quality"
            )
        )
    file = FileDescriptorProto(name=f"thermostand/{name}.proto", package="thermostand", syntax="proto3")
    file.dependency.append(messages.READING_FILE.name)
    file.message_type.add(name=name, field=own)
    pool = DescriptorPool()
    pool.Add(messages.READING_FILE)
    pool.Add(file)
    return GetMessageClass(pool.FindMessageTypeByName(f"thermostand.{name}"))


KNOWN_QUALITIES = [*messages.QUALITY_OF_NUMBER]
BAD = messages.QUALITY_NUMBER[Quality.BAD]
