"""Whether a target is still where the frame before had it, and which rows of the picture it takes to follow it."""

from __future__ import annotations

import numpy as np

from thermostand.markers.edge_model import CX, CY, M11, M12, M22, SIGMA, EdgeState, Float
from thermostand.markers.newton import LEAST_BAND_PX
from thermostand.markers.pixels import Mask, Picture

_FOLLOWED_PART = 0.9
_GREATEST_STEP_PX = 5.0
_GLANCE_BLURS = 3.0
_GLANCE_CONTRAST = 0.75
_TOWARDS = np.array([[function(k * np.pi / 8) for k in range(16)] for function in (np.cos, np.sin)])
_TWICE = 2 * _TOWARDS[0] * _TOWARDS[1]
_ROOM_PX, _ROOM_OF_UNSEEN = 4.0, 0.5
"""By what a marker may move, or its band grow, until rows are looked at that were not foreseen; of one that was not
seen, in radii: the search for it begins in its place and goes further."""


def still_there(picture: Picture, state: EdgeState, is_seen: Mask, inwards: Float) -> bool:
    """Whether the markers (N,) that were seen still look as they did: a glance at 16 pixels on either side of each
    outline, not nearer to the centre than `inwards` (N, 1) radii. Much cheaper than a fit that ends nowhere because the
    target has moved."""
    m11, m12, m22 = (state.parameters[:, [each]] for each in (M11, M12, M22))
    radius = state.scale_px[:, None] / np.sqrt(m11 * _TOWARDS[0] ** 2 + m22 * _TOWARDS[1] ** 2 + m12 * _TWICE)
    margin = np.minimum(_GLANCE_BLURS * state.parameters[:, [SIGMA]], np.minimum(0.6, 1 - inwards) * radius)
    along = np.stack([radius + margin, radius - margin])
    column, row = (
        np.clip(np.rint(state.parameters[:, [axis]] + along * _TOWARDS[axis]), 0, picture.shape[1 - axis] - 1)
        for axis in (CX, CY)
    )
    levels = picture.values_DN(row.astype(np.intp), column.astype(np.intp)).mean(axis=2)
    unchanged = (levels[0] - levels[1]) / state.contrast_DN() > _GLANCE_CONTRAST
    return bool(unchanged[is_seen].mean() >= _FOLLOWED_PART)


def has_followed(now_px: Float, before_px: Float) -> bool:
    """Whether centres (N, 2), NaN for missing ones, are of the same markers as before: about as many, and none far from
    where it was."""
    found, found_before = (int(np.isfinite(centres[:, 0]).sum()) for centres in (now_px, before_px))
    moved = np.linalg.norm(now_px - before_px, axis=1)
    return bool(found >= _FOLLOWED_PART * found_before and np.nanmax(moved) < _GREATEST_STEP_PX)


def rows_round(state: EdgeState, is_seen: Mask, outwards: Float, band_sigma: float, height: int) -> Mask:
    """The rows (height,) that a fit from `state` looks at, in all likelihood: those of each marker's band, which ends
    `outwards` (N,) radii from the centre, and some more."""
    half_px, blur_px, mean_px = state.half_extents_px(), state.parameters[:, SIGMA], state.radii_px()
    squares = np.sum(half_px**2, axis=1)
    long_px = np.sqrt(0.5 * (squares + np.sqrt(np.maximum(squares**2 - 4 * mean_px**4, 0))))
    width = np.maximum(band_sigma * blur_px, LEAST_BAND_PX) * long_px / mean_px**2
    band_px = half_px[:, 1] * np.minimum(1 + width, outwards)
    reach_px = np.maximum(band_px, half_px[:, 1] + _GLANCE_BLURS * blur_px)
    reach_px += np.where(is_seen, _ROOM_PX, np.maximum(_ROOM_OF_UNSEEN * half_px[:, 1], _ROOM_PX))
    middle = state.centres_px()[:, 1]
    begins = np.clip(np.floor(middle - reach_px), 0, height).astype(int)
    ends = np.clip(np.ceil(middle + reach_px) + 1, 0, height).astype(int)
    edges = np.bincount(begins, minlength=height + 1) - np.bincount(ends, minlength=height + 1)
    return np.cumsum(edges[:height]) > 0
