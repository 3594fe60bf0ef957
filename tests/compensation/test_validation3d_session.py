"""`compensate validate` on a recorded session of photographs of V0 and V1 at two temperatures."""

from __future__ import annotations

import asyncio
import json
import shutil
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from math import isnan
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner, Result

from thermostand.compensation import cli
from thermostand.compensation.budget.geometry import load_geometry
from thermostand.compensation.calibration.calibrate import Model, calibrate
from thermostand.compensation.calibration.camera_file import build_camera_file
from thermostand.compensation.calibration.session_centres import Positions
from thermostand.compensation.calibration.stage_geometry import TableSigma
from thermostand.compensation.drift.model_file import save_model
from thermostand.compensation.drift.paper_model import fit_paper
from thermostand.compensation.observations import Float, Observations, observe_session, read_session_target
from thermostand.compensation.validation3d.validate import select_validation_frames
from thermostand.experiments.steps import Role
from thermostand.foundation.clock import NS_PER_S
from thermostand.foundation.documents import parse_document
from thermostand.foundation.errors import SessionError
from thermostand.foundation.items import Batch, Item, StepMark, StepState
from thermostand.foundation.readings import Frame, Quality, Reading
from thermostand.markers.target import Target
from thermostand.recording.reading.session import Session

from .conftest import record_items
from .renderer import Scene, compute_true_centres_px, photograph, render
from .synthetic import observations as thermal_cycle

START_NS = 1_767_290_400 * NS_PER_S
SIZE, F_px, DISTANCE_mm = (640, 480), 2000.0, 1000.0
TARGET_YAML = "name: small\ncolumns: 9\nrows: 6\npitch_mm: 30\ndiameter_mm: 10\nprinting_error_mm: 0.002\n"
TARGET = parse_document(TARGET_YAML, Target, "target.yaml")
V0, V1 = (0.0, 0.0), (60.0, 20.0)
VISITS = [(chamber_degC, place) for chamber_degC in (24.0, 44.0) for place in (V0, V1, V0)]
SHIFT_px_K = 0.03
"""The drift: the picture moves down by this."""
GRANITE_K = 10.0
"""Of the granite inside, warmer at the second temperature."""


def scene_at(place: tuple[float, float], above_K: float = 0.0) -> Scene:
    """A shift of the target in its distance's scale stands for the picture's."""
    z_mm = DISTANCE_mm + place[0]
    shift_mm = (1.3, -0.7 - SHIFT_px_K * above_K * z_mm / F_px)
    return Scene(size=SIZE, f_px=F_px, distance_mm=z_mm, diameter_mm=10, tilt_y_deg=place[1], shift_mm=shift_mm)


def published(index: int, time_ns: int, silent: str) -> Iterator[Item]:
    chamber_degC, place = VISITS[index]
    for number, (axis, position) in enumerate(zip(("linear", "rotary"), place, strict=True)):
        for state in (StepState.STARTED, StepState.DONE):
            move: dict[str, object] = {"axis": axis, "position": position}
            yield StepMark(time_ns, f"move-{index}-{axis}", 3 * index + number, "move_to", state, move)
    above_K = chamber_degC - 24
    degC = {"granite_inside": 24 + GRANITE_K * (above_K > 0), "granite_outside": 24.0, "artifact": 24.0}
    degC |= {"air": 24.0, "laboratory": 24.0}
    degC |= {silent: float("nan")} if silent and above_K else {}
    readings = tuple(
        Reading(f"thermometers.{name}", value, "degC", time_ns, Quality.BAD if isnan(value) else Quality.GOOD)
        for name, value in degC.items()
    )
    yield Batch("thermometers", time_ns, readings)
    step, role = f"capture-{index}", "repeatability" if index % 3 == 2 else "pose"
    capture: dict[str, object] = {"frames": 1, "role": role, "chamber_degC": chamber_degC}
    yield StepMark(time_ns, step, 3 * index + 2, "capture", StepState.STARTED, capture)
    scene = scene_at(place, above_K)
    image = photograph(scene, render(scene), index)
    yield Frame("camera.image", image, time_ns, 0.1, 0.0, chamber_degC + 15, index, 0, 0, step)
    yield StepMark(time_ns, step, 3 * index + 2, "capture", StepState.DONE, capture)


async def record(directory: Path, visits: int = len(VISITS), silent: str = "") -> None:
    how = {"session_id": "cycle-2", "recipe": "validation", "attachments": {"target.yaml": TARGET_YAML}}
    await record_items(directory, partial(published, silent=silent), visits, 30, **how)


