"""Models, cameras and run-time files that were changed or damaged: each is refused with one sentence that names the
place, before anything is computed with them."""

from __future__ import annotations

import json
import os
import re
import resource
import stat
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from copy import deepcopy
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

import thermostand
from thermostand.compensation import cli
from thermostand.compensation.apply.runtime_export import build_runtime_model
from thermostand.compensation.calibration.calibrate import Model, calibrate
from thermostand.compensation.calibration.camera_file import build_camera_file
from thermostand.compensation.drift.drift_model import DriftModel
from thermostand.compensation.drift_runtime import Drift
from thermostand.foundation.errors import SessionError
from thermostand.foundation.files import (
    check_folder_writable,
    check_writable,
    make_folder,
    open_atomic,
    write_atomically,
)

from .calibration_truth import Truth, draw, positions, target_of
from .made_up_models import paper, thermal

Data = dict[str, Any]
Change = Callable[[Data], None]
MORE_B = 1_500_000_000


def put(*place: str | int, value: object) -> Change:
    """The value at a place of the file."""

    def change(data: Data) -> None:
        inner: Any = data
        for part in place[:-1]:
            inner = inner[part]
        inner[place[-1]] = value

    return change


def off_centre(name: str, by: float) -> Change:
    """One covariance that is not that of its mirror image."""

    def change(data: Data) -> None:
        data[name][0][1] += by

    return change


def correlated(name: str, to: float) -> Change:
    """Two covariances of the same two."""

    def change(data: Data) -> None:
        data[name][0][1] = data[name][1][0] = to

    return change


def circle(corners: int) -> list[tuple[float, float]]:
    angle = np.linspace(0, 2 * np.pi, corners, endpoint=False)
    return np.column_stack([320 + 200 * np.cos(angle), 240 + 200 * np.sin(angle)]).tolist()


