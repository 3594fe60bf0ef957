"""The stand's own motion, by its thermometers and its geometry, taken out of the centres before anything is certified.

What corrects is uncertain: each length, coefficient and thermometer is varied by its standard uncertainty in all that
it enters at once, so that what enters several terms counts with its correlation (JCGM 100, 5.2).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from thermostand.compensation.budget.budget import (
    average_states,
    compute_displacement_px,
    read_stand_states,
    vary_inputs,
)
from thermostand.compensation.budget.geometry import Geometry, ThermometerState
from thermostand.compensation.datasheet.datasheet import (
    MOTIONS,
    UNITS,
    Contribution,
    Datasheet,
    Visits,
    fit_curve,
    fit_similarity,
)
from thermostand.compensation.drift.displacements import average_reference_centres
from thermostand.compensation.observations import Float, Observations
from thermostand.experiments.steps import Role
from thermostand.foundation.errors import ConfigError, SessionError
from thermostand.recording.reading.session import Session

SOURCE = "correction of the stand's motion"


@dataclass(frozen=True, slots=True, eq=False)
class StandCorrection:
    """observations: with corrected centres; frames at which a thermometer was silent cannot be used. states: of all
    frames (F). references: of each session."""

    observations: Observations
    geometry: Geometry
    states: Sequence[ThermometerState]
    references: Sequence[ThermometerState]


def correct_for_stand(sessions: Sequence[Session], observations: Observations, geometry: Geometry) -> StandCorrection:
    """SessionError when a session has no such thermometers, or no reference at which they all were alive; ConfigError
    for the geometry of another camera."""
    if geometry.image_px != observations.image_size:
        raise ConfigError(
            f"geometry {geometry.name}: image_px is {list(geometry.image_px)}, and the sessions' frames have "
            f"{list(observations.image_size)}; give the geometry of this camera"
        )
    centres, reasons = observations.centres_px.copy(), list(observations.reasons)
    states: list[ThermometerState] = []
    references: list[ThermometerState] = []
    for index, session in enumerate(sessions):
        own = np.flatnonzero(observations.session == index)
        found = read_stand_states(session, observations.time_ns[own])
        at_rest = observations.of(Role.REFERENCE)[own]
        known = [state for state, is_one in zip(found, at_rest, strict=True) if is_one and _is_known(state)]
        if not known:
            raise SessionError(
                f"{session.path}: the stand's five thermometers were not all alive in any reference frame; its motion "
                "cannot be taken out; with `geometry: none` in the order it stays in"
            )
        reference = average_states(known)
        for row, state in zip(own.tolist(), found, strict=True):
            if _is_known(state):
                centres[row] -= compute_displacement_px(state, reference, geometry, centres[row])
            elif not reasons[row]:
                centres[row], reasons[row] = math.nan, "a thermometer of the stand was silent"
        states += found
        references.append(reference)
    corrected = replace(observations, centres_px=centres, reasons=tuple(reasons))
    return StandCorrection(corrected, geometry, states, references)


def add_stand_uncertainty(sheet: Datasheet, correction: StandCorrection) -> Datasheet:
    """The datasheet with what the correction adds to the uncertainty of each temperature coefficient."""
    added = _compute_slope_uncertainty(correction, sheet.visits[0])
    basis = "granite, post, target, air and thermometers, each varied in all that it enters"
    lines = {
        f"{motion}_per_K": Contribution(SOURCE, "B", u, f"{unit}/K", basis)
        for motion, unit, u in zip(MOTIONS, UNITS, added.tolist(), strict=True)
    }
    quantities = tuple(
        replace(one, contributions=(*one.contributions, lines[one.key]))
        if one.key in lines and not math.isnan(one.value)
        else one
        for one in sheet.quantities
    )
    return replace(sheet, quantities=quantities)


def _compute_slope_uncertainty(correction: StandCorrection, visits: Visits) -> Float:
    """(4,): of MOTIONS, per K of the air. A thermometer may be wrong at both ends of the range, each by its own."""
    observations, geometry = correction.observations, correction.geometry
    places = average_reference_centres(observations)[0][0]
    rows = np.searchsorted(observations.time_ns[observations.session == 0], visits.time_ns)
    away = (visits.air_degC - visits.air_degC[0]) / np.ptp(visits.air_degC) * math.sqrt(2)
    varied = np.array(
        [
            [
                _compute_motions(*inputs, correction.references[0], places)
                for inputs in [(correction.states[row], geometry), *vary_inputs(correction.states[row], geometry)]
            ]
            for row in rows.tolist()
        ]
    )
    off = varied[:, 1:] - varied[:, :1]
    off[:, -len(ThermometerState.__dataclass_fields__) :] *= away[:, None, None]
    slopes = np.zeros((off.shape[1], len(MOTIONS)))
    for number in range(off.shape[1]):
        shown = replace(visits, moved=off[:, number])
        slopes[number] = [curve.slope if (curve := fit_curve(shown, motion)) else 0.0 for motion in range(len(MOTIONS))]
    return np.sqrt((slopes**2).sum(axis=0))


def _compute_motions(state: ThermometerState, geometry: Geometry, reference: ThermometerState, places: Float) -> Float:
    """(4,): of the image by the stand."""
    moved = compute_displacement_px(state, reference, geometry, places)
    middle = (np.array(geometry.image_px) - 1) / 2
    return fit_similarity(places, moved, middle)


def _is_known(state: ThermometerState) -> bool:
    values: NDArray[np.float64] = np.array([getattr(state, name) for name in ThermometerState.__dataclass_fields__])
    return bool(np.isfinite(values).all())
