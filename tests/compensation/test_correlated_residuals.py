"""The covariance of centres in pictures whose residuals hang together: chi^2 of the true errors is near 1."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

from tests.nightly import mark_nightly
from thermostand.markers.detection import NARROW_SIGMA, WIDE_SIGMA, Detection, detect
from thermostand.markers.sandwich import compute_variance_growth, compute_variance_ratio

from .degraded_images import (
    Picture,
    make_jpeg_picture,
    make_motion_blur_picture,
    photograph_flickering_rows,
    photograph_grained_paper,
    photograph_unequal_pixels,
    photograph_with_gamma,
    photograph_with_noise,
)
from .renderer import Float, compute_true_centres_px, render
from .test_markers import HALF, PAPER

SCENE = replace(HALF, roll_deg=7, tilt_y_deg=10, distance_mm=1100)
FRAMES = 4


@cache
def clean() -> Float:
    return render(SCENE)


def errors_px(picture: Picture) -> tuple[Float, Float, list[Detection]]:
    """Errors and claimed variances (K, 2) of the unflagged markers of a few frames."""
    found = [detect(picture(SCENE, clean(), seed), PAPER) for seed in range(FRAMES)]
    clear = np.array([one.flags == 0 for one in found])
    assert clear.mean() > 0.85
    errors = np.array([one.centres_px for one in found]) - compute_true_centres_px(SCENE)
    variances = np.array([np.diagonal(one.covariance_px2, axis1=1, axis2=2) for one in found])
    return errors[clear], variances[clear], found


@pytest.mark.parametrize(
    "picture",
    [
        photograph_with_noise,
        mark_nightly(make_jpeg_picture(95)),
        make_jpeg_picture(90),
        mark_nightly(make_jpeg_picture(80)),
        mark_nightly(make_motion_blur_picture(2)),
        make_motion_blur_picture(4),
        mark_nightly(make_motion_blur_picture(8)),
        photograph_unequal_pixels,
        photograph_with_gamma,
    ],
    ids=[
        *("noise alone", "JPEG 95", "JPEG 90", "JPEG 80", "blurred 2 px", "blurred 4 px", "blurred 8 px"),
        *("unequal pixels", "gamma 2.2"),
    ],
)
def test_the_claimed_variance_is_that_of_the_errors(picture: Picture):
    """The chi^2 of 432 coordinates scatters by 7 %."""
    errors, variances, _ = errors_px(picture)
    assert 0.8 < np.mean(errors**2 / variances) < 1.25


def test_rows_that_flicker_make_y_uncertain_and_leave_x_as_it_is():
    """The nine markers of a row share its flicker: 24 numbers scatter by 29 %."""
    errors, variances, _ = errors_px(photograph_flickering_rows)
    x, y = np.mean(errors**2 / variances, axis=0)
    assert 0.8 < x < 1.25
    assert 0.8 < y < 1.6
    assert np.mean(variances[:, 1]) > 5 * np.mean(variances[:, 0])


def test_independent_noise_is_fitted_in_a_wide_band_and_keeps_its_covariance():
    _, _, found = errors_px(photograph_with_noise)
    for detection in found:
        assert detection.band_sigma == WIDE_SIGMA
        assert detection.growth == pytest.approx(1, abs=0.25)


def test_grained_ground_is_fitted_in_a_narrow_band_where_that_is_better_and_frames_after_it_too():
    errors, variances, found = errors_px(photograph_grained_paper)
    assert {detection.band_sigma for detection in found} == {NARROW_SIGMA}
    assert 0.8 < np.mean(errors**2 / variances) < 1.25
    wide = [
        detect(photograph_grained_paper(SCENE, clean(), seed), PAPER, replace(one, band_sigma=WIDE_SIGMA))
        for seed, one in enumerate(found)
    ]
    clear = np.array([(one.flags | other.flags) == 0 for one, other in zip(found, wide, strict=True)])
    off = [np.array([one.centres_px for one in group]) - compute_true_centres_px(SCENE) for group in (found, wide)]
    assert np.std(off[0][clear]) < 0.7 * np.std(off[1][clear])
    after = detect(photograph_grained_paper(SCENE, clean(), 9), PAPER, found[0])
    assert after.band_sigma == NARROW_SIGMA
    assert after.excess_px2.tolist() == found[0].excess_px2.tolist()


def test_a_picture_that_noise_does_not_describe_is_suspect_and_one_with_noise_alone_is_not():
    _, _, grained = errors_px(photograph_grained_paper)
    _, _, noisy = errors_px(photograph_with_noise)
    assert all(one.is_suspect for one in grained)
    assert not any(one.is_suspect for one in noisy)
    assert detect(photograph_grained_paper(SCENE, clean(), 9), PAPER, grained[0]).is_suspect


def test_all_markers_decide_where_a_sample_of_them_is_conspicuous_by_chance():
    """Frames of noise alone whose 27 sampled markers have 1.3 times their variances; JPEG of quality 90 has as much."""
    for seed in (22, 36):
        assert not detect(photograph_with_noise(SCENE, clean(), seed), PAPER).is_suspect
    _, _, compressed = errors_px(make_jpeg_picture(90))
    assert all(one.is_suspect for one in compressed)


def growth(scatter: Float, clean_markers: NDArray[np.bool_]) -> Float:
    return compute_variance_growth(*compute_variance_ratio(scatter, clean_markers))


def test_growth_within_its_chance_is_none_and_beyond_it_is_kept():
    rng = np.random.default_rng(1)
    independent = np.full((200, 2), 7.0)
    robust = 7.0 * rng.chisquare(8, (200, 2)) / 8
    clean_markers = np.ones(200, bool)
    scatter = np.stack([robust, independent], axis=1)
    assert growth(scatter, clean_markers) == pytest.approx(1, abs=0.1)
    scatter[:, 0, 1] *= 4
    assert growth(scatter, clean_markers) == pytest.approx([1, 4], abs=0.25)
    scatter[50:] = np.nan
    assert growth(scatter, clean_markers)[1] == pytest.approx(4, abs=0.6)
    assert growth(scatter[:7], clean_markers[:7]).tolist() == [1, 1]
