"""What a drift model was fitted to, and where it holds: the same for every form."""

from __future__ import annotations

import importlib.metadata
import math
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from pydantic import Field

from thermostand.compensation.drift.candidates import Pair
from thermostand.compensation.drift.displacements import Displacements, average_reference_centres
from thermostand.compensation.drift.hull import compute_convex_hull, is_area
from thermostand.compensation.history.thermal_history import Float
from thermostand.compensation.observations import Observations
from thermostand.experiments.steps import Role
from thermostand.foundation.documents import Document
from thermostand.foundation.errors import SessionError

# A step of the image in a session: what is recorded of one that was found.

MOTIONS = 4  # shift along I and J, turn, scale


class Bump(Document):
    """A step between two frames of a session: after_ns is the last one before it, before_ns the first one after it.

    motions_px (4,): shift along I and J, turn and scale, each in px at half the image's width from its centre,
    sigma_px (4,) their standard uncertainties. marker: the one that moved, from 0; None when the whole image did.
    """

    session_id: str
    after_ns: int
    before_ns: int
    motions_px: Annotated[tuple[float, ...], Field(min_length=MOTIONS, max_length=MOTIONS)]
    sigma_px: Annotated[tuple[float, ...], Field(min_length=MOTIONS, max_length=MOTIONS)]
    marker: int | None = None

    @property
    def size_px(self) -> float:
        """How far the image's middle moved, or what turns and scales did at its edge."""
        return max(math.hypot(*self.motions_px[:2]), *(abs(one) for one in self.motions_px[2:]))

    @property
    def text(self) -> str:
        """The bump in a sentence without its time: which part moved, and how far."""
        if self.marker is not None:
            who = f"marker {self.marker} moved"
        else:
            who = "the image moved"
        i, j = (
            f"{1e3 * value:+.0f} ({1e3 * sigma:.0f})"
            for value, sigma in zip(self.motions_px[:2], self.sigma_px[:2], strict=True)
        )
        turned = (
            ""
            if self.marker is not None
            else "; turned and scaled by {:+.0f} and {:+.0f} mpx at its edge".format(
                *(1e3 * value for value in self.motions_px[2:])
            )
        )
        return f"{who} by {i} mpx along I and {j} along J (standard uncertainty){turned}"


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


def collect_facts(
    observations: Observations, rows: Displacements, camera_range_degC: Pair, reference_degC: float
) -> ModelFacts:
    """Collect the facts of a model fitted to the set-point `rows` of these observations; SessionError when the markers
    lie in one line, or the sessions have different reference temperatures."""
    hull_px = compute_convex_hull(rows.measured_px)
    if not is_area(hull_px):
        raise SessionError("the markers lie in one line; a model of the image needs an area of them")
    reference = observations.of(Role.REFERENCE)
    return ModelFacts(
        image_size=observations.image_size,
        camera_range_degC=camera_range_degC,
        hull_px=hull_px,
        reference_degC=reference_degC,
        reference_chamber_degC=_find_reference_chamber_degC(observations),
        reference_centres_px=average_reference_centres(observations)[0][observations.session[reference][0]],
        target_name=observations.target.name,
        camera_serial=observations.sessions[0].camera_serial,
        session_ids=tuple(session.session_id for session in observations.sessions),
        software_version=importlib.metadata.version("thermostand"),
    )


def _find_reference_chamber_degC(observations: Observations) -> float:
    """The set-point of the reference frames; displacements from two different ones cannot be mixed."""
    set_points = np.unique(observations.chamber_degC[observations.of(Role.REFERENCE)])
    if len(set_points) != 1:
        listed = ", ".join(f"{value:g}" for value in set_points)
        raise SessionError(f"the sessions have different reference temperatures: {listed} degC")
    return float(set_points[0])
