"""The next visit of a session that decides, or its end: I-optimal design over the wanted temperatures.

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
from numpy.typing import NDArray

from thermostand.compensation.drift.candidates import FEWEST_BETWEEN
from thermostand.compensation.drift.claims import Claims
from thermostand.compensation.drift.terms import compute_features
from thermostand.compensation.drift.thermal_fit import fit_thermal
from thermostand.compensation.drift.thermal_model import ThermalModel
from thermostand.compensation.drift_runtime import Follower
from thermostand.compensation.expression import AIR, POWER, lag
from thermostand.compensation.history.thermal_history import (
    Float,
    States,
    ThermalStateSpec,
    compute_states_at,
    read_history,
    solve_damped_least_squares,
)
from thermostand.compensation.observations import Observations, observe
from thermostand.experiments.steps import WANTED_STATES, Role, WantedState
from thermostand.foundation.errors import SessionError
from thermostand.recording.format.layout import FINISHED, FRAMES, TELEMETRY, UNFINISHED
from thermostand.recording.reading.session import Session
from thermostand.recording.repair.salvage import salvage_unfinished

# How the air, the camera and what it remembers go on when the chamber is given set-points: a forecast of the features
# of the drift model, for many courses at once.
#
# The air follows a set-point by a limited ramp and a first-order lag; the camera is linear in lags of the air, fitted
# to the session so far. Lags and plays are those of compensation/drift_runtime.py.

STEP_S = 60.0  # of the forecast: a quarter of the fastest lag; time grows in inverse proportion
# Assumed, not learned from the stand: off by two, the forecast air arrives some minutes early or late.
_AIR_TAU_S = 300.0
_AIR_LAGS, _POWER_LAGS = ([lag(of, tau_s) for tau_s in (150.0, 480.0, 1200.0, 4000.0)] for of in (AIR, POWER))
_RIDGE = 1e-8  # keeps the system solvable; features are about 1
# Time is in inverse proportion to it; readings each few seconds have no more to say of a camera that takes minutes.
_EVERY_READING = 6
"""Of the camera's readings, for its fit: they come every few seconds, it moves within minutes."""


@dataclass(frozen=True, slots=True, eq=False)
class CameraSurroundings:
    """What the session shows of chamber and camera. air (2,): offset and slope of the recorded air over set-points.
    camera (2 + K,): of a powered camera, a constant, the weights of the air and of its lags. ramp_K_per_min: at most.
    """

    air: Float
    camera: Float
    ramp_K_per_min: float

    def air_degC(self, set_point_degC: Float) -> Float:
        """The air near the camera after a long time at set-points."""
        return self.air[0] + self.air[1] * set_point_degC

    def camera_degC(self, air_degC: Float, lags_degC: Float) -> Float:
        """(S,): of air (S,) and its lags (S, K)."""
        return self.camera[0] + self.camera[1] * air_degC + lags_degC @ self.camera[2:]


@dataclass(frozen=True, slots=True, eq=False)
class ForecastState:
    """S situations. target_degC (S,): what the air follows. air_degC (S,). camera_lags (S, K): lags of the air that the
    camera is made of. states: what a drift model remembers, of the air, the supply and the camera."""

    target_degC: Float
    air_degC: Float
    camera_lags: Float
    states: States

    def where(self, rows: NDArray[np.int64]) -> ForecastState:
        """Return these situations, in this order."""
        return ForecastState(
            self.target_degC[rows], self.air_degC[rows], self.camera_lags[rows], self.states.where(rows)
        )


def concatenate_states(parts: Sequence[ForecastState]) -> ForecastState:
    """The situations of all these, which remember the same; ValueError for none."""
    columns = [(part.target_degC, part.air_degC, part.camera_lags, part.states.rows) for part in parts]
    target, air, lags, rows = (np.concatenate(each) for each in zip(*columns, strict=True))
    return ForecastState(target, air, lags, States(parts[0].states.memory, rows))


