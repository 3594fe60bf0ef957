import json
import math
import subprocess
import sys

import cv2
import numpy as np
import pyarrow.parquet
import pytest

from tests.recording.exports import csv_rows, export_session, ignore_progress, parquet_rows
from tests.recording.full_session import ATTACHMENTS, INFO, MS, START_NS, frame, make_half_second, record
from thermostand.foundation.clock import NS_PER_S
from thermostand.foundation.errors import SessionError
from thermostand.foundation.instants import format_utc
from thermostand.foundation.items import Batch, Event
from thermostand.foundation.readings import Reading, bad_reading
from thermostand.recording.exporting.export import export
from thermostand.recording.exporting.state import describe_state
from thermostand.recording.exporting.tables import GROUP_ROWS, Column, ParquetTable
from thermostand.recording.format.layout import FRAMES
from thermostand.recording.reading.notes import add_note, add_tags
from thermostand.recording.reading.session import Session

# channel of the session -> table and column of the export
CHANNELS = {
    "thermometers.air": ("thermometers", "air_degC"),
    "thermometers.artifact": ("thermometers", "artifact_degC"),
    "regulator.pv": ("regulator", "pv_degC"),
    "linear.position": ("linear", "position_mm"),
    "rotary.position": ("rotary", "position_deg"),
}


def assert_readings_equal(session, channel, rows, column):
    mine = [row for row in rows if row[f"{column}_quality"]]
    times_ns, values = session.readings(channel)
    assert [int(row["time_ns"]) for row in mine] == times_ns.tolist()
    np.testing.assert_array_equal([float(row[column]) for row in mine], values)
    assert [row[f"{column}_quality"] == "bad" for row in mine] == np.isnan(values).tolist()


async def test_csv_reads_back_every_value_exactly(tmp_path):
    session, out = await export_session(tmp_path)
    assert sorted(CHANNELS) == session.channels()
    for channel, (table, column) in CHANNELS.items():
        assert_readings_equal(session, channel, csv_rows(out / "telemetry" / f"{table}.csv"), column)
    raw = (out / "telemetry" / "thermometers.csv").read_bytes()
    header, first = raw.split(b"\r\n")[:2]
    assert header.startswith(b"time_ns,time_utc,granite_inside_degC,granite_inside_degC_quality,")
    assert b"0.30000000000000004" in raw
    assert f"{START_NS - 3 * MS},2026-01-01T18:00:00.120456789Z,,," in first.decode()


async def test_parquet_reads_back_every_value_exactly_and_typed(tmp_path):
    session, out = await export_session(tmp_path, telemetry="parquet")
    for channel, (table, column) in CHANNELS.items():
        assert_readings_equal(session, channel, parquet_rows(out / "telemetry" / f"{table}.parquet"), column)
    schema = pyarrow.parquet.read_schema(out / "telemetry" / "thermometers.parquet")
    types = {name: str(schema.field(name).type) for name in ("time_ns", "time_utc", "air_degC", "remarks")}
    assert types == {"time_ns": "int64", "time_utc": "timestamp[ns, tz=UTC]", "air_degC": "double", "remarks": "string"}
    assert str(schema.field("air_degC_quality").type).startswith("dictionary<values=string")
    table = pyarrow.parquet.read_table(out / "telemetry" / "thermometers.parquet")
    assert table["time_utc"].cast("int64").to_pylist() == table["time_ns"].to_pylist()
    assert table["laboratory_degC"].null_count == len(table), "what was not measured is empty, not NaN"


@pytest.mark.parametrize("table_format", ["csv", "parquet"])
async def test_reasons_and_qualities_are_reported(tmp_path, table_format):
    _, out = await export_session(tmp_path, telemetry=table_format)
    rows = (csv_rows if table_format == "csv" else parquet_rows)(out / "telemetry" / f"thermometers.{table_format}")
    assert len(rows) == 24, "the readings of a batch that have two instants are two rows"
    bad, stale = rows[8], rows[9]
    assert bad["air_degC_quality"] == "bad"
    assert math.isnan(float(bad["air_degC"]))
    end = "line 2" if table_format == "csv" else "line\n2"  # a CSV cell has no control characters
    assert bad["remarks"] == f'thermometers.air: sensor break; "open", {end}'
    assert (stale["artifact_degC_quality"], stale["air_degC_quality"] or None) == ("stale", None)
    assert stale["remarks"] == "thermometers.artifact: not confirmed"


