"""The telemetry of a session as tables, one for each device: a row an instant, a column a channel, named by what the
device calls it and its unit. What a device was read to measure without having declared it has columns behind the
others.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from operator import attrgetter
from pathlib import Path

from thermostand.foundation.items import Batch
from thermostand.foundation.readings import Channel, Reading
from thermostand.recording.exporting.tables import TABLES, Cell, Column, TableFormat, TableWriter
from thermostand.recording.format import messages
from thermostand.recording.format.batches import READINGS, name_fields
from thermostand.recording.format.decoded_items import decode_item
from thermostand.recording.format.records import read_telemetry_messages
from thermostand.recording.format.utc_offsets import UtcOffsets
from thermostand.recording.reading.recorded_devices import recorded_devices
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


def write_telemetry(
    session: Session, folder: Path, table_format: TableFormat, done: Callable[[int, str], None]
) -> None:
    """One table per device, in the order of the recording, and one of the frames' descriptions. `done` gets the bytes
    of each segment that has been read."""
    folder.mkdir()
    channels = _collect_channels(session)
    tables: dict[str, TableWriter] = {}
    with ExitStack() as stack:
        for path in session.telemetry_segments:
            for message in read_telemetry_messages(path, lambda channel: channel.topic.startswith(READINGS)):
                batch = decode_item(message)
                if not isinstance(batch, Batch):
                    continue
                name = batch.device
                if name not in tables:
                    columns = _make_columns(channels[name])
                    tables[name] = TABLES[table_format](folder / f"{name}.{table_format}", columns)
                    stack.callback(tables[name].close)
                for row in _iterate_batch_rows(channels[name], batch, session.utc):
                    tables[name].add(row)
            done(path.stat().st_size, f"telemetry {path.name}")
        if metas := session.frame_metas():
            described = TABLES[table_format](folder / f"camera_meta.{table_format}", META_COLUMNS)
            stack.callback(described.close)
            for meta in metas:
                described.add(_make_meta_row(meta, session.utc))


def _make_meta_row(meta: messages.FrameMeta, utc: UtcOffsets) -> Sequence[Cell]:
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


def _collect_channels(session: Session) -> dict[str, tuple[Channel, ...]]:
    """Return what each device declares, then what it was read to measure besides."""
    found = {name: device.channels for name, device in recorded_devices(session.telemetry_segments).items()}
    for channel, unit in session.units().items():
        device, _, name = channel.removesuffix(f" ({unit})").partition(".")
        if device in found and (name, unit) not in [(each.name, each.unit) for each in found[device]]:
            found[device] = (*found[device], Channel(name, unit))
    return found


def _make_columns(channels: tuple[Channel, ...]) -> tuple[Column, ...]:
    """time_ns is the instant of the measurement; a value's unit is in its name."""
    values = [
        column
        for field in name_fields(channels)
        for column in (Column(field, "value"), Column(f"{field}_quality", "word"))
    ]
    return (*TIME_COLUMNS, *values, Column("remarks", "text"))


def _iterate_batch_rows(channels: Sequence[Channel], batch: Batch, utc: UtcOffsets) -> Iterator[Sequence[Cell]]:
    """A row for each instant at which something was measured, most often one."""
    keys = [(f"{batch.device}.{each.name}", each.unit) for each in channels]
    for time_ns, readings in _group_by_instant(batch):
        cells: list[Cell] = []
        for key in keys:
            reading = readings.get(key)
            cells += (None, None) if reading is None else (reading.value, reading.quality.value)
        remarks = (_format_remark(reading, key in keys) for key, reading in readings.items())
        yield (time_ns, utc.utc_ns(time_ns), *cells, "; ".join(filter(None, remarks)))


def _group_by_instant(batch: Batch) -> Iterator[tuple[int, dict[tuple[str, str], Reading]]]:
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


def _format_remark(reading: Reading, has_column: bool) -> str:
    """The reason of a reading, and the reading itself when the table has no column for it; "" when there is neither."""
    if not has_column:
        value = f"{reading.channel} {reading.value!r} {reading.unit} {reading.quality.value}"
        return f"{value} ({reading.reason})" if reading.reason else value
    return f"{reading.channel}: {reading.reason}" if reading.reason else ""
