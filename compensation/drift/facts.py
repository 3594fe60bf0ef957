"""What a drift model was fitted to, and where it holds: the same for every form."""

from __future__ import annotations

import importlib.metadata
from dataclasses import dataclass

import numpy as np

from thermostand.compensation.drift.bump import Bump
from thermostand.compensation.drift.candidates import Pair
from thermostand.compensation.drift.displacements import Displacements, reference_centres
from thermostand.compensation.drift.hull import convex_hull, is_area
from thermostand.compensation.history.states import Float
from thermostand.compensation.observations import Observations
from thermostand.experiments.steps import Role
from thermostand.foundation.errors import SessionError


@dataclass(frozen=True, slots=True, eq=False)
class ModelFacts:
    """image_size: (width, height), px. camera_range_degC: the calibrated interval of the camera's temperature. hull_px
    (H, 2): convex hull of the training markers. reference_degC: the camera's temperature at the reference,
    reference_chamber_degC the set-point. reference_centres_px (N, 2): of the first session with reference frames, NaN
    for a marker never seen. software_version: what it was fitted by. bumps: steps of the image that it was
    fitted around."""

    image_size: tuple[int, int]
    camera_range_degC: Pair
    hull_px: Float
    reference_degC: float
    reference_chamber_degC: float
    reference_centres_px: Float
    target_name: str
    camera_serial: str
    session_ids: tuple[str, ...]
    software_version: str
    bumps: tuple[Bump, ...] = ()


def facts_of(
    observations: Observations, rows: Displacements, camera_range_degC: Pair, reference_degC: float
) -> ModelFacts:
    """Of a model fitted to the set-point `rows` of these observations; SessionError when the markers lie in one line,
    or the sessions have different reference temperatures."""
    hull_px = convex_hull(rows.measured_px)
    if not is_area(hull_px):
        raise SessionError("the markers lie in one line; a model of the image needs an area of them")
    reference = observations.of(Role.REFERENCE)
    return ModelFacts(
        image_size=observations.image_size,
        camera_range_degC=camera_range_degC,
        hull_px=hull_px,
        reference_degC=reference_degC,
        reference_chamber_degC=_reference_chamber_degC(observations),
        reference_centres_px=reference_centres(observations)[0][observations.session[reference][0]],
        target_name=observations.target.name,
        camera_serial=observations.sessions[0].camera_serial,
        session_ids=tuple(session.session_id for session in observations.sessions),
        software_version=importlib.metadata.version("thermostand"),
    )


def _reference_chamber_degC(observations: Observations) -> float:
    """The set-point of the reference frames; displacements from two different ones cannot be mixed."""
    set_points = np.unique(observations.chamber_degC[observations.of(Role.REFERENCE)])
    if len(set_points) != 1:
        listed = ", ".join(f"{value:g}" for value in set_points)
        raise SessionError(f"the sessions have different reference temperatures: {listed} degC")
    return float(set_points[0])
