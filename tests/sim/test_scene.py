"""The renderer against exact geometry, and its noise against the sensor's statistics."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
import pytest
from numpy.typing import NDArray

from thermostand.drivers.sim.physics.optics import (
    Nodes,
    Optics,
    StandPlacement,
    compute_optics_at,
    compute_true_centres_px,
)
from thermostand.drivers.sim.physics.scene import (
    SceneSpec,
    SimulatedScene,
    compute_disc_coverages,
    compute_polygon_coverage,
    make_still,
)

TIME_ns = 1_700_000_000_000_000_000
FLAT = SceneSpec(light_slope=(0.0, 0.0), vignetting=0.0)
ROWS = 700  # with markers in them
SCENE = SimulatedScene(FLAT, seed=1)
COLD = Nodes(24.0, 24.0, 24.0, 24.0, 24.0, 24.0)


def at(linear_mm: float = 0.0, rotary_deg: float = 0.0, roll_deg: float = 0.0) -> Optics:
    return compute_optics_at("modified", COLD, StandPlacement(linear_mm, rotary_deg, camera_roll_deg=roll_deg))


def centroid(weights: NDArray[np.floating]) -> tuple[float, float]:
    rows, columns = np.indices(weights.shape)
    total = float(weights.sum(dtype=np.float64))
    return float((columns * weights).sum(dtype=np.float64)) / total, float(
        (rows * weights).sum(dtype=np.float64)
    ) / total


@pytest.mark.parametrize(
    "optics", [at(), at(25, 8), at(-60, -20), at(140, 30), at(70, 22, 20)], ids=["V0", "V1", "V2", "far", "rolled"]
)
def test_rendered_centroids_are_the_true_centres_within_2e_5_px(optics: Optics):
    for (left, top, coverage), (x, y) in zip(
        compute_disc_coverages(optics, 1.0), compute_true_centres_px(optics), strict=True
    ):
        found_x, found_y = centroid(coverage)
        assert (left + found_x, top + found_y) == pytest.approx((x, y), abs=2e-5)


def test_coverage_has_the_discs_area_and_the_edge_spread_of_its_blur():
    optics = at()
    _, _, coverage = compute_disc_coverages(optics, 1.0)[22]  # in the centre: no distortion
    scale_px_per_mm = optics.f_px / optics.target_centre_mm[2]
    assert coverage.sum(dtype=np.float64) == pytest.approx(math.pi * (4.0 * scale_px_per_mm) ** 2, rel=2e-3)
    assert coverage.max() == pytest.approx(1.0, abs=1e-5)
    # second moment of a blurred disc: R^2/4 + blur^2 + pixel box
    columns = np.arange(coverage.shape[1])
    profile = coverage.sum(axis=0, dtype=np.float64) / coverage.sum(dtype=np.float64)
    variance = profile @ columns**2 - (profile @ columns) ** 2
    radius_squared = coverage.sum(dtype=np.float64) / math.pi
    assert variance == pytest.approx(radius_squared / 4 + 1.0 + 1 / 12, rel=2e-4)


def test_polygon_coverage_is_exact_for_a_square_between_cells():
    corners = np.array([[1.25, 1.5], [3.25, 1.5], [3.25, 2.75], [1.25, 2.75]])
    area = compute_polygon_coverage(np.array(list(_short_edges(corners))), width=5, height=4)
    expected = np.outer([0, 0.5, 0.75, 0], [0, 0.75, 1.0, 0.25, 0])
    assert area == pytest.approx(expected, abs=1e-12)


def _short_edges(corners: NDArray[np.float64]) -> Iterator[NDArray[np.float64]]:
    for here, after in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        yield from (here + (after - here) * part / 8 for part in range(8))


def test_the_noise_free_image_has_the_specified_levels():
    image = SCENE.noise_free(at(), 0.1, 0.0, 1.0)
    x, y = np.round(compute_true_centres_px(at())[22]).astype(int)
    assert image[5, 5] == pytest.approx(200.0, abs=1e-3)
    assert image[y, x] == pytest.approx(30.0, abs=1e-3)
    assert image.shape == (2048, 2448)


def test_signal_follows_exposure_and_gain_but_the_black_level_does_not():
    assert SCENE.noise_free(at(), 0.05, 0.0, 1.0)[0, 0] == pytest.approx(3.0 + 197.0 / 2)
    assert SCENE.noise_free(at(), 0.05, 20.0 * math.log10(2.0), 1.0)[0, 0] == pytest.approx(200.0)


def test_light_is_uneven_and_smooth():
    image = SimulatedScene(SceneSpec(), seed=1).noise_free(at(), 0.1, 0.0, 1.0)
    assert image[1023, 1223] == pytest.approx(200.0, abs=0.1)
    assert image[1023, 2447] > image[1023, 0] + 10.0
    assert image[0, 0] < 190.0
    assert np.abs(np.diff(image[3])).max() < 0.05


def test_noise_has_the_variance_of_shot_and_read_noise_and_no_mean():
    scene = SimulatedScene(FLAT, seed=4)
    first = scene.render(at(), TIME_ns, 0.1, 0.0, 1.0, 200).astype(float)
    second = scene.render(at(), TIME_ns + 1, 0.1, 0.0, 1.0, 200).astype(float)
    variance = 1.0 + 197.0 / 40.0 + 1.0 / 12.0
    assert first.mean() == pytest.approx(200.0, abs=0.02)
    assert first.var() == pytest.approx(variance, rel=0.01)
    assert (first - second).var() / 2.0 == pytest.approx(variance, rel=0.01)


def test_noise_is_white():
    noise = SimulatedScene(FLAT, seed=4).render(at(), TIME_ns, 0.1, 0.0, 1.0, 256).astype(float) - 200.0
    variance = noise.var()
    for shifted, kept in ((noise[1:], noise[:-1]), (noise[:, 1:], noise[:, :-1]), (noise[64:], noise[:-64])):
        assert abs(np.mean(shifted * kept)) / variance < 0.006  # 4 sigma of 600 000 pixels
    assert noise.mean(axis=0).std() == pytest.approx(math.sqrt(variance / 256), rel=0.1)
    assert noise.mean(axis=1).std() == pytest.approx(math.sqrt(variance / 2448), rel=0.2)


def test_a_frame_depends_on_seed_and_time_only():
    scene = SimulatedScene(SceneSpec(), seed=7)
    frame = scene.render(at(), TIME_ns, 0.1, 0.0, 1.0, ROWS)
    other = scene.render(at(), TIME_ns + 500_000_000, 0.1, 0.0, 1.0, ROWS)
    assert (frame != other).mean() > 0.5
    assert (SimulatedScene(SceneSpec(), seed=7).render(at(), TIME_ns, 0.1, 0.0, 1.0, ROWS) == frame).all()
    assert (scene.render(at(), TIME_ns, 0.1, 0.0, 1.0, ROWS) == frame).all()
    assert (SimulatedScene(SceneSpec(), seed=8).render(at(), TIME_ns, 0.1, 0.0, 1.0, ROWS) != frame).mean() > 0.5


@pytest.fixture(scope="module")
def whole() -> NDArray[np.uint8]:
    """A whole frame; not to be changed."""
    return SimulatedScene(SceneSpec(), seed=7).render(at(), TIME_ns, 0.1, 0.0, 0.9)


@pytest.mark.parametrize("rows", [2, 700, 2047])
def test_the_upper_rows_alone_are_those_of_the_whole_frame(rows: int, whole: NDArray[np.uint8]):
    assert (SimulatedScene(SceneSpec(), seed=7).render(at(), TIME_ns, 0.1, 0.0, 0.9, rows) == whole[:rows]).all()


def test_an_overexposed_frame_clips_at_255():
    frame = SCENE.render(at(), TIME_ns, 0.2, 0.0, 1.0)
    assert frame[:50].min() == 255
    x, y = np.round(compute_true_centres_px(at())[22]).astype(int)
    assert frame[y, x] < 80


def test_a_shut_flap_gives_a_dark_frame():
    frame = SimulatedScene(SceneSpec(), seed=1).render(at(), TIME_ns, 0.1, 0.0, 0.0)
    assert frame.dtype == np.uint8
    assert frame.mean() == pytest.approx(3.0, abs=0.05)
    assert frame.max() < 12


def test_a_half_open_flap_shades_linearly_from_the_top():
    rows = SCENE.noise_free(at(), 0.1, 0.0, 0.475)[:, 0] - 3.0
    assert rows[0] == pytest.approx(197.0)
    assert rows[-1] == pytest.approx(0.0, abs=0.2)
    assert np.diff(rows) == pytest.approx(np.diff(rows).mean(), rel=0.01)


def test_markers_cut_by_the_border_are_drawn_as_far_as_they_reach():
    optics = at(linear_mm=-140.0)
    image = SCENE.noise_free(optics, 0.1, 0.0, 1.0)
    centres = compute_true_centres_px(optics)
    assert (centres[:, 0] < 0.0).any()
    edge = centres[(centres[:, 0] > -20.0) & (centres[:, 0] < 20.0)]
    assert len(edge) > 0
    assert all(image[round(y), 0] < 40.0 for _, y in edge)


def test_a_target_out_of_sight_leaves_the_paper_white():
    optics = compute_optics_at("modified", COLD, StandPlacement(target_offset_mm=(2000.0, 0.0)))
    assert SCENE.noise_free(optics, 0.1, 0.0, 1.0).min() == pytest.approx(200.0, abs=1e-3)


def test_a_still_scene_renders_once_until_another_exposure_is_asked_for():
    asked: list[float] = []

    def render(
        optics: Optics, time_ns: int, exposure_s: float, gain_dB: float, flap_open: float, rows: int
    ) -> NDArray[np.uint8]:
        asked.append(exposure_s)
        return np.full((rows, 1), len(asked), dtype=np.uint8)

    shown, optics = make_still(render), at()
    pictures = [
        int(shown(optics, TIME_ns + n, exposure_s, 0.0, 1.0, 2)[0, 0])
        for n, exposure_s in enumerate((0.1, 0.1, 0.2, 0.2, 0.1))
    ]
    assert (pictures, len(asked)) == ([1, 1, 2, 2, 3], 3)
