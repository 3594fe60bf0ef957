"""Exports read back by other readers than ours, projected by OpenCV, compared with our own projection."""

from __future__ import annotations

import ast
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from thermostand.compensation.calibration.exports import EXPORTS, refit_radtan, write_exports
from thermostand.compensation.calibration.pinhole import Pinhole
from thermostand.foundation.errors import SessionError

SIZE = (2448, 2048)
BROWN = Pinhole(np.array([7246.1234567, 7251.7, 1231.8, 1015.4, -0.12, 0.35, 2e-4, -3e-4, 0.7]), SIZE)
RATIONAL = Pinhole(np.concatenate([BROWN.vector, [0.05, -0.2, 0.4]]), SIZE)
PIXELS = np.stack(np.meshgrid(np.linspace(0, 2447, 25), np.linspace(0, 2047, 21)), axis=-1).reshape(-1, 2)

Read = tuple[np.ndarray, np.ndarray, tuple[int, int]]


def read_opencv(path: Path) -> Read:
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    size = int(storage.getNode("image_width").real()), int(storage.getNode("image_height").real())
    assert storage.getNode("avg_reprojection_error").real() == pytest.approx(np.sqrt(2) * 0.003)
    return storage.getNode("camera_matrix").mat(), storage.getNode("distortion_coefficients").mat(), size


def read_ros(path: Path) -> Read:
    data = yaml.safe_load(path.read_text())
    matrix, distortion = (
        np.array(data[name]["data"]).reshape(data[name]["rows"], data[name]["cols"])
        for name in ("camera_matrix", "distortion_coefficients")
    )
    models = {5: "plumb_bob", 8: "rational_polynomial"}
    assert data["distortion_model"] == models[distortion.size]
    assert np.array_equal(np.reshape(data["projection_matrix"]["data"], (3, 4))[:, :3], matrix)
    assert np.array_equal(np.reshape(data["rectification_matrix"]["data"], (3, 3)), np.eye(3))
    return matrix, distortion, (data["image_width"], data["image_height"])


def read_kalibr(path: Path) -> Read:
    data = yaml.safe_load(path.read_text())["cam0"]
    assert (data["camera_model"], data["distortion_model"]) == ("pinhole", "radtan")
    fx, fy, cx, cy = data["intrinsics"]
    matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
    assert len(data["distortion_coeffs"]) == 4
    return matrix, np.array(data["distortion_coeffs"]), tuple(data["resolution"])


def read_mrcal(path: Path) -> Read:
    data = ast.literal_eval(path.read_text())
    fx, fy, cx, cy, *distortion = data["intrinsics"]
    assert data["lensmodel"] == f"LENSMODEL_OPENCV{len(distortion)}"
    assert data["extrinsics"] == [0] * 6
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]]), np.array(distortion), tuple(data["imagersize"])


READERS: dict[str, Callable[[Path], Read]] = {
    "opencv.yaml": read_opencv,
    "ros_camera_info.yaml": read_ros,
    "kalibr_camchain.yaml": read_kalibr,
    "mrcal.cameramodel": read_mrcal,
}


@pytest.mark.parametrize("lens", [BROWN, RATIONAL])
def test_every_export_reads_back_to_the_same_projection(lens: Pinhole, tmp_path: Path):
    write_exports(tmp_path, lens, "TS-0001", 0.003)
    assert set(READERS) == set(EXPORTS) == {path.name for path in tmp_path.iterdir()}
    points = np.column_stack([lens.compute_slopes(PIXELS), np.ones(len(PIXELS))]) * 826
    for name, reader in READERS.items():
        matrix, distortion, size = reader(tmp_path / name)
        assert size == SIZE
        theirs, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix, distortion)
        ours = refit_radtan(lens).lens if name.startswith("kalibr") else lens
        assert np.abs(ours.project(points) - theirs[:, 0]).max() < 1e-6, name


def test_what_radtan_cannot_hold_is_fitted_not_cut_off():
    strong = BROWN.apply_step(np.array([0, 0, 0, 0, 0, 0, 0, 0, 30.0]))
    refit = refit_radtan(strong)
    points = np.column_stack([strong.compute_slopes(PIXELS), np.ones(len(PIXELS))])
    cut = Pinhole(np.append(strong.vector[:8], 0.0), SIZE)
    cut_px = np.abs(cut.project(points) - PIXELS).max()
    off = refit.lens.project(points) - PIXELS
    assert np.linalg.norm(off, axis=1).max() < 0.1 * cut_px
    assert refit.worst_px == pytest.approx(np.linalg.norm(off, axis=1).max(), rel=0.2)
    assert refit.rms_px < refit.worst_px
    assert refit.lens.vector[8] == 0


def test_a_camera_radtan_can_hold_stays_as_it_is():
    plain = Pinhole(np.append(BROWN.vector[:8], 0.0), SIZE)
    refit = refit_radtan(plain)
    assert refit.worst_px < 1e-6
    assert refit.lens.vector == pytest.approx(plain.vector, rel=1e-6)


def test_a_folder_that_cannot_be_made_is_refused(tmp_path: Path):
    (tmp_path / "file").touch()
    with pytest.raises(SessionError, match="cannot be made"):
        write_exports(tmp_path / "file" / "exports", BROWN, "camera", 0.003)