@pytest.mark.parametrize("table_format", ["csv", "parquet"])
async def test_quantities_that_were_not_declared_have_columns_each_unit_its_own(tmp_path, table_format):
    def items(time_ns, index):
        readings = (
            Reading("thermometers.humidity", 45.25, "%", time_ns),
            bad_reading("thermometers.=dew", "degC", time_ns, "no answer"),
            Reading("thermometers.pt100_7", 30.5, "degC", time_ns),
            Reading("thermometers.pt100_7_raw", 7.0, "1", time_ns),
            Reading("thermometers.pt100_7", 303.65, "K", time_ns),
            Reading("thermometers.air_degC", 1.0, "1", time_ns),
            Reading("thermometers.air", 20.5, "degC", time_ns),
            Reading("thermometers.air", 20.75, "degC", time_ns),
        )
        yield Batch("thermometers", time_ns, readings)

    session, out = await export_session(tmp_path, count=1, items=items, telemetry=table_format)
    rows = (csv_rows if table_format == "csv" else parquet_rows)(out / "telemetry" / f"thermometers.{table_format}")
    for name, column in (
        ("air", "air_degC"),
        ("pt100_7_raw", "pt100_7_raw"),
        ("humidity", "humidity_percent"),
    ):
        assert_readings_equal(session, f"thermometers.{name}", rows, column)
    assert (float(rows[0]["pt100_7_degC"]), rows[0]["pt100_7_degC_quality"]) == (30.5, "good")
    assert (math.isnan(float(rows[0]["dew_degC"])), rows[0]["dew_degC_quality"]) == (True, "bad")
    assert (float(rows[0]["pt100_7_K"]), float(rows[0]["air_degC_2"])) == (303.65, 1.0)
    assert rows[0]["remarks"] == "thermometers.=dew: no answer"


@pytest.mark.parametrize("encoding", ["zstd", "raw"])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
async def test_every_frame_is_a_png_of_its_pixels(tmp_path, encoding, dtype):
    session, out = await export_session(
        tmp_path, items=lambda time_ns, index: make_half_second(time_ns, index, dtype), encoding=encoding
    )
    names = sorted(path.name for path in (out / "frames").iterdir())
    assert names[:3] == ["000001.png", "000001.txt", "000002.png"]
    assert names[-1] == "index.csv"
    assert len(names) == 2 * 12 + 1
    for number, recorded in enumerate(session.frames(), 1):
        image = cv2.imread(str(out / "frames" / f"{number:06d}.png"), cv2.IMREAD_UNCHANGED)
        assert image.dtype == dtype
        np.testing.assert_array_equal(image, recorded.image)


def sidecar(path):
    """A sidecar as anything can read it: name -> text."""
    return dict(line.split(":", 1) for line in path.read_text(encoding="utf-8").splitlines())


async def test_the_sidecar_tells_the_temperatures_of_its_frame(tmp_path):
    session, out = await export_session(tmp_path)
    times_ns, air_degC = session.readings("thermometers.air")
    for number, shot in enumerate(session.frames(), 1):
        reported = sidecar(out / "frames" / f"{number:06d}.txt")
        assert reported["file"].strip() == f"{number:06d}.png"
        assert reported["time_utc"].strip() == format_utc(shot.time_ns)
        assert int(reported["time_ns"]) == shot.time_ns
        np.testing.assert_array_equal(float(reported["camera_temperature_degC"]), shot.camera_degC)
        assert (float(reported["exposure_s"]), float(reported["gain_dB"])) == (shot.exposure_s, shot.gain_dB)
        assert (int(reported["block_id"]), int(reported["dropped"])) == (shot.block_id, shot.dropped)
        assert reported["step_id"].strip() == shot.step_id
        before = times_ns <= shot.time_ns
        assert before.sum() == number - 1
        np.testing.assert_array_equal(
            float(reported["thermometers.air_degC"]), air_degC[before][-1] if before.any() else np.nan
        )
        age_s = (shot.time_ns - times_ns[before][-1]) / NS_PER_S if before.any() else np.nan
        np.testing.assert_array_equal(float(reported["thermometers.air_age_s"]), age_s)
    assert sidecar(out / "frames" / "000004.txt")["camera_temperature_degC"] == " nan"
    assert sidecar(out / "frames" / "000006.txt")["thermometers.air_degC"] == " nan", "a BAD reading is not passed over"


