"""From what a thermal imager's sensor counted to temperatures, by the published formula of FLIR's radiometric files.

    S(T) = R1 / (R2 (exp(B / T) - F)) - O                                        counts of a black body, T in K
    tau  = X exp(-sqrt(d / 2) (alpha1 + beta1 sqrt(w))) + (1 - X) exp(-sqrt(d / 2) (alpha2 + beta2 sqrt(w)))

tau is the air's transmission on each side of a window halfway; w its water content, of the air's temperature and
humidity. The window reflects nothing.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

ZERO_C_K = 273.15


@dataclass(frozen=True, slots=True)
class Planck:
    """The calibration of one camera and range."""

    R1: float
    R2: float
    B: float
    F: float
    O: float  # noqa: E741 - the name that FLIR gives it

    def counts(self, T_K: float) -> float:
        """S(T); NaN for a temperature that has none."""
        if not T_K > 0:
            return math.nan
        bose = math.exp(min(self.B / T_K, 700.0)) - self.F
        return self.R1 / (self.R2 * bose) - self.O if bose > 0 else math.nan

    def degC(self, counts: NDArray[np.float64]) -> NDArray[np.float64]:
        """The inverse of `counts`, in degC; NaN where there is no such temperature."""
        with np.errstate(all="ignore"):
            argument = self.R1 / (self.R2 * (counts + self.O)) + self.F
            kelvin = self.B / np.log(np.where(argument > 0, argument, np.nan))
        return np.where((kelvin > 0) & np.isfinite(kelvin), kelvin - ZERO_C_K, np.nan)


@dataclass(frozen=True, slots=True)
class Air:
    """The air between: transmission constants of the camera, and how far it goes."""

    distance_m: float
    temperature_K: float
    humidity: float  # 0..1
    alpha1: float
    alpha2: float
    beta1: float
    beta2: float
    X: float

    @property
    def transmission(self) -> float:
        """tau; NaN outside the formula's range."""
        t = self.temperature_K - ZERO_C_K
        exponent = 1.5587 + 0.06939 * t - 0.00027816 * t * t + 0.00000068455 * t * t * t
        if not (self.distance_m >= 0 and self.humidity >= 0 and abs(exponent) < 50):
            return math.nan
        way, root_w = math.sqrt(self.distance_m / 2), math.sqrt(self.humidity * math.exp(exponent))
        first, second = self.alpha1 + self.beta1 * root_w, self.alpha2 + self.beta2 * root_w
        if not (abs(first) * way <= 50 and abs(second) * way <= 50):  # nor NaN
            return math.nan
        return self.X * math.exp(-way * first) + (1 - self.X) * math.exp(-way * second)


@dataclass(frozen=True, slots=True)
class RadiometricSurroundings:
    """What else reaches the sensor: what the object reflects, and a window."""

    air: Air
    reflected_K: float
    window_K: float
    window_transmission: float


def compute_temperatures_degC(
    raw: NDArray[np.uint16], planck: Planck, around: RadiometricSurroundings, emissivity: float
) -> NDArray[np.float64]:
    """Compute the temperatures of a surface with this emissivity (0..1], in degC, shape of `raw`; NaN where the formula
    has no answer."""
    tau, tw = around.air.transmission, around.window_transmission
    if not (tau > 0 and tw > 0 and emissivity > 0):
        return np.full(raw.shape, np.nan)
    air = planck.counts(around.air.temperature_K)
    seen = raw / (emissivity * tau * tw * tau)
    seen = seen - (1 - tau) / (emissivity * tau) * air
    seen = seen - (1 - emissivity) / emissivity * planck.counts(around.reflected_K)
    seen = seen - (1 - tw) / (emissivity * tau * tw) * planck.counts(around.window_K)
    seen = seen - (1 - tau) / (emissivity * tau * tw * tau) * air
    return planck.degC(seen)
