"""The edge fit against rendered truth: bias, scatter against the Cramer-Rao limit, honesty of the covariance."""

from __future__ import annotations

import math
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.special import ndtr

from tests.nightly import mark_nightly
from thermostand.markers import edge_fit
from thermostand.markers.detection import detect
from thermostand.markers.edge_fit import EdgeFit, Flag, fit_edges
from thermostand.markers.edge_model import (
    B0,
    BX,
    BY,
    CX,
    CY,
    F0,
    FX,
    FY,
    M11,
    M12,
    M22,
    SIGMA,
    EdgeState,
    Float,
    Work,
    build_normal_equations,
    evaluate_normal_distribution,
)
from thermostand.markers.noise import Noise
from thermostand.markers.pixels import (
    CORE,
    DISC,
    GROUND,
    SHARE,
    VALUE,
    Limits,
    Pixels,
    U,
    V,
    allocate_pixels,
    gather,
    make_picture,
)
from thermostand.markers.target import Target

from .renderer import Scene, compute_true_centres_px, make_shaded_light, photograph, project, render

SCENES = {
    "A even light": (Scene(), 2.21),
    "B sharp": (Scene(psf_px=0.8), 1.97),
    "D shaded": (Scene(light=make_shaded_light), 2.21),
    "E tilt 30": (Scene(tilt_y_deg=30, tilt_x_deg=5, roll_deg=20, distance_mm=1040), 2.47),
    "F tilt 45": (Scene(tilt_y_deg=45, distance_mm=1040), 2.76),
}
"""Scene and Cramer-Rao limit in mpx with two planes (12 parameters), of the same geometry."""


@cache
def clean(name: str) -> Float:
    return render(SCENES[name][0])


def start_from(scene: Scene, offset_px: float) -> EdgeState:
    """Rough ellipses: centres off by `offset_px`, blur 1.2, levels unknown."""
    centres = compute_true_centres_px(scene)
    angle = np.arange(64) * (2 * np.pi / 64)
    circle = np.column_stack([np.cos(angle), np.sin(angle)])
    parameters, scale = np.full((len(centres), 12), np.nan), np.empty(len(centres))
    for n, disc in enumerate(scene.discs_mm()):
        outline = project(scene, disc[:2] + disc[2] / 2 * circle) - centres[n]
        shape = np.linalg.inv(outline.T @ outline / 32)
        scale[n] = np.linalg.det(shape) ** -0.25
        shape *= scale[n] ** 2
        parameters[n, [M11, M12, M22]] = shape[0, 0], shape[0, 1], shape[1, 1]
    parameters[:, [CX, CY]] = centres + offset_px
    parameters[:, SIGMA] = 1.2
    return EdgeState(parameters, scale)


def fit(scene: Scene, image: np.ndarray, start: EdgeState, noise: Noise | None = None) -> EdgeFit:
    camera = Noise(scene.read_DN**2 + 1 / 12, 1 / scene.electrons_per_DN)
    return fit_edges(make_picture(image), start, noise or camera, np.tile([0.0, 2.3], (len(start.scale_px), 1)))


def rms_mpx(errors_px: Float) -> float:
    return 1e3 * float(np.sqrt(np.mean(np.square(errors_px))))


def test_the_normal_distribution_and_its_density_are_right_to_2e_7():
    for t in np.linspace(-7, 7, 2001):
        step, density = evaluate_normal_distribution(t)
        assert step == pytest.approx(0.5 * math.erfc(-t / math.sqrt(2)), abs=2e-7)
        assert density == pytest.approx(math.exp(-t * t / 2) / math.sqrt(2 * math.pi), abs=2e-7)


def test_one_machine_code_fits_whatever_memory_the_reach_lies_in():
    """Another one would be compiled first, for a quarter of a minute."""
    scene = Scene(columns=3, rows=3, size=(300, 300))
    start, image = start_from(scene, 0.3), make_picture(np.zeros((300, 300), np.uint8))
    reach = np.tile([0.0, 2.3], (9, 1))
    fit_edges(image, start, Noise(1.0, 0.1), reach)
    reach.flags.writeable = False
    fit_edges(image, start, Noise(1.0, 0.1), reach)
    fit_edges(image, start, Noise(1.0, 0.1), np.tile([0, 2], (9, 1)))
    assert len(edge_fit._fit_all.signatures) == 1


def test_the_reference_renderer_puts_the_centroid_where_the_truth_says():
    scene = Scene(columns=3, rows=3, size=(900, 900), tilt_y_deg=30, roll_deg=10)
    light = scene.ground_DN - render(scene)
    for x, y in compute_true_centres_px(scene):
        rows, columns = np.mgrid[round(y) - 60 : round(y) + 61, round(x) - 60 : round(x) + 61]
        weight = light[rows, columns]
        found = np.array([(weight * columns).sum(), (weight * rows).sum()]) / weight.sum()
        np.testing.assert_allclose(found, [x, y], atol=1e-4)


