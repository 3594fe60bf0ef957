"""Where the markers are in an image, for a recorder that keeps only those parts of it."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from thermostand.markers.candidate_search import Candidates, find_candidates, iterate_disc_sizes_px
from thermostand.markers.grid_identification import DetectionError, Identified, identify, project
from thermostand.markers.noise import Image
from thermostand.markers.target import Target

MARGIN_px = 20
"""Around each marker's outline. The edge fit reads 9 blurs, 18 px for a lens that blurs by sigma = 2 px; the rest is
for the few tenths of a pixel that heat moves the image, and for the first stage's own error."""

Float = NDArray[np.float64]


def find_marker_windows(image: Image, target: Target) -> NDArray[np.int32] | None:
    """The bounding box of each marker with MARGIN_px around it, cut at the image's edges: x, y, width, height in px,
    shape (target.count, 4), marker n at index n - 1. None unless every marker is found. Grey image (height, width)."""
    for size_px in iterate_disc_sizes_px(target, image.shape):
        try:
            candidates = find_candidates(image, target, size_px)
            identified = identify(candidates, target)
        except (DetectionError, cv2.error, np.linalg.LinAlgError):
            continue
        if (identified.candidate >= 0).all():
            return _compute_windows(candidates, identified, target, image.shape)
    return None


def _compute_windows(
    candidates: Candidates, identified: Identified, target: Target, shape: tuple[int, int]
) -> NDArray[np.int32]:
    centre = candidates.centres_px[identified.candidate]
    half = _compute_half_extents_px(identified.homography, target)
    # The shape is the homography's, the size that in the image: the print may be larger than its description.
    half *= np.sqrt(candidates.areas_px2[identified.candidate] / (np.pi * half.prod(axis=1)))[:, None]
    low = np.maximum(np.floor(centre - half - MARGIN_px), 0)
    high = np.minimum(np.ceil(centre + half + MARGIN_px) + 1, shape[::-1])
    return np.concatenate([low, high - low], axis=1).astype(np.int32)


def _compute_half_extents_px(homography: Float, target: Target) -> Float:
    """Return half width and half height of each marker's outline, (N, 2)."""
    angle = np.arange(64) * (2 * np.pi / 64)
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    outlines = target.coordinates_mm()[:, None] + target.diameters_mm()[:, None, None] / 2 * circle
    mapped = project(homography, outlines.reshape(-1, 2)).reshape(outlines.shape)
    return np.ptp(mapped, axis=1) / 2
