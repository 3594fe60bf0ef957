"""Applies a thermostand drift model to a running camera. This file and a JSON file are all it takes, with numpy.

    drift = Drift.load("drift.json")
    drift.advance(dt_s, ambient_degC, power_on, camera_degC)   # every few seconds, from switching on
    reference_px = drift.correct(points_px)                    # (N, 2), x to the right, y down, px
    drift.flags(points_px)                                     # (N,), 0 inside the calibrated range

Integer pixel coordinates are pixel centres. A model of the form `paper` uses the camera's temperature only; one of the
form `thermal` remembers the air, the supply and the camera, and must be fed for about three of its longest time
constants (`drift.memory_s`) before it is right, unless it was fed from a cold start on.

The fit, too, follows the camera with the ThermalState of this file.
"""

import json
import math

import numpy as np

PLACE, CAMERA, AMBIENT, SWITCHED_ON, HISTORY, STATE = 1, 2, 4, 8, 16, 32
"""Flags: the point is outside the markers' hull; the camera's temperature, the air's temperature or its rate of change
are outside the calibrated range; the camera was switched on too recently; it has not been followed for long enough;
each is in its range, but not in this combination."""

RATE_TAU_S = 600.0
"""The ambient's rate of change is that of its 10 min lag."""
SETTLED_TAUS = 3.0
"""After so many time constants a state that began with a guess has forgotten it (5 % are left)."""
_COLD_K = 3.0
"""A camera this close to the air around it has been off for long: nothing of it is warm."""
_UNPOWERED_TAU_S = 900.0
"""An unpowered camera reports no temperature; its excess over the air is assumed to decay so until it does."""
_SPAN_K, _MARGIN, _HULL_MARGIN_PX, _SWITCHED_ON_S, _MORE_LEVERAGE = 20.0, 0.02, 1.0, 1.0, 3.0


class ThermalState:
    """The thermal state of one camera, followed from sample to sample.

    It begins, and begins again after a gap, in equilibrium: lags of temperatures at these temperatures, lags of the
    power at the part of its self-heating that the camera shows. Unless the camera is as cold as the air, that is a
    guess, which is forgotten after about three of the time constants. camera_degC, air_degC: the last ones.
    ambient_lag, power_lag, camera_lag: the 10 min lag, then one for each of taus_s. plays: one for each of plays_K.
    settled_s: how long ago the state was a guess. on_s: since the camera was switched on. begun: False in a gap.
    """

    def __init__(self, taus_s, plays_K, self_heating_K):
        """taus_s: time constants, s. plays_K: radii. self_heating_K: over the air of a camera that has been on for
        long."""
        self._taus_s = np.array([RATE_TAU_S, *taus_s])
        self._radii_K = np.array(plays_K, float)
        self._self_heating_K = self_heating_K
        self.begun = False
        self.settled_s = self.on_s = self.air_degC = self.camera_degC = math.nan
        self.ambient_lag = self.power_lag = self.camera_lag = np.full(len(self._taus_s), math.nan)
        self.plays = np.full(len(self._radii_K), math.nan)

    def advance(self, dt_s, ambient_degC, power_on, camera_degC):
        """dt_s have passed, with this mean temperature of the air near the camera and this share (0..1) of them
        powered; at their end the camera has this temperature (NaN: unknown). An ambient of NaN is a gap."""
        if math.isnan(ambient_degC) or math.isnan(power_on):
            self.begun = False
            return
        if not self.begun:
            self._begin(ambient_degC, power_on, camera_degC)
        before_degC = self.camera_degC
        excess_K = (before_degC - self.air_degC) * math.exp(-dt_s / _UNPOWERED_TAU_S)
        self.air_degC = ambient_degC
        self.camera_degC = ambient_degC + excess_K if math.isnan(camera_degC) else camera_degC
        # First-order followers of a constant input, exactly: z + (s - z)(1 - exp(-dt/tau)); and Prandtl-Ishlinskii
        # plays, which stay where they are until the camera is further away than their radius.
        gained = -np.expm1(-dt_s / self._taus_s)
        self.ambient_lag = self.ambient_lag + (ambient_degC - self.ambient_lag) * gained
        self.power_lag = self.power_lag + (power_on - self.power_lag) * gained
        self.camera_lag = self.camera_lag + ((before_degC + self.camera_degC) / 2 - self.camera_lag) * gained
        self.plays = np.clip(self.plays, self.camera_degC - self._radii_K, self.camera_degC + self._radii_K)
        self.settled_s += dt_s
        self.on_s = self.on_s + dt_s if power_on == 1 else dt_s * power_on

    @property
    def rate_K_per_h(self):
        """How fast the ambient changes."""
        return 3600 / RATE_TAU_S * (self.air_degC - self.ambient_lag[0])

    def _begin(self, ambient_degC, power_on, camera_degC):
        excess_K = 0.0 if math.isnan(camera_degC) else camera_degC - ambient_degC
        cold = abs(excess_K) < _COLD_K and not math.isnan(camera_degC)
        warmed = 0.0 if cold else min(max(excess_K / self._self_heating_K, 0.0), 1.0)
        self.begun = True
        self.settled_s = math.inf if cold else 0.0
        self.on_s = 0.0 if cold or power_on == 0 else math.inf
        self.air_degC, self.camera_degC = ambient_degC, ambient_degC + excess_K
        self.ambient_lag = np.full(len(self._taus_s), float(ambient_degC))
        self.power_lag = np.full(len(self._taus_s), warmed)
        self.camera_lag = np.full(len(self._taus_s), self.camera_degC)
        self.plays = np.full(len(self._radii_K), self.camera_degC)


