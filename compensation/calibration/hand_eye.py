"""Where the table's axes are in the camera's frame, from the target's pose at each position: the adjustment's start."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from thermostand.compensation.calibration.least_squares import Float
from thermostand.compensation.calibration.stage_geometry import Table
from thermostand.foundation.errors import CalibrationError

_LEAST_TURN_DEG = 5.0
_LEAST_TRAVEL_MM = 10.0


def table_from_poses(
    linear_mm: Float, rotary_deg: Float, rotations: Float, translations_mm: Float, middle_mm: Float
) -> Table:
    """The table that puts the target, whose middle is (3,), at poses (P, 3, 3) and (P, 3).

    CalibrationError when an axis hardly moved.
    """
    if np.ptp(rotary_deg) < _LEAST_TURN_DEG or np.ptp(linear_mm) < _LEAST_TRAVEL_MM:
        raise CalibrationError(
            f"the positions span {np.ptp(linear_mm):g} mm and {np.ptp(rotary_deg):g} deg; "
            f"{_LEAST_TRAVEL_MM:g} mm and {_LEAST_TURN_DEG:g} deg are needed to separate camera and table"
        )
    rotary = _axis(rotary_deg, rotations)
    turns = Rotation.from_rotvec(rotary_deg[:, None] * rotary, degrees=True)
    mount = (turns.inv() * Rotation.from_matrix(rotations)).mean().as_matrix()
    base_mm, linear, offset_mm = _places(linear_mm, turns.as_matrix(), translations_mm)
    # What of o is along the axis is for the wobble to act on, and otherwise the same as a shift of the base.
    along = rotary * (rotary @ (offset_mm + mount @ middle_mm))
    return Table(base_mm + along, linear, rotary, mount, offset_mm - along)


def _axis(rotary_deg: Float, rotations: Float) -> Float:
    """Unit vector about which the target turns with rising angle: sum of all turns from the first position."""
    total = (rotary_deg - rotary_deg[0]) @ Rotation.from_matrix(rotations @ rotations[0].T).as_rotvec()
    return total / np.linalg.norm(total)


def _places(linear_mm: Float, turns: Float, translations_mm: Float) -> tuple[Float, Float, Float]:
    """c, l and o of t = c + z l + turn o, by least squares."""
    identity = np.broadcast_to(np.eye(3), turns.shape)
    design = np.concatenate([identity, linear_mm[:, None, None] * np.eye(3), turns], axis=2).reshape(-1, 9)
    found = np.asarray(np.linalg.lstsq(design, translations_mm.ravel(), rcond=1e-9)[0], np.float64)
    return found[:3], found[3:6] / np.linalg.norm(found[3:6]), found[6:]
