"""Windows around the markers, and that a detection on what they keep is the detection on the whole image."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from tests.nightly import mark_nightly
from thermostand.foundation.readings import Frame
from thermostand.markers.detection import Flag, detect
from thermostand.markers.target import load_target
from thermostand.markers.windows import MARGIN_px, find_marker_windows
from thermostand.recording.format.images import MarkerWindows

from .renderer import Scene, photograph, project, render

PAPER = load_target(Path(__file__).parents[2] / "configs" / "targets" / "paper-9x6.yaml")
HALF = Scene(size=(1224, 1024), f_px=4386)
VIEWS = {
    "frontal": HALF,
    "tilted": dataclasses.replace(HALF, tilt_y_deg=30, roll_deg=-10),
    "rolled and tilted": dataclasses.replace(HALF, roll_deg=45, tilt_x_deg=30, distance_mm=1300),
    "larger discs than described": dataclasses.replace(HALF, diameter_mm=10),
}


def outlines_px(scene):
    """Points on the true outline of each marker, (N, 90, 2)."""
    angle = np.arange(90) * (2 * np.pi / 90)
    circle = np.column_stack([np.cos(angle), np.sin(angle)])
    return np.array([project(scene, disc[:2] + disc[2] / 2 * circle) for disc in scene.discs_mm()])


@pytest.mark.parametrize("view", VIEWS)
def test_a_window_is_its_markers_bounding_box_and_the_margin(view):
    scene = VIEWS[view]
    windows = find_marker_windows(photograph(scene, render(scene), 1), PAPER)
    assert windows.dtype == np.int32
    assert windows.shape == (54, 4)
    outlines = outlines_px(scene)
    low, high = windows[:, :2], windows[:, :2] + windows[:, 2:] - 1
    for margin in (outlines.min(axis=1) - low, high - outlines.max(axis=1)):
        assert margin.min() > MARGIN_px - 0.7
        assert margin.max() < MARGIN_px + 1.7


def test_windows_end_at_the_edges_of_the_image():
    # The outermost outlines are 6 px from the left edge of the image, less than the margin.
    scene = dataclasses.replace(HALF, shift_mm=(-13.9, 0))
    image = photograph(scene, render(scene), 1)
    windows = find_marker_windows(image, PAPER)
    assert windows[:, 0].min() == 0
    assert (windows[:, :2] + windows[:, 2:] <= image.shape[::-1]).all()


def test_without_one_marker_no_windows_are_made():
    scene = dataclasses.replace(HALF, missing=(30,))
    assert find_marker_windows(photograph(scene, render(scene), 1), PAPER) is None


@pytest.mark.parametrize("level_DN", [3, 120, 255])
def test_an_even_image_has_no_windows(level_DN):
    assert find_marker_windows(np.full((512, 612), level_DN, np.uint8), PAPER) is None


def test_an_image_too_small_for_any_marker_has_no_windows():
    assert find_marker_windows(np.zeros((3, 3), np.uint8), PAPER) is None


def partial(images):
    """What a recorder keeps of the second image when the first was whole."""
    keep = MarkerWindows(lambda image: find_marker_windows(image, PAPER))
    times = (0, 1_000_000_000)
    frames = [Frame("camera.image", image, t, 0.1, 0.0, 40.0, 1, 1) for image, t in zip(images, times, strict=True)]
    first, second = map(keep, frames)
    assert first.windows is None
    assert second.windows is not None
    assert (second.image != images[1]).mean() > 0.5, "the test would compare an image with itself"
    return second.image


@pytest.mark.parametrize(
    ("view", "dtype", "gain"),
    [
        *[("frontal", np.uint16, 16), ("tilted", np.uint8, 1)],
        *[mark_nightly("frontal", np.uint8, 1), mark_nightly("tilted", np.uint16, 16)],
    ],
)
def test_centres_from_a_partial_frame_are_those_of_the_whole_one(view, dtype, gain):
    scene = dataclasses.replace(VIEWS[view], read_DN=float(gain), electrons_per_DN=40.0 / gain)
    moved = dataclasses.replace(scene, shift_mm=(0.05, -0.04))  # 0.2 px
    images = [photograph(one, render(one) * gain, seed, dtype) for seed, one in enumerate((scene, moved))]
    kept = partial(images)
    before = detect(images[0], PAPER)
    # Tracked, only pixels of the windows are read. A search looks at the surroundings, too: the fit starts elsewhere.
    for previous, tolerance_px in ((before, 1e-6), (None, 1e-3)):
        found, expected = detect(kept, PAPER, previous), detect(images[1], PAPER, previous)
        assert not (expected.flags & Flag.MISSING).any()
        np.testing.assert_allclose(found.centres_px, expected.centres_px, rtol=0, atol=tolerance_px)
        np.testing.assert_array_equal(found.flags, expected.flags)