class Drift:
    """One camera and its thermal state."""

    def __init__(self, model):
        """model: what the JSON file holds."""
        if model.get("format") != "thermostand drift runtime" or model.get("version") != 1:
            raise ValueError("not a drift runtime model of this version")
        self._model = model
        self._coefficients = np.array(model["coefficients_px"])
        self._hull_px = np.array(model["hull_px"])
        self._state = ThermalState(
            model.get("taus_s", []), model.get("plays_K", []), model.get("self_heating_K", math.nan)
        )
        self._camera_degC = math.nan

    @classmethod
    def load(cls, path):
        """The drift of a JSON file."""
        with open(path, encoding="utf-8") as file:
            return cls(json.load(file))

    @property
    def memory_s(self):
        """How long it must have been fed to be right, s; 0 for a form without memory."""
        longest_s = SETTLED_TAUS * max(self._model.get("taus_s", []), default=0.0)
        return self._model.get("history_s", longest_s)

    def advance(self, dt_s, ambient_degC, power_on, camera_degC):
        """As ThermalState.advance."""
        self._state.advance(dt_s, ambient_degC, power_on, camera_degC)
        self._camera_degC = self._state.camera_degC if self._state.begun else camera_degC

    def shift(self, points_px):
        """Displacement (N, 2), px, of points (N, 2) to where they would be at the reference; NaN before `advance`."""
        points_px = np.asarray(points_px, float)
        if self._model["form"] == "paper":
            return self._polynomial(points_px) @ self._coefficients.T
        if not self._state.begun:
            return np.full_like(points_px, np.nan)
        amounts = self._coefficients @ self._away()
        return self._moved(points_px, amounts)

    def correct(self, points_px):
        """Where the points (N, 2), px, would be at the reference."""
        return np.asarray(points_px, float) + self.shift(points_px)

    def flags(self, points_px):
        """(N,) int: why each correction is an extrapolation, 0 when it is not."""
        points_px = np.asarray(points_px, float)
        sides = np.roll(self._hull_px, -1, axis=0) - self._hull_px
        along = sides / np.linalg.norm(sides, axis=1, keepdims=True)
        offset = points_px[:, None] - self._hull_px
        distance_px = along[:, 0] * offset[:, :, 1] - along[:, 1] * offset[:, :, 0]
        outside = ~(distance_px >= -_HULL_MARGIN_PX).all(axis=1)
        return np.where(outside, PLACE, 0) | self._state_flags()

    def _polynomial(self, points_px):
        """The paper's terms: products of Chebyshev polynomials of I, J and T, each scaled to [-1, 1]."""
        width, height = self._model["image_size_px"]
        low, high = self._model["camera_range_degC"]
        t = np.full(len(points_px), (2 * self._camera_degC - low - high) / (high - low))
        i, j = 2 * (points_px[:, 0] + 0.5) / width - 1, 2 * (points_px[:, 1] + 0.5) / height - 1
        a, b, c = np.array(self._model["terms_abc"]).T
        chebyshev = [np.polynomial.chebyshev.chebvander(values, int(max(a))) for values in (i, j, t)]
        return chebyshev[0][:, a] * chebyshev[1][:, b] * chebyshev[2][:, c]

    def _features(self):
        """The terms of the thermal state."""
        camera_degC, air_degC = self._model["reference_degC"], self._model["reference_ambient_degC"]
        taus_s, radii_K = self._model["taus_s"], self._model["plays_K"]
        state, own = self._state, (self._state.camera_degC - camera_degC) / _SPAN_K
        values = []
        for kind, parameter in self._model["terms"]:
            at = 1 + taus_s.index(parameter) if parameter in taus_s else 0
            values.append(
                {
                    "constant": lambda: 1.0,
                    "camera": lambda: own,
                    "camera squared": lambda: own**2,
                    "ambient lag": lambda at=at: (state.ambient_lag[at] - air_degC) / _SPAN_K,
                    "power lag": lambda at=at: state.power_lag[at] - 1,
                    "camera lag": lambda at=at: (state.camera_lag[at] - camera_degC) / _SPAN_K,
                    "camera lag squared": lambda at=at: ((state.camera_lag[at] - camera_degC) / _SPAN_K) ** 2,
                    "play": lambda r=parameter: (state.plays[radii_K.index(r)] - camera_degC) / _SPAN_K,
                }[kind]()
            )
        return np.array(values)

    def _away(self):
        """The features minus those of the reference."""
        return self._features() - np.array(self._model["reference_features"])

    def _moved(self, points_px, amounts):
        """Eight infinitesimal motions of a homography: shift, affine, perspective."""
        width, height = self._model["image_size_px"]
        x = (points_px[:, 0] - (width - 1) / 2) / (width / 2)
        y = (points_px[:, 1] - (height - 1) / 2) / (width / 2)
        right, down, xx, xy, yx, yy, bend_x, bend_y = amounts
        bend = bend_x * x + bend_y * y
        return np.stack([right + xx * x + xy * y + bend * x, down + yx * x + yy * y + bend * y], axis=1)

    def _state_flags(self):
        found = _beyond(self._camera_degC, self._limits("camera_range_degC"), CAMERA)
        if self._model["form"] == "paper":
            return found
        if not self._state.begun:
            return CAMERA | AMBIENT | SWITCHED_ON | HISTORY | STATE
        found |= _beyond(self._state.rate_K_per_h, self._limits("rate_range_K_per_h", 1.0), AMBIENT)
        least_on_s = self._model["least_on_s"]
        least_on_s = math.inf if least_on_s is None else least_on_s - _SWITCHED_ON_S
        found |= _beyond(self._state.on_s, (least_on_s, math.inf), SWITCHED_ON)
        if self._model.get("leverage") is not None:
            away, matrix = self._away(), np.array(self._model["leverage_matrix"])
            found |= _beyond(away @ matrix @ away, (0.0, _MORE_LEVERAGE * self._model["leverage"]), STATE)
        if self._model["taus_s"]:
            found |= _beyond(self._state.ambient_lag[-1], self._limits("ambient_range_degC"), AMBIENT)
        return found | _beyond(self._state.settled_s, (self.memory_s, math.inf), HISTORY)

    def _limits(self, name, least=0.0):
        """A calibrated range with its margin; the paper's form has none."""
        low, high = self._model[name]
        margin = 0.0 if self._model["form"] == "paper" else max(_MARGIN * (high - low), least)
        return low - margin, high + margin


def _beyond(value, limits, flag):
    return 0 if limits[0] <= value <= limits[1] else flag
