"""How the chamber, and the camera in it, follow a new set-point: a small model, and its fit to recorded sessions.

After dead_s the air goes towards the set-point with

    dT/dt = clip((set-point - T) / time_constant_s, -rate, +rate)

so a large step runs at the rate that the heater or the compressor gives, and the rest is approached exponentially.
The camera follows the air with one time constant more.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from thermostand.foundation.clock import NS_PER_S
from thermostand.foundation.documents import Document
from thermostand.foundation.errors import SessionError
from thermostand.foundation.items import StepMark, StepState
from thermostand.recording.reading.session import Session
from thermostand.stand.config.chamber_section import BAND_K

_ARRIVAL_LEVELS_K = (4.0, 2.0, 1.0, BAND_K)  # halved each time, down to the band
_LEAST_RAMP_K = 1.5  # smaller steps drown in the display's 0.1 K
_HALF_DIGIT_K = 0.05  # of a display of 0.1 K
_LEAST_CAMERA_CHANGE_K = 1.0  # within half a dwell; cameras report their temperature in steps of 0.1 to 0.5 K
_CAMERA_MEAN_S = 60.0  # several such steps are averaged
_FIT_POINTS = 41  # factors that are tried; round number, nothing was measured
_PRIOR_S = 0.5  # what a factor of e away from the defaults must gain in the mean error

_SETS = ("start_chamber", "set_temperature")
_DISTURBS = (*_SETS, "stop_chamber", "open_flap")  # what ends the undisturbed approach to a set-point


class Response(Document):
    """How the air approaches a set-point in one direction."""

    dead_s: float = Field(ge=0)
    rate_K_per_s: float = Field(gt=0)
    time_constant_s: float = Field(gt=0)

    def arrival_s(self, gap_K: float, level_K: float = BAND_K) -> float:
        """Return how long from the step of the set-point until the air is within `level_K` of it, s; 0 when it is from
        the start."""
        gap_K = abs(gap_K)
        if gap_K <= level_K:
            return 0.0
        return self.dead_s + float(_compute_approach_s(gap_K, level_K, self.rate_K_per_s, self.time_constant_s))


class ChamberModel(Document):
    """The whole: both directions, the camera, and how many ramps each was learned from (0: a default).

    camera_above_air_K: how much warmer than the air a camera is that is on, at the end of a ramp's dwell; 0 until
    recorded runs have shown it.

    The defaults are 2 kW and a freezer's 600 W on about 60 kJ/K of liner, racks and air, and a camera for which the
    paper's dwell of 45 min (section 3.2) is three time constants.
    """

    heating: Response = Response(dead_s=30.0, rate_K_per_s=2.0 / 60.0, time_constant_s=120.0)
    cooling: Response = Response(dead_s=60.0, rate_K_per_s=0.6 / 60.0, time_constant_s=120.0)
    camera_time_constant_s: float = Field(default=900.0, gt=0)
    camera_above_air_K: float = Field(default=0.0, ge=-50, le=100)
    heating_ramps: int = Field(default=0, ge=0)
    cooling_ramps: int = Field(default=0, ge=0)
    camera_ramps: int = Field(default=0, ge=0)

    def arrival_s(self, from_degC: float, to_degC: float, level_K: float = BAND_K) -> float:
        """Return how long from the step of the set-point until the air is within `level_K` of it, s."""
        response = self.heating if to_degC > from_degC else self.cooling
        return response.arrival_s(to_degC - from_degC, level_K)

    def settled_s(self, from_degC: float, to_degC: float) -> float:
        """Return how long until the camera has followed for two time constants after that, s; 0 when the air need not
        move."""
        arrival_s = self.arrival_s(from_degC, to_degC)
        return arrival_s + 2.0 * self.camera_time_constant_s if arrival_s > 0.0 else 0.0


@dataclass(frozen=True, slots=True)
class Ramp:
    """One recorded answer to a new set-point.

    arrivals: (level in K, s after the step from when on the air stayed within it). camera_time_constant_s: of the
    camera meanwhile, NaN when it did not move enough to fit it. camera_above_air_K: at its end, NaN without a camera's
    temperature.
    """

    from_degC: float
    to_degC: float
    arrivals: tuple[tuple[float, float], ...]
    camera_time_constant_s: float
    camera_above_air_K: float = math.nan


def fit_chamber_model(ramps: Sequence[Ramp]) -> ChamberModel:
    """The model that recorded ramps show: for each direction the response with the least mean absolute error of the
    arrivals, the median of the camera's time constants. What they do not show is as the defaults have it."""
    heating = [ramp for ramp in ramps if ramp.to_degC > ramp.from_degC]
    cooling = [ramp for ramp in ramps if ramp.to_degC < ramp.from_degC]
    seen_s = [ramp.camera_time_constant_s for ramp in ramps if not math.isnan(ramp.camera_time_constant_s)]
    above_K = [ramp.camera_above_air_K for ramp in ramps if not math.isnan(ramp.camera_above_air_K)]
    default = ChamberModel()
    return ChamberModel(
        heating=_fit_response(heating, default.heating),
        cooling=_fit_response(cooling, default.cooling),
        camera_time_constant_s=float(np.median(seen_s)) if seen_s else default.camera_time_constant_s,
        camera_above_air_K=float(np.median(above_K)) if above_K else default.camera_above_air_K,
        heating_ramps=len(heating),
        cooling_ramps=len(cooling),
        camera_ramps=len(seen_s),
    )


