"""Discs and ground under the same light: what it gains where it is so, and that it costs nothing where it is not."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from thermostand.markers.detection import apply_common_light
from thermostand.markers.edge_fit import EdgeFit, fit_edges
from thermostand.markers.noise import Noise
from thermostand.markers.pixels import make_picture

from .renderer import Float, Scene, compute_true_centres_px, make_shaded_light, photograph, render
from .test_edge_fit import rms_mpx, start_from

HALF = Scene(size=(1224, 1024), f_px=4386, psf_px=1.5)
LIGHT_DISCS = dataclasses.replace(HALF, disc_DN=200.0, ground_DN=30.0)
CAMERA = Noise(1 + 1 / 12, 1 / 40)
FRAMES = 4
ALL = np.ones(54, bool)


def scattered() -> Float:
    """A hump of light that adds to discs and ground alike."""
    v, u = np.indices((1024, 1224))
    return 25 * np.exp(-((u - 612) ** 2 + (v - 512) ** 2) / (2 * 100.0**2))


def fits(scene: Scene, clean: Float) -> list[EdgeFit]:
    start = start_from(scene, 0.3)
    return [
        fit_edges(make_picture(photograph(scene, clean, seed)), start, CAMERA, np.tile([0.0, 1.5], (54, 1)))
        for seed in range(FRAMES)
    ]


@pytest.mark.parametrize(
    ("scene", "part"),
    [(HALF, 0.96), (dataclasses.replace(HALF, light=make_shaded_light), 0.96), (LIGHT_DISCS, 1.01)],
    ids=["even", "shaded", "light discs: the slope of a dark ground is known well anyway"],
)
def test_under_common_light_centres_scatter_less_and_their_covariance_says_so(scene: Scene, part: float):
    truth, plain = compute_true_centres_px(scene), fits(scene, render(scene))
    found = [apply_common_light(fit, ALL) for fit in plain]
    before = rms_mpx(np.array([fit.state.centres_px() - truth for fit in plain]))
    after = rms_mpx(np.array([centres - truth for centres, _ in found]))
    claimed = 1e3 * float(np.sqrt(np.mean([np.einsum("nii->ni", covariance) for _, covariance in found])))
    assert after < part * before
    assert 0.9 < claimed / after < 1.1


def test_scattered_light_leaves_the_centres_as_they_were_fitted():
    """Believing in common light there would put them 10 mpx wrong."""
    truth, plain = compute_true_centres_px(HALF), fits(HALF, render(HALF) + scattered())
    before = rms_mpx(np.array([fit.state.centres_px() - truth for fit in plain]))
    after = rms_mpx(np.array([apply_common_light(fit, ALL)[0] - truth for fit in plain]))
    assert after < 1.02 * before


def test_a_marker_with_a_light_of_its_own_and_one_that_is_not_clean_stay_as_they_were_fitted():
    clean = render(HALF)
    x, y = compute_true_centres_px(HALF)[30].astype(int)
    clean[y - 40 : y + 40, x - 40 : x + 40] += np.arange(-40, 40) * 0.4
    fit, clean_ones = fits(HALF, clean)[0], ALL.copy()
    clean_ones[7] = False
    centres, covariance = apply_common_light(fit, clean_ones)
    moved = np.any(centres != fit.state.centres_px(), axis=1)
    assert np.flatnonzero(~moved).tolist() == [7, 30]
    np.testing.assert_array_equal(covariance[[7, 30]], fit.covariance_px2[[7, 30]])


def test_few_markers_tell_nothing_about_the_light():
    fit, few = fits(HALF, render(HALF))[0], np.arange(54) < 19
    np.testing.assert_array_equal(apply_common_light(fit, few)[0], fit.state.centres_px())
