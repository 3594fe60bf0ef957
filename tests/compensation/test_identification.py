"""A seeded few of the benchmark's frames: every marker identified from the pixels, and in its place."""

from __future__ import annotations

import numpy as np
import pytest

from tests.compensation.identification_scenes import TARGETS, draw_pose, find_own_centres, judge
from tests.compensation.renderer import compute_true_centres_px, photograph, render
from thermostand.markers.detection import detect
from thermostand.markers.target import load_target
from thermostand.stand.config.stand_config import find_packaged

PAPER = load_target(find_packaged("targets", "paper-9x6"))


@pytest.mark.parametrize("name", ["uneven light", "one marker missing", "dark disc clutter"])
def test_the_papers_target_is_identified(name: str):
    scene = draw_pose(name, 3)
    assert judge(find_own_centres(photograph(scene, render(scene), 3), PAPER), scene, own_order=True) == "found"


@pytest.mark.parametrize("name", ["light on dark", "staggered 4x11", "20x14", "webcam, 8 px discs"])
def test_other_targets_are_identified(name: str):
    target, nominal = TARGETS[name]
    scene = draw_pose(name, 3, {name: nominal})
    assert judge(find_own_centres(photograph(scene, render(scene), 3), target), scene, own_order=True) == "found"


def test_the_first_stage_is_off_by_noise_alone_also_where_it_searches_a_reduced_image():
    scene = draw_pose("roll 20", 1)
    centres_px = find_own_centres(photograph(scene, render(scene), 1), PAPER)
    assert centres_px is not None
    off = centres_px - compute_true_centres_px(scene)
    assert np.abs(off.mean(axis=0)).max() < 0.05
    assert np.abs(off).max() < 0.5


def test_detection_keeps_the_corners_that_a_wide_lens_puts_off_the_homography():
    scene = draw_pose("wide field, distortion", 1)
    detection = detect(photograph(scene, render(scene), 1), PAPER)
    assert detection.found == 54
    assert np.abs(detection.centres_px - compute_true_centres_px(scene)).max() < 0.05
