"""What the page shows of a frame, against rendered photographs of which everything is known."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.compensation.renderer import Scene, compute_true_centres_px, photograph, render
from thermostand.markers.detection import detect
from thermostand.markers.target import load_target
from thermostand.stand.serving.preview import (
    Previewer,
    compute_keystone_percent,
    compute_tilt_deg,
    encode_half_jpeg,
    measure_setup,
)
from thermostand.stand.serving.shot import FrameShot

PAPER = load_target(Path(__file__).parents[2] / "configs" / "targets" / "paper-9x6.yaml")
SMALL = Scene(size=(612, 512), f_px=2193)
MOVED = replace(SMALL, shift_mm=(0.1, -0.06))


IMAGES = {}


def image_of(scene):
    if repr(scene) not in IMAGES:
        IMAGES[repr(scene)] = photograph(scene, render(scene), 1)
    return IMAGES[repr(scene)]


def shot(scene, time_ns=1, **kwargs):
    return FrameShot("camera", time_ns, image_of(scene), **kwargs)


def test_drift_is_shown_against_the_reference_and_is_the_true_one():
    previewer = Previewer(PAPER)
    first = previewer.look(shot(SMALL, role="reference", as_reference=True))
    assert (first.mean_px, first.expected, len(first.markers)) == (0.0, 54, 54)
    then = previewer.look(shot(MOVED, 2, role="fit"))
    truth = compute_true_centres_px(MOVED) - compute_true_centres_px(SMALL)
    assert then.reference_ns == 1
    assert then.mean_px == pytest.approx(np.hypot(*truth.mean(axis=0)), abs=0.005)
    assert (then.mean_dx, then.mean_dy) == pytest.approx(truth.mean(axis=0), abs=0.005)
    assert then.worst_px == pytest.approx(np.hypot(*truth.T).max(), abs=0.03)
    number, x, y, dx, dy = then.markers[10]
    assert (x, y) == pytest.approx(compute_true_centres_px(MOVED)[number - 1], abs=0.06)
    assert (dx, dy) == pytest.approx(truth[number - 1], abs=0.06)


def test_of_a_target_that_is_moved_on_purpose_no_drift_is_shown():
    previewer = Previewer(PAPER)
    previewer.look(shot(SMALL, role="reference", as_reference=True))
    found = previewer.look(shot(MOVED, 2, role="calibration"))
    assert found.mean_px is None
    assert found.markers[0][3:] == (None, None)
    assert previewer.look(shot(SMALL, 3, role="fit")).mean_px == pytest.approx(0, abs=0.001)  # the reference stays


def test_a_frame_without_the_target_says_why_and_is_shown_all_the_same():
    blank = np.full((512, 612), 90, np.uint8)
    found = Previewer(PAPER).look(FrameShot("camera", 1, blank))
    assert found.markers == ()
    assert found.trouble
    assert found.setup.histogram[90 // 4] == 1.0
    assert found.setup.edge_px is None


def test_the_picture_has_half_the_size_also_of_sixteen_bits():
    for image in (image_of(SMALL), image_of(SMALL).astype(np.uint16) << 8):
        back = cv2.imdecode(np.frombuffer(encode_half_jpeg(image), np.uint8), cv2.IMREAD_UNCHANGED)
        assert back.shape == (256, 306)
        assert abs(float(back.mean()) - float(image_of(SMALL).mean())) < 2


def test_the_edges_are_as_wide_as_the_blur_makes_them():
    for psf_px in (0.8, 1.6):
        scene = replace(SMALL, psf_px=psf_px)
        found = Previewer(PAPER).look(shot(scene)).setup
        assert found.edge_px == pytest.approx(2.5631 * np.hypot(psf_px, np.sqrt(1 / 12)), rel=0.05)
        assert found.contrast_DN == pytest.approx(170, rel=0.03)


def test_too_much_light_is_reported():
    image = image_of(SMALL).copy()
    image[:128] = 255
    setup = measure_setup(image, None, PAPER)
    assert setup.saturated == pytest.approx(0.25, abs=0.001)
    assert sum(setup.histogram) == pytest.approx(1, abs=1e-3)


@pytest.mark.parametrize(("x_deg", "y_deg"), [(20.0, 0.0), (0.0, 12.0), (-15.0, 8.0)])
def test_the_tilt_of_the_target_is_reported(x_deg, y_deg):
    scene = replace(SMALL, tilt_x_deg=x_deg, tilt_y_deg=y_deg)
    found = detect(image_of(scene), PAPER)
    normal = np.cos(np.radians(x_deg)) * np.cos(np.radians(y_deg))
    assert compute_tilt_deg(found.homography, PAPER) == pytest.approx(np.degrees(np.arccos(normal)), abs=1.0)


def test_a_target_that_faces_the_camera_has_no_tilt_and_no_keystone():
    found = detect(image_of(SMALL), PAPER)
    assert compute_tilt_deg(found.homography, PAPER) is None
    assert compute_keystone_percent(found.homography, PAPER) == pytest.approx((0, 0), abs=0.05)


@pytest.mark.parametrize("tilt", ["tilt_x_deg", "tilt_y_deg"])
def test_the_keystone_shows_which_side_is_nearer(tilt):
    """The scale at each end of the target, from the true centres of its outer markers."""
    scene = replace(SMALL, **{tilt: 10.0})
    found = detect(image_of(scene), PAPER)
    centres = compute_true_centres_px(scene).reshape(6, 9, 2)
    gaps_down, gaps_across = np.abs(np.diff(centres[:, :, 1], axis=0)), np.abs(np.diff(centres[:, :, 0], axis=1))
    column, row = np.argsort(centres[0, :, 0]), np.argsort(centres[:, 0, 1])
    right_left = gaps_down[:, column[-1]].mean() / gaps_down[:, column[0]].mean() - 1
    low_up = gaps_across[row[-1]].mean() / gaps_across[row[0]].mean() - 1
    across, down = compute_keystone_percent(found.homography, PAPER)
    if tilt == "tilt_y_deg":
        assert across / 100 == pytest.approx(np.sign(right_left) * abs(right_left) * 1.0, rel=0.6)
        assert abs(down) < 0.3
    else:
        assert np.sign(down) == np.sign(low_up)
        assert abs(across) < 0.3