async def test_a_reading_counts_from_its_own_instant(tmp_path):
    def items(time_ns, index):
        for at_ns, pv_degC in ((time_ns, 21.0), (time_ns + 1, 22.0)):
            yield Batch("regulator", at_ns, (Reading("regulator.pv", pv_degC, "degC", at_ns),))
        yield frame(time_ns, index)

    _, out = await export_session(tmp_path, count=1, items=items)
    reported = sidecar(out / "frames" / "000001.txt")
    assert (reported["regulator.pv_degC"], reported["regulator.pv_age_s"]) == (" 21.0", " 0.0")


async def test_the_index_says_what_the_sidecars_say(tmp_path):
    _, out = await export_session(tmp_path, telemetry=None)
    rows = csv_rows(out / "frames" / "index.csv")
    assert len(rows) == 12
    for number, row in enumerate(rows, 1):
        assert {name: text.strip() for name, text in sidecar(out / "frames" / f"{number:06d}.txt").items()} == row


async def test_its_readme_says_how_a_text_was_changed_and_what_was_recorded_can_be_had_again(tmp_path):
    def hostile(time_ns, index):
        yield Event(time_ns, "info", "note", "=cmd|'/C calc'!A0\x1b[2J")
        yield Batch("regulator", time_ns, (Reading("regulator.pv", -1.5, "degC", time_ns),))

    _, out = await export_session(tmp_path, count=1, items=hostile)
    readme = " ".join((out / "README.txt").read_text(encoding="utf-8").split())
    assert "one of = + - @) has an apostrophe (')" in readme
    assert "Control characters" in readme
    (event,) = csv_rows(out / "events.csv")
    assert event["text"].removeprefix("'") == "=cmd|'/C calc'!A0[2J"
    assert event["text"].startswith("'")
    (state,) = csv_rows(out / "telemetry" / "regulator.csv")
    assert state["pv_degC"] == "-1.5"  # a number is no formula


async def test_steps_events_metadata_and_attachments_are_exported(tmp_path):
    session, out = await export_session(tmp_path, count=2, frames=False, telemetry=None)
    assert sorted(path.name for path in out.iterdir()) == [
        "README.txt",
        "attachments",
        "events.csv",
        "frames.csv",
        "ro-crate-metadata.json",
        "session.json",
        "steps.csv",
    ]
    steps = csv_rows(out / "steps.csv")
    assert [(row["step_id"], row["state"]) for row in steps] == [
        (mark.step_id, mark.state.value) for mark in session.steps()
    ]
    assert json.loads(steps[0]["parameters_json"]) == {"frames": 1, "interval_s": 0.5}
    events = csv_rows(out / "events.csv")
    assert [(int(row["time_ns"]), row["level"], row["kind"], row["text"]) for row in events] == [
        (event.time_ns, event.level, event.kind, event.text) for event in session.events()
    ]
    assert json.loads((out / "session.json").read_text(encoding="utf-8")) == {
        **INFO.metadata(),
        **describe_state(session)._asdict(),
        "findings": list(describe_state(session).findings),
    }
    for name, text in ATTACHMENTS.items():
        assert (out / "attachments" / name).read_bytes() == text.encode()


async def test_the_descriptions_of_frames_are_a_table_of_their_own(tmp_path):
    session, out = await export_session(tmp_path, frames=False)
    assert not (out / "frames").exists()
    rows = csv_rows(out / "telemetry" / "camera_meta.csv")
    assert [int(row["block_id"]) for row in rows] == [meta.block_id for meta in session.frame_metas()]
    np.testing.assert_array_equal(
        [float(row["camera_temperature_degC"]) for row in rows], [meta.camera_degC for meta in session.frame_metas()]
    )


async def test_progress_rises_to_the_end(tmp_path):
    await record(tmp_path / "s")
    reported = []
    export(Session.open(tmp_path / "s"), tmp_path / "out", report=lambda done, text: reported.append((done, text)))
    shares = [done for done, _ in reported]
    assert shares == sorted(shares)
    assert 0.5 < shares[-1] <= 1.0
    assert reported[-1][1] == "frame 12 of 12"


