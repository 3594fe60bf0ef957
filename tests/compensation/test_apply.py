"""A drift model put to use by the command: tables, images and exports, all as the model itself says."""

import csv
import itertools
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from thermostand.compensation.cli import app
from thermostand.compensation.drift.model_file import load_model, save_model
from thermostand.compensation.drift.training_data import compute_frame_states
from thermostand.compensation.history.thermal_history import compute_states_at, read_history
from thermostand.compensation.observations import observe, read_session_target
from thermostand.experiments.steps import Role
from thermostand.markers.detection import detect
from thermostand.recording.reading.session import Session

from .conftest import Recorded
from .made_up_models import paper, thermal


def run(*arguments: object, status: int = 0) -> str:
    """What it says."""
    result = CliRunner().invoke(app, [str(argument) for argument in arguments])
    assert result.exit_code == status, result.output
    return result.output


def table(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


@pytest.fixture
def files(tmp_path: Path) -> dict[str, Path]:
    names = {"paper": paper(), "thermal": thermal()}
    for name, model in names.items():
        save_model(model, tmp_path / f"{name}.json")
    return {name: tmp_path / f"{name}.json" for name in names}


def test_a_table_gets_its_corrections_at_the_temperature_of_each_row(files: dict[str, Path], tmp_path: Path):
    points, out = tmp_path / "points.csv", tmp_path / "out.csv"
    points.write_text("name,x_px,y_px,camera_degC\na,100,200,40\nb,nan,200,40\nc,620.5,100,40\nd,100,200,\n")
    printed = run("apply", files["paper"], points, "-o", out)
    assert printed.startswith("warning: 3 of 4 points")
    rows = table(out)
    model, place = paper(), np.array([[100.0, 200.0]])
    assert [rows[0][name] for name in ("name", "x_px", "camera_degC", "outside")] == ["a", "100", "40", ""]
    expected = model.correct(place, 40.0)[0]
    assert [float(rows[0][f"{axis}_reference_px"]) for axis in "xy"] == pytest.approx(expected, abs=1e-6)
    variance = model.covariance(place, 40.0)[0, 0, 0]
    assert float(rows[0]["var_x_correction_px2"]) == pytest.approx(variance, rel=1e-6)
    assert [rows[index]["outside"] for index in (1, 2, 3)] == ["PLACE", "PLACE", "CAMERA"]
    assert (rows[1]["x_reference_px"], rows[3]["y_reference_px"]) == ("nan", "nan")


def test_the_markers_of_a_session_are_corrected_with_its_recorded_states(
    recorded: Recorded, files: dict[str, Path], tmp_path: Path
):
    found, out = tmp_path / "found.csv", tmp_path / "out.csv"
    run("detect", recorded.path, "-o", found)
    for name, model in (("paper", paper()), ("thermal", thermal())):
        run("apply", files[name], found, "--session", recorded.path, "-o", out)
        rows, session = table(out), Session.open(recorded.path)
        assert len(rows) == 54 * session.frame_count
        frames = list(session.frames())
        times_ns = np.array([frame.time_ns for frame in frames])
        camera_degC = np.array([frame.camera_degC for frame in frames])
        states = compute_states_at(read_history(session), model.memory, times_ns, camera_degC)
        for index in (4, 8, 15):
            row = rows[54 * index + 7]
            place = np.array([[float(row["x_px"]), float(row["y_px"])]])
            expected = model.correct(place, states.where(np.array([index])))[0]
            assert [float(row[f"{axis}_reference_px"]) for axis in "xy"] == pytest.approx(expected, abs=2e-6)


def test_images_of_a_session_show_the_target_where_the_model_puts_it(
    recorded: Recorded, files: dict[str, Path], tmp_path: Path
):
    out, session = tmp_path / "images", Session.open(recorded.path)
    run("apply", files["paper"], recorded.path, "-o", out, "--frames", "6:8")
    index = table(out / "images.csv")
    assert [(row["image"], row["frame"]) for row in index] == [("000006.tiff", "6"), ("000007.tiff", "7")]
    target = read_session_target(session)
    for number in (6, 7):
        frame = session.frame(number)
        image = cv2.imread(str(out / f"{number:06d}.tiff"), cv2.IMREAD_UNCHANGED)
        assert image.dtype == np.float32
        before = detect(frame.image, target).centres_px
        after = detect(np.clip(np.round(256 * image), 0, 65535).astype(np.uint16), target).centres_px
        assert np.abs(after - paper().correct(before, frame.camera_degC)).max() < 0.02
    run("apply", files["paper"], recorded.path, "-o", tmp_path / "png", "--frames", ":1", "--format", "png")
    assert cv2.imread(str(tmp_path / "png" / "000000.png"), cv2.IMREAD_UNCHANGED).dtype == np.uint8


def test_one_image_is_corrected_at_a_given_temperature(recorded: Recorded, files: dict[str, Path], tmp_path: Path):
    image = Session.open(recorded.path).frame(4).image
    cv2.imwrite(str(tmp_path / "photo.png"), image)
    run("apply", files["paper"], tmp_path / "photo.png", "--camera-degC", 44, "-o", tmp_path / "out.tiff")
    moved = cv2.imread(str(tmp_path / "out.tiff"), cv2.IMREAD_UNCHANGED)
    assert moved.shape == image.shape
    assert moved is not None
    assert not np.allclose(moved, image, atol=1)


def test_what_cannot_be_corrected_is_refused_with_a_sentence(
    recorded: Recorded, files: dict[str, Path], tmp_path: Path
):
    out, numbers = tmp_path / "out", itertools.count()

    def refused(
        *arguments: object, text: str = "x_px,y_px,camera_degC\n100,200,40\n", status: int = 2, says: str
    ) -> None:
        points = tmp_path / f"points-{next(numbers)}.csv"
        points.write_text(text)
        given = [points if argument == "POINTS" else argument for argument in arguments]
        printed = run("apply", *given, "-o", out, status=status)
        assert says in printed
        assert printed.count("\n") == 1
        assert not out.exists()

    refused(files["paper"], "POINTS", text="x,y\n1,2\n", status=1, says="has no column x_px")
    refused(files["paper"], "POINTS", text="x_px,y_px\n1,2\n", says="has no column camera_degC; give --session")
    refused(
        files["paper"],
        "POINTS",
        text="x_px,y_px,camera_degC\n1,2,warm\n",
        status=1,
        says="line 2: camera_degC is 'warm'",
    )
    refused(
        files["paper"], "POINTS", text="x_px,y_px,camera_degC\n1,2\n", status=1, says="line 2 has not as many cells"
    )
    refused(files["paper"], "POINTS", text="x_px,y_px,outside\n1,2,3\n", status=1, says="have been corrected")
    refused(files["paper"], "POINTS", "--session", recorded.path, says="needs the instant of every point")
    refused(files["thermal"], "POINTS", says="needs the thermal state")
    refused(files["paper"], "POINTS", "--frames", "0:1", says="--frames does not belong here")
    refused(files["paper"], recorded.path, "--frames", "0:99", says="the session has 17 frames")
    refused(files["paper"], recorded.path, "--frames", "3", says="give FIRST:END")
    refused(files["paper"], recorded.path, "--camera-degC", "3", says="a session has temperatures of its own")
    refused(files["paper"], tmp_path / "photo.png", says="give the camera's temperature with --camera-degC")
    refused(tmp_path / "none.json", "POINTS", status=2, says="none.json: no such file")
    cv2.imwrite(str(tmp_path / "small.png"), np.zeros((40, 50), np.uint8))
    refused(
        files["paper"],
        tmp_path / "small.png",
        "--camera-degC",
        "40",
        status=1,
        says="50 x 40 pixels, the model is of 640",
    )


def test_an_existing_folder_is_not_written_into(recorded: Recorded, files: dict[str, Path], tmp_path: Path):
    (tmp_path / "taken").mkdir()
    assert "a new folder" in run("apply", files["paper"], recorded.path, "-o", tmp_path / "taken", status=1)
    assert not list((tmp_path / "taken").iterdir())


def test_a_camera_temperature_alone_is_enough_for_the_form_that_needs_no_history(
    recorded: Recorded, files: dict[str, Path], tmp_path: Path
):
    both, out = tmp_path / "both.json", tmp_path / "out.csv"
    save_model(replace(thermal(), other=paper()), both)
    points, photo = tmp_path / "points.csv", tmp_path / "photo.png"
    for text, options in (
        ("x_px,y_px\n100,200\n", ("--camera-degC", 40)),
        ("x_px,y_px,camera_degC\n100,200,40\n", ()),
    ):
        points.write_text(text)
        printed = run("apply", both, points, *options, "-o", out)
        assert printed.startswith("the camera's temperature alone")
        assert "0.020 and 0.030 px" in printed
        assert printed.count("\n") == 1
        expected = paper().correct(np.array([[100.0, 200.0]]), 40.0)[0]
        (row,) = table(out)
        assert [float(row[f"{axis}_reference_px"]) for axis in "xy"] == pytest.approx(expected, abs=1e-6)
    cv2.imwrite(str(photo), Session.open(recorded.path).frame(4).image)
    for name in ("both", "paper"):
        run("apply", tmp_path / f"{name}.json", photo, "--camera-degC", 44, "-o", tmp_path / f"{name}.tiff")
    assert (tmp_path / "both.tiff").read_bytes() == (tmp_path / "paper.tiff").read_bytes()
    refused = run("apply", files["thermal"], photo, "--camera-degC", 44, "-o", tmp_path / "none.tiff", status=2)
    assert "needs the thermal state" in refused


def test_a_model_is_anchored_in_a_session_by_its_reference_frames(
    recorded: Recorded, files: dict[str, Path], tmp_path: Path
):
    at_first_px = recorded.true_px[3] + 0.5
    facts = replace(thermal().facts, reference_centres_px=at_first_px, session_ids=("another",))
    elsewhere = replace(thermal(), facts=facts)
    other = replace(paper(), facts=replace(paper().facts, session_ids=("another",)))
    save_model(replace(elsewhere, other=other), tmp_path / "elsewhere.json")
    assert "thermal: " in run("rereference", tmp_path / "elsewhere.json", recorded.path, "-o", tmp_path / "here.json")
    here, observed = load_model(tmp_path / "here.json"), observe(recorded.path)
    assert (here.form, here.other) == ("thermal", None)
    states = compute_frame_states(observed, here.memory)
    at_reference = np.flatnonzero(observed.of(Role.REFERENCE)).tolist()
    corrected = [here.correct(recorded.true_px[k], states.where(np.array([k]))) for k in at_reference]
    assert np.abs(np.mean(corrected, axis=0) - at_first_px).max() < 0.02
    place = tmp_path / "place.csv"
    place.write_text(f"x_px,y_px,time_ns\n100,200,{observed.time_ns[4]}\n")
    for name, is_offered in (("elsewhere", True), ("here", False)):
        answer = run("apply", tmp_path / f"{name}.json", place, "--session", recorded.path, "-o", tmp_path / "out.csv")
        assert ("`compensate rereference`" in answer) == is_offered
    refused = run("rereference", files["paper"], recorded.path, "-o", tmp_path / "none.json", status=1)
    assert "no thermal form" in refused
    few = "fit", recorded.path, *2 * ["--like", files["thermal"]], "-o", tmp_path / "none.json"
    assert "3 units or more" in run(*few, status=1)
    assert "leave out --form" in run(*few, "--form", "paper", status=2)


def test_a_session_is_corrected_with_the_form_in_use_and_so_is_an_export(
    recorded: Recorded, files: dict[str, Path], tmp_path: Path
):
    save_model(replace(thermal(), other=paper()), tmp_path / "both.json")
    run("detect", recorded.path, "-o", tmp_path / "found.csv")
    for name in ("both", "thermal"):
        model = tmp_path / f"{name}.json"
        answer = run("apply", model, tmp_path / "found.csv", "--session", recorded.path, "-o", tmp_path / f"{name}.csv")
        assert "the thermal form" in answer
        run("export", model, "-o", tmp_path / name)
    assert (tmp_path / "both.csv").read_bytes() == (tmp_path / "thermal.csv").read_bytes()
    assert (tmp_path / "both" / "drift.json").read_bytes() == (tmp_path / "thermal" / "drift.json").read_bytes()
    assert files["thermal"].exists()


def test_export_says_what_it_has_written(files: dict[str, Path], tmp_path: Path):
    printed = run("export", files["thermal"], "-o", tmp_path / "a" / "b")
    assert printed.split() == [str(tmp_path / "a" / "b" / name) for name in ("drift.json", "drift_runtime.py")]
    assert run("export", files["thermal"], "--c", tmp_path / "lens.h") == f"{tmp_path / 'lens.h'}\n"
    assert "lens_advance(" in (tmp_path / "lens.h").read_text()
    assert "drift_node.py" in run("export", files["thermal"], "--ros2", tmp_path / "camera_drift")
    assert "give -o FOLDER" in run("export", files["thermal"], status=2)


def test_an_exported_image_is_corrected_as_the_session_is_at_its_time(
    recorded: Recorded, files: dict[str, Path], tmp_path: Path
):
    session, out = Session.open(recorded.path), tmp_path / "out.tiff"
    frame, photo = session.frame(6), tmp_path / "photo.png"
    cv2.imwrite(str(photo), frame.image)
    for name in ("paper", "thermal"):
        run("apply", files[name], recorded.path, "-o", tmp_path / name, "--frames", "6:7")
        run("apply", files[name], photo, "--session", recorded.path, "--time", frame.time_ns, "-o", out)
        assert out.read_bytes() == (tmp_path / name / "000006.tiff").read_bytes()
    for given, says in (
        (("--session", recorded.path), "say with --time"),
        (("--time", frame.time_ns, "--camera-degC", 40), "give --session as well"),
        (("--session", recorded.path, "--time", "noon"), "give time_ns, or a time"),
    ):
        assert says in run("apply", files["paper"], photo, *given, "-o", tmp_path / "none.tiff", status=2)
