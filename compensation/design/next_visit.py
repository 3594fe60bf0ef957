"""The next visit of a night that decides, or its end: I-optimal design over the wanted temperatures.

I-optimal: the next visits are those after which the drift model's variance, averaged over the states in which it is
wanted, is least. A slow part of a camera shows only on a long way in one direction, so whole courses of some hours
are compared, and of the best one the first visit is made; then the model is fitted again.

Pure: what was observed goes in, a decision comes out, the same for the same observations.
"""

from __future__ import annotations

import math
import shutil
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Literal

import numpy as np

from thermostand.compensation.design.forecast import (
    CameraSurroundings,
    ForecastState,
    after,
    at_rest,
    now,
    surroundings,
    together,
)
from thermostand.compensation.drift.candidates import FEWEST_BETWEEN
from thermostand.compensation.drift.terms import features
from thermostand.compensation.drift.thermal_learning import fit_thermal
from thermostand.compensation.drift.thermal_model import ThermalModel
from thermostand.compensation.history.states import Float, ThermalMemory
from thermostand.compensation.history.thermal_history import recorded_history
from thermostand.compensation.observations import Observations, observe
from thermostand.experiments.steps import WANTED_STATES, Role, WantedState
from thermostand.foundation.errors import SessionError
from thermostand.recording.format.layout import FINISHED, FRAMES, TELEMETRY, UNFINISHED
from thermostand.recording.reading.session import Session
from thermostand.recording.repair.salvage import salvage_unfinished

_PLACES = 7
_AFTER_S: dict[WantedState, float] = {"at_rest": 4 * 3600.0, "on_the_way": 2700.0}


def wanted_states(
    around: CameraSurroundings, memory: ThermalMemory, range_degC: tuple[float, float], kinds: Sequence[WantedState]
) -> ForecastState:
    """Of a powered camera throughout the range: so long after it was brought there from rest in the middle, or half way
    to either end. Both ways to a temperature and what creeps are in these. ValueError without a kind."""
    low, high = range_degC
    pairs = np.array(list(product(np.linspace(low, high, 5)[1:4], np.linspace(low, high, _PLACES))))
    begun = at_rest(around, pairs[:, 0], memory)
    return together([after(around, begun, pairs[:, 1], np.full(len(pairs), _AFTER_S[kind])) for kind in kinds])


_HORIZON_S = 8 * 3600.0
_DRAWN = 40
"""Courses of each kind, drawn from the whole grid and from each of its thirds."""
_THIRDS, _EVERY = 3, 3


@dataclass(frozen=True, slots=True, eq=False)
class DesignState:
    """covariance (H, H), px^2: of the coefficients. noise_px2: of one more instant. wanted (W, H): features of the
    states in which the model is wanted. features: of situations (S,), (S, H)."""

    covariance: Float
    noise_px2: float
    wanted: Float
    features: Callable[[ForecastState], Float]


@dataclass(frozen=True, slots=True)
class BestCourse:
    """The first visit of a course. variance_px2: of the model after all of it, mean over the wanted states."""

    chamber_degC: float
    dwell_s: float
    variance_px2: float


def best_course(
    known: DesignState,
    here: ForecastState,
    around: CameraSurroundings,
    grid_degC: Float,
    dwells_s: Sequence[float],
    seed: int,
) -> BestCourse:
    """Of courses of each dwell, about as long together: the one after which the mean variance over the wanted states is
    least. The same for a seed."""
    rng = np.random.default_rng([20, seed])
    moment = known.wanted.T @ known.wanted / len(known.wanted)
    best: BestCourse | None = None
    for dwell_s in dwells_s:
        set_points = _drawn(grid_degC, max(1, round(_HORIZON_S / dwell_s)), rng)
        variance_px2 = _after_courses(known, here, around, set_points, dwell_s, moment)
        first = int(np.argmin(variance_px2))
        found = BestCourse(float(set_points[first, 0]), dwell_s, float(variance_px2[first]))
        best = found if best is None or found.variance_px2 < best.variance_px2 else best
    if best is None:
        raise ValueError("there is no dwell to choose from")
    return best


def _after_courses(
    known: DesignState,
    here: ForecastState,
    around: CameraSurroundings,
    set_points: Float,
    dwell_s: float,
    moment: Float,
) -> Float:
    """(S,), px^2: the variance after each course (S, visits); the covariance of each is updated visit by visit (the
    Sherman-Morrison formula)."""
    count = len(set_points)
    at = here.where(np.zeros(count, np.int64))
    covariance = np.repeat(known.covariance[None], count, axis=0)
    for visit in set_points.T:
        at = after(around, at, visit, np.full(count, dwell_s))
        own = known.features(at)
        gain = np.einsum("skl,sl->sk", covariance, own)
        total = known.noise_px2 + (gain * own).sum(axis=1)
        covariance -= gain[:, :, None] * gain[:, None, :] / total[:, None, None]
    return np.einsum("skl,lk->s", covariance, moment)


