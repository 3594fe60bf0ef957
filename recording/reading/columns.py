"""Readings as columns, without an object for each reading.

Most messages have no remarks, and then their fields are all there is: they are gathered in rows of values and of
qualities and checked together. The few others are decoded as batches.
"""

from __future__ import annotations

from array import array
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from operator import attrgetter
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from google.protobuf.message import DecodeError
from numpy.typing import NDArray

from thermostand.foundation.errors import SessionError
from thermostand.foundation.extras import import_extra
from thermostand.foundation.items import Batch
from thermostand.recording.format import messages
from thermostand.recording.format.batches import BAD, KNOWN_QUALITIES, BatchSchema, disambiguate_channel
from thermostand.recording.format.records import RecordedMessage

if TYPE_CHECKING:
    import pandas as pd


class ChannelColumn(NamedTuple):
    """The readings of a channel in order of time, (n,) each: instants of the stand's clock, ns since 1970, and values,
    NaN where the reading was BAD."""

    time_ns: NDArray[np.int64]
    value: NDArray[np.float64]

    def to_pandas(self) -> pd.Series[float]:
        """The values over their instants, datetime64[ns] of the stand's clock. SessionError when pandas is not
        installed (extra `arrays`)."""
        values = import_extra("pandas", "arrays").Series(self.value, self.time_ns.astype("datetime64[ns]"))
        return values.rename_axis("time")


Part = tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]  # numbers of the messages, times, values


@dataclass(slots=True)
class _Rows:
    """The plain messages of one form: of each its number, its time, its values and their qualities."""

    form: BatchSchema
    values_of: Callable[[Any], Iterable[float]] = field(init=False)
    qualities_of: Callable[[Any], Iterable[int]] = field(init=False)
    numbers: array[int] = field(default_factory=lambda: array("q"))
    times_ns: array[int] = field(default_factory=lambda: array("q"))
    values: array[float] = field(default_factory=lambda: array("d"))
    qualities: array[int] = field(default_factory=lambda: array("i"))

    def __post_init__(self) -> None:
        names = (
            *self.form.fields,
            *self.form.fields[:1],
        )  # of a single name attrgetter makes no tuple
        if names:
            self.values_of = attrgetter(*names)
            self.qualities_of = attrgetter(*(f"{name}_quality" for name in names))


class ReadingColumns:
    """The readings of a session: `add` each message in the order of the files, then ask for the columns.

    A channel whose unit has changed, when a run was resumed with a device that declares another one, is two: the second
    has its unit in its name.
    """

    def __init__(self) -> None:
        self._rows: dict[BatchSchema, _Rows] = {}
        self._single: dict[
            tuple[str, str], list[tuple[int, int, float]]
        ] = {}  # (device, channel) -> number, time, value
        self.suspect: dict[str, list[int]] = {}  # by channel: the instants, ns, of readings with cause "suspect"
        self.units: dict[str, str] = {}  # by channel
        self._count = 0

    def add(self, message: RecordedMessage) -> None:
        """One more message of readings; SessionError when it is not one of its form."""
        self._count += 1
        form = message.form
        if form is None:
            raise SessionError(f"{message.topic} has no readings")
        rows = self._rows.get(form)
        if rows is None:
            rows = self._rows[form] = _Rows(form)
            for each in form.device.channels:
                self._name_channel(f"{form.name}.{each.name}", each.unit)
        try:
            found: Any = form.message.FromString(message.data)
        except DecodeError:
            found = None
        if found is None or found.remarks:
            self._add_singly(form.decode(message.data, message.time_ns))
            return
        rows.numbers.append(self._count)
        rows.times_ns.append(found.time_ns or message.time_ns)
        if form.fields:
            rows.values.extend(rows.values_of(found))
            rows.qualities.extend(rows.qualities_of(found))

    def _name_channel(self, channel: str, unit: str) -> str:
        """Return what a channel is called that is read in this unit."""
        name = disambiguate_channel(channel, unit, self.units.setdefault(channel, unit))
        self.units[name] = unit
        return name

    def _add_singly(self, batch: Batch) -> None:
        for reading in batch.readings:
            channel = self._name_channel(reading.channel, reading.unit)
            if reading.cause == "suspect":
                self.suspect.setdefault(channel, []).append(reading.time_ns)
            single = self._single.setdefault((batch.device, channel), [])
            single.append((self._count, reading.time_ns, reading.value))

    def columns(self) -> dict[str, dict[str, ChannelColumn]]:
        """Device -> channel -> (time_ns, value) in order of time, of equal times in order of the files; SessionError
        when a value does not fit its quality."""
        parts: dict[tuple[str, str], list[Part]] = {}
        for form, rows in self._rows.items():
            for channel, part in self._iterate_parts(form, rows):
                parts.setdefault((form.name, channel), []).append(part)
        for key, single in self._single.items():
            numbers, times_ns, values = zip(*single, strict=True)
            part = (np.array(numbers, np.int64), np.array(times_ns, np.int64), np.array(values, np.float64))
            parts.setdefault(key, []).append(part)
        columns: dict[str, dict[str, ChannelColumn]] = {form.name: {} for form in self._rows}
        for (device, channel), of_channel in parts.items():
            columns.setdefault(device, {})[channel] = _sort(of_channel)
        return columns

    def _iterate_parts(self, form: BatchSchema, rows: _Rows) -> Iterator[tuple[str, Part]]:
        """Each channel of a device with its readings in the plain messages."""
        numbers, times_ns = np.array(rows.numbers), np.array(rows.times_ns)
        shape = (len(numbers), len(form.fields) + 1 if form.fields else 0)
        all_values, all_qualities = np.array(rows.values).reshape(shape), np.array(rows.qualities).reshape(shape)
        for index, each in enumerate(form.device.channels):
            is_given = all_qualities[:, index] != messages.ABSENT
            values, qualities = all_values[is_given, index], all_qualities[is_given, index]
            channel = self._name_channel(f"{form.name}.{each.name}", each.unit)
            is_wrong = (np.isnan(values) != (qualities == BAD)) | ~np.isin(qualities, KNOWN_QUALITIES)
            if is_wrong.any():
                value, quality = values[is_wrong][0], qualities[is_wrong][0]
                raise SessionError(f"{channel}: the recorded value {value} does not fit its quality {quality}")
            if len(values):
                yield channel, (numbers[is_given], times_ns[is_given], values)


def _sort(parts: list[Part]) -> ChannelColumn:
    numbers, times_ns, values = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
    order = np.lexsort((numbers, times_ns))
    return ChannelColumn(times_ns[order], values[order])
