"""`compensate calibrate` on a recorded session of rendered photographs at nine table positions."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner, Result

from thermostand.compensation import cli
from thermostand.compensation.calibration.camera_file import load_camera
from thermostand.compensation.calibration.pose import find_pose
from thermostand.compensation.calibration.session_centres import observe_positions
from thermostand.compensation.observations import read_session_target
from thermostand.foundation.clock import NS_PER_S, VirtualClock
from thermostand.foundation.errors import CalibrationError, SessionError
from thermostand.foundation.hub import Hub
from thermostand.foundation.items import Batch, StepMark, StepState
from thermostand.foundation.readings import Frame, Quality, Reading
from thermostand.recording.reading.session import Session

from .conftest import recording
from .renderer import Scene, compute_true_centres_px, photograph, render

START_NS = 1_767_290_400 * NS_PER_S
TARGET_YAML = "name: small\ncolumns: 9\nrows: 6\npitch_mm: 30\ndiameter_mm: 10\nprinting_error_mm: 0.002\n"
PLACES = [(linear, rotary) for linear in (0.0, 60.0, 120.0) for rotary in (-25.0, 0.0, 25.0)]
REPORTED_mm = 0.004
"""The linear axis comes to rest this much beyond where it was sent, and reports it."""
DARK = 4


def scene_at(linear_mm: float, rotary_deg: float) -> Scene:
    return Scene(
        size=(640, 480),
        f_px=2000,
        k1=-0.1,
        distance_mm=1000 + linear_mm,
        diameter_mm=10,
        tilt_y_deg=rotary_deg,
        shift_mm=(1.3, -0.7),
    )


@dataclass(frozen=True)
class Recorded:
    path: Path
    true_px: np.ndarray


async def record(directory: Path, role: str, places: Sequence[tuple[float, float]] = PLACES) -> None:
    devices = {"linear": "axis", "rotary": "axis", "camera": "camera"}
    async with recording(directory, devices, {"target.yaml": TARGET_YAML}, recipe="calibration") as (hub, clock):
        for number, place in enumerate(places):
            await publish_visit(hub, clock, number, place, role)


async def publish_visit(hub: Hub, clock: VirtualClock, number: int, place: tuple[float, float], role: str) -> None:
    """Move, poll while moving and at rest, capture two frames."""
    for index, (axis, position) in enumerate(zip(("linear", "rotary"), place, strict=True)):
        move = f"move-{number}-{axis}"
        for state in (StepState.STARTED, StepState.DONE):
            parameters: dict[str, object] = {"axis": axis, "position": position}
            hub.publish(StepMark(clock.now_ns(), move, 3 * number + index, "move_to", state, parameters))
            if state is StepState.STARTED:
                publish_poll(hub, clock.now_ns(), axis, position - 20, moving=1.0)
            await clock.sleep_until(clock.now_ns() + NS_PER_S)
    publish_poll(hub, clock.now_ns(), "linear", place[0] + REPORTED_mm, moving=0.0)
    capture = f"capture-{number}"
    parameters = {"frames": 2, "role": role, "chamber_degC": 24.0}
    hub.publish(StepMark(clock.now_ns(), capture, 3 * number + 2, "capture", StepState.STARTED, parameters))
    scene = scene_at(place[0] + REPORTED_mm, place[1])
    clean = render(scene)
    for frame in range(2):
        await clock.sleep_until(clock.now_ns() + NS_PER_S)
        image = photograph(scene, clean, 10 * number + frame)
        if number == DARK and frame == 1:
            image = np.full_like(image, 3)
        hub.publish(Frame("camera.image", image, clock.now_ns(), 0.1, 0.0, 40.0, 2 * number + frame, 0, 0, capture))
    hub.publish(StepMark(clock.now_ns(), capture, 3 * number + 2, "capture", StepState.DONE, parameters))


def publish_poll(hub: Hub, time_ns: int, axis: str, position: float, moving: float) -> None:
    readings = (
        Reading(f"{axis}.position", position, "mm", time_ns, Quality.GOOD),
        Reading(f"{axis}.moving", moving, "1", time_ns, Quality.GOOD),
    )
    hub.publish(Batch(axis, time_ns, readings))


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Recorded:
    path = tmp_path_factory.mktemp("sessions") / "calibration"
    asyncio.run(record(path, "calibration"))
    return Recorded(path, np.array([compute_true_centres_px(scene_at(z + REPORTED_mm, angle)) for z, angle in PLACES]))


@pytest.fixture(scope="module")
def camera_text(recorded: Recorded, tmp_path_factory: pytest.TempPathFactory) -> str:
    """A camera file, made with the model given."""
    out = tmp_path_factory.mktemp("camera") / "camera.json"
    assert run(recorded.path, "-o", out, "--model", "rational").exit_code == 0
    return out.read_text()


def run(*arguments: str | Path) -> Result:
    return CliRunner().invoke(cli.app, ["calibrate", *(str(argument) for argument in arguments)])


def test_positions_are_what_the_axes_reported_at_rest_and_frames_are_averaged(recorded: Recorded):
    session = Session.open(recorded.path)
    found = observe_positions(session, read_session_target(session))
    assert found.linear_mm == pytest.approx([linear + REPORTED_mm for linear, _ in PLACES], abs=1e-9)
    assert found.rotary_deg.tolist() == [rotary for _, rotary in PLACES]  # never reported at rest: where it was sent
    assert found.frames.tolist() == [2] * DARK + [1] + [2] * (len(PLACES) - DARK - 1)
    assert found.image_size == (640, 480)
    off = found.centres_px - recorded.true_px
    sigma = np.sqrt(np.diagonal(found.covariance_px2, axis1=2, axis2=3))
    assert np.sqrt(np.nanmean((off / sigma) ** 2)) == pytest.approx(1.0, abs=0.25)
    assert sigma[DARK].mean() == pytest.approx(np.sqrt(2) * sigma[0].mean(), rel=0.2)
    assert 0.8 < found.chi < 1.2


def test_calibrate_writes_the_camera_its_exports_and_a_report(recorded: Recorded, tmp_path: Path):
    out, exports, report = tmp_path / "camera.json", tmp_path / "exports", tmp_path / "report.html"
    result = run(recorded.path, "-o", out, "--export", exports, "--report", report, "--rotary-arcmin", "0.02")
    assert result.exit_code == 0, result.output
    camera = load_camera(out)
    assert camera.lens.focal_px == pytest.approx([2000, 2000], abs=1.0)
    assert camera.lens.vector[4] == pytest.approx(-0.1, abs=0.02)
    assert camera.fit.ratio < 1.05
    assert (camera.camera_serial, camera.session_ids, camera.target_name) == ("TS-0001", ("calibration",), "small")
    assert {path.name for path in exports.iterdir()} == {
        "opencv.yaml",
        "ros_camera_info.yaml",
        "kalibr_camchain.yaml",
        "mrcal.cameramodel",
    }
    assert report.read_text().count("<svg") == 7
    assert "x the detection sigma" in result.stdout
    assert "orientation: small" in result.stdout
    for lens in (camera.lens, camera.ray_lens):
        pose = find_pose(lens, camera.adjusted_board, recorded.true_px[2], np.tile(1e-5 * np.eye(2), (54, 1, 1)))
        rotation, translation = scene_at(REPORTED_mm, 25.0).pose()
        assert np.abs(pose.rotation - rotation).max() < 2e-3
        assert pose.translation_mm == pytest.approx(translation, abs=1.5)
    again = tmp_path / "again.json"
    camera.save(again)
    assert again.read_bytes() == out.read_bytes()


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"format": "another"}, "format"),
        ({"names": ["fx"]}, "not those of a pinhole"),
        ({"covariance": [[1.0]]}, "covariance: shape (1, 1) instead of (24, 24)"),
        ({"surplus": 1}, "surplus"),
    ],
)
def test_a_file_that_is_not_a_camera_is_refused(
    camera_text: str, tmp_path: Path, change: dict[str, object], sentence: str
):
    out = tmp_path / "camera.json"
    out.write_text(json.dumps(json.loads(camera_text) | change))
    with pytest.raises(SessionError, match="not a camera file") as refused:
        load_camera(out)
    assert sentence in str(refused.value)
    with pytest.raises(SessionError, match="no such file"):
        load_camera(tmp_path / "none.json")


def test_bad_input_is_refused_with_a_sentence_and_leaves_nothing(recorded: Recorded, tmp_path: Path):
    out = tmp_path / "camera.json"
    cases = [
        ([tmp_path, "-o", out], "not a session", 2),
        ([recorded.path, "-o", tmp_path / "none" / "camera.json"], "cannot be written", 1),
        (
            [recorded.path, "-o", out, "--export", next((recorded.path / "telemetry").iterdir()) / "exports"],
            "cannot be made",
            1,
        ),
        ([recorded.path, "-o", out, "--target", "dots"], "installed targets", 2),
        ([recorded.path, "-o", out, "--model", "fisheye"], "fisheye", 2),
        ([recorded.path, "-o", out, "--linear-um", "0"], "--linear-um", 2),
    ]
    for arguments, sentence, status in cases:
        result = run(*arguments)
        assert result.exit_code == status, sentence
        assert sentence in result.stderr.splitlines()[-1]
        assert not list(tmp_path.iterdir())


def test_a_session_without_calibration_frames_is_refused(recorded: Recorded, tmp_path: Path):
    asyncio.run(record(tmp_path / "poses", "pose", PLACES[:1]))
    session = Session.open(tmp_path / "poses")
    with pytest.raises(SessionError, match="the role calibration"):
        observe_positions(session, read_session_target(session))
    text = TARGET_YAML.replace("columns: 9", "columns: 12")
    (tmp_path / "other.yaml").write_text(text)
    session = Session.open(recorded.path)
    other = read_session_target(session).model_copy(update={"polarity": "light"})
    with pytest.raises(CalibrationError, match="found at 0 positions, 5 are needed; frame"):
        observe_positions(session, other)
