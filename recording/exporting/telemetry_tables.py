"""The telemetry of a session as tables, one for each topic: a row an instant, a column a quantity.

Devices have quantities beyond those of their kind, such as thermometers of a laboratory's own names: they have columns
behind the others, named by the quantity and its unit.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from operator import attrgetter
from pathlib import Path

from thermostand.foundation.items import Batch
from thermostand.foundation.readings import Reading
from thermostand.recording.exporting.tables import TABLES, Cell, Column, TableFormat, TableWriter
from thermostand.recording.exporting.topics import recorded_devices
from thermostand.recording.format import messages
from thermostand.recording.format.kinds import Quantity
from thermostand.recording.format.records import RecordedMessage, telemetry_messages
from thermostand.recording.format.utc_offsets import UtcOffsets
from thermostand.recording.reading.session import Session

TIME_COLUMNS = (Column("time_ns", "ns"), Column("time_utc", "utc"))
META_COLUMNS = (
    *TIME_COLUMNS,
    Column("channel", "word"),
    Column("step_id", "word"),
    Column("block_id", "count"),
    Column("camera_ticks_ns", "count"),
    Column("exposure_s", "value"),
    Column("gain_dB", "value"),
    Column("camera_temperature_degC", "value"),
    Column("dropped", "count"),
    Column("flags", "word"),
)
_UNIT_WORDS = {"%": "percent", "1": ""}

Quantities = Mapping[str, Sequence[Quantity]]  # by topic


def write_telemetry(
    session: Session, folder: Path, table_format: TableFormat, done: Callable[[int, str], None]
) -> None:
    """One table per topic, in the order of the recording, and one of the frames' descriptions. `done` gets the bytes of
    each segment that has been read."""
    folder.mkdir()
    quantities = _quantities(session)
    tables: dict[str, TableWriter] = {}
    with ExitStack() as stack:
        for path in session.telemetry_segments:
            for message in telemetry_messages(path, lambda channel: channel.topic in messages.KIND_OF_TOPIC):
                if message.topic not in tables:
                    name = message.topic.strip("/").replace("/", "_")
                    columns = _columns(message.topic, quantities)
                    table = TABLES[table_format](folder / f"{name}.{table_format}", columns)
                    stack.callback(table.close)
                    tables[message.topic] = table
                for row in _rows(message, quantities, session.utc):
                    tables[message.topic].add(row)
            done(path.stat().st_size, f"telemetry {path.name}")
        if metas := session.frame_metas():
            described = TABLES[table_format](folder / f"camera_meta.{table_format}", META_COLUMNS)
            stack.callback(described.close)
            for meta in metas:
                described.add(_described(meta, session.utc))


def _described(meta: messages.FrameMeta, utc: UtcOffsets) -> Sequence[Cell]:
    return (
        meta.time_ns,
        utc.utc_ns(meta.time_ns),
        meta.channel,
        meta.step_id,
        meta.block_id,
        meta.camera_ticks,
        meta.exposure_s,
        meta.gain_dB,
        meta.camera_degC,
        meta.dropped,
        ",".join(meta.flags),
    )


def _quantities(session: Session) -> Quantities:
    """Those of each kind, then those that its devices in this session have besides."""
    kinds = recorded_devices(session)
    found = {topic: list(kind.quantities) for topic, kind in messages.KIND_OF_TOPIC.items()}
    for channel, unit in session.units().items():
        device, _, name = channel.partition(".")
        if device not in kinds:
            continue
        own = found[messages.KINDS[kinds[device]].topic]
        word = _UNIT_WORDS.get(unit, unit)
        field = f"{name}_{word}" if word else name
        is_there = any((each.name, each.unit) == (name, unit) for each in own)
        if not is_there and not {field, f"{field}_quality"} & _taken(own):
            own.append(Quantity(name, unit, field))
    return found


def _taken(quantities: Sequence[Quantity]) -> set[str]:
    """Names of columns that are in use."""
    return {"time_ns", "time_utc", "device", "remarks"} | {
        name for each in quantities for name in (each.field, f"{each.field}_quality")
    }


def _columns(topic: str, quantities: Quantities) -> tuple[Column, ...]:
    """time_ns is the instant of the measurement; a value's unit is in its name."""
    values = [
        column
        for quantity in quantities[topic]
        for column in (Column(quantity.field, "value"), Column(f"{quantity.field}_quality", "word"))
    ]
    return (*TIME_COLUMNS, Column("device", "word"), *values, Column("remarks", "text"))


def _rows(message: RecordedMessage, quantities: Quantities, utc: UtcOffsets) -> Iterator[Sequence[Cell]]:
    batch = messages.decode_batch(message.topic, message.data, message.time_ns)
    yield from _batch_rows(quantities[message.topic], batch, utc)


def _batch_rows(quantities: Sequence[Quantity], batch: Batch, utc: UtcOffsets) -> Iterator[Sequence[Cell]]:
    """A row for each instant at which something was measured, most often one."""
    keys = [(f"{batch.device}.{quantity.name}", quantity.unit) for quantity in quantities]
    for time_ns, readings in _by_instant(batch):
        cells: list[Cell] = []
        for key in keys:
            reading = readings.get(key)
            cells += (None, None) if reading is None else (reading.value, reading.quality.value)
        remarks = (_remark(reading, key in keys) for key, reading in readings.items())
        yield (time_ns, utc.utc_ns(time_ns), batch.device, *cells, "; ".join(filter(None, remarks)))


def _by_instant(batch: Batch) -> Iterator[tuple[int, dict[tuple[str, str], Reading]]]:
    """(time_ns, (channel, unit) -> reading), ascending; a channel read twice at one instant gives two of them."""
    readings: dict[tuple[str, str], Reading] = {}
    time_ns = 0
    for reading in sorted(batch.readings, key=attrgetter("time_ns")):
        key = (reading.channel, reading.unit)
        if readings and (reading.time_ns != time_ns or key in readings):
            yield time_ns, readings
            readings = {}
        time_ns = reading.time_ns
        readings[key] = reading
    if readings:
        yield time_ns, readings


def _remark(reading: Reading, has_column: bool) -> str:
    """The reason of a reading, and the reading itself when the table has no column for it; "" when there is neither."""
    if not has_column:
        value = f"{reading.channel} {reading.value!r} {reading.unit} {reading.quality.value}"
        return f"{value} ({reading.reason})" if reading.reason else value
    return f"{reading.channel}: {reading.reason}" if reading.reason else ""
