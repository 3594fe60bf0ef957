"""A frame as it is sent to the process that looks at frames. Nothing is imported here that takes time."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thermostand.experiments.steps import Role

# Drift is that of the camera, so it is measured in frames in which nothing else moves. "": a frame that no capture of a
# run asked for.
DRIFT_ROLES = frozenset({"", Role.REFERENCE, Role.FIT, Role.VALIDATION, Role.WARM_UP, Role.SETTLING})

Image = NDArray[np.uint8] | NDArray[np.uint16]


@dataclass(frozen=True, slots=True)
class FrameShot:
    """role: of its capture, "" without one. as_reference: drift counts from it on."""

    camera: str
    time_ns: int
    image: Image
    role: str = ""
    as_reference: bool = False


def is_reference(role: str, before: str, *, is_first: bool) -> bool:
    """Return whether drift counts from a frame of this role on, the one looked at before being of role `before`."""
    return role in DRIFT_ROLES and (is_first or role == Role.REFERENCE != before)
