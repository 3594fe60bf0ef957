"""Exports of a recorded session, and their tables as they are read back."""

import csv

import pyarrow.parquet

from tests.recording.full_session import make_half_second, record
from thermostand.recording.exporting.export import export
from thermostand.recording.format.images import FrameEncoding
from thermostand.recording.reading.session import Session


def ignore_progress(done, text):
    pass


def csv_rows(path):
    with path.open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def parquet_rows(path):
    table = pyarrow.parquet.read_table(path)
    return table.select([name for name in table.column_names if name != "time_utc"]).to_pylist()  # datetime has no ns


async def export_session(tmp_path, *, count=12, items=make_half_second, encoding: FrameEncoding = "zstd", **choices):
    """The recorded session, and the folder it was exported to."""
    await record(tmp_path / "s", count, items, encoding)
    session = Session.open(tmp_path / "s")
    export(session, tmp_path / "out", report=ignore_progress, **choices)
    return session, tmp_path / "out"
