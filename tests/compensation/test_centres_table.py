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
