"""The normal equations of markers seen in many pictures.

A marker is moved by what all share (the camera), by what its picture has of its own (a pose, the table's errors) and by
its board point only: the sums run over these blocks, not over the rows of a derivative that is nearly all zeros.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thermostand.compensation.calibration.least_squares import Float


@dataclass(frozen=True, slots=True, eq=False)
class Slopes:
    """Derivatives of M whitened markers, of board point marker[m] in picture[m]: common (M, 2, C) with respect to what
    all share, own (M, 2, F) to what the picture has of its own, points (M, 2, 3) to the board point."""

    picture: NDArray[np.int64]
    marker: NDArray[np.int64]
    common: Float
    own: Float
    points: Float


def equations_of(slopes: Slopes, off: Float, pictures: int, markers: int) -> tuple[Float, Float]:
    """J' J (n, n) and J' r (n,) of residuals off (M, 2); n = C, then F of each picture, then 3 of each board point."""
    common, own, points, off = (
        _placed(slopes, part, pictures, markers) for part in (slopes.common, slopes.own, slopes.points, off[..., None])
    )
    of_pictures = [part.reshape(pictures, 2 * markers, part.shape[-1]) for part in (common, own, off)]
    of_markers = [
        np.swapaxes(part, 0, 1).reshape(markers, 2 * pictures, part.shape[-1]) for part in (common, points, off)
    ]
    to_own, to_points = np.swapaxes(of_pictures[1], 1, 2), np.swapaxes(of_markers[1], 1, 2)
    flat = common.reshape(-1, common.shape[-1])
    beside = np.concatenate([_rows(to_own @ of_pictures[0]), _rows(to_points @ of_markers[0])])
    crossed = np.swapaxes(np.swapaxes(own, 2, 3) @ points, 1, 2).reshape(-1, 3 * markers)
    others = [[_diagonal(to_own @ of_pictures[1]), crossed], [crossed.T, _diagonal(to_points @ of_markers[1])]]
    normal = np.block([[flat.T @ flat, beside.T], [beside, np.block(others)]])
    parts = flat.T @ off.ravel(), (to_own @ of_pictures[2]).ravel(), (to_points @ of_markers[2]).ravel()
    return normal, np.concatenate(parts)


def _placed(slopes: Slopes, values: Float, pictures: int, markers: int) -> Float:
    """(pictures, markers, 2, K) of (M, 2, K): 0 where a marker is not used."""
    placed = np.zeros((pictures, markers, *values.shape[1:]))
    placed[slopes.picture, slopes.marker] = values
    return placed


def _rows(blocks: Float) -> Float:
    """(B K, C) of blocks (B, K, C)."""
    return blocks.reshape(-1, blocks.shape[-1])


def _diagonal(blocks: Float) -> Float:
    """(B K, B K) of blocks (B, K, K)."""
    count, size, _ = blocks.shape
    matrix = np.zeros((count, size, count, size))
    each = np.arange(count)
    matrix[each, :, each] = blocks
    return matrix.reshape(count * size, count * size)
