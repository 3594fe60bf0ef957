"""Fifteen webcam pictures of a 10 x 10 target (robot_cal_tools, Apache-2.0): real noise, glare, textured ground."""

from __future__ import annotations

import csv
import os
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from tests.nightly import mark_nightly
from thermostand.compensation.cli import app
from thermostand.compensation.commands import detect_cli
from thermostand.markers.detection import Detection, detect
from thermostand.markers.grid_identification import project
from thermostand.markers.image_file import read_image
from thermostand.markers.target import load_target

ROOT = Path(__file__).parents[2]
TARGET = load_target(ROOT / "configs" / "targets" / "robot-cal-tools-10x10.yaml")
IMAGES = ROOT.parent / "shared" / "data" / "robot_cal_tools_10x10" / "images"


BY_DAY = (0, 4, 8, 12)
OTHERS = (1, 2, 3, 5, 6, 7, 9, 10, 11, 13, 14)
Detected = tuple[Path, list[Detection]]


@pytest.fixture(scope="module")
def detected_of(tmp_path_factory: pytest.TempPathFactory) -> Callable[[tuple[int, ...]], Detected]:
    return cache(lambda numbers: detected(numbers, tmp_path_factory.mktemp("photographs") / "markers.csv"))


def detected(numbers: tuple[int, ...], out: Path) -> Detected:
    """The table that `compensate detect` writes of these photographs, and the detections it was written from."""
    paths = [IMAGES / f"{number}.png" for number in numbers]
    for path in paths:
        if not path.exists():
            if os.environ.get("CI") == "true":
                pytest.fail(f"{path} is missing")
            pytest.skip(f"{path} is missing")
    detections: list[Detection] = []

    def kept(*arguments: Any, **options: Any) -> Detection:
        detections.append(detect(*arguments, **options))
        return detections[-1]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(detect_cli, "detect", kept)
        arguments = ["detect", *map(str, paths), "--target", "robot-cal-tools-10x10", "-o", str(out)]
        result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 0, result.output
    assert "not found" not in result.stderr
    assert "variances of their centres" in result.stderr
    return out, detections


@pytest.mark.parametrize(("numbers", "doubtless"), [(BY_DAY, 0), mark_nightly(OTHERS, 1)])
def test_noise_does_not_describe_webcam_pictures_of_a_print_and_that_is_reported(
    numbers: tuple[int, ...], doubtless: int, detected_of: Callable[[tuple[int, ...]], Detected]
):
    assert [one.is_suspect for one in detected_of(numbers)[1]].count(False) <= doubtless


@pytest.fixture(params=[*BY_DAY, *map(mark_nightly, OTHERS)], ids="{}.png".format)
def photograph(
    request: pytest.FixtureRequest, detected_of: Callable[[tuple[int, ...]], Detected]
) -> tuple[np.ndarray, Detection]:
    numbers = BY_DAY if request.param in BY_DAY else OTHERS
    detection = detected_of(numbers)[1][numbers.index(request.param)]
    return read_image(IMAGES / f"{request.param}.png"), detection


@pytest.mark.parametrize("numbers", [BY_DAY, mark_nightly(OTHERS)])
def test_the_table_has_every_marker_of_every_photograph(
    numbers: tuple[int, ...], detected_of: Callable[[tuple[int, ...]], Detected]
):
    with detected_of(numbers)[0].open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 100 * len(numbers)
    for number in numbers:
        own = [row for row in rows if row["image"] == f"{number}.png"]
        assert [int(row["marker"]) for row in own] == list(range(1, 101))
        assert not [row for row in own if row["x_px"] == "nan" or "MISSING" in row["flags"].split("|")]


def test_all_hundred_dots_are_found_where_opencv_finds_them(photograph: tuple[np.ndarray, Detection]):
    image, detection = photograph
    assert detection.found == 100
    success, grid = cv2.findCirclesGrid(image, (10, 10))
    assert success
    away = np.linalg.norm(grid.reshape(-1, 1, 2) - detection.centres_px[None], axis=2)
    assert sorted(away.argmin(axis=1)) == list(range(100))
    assert away.min(axis=1).max() < 0.5


def test_the_dots_lie_on_one_plane_in_their_order(photograph: tuple[np.ndarray, Detection]):
    """A mix-up costs at least a pitch, 13 px; the lens distorts by up to 3 px at the picture's edge."""
    _, detection = photograph
    off = np.linalg.norm(project(detection.homography, TARGET.coordinates_mm()) - detection.centres_px, axis=1)
    assert np.sqrt(np.mean(off**2)) < 0.7
    assert off.max() < 3
    rows, columns = (
        detection.centres_px[10] - detection.centres_px[0],
        detection.centres_px[1] - detection.centres_px[0],
    )
    assert columns[0] * rows[1] - columns[1] * rows[0] < 0


def test_the_big_dot_is_marker_one_in_its_corner(photograph: tuple[np.ndarray, Detection]):
    image, detection = photograph
    radii = detection.state.radii_px()
    assert radii.argmax() == 0
    assert radii[0] > 1.5 * np.max(radii[1:])
    dark = cv2.threshold(image, 0, 255, cv2.THRESH_BINARY_INV + cv2.THRESH_OTSU)[1]
    x, y = np.rint(detection.centres_px[0]).astype(int)
    # A square as large as half the big dot, larger than any small one, is dark to its corners.
    half = int(0.6 * radii[0])
    assert dark[max(y - half, 0) : y + half + 1, max(x - half, 0) : x + half + 1].all()
