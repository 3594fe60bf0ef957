"""Images moved by a drift: as exact as a spline is, also near the border, and no marker goes astray."""

import numpy as np
import pytest
from scipy import ndimage

from tests.compensation.renderer import Scene, render
from tests.nightly import mark_nightly
from thermostand.compensation.apply.image_correction import warp
from thermostand.compensation.drift_runtime import LATTICE_PX, source_offset
from thermostand.markers.detection import detect
from thermostand.markers.target import load_target
from thermostand.stand.config.stand_config import find_packaged

SMALL = (200, 160)


def drift(xy_px):
    """As a camera's: half a pixel, a little larger at one side, bent."""
    x, y = (xy_px[:, 0] - 1223.5) / 1224, (xy_px[:, 1] - 1023.5) / 1224
    return np.stack([0.42 + 0.05 * x - 0.03 * x * y, -0.55 + 0.06 * y + 0.02 * y * y], axis=1)


def across_zero(xy_px):
    """Changes its sign, and so the whole pixel that is read, every few pixels."""
    return np.stack([1.6 * np.sin(xy_px[:, 0] / 60), 1.3 * np.cos(xy_px[:, 1] / 45)], axis=1)


def noise(shape, dtype=np.uint8):
    return np.random.default_rng(5).integers(0, np.iinfo(dtype).max, shape, endpoint=True).astype(dtype)


def scene(x, y):
    """Blobs of a blur of 0.8 px and more, as a lens makes them, on a ground of 20: any place has its exact value."""
    rng = np.random.default_rng(3)
    total = np.full(x.shape, 20.0)
    for _ in range(150):
        at_x, at_y, blur = rng.uniform(-10, 220), rng.uniform(-10, 160), rng.uniform(0.8, 4)
        total += rng.uniform(5, 40) * np.exp(-((x - at_x) ** 2 + (y - at_y) ** 2) / (2 * blur**2))
    return total


@pytest.mark.parametrize(
    ("shift", "dtype"),
    [(drift, np.uint8), (across_zero, np.uint16), mark_nightly(drift, np.uint16), mark_nightly(across_zero, np.uint8)],
)
def test_every_pixel_is_that_of_the_scene_at_the_place_it_comes_from(shift, dtype):
    """As near as a cubic B-spline comes in twice the precision, and a little of what rounding leaves."""
    rows, columns = np.mgrid[:150, :210].astype(float)
    scale = np.iinfo(dtype).max / 256
    image = np.round(scale * np.clip(scene(columns, rows), 0, 255)).astype(dtype)
    moved = warp(image, shift) / scale
    places = np.stack(np.meshgrid(np.arange(0, 256.0, LATTICE_PX), np.arange(0, 192.0, LATTICE_PX)), axis=-1)
    offset = source_offset(shift, places.reshape(-1, 2)).reshape(places.shape)
    dx, dy = (
        ndimage.map_coordinates(offset[:, :, i], [rows / LATTICE_PX, columns / LATTICE_PX], order=1) for i in (0, 1)
    )
    inner = (slice(8, -8), slice(8, -8))
    truth = np.clip(scene(columns + dx, rows + dy), 0, 255)[inner]
    spline = ndimage.map_coordinates(image / scale, [rows + dy, columns + dx], order=3)[inner]
    error = np.sqrt(((moved[inner] - truth) ** 2).mean())
    assert moved.dtype == np.float32
    assert error < np.sqrt(((spline - truth) ** 2).mean()) + 0.02
    assert error < 0.35


@pytest.mark.parametrize("shape", [(16, 16), (61, 131), (160, 200)])
def test_a_plane_is_read_exactly(shape):
    rows, columns = np.mgrid[: shape[0], : shape[1]].astype(np.float32)
    moved = warp(100 + 2 * columns + rows, lambda xy_px: np.full_like(xy_px, -0.3))
    expected = 100 + 2 * (columns + 0.3) + rows + 0.3
    assert moved[4:-4, 4:-4] == pytest.approx(expected[4:-4, 4:-4], abs=1e-3)


def test_the_place_a_point_comes_from_is_the_inverse_of_the_shift():
    points = np.random.default_rng(1).uniform(0, 2000, (500, 2))
    source = points + source_offset(drift, points)
    assert source + drift(source) == pytest.approx(points, abs=1e-9)


def test_markers_are_found_where_the_shift_puts_them_within_half_a_thousandth_of_a_pixel():
    target = load_target(find_packaged("targets", "paper-9x6"))
    image = (256 * render(Scene(psf_px=0.8, tilt_y_deg=4, roll_deg=1))).astype(np.uint16)
    before = detect(image, target).centres_px
    after = detect(np.round(warp(image, drift)).astype(np.uint16), target).centres_px
    error_px = after - before - drift(before)
    assert np.sqrt((error_px**2).mean()) < 5e-4


def test_no_shift_leaves_the_image_as_it_is():
    image = noise(SMALL[::-1])
    assert np.array_equal(np.round(warp(image, np.zeros_like)), image)


def test_what_was_outside_is_the_image_mirrored_about_its_outermost_pixels():
    image = noise(SMALL[::-1])
    moved = warp(image, lambda xy_px: np.full_like(xy_px, 3.0))
    assert moved[:3, 3:] == pytest.approx(image[3:0:-1, :-3].astype(float), abs=5e-3)


def test_a_shift_that_is_not_known_everywhere_is_refused():
    with pytest.raises(ValueError, match="not finite"):
        warp(noise(SMALL), lambda xy_px: np.where(xy_px > 100, np.nan, 0 * xy_px))


def test_a_shift_that_tears_the_image_apart_is_refused():
    with pytest.raises(ValueError, match="within 16 px"):
        warp(noise(SMALL), lambda xy_px: -0.1 * xy_px)


def test_an_image_that_is_too_small_is_refused():
    with pytest.raises(ValueError, match=r"at least 16 x 16 pixels, not \(15, 40\)"):
        warp(noise((15, 40)), np.zeros_like)