THERMAL: dict[str, tuple[Change, str]] = {
    "coefficient": (put("coefficients_px", 2, 3, value=1e300), "coefficients_px: terms of 1e\\+300 px"),
    "coefficient that is an image": (put("coefficients_px", 0, 0, value=700e3), "for an image of 640"),
    "reference": (put("reference_features", 0, value=-1e9), "reference_features: they move points"),
    "negative variance": (put("coefficient_covariance_px2", 3, 3, value=-1e-6), "variance in row 3 is -1e-06"),
    "not symmetric": (off_centre("coefficient_covariance_px2", 5e-7), "coefficient_covariance_px2: not symmetric"),
    "more than correlated": (correlated("leverage_matrix_px2", 3e-6), "leverage_matrix_px2: not positive semidefinite"),
    "covariance cut": (lambda data: data["coefficient_covariance_px2"].pop(), "coefficient_covariance_px2: shape"),
    "leverage": (put("leverage_px2", value=0.0), "leverage_px2"),
    "hull": (put("hull_px", value=circle(3000)), "hull_px"),
    "discrepancy": (put("discrepancy_px", value=[-0.1, 0.1]), "discrepancy_px"),
    "between sessions": (put("between_sessions_px", value=[0.1, -0.1]), "between_sessions_px"),
    "too few claims": (put("claim_factors", value=[1.0, 2.0]), "claim_factors"),
    "negative claim": (put("claim_factors", 1, value=-1.0), "claim_factors"),
    "temperature": (put("reference_degC", value=-300.0), "reference_degC"),
    "air": (put("ambient_range_degC", value=[50.0, 10.0]), "ambient_range_degC: not low, high"),
    "another term": (put("terms", 3, "kind", value="power lag"), "terms.4.*no model has a power lag"),
    "lag of no time": (put("terms", 3, "tau_s", value=0.0), "terms.4.*greater than 0"),
    "image": (put("image_size_px", value=[10**9, 10**9]), "image_size_px"),
    "infinite": (put("coefficients_px", 2, 3, value=float("inf")), "coefficients_px.*finite"),
    "not a number": (put("hull_px", 2, value=[float("nan"), 1.0]), "hull_px.*finite"),
    "huge whole number": (put("reference_degC", value=10**400), "reference_degC"),
    "fold": (
        put("candidates", value=[{"form": "paper", "name": "", "terms": 1, "rms_px": [0.1, 0.1], "chosen": True,
                                  "fold_chamber_degC": [1.0], "fold_rms_px": []}]),
        "fold_rms_px: 0 for 1",
    ),
}  # fmt: skip
PAPER: dict[str, tuple[Change, str]] = {
    "coefficient": (put("coefficients_px", 1, 0, value=-1e300), "coefficients_px: terms of 1e\\+300 px"),
    "more than an image": (put("coefficients_px", 1, 0, value=700.0), "they move points by .* the image has 640"),
    "negative variance": (put("coefficient_covariance_px2", 1, 2, 2, value=-1.0), "variance in row 2 is -1"),
    "range": (put("camera_range_degC", value=[30.0, 1e6]), "camera_range_degC"),
}
CAMERA: dict[str, tuple[Change, str]] = {
    "focal length": (put("vector", 0, value=1e300), "vector: the focal lengths"),
    "negative focal length": (put("vector", 1, value=-7000.0), "vector: the focal lengths"),
    "centre": (put("vector", 2, value=-1e6), "vector: the centre"),
    "distortion": (put("vector", 4, value=-1e6), "vector: this distortion folds"),
    "distortion out of range": (put("vector", 5, value=1e300), "vector: this distortion folds"),
    "variance": (put("covariance", 0, 0, value=-1.0), "covariance: the variance in row 0"),
    "covariance": (off_centre("covariance", 1.0), "covariance: not symmetric"),
    "rays": (put("rays", "coefficients_mm", 0, 0, 0, value=1e300), "rays.coefficients_mm: they move points"),
    "rays' variance": (put("rays", "covariance_mm2", 1, 1, value=-1.0), "rays.covariance_mm2"),
    "rays' hull": (put("rays", "hull_px", value=circle(3000)), "rays.hull_px"),
    "rays' range": (put("rays", "range_mm", value=[900.0, 800.0]), "rays.range_mm: not near, far"),
    "board": (put("board", "points_mm", 4, value=[1e300, 0.0, 0.0]), "board.points_mm.5"),
    "board's sigma": (put("board", "sigma_mm", 4, value=[-0.1, 0.1, 0.1]), "board.sigma_mm.5"),
    "diameter": (put("board", "diameters_mm", 4, value=0.0), "board.diameters_mm.5"),
    "mount": (put("table", "mount", 0, 0, value=5.0), "mount: not a rotation"),
    "axis": (put("table", "linear", 0, value=5.0), "not of length 1"),
    "table": (lambda data: data["table"]["rotary_deg"].pop(), "rotary_deg: shape"),
    "map": (lambda data: data["uncertainty"]["sigma_px"].pop(), "sigma_px: shape"),
}
RUNTIME: dict[str, tuple[Change, str]] = {
    "coefficient": (put("coefficients_px", 2, 3, value=1e300), "coefficients_px: terms of"),
    "infinite": (put("coefficients_px", 2, 3, value=float("inf")), "coefficients_px: not finite"),
    "null": (put("coefficients_px", 2, 3, value=None), "coefficients_px: not "),
    "ragged": (lambda data: data["coefficients_px"][0].pop(), "coefficients_px: not numbers"),
    "hull": (put("hull_px", value=circle(3000)), "hull_px: 3000 corners"),
    "leverage": (lambda data: data["leverage_matrix"].pop(), "leverage_matrix: not finite numbers of shape"),
    "image": (put("image_size_px", value=[0, 0]), "image of 0"),
}


def saved(model: DriftModel, folder: Path) -> Path:
    path = folder / "good.json"
    thermostand.save_model(model, path)
    return path