def fit_surroundings(observations: Observations, ramp_K_per_min: float) -> CameraSurroundings:
    """Return what the last session says; SessionError when it has no history of the air or too few readings of the
    camera."""
    history = observations.histories[-1] if observations.histories else None
    if history is None or not history.has_ambient or len(history.camera_ns) < 10 * _EVERY_READING:
        raise SessionError("the session has no history of air and camera; nothing can be foreseen")
    at_ns, recorded_degC = history.camera_ns[::_EVERY_READING], history.camera_degC[::_EVERY_READING]
    states = compute_states_at(history, ThermalStateSpec((*_AIR_LAGS, *_POWER_LAGS)), at_ns, recorded_degC)
    air = np.interp(at_ns, history.ambient_ns, history.ambient_degC)
    # While it warms up the supply's lags explain it; of a camera that has been on for long they are 1.
    terms = np.column_stack([np.ones(len(air)), air, states.of(_AIR_LAGS), states.of(_POWER_LAGS) - 1])
    known = np.isfinite(terms).all(axis=1) & np.isfinite(recorded_degC)
    weights = solve_damped_least_squares(terms[known], recorded_degC[known], _RIDGE)
    return CameraSurroundings(_fit_air_response(observations), weights[: 2 + len(_AIR_LAGS)], ramp_K_per_min)


def _fit_air_response(observations: Observations) -> Float:
    """Offset and slope; the air is taken to be at the set-point until two of them have been visited."""
    frames = observations.of(Role.REFERENCE, Role.FIT, Role.VALIDATION) & np.isfinite(observations.air_degC)
    set_points, air = observations.chamber_degC[frames], observations.air_degC[frames]
    if len(set_points) < 2 or np.ptp(set_points) < 2.0:
        return np.array([0.0, 1.0])
    slope, offset = np.polyfit(set_points, air, 1)
    # Air that follows the set-point by less than half was not at rest; round numbers, nothing was measured.
    return np.array([offset, slope]) if 0.5 < slope < 1.5 else np.array([0.0, 1.0])


def read_current_state(observations: Observations, memory: ThermalStateSpec) -> ForecastState:
    """Return the camera's state at the last frame of the last session."""
    history = observations.histories[-1]
    own = observations.session == len(observations.sessions) - 1
    at_ns, recorded_degC = observations.time_ns[own][-1:], observations.camera_degC[own][-1:]
    lags = compute_states_at(history, ThermalStateSpec(tuple(_AIR_LAGS)), at_ns, recorded_degC).of(_AIR_LAGS)
    air = np.interp(at_ns, history.ambient_ns, history.ambient_degC)
    return ForecastState(air, air, lags, compute_states_at(history, memory, at_ns, recorded_degC))


def compute_equilibrium(around: CameraSurroundings, set_points_degC: Float, memory: ThermalStateSpec) -> ForecastState:
    """Compute the state of a powered camera after a long time at set-points (S,); plays are as after a way from a
    colder place."""
    air = around.air_degC(set_points_degC)
    lags = np.repeat(air[:, None], len(_AIR_LAGS), axis=1)
    follower = Follower(memory.parts)
    values = follower.rest([around.camera_degC(air, lags), air, np.ones(len(air))])
    for place, _, is_play, radius_K in follower.parts:
        values[place] = values[place] - (radius_K if is_play else 0.0)
    return ForecastState(air, air, lags, _make_states(memory, values))


def _make_states(memory: ThermalStateSpec, values: Sequence[Float]) -> States:
    """Make the states of a camera that has been on, and followed, for long."""
    return States(memory, np.column_stack([*values, *np.full((2, len(values[0])), np.inf)]))


