"""The next visit of a night that decides, or its end: I-optimal design over the wanted temperatures.

I-optimal: the next visits are those after which the drift model's variance, averaged over the states in which it is
wanted, is least. A slow part of a camera shows only on a long way in one direction, so whole courses of some hours
are compared, and of the best one the first visit is made; then the model is fitted again.

Pure: what was observed goes in, a decision comes out, the same for the same observations.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from thermostand.compensation.design.courses import Known, best_course
from thermostand.compensation.design.forecast import Situation, now, surroundings
from thermostand.compensation.design.wanted_states import wanted_states
from thermostand.compensation.drift.candidates import FEWEST_BETWEEN
from thermostand.compensation.drift.terms import features
from thermostand.compensation.drift.thermal_learning import fit_thermal
from thermostand.compensation.drift.thermal_model import ThermalModel
from thermostand.compensation.history.states import Float
from thermostand.compensation.observations import Observations
from thermostand.experiments.steps import WANTED_STATES, Role, WantedState
from thermostand.foundation.errors import SessionError

_GRID = 13
_APART_K = 1.0
"""From a held-out temperature: nearer ones would show it to the fitter."""
_UNCHECKED = "what the model leaves between set-points is seen at three of them"


@dataclass(frozen=True, slots=True)
class Wanted:
    """What a night is for, and within what it decides. range_degC: set-points at which the model is wanted; none
    outside is chosen, nor one of held_out_degC. residual_px: the predicted residual with which the night is content.
    dwells_s: to choose from. ramp_K_per_min: of the chamber, at most. states: in which the model is wanted there, see
    wanted_states.py."""

    range_degC: tuple[float, float]
    residual_px: float
    held_out_degC: tuple[float, ...] = ()
    dwells_s: tuple[float, ...] = (900.0, 1500.0, 2700.0)
    ramp_K_per_min: float = 2.0
    states: tuple[WantedState, ...] = WANTED_STATES


@dataclass(frozen=True, slots=True)
class Decision:
    """kind: "visit" or "enough". chamber_degC, dwell_s: of the visit. predicted_px: the residual that the model
    predicts over the wanted states, RMS of a coordinate, NaN where that was not asked. reason: in words."""

    kind: Literal["visit", "enough"]
    chamber_degC: float
    dwell_s: float
    predicted_px: float
    reason: str


def decide(observations: Observations, wanted: Wanted) -> Decision:
    """What to do next. While no model can be fitted, the temperature that is furthest from those visited."""
    grid = _grid(wanted)
    try:
        model = fit_thermal(observations)
        around = surroundings(observations, wanted.ramp_K_per_min)
    except SessionError as error:
        return _furthest(observations, wanted, grid, f"no model yet ({error})")
    asked = wanted_states(around, model.memory, wanted.range_degC, wanted.states)
    predicted_px = predicted_residual_px(model, asked)
    if predicted_px <= wanted.residual_px:
        reason = f"the residual is predicted at {1e3 * predicted_px:.1f} mpx, {1e3 * wanted.residual_px:g} are wanted"
        return Decision("enough", math.nan, 0.0, predicted_px, reason)
    if _few_between(observations) and _without_discrepancy_px(model, asked) <= wanted.residual_px:
        return _furthest(observations, wanted, grid, _UNCHECKED)
    known = Known(
        model.leverage_matrix,
        float(model.discrepancy_px @ model.discrepancy_px),
        _features(model, asked),
        lambda situation: _features(model, situation),
    )
    seed = int(observations.time_ns[-1] % (1 << 32))
    course = best_course(known, now(observations, model.memory), around, grid, wanted.dwells_s, seed)
    reason = (
        f"the residual is predicted at {1e3 * predicted_px:.1f} mpx; {course.chamber_degC:g} degC for "
        f"{course.dwell_s / 60:g} min begins the course that lowers it most"
    )
    return Decision("visit", course.chamber_degC, course.dwell_s, predicted_px, reason)


def predicted_residual_px(model: ThermalModel, asked: Situation) -> float:
    """RMS of a coordinate over these situations and the outline of the markers, within the night."""
    hull_px = model.facts.hull_px
    situations, places = len(asked.air_degC), len(hull_px)
    states = asked.states.where(np.repeat(np.arange(situations), places))
    own = model.of_sessions(model.facts.session_ids)
    covariance = own.covariance(np.tile(hull_px, (situations, 1)), states)
    return float(np.sqrt(np.trace(covariance, axis1=1, axis2=2).mean() / 2))


def _grid(wanted: Wanted) -> Float:
    """Set-points to choose from; SessionError never: the ends stay when all is held out."""
    grid = np.linspace(*wanted.range_degC, _GRID)
    held_out = np.array(wanted.held_out_degC)
    near = np.abs(grid[:, None] - held_out).min(axis=1, initial=np.inf)
    return np.round(grid[near >= _APART_K] if (near >= _APART_K).any() else grid[[0, -1]], 1)


def _few_between(observations: Observations) -> bool:
    """Whether too few set-points lie between others for what the model leaves at such ones."""
    return len(_seen_degC(observations)) - 2 < FEWEST_BETWEEN


def _without_discrepancy_px(model: ThermalModel, asked: Situation) -> float:
    return predicted_residual_px(replace(model, discrepancy_px=np.zeros(2)), asked)


def _seen_degC(observations: Observations) -> Float:
    """The set-points that a fit knows, each once."""
    return np.unique(observations.chamber_degC[observations.of(Role.REFERENCE, Role.FIT)])


def _furthest(observations: Observations, wanted: Wanted, grid: Float, why: str) -> Decision:
    seen = _seen_degC(observations)
    distance_K = np.abs(grid[:, None] - seen).min(axis=1, initial=np.inf)
    degC, dwell_s = float(grid[np.argmax(distance_K)]), max(wanted.dwells_s)
    return Decision("visit", degC, dwell_s, math.nan, f"{why}; {degC:g} degC is furthest from the others")


def _features(model: ThermalModel, situation: Situation) -> Float:
    found = features(situation.states, [term.feature for term in model.terms], model.origin)
    return found - model.reference_features
