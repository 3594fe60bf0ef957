"""A week of what the stand did, in memory that does not grow, and answers of it for curves of a given number of points.

Each channel is kept as the smallest and largest value of each cell of two rings: cells of 1 s for the last hours, of
10 s for the week. A cell is (inf, -inf) without a reading and (_BAD, -_BAD) when all of its readings were BAD, so that
joining cells to columns is one minimum and one maximum. Of a column without a reading the value before it holds, for a
while: a channel that is polled every 30 s is no row of gaps, one that is BAD or is not polled any more is one.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Collection, Iterator, Mapping
from dataclasses import asdict, dataclass

import numpy as np
from numpy.typing import NDArray

from thermostand.foundation.clock import NS_PER_S, to_ns
from thermostand.foundation.items import Batch, Event, Item, StepMark, StepState
from thermostand.foundation.readings import Quality

FINE_S, FINE_CELLS = 1.0, 4 * 3600
COARSE_S, COARSE_CELLS = 10.0, 7 * 24 * 360
MOST_CHANNELS = 64  # round number; nothing was measured
MOST_POINTS = 5000  # of a curve: more than a screen is wide
MOST_MARKS = 2000  # round number; nothing was measured
_HOLDS_S = 100.0  # how long a value holds without another; stages are polled every 30 s
_UNKEPT = ("_raw",)  # resistances and currents behind temperatures: three curves for one thermometer

_BAD = float(np.finfo(np.float32).max)

Float = NDArray[np.float32]
Times = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Mark:
    """An event, or a step: then `level` is "step", `kind` and `text` are the step's, and end_ns is None while it is
    under way. Or `level` is "reference": from then on the drift of the camera `kind` counts from another frame, and is
    not to be compared with that before."""

    time_ns: int
    level: str
    kind: str
    text: str
    step_id: str = ""
    end_ns: int | None = None


@dataclass(frozen=True, slots=True)
class Columns:
    """Decimated curves. from_ns: when the first column begins; each is width_ns wide, and there are `points` of them.
    low, high: smallest and largest value in each column by channel, shape (points,), NaN without a value. units: by
    channel. marks: those in the time asked for, oldest first."""

    from_ns: int
    width_ns: int
    points: int
    low: Mapping[str, Float]
    high: Mapping[str, Float]
    units: Mapping[str, str]
    marks: tuple[Mark, ...]

    def as_json(self) -> dict[str, object]:
        """The history as the interface answers it; NaN becomes None, and `high` holds only channels that differ from
        `low`."""
        different = [name for name in self.low if not np.array_equal(self.low[name], self.high[name], equal_nan=True)]
        return {
            "from_ns": self.from_ns,
            "width_ns": self.width_ns,
            "points": self.points,
            "low": {name: _round_numbers(values) for name, values in self.low.items()},
            "high": {name: _round_numbers(self.high[name]) for name in different},
            "units": dict(self.units),
            "marks": [asdict(mark) for mark in self.marks],
        }


def _round_numbers(values: Float) -> list[float | None]:
    """Round to four decimals, a tenth of a millikelvin and of a millipixel: more would only be bytes."""
    rounded = np.round(values.astype(np.float64), 4).tolist()
    return [None if value != value else value for value in rounded]


class _Ring:
    """Cells of one width for all channels; `newest` is the number of the latest cell, -1 before the first reading."""

    def __init__(self, width_s: float, cells: int) -> None:
        self.width_ns = to_ns(width_s)
        self.cells = cells
        self.newest = -1
        self._low: Float = np.empty((0, cells), np.float32)
        self._high: Float = np.empty((0, cells), np.float32)

    def resize(self, rows: int) -> None:
        """Resize the arrays for so many channels."""
        more = np.full((rows - len(self._low), self.cells), np.inf, np.float32)
        self._low, self._high = np.concatenate((self._low, more)), np.concatenate((self._high, -more))

    def add(self, row: int, time_ns: int, value: float) -> None:
        """One reading; NaN is a BAD one. What is older than the ring is not kept."""
        cell = time_ns // self.width_ns
        if cell > self.newest:
            self._advance_to(cell)
        elif cell <= self.newest - self.cells:
            return
        at = cell % self.cells
        low, high = (_BAD, -_BAD) if math.isnan(value) else (value, value)
        if low < self._low.item(row, at):
            self._low[row, at] = low
        if high > self._high.item(row, at):
            self._high[row, at] = high

    def fill(self, row: int, times_ns: Times, values: NDArray[np.floating]) -> None:
        """Add many readings at once, in order of time."""
        cells = times_ns // self.width_ns
        if len(cells) and cells[-1] > self.newest:
            self._advance_to(int(cells[-1]))
        kept = cells > self.newest - self.cells
        at, values = cells[kept] % self.cells, values[kept].astype(np.float32)
        np.minimum.at(self._low[row], at, np.nan_to_num(values, nan=_BAD))
        np.maximum.at(self._high[row], at, np.nan_to_num(values, nan=-_BAD))

    def merge(self, row: int, other: _Ring, other_row: int) -> None:
        """Merge another ring's channel of the same cells, as far as they are not too old."""
        if other.newest > self.newest:
            self._advance_to(other.newest)
        numbers = np.arange(max(other.newest, self.newest) - self.cells + 1, other.newest + 1)
        at = numbers % self.cells
        self._low[row, at] = np.minimum(self._low[row, at], other._low[other_row, at])
        self._high[row, at] = np.maximum(self._high[row, at], other._high[other_row, at])

    def get_oldest_ns(self) -> int:
        """The instant of the oldest cell that may hold something."""
        return (self.newest - self.cells + 1) * self.width_ns

    def columns(self, rows: list[int], first: int, per_column: int, points: int) -> tuple[Float, Float]:
        """Lowest and highest, shape (rows, points), of columns of `per_column` cells, the first of which is `first`."""
        begin, end = max(first, self.newest - self.cells + 1, 0), min(first + per_column * points, self.newest + 1)
        low = np.full((len(rows), points), np.inf, np.float32)
        high = -low
        while begin < end:  # at most three pieces: up to a column's edge or the ring's end, whole columns, the rest
            column, at = (begin - first) // per_column, begin % self.cells
            stop = min(end, begin + self.cells - at)
            if (whole := (stop - begin) // per_column) and (begin - first) % per_column == 0:
                stop = begin + whole * per_column
            else:
                whole, stop = 1, min(stop, first + (column + 1) * per_column)
            shape, columns = (whole, (stop - begin) // whole), slice(column, column + whole)
            for index, row in enumerate(rows):
                part = slice(at, at + stop - begin)
                lowest, highest = self._low[row, part].reshape(shape), self._high[row, part].reshape(shape)
                low[index, columns] = np.minimum(low[index, columns], lowest.min(axis=1))
                high[index, columns] = np.maximum(high[index, columns], highest.max(axis=1))
            begin = stop
        return low, high

    def _advance_to(self, cell: int) -> None:
        """Make `cell` the newest; the cells that were not there yet are empty."""
        count = min(cell - self.newest, self.cells)
        begin, end = (cell - count + 1) % self.cells, cell % self.cells + 1
        for part in (slice(begin, end),) if begin < end else (slice(begin, None), slice(0, end)):
            self._low[:, part], self._high[:, part] = np.inf, -np.inf
        self.newest = cell


class History:
    """A subscriber of the hub. It is used from one thread.

    Readings whose channel ends in `_raw` are not kept, nor channels beyond MOST_CHANNELS. Memory: 0.6 MB a channel.
    """

    def __init__(self) -> None:
        self._rings = (_Ring(FINE_S, FINE_CELLS), _Ring(COARSE_S, COARSE_CELLS))
        self._capacity = 8
        for ring in self._rings:
            ring.resize(self._capacity)
        self._rows: dict[str, int] = {}
        self._units: dict[str, str] = {}
        self._infos: deque[Mark] = deque(maxlen=MOST_MARKS)  # so many of level info
        self._warned: deque[Mark] = deque(maxlen=MOST_MARKS)  # and so many of what is more
        self._steps: deque[Mark] = deque(maxlen=MOST_MARKS)
        self._references: deque[Mark] = deque(maxlen=MOST_MARKS)
        self._last_ns: dict[str, int] = {}

    def __call__(self, item: Item) -> None:
        """Follow one item."""
        match item:
            case Batch():
                for reading in item.readings:
                    value = math.nan if reading.quality is Quality.BAD else reading.value
                    self.add(reading.channel, reading.time_ns, value, reading.unit)
            case Event() | StepMark():
                self.mark(item)
            case _:
                pass

    def channels(self) -> tuple[str, ...]:
        """The channels that there are, in the order of their first reading."""
        return tuple(self._rows)

    def get_last_ns(self, channel: str) -> int | None:
        """Return when the latest reading of a channel was made, None without any."""
        return self._last_ns.get(channel)

    def add(self, channel: str, time_ns: int, value: float, unit: str) -> None:
        """One value of a channel; NaN for a measurement that is BAD."""
        row = self._row(channel, unit)
        if row is not None:
            self._last_ns[channel] = max(time_ns, self._last_ns.get(channel, 0))
            for ring in self._rings:
                ring.add(row, time_ns, value)

    def fill(self, channel: str, times_ns: Times, values: NDArray[np.floating], unit: str) -> None:
        """Add many values of a channel, in order of time, NaN for those that are BAD; shape (n,) both."""
        row = self._row(channel, unit)
        if row is not None and len(times_ns):
            self._last_ns[channel] = max(int(times_ns[-1]), self._last_ns.get(channel, 0))
            for ring in self._rings:
                ring.fill(row, times_ns, values)

    def merge(self, other: History) -> None:
        """Add what another one has, which was before this one."""
        for channel, other_row in other._rows.items():
            row = self._row(channel, other._units[channel])
            if row is not None:
                self._last_ns[channel] = max(other._last_ns.get(channel, 0), self._last_ns.get(channel, 0))
                for ring, others in zip(self._rings, other._rings, strict=True):
                    ring.merge(row, others, other_row)
        for marks, others in (
            (self._infos, other._infos),
            (self._warned, other._warned),
            (self._steps, other._steps),
            (self._references, other._references),
        ):
            own = tuple(marks)
            marks.clear()
            marks.extend((*others, *own))

    def mark(self, item: Event | StepMark) -> None:
        """Keep an event, or where a step is."""
        if isinstance(item, Event):
            kept = self._infos if item.level == "info" else self._warned
            kept.append(Mark(item.time_ns, item.level, item.kind, item.text))
            return
        if item.state is StepState.STARTED:
            self._steps.append(Mark(item.time_ns, "step", item.kind, _get_role(item), item.step_id))
            return
        for index in range(len(self._steps) - 1, max(-1, len(self._steps) - 9), -1):
            step = self._steps[index]
            if step.step_id == item.step_id and step.end_ns is None:
                self._steps[index] = Mark(step.time_ns, "step", step.kind, step.text, step.step_id, item.time_ns)
                return

    def reference(self, camera: str, time_ns: int) -> None:
        """Count the drift of this camera from another frame from then on."""
        self._references.append(Mark(time_ns, "reference", camera, ""))

    def columns(self, from_ns: int, to_ns: int, points: int = 1200, channels: Collection[str] | None = None) -> Columns:
        """Curves from `from_ns` to `to_ns` in at most `points` columns; ValueError when that is no time or no number.

        A column is a whole number of cells, at least one: short times have fewer columns. channels: None for all;
        those that are not there are left out. Before the oldest reading there is nothing.
        """
        if not from_ns < to_ns:
            raise ValueError(f"a history's end is after its beginning, not {to_ns} after {from_ns}")
        if not 1 <= points <= MOST_POINTS:
            raise ValueError(f"a history has 1 to {MOST_POINTS} points, not {points}")
        ring = self._choose_ring(from_ns, to_ns, points)
        cells = -(-(to_ns - from_ns) // ring.width_ns)
        per_column = max(1, -(-cells // points))
        first = from_ns // ring.width_ns // per_column * per_column  # a curve that moves keeps its columns
        count = -(-(to_ns // ring.width_ns + 1 - first) // per_column)
        first, count = self._limit_columns(ring, first, per_column, count)
        width_ns = per_column * ring.width_ns
        holds = max(1, round(_HOLDS_S * NS_PER_S / width_ns))
        names = [name for name in self._rows if channels is None or name in channels]
        rows = [self._rows[name] for name in names]
        found = _fill_gaps(*ring.columns(rows, first - holds * per_column, per_column, count + holds), holds)
        low, high = (dict(zip(names, values[:, holds:], strict=True)) for values in found)
        units = {name: self._units[name] for name in names}
        marks = tuple(self._iterate_marks(from_ns, to_ns))
        return Columns(first * ring.width_ns, width_ns, count, low, high, units, marks)

    def _row(self, channel: str, unit: str) -> int | None:
        row = self._rows.get(channel)
        if row is None and len(self._rows) < MOST_CHANNELS and not channel.endswith(_UNKEPT):
            row = self._rows[channel] = len(self._rows)
            self._units[channel] = unit
            if row >= self._capacity:
                self._capacity *= 2
                for ring in self._rings:
                    ring.resize(self._capacity)
        return row

    def _choose_ring(self, from_ns: int, to_ns: int, points: int) -> _Ring:
        """The fine one where it goes back far enough and is not finer than what is asked for by much."""
        fine, coarse = self._rings
        is_long = (to_ns - from_ns) // points > coarse.width_ns
        return coarse if is_long or from_ns < fine.get_oldest_ns() else fine

    def _limit_columns(self, ring: _Ring, first: int, per_column: int, count: int) -> tuple[int, int]:
        """The columns that can hold something: nobody is sent a century of nothing."""
        oldest = max(0, ring.newest - ring.cells + 1) // per_column * per_column
        skipped = min(max(0, (oldest - first) // per_column), count)
        first += skipped * per_column
        newest = max(0, -(-(ring.newest + 1 - first) // per_column))
        return first, min(count - skipped, newest + 1)

    def _iterate_marks(self, from_ns: int, to_ns: int) -> Iterator[Mark]:
        found = [
            mark
            for marks in (self._infos, self._warned, self._steps, self._references)
            for mark in marks
            if mark.time_ns < to_ns and (mark.time_ns if mark.level != "step" else mark.end_ns or to_ns) >= from_ns
        ]
        return iter(sorted(found, key=lambda mark: mark.time_ns))


def _get_role(mark: StepMark) -> str:
    """Return what the curves name a step by: a capture's role, a chamber's set-point."""
    for name in ("role", "chamber_degC", "text"):
        value = mark.parameters.get(name)
        if isinstance(value, str | int | float) and value != "":
            return str(value)
    return ""


def _fill_gaps(low: Float, high: Float, holds: int) -> tuple[Float, Float]:
    """Columns without a reading take the one before, over at most `holds` of them; those of BAD readings are NaN."""
    index = np.arange(low.shape[1])
    source = np.maximum.accumulate(np.where(np.isinf(low), -1, index), axis=1)
    stays = (source >= 0) & (index - source <= holds)
    found = [np.take_along_axis(values, np.maximum(source, 0), axis=1) for values in (low, high)]
    for values in found:
        values[~stays | (np.abs(values) == _BAD)] = np.nan
    return found[0], found[1]
