"""The ellipses that a target's markers should be in the image, by the target's plane and by the other markers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thermostand.markers.edge_model import B0, CX, CY, M11, M12, M22, SIGMA, EdgeState, Float
from thermostand.markers.plane import expected_px, project
from thermostand.markers.target import Target

_FIRST_BLUR_PX = 1.2
_LEAST_PEERS = 8
"""Markers that a shape is predicted from, with three coefficients each."""


@dataclass(frozen=True, slots=True, eq=False)
class Implied:
    """state: the edges of K markers. spread: (K, 4), standard deviations of their m11, m12, m22 and sigma."""

    state: EdgeState
    spread: Float


def expected_edges(homography: Float, target: Target) -> EdgeState:
    """The image ellipses of the target's circles, levels unknown (NaN): conic C = H^-T Q H^-1 of each circle Q."""
    x, y = target.coordinates_mm().T
    radius = target.diameters_mm() / 2
    _require_in_front(homography, np.column_stack([x, y]), radius)
    circle = np.zeros((target.count, 3, 3))
    circle[:, [0, 1, 2], [0, 1, 2]] = np.stack([np.ones_like(x), np.ones_like(x), x**2 + y**2 - radius**2], axis=1)
    circle[:, 0, 2] = circle[:, 2, 0] = -x
    circle[:, 1, 2] = circle[:, 2, 1] = -y
    back = np.linalg.inv(homography)
    conic = back.T @ circle @ back
    centre = -np.linalg.solve(conic[:, :2, :2], conic[:, :2, 2, None])[:, :, 0]
    level = conic[:, 2, 2] + np.einsum("ni,ni->n", conic[:, :2, 2], centre)
    shape = -conic[:, :2, :2] / level[:, None, None]
    scale = np.linalg.det(shape) ** -0.25
    shape = shape * (scale**2)[:, None, None]
    parameters = np.full((target.count, 12), np.nan)
    parameters[:, [CX, CY]] = centre
    parameters[:, M11], parameters[:, M12], parameters[:, M22] = shape[:, 0, 0], shape[:, 0, 1], shape[:, 1, 1]
    parameters[:, SIGMA] = _FIRST_BLUR_PX
    return EdgeState(parameters, scale)


def _require_in_front(homography: Float, centres_mm: Float, radii_mm: Float) -> None:
    """DetectionError when the image's horizon goes between or through the discs: their outlines are no ellipses."""
    corners = np.array([(-1, -1), (-1, 1), (1, -1), (1, 1)])
    project(homography, (centres_mm[:, None] + radii_mm[:, None, None] * corners).reshape(-1, 2))


def implied_edges(
    state: EdgeState, homography: Float, target: Target, clean: NDArray[np.bool_], which: NDArray[np.intp]
) -> Implied | None:
    """What the `clean` (N,) markers of `state` say about those numbered `which` (K,), from 0.

    Shapes deviate from the homography's ellipses, and blurs from each other, linearly over the target; only markers of
    the same size are asked, as a print grows all its outlines by the same width. Levels are those of the nearest clean
    marker. None when there is nobody to ask.
    """
    diameters = target.diameters_mm()
    peers = [clean & (diameters == diameters[n]) for n in which]
    if not peers or min(np.count_nonzero(group) for group in peers) < _LEAST_PEERS:
        return None
    places = target.coordinates_mm()
    expected = expected_edges(homography, target)
    known = np.where(clean[:, None], state.centres_px(), np.nan)
    expected.parameters[:, [CX, CY]] = expected_px(places, known, homography)
    in_scale = state.parameters[:, M11 : SIGMA + 1].copy()
    in_scale[:, :3] *= ((expected.scale_px / state.scale_px) ** 2)[:, None]
    deviation = in_scale - np.pad(expected.parameters[:, M11:SIGMA], ((0, 0), (0, 1)))
    design = np.column_stack([np.ones(target.count), places])
    implied, spread = expected[which], np.empty((len(which), 4))
    for row, (n, group) in enumerate(zip(which, peers, strict=True)):
        by_peers = design[n] @ np.linalg.pinv(design[group])
        scatter = deviation[group] - design[group] @ np.linalg.pinv(design[group]) @ deviation[group]
        variance = np.sum(scatter**2, axis=0) / (np.count_nonzero(group) - design.shape[1])
        spread[row] = np.sqrt(variance * (1 + by_peers @ by_peers))
        implied.parameters[row, SIGMA] = 0
        implied.parameters[row, M11 : SIGMA + 1] += by_peers @ deviation[group]
        nearest = np.flatnonzero(clean)[np.linalg.norm(places[clean] - places[n], axis=1).argmin()]
        implied.parameters[row, B0:] = state.parameters[nearest, B0:]
    return Implied(implied, spread)
