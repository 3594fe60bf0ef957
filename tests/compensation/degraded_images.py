"""Photographs whose residuals hang together, or are not what the noise model says: each from a scene, its noise-free
image and a seed."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray

from .renderer import Float, Scene, photograph

Image = NDArray[np.uint8] | NDArray[np.uint16]
Picture = Callable[[Scene, Float, int], Image]


def photograph_with_noise(scene: Scene, clean: Float, seed: int) -> Image:
    return photograph(scene, clean, seed)


def make_jpeg_picture(quality: int) -> Picture:
    def picture(scene: Scene, clean: Float, seed: int) -> Image:
        stored = cv2.imencode(".jpg", photograph(scene, clean, seed), [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
        return np.asarray(cv2.imdecode(stored, cv2.IMREAD_GRAYSCALE), np.uint8)

    return picture


def make_motion_blur_picture(length_px: float, angle_deg: float = 20) -> Picture:
    """Along a line at an angle to the rows."""
    kernel = np.zeros((31, 31))
    for t in np.linspace(-length_px / 2, length_px / 2, 400):
        x, y = 15 + t * np.cos(np.radians(angle_deg)), 15 + t * np.sin(np.radians(angle_deg))
        column, row = int(x), int(y)
        right, down = x - column, y - row
        kernel[row : row + 2, column : column + 2] += np.outer([1 - down, down], [1 - right, right]) / 400
    return lambda scene, clean, seed: photograph(scene, np.asarray(cv2.filter2D(clean, -1, kernel), np.float64), seed)


def photograph_unequal_pixels(scene: Scene, clean: Float, seed: int) -> Image:
    gains = 1 + 0.02 * np.random.default_rng(seed + 1000).standard_normal(clean.shape)
    return photograph(scene, clean * gains, seed)


def photograph_with_gamma(scene: Scene, clean: Float, seed: int) -> Image:
    image = photograph(scene, clean, seed) / 255
    return np.round(255 * image ** (1 / 2.2)).astype(np.uint8)


def photograph_flickering_rows(scene: Scene, clean: Float, seed: int) -> Image:
    rows = np.random.default_rng(seed + 1000).standard_normal((scene.size[1], 1))
    return photograph(scene, clean + 3 * rows, seed)


def photograph_grained_paper(scene: Scene, clean: Float, seed: int) -> Image:
    grain = cv2.GaussianBlur(np.random.default_rng(seed + 1000).standard_normal(clean.shape), (0, 0), 5)
    return photograph(scene, clean * (1 + 0.05 * grain / grain.std()), seed)
