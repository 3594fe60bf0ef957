"""A drift model from a CSV table of centres and temperatures, and what is reported of tables that are none."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from thermostand.compensation import cli
from thermostand.compensation.array_observations import load_observations
from thermostand.compensation.drift.model_file import load_model
from thermostand.compensation.drift_runtime import Drift
from thermostand.foundation.errors import SessionError

from .drawn_cameras import draw_camera
from .drawn_sessions import make_full_session, record_session

HEAD = "frame,marker,x_px,y_px,camera_degC"


def written(path: Path, *, air: bool) -> Path:
    """A drawn session as a table."""
    seen = record_session(draw_camera(1), make_full_session()).observed
    names = [*HEAD.split(","), "chamber_degC", "role", "time_ns", *(["air_degC"] if air else [])]
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(names)
        for k in range(len(seen.frame)):
            of_frame = [seen.chamber_degC[k], seen.role[k], seen.time_ns[k], *([seen.air_degC[k]] if air else [])]
            for n in range(0, 54, 5):
                writer.writerow([k, n, *seen.centres_px[k, n], seen.camera_degC[k], *of_frame])
    return path


def test_a_table_is_fitted_without_session_and_stand(tmp_path: Path) -> None:
    out = tmp_path / "model.json"
    done = CliRunner().invoke(cli.app, ["fit", str(written(tmp_path / "centres.csv", air=False)), "-o", str(out)])
    assert done.exit_code == 0, done.output
    assert done.stdout.startswith("paper: degree")
    model = load_model(out)
    assert model.facts.session_ids == ("centres",)
    assert np.abs(model.shift(np.array([[1200.0, 1000.0]]), 60.0)).max() > 0.1
    runtime_model = tmp_path / "runtime"
    exported = CliRunner().invoke(cli.app, ["export", str(out), "-o", str(runtime_model)])
    assert exported.exit_code == 0, exported.output
    (file,) = runtime_model.glob("*.json")
    assert isinstance(Drift.load(file), Drift)  # its terms cancel each other there, too


def test_a_table_gives_what_it_says(tmp_path: Path) -> None:
    path = written(tmp_path / "centres.csv", air=True)
    seen, found = record_session(draw_camera(1), make_full_session()).observed, load_observations(path, "C-1")
    assert found.sessions[0].camera_serial == "C-1"
    assert np.allclose(found.centres_px[:, ::5], seen.centres_px[:, ::5])
    assert np.isnan(found.centres_px[:, 1]).all()
    assert (found.role == seen.role).all()
    assert (found.time_ns == seen.time_ns).all()
    assert len(found.histories) == 1


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "has no column frame"),
        (HEAD + "\n", "has no rows"),
        ("frame,marker,x_px,y_px\n0,0,1,2\n", "has no column camera_degC"),
        (HEAD + "\n0,0,1\n", "line 2 has not as many cells"),
        (HEAD + "\n0,0,one,2,30\n", "line 2: x_px is 'one', not a number"),
        (HEAD + "\n0,0,inf,2,30\n", "line 2: x_px is 'inf', not a finite number"),
        (HEAD + "\n0,0,,,30\n1,0,,,31\n", "none of the 2 frames has a centre"),
        (HEAD + "\n0,-1,1,2,30\n", "line 2: marker is '-1'"),
        (HEAD + "\n0,99999999,1,2,30\n", "line 2: marker is '99999999'"),
        (HEAD + "\n0,0,1,2,30\n0,0,1,2,30\n", "line 3: frame 0 has this marker already"),
        (HEAD + "\n0,0,1,2,30\n0,1,1,2,31\n", "line 3: camera_degC of frame 0 is another one"),
        (HEAD + ",role\n0,0,1,2,30,best\n", "role is 'best', not one of reference"),
        (HEAD + ",air_degC\n0,0,1,2,30,20\n", "has air_degC without time_ns"),
        (HEAD + ",time_ns\n0,0,1,2,30,5\n1,0,1,2,30,4\n", "time_ns does not grow"),
        (HEAD + ",var_x_px2\n0,0,1,2,30,1\n", "has no column cov_xy_px2"),
        (
            HEAD + ",var_x_px2,cov_xy_px2,var_y_px2\n0,0,1,2,30,1,2,1\n",
            "line 2: var_x_px2, cov_xy_px2, var_y_px2 are no",
        ),
    ],
)
def test_what_is_no_table_of_centres_is_refused_with_file_line_and_column(text: str, says: str, tmp_path: Path) -> None:
    path = tmp_path / "centres.csv"
    path.write_text(text)
    with pytest.raises(SessionError, match=r"centres\.csv: ") as raised:
        load_observations(path)
    assert says in str(raised.value)
    assert "\n" not in str(raised.value)


CELLS = [["frame", "marker", "x_px", "y_px", "camera_degC"]] + [
    [str(frame), str(marker), f"{1512.5 + marker + frame / 8:.4f}", f"{98.25 + frame:.3f}", f"{-5.5 + frame:.2f}"]
    for frame in range(3)
    for marker in range(2)
]


def joined(sign: str, *, decimal: str = ".", end: str = "\n") -> str:
    return "".join(sign.join(cell.replace(".", decimal) for cell in row) + end for row in CELLS)


def quoted(sign: str) -> str:
    return "".join(sign.join(f'"{cell.replace(".", ",")}"' for cell in row) + "\n" for row in CELLS)


SPREADSHEETS = {
    "comma": joined(",").encode(),
    "semicolon, decimal comma": joined(";", decimal=",").encode(),
    "semicolon, decimal point": joined(";").encode(),
    "tab, decimal comma": joined("\t", decimal=",").encode(),
    "bar": joined("|").encode(),
    "blanks": joined("  ").encode(),
    "comma, quoted decimal comma": quoted(",").encode(),
    "CRLF": joined(",", end="\r\n").encode(),
    "CR": joined(",", end="\r").encode(),
    "BOM": joined(",").encode("utf-8-sig"),
    "UTF-16": joined("\t", decimal=",").encode("utf-16"),
    "UTF-16 without BOM": joined("\t", decimal=",").encode("utf-16-le"),
    "UTF-16, big end first": b"\xfe\xff" + joined(";").encode("utf-16-be"),
    "cp1252": joined(";").replace("frame", "°;frame").replace("\n", "\n25 °;", 6).encode("cp1252"),
    "sep=": b"sep=;\r\n" + joined(";", decimal=",", end="\r\n").encode(),
    "quoted sep=": b'"sep=|"\n' + joined("|").encode(),
    "capitals": joined(",").replace("x_px", "X_PX").replace("camera_degC", "CAMERA_DEGC").encode(),
    "frames with a point": joined(",").replace("\n1,", "\n1.0,").replace("\n2,", "\n2.000,").encode(),
    "empty last rows": (joined(";") + ";;;;\n" * 3 + "\n\n").encode(),
    "empty last columns": joined(";").replace("\n", ";;\n").encode(),
    "thousands by points": joined(";", decimal=",").replace("1512,", "1.512,").encode(),
    "thousands by commas": joined(";").replace("1512.", "1,512.").encode(),
    "thousands by apostrophes": joined(";").replace("1512.", "1'512.").encode(),
    "thousands by narrow blanks": joined(";", decimal=",").replace("1512,", "1\u202f512,").encode(),
    "minus sign": joined(",").replace("-", "\u2212").encode(),
    "blanks about cells": joined(" ; ").encode(),
}  # fmt: skip


@pytest.mark.parametrize("name", SPREADSHEETS)
def test_a_table_is_read_as_any_country_and_program_writes_it(name: str, tmp_path: Path) -> None:
    path = tmp_path / "centres.csv"
    path.write_bytes(SPREADSHEETS[name])
    found = load_observations(path)
    wanted = np.array([[[1512.5 + m + f / 8, 98.25 + f] for m in range(2)] for f in range(3)])
    assert found.centres_px.tolist() == wanted.tolist()
    assert found.camera_degC.tolist() == [-5.5, -4.5, -3.5]


SEMI = "frame;marker;x_px;y_px;camera_degC\n"


@pytest.mark.parametrize(
    ("data", "says"),
    [
        (b"PK\x03\x04 a workbook", "save it as CSV"),
        (b"\x89PNG\r\n\x1a\n\0\0\0\x0d", "not text"),
        (SEMI + "0;0;512,345;100,125;25,000\n", "line 2: x_px may be read in two ways"),
        (SEMI + "0;0;512,3;100.1;25\n0;1;512.3;100.1;25\n", "line 2: x_px may be read in two ways"),
        (SEMI + "0;0;512,3 px;100,1;25\n", "line 2: x_px is '512,3 px', not a number; write it without a unit"),
        (SEMI + "0;0;#DIV/0!;100,1;25\n", "line 2: x_px is '#DIV/0!'"),
        (SEMI + "0;0;25. Mrz;100,1;25\n", "line 2: x_px is '25. Mrz'"),
        (SEMI + "\n\n1,5;0;512,3;100,1;25\n", "line 4: frame is '1.5', not a whole number"),
        (SEMI + "1E+03;0;512,3;100,1;25\n", "line 2: frame is '1E+03', which a spreadsheet has rounded"),
        (SEMI + "0;0;1_0;100,1;25\n", "line 2: x_px is '1_0', not a number"),
        ("frame;marker;x_px;y_px;camera_degC;time_ns\n0;0;1,5;2;30;1,7679E+18\n", "time_ns is '1.7679E+18', which a"),
        ("frame;Frame;marker;x_px;y_px;camera_degC;frame\n", "has two columns frame"),
        ("Bild;Punkt;X;Y;T\n0;0;1;2;3\n", "has no column frame"),
        ("sep=;\nframe;marker;x_px;y_px;camera_degC\n0;0;1;2\n", "line 3 has not as many cells"),
        ('frame,marker,x_px,y_px,camera_degC\n0,0,"1,2,30\n', "cannot be read as a CSV table"),
    ],
)
def test_a_table_that_cannot_be_read_says_what_to_change(data: str | bytes, says: str, tmp_path: Path) -> None:
    path = tmp_path / "centres.csv"
    path.write_bytes(data if isinstance(data, bytes) else data.encode())
    with pytest.raises(SessionError, match=r"centres\.csv: ") as raised:
        load_observations(path)
    assert says in str(raised.value)


def test_sessions_of_a_table_have_a_reference_each_and_readings_go_to_the_history(tmp_path: Path) -> None:
    head = "session,frame,marker,x_px,y_px,camera_degC,time_ns,air_degC,width_px,height_px\n"
    rows = [f"{'ab'[f // 4]},{f},1,{100 + f},50,{20 + f % 4},{f * 60 * 10**9},{15 + f},640,480\n" for f in range(8)]
    readings = "".join(f",,,,,,{(f * 60 + 30) * 10**9},{15.5 + f},,\n" for f in range(7))
    path = tmp_path / "t.csv"
    path.write_text(head + "".join(rows) + readings)
    found = load_observations(path)
    assert [facts.session_id for facts in found.sessions] == ["t a", "t b"]
    assert found.session.tolist() == [0] * 4 + [1] * 4
    assert found.image_size == (640, 480)
    assert found.role.tolist() == (["reference"] + ["fit"] * 3) * 2
    assert [len(history.ambient_ns) for history in found.histories] == [4 + 7, 4 + 7]
    assert set(found.not_known) == {"supply", "set_points", "uncertainty"}
    path.write_text(head + "".join(rows).replace("640", "641", 1))
    with pytest.raises(SessionError, match="width_px and height_px are not the same in all rows"):
        load_observations(path)