def calibration_positions() -> Positions:
    """Noise-free but for 3 mpx, at nine places around V0 and V1."""
    places = np.array([(linear, rotary) for linear in (-40.0, 30.0, 100.0) for rotary in (-25.0, 0.0, 25.0)])
    centres = np.array([compute_true_centres_px(scene_at((linear, rotary))) for linear, rotary in places])
    noise = 0.003 * np.random.default_rng(2).standard_normal(centres.shape)
    return Positions(
        linear_mm=places[:, 0],
        rotary_deg=places[:, 1],
        centres_px=centres + noise,
        covariance_px2=np.tile(0.003**2 * np.eye(2), (*centres.shape[:2], 1, 1)),
        frames=np.ones(len(centres), np.int64),
        flags=np.zeros(centres.shape[:2], np.uint8),
        chi=float("nan"),
        image_size=SIZE,
    )


def cycle() -> Observations:
    """A thermal cycle of the small camera, the target at V0."""
    at_V0 = compute_true_centres_px(scene_at(V0))

    def drift(_: Float, above_K: float) -> Float:
        return at_V0 + np.array([0.0, SHIFT_px_K * above_K])

    return replace(thermal_cycle(drift, noise_px=0.003), image_size=SIZE, target=TARGET)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """session, camera.json, model.json and the geometry of the small stand."""
    folder = tmp_path_factory.mktemp("validation")
    asyncio.run(record(folder / "session"))
    found = calibrate(calibration_positions(), TARGET, TableSigma(), Model.BROWN)
    build_camera_file(
        found, camera_serial="TS-0001", session_ids=("cycle-2",), target_name="small", software_version="0"
    ).save(folder / "camera.json")
    save_model(fit_paper(cycle(), 1), folder / "model.json")
    geometry = load_geometry("paper").model_copy(update={"focal_px": F_px, "image_px": SIZE})
    (folder / "small.yaml").write_text(geometry.model_dump_json())
    return folder


def run(folder: Path, session: Path, out: Path, *options: str) -> Result:
    files = ["--camera", str(folder / "camera.json"), "--model", str(folder / "model.json")]
    return CliRunner().invoke(cli.app, ["validate", str(session), *files, "-o", str(out), *options])


def test_validate_writes_the_page_and_the_numbers_next_to_it(folder: Path, tmp_path: Path):
    result = run(folder, folder / "session", tmp_path / "validation.html", "--budget", str(folder / "small.yaml"))
    assert result.exit_code == 0, result.output
    assert "paper, after" in result.stdout
    page, document = (tmp_path / "validation.html").read_text(), json.loads((tmp_path / "validation.json").read_text())
    assert page.count("<svg") == 3
    assert [(one["linear_mm"], one["rotary_deg"]) for one in document["positions"]] == [V0, V1]
    assert document["chamber_degC"] == [24.0, 44.0]
    assert document["camera_degC"] == [39.0, 59.0]
    before, after, alone, with_stand = (one["translation_um"][1] for one in document["results"])
    for position, z_mm in enumerate((DISTANCE_mm, DISTANCE_mm + V1[0])):
        assert before[position] == pytest.approx([0, 1e3 * SHIFT_px_K * 20 * z_mm / F_px, 0], abs=15)
        assert after[position] == pytest.approx([0, 0, 0], abs=15)
        assert np.linalg.norm(after[position]) < 0.1 * np.linalg.norm(before[position])
        granite_um = 1e3 * 5e-6 * 413 * GRANITE_K
        assert np.subtract(alone[position], before[position])[2] == pytest.approx(-granite_um, rel=0.05)
        extra_um = granite_um * (z_mm / 826 - 1)  # what a drift fitted at 826 mm has taken out too much
        assert np.subtract(with_stand[position], after[position])[2] == pytest.approx(extra_um, rel=0.05)
        (own_um, z_um) = (one["stand_um"][1][position][2] for one in document["results"][2:])
        # 10 % of the expansion, 20 mm of the length, 1 K of gradient in either part, 0.1 K of the target
        parts_um = [0.1 * granite_um, 1e3 * 5e-6 * 20 * GRANITE_K, 2.065, 2.065, 1e3 * 8.5e-6 * 0.1 * z_mm]
        assert own_um == pytest.approx(np.linalg.norm(parts_um), rel=0.02)
        assert 0.05 * extra_um < z_um < 0.25 * extra_um