async def test_a_session_that_breaks_off_leaves_nothing(tmp_path):
    await record(tmp_path / "s")
    session = Session.open(tmp_path / "s")
    damaged = sorted((tmp_path / "s" / FRAMES).iterdir())[1]
    content = bytearray(damaged.read_bytes())
    content[len(content) // 2] ^= 1
    damaged.write_bytes(content)
    reported = []
    with pytest.raises(SessionError, match="damaged"):
        export(session, tmp_path / "out", report=lambda done, text: reported.append(text))
    assert any(text.startswith("frame") for text in reported), "it was on its way"
    assert [path.name for path in tmp_path.iterdir()] == ["s"]


async def test_an_interrupted_export_leaves_nothing(tmp_path):
    await record(tmp_path / "s")

    def interrupt(done, text):
        if text.startswith("frame 5"):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        export(Session.open(tmp_path / "s"), tmp_path / "out", report=interrupt)
    assert [path.name for path in tmp_path.iterdir()] == ["s"]


async def test_nothing_is_overwritten_by_an_export(tmp_path):
    session, out = await export_session(tmp_path, count=1)
    before = sorted(out.rglob("*"))
    with pytest.raises(SessionError, match="exists already"):
        export(session, out, report=ignore_progress)
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(SessionError, match="cannot be made"):
        export(session, tmp_path / "file" / "out", report=ignore_progress)
    (tmp_path / "next.part").mkdir()
    with pytest.raises(SessionError, match=r"next\.part: "):
        export(session, tmp_path / "next", report=ignore_progress)
    assert sorted(out.rglob("*")) == before
    assert (tmp_path / "next.part").is_dir()


@pytest.mark.parametrize("name", ["../config.yaml", "/etc/passwd", "a/b", "..", "", "a\0b"])
async def test_an_attachment_cannot_be_written_elsewhere(tmp_path, name):
    await record(tmp_path / "s", 1, attachments={name: "text"})
    with pytest.raises(SessionError, match="has no name"):
        export(Session.open(tmp_path / "s"), tmp_path / "out", report=ignore_progress)
    assert [path.name for path in tmp_path.iterdir()] == ["s"]


def test_a_long_table_is_written_in_groups(tmp_path):
    table = ParquetTable(tmp_path / "long.parquet", (Column("time_ns", "ns"), Column("device", "word")))
    rows = [(time_ns, f"axis-{time_ns // 10_000}") for time_ns in range(2 * GROUP_ROWS + 1)]
    for row in rows:
        table.add(row)
    table.close()
    assert pyarrow.parquet.read_metadata(tmp_path / "long.parquet").num_row_groups == 3
    assert [tuple(row.values()) for row in parquet_rows(tmp_path / "long.parquet")] == rows


PARQUET_WITHOUT_PYARROW = """
import sys
sys.modules["pyarrow"] = None  # as an interpreter that has none
from pathlib import Path
from thermostand.recording.exporting.state import describe_state
from thermostand.recording.exporting.export import export
from thermostand.recording.reading.session import Session
export(Session.open(Path(sys.argv[1])), Path(sys.argv[2]), telemetry="parquet", report=print)
"""


async def test_without_pyarrow_parquet_is_refused_with_a_sentence(tmp_path):
    await record(tmp_path / "s", 1)
    ended = subprocess.run(
        [sys.executable, "-c", PARQUET_WITHOUT_PYARROW, tmp_path / "s", tmp_path / "out"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert ended.returncode == 1
    assert ended.stderr.splitlines()[-1].startswith("thermostand.foundation.errors.SessionError: pyarrow ")
    assert not (tmp_path / "out").exists()


async def test_notes_and_tags_are_exported(tmp_path):
    await record(tmp_path / "s", 2)
    add_note(tmp_path / "s", "=SUM(A1)", "eva", START_NS)
    add_tags(tmp_path / "s", ["paper"], "eva", START_NS)
    export(Session.open(tmp_path / "s"), tmp_path / "out", report=ignore_progress)
    assert [(row["kind"], row["text"]) for row in csv_rows(tmp_path / "out" / "notes.csv")] == [
        ("note", "'=SUM(A1)"),
        ("tag", "paper"),
    ]
