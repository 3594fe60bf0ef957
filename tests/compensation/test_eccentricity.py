"""Discs' centres from ellipses' centres, against the reference renderer's projection."""

import dataclasses
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from thermostand.markers.detection import detect, make_empty_detection
from thermostand.markers.eccentricity import (
    compute_disc_centres,
    compute_disc_centres_px,
    compute_ellipse_centre_offset_px,
)
from thermostand.markers.target import load_target

from .renderer import Scene, compute_true_centres_px, photograph, project, render

PAPER = load_target(Path(__file__).parents[2] / "configs" / "targets" / "paper-9x6.yaml")
TILTED = {
    30: Scene(tilt_y_deg=30, tilt_x_deg=5, roll_deg=20, distance_mm=1040),
    45: Scene(tilt_y_deg=45, distance_mm=1040),
}


@cache
def found_at(tilt_deg):
    return detect(photograph(TILTED[tilt_deg], render(TILTED[tilt_deg]), 1), PAPER)


def middles_px(scene):
    return project(scene, scene.discs_mm()[:, :2])


def rms_mpx(errors_px):
    return 1e3 * np.sqrt(np.mean(np.square(errors_px)))


@pytest.mark.parametrize("tilt_deg", TILTED)
def test_the_homography_gives_the_centres_of_the_discs(tilt_deg):
    scene, found = TILTED[tilt_deg], found_at(tilt_deg)
    assert rms_mpx(found.centres_px - middles_px(scene)) > 30, "without the correction the test would prove nothing"
    assert rms_mpx(compute_disc_centres_px(found, PAPER) - middles_px(scene)) < 3.2


def test_a_lens_that_distorts_leaves_no_more_than_the_noise():
    """Scene J of the bench, whose Cramer-Rao limit is 2.21 mpx; a homography alone leaves 4.3."""
    scene = Scene(k1=-0.15, k2=0.1, tilt_y_deg=20)
    found = detect(photograph(scene, render(scene), 1), PAPER)
    assert rms_mpx(compute_disc_centres_px(found, PAPER) - middles_px(scene)) < 1.2 * 2.21


def test_without_noise_the_correction_is_exact_and_missing_markers_stay_missing():
    scene, seen = TILTED[30], found_at(30)
    centres_px = compute_true_centres_px(scene)
    centres_px[7] = np.nan
    corrected = compute_disc_centres_px(dataclasses.replace(seen, centres_px=centres_px), PAPER)
    assert np.isnan(corrected[7]).all()
    assert rms_mpx(np.delete(corrected - middles_px(scene), 7, axis=0)) < 0.02


@pytest.mark.parametrize(
    "scene", [*TILTED.values(), Scene(k1=-0.15, k2=0.1, tilt_y_deg=20, f_px=3000, distance_mm=350)]
)
def test_the_camera_gives_the_offset_of_each_ellipse_with_distortion_too(scene):
    offset_px = compute_ellipse_centre_offset_px(lambda points_mm: project(scene, points_mm), PAPER)
    assert rms_mpx(offset_px) > 10
    np.testing.assert_allclose(offset_px, compute_true_centres_px(scene) - middles_px(scene), atol=2e-5)


def test_the_discs_centres_are_as_uncertain_as_the_outlines():
    scene, rng = TILTED[45], np.random.default_rng(5)
    centres_px = compute_true_centres_px(scene)
    centres_px[7] = np.nan
    seen = dataclasses.replace(make_empty_detection(PAPER), centres_px=centres_px)
    noise_px = rng.normal(scale=0.02, size=(120, len(centres_px), 2))  # above that of a camera
    draws_px = np.array(
        [compute_disc_centres(dataclasses.replace(seen, centres_px=centres_px + each), PAPER)[0] for each in noise_px]
    )
    own_px = draws_px - noise_px
    known = np.arange(len(centres_px)) != 7
    added_px2 = draws_px.var(axis=0) - noise_px.var(axis=0)
    assert np.abs(added_px2[known]).max() < 0.01 * 0.02**2
    assert own_px[:, known].std(axis=0).max() < 0.1 * 0.02
    assert np.isnan(draws_px[:, 7]).all()


def test_an_image_without_the_target_has_no_discs_either():
    centres_px, covariance_px2 = compute_disc_centres(make_empty_detection(PAPER), PAPER)
    assert np.isnan(centres_px).all()
    assert np.isnan(covariance_px2).all()
    assert (centres_px.shape, covariance_px2.shape) == ((54, 2), (54, 2, 2))
