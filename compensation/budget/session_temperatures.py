"""The five thermometers of a recorded session, where frames were taken."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thermostand.compensation.budget.geometry import StandTemperatures
from thermostand.foundation.errors import SessionError
from thermostand.foundation.items import StepState
from thermostand.recording.reading.interpolation import interpolated
from thermostand.recording.reading.session import Session

_SENSORS = tuple(name.removesuffix("_degC") for name in StandTemperatures.__dataclass_fields__)


@dataclass(frozen=True, slots=True)
class CaptureState:
    """A capture step of the session and the stand in the middle of it. role: reference, fit, pose ..., or empty."""

    step_id: str
    role: str
    chamber_degC: float
    start_ns: int
    end_ns: int
    state: StandTemperatures


def states_at(session: Session, times_ns: NDArray[np.int64]) -> list[StandTemperatures]:
    """The thermometers at each instant; NaN where one was BAD or silent for more than two minutes.

    SessionError when the session has no such thermometer.
    """
    columns = [interpolated(*session.readings(f"thermometers.{sensor}"), times_ns) for sensor in _SENSORS]
    return [StandTemperatures(*map(float, row)) for row in np.stack(columns, axis=1)]


def mean_state(states: Sequence[StandTemperatures]) -> StandTemperatures:
    """The mean of each thermometer over the states that know it; NaN when none does."""
    table = np.array([[getattr(state, f"{sensor}_degC") for sensor in _SENSORS] for state in states])
    known = np.isfinite(table)
    counts = np.maximum(known.sum(axis=0), 1)
    means = np.where(known.any(axis=0), np.where(known, table, 0.0).sum(axis=0) / counts, math.nan)
    return StandTemperatures(*map(float, means))


def capture_states(session: Session) -> list[CaptureState]:
    """Every capture that was completed, in order; SessionError when there is none."""
    started = {mark.step_id: mark for mark in session.steps() if mark.kind == "capture" and mark.state == "started"}
    ended = {mark.step_id: mark.time_ns for mark in session.steps() if mark.state == StepState.DONE}
    marks = [mark for mark in started.values() if mark.step_id in ended]
    if not marks:
        raise SessionError(f"{session.path}: no capture was completed, so there is no state of the stand to judge")
    middles = np.array([(mark.time_ns + ended[mark.step_id]) // 2 for mark in marks], np.int64)
    found: list[CaptureState] = []
    for mark, state in zip(marks, states_at(session, middles), strict=True):
        chamber = mark.parameters.get("chamber_degC")
        chamber_degC = float(chamber) if isinstance(chamber, int | float) else math.nan
        role = str(mark.parameters.get("role") or "")
        found.append(CaptureState(mark.step_id, role, chamber_degC, mark.time_ns, ended[mark.step_id], state))
    return found
