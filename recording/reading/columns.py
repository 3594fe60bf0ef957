"""Readings of a whole topic as columns, without an object for each reading.

Most messages have no remarks, and then their fields are all there is: they are gathered in rows of values and of
qualities and checked together. The few others are decoded as batches.
"""

from __future__ import annotations

from array import array
from collections.abc import Iterator
from dataclasses import dataclass, field
from operator import attrgetter
from typing import Any

import numpy as np
from google.protobuf.message import DecodeError
from numpy.typing import NDArray

from thermostand.foundation.errors import SessionError
from thermostand.foundation.items import Batch
from thermostand.foundation.readings import Quality
from thermostand.recording.format import messages

Column = tuple[NDArray[np.int64], NDArray[np.float64]]

BAD = messages.QUALITY_NUMBER[Quality.BAD]
KNOWN = list(messages.QUALITY_OF_NUMBER)

Part = tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]  # numbers of the messages, times, values


@dataclass(frozen=True, slots=True)
class _Rows:
    """The plain messages of one device: of each its number, its time, its values and their qualities."""

    numbers: array[int] = field(default_factory=lambda: array("q"))
    times_ns: array[int] = field(default_factory=lambda: array("q"))
    values: array[float] = field(default_factory=lambda: array("d"))
    qualities: array[int] = field(default_factory=lambda: array("i"))


class TopicColumns:
    """The readings of one topic: `add` each message in the order of the files, then ask for the columns."""

    def __init__(self, topic: str) -> None:
        self._topic = topic
        self._quantities = messages.KIND_OF_TOPIC[topic].quantities
        self._parse = messages.CLASSES[topic].FromString
        names = [quantity.field for quantity in self._quantities]
        names += names[:1]  # twice the first: of a single name attrgetter makes no tuple
        self._values_of = attrgetter(*names)
        self._qualities_of = attrgetter(*(f"{name}_quality" for name in names))
        self._rows: dict[str, _Rows] = {}  # by device
        self._single: dict[
            tuple[str, str], list[tuple[int, int, float]]
        ] = {}  # (device, channel) -> number, time, value
        self.doubted: dict[str, list[int]] = {}  # by channel: the instants, ns, of readings with cause "doubt"
        self.units: dict[str, str] = {}  # by channel, as it was recorded first
        self._count = 0

    def add(self, data: bytes, log_time_ns: int) -> None:
        """One more message; SessionError when it is not one of this topic."""
        self._count += 1
        try:
            message: Any = self._parse(data)
        except DecodeError:
            message = None
        if message is None or message.remarks:
            self._add_singly(messages.decode_batch(self._topic, data, log_time_ns))
            return
        rows = self._rows.get(message.device)
        if rows is None:
            rows = self._rows[message.device] = _Rows()
        rows.numbers.append(self._count)
        rows.times_ns.append(message.time_ns or log_time_ns)
        rows.values.extend(self._values_of(message))
        rows.qualities.extend(self._qualities_of(message))

    def _add_singly(self, batch: Batch) -> None:
        for reading in batch.readings:
            self.units.setdefault(reading.channel, reading.unit)
            if reading.cause == "doubt":
                self.doubted.setdefault(reading.channel, []).append(reading.time_ns)
            single = self._single.setdefault((batch.device, reading.channel), [])
            single.append((self._count, reading.time_ns, reading.value))

    def columns(self) -> dict[str, dict[str, Column]]:
        """Device -> channel -> (time_ns, value) in order of time, of equal times in order of the files; SessionError
        when a value does not fit its quality."""
        parts: dict[tuple[str, str], list[Part]] = {}
        for device, rows in self._rows.items():
            for channel, part in self._parts(device, rows):
                parts.setdefault((device, channel), []).append(part)
        for key, single in self._single.items():
            numbers, times_ns, values = zip(*single, strict=True)
            part = (np.array(numbers, np.int64), np.array(times_ns, np.int64), np.array(values, np.float64))
            parts.setdefault(key, []).append(part)
        columns: dict[str, dict[str, Column]] = {device: {} for device in self._rows}
        for (device, channel), of_channel in parts.items():
            columns.setdefault(device, {})[channel] = _sorted(of_channel)
        return columns

    def _parts(self, device: str, rows: _Rows) -> Iterator[tuple[str, Part]]:
        """Each channel of a device with its readings in the plain messages."""
        numbers, times_ns = np.array(rows.numbers), np.array(rows.times_ns)
        all_values = np.array(rows.values).reshape(len(numbers), -1)
        all_qualities = np.array(rows.qualities).reshape(len(numbers), -1)
        for index, quantity in enumerate(self._quantities):
            is_given = all_qualities[:, index] != messages.ABSENT
            values, qualities = all_values[is_given, index], all_qualities[is_given, index]
            channel = f"{device}.{quantity.name}"
            is_wrong = (np.isnan(values) != (qualities == BAD)) | ~np.isin(qualities, KNOWN)
            if is_wrong.any():
                value, quality = values[is_wrong][0], qualities[is_wrong][0]
                raise SessionError(f"{channel}: the recorded value {value} does not fit its quality {quality}")
            if len(values):
                self.units[channel] = quantity.unit
                yield channel, (numbers[is_given], times_ns[is_given], values)


def _sorted(parts: list[Part]) -> Column:
    numbers, times_ns, values = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
    order = np.lexsort((numbers, times_ns))
    return times_ns[order], values[order]
