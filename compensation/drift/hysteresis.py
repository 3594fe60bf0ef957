"""How much a camera's drift depends on the way: heating against cooling branches, closure, and repeatability.

A visit is a set-point with its frames; its branch is the side from which it was reached. All figures are of the mean
over the markers seen in both visits, along I and J, px. Lag and hysteresis both open the branches; a set-point with a
doubled dwell separates them: lag shrinks, hysteresis does not.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations, groupby

import numpy as np
from numpy.typing import NDArray

from thermostand.compensation.drift.bumps import correct_bumps
from thermostand.compensation.drift.displacements import compute_displacements
from thermostand.compensation.drift.drift_model import DriftModel
from thermostand.compensation.drift.training_data import compute_frame_states
from thermostand.compensation.history.thermal_history import Float
from thermostand.compensation.observations import Mask, Observations
from thermostand.experiments.steps import Role

_CYCLE = (Role.REFERENCE, Role.FIT, Role.VALIDATION)


@dataclass(frozen=True, slots=True, eq=False)
class BranchDifference:
    """Heating minus cooling branch at one set-point: difference_px and its standard uncertainty, each (I, J); rms_px:
    over the markers, of both coordinates' difference."""

    chamber_degC: float
    difference_px: Float
    uncertainty_px: Float
    rms_px: float


@dataclass(frozen=True, slots=True, eq=False)
class Hysteresis:
    """The hysteresis of one session. range_px (2,): of the whole drift. largest_px, rms_px (2,): of the gaps along I
    and J, NaN without any. area_px_K (2,): the integral of the absolute gap over the set-points, 0 with fewer than two.
    closure_px (2,): last visit of the reference set-point minus the first, NaN when there was only one.
    repeatability_px (2,): standard deviation of visits of the same set-point from the same side, NaN when none was
    repeated. gaps: of each set-point that was reached from below and from above."""

    session_id: str
    range_px: Float
    largest_px: Float
    rms_px: Float
    area_px_K: Float
    closure_px: Float
    repeatability_px: Float
    gaps: tuple[BranchDifference, ...]


@dataclass(frozen=True, slots=True, eq=False)
class _Visit:
    """Mean place relative to the reference of each marker (N, 2) and its variance; NaN for one not seen. from_below:
    None for the first visit, which came from nowhere."""

    chamber_degC: float
    from_below: bool | None
    place_px: Float
    variance_px2: Float


def compute_hysteresis(observations: Observations, model: DriftModel | None = None) -> tuple[Hysteresis, ...]:
    """Compute hysteresis in each session that has reference frames, with `model` after compensation, else before."""
    if model is not None:
        observations = correct_bumps(observations, model.facts.bumps)
    found: list[Hysteresis] = []
    for index, facts in enumerate(observations.sessions):
        own = observations.of(*_CYCLE) & (observations.session == index)
        if (own & observations.of(Role.REFERENCE)).any():
            found.append(_compute_session_hysteresis(facts.session_id, _collect_visits(observations, own, model)))
    return tuple(found)


def _collect_visits(observations: Observations, own: Mask, model: DriftModel | None) -> list[_Visit]:
    """Collect the visits in order of time; frames of one set-point that follow each other are a visit."""
    rows = compute_displacements(observations, own)
    place = -rows.displacement_px
    if model is not None:
        states = compute_frame_states(observations, model.memory)
        place = place + model.shift(rows.measured_px, states.where(rows.frame))
    shape = (len(observations.frame), observations.target.count, 2)
    of_frame, variance = np.full(shape, np.nan), np.full(shape, np.nan)
    of_frame[rows.frame, rows.marker], variance[rows.frame, rows.marker] = place, rows.variance_px2
    visits: list[_Visit] = []
    for chamber_degC, group in groupby(np.flatnonzero(own).tolist(), key=lambda k: float(observations.chamber_degC[k])):
        frames = np.array(list(group))
        before = visits[-1].chamber_degC if visits else None
        mean, uncertain = _average_frames(of_frame[frames], variance[frames])
        visits.append(_Visit(chamber_degC, None if before is None else chamber_degC > before, mean, uncertain))
    return visits


def _average_frames(values: Float, variance: Float) -> tuple[Float, Float]:
    """Average a marker's centres over the frames that have it."""
    count = np.isfinite(values).sum(axis=0)
    safe = np.maximum(count, 1)
    mean = np.where(count > 0, np.nansum(values, axis=0) / safe, np.nan)
    return mean, np.where(count > 0, np.nansum(variance, axis=0) / safe**2, np.nan)


def _compute_session_hysteresis(session_id: str, visits: list[_Visit]) -> Hysteresis:
    centres = np.array([np.nanmean(visit.place_px, axis=0) for visit in visits])
    reference = [visit for visit in visits if visit.chamber_degC == visits[0].chamber_degC]
    closure = reference[-1].place_px - reference[0].place_px
    gaps = tuple(_compute_branch_differences(visits))
    apart_px = np.array([gap.difference_px for gap in gaps]).reshape(-1, 2)
    unknown = np.full(2, np.nan)
    return Hysteresis(
        session_id=session_id,
        range_px=np.ptp(centres, axis=0),
        largest_px=np.abs(apart_px).max(axis=0) if gaps else unknown,
        rms_px=np.sqrt((apart_px**2).mean(axis=0)) if gaps else unknown,
        area_px_K=np.asarray(np.trapezoid(np.abs(apart_px), [gap.chamber_degC for gap in gaps], axis=0)).reshape(-1),
        closure_px=np.nanmean(closure, axis=0) if len(reference) > 1 else unknown,
        repeatability_px=_compute_repeatability_px(visits),
        gaps=gaps,
    )


def _compute_branch_differences(visits: list[_Visit]) -> Iterator[BranchDifference]:
    """Compute for each set-point the mean of the visits from below minus that of the visits from above."""
    for chamber_degC in sorted({visit.chamber_degC for visit in visits}):
        sides = [
            [visit for visit in visits if visit.chamber_degC == chamber_degC and visit.from_below is side]
            for side in (True, False)
        ]
        if all(sides):
            up, down = (np.mean([visit.place_px for visit in side], axis=0) for side in sides)
            variance = sum(np.sum([visit.variance_px2 for visit in side], axis=0) / len(side) ** 2 for side in sides)
            yield _make_branch_difference(chamber_degC, up - down, np.asarray(variance))


def _make_branch_difference(chamber_degC: float, difference: Float, variance: Float) -> BranchDifference:
    seen: NDArray[np.bool_] = np.isfinite(difference[:, 0])
    return BranchDifference(
        chamber_degC=chamber_degC,
        difference_px=difference[seen].mean(axis=0),
        uncertainty_px=np.sqrt(variance[seen].sum(axis=0)) / max(int(seen.sum()), 1),
        rms_px=float(np.sqrt((difference[seen] ** 2).mean())),
    )


def _compute_repeatability_px(visits: list[_Visit]) -> Float:
    """Compute it from the differences of all pairs of visits of the same set-point from the same side."""
    pairs = [
        np.nanmean(one.place_px - other.place_px, axis=0)
        for one, other in combinations(visits, 2)
        if (one.chamber_degC, one.from_below) == (other.chamber_degC, other.from_below)
    ]
    return np.sqrt(np.mean(np.square(pairs), axis=0) / 2) if pairs else np.full(2, np.nan)