@pytest.mark.usefixtures("undrawn")
def test_rays_give_the_same_without_the_stand(folder: Path, tmp_path: Path):
    result = run(folder, folder / "session", tmp_path / "validation.html", "--lens", "rays")
    assert result.exit_code == 0, result.output
    document = json.loads((tmp_path / "validation.json").read_text())
    assert document["camera_model"].startswith("rays, degree")
    assert len(document["results"]) == 2
    assert document["results"][0]["mean_um"][1] == pytest.approx(1e3 * SHIFT_px_K * 20 * 1030 / F_px, rel=0.05)


def test_bad_input_is_refused_in_a_sentence_and_leaves_nothing(folder: Path, recorded_alone: Path, tmp_path: Path):
    session, out = folder / "session", tmp_path / "validation.html"
    cases = [
        (session, tmp_path / "validation.json", [], "name it .html", 2),
        (session, tmp_path / "none" / "validation.html", [], "cannot be written", 1),
        (session, out, ["--model", str(folder / "camera.json")], "not a drift model", 1),
        (session, out, ["--camera", str(folder / "model.json")], "not a camera file", 1),
        (session, out, ["--budget", "none.yaml"], "none.yaml", 2),
        (recorded_alone, out, [], "poses were seen at 1 temperature; two are needed", 1),
        (folder, out, [], "not a session", 2),
    ]
    for given, path, options, sentence, status in cases:
        result = run(folder, given, path, *options)
        assert result.exit_code == status, sentence
        assert sentence in result.stderr.splitlines()[-1]
        assert not list(tmp_path.iterdir())


@pytest.fixture(scope="module")
def recorded_alone(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The reference temperature only."""
    path = tmp_path_factory.mktemp("sessions") / "alone"
    asyncio.run(record(path, visits=3))
    return path


@pytest.mark.usefixtures("undrawn")
def test_a_silent_thermometer_is_named_where_it_is_needed(folder: Path, tmp_path: Path):
    asyncio.run(record(tmp_path / "silent", silent="artifact"))
    out = tmp_path / "validation.html"
    refused = run(folder, tmp_path / "silent", out, "--budget", "paper")
    assert refused.exit_code == 1
    assert "thermometer artifact was silent" in refused.stderr.splitlines()[-1]
    assert run(folder, tmp_path / "silent", out).exit_code == 0


@pytest.mark.usefixtures("undrawn")
def test_a_session_with_something_missing_is_validated_only_when_that_is_asked_for(folder: Path, tmp_path: Path):
    session = Path(shutil.copytree(folder / "session", tmp_path / "session"))
    (session / "frames" / "0001.mcap.part").write_bytes(b"what a killed recorder left")
    out = tmp_path / "validation.html"
    refused = run(folder, session, out)
    assert refused.exit_code == 1
    assert "frames/0001.mcap.part is not finished" in refused.stderr
    assert not out.exists()
    used = run(folder, session, out, "--incomplete")
    assert used.exit_code == 0, used.output
    assert f"warning: {session}: frames/0001.mcap.part is not finished" in used.stderr
    assert run(folder, folder / "session", tmp_path / "whole.html").exit_code == 0
    assert json.loads((tmp_path / "validation.json").read_text()) == json.loads((tmp_path / "whole.json").read_text())


def test_pose_frames_teach_the_drift_nothing(folder: Path):
    session = Session.open(folder / "session")
    observed = observe_session(session, read_session_target(session))
    assert observed.role.tolist() == ["pose", "pose", "repeatability"] * 2
    with pytest.raises(SessionError, match="no usable frames"):
        fit_paper(observed, 1)
    assert not observed.of(Role.REFERENCE, Role.FIT, Role.VALIDATION, Role.WARM_UP).any()


def test_frames_are_sorted_by_where_the_table_stood_not_by_their_order(folder: Path):
    session = Session.open(folder / "session")
    observed = observe_session(session, read_session_target(session))
    found = select_validation_frames(session, observed)
    assert found.names == ("V0", "V1")
    assert [[indices.tolist() for indices in row] for row in found.frames] == [[[0], [1], [2]], [[3], [4], [5]]]
    assert found.used.tolist() == [0, 1, 2, 3, 4, 5]
    with pytest.raises(SessionError, match="60 mm, 20 deg"):
        select_validation_frames(session, replace(observed, reasons=("", "dark", "", "", "", "")))