def _drawn(grid_degC: Float, visits: int, rng: np.random.Generator) -> Float:
    """(S, visits): to and fro, steadily up or down, staying at one temperature, and at one after the other. What creeps
    for hours shows in those that stay or go one way, which are hardly ever drawn by chance."""
    parts = [grid_degC, *(third for third in np.array_split(grid_degC, _THIRDS) if len(third))]
    to_and_fro = [rng.choice(part, (_DRAWN, visits)) for part in parts]
    up = [np.sort(rng.choice(part, (_DRAWN // 2, visits)), axis=1) for part in parts]
    down = [np.sort(rng.choice(part, (_DRAWN // 2, visits)), axis=1)[:, ::-1] for part in parts]
    staying = np.repeat(grid_degC[:, None], visits, axis=1)
    pairs = np.array(list(product(grid_degC[::_EVERY], repeat=2)))
    first = visits // 2
    both = np.hstack([np.repeat(pairs[:, :1], first, axis=1), np.repeat(pairs[:, 1:], visits - first, axis=1)])
    return np.concatenate([*to_and_fro, *up, *down, staying, both])


def recorded_so_far(session: Path) -> Observations:
    """The frames so far, with the telemetry up to the last of them: what comes in while somebody waits for a decision
    changes nothing. SessionError when there is nothing to be read, or no frame can be used."""
    with tempfile.TemporaryDirectory(prefix="thermostand-known-") as folder:
        copy = Path(folder) / session.name
        for series in (TELEMETRY, FRAMES):
            (copy / series).mkdir(parents=True)
            for segment in sorted((session / series).iterdir()) if (session / series).is_dir() else ():
                _taken(segment, copy / series)
        salvage_unfinished(Path(folder))
        observed = observe(copy, incomplete=_unreported)
        history = recorded_history(Session.open(copy), int(observed.time_ns[-1]))
        return replace(observed, histories=(history,))


def _taken(segment: Path, folder: Path) -> None:
    """A segment may be finished between the list and the look at it."""
    finished = segment.with_name(f"{segment.name.partition('.')[0]}{FINISHED}")
    try:
        if segment.name.endswith(UNFINISHED) and not finished.exists():
            shutil.copyfile(segment, folder / segment.name)
        elif finished.exists() and not (folder / finished.name).exists():
            (folder / finished.name).symlink_to(finished.absolute())
    except FileNotFoundError:
        if not finished.exists():
            raise SessionError(f"{segment}: was removed while it was read") from None
        (folder / finished.name).symlink_to(finished.absolute())


def _unreported(sentence: str) -> None:
    """A night under way lacks its rest."""


_GRID = 13
_APART_K = 1.0
"""From a held-out temperature: nearer ones would show it to the fitter."""
_UNCHECKED = "what the model leaves between set-points is seen at three of them"


@dataclass(frozen=True, slots=True)
class Wanted:
    """What a night is for, and within what it decides. range_degC: set-points at which the model is wanted; none
    outside is chosen, nor one of held_out_degC. residual_px: the predicted residual with which the night is content.
    dwells_s: to choose from. ramp_K_per_min: of the chamber, at most. states: in which the model is wanted there, see
    wanted_states."""

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
    known = DesignState(
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


def predicted_residual_px(model: ThermalModel, asked: ForecastState) -> float:
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


def _without_discrepancy_px(model: ThermalModel, asked: ForecastState) -> float:
    return predicted_residual_px(replace(model, discrepancy_px=np.zeros(2)), asked)


def _seen_degC(observations: Observations) -> Float:
    """The set-points that a fit knows, each once."""
    return np.unique(observations.chamber_degC[observations.of(Role.REFERENCE, Role.FIT)])


def _furthest(observations: Observations, wanted: Wanted, grid: Float, why: str) -> Decision:
    seen = _seen_degC(observations)
    distance_K = np.abs(grid[:, None] - seen).min(axis=1, initial=np.inf)
    degC, dwell_s = float(grid[np.argmax(distance_K)]), max(wanted.dwells_s)
    return Decision("visit", degC, dwell_s, math.nan, f"{why}; {degC:g} degC is furthest from the others")


def _features(model: ThermalModel, situation: ForecastState) -> Float:
    found = features(situation.states, [term.feature for term in model.terms], model.origin)
    return found - model.reference_features
