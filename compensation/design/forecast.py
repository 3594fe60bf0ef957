"""How the air, the camera and what it remembers go on when the chamber is given set-points: a forecast of the features
of the drift model, for many courses at once.

The air follows a set-point by a limited ramp and a first-order lag; the camera is linear in lags of the air, fitted to
the night so far. Lags and plays are those of compensation/drift_runtime.py.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thermostand.compensation.drift_runtime import Follower
from thermostand.compensation.expression import AIR, POWER, lag
from thermostand.compensation.history.states import Float, States, ThermalMemory
from thermostand.compensation.history.thermal_history import damped_least_squares, states_at
from thermostand.compensation.observations import Observations
from thermostand.experiments.steps import Role
from thermostand.foundation.errors import SessionError

STEP_S = 60.0
_AIR_TAU_S = 300.0
_AIR_LAGS, _POWER_LAGS = ([lag(of, tau_s) for tau_s in (150.0, 480.0, 1200.0, 4000.0)] for of in (AIR, POWER))
_RIDGE = 1e-8
_EVERY = 6
"""Of the camera's readings, for its fit: they come every few seconds, it moves within minutes."""


@dataclass(frozen=True, slots=True, eq=False)
class CameraSurroundings:
    """What the night says of chamber and camera. air (2,): offset and slope of the recorded air over set-points.
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
        """These situations, in this order."""
        return ForecastState(
            self.target_degC[rows], self.air_degC[rows], self.camera_lags[rows], self.states.where(rows)
        )


def together(parts: Sequence[ForecastState]) -> ForecastState:
    """The situations of all these, which remember the same; ValueError for none."""
    columns = [(part.target_degC, part.air_degC, part.camera_lags, part.states.rows) for part in parts]
    target, air, lags, rows = (np.concatenate(each) for each in zip(*columns, strict=True))
    return ForecastState(target, air, lags, States(parts[0].states.memory, rows))


def surroundings(observations: Observations, ramp_K_per_min: float) -> CameraSurroundings:
    """What the last session says; SessionError when it has no history of the air or too few readings of the camera."""
    history = observations.histories[-1] if observations.histories else None
    if history is None or not history.has_ambient or len(history.camera_ns) < 10 * _EVERY:
        raise SessionError("the session has no history of air and camera; nothing can be foreseen")
    at_ns, recorded_degC = history.camera_ns[::_EVERY], history.camera_degC[::_EVERY]
    states = states_at(history, ThermalMemory((*_AIR_LAGS, *_POWER_LAGS)), at_ns, recorded_degC)
    air = np.interp(at_ns, history.ambient_ns, history.ambient_degC)
    # While it warms up the supply's lags explain it; of a camera that has been on for long they are 1.
    terms = np.column_stack([np.ones(len(air)), air, states.of(_AIR_LAGS), states.of(_POWER_LAGS) - 1])
    known = np.isfinite(terms).all(axis=1) & np.isfinite(recorded_degC)
    weights = damped_least_squares(terms[known], recorded_degC[known], _RIDGE)
    return CameraSurroundings(_air(observations), weights[: 2 + len(_AIR_LAGS)], ramp_K_per_min)


def _air(observations: Observations) -> Float:
    """Offset and slope; the air is taken to be at the set-point until two of them have been visited."""
    frames = observations.of(Role.REFERENCE, Role.FIT, Role.VALIDATION) & np.isfinite(observations.air_degC)
    set_points, air = observations.chamber_degC[frames], observations.air_degC[frames]
    if len(set_points) < 2 or np.ptp(set_points) < 2.0:
        return np.array([0.0, 1.0])
    slope, offset = np.polyfit(set_points, air, 1)
    return np.array([offset, slope]) if 0.5 < slope < 1.5 else np.array([0.0, 1.0])


def now(observations: Observations, memory: ThermalMemory) -> ForecastState:
    """At the last frame of the last session."""
    history = observations.histories[-1]
    own = observations.session == len(observations.sessions) - 1
    at_ns, recorded_degC = observations.time_ns[own][-1:], observations.camera_degC[own][-1:]
    lags = states_at(history, ThermalMemory(tuple(_AIR_LAGS)), at_ns, recorded_degC).of(_AIR_LAGS)
    air = np.interp(at_ns, history.ambient_ns, history.ambient_degC)
    return ForecastState(air, air, lags, states_at(history, memory, at_ns, recorded_degC))


def at_rest(around: CameraSurroundings, set_points_degC: Float, memory: ThermalMemory) -> ForecastState:
    """Of a powered camera after a long time at set-points (S,); plays are as after a way from a colder place."""
    air = around.air_degC(set_points_degC)
    lags = np.repeat(air[:, None], len(_AIR_LAGS), axis=1)
    follower = Follower(memory.parts)
    values = follower.rest([around.camera_degC(air, lags), air, np.ones(len(air))])
    for place, _, is_play, radius_K in follower.parts:
        values[place] = values[place] - (radius_K if is_play else 0.0)
    return ForecastState(air, air, lags, _states(memory, values))


def _states(memory: ThermalMemory, values: Sequence[Float]) -> States:
    """Of a camera that has been on, and followed, for long."""
    return States(memory, np.column_stack([*values, *np.full((2, len(values[0])), np.inf)]))


def after(
    around: CameraSurroundings, situation: ForecastState, set_points_degC: Float, dwell_s: Float
) -> ForecastState:
    """After dwells (S,) at set-points (S,), s and degC."""
    goal, memory = around.air_degC(set_points_degC), situation.states.memory
    left_s = np.asarray(dwell_s, np.float64).copy()
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
        _, _, _, *lags = _moved(of_air, [*inputs, *lags], inputs, dt)
        camera = np.where(dt[:, 0] > 0, around.camera_degC(air, np.column_stack(lags)), before_camera)
        mean = [(camera + before_camera) / 2, mean_air, on]
        values = _moved(of_model, [camera, mean_air, on, *values[3:]], mean, dt)
    return ForecastState(target, air, np.column_stack(lags), _states(memory, values))


def _moved(follower: Follower, now: list[Float], mean: list[Float], dt_s: Float) -> list[Float]:
    """After dt_s (S, 1), with these inputs now and in the mean."""
    follower.follow(now, [*mean, *now[3:]], (-np.expm1(-dt_s / follower.taus_s)).T, np.clip)
    return now
