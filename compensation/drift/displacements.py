"""How far each measured centre is from where it was at the reference temperature.

Displacement always means reference position minus measured position: what must be added to a measured centre.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from thermostand.compensation.observations import Float, Mask, Observations
from thermostand.experiments.steps import Role
from thermostand.foundation.errors import SessionError

# The mean of 20 frames has 0.22 of the noise of one; of 10 it has 0.32, of 40 0.16.
_ANCHOR_FRAMES = 20


@dataclass(frozen=True, slots=True, eq=False)
class Displacements:
    """M single centres against their references, row by row.

    measured_px (M, 2), displacement_px (M, 2): reference minus measured. variance_px2 (M, 2): of the measured centre
    and of its reference. camera_degC, chamber_degC (M,). frame (M,): row of the observations. marker (M,): from 0.
    """

    measured_px: Float
    displacement_px: Float
    variance_px2: Float
    camera_degC: Float
    chamber_degC: Float
    frame: NDArray[np.int64]
    marker: NDArray[np.int64]

    def where(self, mask: Mask) -> Displacements:
        """The rows of a mask (M,)."""
        return Displacements(*(getattr(self, field.name)[mask] for field in fields(self)))


def find_reference_frames(observations: Observations) -> Mask:
    """(F,): the frames that displacements are measured against: each session's REFERENCE frames; in a session that has
    none the last frames of its first warm-up, so that a recorded warm-up can be learned from by itself."""
    found = observations.of(Role.REFERENCE)
    warm_up = np.flatnonzero(observations.of(Role.WARM_UP))
    for index in range(len(observations.sessions)):
        own = warm_up[observations.session[warm_up] == index]
        if len(own) and not found[observations.session == index].any():
            first = [frame for frame in own.tolist() if observations.step_id[frame] == observations.step_id[own[0]]]
            found[first[-_ANCHOR_FRAMES:]] = True
    return found


def average_reference_centres(observations: Observations, frames: Mask | None = None) -> tuple[Float, Float]:
    """Average the centres (S, N, 2), with their variance (S, N, 2), over each session's own `frames` (F,), by default
    its REFERENCE frames; NaN without any.

    Each session has a reference of its own: between sessions the target may have been moved.
    """
    shape = (len(observations.sessions), observations.target.count, 2)
    centres, variance = np.full(shape, np.nan), np.full(shape, np.nan)
    frames = observations.of(Role.REFERENCE) if frames is None else frames
    for index in range(len(observations.sessions)):
        own = frames & (observations.session == index)
        measured = observations.centres_px[own]
        count = np.isfinite(measured).sum(axis=0)
        seen = count > 0
        centres[index][seen] = np.nansum(measured, axis=0)[seen] / count[seen]
        variance[index][seen] = np.nansum(_get_variance_px2(observations)[own], axis=0)[seen] / count[seen] ** 2
    return centres, variance


def compute_displacements(observations: Observations, frames: Mask, against: Mask | None = None) -> Displacements:
    """The measured centres of `frames` (F,) against the references of their sessions, the mean of the frames `against`
    (F,), by default the REFERENCE frames; markers without either are left out. SessionError when a session of these
    frames has no reference frames."""
    centres, variance = average_reference_centres(observations, against)
    for index in np.unique(observations.session[frames]):
        if not np.isfinite(centres[index]).any():
            name = observations.sessions[index].session_id
            raise SessionError(f"session {name} has no usable reference frames to measure the drift against")
    return compute_displacements_from(
        observations, frames, centres[observations.session], variance[observations.session]
    )


def compute_displacements_from(
    observations: Observations, frames: Mask, reference_px: Float, reference_px2: Float | float = 0.0
) -> Displacements:
    """The measured centres of `frames` (F,) against references, (F, N, 2) or (N, 2) for all, and their variances;
    markers without either are left out."""
    displacement = reference_px - observations.centres_px
    frame, marker = np.nonzero(frames[:, None] & np.isfinite(displacement).all(axis=2))
    variance = _get_variance_px2(observations) + reference_px2
    return Displacements(
        measured_px=observations.centres_px[frame, marker],
        displacement_px=displacement[frame, marker],
        variance_px2=variance[frame, marker],
        camera_degC=observations.camera_degC[frame],
        chamber_degC=observations.chamber_degC[frame],
        frame=frame,
        marker=marker,
    )


def _get_variance_px2(observations: Observations) -> Float:
    """(F, N, 2): the diagonals of the covariances."""
    return np.diagonal(observations.covariance_px2, axis1=2, axis2=3)