def test_the_normal_equations_are_those_of_the_model():
    """J'We and J'WJ against numerical derivatives of the model; the terms left out are below 2 and 7 %."""
    truth = np.array([20.3, 19.8, 1.1, 0.08, 0.9, 1.1, 200, 3, -2, 30, 1, 1])
    away = truth + np.array([0.02, -0.03, 0.002, 0.001, -0.002, 0.02, 0.5, 0.1, 0.1, -0.3, 0.1, -0.1])
    pixels = allocate_pixels(41 * 41)
    image, limits = np.zeros((41, 41), np.uint8), Limits(0.0, 0.5, 1.5, 1.6)
    gather(make_picture(image), away[:5], 12.0, limits, 255, pixels)
    values = [pixels.table[region, :, : pixels.counts[region]] for region in range(3)]
    for part in values:
        part[VALUE] = model(truth, in_image(part, pixels))
    normal, right = np.empty((12, 12)), np.empty(12)
    squares, weights = build_normal_equations(pixels, away, 12.0, (1.0, 0.0), Work(normal, right), False)
    seen = in_image(np.concatenate(values, axis=1), pixels)
    residual = seen[VALUE] - model(away, seen)
    steps = 1e-5 * np.eye(12)
    slopes = np.array([(model(away + step, seen) - model(away - step, seen)) / 2e-5 for step in steps])
    size = np.linalg.norm(slopes, axis=1)
    assert weights == seen.shape[1]
    assert squares == pytest.approx(np.sum(residual**2), rel=1e-3)
    np.testing.assert_allclose(right / size, slopes @ residual / size, atol=0.02 * float(np.linalg.norm(residual)))
    np.testing.assert_allclose(normal / np.outer(size, size), slopes @ slopes.T / np.outer(size, size), atol=0.07)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("centre", [(20.3, 19.8), (3.0, 38.6), (39.2, 38.6)])
def test_pixels_are_gathered_by_where_they_lie_round_the_outline(
    centre: tuple[float, float], dtype: type[np.uint8] | type[np.uint16]
):
    """Each once, in the region that its F says, also where the image cuts them off."""
    shape, scale, limits = np.array([1.1, 0.08, 0.9]), 9.0, Limits(0.4, 0.7, 1.3, 1.7)
    pixels = allocate_pixels(41 * 41)
    image = np.random.default_rng(1).integers(0, np.iinfo(dtype).max, (41, 41), dtype)
    gathered = gather(make_picture(image), np.array([*centre, *shape]), scale, limits, np.iinfo(dtype).max, pixels)
    v, u = np.mgrid[:41, :41]
    x, y = (u - centre[0]) / scale, (v - centre[1]) / scale
    F = np.sqrt(shape[0] * x * x + 2 * shape[1] * x * y + shape[2] * y * y)
    region = np.select([F <= 0.4, F <= 0.7, F <= 1.3, F <= 1.7], [-1, DISC, CORE, GROUND], -1)
    for which in (CORE, GROUND, DISC):
        found = in_image(pixels.table[which, :, : pixels.counts[which]], pixels).astype(int)
        np.testing.assert_array_equal(found[VALUE], image[found[V], found[U]])
        assert sorted(zip(found[U], found[V], strict=True)) == sorted(
            zip(u[region == which], v[region == which], strict=True)
        )
    assert gathered.seen == np.count_nonzero(region >= 0)
    assert gathered.cut == (abs(centre[0] - 20) > 10)


def in_image(part: NDArray[np.float32], pixels: Pixels) -> Float:
    """Places in the image, and values."""
    whole = part[:SHARE].astype(np.float64)
    whole[[U, V]] += pixels.origin[:, None]
    return whole


def model(p: Float, pixels: Float) -> Float:
    """The model of the module, R = 12 px, written out again."""
    x, y = (pixels[U] - p[CX]) / 12, (pixels[V] - p[CY]) / 12
    gx, gy = p[M11] * x + p[M12] * y, p[M12] * x + p[M22] * y
    F, length = np.sqrt(gx * x + gy * y), np.hypot(gx, gy)
    t = (F - 1) * F / length * 12 / p[SIGMA]
    b, f = (p[i] + p[i + 1] * x + p[i + 2] * y for i in (B0, F0))
    lean = ((p[BX] - p[FX]) * gx + (p[BY] - p[FY]) * gy) / length * p[SIGMA] / 12
    return f + (b - f) * ndtr(t) + lean * np.exp(-t * t / 2) / math.sqrt(2 * math.pi)


@pytest.mark.parametrize("name", SCENES)
def test_a_noise_free_image_gives_the_true_centre_within_a_tenth_of_a_mpx(name: str):
    scene = SCENES[name][0]
    fine = np.round(clean(name) * 200).astype(np.uint16)
    result = fit(scene, fine, start_from(scene, 1.0), Noise(1.0, 1 / 40))
    assert not result.flags.any()
    assert rms_mpx(result.state.centres_px() - compute_true_centres_px(scene)) < 0.1


