"""The stand's own part in the images of the validation positions, each at its own distance.

The granite carries a target at every position alike, but the further away it is, the less of that is seen. A drift
model fitted at one distance therefore takes out a little too much or too little at the others.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from thermostand.compensation.budget.correction import displacement_px, varied
from thermostand.compensation.budget.geometry import Geometry, Quantity, StandTemperatures
from thermostand.compensation.budget.session_temperatures import mean_state, states_at
from thermostand.compensation.observations import Float, Observations
from thermostand.compensation.validation3d.validation_frames import ValidationFrames
from thermostand.foundation.errors import SessionError
from thermostand.recording.reading.session import Session


@dataclass(frozen=True, slots=True, eq=False)
class StandPart:
    """What the stand has done to each centre since the reference temperature, px; NaN in frames that are not used.

    here (F, N, 2): with the target where it is. excess (F, N, 2): that minus what it does to a target at
    geometry.distance_mm, where the drift was measured. here_errors, excess_errors (V, F, N, 2): how much they change
    when one of V uncertain inputs is larger by its standard uncertainty.
    """

    here: Float
    excess: Float
    here_errors: Float
    excess_errors: Float


def stand_part(
    session: Session, observations: Observations, frames: ValidationFrames, geometry: Geometry, distances_mm: Float
) -> StandPart:
    """distances_mm (P,): of the target's middle from the lens at each position.

    SessionError when one of the five thermometers was silent.
    """
    used = frames.used
    states = dict(zip(used.tolist(), states_at(session, observations.time_ns[used]), strict=True))
    reference = mean_state([states[index] for row in frames.frames[0] for index in row.tolist()])
    _check_known(session, [reference, *states.values()])
    at = [geometry.model_copy(update={"distance_mm": _moved(geometry, z_mm)}) for z_mm in distances_mm.tolist()]
    inputs = 1 + sum(1 for _ in varied(reference, geometry))
    here, at_fit = (np.full((inputs, *observations.centres_px.shape), np.nan) for _ in range(2))
    for row in frames.frames:
        for stand, indices in zip([*at, at[0]], row, strict=True):
            for index in indices.tolist():
                centres = observations.centres_px[index]
                here[:, index] = _displacements_px(states[index], reference, stand, centres)
                at_fit[:, index] = _displacements_px(states[index], reference, geometry, centres)
    excess = here - at_fit
    return StandPart(here[0], excess[0], here[1:] - here[0], excess[1:] - excess[0])


def _check_known(session: Session, states: list[StandTemperatures]) -> None:
    for name in StandTemperatures.__dataclass_fields__:
        if not all(math.isfinite(getattr(state, name)) for state in states):
            silent = name.removesuffix("_degC")
            raise SessionError(
                f"{session.path}: the thermometer {silent} was silent while poses were taken, so the stand's part "
                "cannot be computed; leave out --budget"
            )


def _moved(geometry: Geometry, distance_mm: float) -> Quantity:
    return Quantity(value=distance_mm, u=geometry.distance_mm.u)


def _displacements_px(
    state: StandTemperatures, reference: StandTemperatures, geometry: Geometry, centres_px: Float
) -> Float:
    """(1 + V, N, 2): nominal, and with each uncertain input larger in turn."""
    inputs = [(state, geometry), *varied(state, geometry)]
    return np.array([displacement_px(each, reference, stand, centres_px) for each, stand in inputs])
