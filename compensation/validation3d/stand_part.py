"""The stand's own part in the images of the validation positions, each at its own distance.

The granite carries a target at every position alike, but the further away it is, the less of that is seen. A drift
model fitted at one distance therefore takes out a little too much or too little at the others.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from compensation.budget.correction import stand_correction
from compensation.budget.geometry import Geometry, Quantity, StandState
from compensation.budget.states import mean_state, states_at
from compensation.observations import Float, Observations
from compensation.validation3d.positions import ValidationFrames
from drivers.interface import SessionError
from stand.recording.session import Session


@dataclass(frozen=True, slots=True, eq=False)
class StandPart:
    """What the stand has done to each centre since the reference temperature, px; (F, N, 2), NaN in other frames.

    here: with the target where it is. at_fit: with it at geometry.distance_mm, where the drift was measured.
    """

    here: Float
    at_fit: Float


def stand_part(
    session: Session, observations: Observations, frames: ValidationFrames, geometry: Geometry, distances_mm: Float
) -> StandPart:
    """distances_mm (P,): of the target's middle from the lens at each position.

    SessionError when one of the five thermometers was silent.
    """
    used = frames.used
    states = dict(zip(used.tolist(), states_at(session, observations.time_ns[used]), strict=True))
    reference = mean_state([states[index] for row in frames.frames[0] for index in row.tolist()])
    here, at_fit = (np.full(observations.centres_px.shape, np.nan) for _ in range(2))
    there = [geometry.model_copy(update={"distance_mm": _moved(geometry, z_mm)}) for z_mm in distances_mm.tolist()]
    for row in frames.frames:
        for stand, indices in zip([*there, there[0]], row, strict=True):
            for index in indices.tolist():
                centres = observations.centres_px[index]
                here[index] = _displacement_px(session, states[index], reference, stand, centres)
                at_fit[index] = _displacement_px(session, states[index], reference, geometry, centres)
    return StandPart(here, at_fit)


def _moved(geometry: Geometry, distance_mm: float) -> Quantity:
    return Quantity(value=distance_mm, u=geometry.distance_mm.u)


def _displacement_px(
    session: Session, state: StandState, reference: StandState, geometry: Geometry, centres_px: Float
) -> Float:
    try:
        return stand_correction(state, reference, geometry).displacement_px(centres_px)
    except ValueError as error:
        raise SessionError(f"{session.path}: {error}") from error
