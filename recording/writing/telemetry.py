"""Items of the hub as records of the telemetry series."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from foundation.items import Batch, Event, Item, StepMark
from foundation.readings import Frame, Quality
from recording.format import messages
from recording.format.items import Description, UndescribedFrame
from recording.writing.segment import Record, Topic

SEQUENCE_MASK = 0xFFFF_FFFF  # MCAP has 32 bits for the block id; FrameMeta has all 64


class TelemetryEncoder:
    """Items of the hub to records of the telemetry series; `devices` maps a device's name to its kind."""

    def __init__(self, devices: Mapping[str, str]) -> None:
        unknown = sorted({kind for kind in devices.values() if kind not in messages.KINDS})
        if unknown:
            raise ValueError(f"no device kind {', '.join(unknown)}; there are {', '.join(messages.KINDS)}")
        self._devices = dict(devices)
        self._encoders = {
            name: messages.BatchEncoder(name, messages.KINDS[kind]) for name, kind in self._devices.items()
        }
        self._table: dict[str, float] = {}  # unit -> last position of the axis in that unit

    def topics(self) -> tuple[Topic, ...]:
        """The topics these devices need, and those every session has."""
        names = [kind.topic for name, kind in messages.KINDS.items() if name in self._devices.values()]
        if "axis" in self._devices.values():
            names.append(messages.TABLE_POSE)
        names += [messages.CAMERA_META, messages.STEP, messages.EVENT, messages.LOG]
        return tuple(Topic(name, messages.CLASSES[name], self._devices_on(name)) for name in names)

    def _devices_on(self, topic: str) -> tuple[str, ...]:
        return tuple(name for name, encoder in self._encoders.items() if encoder.topic == topic)

    def check(self, item: Item) -> None:
        """ValueError when the item is a batch of a device that was not declared."""
        if isinstance(item, Batch) and item.device not in self._encoders:
            raise ValueError(f"{item.device} is not among the recorded devices {', '.join(self._encoders)}")

    def encode(self, item: Item | Description) -> Iterator[Record]:
        """The item's records, most often one."""
        match item:
            case Batch():
                encoder = self._encoders[item.device]
                yield Record(encoder.topic, item.time_ns, encoder.encode(item))
                if self._devices[item.device] == "axis":
                    yield from self._pose(item)
            case Description():
                yield Record(messages.CAMERA_META, item.time_ns, item.data, item.sequence)
            case UndescribedFrame():
                pass  # a description is never invented
            case Frame():
                yield Record(
                    messages.CAMERA_META, item.time_ns, messages.encode_frame_meta(item), item.block_id & SEQUENCE_MASK
                )
            case StepMark():
                yield Record(messages.STEP, item.time_ns, messages.encode_step(item))
            case Event():
                yield Record(messages.EVENT, item.time_ns, messages.encode_event(item))
                yield Record(messages.LOG, item.time_ns, messages.encode_log(item))

    def _pose(self, batch: Batch) -> Iterator[Record]:
        """The table's pose for viewers, once both axes have told where they are; none while one does not know."""
        for reading in batch.readings:
            if reading.channel == f"{batch.device}.position":
                self._table.pop(reading.unit, None)
                if reading.quality is not Quality.BAD:
                    self._table[reading.unit] = reading.value
        if "mm" in self._table and "deg" in self._table:
            pose = messages.encode_table_pose(batch.time_ns, self._table["mm"], self._table["deg"])
            yield Record(messages.TABLE_POSE, batch.time_ns, pose)
