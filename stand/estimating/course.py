"""The course of a plan over time, as it is expected: set-point, air, camera, and when frames are taken."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from thermostand.experiments.steps import (
    AnySoak,
    Capture,
    LABORATORY_degC,
    PowerCamera,
    SetTemperature,
    StartChamber,
    StopChamber,
)
from thermostand.stand.config.stand_config import StandConfig
from thermostand.stand.estimating.chamber_model import ChamberModel
from thermostand.stand.estimating.run_estimate import PlanEstimate

_STEP_s = 20.0  # a third of the shortest default dead time; half of it changes no curve by a line's width
_MOST_POINTS = 600  # one for each two pixels of a wide screen
_MOST_INTEGRATED = 40_000  # 9 days of 20 s; longer plans are integrated in longer steps


@dataclass(frozen=True, slots=True)
class PlannedCapture:
    """Frames of one capture. at_s: its beginning after that of the plan; step: its index in the plan."""

    step: int
    at_s: float
    duration_s: float
    chamber_degC: float | None
    role: str
    frames: int


@dataclass(frozen=True, slots=True)
class PlannedSoak:
    """From when to when the chamber rests at a set-point, s after the plan's beginning."""

    step: int
    from_s: float
    to_s: float


@dataclass(frozen=True, slots=True)
class Course:
    """Temperatures by time, degC; None while they are not known.

    times_s: ascending, from the plan's beginning. set_point_degC, air_degC, camera_degC: as long as times_s. The air
    is not known before the chamber is started and after it was stopped; the camera is that of the model, which has
    one time constant (and, once recorded runs have shown it, how much warmer than the air a camera is that is on).
    """

    times_s: list[float]
    set_point_degC: list[float | None]
    air_degC: list[float | None]
    camera_degC: list[float | None]
    captures: list[PlannedCapture]
    soaks: list[PlannedSoak]


def predict_course(estimate: PlanEstimate, config: StandConfig, chamber: ChamberModel) -> Course:
    """Predict the course of a plan by the chamber's model; each step takes what the estimate says."""
    spans, captures, soaks = _list_spans(estimate, config)
    grid_s = max(_STEP_s, spans[-1].to_s / _MOST_INTEGRATED) if spans else _STEP_s
    course = Course([], [], [], [], captures, soaks)
    air = camera = LABORATORY_degC
    if spans and spans[0].camera_on:
        camera += chamber.camera_above_air_K
    way = _Way(chamber, config.set_point_K_per_min / 60.0)
    for span in spans:
        count = max(1, math.ceil((span.to_s - span.from_s) / grid_s))
        dt_s = (span.to_s - span.from_s) / count
        for n in range(count + 1):
            if n:
                air = way.follow(air, span, n * dt_s, dt_s)
                above_K = chamber.camera_above_air_K if span.camera_on else 0.0
                camera += (air + above_K - camera) * -math.expm1(-dt_s / chamber.camera_time_constant_s)
            known = span.set_point_degC is not None
            course.times_s.append(span.from_s + n * dt_s)
            course.set_point_degC.append(span.set_point_degC)
            course.air_degC.append(round(air, 2) if known else None)
            course.camera_degC.append(round(camera, 2) if known else None)
    return _thin(course)


@dataclass(frozen=True, slots=True)
class _Span:
    """A time with one set-point (None: the chamber is stopped) and the camera's supply on or off."""

    from_s: float
    to_s: float
    set_point_degC: float | None
    camera_on: bool


class _Way:
    """The air on its way: the equation of stand/estimating/chamber_model.py, solved exactly within each time step."""

    def __init__(self, chamber: ChamberModel, set_point_K_per_s: float) -> None:
        self._chamber = chamber
        self._most_K_per_s = set_point_K_per_s
        self._target_degC: float | None = None
        self._since_s = 0.0

    def follow(self, air_degC: float, span: _Span, into_s: float, dt_s: float) -> float:
        """The air a time step later; the stopped chamber keeps its temperature, about which nothing is stated."""
        if (to_degC := span.set_point_degC) is None:
            return air_degC
        if to_degC != self._target_degC:
            self._target_degC, self._since_s = to_degC, span.from_s
        response = self._chamber.heating if to_degC > air_degC else self._chamber.cooling
        if span.from_s + into_s - self._since_s <= response.dead_s:
            return air_degC
        most_K = min(response.rate_K_per_s, self._most_K_per_s) * dt_s
        change_K = (to_degC - air_degC) * -math.expm1(-dt_s / response.time_constant_s)
        return air_degC + min(max(change_K, -most_K), most_K)


def _list_spans(
    estimate: PlanEstimate, config: StandConfig
) -> tuple[list[_Span], list[PlannedCapture], list[PlannedSoak]]:
    at_s, set_point_degC, camera_on = 0.0, None, True
    spans, captures, soaks = list[_Span](), list[PlannedCapture](), list[PlannedSoak]()
    for priced in estimate.steps:
        step, index, end_s = priced.planned.step, priced.planned.index, at_s + priced.duration_s
        if isinstance(step, StartChamber | SetTemperature):
            set_point_degC = step.chamber_degC
        elif isinstance(step, StopChamber):
            set_point_degC = None
        elif isinstance(step, PowerCamera):
            camera_on = step.on
        elif isinstance(step, Capture):
            captures.append(
                PlannedCapture(index, at_s, priced.duration_s, step.chamber_degC, step.role.value, priced.frames)
            )
        elif isinstance(step, AnySoak):
            soaks.append(PlannedSoak(index, at_s, end_s))
        last = spans[-1] if spans else None
        if last is not None and (last.set_point_degC, last.camera_on) == (set_point_degC, camera_on):
            spans[-1] = _Span(last.from_s, end_s, set_point_degC, camera_on)
        elif end_s > at_s:
            spans.append(_Span(at_s, end_s, set_point_degC, camera_on))
        at_s = end_s
    if estimate.after_s:
        spans.append(_Span(at_s, at_s + estimate.after_s, config.ending.ambient_degC, camera_on))
    return spans, captures, soaks


def _thin(course: Course) -> Course:
    """Choose at most some hundred points, those where the set-point changes among them."""
    count = len(course.times_s)
    every = max(1, math.ceil(count / _MOST_POINTS))
    points = course.set_point_degC
    kept = [
        n
        for n in range(count)
        if n % every == 0 or n == count - 1 or points[n] != points[n - 1] or points[n] != points[n + 1]
    ]

    def pick(values: Sequence[float | None]) -> list[float | None]:
        return [values[n] for n in kept]

    times_s = [round(course.times_s[n], 1) for n in kept]
    columns = (pick(course.set_point_degC), pick(course.air_degC), pick(course.camera_degC))
    return Course(times_s, *columns, course.captures, course.soaks)
