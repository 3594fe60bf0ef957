"""Session of the validation recipe -> which frames show which validation position at which temperature."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import groupby

import numpy as np
from numpy.typing import NDArray

from thermostand.compensation.calibration.session_centres import TableVisit, place, visits_for
from thermostand.compensation.observations import Float, Observations
from thermostand.experiments.steps import Role
from thermostand.foundation.errors import SessionError
from thermostand.recording.reading.session import Session

FrameIndices = NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False)
class ValidationFrames:
    """T temperatures in order of visit, the first is the reference; P positions V0, V1, ... in order of visit there.

    linear_mm, rotary_deg (P,): where the axes stood at the reference. chamber_degC (T,): set-points. frames: T rows of
    P + 1 arrays of frame numbers, usable ones; the last is V0 again, at the end of the temperature. An array is empty
    where nothing was seen.
    """

    linear_mm: Float
    rotary_deg: Float
    chamber_degC: Float
    frames: tuple[tuple[FrameIndices, ...], ...]

    @property
    def names(self) -> tuple[str, ...]:
        """V0, V1, ..."""
        return tuple(f"V{index}" for index in range(len(self.linear_mm)))

    @property
    def used(self) -> FrameIndices:
        """All frames of all temperatures, ascending."""
        return np.sort(np.concatenate([frames for row in self.frames for frames in row]))


def validation_frames(session: Session, observations: Observations) -> ValidationFrames:
    """SessionError without two temperatures, or when a position was not seen at the first of them."""
    visits = visits_for(session.steps(), {Role.POSE, Role.REPEATABILITY})
    if not visits:
        raise SessionError(
            f"{session.path}: has no capture with the role {Role.POSE}; record one with the validation recipe"
        )
    seen = _frames_of(observations)
    rows = _temperatures(visits, seen, observations.chamber_degC)
    if len(rows) < 2:
        raise SessionError(f"{session.path}: poses were seen at {len(rows)} temperature; two are needed to compare")
    (_, reference), *_ = rows
    posed = {_sent(visits[step_id]): step_id for step_id in reversed(reference) if visits[step_id].role == Role.POSE}
    at = list(reversed(posed.values()))
    _check_seen_at_reference(session, visits, at)
    return ValidationFrames(
        linear_mm=np.array([place(session, "linear", visits[step_id]) for step_id in at]),
        rotary_deg=np.array([place(session, "rotary", visits[step_id]) for step_id in at]),
        chamber_degC=np.array([chamber_degC for chamber_degC, _ in rows]),
        frames=tuple(_row(visits, seen, steps, [_sent(visits[step_id]) for step_id in at]) for _, steps in rows),
    )


def _frames_of(observations: Observations) -> dict[str, FrameIndices]:
    """Step id -> its usable pose frames."""
    steps = np.array(observations.step_id)
    chosen = observations.of(Role.POSE, Role.REPEATABILITY)
    return {str(step_id): np.flatnonzero(chosen & (steps == step_id)) for step_id in np.unique(steps[chosen])}


def _temperatures(
    visits: dict[str, TableVisit], seen: dict[str, FrameIndices], chamber_degC: Float
) -> list[tuple[float, list[str]]]:
    """Set-point and the steps seen at it, in order; going back to a set-point is another temperature."""
    known = [step_id for step_id in visits if step_id in seen]
    return [
        (set_point, list(steps)) for set_point, steps in groupby(known, lambda step: float(chamber_degC[seen[step][0]]))
    ]


def _row(
    visits: dict[str, TableVisit], seen: dict[str, FrameIndices], steps: list[str], places: list[tuple[float, float]]
) -> tuple[FrameIndices, ...]:
    """The frames at each place, and of the return to the first."""
    found = {(_sent(visits[step_id]), visits[step_id].role): seen[step_id] for step_id in steps}
    nothing = np.empty(0, np.int64)
    posed = [found.get((there, str(Role.POSE)), nothing) for there in places]
    return (*posed, found.get((places[0], str(Role.REPEATABILITY)), nothing))


def _check_seen_at_reference(session: Session, visits: dict[str, TableVisit], at: list[str]) -> None:
    known = {_sent(visits[step_id]) for step_id in at}
    for visit in visits.values():
        if _sent(visit) not in known:
            linear_mm, rotary_deg = _sent(visit)
            raise SessionError(
                f"{session.path}: the position {linear_mm:g} mm, {rotary_deg:g} deg was not seen at the first "
                "temperature, to which all others are compared"
            )


def _sent(visit: TableVisit) -> tuple[float, float]:
    return visit.sent["linear"], visit.sent["rotary"]
