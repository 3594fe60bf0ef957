"""Which marker is which where the image alone does not say: sides beyond the frame, mirrors, turned files."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import PIL.Image
import pytest

from tests.nightly import mark_nightly
from thermostand.markers.detection import DetectionError, Flag, detect
from thermostand.markers.image_file import read_image
from thermostand.markers.target import DonutMarkers, OddMarker, Target

from .renderer import Scene, compute_true_centres_px, photograph, render
from .test_markers import HALF, PAPER, rms_mpx

MARKED = PAPER.model_copy(update={"odd_marker": OddMarker(number=1, diameter_mm=14.0)})
DONUTS = PAPER.model_copy(update={"donut_markers": DonutMarkers(numbers=(20, 22, 40), hole_mm=4.0)})
SCENE = replace(HALF, roll_deg=3, distance_mm=1100)
WITH_HOLES = replace(SCENE, holes_mm=dict.fromkeys((20, 22, 40), 4.0))


def shifted(scene: Scene, x_px: float, y_px: float) -> Scene:
    per_px = scene.distance_mm / scene.f_px
    return replace(scene, shift_mm=(x_px * per_px, y_px * per_px))


@pytest.mark.parametrize(
    ("side", "cut"),
    [
        *[("left", "beyond"), ("right", "half"), ("top", "a tenth"), ("bottom", "beyond")],
        *[mark_nightly("left", "half"), mark_nightly("left", "a tenth"), mark_nightly("right", "beyond")],
        *[mark_nightly("right", "a tenth"), mark_nightly("top", "beyond"), mark_nightly("top", "half")],
        *[mark_nightly("bottom", "half"), mark_nightly("bottom", "a tenth")],
    ],
)
def test_a_side_of_the_grid_beyond_the_frame_is_found_by_the_frame(side: str, cut: str):
    scene = replace(SCENE, roll_deg=0)
    truth, (width, height) = compute_true_centres_px(scene), scene.size
    radius = 4 * scene.f_px / scene.distance_mm
    inside = {"beyond": -2 * radius, "half": 0.0, "a tenth": 0.8 * radius}[cut]
    moves = {
        "left": (inside - truth[:, 0].min(), 0.0),
        "right": (width - 1 - inside - truth[:, 0].max(), 0.0),
        "top": (0.0, inside - truth[:, 1].min()),
        "bottom": (0.0, height - 1 - inside - truth[:, 1].max()),
    }
    scene = shifted(scene, *moves[side])
    found = detect(photograph(scene, render(scene), 1), PAPER)
    assert found.found == (48 if side in ("left", "right") else 45)
    assert rms_mpx(found, scene) < 6
    assert np.all(found.flags[np.isnan(found.centres_px[:, 0])] & Flag.MISSING)


def test_a_side_that_should_be_in_the_frame_and_is_not_leaves_two_places_and_is_refused():
    scene = replace(SCENE, distance_mm=1500, missing=tuple(range(1, 55, 9)))
    with pytest.raises(DetectionError, match="more than one place"):
        detect(photograph(scene, render(scene), 1), PAPER)


def test_a_mirrored_image_of_a_marked_target_is_refused_and_the_image_itself_is_not():
    scene = replace(SCENE, diameters_mm={1: 14.0}, roll_deg=150)
    image = photograph(scene, render(scene), 1)
    assert rms_mpx(detect(image, MARKED), scene) < 6
    for mirrored in (image[:, ::-1], image[::-1]):
        with pytest.raises(DetectionError, match=r"mirrored, .* odd marker 1"):
            detect(np.ascontiguousarray(mirrored, np.uint8), MARKED)


@pytest.mark.parametrize(("roll_deg", "is_light"), [(-100, False), (90, True), (183, False)])
def test_three_donuts_tell_the_turn_and_are_measured_like_the_others(roll_deg: float, is_light: bool):
    levels = {"disc_DN": 200.0, "ground_DN": 30.0} if is_light else {}
    scene = replace(WITH_HOLES, roll_deg=roll_deg, distance_mm=1500, **levels)
    target = DONUTS.model_copy(update={"polarity": "light" if is_light else "dark"})
    found = detect(photograph(scene, render(scene), 1), target)
    assert found.found == 54
    assert not found.flags.any()
    sigmas = (found.centres_px - compute_true_centres_px(scene)) / np.sqrt(
        np.diagonal(found.covariance_px2, axis1=1, axis2=2)
    )
    assert np.abs(sigmas[target.is_donut()]).max() < 4
    assert detect(photograph(scene, render(scene), 2), target, found).found == 54


def test_a_mirrored_image_of_a_target_with_donuts_is_refused_and_one_filled_by_dirt_or_one_of_glare_is_not():
    clean = render(WITH_HOLES)
    image = np.asarray(photograph(WITH_HOLES, clean, 1), np.uint8)
    for mirrored in (image[:, ::-1], image[::-1]):
        with pytest.raises(DetectionError, match=r"mirrored, .* 20, 22 and 40"):
            detect(np.ascontiguousarray(mirrored), DONUTS)
    u, v = np.rint(compute_true_centres_px(WITH_HOLES)[[19, 30]]).astype(int).T
    dirty, shining = image.copy(), image.copy()
    dirty[v[0] - 9 : v[0] + 10, u[0] - 9 : u[0] + 10] = 30
    shining[v[1] - 8 : v[1] + 9, u[1] - 8 : u[1] + 9] = 200
    for picture in (dirty, shining):
        assert rms_mpx(detect(picture, DONUTS), WITH_HOLES) < 20
    bare = photograph(SCENE, render(SCENE), 1)
    with pytest.raises(DetectionError, match="not the donut markers 20, 22 and 40"):
        detect(bare, DONUTS)


def test_a_target_says_how_its_orientation_is_known():
    assert MARKED.orientation.endswith("odd marker 1")
    assert DONUTS.orientation.endswith("20, 22 and 40")
    assert "target file" in PAPER.orientation
    silent = Target(name="t", columns=9, rows=6, pitch_mm=30, diameter_mm=8)
    assert "within 75 deg of 0 deg in the image (assumed" in silent.orientation


@pytest.mark.parametrize(("orientation", "words"), [(2, "mirrored"), (3, "180"), (6, "90"), (8, "270")])
def test_a_file_that_is_to_be_shown_turned_is_refused(tmp_path: Path, orientation: int, words: str):
    exif = PIL.Image.Exif()
    exif[0x0112] = orientation
    picture = PIL.Image.fromarray(np.zeros((8, 12), np.uint8))
    for name in ("turned.jpg", "turned.png"):
        picture.save(tmp_path / name, exif=exif)
        with pytest.raises(DetectionError, match=rf"{name}: its EXIF orientation .* {words}.*exiftool -Orientation="):
            read_image(tmp_path / name)


@pytest.mark.parametrize("orientation", [0, 1, 9])
def test_a_file_that_is_upright_or_says_nonsense_is_read(tmp_path: Path, orientation: int):
    exif = PIL.Image.Exif()
    exif[0x0112] = orientation
    PIL.Image.fromarray(np.zeros((8, 12), np.uint8)).save(tmp_path / "upright.jpg", exif=exif)
    assert read_image(tmp_path / "upright.jpg").shape == (8, 12)
