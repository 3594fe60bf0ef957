"""What small rotations need beside scipy's Rotation: cross products as matrices, and directions across an axis."""

from __future__ import annotations

import numpy as np

from compensation.calibration.least_squares import Float


def crosses(vectors: Float) -> Float:
    """Matrices (..., 3, 3) that multiply by `vectors` x from the left."""
    x, y, z = np.moveaxis(vectors, -1, 0)
    zero = np.zeros_like(x)
    return np.stack(
        [np.stack([zero, -z, y], axis=-1), np.stack([z, zero, -x], axis=-1), np.stack([-y, x, zero], axis=-1)], axis=-2
    )


def across(axis: Float) -> Float:
    """(3, 2): unit vectors at right angles to a unit vector (3,) and each other, steady when it turns a little."""
    coordinate = np.eye(3)[np.argmin(np.abs(axis))]
    first = coordinate - axis * (axis @ coordinate)
    first = first / np.linalg.norm(first)
    return np.column_stack([first, crosses(axis) @ first])
