"""What of a camera follows late, not fully, or never twice alike: lag, play, stick-slip and fixings."""

from __future__ import annotations

import math
import random


class Lag:
    """First order: `value` follows with time constant tau_s."""

    def __init__(self, tau_s: float, value: float) -> None:
        self.value = value
        self._tau_s = tau_s

    def step(self, wanted: float, dt_s: float) -> None:
        """Towards `wanted` for dt_s."""
        self.value += (float(wanted) - self.value) * -math.expm1(-dt_s / self._tau_s)


class Backlash:
    """A dead zone: place_K follows what pushes it only once that is more than half_K away."""

    def __init__(self, half_K: float) -> None:
        self.place_K = 0.0
        self._half_K = half_K

    def step(self, push_K: float) -> None:
        """Take where the push is now."""
        self.place_K = min(max(self.place_K, push_K - self._half_K), push_K + self._half_K)


class StickSlip:
    """A contact: place_K stays until the push is about threshold_K away (0.5 to 1.5 of it, another time each time), and
    then makes up for 0.6 to 1.0 of the way."""

    def __init__(self, threshold_K: float, seed: str) -> None:
        self.place_K = 0.0
        self._random = random.Random(seed)
        self._threshold_K = threshold_K
        self._limit_K = threshold_K

    def step(self, push_K: float) -> None:
        """Take where the push is now."""
        if abs(push_K - self.place_K) > self._limit_K:
            self.place_K += (push_K - self.place_K) * self._random.uniform(0.6, 1.0)
            self._limit_K = self._threshold_K * self._random.uniform(0.5, 1.5)


class Fixings:
    """place_px (x, y): another place after each travel_K of temperature, up or down; normal, of scatter_px, with a
    memory of 0.6 of the one before; reached with a time constant of 20 min."""

    SETTLING_S = 1200.0

    def __init__(self, scatter_px: float, travel_K: float, seed: str) -> None:
        self._random = random.Random(seed)
        self._scatter_px, self._travel_K = scatter_px, travel_K
        self._left_K = travel_K
        self._wanted_px = (0.0, 0.0)
        self._place = (Lag(self.SETTLING_S, 0.0), Lag(self.SETTLING_S, 0.0))

    @property
    def place_px(self) -> tuple[float, float]:
        """Return where the fixings are now."""
        return self._place[0].value, self._place[1].value

    def step(self, travelled_K: float, dt_s: float) -> None:
        """Take how far the temperature went within dt_s."""
        self._left_K -= travelled_K
        if self._left_K <= 0:
            self._left_K = self._travel_K
            x, y = self._wanted_px
            new = 0.8 * self._scatter_px
            self._wanted_px = (0.6 * x + new * self._random.gauss(0, 1), 0.6 * y + new * self._random.gauss(0, 1))
        for lag, wanted in zip(self._place, self._wanted_px, strict=True):
            lag.step(wanted, dt_s)


# Thermal tension in the joints of an unmodified camera: a Bouc-Wen element that creeps and now and then slips.
#
# The paper (sections 3.2 and 4) found the drift of a camera as bought to differ between warming and cooling and not to
# repeat, and blames tension that builds up in the lens mount and the sensor's support and lets go irregularly.


class BoucWen:
    """Tension of one joint, in K of body temperature change it has stored; |tension_K| stays below `limit_K`.

    Following Bouc and Wen, with x the body's temperature, Z the limit and n the sharpness of the knee:

        dz = dx (1 - (1 + sign(z dx))/2 |z/Z|^n) - z dt/tau

    Loading bends over to Z, unloading starts with the full slope. The last term is creep. After every so many K of
    travel, drawn from `seed`, the joint slips and keeps only a part of its tension.
    """

    def __init__(self, limit_K: float, seed: int, sharpness: float = 1.5, creep_s: float = 30_000.0) -> None:
        self.tension_K = 0.0
        self._limit_K = limit_K
        self._sharpness = sharpness
        self._creep_s = creep_s
        self._random = random.Random(seed)
        self._travel_to_slip_K = self._draw_travel_K()

    def step(self, change_K: float, dt_s: float) -> None:
        """Take a change of the body's temperature that happened within dt_s."""
        tension_K = self.tension_K
        yielding = abs(tension_K / self._limit_K) ** self._sharpness if tension_K * change_K > 0 else 0.0
        self.tension_K = tension_K + change_K * (1.0 - yielding) - tension_K * dt_s / self._creep_s
        self._travel_to_slip_K -= abs(change_K)
        if self._travel_to_slip_K <= 0.0:
            self.tension_K *= self._random.uniform(0.5, 0.9)
            self._travel_to_slip_K = self._draw_travel_K()

    def _draw_travel_K(self) -> float:
        return self._random.uniform(15.0, 60.0)