@pytest.mark.parametrize(
    "name", ["A even light", "F tilt 45", *map(mark_nightly, ["B sharp", "D shaded", "E tilt 30"])]
)
def test_noisy_frames_scatter_at_the_physical_limit_and_the_covariance_says_so(name: str):
    scene, limit_mpx = SCENES[name]
    truth, state = compute_true_centres_px(scene), start_from(scene, 1.0)
    errors: list[Float] = []
    variances: list[Float] = []
    for seed in range(4):
        result = fit(scene, photograph(scene, clean(name), seed), state)
        assert not result.flags.any()
        assert np.all(np.abs(result.chi - 1) < 0.1)
        state = result.state
        errors.append(result.state.centres_px() - truth)
        variances.append(np.einsum("nii->ni", result.covariance_px2))
    actual, predicted = rms_mpx(np.array(errors)), 1e3 * float(np.sqrt(np.mean(variances)))
    assert actual < 1.15 * limit_mpx
    assert 0.9 < predicted / actual < 1.1


def test_dots_of_seven_to_ten_pixels_keep_their_centre_and_an_honest_covariance():
    scene = Scene(size=(640, 480), f_px=1000, roll_deg=7, tilt_y_deg=20, psf_px=0.7)
    truth, image = compute_true_centres_px(scene), render(scene)
    start = start_from(scene, 0.3)
    assert 3.3 < start.radii_px().min() < start.radii_px().max() < 5
    fine = fit(scene, np.round(image * 200).astype(np.uint16), start, Noise(1.0, 1 / 40))
    assert rms_mpx(fine.state.centres_px() - truth) < 0.5
    results = [fit(scene, photograph(scene, image, seed), start) for seed in range(6)]
    actual = rms_mpx(np.array([result.state.centres_px() - truth for result in results]))
    predicted = 1e3 * np.sqrt(np.mean([np.einsum("nii->ni", result.covariance_px2) for result in results]))
    assert actual < 8
    assert 0.85 < predicted / actual < 1.15


def test_a_defocused_image_is_gathered_again_in_a_wider_band():
    scene = Scene(columns=3, rows=3, size=(800, 800), psf_px=3.0)
    truth = compute_true_centres_px(scene)
    result = fit(scene, photograph(scene, render(scene), 1), start_from(scene, 1.0))
    assert not result.flags.any()
    np.testing.assert_allclose(result.state.parameters[:, SIGMA], math.hypot(3, 1 / math.sqrt(12)), rtol=0.02)
    assert rms_mpx(result.state.centres_px() - truth) < 1.25 * 4.38


def test_plain_ground_diverges_and_says_so_while_the_others_are_measured():
    scene = Scene(columns=3, rows=3, size=(800, 800), missing=(5,))
    result = fit(scene, photograph(scene, render(scene), 3), start_from(scene, 0.5))
    assert result.flags[4] == Flag.DIVERGED
    assert np.isnan(result.chi[4])
    assert not np.delete(result.flags, 4).any()


@pytest.mark.parametrize("from_above", [False, True], ids=["8 bits", "8 upper bits of 16"])
def test_an_overexposed_ground_is_flagged_and_does_not_shift_the_centres(from_above: bool):
    scene = Scene(columns=3, rows=3, size=(800, 800), ground_DN=300)
    image, noise = photograph(scene, render(scene), 3), Noise(1 + 1 / 12, 1 / 40)
    if from_above:
        image, noise = image.astype(np.uint16) << 8, Noise(noise.floor_DN2 * 256**2, noise.slope_DN * 256)
    result = fit(scene, image, start_from(scene, 0.5), noise)
    assert np.all(result.flags == Flag.SATURATED)
    assert rms_mpx(result.state.centres_px() - compute_true_centres_px(scene)) < 5


def test_the_fit_reads_its_inputs_only():
    scene = Scene(columns=3, rows=3, size=(800, 800))
    image, start = photograph(scene, render(scene), 3), start_from(scene, 0.5)
    before, parameters = image.copy(), start.parameters.copy()
    image.setflags(write=False)
    fit(scene, image, start)
    np.testing.assert_array_equal(image, before)
    np.testing.assert_array_equal(start.parameters, parameters)


@pytest.mark.parametrize("tail", [0.1, 0.3])
def test_a_blur_with_one_side_moves_all_outlines_towards_it_without_a_flag(tail: float):
    """Of an exponential tail to the right, whose centre of gravity is known."""
    scene = Scene(size=(640, 480), f_px=2000, diameter_mm=10)
    target = Target(name="coma", columns=9, rows=6, pitch_mm=30, diameter_mm=10)
    clean = render(scene)
    kernel = np.zeros(13)
    kernel[6:] = tail * np.exp(-np.arange(7) / 0.7)
    kernel[6] = 1 - kernel[7:].sum()
    centre_px = float(kernel @ (np.arange(13) - 6))
    rows = np.pad(clean, ((0, 0), (6, 6)), "edge")
    blurred = np.stack([np.convolve(row, kernel, "valid") for row in rows])
    before, after = (detect(photograph(scene, image, seed), target) for seed, image in ((1, clean), (2, blurred)))
    moved = after.centres_px - before.centres_px
    assert not after.flags.any()
    assert moved.mean(axis=0) == pytest.approx([0.82 * centre_px, 0.0], abs=0.004)
    assert moved.std(axis=0) == pytest.approx([0.0, 0.0], abs=0.009)