@pytest.fixture(scope="module")
def good_camera(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("camera") / "good.json"
    laboratory = draw(Truth(seed=1))
    seen = positions(laboratory).select(np.arange(34) % 4 == 0)
    found = calibrate(seen, target_of(laboratory), model=Model.BROWN)
    made = {"camera_serial": "C", "session_ids": ("s",), "target_name": "t", "software_version": "0"}
    build_camera_file(found, **made).save(path)
    return path


def refused(load: Callable[[Path], object], good: Path, change: Change, sentence: str, path: Path) -> None:
    load(good)
    data = deepcopy(json.loads(good.read_text()))
    change(data)
    path.write_text(json.dumps(data))
    with little_memory(), pytest.raises(thermostand.SessionError) as raised:
        load(path)
    text = str(raised.value)
    assert text.startswith(f"{path}: not a ")
    assert text.endswith("make it again")
    assert "\n" not in text
    assert re.search(sentence, text), text


@contextmanager
def little_memory() -> Iterator[None]:
    """What a file asks for beyond some is refused by the system."""
    before = resource.getrlimit(resource.RLIMIT_AS)
    now = int(Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")
    resource.setrlimit(resource.RLIMIT_AS, (now + MORE_B, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, before)


@pytest.mark.parametrize("what", THERMAL)
def test_a_thermal_model_with_numbers_that_cannot_be_is_refused(what: str, tmp_path: Path):
    refused(thermostand.load_model, saved(thermal(), tmp_path), *THERMAL[what], tmp_path / "bad.json")


@pytest.mark.parametrize("what", PAPER)
def test_a_paper_model_with_numbers_that_cannot_be_is_refused(what: str, tmp_path: Path):
    refused(thermostand.load_model, saved(paper(), tmp_path), *PAPER[what], tmp_path / "bad.json")


@pytest.mark.parametrize("what", CAMERA)
def test_a_camera_with_numbers_that_cannot_be_is_refused(what: str, good_camera: Path, tmp_path: Path):
    refused(thermostand.load_camera, good_camera, *CAMERA[what], tmp_path / "bad.json")


@pytest.mark.parametrize("what", RUNTIME)
def test_a_run_time_file_with_numbers_that_cannot_be_is_refused(what: str, tmp_path: Path):
    change, sentence = RUNTIME[what]
    data = json.loads(json.dumps(build_runtime_model(thermal())))
    Drift(data)
    change(data)
    path = tmp_path / "drift.json"
    path.write_text(json.dumps(data))
    with little_memory(), pytest.raises(ValueError, match=sentence):
        Drift.load(path)


@pytest.mark.parametrize(
    ("damage", "sentence"),
    [
        (lambda text: text.replace("{", '{"degree": 2, ', 1), "key 'degree' is given twice"),
        (lambda text: text.replace('"bumps": []', '"bumps": ' + "[" * 100_000 + "]" * 100_000), "nested too deeply"),
        (lambda text: text.replace('"bumps": []', '"bumps": ' + "[" * 300 + "]" * 300), "bumps|nested|recursion"),
        (lambda text: text + " " * 20_000_000, "has more than 20 MB"),
        (lambda text: text[: len(text) // 2], "line"),
    ],
    ids=["a key twice", "nested 100,000 deep", "nested 300 deep", "long", "cut"],
)  # fmt: skip
def test_a_text_that_is_no_file_of_ours_is_refused(damage: Callable[[str], str], sentence: str, tmp_path: Path):
    path = saved(paper(), tmp_path)
    path.write_text(damage(path.read_text()))
    with little_memory(), pytest.raises(thermostand.SessionError, match=sentence) as raised:
        thermostand.load_model(path)
    assert str(raised.value).startswith(f"{path}: not a drift model")


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="a device without an end")
def test_a_device_without_an_end_is_refused():
    with little_memory(), pytest.raises(thermostand.SessionError, match="more than 20 MB"):
        thermostand.load_model("/dev/zero")


def test_what_the_hull_may_have_is_loaded_in_little_memory(tmp_path: Path):
    model = paper()
    path = saved(replace(model, facts=replace(model.facts, hull_px=np.array(circle(2000)))), tmp_path)
    with little_memory():
        assert thermostand.load_model(path).inside(np.array([[320.0, 240.0]]), 40.0).all()


def test_the_command_line_refuses_them_with_the_status_of_other_bad_input(tmp_path: Path, good_camera: Path):
    points = tmp_path / "points.csv"
    points.write_text("x_px,y_px\n100,100\n")
    path = saved(paper(), tmp_path)
    apply = ["apply", str(path), str(points), "--camera-degC", "40", "-o", str(tmp_path / "out.csv")]
    assert CliRunner().invoke(cli.app, apply).exit_code == 0
    (tmp_path / "out.csv").unlink()
    data = json.loads(path.read_text())
    PAPER["negative variance"][0](data)
    path.write_text(json.dumps(data))
    result = CliRunner().invoke(cli.app, apply)
    other = CliRunner().invoke(cli.app, [*apply[:1], str(points), *apply[2:]])
    assert result.exit_code == other.exit_code != 0
    assert "variance in row 2" in result.output
    assert "Traceback" not in result.output
    assert not (tmp_path / "out.csv").exists()


# What may be replaced by a file, and what may not: a rename over a device node would destroy the node.


@pytest.fixture
def pipe(tmp_path: Path) -> Path:
    """Stands for a device node: as little a regular file, and harmless."""
    path = tmp_path / "pipe"
    os.mkfifo(path)
    return path


def test_a_pipe_is_refused_and_stays_a_pipe(pipe: Path):
    for write in (check_writable, lambda path: write_atomically(path, "text")):
        with pytest.raises(SessionError, match=r"pipe: .*not a regular file"):
            write(pipe)
    assert stat.S_ISFIFO(pipe.stat().st_mode)
    assert list(pipe.parent.iterdir()) == [pipe]


def test_a_link_to_a_pipe_is_refused_too(pipe: Path):
    link = pipe.with_name("link")
    link.symlink_to(pipe)
    with pytest.raises(SessionError, match="link: cannot be written"):
        write_atomically(link, "text")
    assert link.is_symlink()


def test_a_folder_is_refused(tmp_path: Path):
    (tmp_path / "folder").mkdir()
    for write in (check_writable, lambda path: write_atomically(path, "text")):
        with pytest.raises(SessionError, match=r"folder: cannot be written \(it is a folder\)"):
            write(tmp_path / "folder")
    assert [path.name for path in tmp_path.iterdir()] == ["folder"]


def test_a_pipe_that_appears_during_the_work_is_refused_at_the_rename(tmp_path: Path):
    out = tmp_path / "out"

    def write() -> None:
        with open_atomic(out) as file:
            file.write("text")
            os.mkfifo(out)

    with pytest.raises(SessionError, match="not a regular file"):
        write()
    assert stat.S_ISFIFO(out.stat().st_mode)
    assert list(tmp_path.iterdir()) == [out]


def test_a_file_is_replaced_when_the_block_has_ended_and_not_before(tmp_path: Path):
    out = tmp_path / "out"
    out.write_text("older")
    with open_atomic(out) as file:
        file.write("a\r\nb\n")
        assert out.read_text() == "older"
    assert out.read_bytes() == b"a\r\nb\n"
    assert list(tmp_path.iterdir()) == [out]


def test_a_folder_is_made_when_it_is_needed_and_not_before(tmp_path: Path):
    wanted = tmp_path / "a" / "b"
    check_folder_writable(wanted, ["x"])
    assert not list(tmp_path.iterdir())
    make_folder(wanted)
    make_folder(wanted)
    check_folder_writable(wanted, ["x"])
    (wanted / "x").mkdir()
    with pytest.raises(SessionError, match="it is a folder"):
        check_folder_writable(wanted, ["x"])
    (tmp_path / "file").touch()
    (tmp_path / "dangling").symlink_to(tmp_path / "nowhere")
    for path in (tmp_path / "file", tmp_path / "file" / "b", tmp_path / "dangling"):
        with pytest.raises(SessionError, match="cannot be made"):
            check_folder_writable(path, ["x"])
