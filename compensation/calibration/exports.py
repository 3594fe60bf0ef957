"""The pinhole in the files of other programs. All of them put integer coordinates at pixel centres, as we do.

Kalibr's radtan has no k3: the camera is fitted again without it, and the difference is reported.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import yaml

from thermostand.compensation.calibration.least_squares import Float, make_equations, minimise
from thermostand.compensation.calibration.pinhole import Pinhole
from thermostand.compensation.calibration.uncertainty import make_pixel_grid
from thermostand.foundation.files import make_folder, write_atomically

_GRID_COLUMNS = 33  # round number; nothing was measured


@dataclass(frozen=True, slots=True)
class RadtanFit:
    """A lens fitted to another one over the whole image; rms_px per coordinate, worst_px: the longest difference."""

    lens: Pinhole
    rms_px: float
    worst_px: float


def refit_radtan(lens: Pinhole) -> RadtanFit:
    """The nearest camera with k1 k2 p1 p2 only, by least squares over the pixels of the image.

    A rational denominator and k3 go into k1, k2 and the focal lengths, not away.
    """
    pixels = make_pixel_grid(lens.image_size, _GRID_COLUMNS).reshape(-1, 2)
    slopes = lens.compute_slopes(pixels)
    kept = np.isfinite(slopes).all(axis=1)
    points = np.column_stack([slopes[kept], np.ones(np.count_nonzero(kept))])
    vector = np.concatenate([lens.vector[:8], [0.0]])

    def step(state: Pinhole, change: Float) -> Pinhole:
        return state.apply_step(np.concatenate([change, [0.0]]))

    solution = minimise(
        Pinhole(vector, lens.image_size),
        lambda state: (state.project(points) - pixels[kept]).ravel() / 1e-6,
        make_equations(lambda state: state.compute_vector_jacobian(points)[:, :, :8].reshape(-1, 8) / 1e-6),
        step,
    )
    off = solution.state.project(points) - pixels[kept]
    return RadtanFit(solution.state, float(np.sqrt(np.mean(off**2))), float(np.linalg.norm(off, axis=1).max()))


def format_opencv_yaml(lens: Pinhole, name: str, rms_px: float) -> str:
    """OpenCV's FileStorage. rms_px: per coordinate; the file has OpenCV's root of the mean of dx^2 + dy^2."""
    storage = cv2.FileStorage("camera.yaml", cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
    storage.write("camera_name", name)
    storage.write("image_width", lens.image_size[0])
    storage.write("image_height", lens.image_size[1])
    storage.write("camera_matrix", lens.matrix)
    storage.write("distortion_coefficients", lens.distortion[:, None])
    storage.write("avg_reprojection_error", math.sqrt(2) * rms_px)
    return storage.releaseAndGetString()


def format_ros_yaml(lens: Pinhole, name: str, rms_px: float) -> str:
    """ROS camera_info."""
    matrix = lens.matrix
    entries: dict[str, object] = {
        "image_width": lens.image_size[0],
        "image_height": lens.image_size[1],
        "camera_name": name,
        "camera_matrix": _format_ros_matrix(matrix),
        "distortion_model": "plumb_bob" if len(lens.distortion) == 5 else "rational_polynomial",
        "distortion_coefficients": _format_ros_matrix(lens.distortion[None]),
        "rectification_matrix": _format_ros_matrix(np.eye(3)),
        "projection_matrix": _format_ros_matrix(np.column_stack([matrix, np.zeros(3)])),
    }
    return yaml.safe_dump(entries, sort_keys=False, default_flow_style=None)


def format_kalibr_yaml(lens: Pinhole, name: str, rms_px: float) -> str:
    """Kalibr's camchain with the refitted camera."""
    vector = refit_radtan(lens).lens.vector.tolist()
    camera = {
        "camera_model": "pinhole",
        "intrinsics": vector[:4],
        "distortion_model": "radtan",
        "distortion_coeffs": vector[4:8],
        "resolution": list(lens.image_size),
        "rostopic": f"/{name}/image_raw",
    }
    return yaml.safe_dump({"cam0": camera}, sort_keys=False, default_flow_style=None)


def format_mrcal_cameramodel(lens: Pinhole, name: str, rms_px: float) -> str:
    """mrcal's .cameramodel: a Python literal, the camera at the origin."""
    entries = {
        "lensmodel": f"LENSMODEL_OPENCV{len(lens.distortion)}",
        "intrinsics": lens.vector.tolist(),
        "extrinsics": [0.0] * 6,
        "imagersize": list(lens.image_size),
        "icam_intrinsics": 0,
    }
    lines = [f"    {key!r}: {value!r}," for key, value in entries.items()]
    return "\n".join(["{", *lines, "}", ""])


EXPORTS: Mapping[str, Callable[[Pinhole, str, float], str]] = {
    "opencv.yaml": format_opencv_yaml,
    "ros_camera_info.yaml": format_ros_yaml,
    "kalibr_camchain.yaml": format_kalibr_yaml,
    "mrcal.cameramodel": format_mrcal_cameramodel,
}
"""File name -> its writer, called with the camera, its name and the reprojection's RMS per coordinate, px."""


def write_exports(folder: Path, lens: Pinhole, name: str, rms_px: float) -> None:
    """Write every export into the folder, made when it is missing, once all of them are made; SessionError when the
    place refuses."""
    texts = {file: writer(lens, name, rms_px) for file, writer in EXPORTS.items()}
    make_folder(folder)
    for file, text in texts.items():
        write_atomically(folder / file, text)


def _format_ros_matrix(matrix: Float) -> dict[str, object]:
    return {"rows": matrix.shape[0], "cols": matrix.shape[1], "data": matrix.ravel().tolist()}
