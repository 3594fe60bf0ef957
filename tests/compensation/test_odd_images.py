"""Images that show no target, or one that no camera sees so, end in a sentence and soon."""

from __future__ import annotations

import time
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from thermostand.markers.bootstrap import Candidates
from thermostand.markers.detection import DetectionError, detect
from thermostand.markers.grid import identify
from thermostand.markers.plane import fit_homography, project
from thermostand.markers.target import load_target
from thermostand.stand.config.stand_config import packaged

TARGET = load_target(packaged("targets", "paper-9x6"))
LONGEST_CPU_S = 30.0


def dots(columns: int, rows: int, astray_px: float) -> NDArray[np.uint8]:
    """So many black dots of 14 px in a grid of 22 px."""
    rng, image = np.random.default_rng(1), np.full((rows * 22 + 22, columns * 22 + 22), 200, np.uint8)
    for row in range(rows):
        for column in range(columns):
            x, y = np.array([column, row]) * 22 + 22 + rng.normal(0, astray_px, 2)
            cv2.circle(image, (round(x * 16), round(y * 16)), 7 * 16, 30, -1, cv2.LINE_AA, 4)
    return image


@pytest.mark.parametrize(("columns", "rows"), [(86, 70), (40, 30)])
@pytest.mark.parametrize("astray_px", [0.0, 1.0])
def test_thousands_of_dots_are_refused_soon(columns: int, rows: int, astray_px: float):
    start_s = time.process_time()
    with pytest.raises(DetectionError, match="where paper-9x6 has 54 markers: is it another target"):
        detect(dots(columns, rows, astray_px), TARGET)
    assert time.process_time() - start_s < LONGEST_CPU_S


@pytest.mark.parametrize("horizon", [0.1, 0.48, 0.9])
def test_spots_in_the_shape_of_a_plane_seen_across_its_horizon_are_refused(horizon: float):
    """At this part of the target's length."""
    x_mm = TARGET.coordinates_mm()[:, 0]
    at_mm = x_mm.min() + horizon * np.ptp(x_mm)
    homography = np.array([[2.0, 0.0, 300.0], [0.0, -2.0, 300.0], [0.01, 0.0, -0.01 * at_mm]])
    mapped = np.column_stack([TARGET.coordinates_mm(), np.ones(TARGET.count)]) @ homography.T
    spots = Candidates(mapped[:, :2] / mapped[:, 2:], np.full(TARGET.count, 150.0), np.zeros(TARGET.count))
    with pytest.raises(DetectionError):
        identify(spots, TARGET)
    with pytest.raises(DetectionError, match="cannot be the markers of a flat target"):
        project(homography, TARGET.coordinates_mm())


def test_spots_on_a_line_and_in_one_place_are_no_plane():
    target_mm = TARGET.coordinates_mm()
    for places in (np.column_stack([np.arange(54.0), np.zeros(54)]), np.zeros((54, 2))):
        with pytest.raises(DetectionError, match="cannot be the markers of a flat target"):
            fit_homography(target_mm, places)


@pytest.mark.parametrize("kind", [np.uint8, np.uint16])
@pytest.mark.parametrize("level", [0, 255, -1])
def test_an_image_of_one_colour_or_of_clipped_noise_has_no_target(kind: type[np.uint8] | type[np.uint16], level: int):
    noise = np.random.default_rng(5).normal(-300, 100, (480, 640)).clip(0, 255)
    image: Any = (np.full((480, 640), level) if level >= 0 else noise).astype(kind)
    with pytest.raises(DetectionError):
        detect(image, TARGET)
