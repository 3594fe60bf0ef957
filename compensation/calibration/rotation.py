"""Rotations as vectors: direction = axis by the right-hand rule, length = angle in rad."""

from __future__ import annotations

import numpy as np

from compensation.calibration.least_squares import Float


def matrices(vectors_rad: Float) -> Float:
    """Rotation matrices (..., 3, 3) of rotation vectors (..., 3) by Rodrigues' formula."""
    angle = np.linalg.norm(vectors_rad, axis=-1)[..., None, None]
    cross = crosses(vectors_rad)
    safe = np.where(angle > 1e-12, angle, 1.0)
    first = np.where(angle > 1e-12, np.sin(safe) / safe, 1.0)
    second = np.where(angle > 1e-12, 2 * np.sin(safe / 2) ** 2 / safe**2, 0.5)
    return np.eye(3) + first * cross + second * (cross @ cross)


def vector(matrix: Float) -> Float:
    """Rotation vector (3,), shorter than pi, of a rotation matrix (3, 3)."""
    sine = np.array([matrix[2, 1] - matrix[1, 2], matrix[0, 2] - matrix[2, 0], matrix[1, 0] - matrix[0, 1]]) / 2
    length = float(np.linalg.norm(sine))
    angle = float(np.arctan2(length, (np.trace(matrix) - 1) / 2))
    return sine if length < 1e-12 else sine * (angle / length)


def crosses(vectors: Float) -> Float:
    """Matrices (..., 3, 3) that multiply by `vectors` x from the left."""
    x, y, z = np.moveaxis(vectors, -1, 0)
    zero = np.zeros_like(x)
    return np.stack(
        [np.stack([zero, -z, y], axis=-1), np.stack([z, zero, -x], axis=-1), np.stack([-y, x, zero], axis=-1)], axis=-2
    )


def nearest(matrix: Float) -> Float:
    """The rotation nearest to a matrix (3, 3), in the sense of least squares."""
    left, _, right = np.linalg.svd(matrix)
    return left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right


def across(axis: Float) -> Float:
    """(3, 2): unit vectors at right angles to a unit vector (3,) and each other, steady when it turns a little."""
    coordinate = np.eye(3)[np.argmin(np.abs(axis))]
    first = coordinate - axis * (axis @ coordinate)
    first = first / np.linalg.norm(first)
    return np.column_stack([first, crosses(axis) @ first])
