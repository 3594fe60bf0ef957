"""What small rotations need beside scipy's Rotation: cross products as matrices, and directions across an axis."""

from __future__ import annotations

import numpy as np

from thermostand.compensation.calibration.least_squares import Float


def crosses(vectors: Float) -> Float:
    """Matrices (..., 3, 3) that multiply by `vectors` x from the left."""
    matrices = np.zeros((*vectors.shape, 3))
    for row, column, axis in ((2, 1, 0), (0, 2, 1), (1, 0, 2)):
        matrices[..., row, column] = vectors[..., axis]
        matrices[..., column, row] = -vectors[..., axis]
    return matrices


def across(axis: Float) -> Float:
    """(3, 2): unit vectors at right angles to a unit vector (3,) and each other, steady when it turns a little."""
    coordinate = np.eye(3)[np.argmin(np.abs(axis))]
    first = coordinate - axis * (axis @ coordinate)
    first = first / np.linalg.norm(first)
    return np.column_stack([first, crosses(axis) @ first])