def forecast(
    around: CameraSurroundings, situation: ForecastState, set_points_degC: Float, soak_s: Float
) -> ForecastState:
    """Compute the states after dwells (S,) at set-points (S,), s and degC."""
    goal, memory = around.air_degC(set_points_degC), situation.states.memory
    left_s = np.asarray(soak_s, np.float64).copy()
    target, air, values = situation.target_degC, situation.air_degC, [*situation.states.columns]
    of_air, of_model = Follower(_AIR_LAGS), Follower(memory.parts)
    lags = [*situation.camera_lags.T]
    on = np.ones(len(goal))
    for _ in range(int(np.ceil(left_s.max() / STEP_S))):
        dt = np.clip(left_s, 0.0, STEP_S)[:, None]
        left_s -= STEP_S
        reach_K = around.ramp_K_per_min / 60 * dt[:, 0]
        target = target + np.clip(goal - target, -reach_K, reach_K)
        before_air, before_camera = air, values[0]
        air = air + (target - air) * -np.expm1(-dt[:, 0] / _AIR_TAU_S)
        mean_air = (air + before_air) / 2
        inputs = [before_camera, mean_air, on]
        _, _, _, *lags = _advance_follower(of_air, [*inputs, *lags], inputs, dt)
        camera = np.where(dt[:, 0] > 0, around.camera_degC(air, np.column_stack(lags)), before_camera)
        mean = [(camera + before_camera) / 2, mean_air, on]
        values = _advance_follower(of_model, [camera, mean_air, on, *values[3:]], mean, dt)
    return ForecastState(target, air, np.column_stack(lags), _make_states(memory, values))


def _advance_follower(follower: Follower, now: list[Float], mean: list[Float], dt_s: Float) -> list[Float]:
    """Advance a lag by dt_s (S, 1), with its inputs now and in the mean."""
    follower.follow(now, [*mean, *now[3:]], (-np.expm1(-dt_s / follower.taus_s)).T, np.clip)
    return now


_PLACES = 7  # round number; nothing was measured
# A camera at rest, 4 h after a change. Asked for 45 min after one instead, a cycle ended after 46 % of the fixed one's
# time but left about four times as much at rest (6 drawn cameras: 7 to 27 mpx for 1 to 8).
_TIME_AT_SET_POINT_S: dict[WantedState, float] = {"at_rest": 4 * 3600.0, "on_the_way": 2700.0}


def list_wanted_states(
    around: CameraSurroundings, memory: ThermalStateSpec, range_degC: tuple[float, float], kinds: Sequence[WantedState]
) -> ForecastState:
    """List states of a powered camera throughout the range: so long after it was brought there from rest in the middle,
    or half way to either end. Both ways to a temperature and what creeps are in these. ValueError without a kind."""
    low, high = range_degC
    pairs = np.array(list(product(np.linspace(low, high, 5)[1:4], np.linspace(low, high, _PLACES))))
    begun = compute_equilibrium(around, pairs[:, 0], memory)
    return concatenate_states(
        [forecast(around, begun, pairs[:, 1], np.full(len(pairs), _TIME_AT_SET_POINT_S[kind])) for kind in kinds]
    )


# What creeps shows only in courses as long: with 4 h one drawn camera was left with 13.1 mpx at rest after 61 % of the
# fixed cycle's time, with 8 h 7.7 after 60 %.
_HORIZON_S = 8 * 3600.0
# Time grows in proportion; each visit is decided again after the one before it.
_COURSES_PER_KIND = 40
"""Courses of each kind, drawn from the whole grid and from each of its thirds."""
_THIRDS, _EVERY = 3, 3  # round numbers; not measured


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
    soak_s: float
    variance_px2: float


def find_best_course(
    known: DesignState,
    here: ForecastState,
    around: CameraSurroundings,
    grid_degC: Float,
    soaks_s: Sequence[float],
    seed: int,
) -> BestCourse:
    """Choose, among courses of each dwell that take about as long together, the one after which the mean variance over
    the wanted states is least. The same for a seed."""
    rng = np.random.default_rng([20, seed])
    moment = known.wanted.T @ known.wanted / len(known.wanted)
    best: BestCourse | None = None
    for soak_s in soaks_s:
        set_points = _draw_courses(grid_degC, max(1, round(_HORIZON_S / soak_s)), rng)
        variance_px2 = _compute_course_variances(known, here, around, set_points, soak_s, moment)
        first = int(np.argmin(variance_px2))
        found = BestCourse(float(set_points[first, 0]), soak_s, float(variance_px2[first]))
        best = found if best is None or found.variance_px2 < best.variance_px2 else best
    if best is None:
        raise ValueError("there is no dwell to choose from")
    return best