def extract_ramps(session: Session) -> list[Ramp]:
    """The ramps of a session that arrived, each followed until the flap opened or the set-point changed again."""
    try:
        pv = _drop_bad(session.readings("regulator.pv"))
    except SessionError:  # a run that ended before its first poll
        return []
    try:
        camera = _drop_bad(session.readings("camera.temperature"))
    except SessionError:  # a camera without a thermometer
        camera = np.empty((2, 0))
    marks = session.steps()
    found: list[Ramp] = []
    for number, mark in enumerate(marks):
        if mark.kind in _SETS and mark.state is StepState.DONE:
            end_s = _find_disturbance_s(marks[number + 1 :], float(pv[0, -1]) if pv.size else 0.0)
            setpoint_degC = float(str(mark.parameters.get("chamber_degC", "nan")))
            ramp = _extract_ramp(_slice(pv, mark, end_s), _slice(camera, mark, end_s), setpoint_degC)
            if ramp is not None:
                found.append(ramp)
    return found


def _compute_approach_s(
    gap_K: NDArray[np.float64] | float,
    level_K: NDArray[np.float64] | float,
    rate_K_per_s: NDArray[np.float64] | float,
    time_constant_s: NDArray[np.float64] | float,
) -> NDArray[np.float64]:
    """The solution of the equation above, without the dead time; 0 < level_K <= gap_K; arrays are broadcast."""
    knee_K = np.maximum(rate_K_per_s * time_constant_s, level_K)  # from here on the approach is exponential
    at_rate_s = np.maximum(gap_K - knee_K, 0.0) / rate_K_per_s
    return np.asarray(at_rate_s + time_constant_s * np.log(np.minimum(gap_K, knee_K) / level_K))


def _fit_response(ramps: Sequence[Ramp], default: Response) -> Response:
    """A search over a grid that is refined twice; for each pair the dead time is the median of what is left."""
    rows = [(abs(ramp.to_degC - ramp.from_degC), level_K, at_s) for ramp in ramps for level_K, at_s in ramp.arrivals]
    if not rows:
        return default
    gap_K, level_K, at_s = np.array(rows).T
    best, spread = default, 30.0
    for _ in range(3):
        factors = np.geomspace(1.0 / spread, spread, _FIT_POINTS)
        rate, time_constant = (
            axis.reshape(-1, 1)
            for axis in np.meshgrid(best.rate_K_per_s * factors, best.time_constant_s * factors, indexing="ij")
        )
        left_s = at_s - _compute_approach_s(gap_K, level_K, rate, time_constant)
        dead_s = np.maximum(np.median(left_s, axis=1, keepdims=True), 0.0)
        # Ramps that never ran at full rate do not determine the rate: then the default stays.
        strange = np.abs(np.log(rate / default.rate_K_per_s)) + np.abs(np.log(time_constant / default.time_constant_s))
        cost_s = np.mean(np.abs(left_s - dead_s), axis=1) + _PRIOR_S * strange[:, 0]
        at = int(np.argmin(cost_s))
        best = Response(
            dead_s=float(dead_s[at, 0]), rate_K_per_s=float(rate[at, 0]), time_constant_s=float(time_constant[at, 0])
        )
        spread = float(factors[-1] / factors[-3])
    return best


