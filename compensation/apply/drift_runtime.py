"""Applies a thermostand drift model to a running camera. This file and a JSON file are all it takes, with numpy.

    drift = Drift.load("drift.json")
    drift.advance(dt_s, ambient_degC, power_on, camera_degC)   # every few seconds, from switching on
    reference_px = drift.correct(points_px)                    # (N, 2), x to the right, y down, px
    drift.flags(points_px)                                     # (N,), 0 inside the calibrated range

Integer pixel coordinates are pixel centres. A model of the form `paper` uses the camera's temperature only; one of the
form `thermal` remembers the air, the supply and the camera, and must be fed for about three of its longest time
constants (`drift.memory_s`) before it is right, unless it was fed from a cold start on.
"""

import json
import math

import numpy as np

PLACE, CAMERA, AMBIENT, SWITCHED_ON, HISTORY = 1, 2, 4, 8, 16
"""Flags: the point is outside the markers' hull; the camera's temperature, the air's temperature or its rate of change
are outside the calibrated range; the camera was switched on too recently; it has not been followed for long enough."""

_RATE_TAU_S, _UNPOWERED_TAU_S, _COLD_K, _SETTLED_TAUS = 600.0, 900.0, 3.0, 3.0
_SPAN_K, _MARGIN, _HULL_MARGIN_PX, _SWITCHED_ON_S = 20.0, 0.02, 1.0, 1.0


class Drift:
    """One camera and its thermal state."""

    def __init__(self, model):
        """model: what the JSON file holds."""
        if model.get("format") != "thermostand drift runtime" or model.get("version") != 1:
            raise ValueError("not a drift runtime model of this version")
        self._model = model
        self._coefficients = np.array(model["coefficients_px"])
        self._hull_px = np.array(model["hull_px"])
        self._taus_s = np.array([_RATE_TAU_S, *model.get("taus_s", [])])
        self._radii_K = np.array(model.get("plays_K", []), float)
        self._camera_degC = math.nan
        self._begun = False

    @classmethod
    def load(cls, path):
        """The drift of a JSON file."""
        with open(path, encoding="utf-8") as file:
            return cls(json.load(file))

    @property
    def memory_s(self):
        """How long it must have been fed to be right, s; 0 for a form without memory."""
        return _SETTLED_TAUS * max(self._model.get("taus_s", []), default=0.0)

    def advance(self, dt_s, ambient_degC, power_on, camera_degC):
        """dt_s have passed, with this mean temperature of the air near the camera and this share (0..1) of them
        powered; at their end the camera tells its temperature (NaN: it does not). An ambient of NaN is a gap."""
        if math.isnan(ambient_degC) or math.isnan(power_on):
            self._begun = False
            self._camera_degC = camera_degC
            return
        if not self._begun:
            self._begin(ambient_degC, power_on, camera_degC)
        before_degC = self._camera_degC
        excess_K = (before_degC - self._air_degC) * math.exp(-dt_s / _UNPOWERED_TAU_S)
        self._air_degC = ambient_degC
        self._camera_degC = ambient_degC + excess_K if math.isnan(camera_degC) else camera_degC
        gained = -np.expm1(-dt_s / self._taus_s)
        self._ambient_lag += (ambient_degC - self._ambient_lag) * gained
        self._power_lag += (power_on - self._power_lag) * gained
        self._camera_lag += ((before_degC + self._camera_degC) / 2 - self._camera_lag) * gained
        self._plays = np.clip(self._plays, self._camera_degC - self._radii_K, self._camera_degC + self._radii_K)
        self._settled_s += dt_s
        self._on_s = self._on_s + dt_s if power_on == 1 else dt_s * power_on

    def shift(self, points_px):
        """Displacement (N, 2), px, of points (N, 2) to where they would be at the reference; NaN before `advance`."""
        points_px = np.asarray(points_px, float)
        if self._model["form"] == "paper":
            return self._polynomial(points_px) @ self._coefficients.T
        if not self._begun:
            return np.full_like(points_px, np.nan)
        amounts = self._coefficients @ (self._features() - np.array(self._model["reference_features"]))
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

    def _begin(self, ambient_degC, power_on, camera_degC):
        """In equilibrium; unless the camera is as cold as the air, that is a guess."""
        excess_K = 0.0 if math.isnan(camera_degC) else camera_degC - ambient_degC
        cold = abs(excess_K) < _COLD_K and not math.isnan(camera_degC)
        warmed = 0.0 if cold else min(max(excess_K / self._model.get("self_heating_K", 15.0), 0.0), 1.0)
        self._begun = True
        self._settled_s = math.inf if cold else 0.0
        self._on_s = 0.0 if cold or power_on == 0 else math.inf
        self._air_degC, self._camera_degC = ambient_degC, ambient_degC + excess_K
        self._ambient_lag = np.full(len(self._taus_s), float(ambient_degC))
        self._power_lag = np.full(len(self._taus_s), warmed)
        self._camera_lag = np.full(len(self._taus_s), self._camera_degC)
        self._plays = np.full(len(self._radii_K), self._camera_degC)

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
        own = (self._camera_degC - camera_degC) / _SPAN_K
        values = []
        for kind, parameter in self._model["terms"]:
            at = 1 + taus_s.index(parameter) if parameter in taus_s else 0
            values.append(
                {
                    "constant": lambda: 1.0,
                    "camera": lambda: own,
                    "camera squared": lambda: own**2,
                    "ambient lag": lambda at=at: (self._ambient_lag[at] - air_degC) / _SPAN_K,
                    "power lag": lambda at=at: self._power_lag[at] - 1,
                    "camera lag": lambda at=at: (self._camera_lag[at] - camera_degC) / _SPAN_K,
                    "camera lag squared": lambda at=at: ((self._camera_lag[at] - camera_degC) / _SPAN_K) ** 2,
                    "play": lambda r=parameter: (self._plays[radii_K.index(r)] - camera_degC) / _SPAN_K,
                }[kind]()
            )
        return np.array(values)

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
        if not self._begun:
            return CAMERA | AMBIENT | SWITCHED_ON | HISTORY
        rate_K_per_h = 3600 / _RATE_TAU_S * (self._air_degC - self._ambient_lag[0])
        found |= _beyond(rate_K_per_h, self._limits("rate_range_K_per_h", 1.0), AMBIENT)
        least_on_s = self._model["least_on_s"]
        least_on_s = math.inf if least_on_s is None else least_on_s - _SWITCHED_ON_S
        found |= _beyond(self._on_s, (least_on_s, math.inf), SWITCHED_ON)
        if self._model["taus_s"]:
            found |= _beyond(self._ambient_lag[-1], self._limits("ambient_range_degC"), AMBIENT)
        return found | _beyond(self._settled_s, (self.memory_s, math.inf), HISTORY)

    def _limits(self, name, least=0.0):
        """A calibrated range with its margin; the paper's form has none."""
        low, high = self._model[name]
        margin = 0.0 if self._model["form"] == "paper" else max(_MARGIN * (high - low), least)
        return low - margin, high + margin


def _beyond(value, limits, flag):
    return 0 if limits[0] <= value <= limits[1] else flag