def _compute_course_variances(
    known: DesignState,
    here: ForecastState,
    around: CameraSurroundings,
    set_points: Float,
    soak_s: float,
    moment: Float,
) -> Float:
    """(S,), px^2: the variance after each course (S, visits); the covariance of each is updated visit by visit (the
    Sherman-Morrison formula)."""
    count = len(set_points)
    at = here.where(np.zeros(count, np.int64))
    covariance = np.repeat(known.covariance[None], count, axis=0)
    for visit in set_points.T:
        at = forecast(around, at, visit, np.full(count, soak_s))
        own = known.features(at)
        gain = np.einsum("skl,sl->sk", covariance, own)
        total = known.noise_px2 + (gain * own).sum(axis=1)
        covariance -= gain[:, :, None] * gain[:, None, :] / total[:, None, None]
    return np.einsum("skl,lk->s", covariance, moment)


def _draw_courses(grid_degC: Float, visits: int, rng: np.random.Generator) -> Float:
    """(S, visits): to and fro, steadily up or down, staying at one temperature, and at one after the other. What creeps
    for hours shows in those that stay or go one way, which are hardly ever drawn by chance."""
    parts = [grid_degC, *(third for third in np.array_split(grid_degC, _THIRDS) if len(third))]
    to_and_fro = [rng.choice(part, (_COURSES_PER_KIND, visits)) for part in parts]
    up = [np.sort(rng.choice(part, (_COURSES_PER_KIND // 2, visits)), axis=1) for part in parts]
    down = [np.sort(rng.choice(part, (_COURSES_PER_KIND // 2, visits)), axis=1)[:, ::-1] for part in parts]
    staying = np.repeat(grid_degC[:, None], visits, axis=1)
    pairs = np.array(list(product(grid_degC[::_EVERY], repeat=2)))
    first = visits // 2
    both = np.hstack([np.repeat(pairs[:, :1], first, axis=1), np.repeat(pairs[:, 1:], visits - first, axis=1)])
    return np.concatenate([*to_and_fro, *up, *down, staying, both])


def observe_partial_session(session: Path) -> Observations:
    """The frames so far, with the telemetry up to the last of them: what comes in while somebody waits for a decision
    changes nothing. SessionError when there is nothing to be read, or no frame can be used."""
    with tempfile.TemporaryDirectory(prefix="thermostand-known-") as folder:
        copy = Path(folder) / session.name
        for series in (TELEMETRY, FRAMES):
            (copy / series).mkdir(parents=True)
            for segment in sorted((session / series).iterdir()) if (session / series).is_dir() else ():
                _copy_segment(segment, copy / series)
        salvage_unfinished(Path(folder))
        observed = observe(copy, incomplete=_ignore_warning)
        history = read_history(Session.open(copy), int(observed.time_ns[-1]))
        return replace(observed, histories=(history,))


def _copy_segment(segment: Path, folder: Path) -> None:
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


def _ignore_warning(sentence: str) -> None:
    """Ignore what is missing: a session under way lacks its rest."""


# Set-points to choose from; nothing was measured. Time grows in proportion.
_GRID = 13
_APART_K = 1.0
"""From a held-out temperature: nearer ones would show it to the fitter."""
_UNCHECKED = "what the model leaves between set-points is seen at three of them"


@dataclass(frozen=True, slots=True)
class DesignGoal:
    """What a session is for, and within what it decides. range_degC: set-points at which the model is wanted; none
    outside is chosen, nor one of held_out_degC. residual_px: the predicted residual at which the session may
    end. soaks_s: to choose from. ramp_K_per_min: of the chamber, at most. states: in which the model is wanted there,
    see list_wanted_states."""

    range_degC: tuple[float, float]
    residual_px: float
    held_out_degC: tuple[float, ...] = ()
    soaks_s: tuple[float, ...] = (900.0, 1500.0, 2700.0)
    ramp_K_per_min: float = 2.0
    states: tuple[WantedState, ...] = WANTED_STATES


@dataclass(frozen=True, slots=True)
class Decision:
    """kind: "visit" or "enough". chamber_degC, soak_s: of the visit. predicted_px: the residual that the model
    predicts over the wanted states, RMS of a coordinate, NaN where that was not asked. reason: in words."""

    kind: Literal["visit", "enough"]
    chamber_degC: float
    soak_s: float
    predicted_px: float
    reason: str


def decide(observations: Observations, wanted: DesignGoal) -> Decision:
    """Return what to do next. While no model can be fitted, the temperature that is furthest from those visited."""
    grid = _make_grid(wanted)
    try:
        model = fit_thermal(observations)
        around = fit_surroundings(observations, wanted.ramp_K_per_min)
    except SessionError as error:
        return _choose_furthest(observations, wanted, grid, f"no model yet ({error})")
    asked = list_wanted_states(around, model.memory, wanted.range_degC, wanted.states)
    predicted_px = predict_residual_px(model, asked)
    if predicted_px <= wanted.residual_px:
        reason = f"the residual is predicted at {1e3 * predicted_px:.1f} mpx, {1e3 * wanted.residual_px:g} are wanted"
        return Decision("enough", math.nan, 0.0, predicted_px, reason)
    if (
        _has_few_interior_set_points(observations)
        and _predict_without_discrepancy_px(model, asked) <= wanted.residual_px
    ):
        return _choose_furthest(observations, wanted, grid, _UNCHECKED)
    known = DesignState(
        model.leverage_matrix,
        float(model.discrepancy_px @ model.discrepancy_px),
        _compute_features(model, asked),
        lambda situation: _compute_features(model, situation),
    )
    seed = int(observations.time_ns[-1] % (1 << 32))
    course = find_best_course(known, read_current_state(observations, model.memory), around, grid, wanted.soaks_s, seed)
    reason = (
        f"the residual is predicted at {1e3 * predicted_px:.1f} mpx; {course.chamber_degC:g} degC for "
        f"{course.soak_s / 60:g} min begins the course that lowers it most"
    )
    return Decision("visit", course.chamber_degC, course.soak_s, predicted_px, reason)


def predict_residual_px(model: ThermalModel, asked: ForecastState) -> float:
    """Return the RMS of a coordinate over these situations and the outline of the markers, within the session."""
    hull_px = model.facts.hull_px
    situations, places = len(asked.air_degC), len(hull_px)
    states = asked.states.where(np.repeat(np.arange(situations), places))
    own = model.of_sessions(model.facts.session_ids)
    covariance = own.covariance(np.tile(hull_px, (situations, 1)), states)
    return float(np.sqrt(np.trace(covariance, axis1=1, axis2=2).mean() / 2))


def _make_grid(wanted: DesignGoal) -> Float:
    """Set-points to choose from; SessionError never: the ends stay when all is held out."""
    grid = np.linspace(*wanted.range_degC, _GRID)
    held_out = np.array(wanted.held_out_degC)
    near = np.abs(grid[:, None] - held_out).min(axis=1, initial=np.inf)
    return np.round(grid[near >= _APART_K] if (near >= _APART_K).any() else grid[[0, -1]], 1)


def _has_few_interior_set_points(observations: Observations) -> bool:
    """Return whether too few set-points lie between others for what the model leaves at such ones."""
    # With fewer, the set-points that are left out are those at the ends, and a model claimed 100 to 700 mpx.
    return len(_list_fitted_set_points(observations)) - 2 < FEWEST_BETWEEN


def _predict_without_discrepancy_px(model: ThermalModel, asked: ForecastState) -> float:
    return predict_residual_px(replace(model, claims=Claims()), asked)


def _list_fitted_set_points(observations: Observations) -> Float:
    """The set-points that a fit knows, each once."""
    return np.unique(observations.chamber_degC[observations.of(Role.REFERENCE, Role.FIT)])


def _choose_furthest(observations: Observations, wanted: DesignGoal, grid: Float, why: str) -> Decision:
    seen = _list_fitted_set_points(observations)
    distance_K = np.abs(grid[:, None] - seen).min(axis=1, initial=np.inf)
    degC, soak_s = float(grid[np.argmax(distance_K)]), max(wanted.soaks_s)
    return Decision("visit", degC, soak_s, math.nan, f"{why}; {degC:g} degC is furthest from the others")


def _compute_features(model: ThermalModel, situation: ForecastState) -> Float:
    found = compute_features(situation.states, [term.feature for term in model.terms], model.origin)
    return found - model.reference_features
