"""The target's plane in the image: homographies, and what a lens adds to them."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray

from thermostand.foundation.errors import DetectionError
from thermostand.markers.target import Target

_LEAST_FOR_DEGREE = {5: 80, 3: 20}
"""A polynomial of this degree needs so many markers: about four for each coefficient, or two for the cubic."""
# Without a test of convergence: the bend is needed to a part of the place tolerance only.
_ROUNDS = 8
_NOT_FLAT = "the spots found cannot be the markers of a flat target"
_SIGMA_OF_MEDIAN = 1 / np.sqrt(2 * np.log(2))
"""Of distances in two dimensions (Rayleigh)."""

Float = NDArray[np.float64]


def project(homography: Float, points: Float) -> Float:
    """Points (K, 2) mapped by a homography; DetectionError when its horizon lies among them: no camera sees them so."""
    mapped = np.column_stack([points, np.ones(len(points))]) @ homography.T
    if not (np.all(mapped[:, 2] > 0) or np.all(mapped[:, 2] < 0)):
        raise DetectionError(_NOT_FLAT)
    return mapped[:, :2] / mapped[:, 2:]


def fit_homography(target_mm: Float, centres_px: Float) -> Float:
    """Least-squares homography (3, 3), target mm -> px, from at least four pairs of points.

    DetectionError when there is none, as for points on a line.
    """
    return check_homography(cv2.findHomography(target_mm, centres_px, 0)[0])


def check_homography(found: object) -> Float:
    """Return what cv2.findHomography gave, as an array; DetectionError when it gave none, or one that cannot be
    inverted."""
    homography = np.full((3, 3), np.nan) if found is None else np.asarray(found, dtype=np.float64)
    if not np.isfinite(homography).all() or np.linalg.det(homography) == 0:
        raise DetectionError(_NOT_FLAT)
    return homography


def compute_area_scale(homography: Float, points: Float) -> Float:
    """px^2 per mm^2 at points (K, 2): the determinant of a homography's derivative, det H / w^3."""
    w = np.column_stack([points, np.ones(len(points))]) @ homography[2]
    return np.abs(np.linalg.det(homography) / w**3)


def compute_pitch_px(homography: Float, target: Target) -> float:
    """The distance of neighbours in the middle of the target: the side of a square of the same area."""
    middle = target.coordinates_mm().mean(axis=0, keepdims=True)
    return target.spacing_mm * float(np.sqrt(compute_area_scale(homography, middle)[0]))


def compute_roll_deg(homography: Float, target: Target) -> float:
    """Counter-clockwise angle in the image of the rows' direction, in the middle of the target."""
    middle = target.coordinates_mm().mean(axis=0)
    ends = project(homography, np.stack([middle, middle + np.array([target.pitch_mm, 0])]))
    return float(np.degrees(np.arctan2(-(ends[1, 1] - ends[0, 1]), ends[1, 0] - ends[0, 0])))


def predict_px(target_mm: Float, centres_px: Float, homography: Float) -> Float:
    """Predict where each marker (N, 2) belongs, by `to_image`; centres_px: NaN where unknown."""
    return make_image_map(target_mm, centres_px, homography)(target_mm)


def make_image_map(target_mm: Float, centres_px: Float, homography: Float) -> Callable[[Float], Float]:
    """The map from points of the target's plane (K, 2), mm, to px: the homography, bent by a polynomial that follows
    the deviations of the known among centres_px (N, 2).

    A wide lens puts markers of the corners a fifth of a pitch off any homography, smoothly; clutter and misfits are
    off by themselves, and weigh little (Cauchy). Below 20 known ones nothing is bent.
    """
    known = np.isfinite(centres_px[:, 0])
    degree = next((degree for degree, least in _LEAST_FOR_DEGREE.items() if known.sum() >= least), None)
    if degree is None:
        return lambda points_mm: project(homography, points_mm)
    low, high = target_mm.min(axis=0), target_mm.max(axis=0)
    design = _compute_monomials(target_mm[known], low, high, degree)
    deviation = centres_px[known] - project(homography, target_mm[known])
    weight = np.ones(len(deviation))
    bend = np.zeros((design.shape[1], 2))
    for _ in range(_ROUNDS):
        root = np.sqrt(weight)[:, None]
        bend = np.linalg.lstsq(design * root, deviation * root, rcond=None)[0]
        off = np.linalg.norm(deviation - design @ bend, axis=1)
        scatter_px = 2 * max(_SIGMA_OF_MEDIAN * float(np.median(off)), 0.1)
        weight = 1 / (1 + (off / scatter_px) ** 2)
    return lambda points_mm: project(homography, points_mm) + _compute_monomials(points_mm, low, high, degree) @ bend


def _compute_monomials(points: Float, low: Float, high: Float, degree: int) -> Float:
    """x^i y^j, i + j <= degree, of points (K, 2) scaled so that low and high are -1 and 1; shape (K, terms)."""
    scaled = (2 * points - low - high) / (high - low)
    powers = [scaled**exponent for exponent in range(degree + 1)]
    pairs = [(i, j) for i in range(degree + 1) for j in range(degree + 1 - i)]
    return np.stack([powers[i][:, 0] * powers[j][:, 1] for i, j in pairs], axis=1)
