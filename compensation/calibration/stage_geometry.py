"""The stages under the target: where a point of the target is in the camera's frame, at a linear and a rotary position.

    p = c + z l + E d + exp(F w) Rot(a, angle) (R0 X + o)

c: a point; l: unit vector of the linear axis; a: unit vector of the rotary axis; R0 and o: how the target sits on the
rotary table. d and w are the table's own errors at the position, mm and rad: E = (l, two directions across), F = (a,
two across), so d[0] and w[0] are errors of the recorded positions, d[1:] is the lack of straightness, w[1:] the
wobble. A wobble turns about the point of the rotary axis at the height of the target's middle.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from thermostand.compensation.calibration.least_squares import Float
from thermostand.compensation.calibration.pinhole import find_perpendiculars, make_cross_matrices

PARAMETERS = 12
"""Of a table's step: c (3), l (2), a (2), R0 (3), o (2)."""
ERRORS = 6
"""Per position: d (3), w (3)."""


@dataclass(frozen=True, slots=True)
class TableSigma:
    """Standard uncertainties of the table at a position; 0 takes that degree of freedom as exact.

    Attributes
    ----------
    linear_mm, rotary_arcmin
        Of the recorded positions; the defaults are the resolutions that the paper names for its table (0.31 um, 0.6
        arcmin) and what a microstepping drive adds.
    straightness_mm, wobble_arcmin
        Across the axes.
    """

    linear_mm: float = 0.0005
    rotary_arcmin: float = 0.6
    straightness_mm: float = 0.0
    wobble_arcmin: float = 0.0

    @property
    def vector(self) -> Float:
        """(6,): of d in mm and w in rad."""
        rotary, wobble = math.radians(self.rotary_arcmin / 60), math.radians(self.wobble_arcmin / 60)
        across_mm = self.straightness_mm
        return np.array([self.linear_mm, across_mm, across_mm, rotary, wobble, wobble])


@dataclass(frozen=True, slots=True, eq=False)
class TableGeometry:
    """base_mm (3,): c. linear (3,): l. rotary (3,): a. mount (3, 3): R0. offset_mm (3,): o. In the camera's frame."""

    base_mm: Float
    linear: Float
    rotary: Float
    mount: Float
    offset_mm: Float

    def compute_poses(self, linear_mm: Float, rotary_deg: Float, errors: Float) -> tuple[Float, Float]:
        """Rotation matrices (P, 3, 3) and translations (P, 3), mm, from target to camera; errors (P, 6)."""
        along, about = _make_axis_frame(self.linear), _make_axis_frame(self.rotary)
        turn = Rotation.from_rotvec(errors[:, 3:] @ about.T).as_matrix() @ self.compute_turns(rotary_deg)
        base = self.base_mm + linear_mm[:, None] * self.linear + errors[:, :3] @ along.T
        return turn @ self.mount, base + turn @ self.offset_mm

    def compute_turns(self, rotary_deg: Float) -> Float:
        """Rotation matrices (P, 3, 3) about the rotary axis."""
        return Rotation.from_rotvec(rotary_deg[:, None] * self.rotary, degrees=True).as_matrix()

    def compute_jacobian(
        self, points_mm: Float, linear_mm: Float, rotary_deg: Float, errors: Float
    ) -> tuple[Float, Float, Float]:
        """Derivatives of the points p of target points (M, 3), each at its own position (M,) with its errors (M, 6).

        With respect to a step of the table (M, 3, 12), to d and w (M, 3, 6), and to the target points (M, 3, 3). Terms
        of second order in w are left out.
        """
        turn = Rotation.from_rotvec(errors[:, 3:] @ _make_axis_frame(self.rotary).T).as_matrix() @ self.compute_turns(
            rotary_deg
        )
        mounted = points_mm @ self.mount.T
        arm = mounted + self.offset_mm
        sideways = find_perpendiculars(self.rotary)
        swing = -make_cross_matrices(np.einsum("mij,mj->mi", turn, arm))  # of a small left rotation
        table = np.concatenate(
            [
                np.broadcast_to(np.eye(3), (len(points_mm), 3, 3)),
                linear_mm[:, None, None] * find_perpendiculars(self.linear),
                (swing + turn @ make_cross_matrices(arm)) @ sideways,
                -turn @ make_cross_matrices(mounted),
                turn @ sideways,
            ],
            axis=2,
        )
        shifts = np.broadcast_to(_make_axis_frame(self.linear), (len(points_mm), 3, 3))
        return table, np.concatenate([shifts, swing @ _make_axis_frame(self.rotary)], axis=2), turn @ self.mount

    @property
    def frame(self) -> Float:
        """Rotation (3, 3) from the camera's to the table's frame: Z along the linear axis, X right and Y down in the
        plane of both axes. Unlike the camera's own axis, which shifts against the lens's decentring, it is seen well.
        """
        down = np.copysign(1.0, self.rotary[1]) * self.rotary
        down = down - self.linear * (self.linear @ down)
        down = down / np.linalg.norm(down)
        return np.stack([make_cross_matrices(down) @ self.linear, down, self.linear])

    def apply_step(self, change: Float) -> TableGeometry:
        """The table a step (12,) away: c, l, a, R0, o in mm and rad."""
        sideways = find_perpendiculars(self.rotary)
        linear = self.linear + find_perpendiculars(self.linear) @ change[3:5]
        return replace(
            self,
            base_mm=self.base_mm + change[:3],
            linear=linear / np.linalg.norm(linear),
            rotary=Rotation.from_rotvec(sideways @ change[5:7]).apply(self.rotary),
            mount=Rotation.from_rotvec(change[7:10]).as_matrix() @ self.mount,
            offset_mm=self.offset_mm + sideways @ change[10:12],
        )


def _make_axis_frame(axis: Float) -> Float:
    """(3, 3): the axis and two unit vectors across it, as columns."""
    return np.column_stack([axis, find_perpendiculars(axis)])
