"""The camera's noise from its images, against the noise they were made with."""

import dataclasses

import numpy as np
import pytest

from tests.nightly import mark_nightly
from thermostand.markers.noise import _sort_indices, estimate_noise, find_full_scale_DN

from .renderer import Scene, make_shaded_light, photograph, render

SCENE = Scene(columns=5, rows=4, size=(1000, 800), ground_DN=150, light=make_shaded_light)


@pytest.mark.parametrize(
    ("read_DN", "electrons_per_DN"), [(1.0, 40.0), mark_nightly(3.0, 100.0), mark_nightly(0.7, 10.0)]
)
def test_read_noise_and_shot_noise_are_found_while_the_target_drifts(read_DN, electrons_per_DN):
    scenes = [
        dataclasses.replace(SCENE, shift_mm=(0.03 * k, 0), read_DN=read_DN, electrons_per_DN=electrons_per_DN)
        for k in range(3)
    ]
    noise = estimate_noise([photograph(scene, render(scene), seed) for seed, scene in enumerate(scenes)])
    for signal_DN in (30.0, 150.0):
        expected = read_DN**2 + 1 / 12 + signal_DN / electrons_per_DN
        assert noise.variance_DN2(np.array(signal_DN)) == pytest.approx(expected, rel=0.04)


@pytest.mark.parametrize("values", [np.arange(12_500) / 50, np.arange(200_000) / 50, np.array([0.01, 0.013, 255.0])])
def test_means_are_put_in_the_order_of_a_stable_sort(values):
    """Of 8 bit, of 12 bit, and such as no mean of whole pixels is."""
    signal = np.random.default_rng(1).choice(values, 5000).astype(np.float32)
    assert np.array_equal(_sort_indices(signal), np.argsort(signal, kind="stable"))


def test_light_that_changed_between_the_images_does_not_count_as_noise():
    clean = render(SCENE)
    steady = estimate_noise([photograph(SCENE, clean, seed) for seed in (1, 2)])
    changed = estimate_noise([photograph(SCENE, clean, 1), photograph(SCENE, 0.97 * clean, 2)])
    level = np.array([30.0, 150.0])
    np.testing.assert_allclose(changed.variance_DN2(level), steady.variance_DN2(level), rtol=0.05)


def test_only_the_parts_that_were_recorded_are_looked_at():
    images = [photograph(SCENE, render(SCENE), seed) for seed in (1, 2)]
    whole = estimate_noise(images)
    for image in images:
        image[:, 500:] = 77
    partial = estimate_noise(images, np.array([[0, 0, 500, 800]], np.int32))
    level = np.array([30.0, 150.0])
    np.testing.assert_allclose(partial.variance_DN2(level), whole.variance_DN2(level), rtol=0.08)


def test_one_image_tells_nothing_and_neither_do_two_of_different_size():
    image = np.full((100, 100), 50, np.uint8)
    assert estimate_noise([]) is None
    assert estimate_noise([image]) is None
    assert estimate_noise([image, image[:50]]) is None


@pytest.mark.parametrize(
    ("brightest", "full_scale"), [(90, 255), (700, 1023), (1800, 4095), (4095, 4095), (60000, 65535)]
)
def test_the_full_scale_of_16_bits_is_that_of_a_camera(brightest, full_scale):
    assert find_full_scale_DN(np.array([[1, brightest]], np.uint16)) == full_scale
    assert find_full_scale_DN(np.array([[90]], np.uint8)) == 255


@pytest.mark.parametrize(("depth", "full_scale"), [(12, 65520), (10, 65472)])
def test_a_camera_that_fills_16_bits_from_above_is_recognised_by_the_bits_it_leaves_empty(depth, full_scale):
    values = np.arange(1 << depth, dtype=np.uint16)[::7, None] << (16 - depth)
    assert find_full_scale_DN(values) == full_scale