def _extract_ramp(pv: NDArray[np.float64], camera: NDArray[np.float64], to_degC: float) -> Ramp | None:
    """Return what the air (rows: s since the step, degC) shows; None when the step was small or it did not arrive."""
    if pv.shape[1] < 2:
        return None
    from_degC = float(pv[1, 0])
    gap_K = abs(to_degC - from_degC)
    if not gap_K >= _LEAST_RAMP_K:
        return None
    levels_K = [level_K for level_K in _ARRIVAL_LEVELS_K if level_K <= gap_K - 0.2]
    stays_s = {level_K: _find_arrival_s(pv, to_degC, level_K) for level_K in levels_K}
    if math.isnan(stays_s[BAND_K]):
        return None
    time_constant_s = _estimate_time_constant_s(camera, stays_s[BAND_K], float(pv[0, -1]))
    return Ramp(from_degC, to_degC, tuple(stays_s.items()), time_constant_s, _measure_above_air_K(camera, pv))


def _measure_above_air_K(camera: NDArray[np.float64], pv: NDArray[np.float64]) -> float:
    """Return how much warmer than the air the camera is in the last minute; NaN when its temperature is not there
    then."""
    end_s = float(pv[0, -1])
    last = [values[1, values[0] >= end_s - _CAMERA_MEAN_S] for values in (camera, pv)]
    return float(last[0].mean() - last[1].mean()) if all(values.size for values in last) else math.nan


def _find_arrival_s(pv: NDArray[np.float64], to_degC: float, level_K: float) -> float:
    """Find from when on every value is within `level_K`, NaN when the last one is not: between two polls, and between
    the display's change to that digit and its next."""
    times_s = [_find_last_outside_s(pv, to_degC, level_K + side_K) for side_K in (_HALF_DIGIT_K, -_HALF_DIGIT_K)]
    return sum(times_s) / 2.0


def _find_last_outside_s(pv: NDArray[np.float64], to_degC: float, level_K: float) -> float:
    last = int(np.flatnonzero(np.abs(pv[1] - to_degC) > level_K)[-1])  # the first value is, or there would be no ramp
    return float(pv[0, last : last + 2].mean()) if last + 1 < pv.shape[1] else math.nan


def _estimate_time_constant_s(camera: NDArray[np.float64], begin_s: float, end_s: float) -> float:
    """Estimate the time constant from three values at equal distances, which needs no final value: exp(-d/tau) = (c -
    b) / (b - a)."""
    half_s = (end_s - begin_s - _CAMERA_MEAN_S) / 2.0
    if half_s < _CAMERA_MEAN_S:
        return math.nan
    centres_s = begin_s + _CAMERA_MEAN_S / 2.0 + half_s * np.arange(3)
    near = [camera[1, np.abs(camera[0] - centre_s) <= _CAMERA_MEAN_S / 2.0] for centre_s in centres_s]
    if not all(values.size for values in near):
        return math.nan
    a, b, c = (float(values.mean()) for values in near)
    ratio = (c - b) / (b - a) if abs(b - a) >= _LEAST_CAMERA_CHANGE_K else math.nan
    return half_s / math.log(1.0 / ratio) if 0.0 < ratio < 1.0 else math.nan


def _drop_bad(column: tuple[NDArray[np.int64], NDArray[np.float64]]) -> NDArray[np.float64]:
    """(s since the epoch, value) without BAD readings, shape (2, n)."""
    times_ns, values = column
    good = np.isfinite(values)
    return np.stack((times_ns[good] / NS_PER_S, values[good]))


def _slice(column: NDArray[np.float64], mark: StepMark, end_s: float) -> NDArray[np.float64]:
    """Slice from the mark to `end_s`, times counted from the mark."""
    begin_s = mark.time_ns / NS_PER_S
    first, last = np.searchsorted(column[0], (begin_s, end_s))
    return column[:, first:last] - np.array([[begin_s], [0.0]])


def _find_disturbance_s(later: Sequence[StepMark], end_s: float) -> float:
    times_ns = (mark.time_ns for mark in later if mark.kind in _DISTURBS and mark.state is StepState.STARTED)
    return next((time_ns / NS_PER_S for time_ns in times_ns), end_s)
