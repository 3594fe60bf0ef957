"""Pictures and tables as other laboratories have them, of a small target whose camera drifts by a known law."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from tests.compensation.renderer import Float, Scene, photograph, render

TARGET = """name: small
columns: 5
rows: 4
pitch_mm: 30
diameter_mm: 10
polarity: dark
"""
REFERENCE_DEGC = 22
PPM_PER_K, SHIFT_PX_PER_K = 60.0, 0.04
SCENE = Scene(columns=5, rows=4, diameter_mm=10.0, size=(320, 256), f_px=1250.0, distance_mm=700.0, psf_px=0.8)


def make_scene(degC: float, distance_mm: float) -> Scene:
    """The target at this distance, seen by a camera of this temperature: its scale and its principal point drift."""
    away_K, mm_per_px = degC - REFERENCE_DEGC, distance_mm / SCENE.f_px
    return replace(
        SCENE,
        distance_mm=distance_mm,
        f_px=SCENE.f_px * (1 + 1e-6 * PPM_PER_K * away_K),
        shift_mm=(SHIFT_PX_PER_K * away_K * mm_per_px, 0.0),
    )


def make_true_shift(xy_px: Float, degC: float) -> Float:
    """Reference minus measured, px, at points (N, 2) that are measured at this temperature."""
    away_K, middle = degC - REFERENCE_DEGC, (np.array(SCENE.size) - 1) / 2
    moved = np.array([SHIFT_PX_PER_K * away_K, 0.0])
    scale = 1 + 1e-6 * PPM_PER_K * away_K
    return middle + (xy_px - middle - moved * scale) / scale - xy_px


def write_picture(path: Path, degC: float, distance_mm: float, seed: int) -> None:
    """A photograph of it, with noise of its own."""
    scene = make_scene(degC, distance_mm)
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), photograph(scene, render(scene), seed))


def write_pose(path: Path, distance_mm: float) -> None:
    """The pose of the target in the camera, m."""
    pose = np.eye(4)
    pose[2, 3] = distance_mm / 1000
    np.savetxt(path, pose)


def write_target(folder: Path) -> Path:
    """The target's file."""
    path = folder / "small.yaml"
    path.write_text(TARGET)
    return path
