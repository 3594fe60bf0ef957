"""The one table that has a row for each frame."""

import math

import numpy as np
import pytest

from tests.recording.exports import csv_rows, export_session, parquet_rows
from tests.recording.full_session import make_half_second
from thermostand.foundation.items import Batch, StepMark
from thermostand.foundation.readings import Reading


@pytest.mark.parametrize(("table_format", "images"), [("csv", True), ("parquet", True), ("csv", False)])
async def test_one_table_has_a_row_for_each_frame(tmp_path, table_format, images):
    session, out = await export_session(tmp_path, telemetry=table_format, frames=images)
    rows = (csv_rows if table_format == "csv" else parquet_rows)(out / f"frames.{table_format}")
    table = session.frames_table()
    assert [int(row["time_ns"]) for row in rows] == session.frame_times_ns.tolist()
    assert [row["step_id"] for row in rows] == table.step_id.tolist()
    for column, values in (
        ("camera_temperature_degC", table.camera_degC),
        ("set_point_degC", table.chamber_degC),
        ("linear_position_mm", table.positions.get("linear")),
        ("rotary_position_deg", table.positions.get("rotary")),
    ):
        if values is not None:
            np.testing.assert_array_equal([float(row[column]) for row in rows], values)
    if images:
        assert all((out / row["file"]).is_file() for row in rows)
        assert not images or (out / "frames" / "index.csv").exists()
    else:
        assert [row["file"] for row in rows] == table.file.tolist()
    reported = (out / "README.txt").read_text()
    assert all(name in reported for name in ("set_point_degC", "role", "NAME_position_mm", "degrees Celsius"))


async def test_role_set_point_and_stages_are_those_of_the_step(tmp_path):
    def items(time_ns, index):
        reported = {"role": "reference", "chamber_degC": 15.0 + index, "frames": 1}
        for item in make_half_second(time_ns, index):
            yield (
                StepMark(time_ns, item.step_id, index, item.kind, item.state, reported)
                if isinstance(item, StepMark)
                else item
            )
        for axis, unit in (("linear", "mm"), ("rotary", "deg")):
            readings = (
                Reading(f"{axis}.position", 2.0 * index, unit, time_ns),
                Reading(f"{axis}.moving", 0, "1", time_ns),
            )
            yield Batch(axis, time_ns, readings)

    _, out = await export_session(tmp_path, count=4, items=items)
    rows = csv_rows(out / "frames.csv")
    assert [row["role"] for row in rows] == ["reference"] * 4
    assert [float(row["set_point_degC"]) for row in rows] == [15.0, 16.0, 17.0, 18.0]
    assert {"linear_position_mm", "rotary_position_deg"} <= rows[0].keys()


async def test_each_frame_has_the_thermometers_of_all_names(tmp_path):
    """Of names of the laboratory's own, from a poll on or until a resume, and nothing that is no temperature."""

    def items(time_ns, index):
        yield from make_half_second(time_ns, index)
        if index > 1:
            readings = (
                Reading("thermometers.pt100_7", 30.0 + index, "degC", time_ns),
                Reading("thermometers.pt100_7_raw", 7.0, "1", time_ns),
            )
            yield Batch("thermometers", time_ns, readings)

    _, out = await export_session(tmp_path, count=4, items=items)
    rows = csv_rows(out / "frames.csv")
    assert [float(row["thermometers.pt100_7_degC"]) for row in rows] == pytest.approx(
        [math.nan] * 3 + [32], nan_ok=True
    )
    assert not [name for name in rows[0] if "_raw" in name]
