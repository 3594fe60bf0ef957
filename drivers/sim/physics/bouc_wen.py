"""Thermal tension in the joints of an unmodified camera: a Bouc-Wen element that creeps and now and then slips.

The paper (sections 3.2 and 4) found the drift of a camera as bought to differ between warming and cooling and not to
repeat, and blames tension that builds up in the lens mount and the sensor's support and lets go irregularly.
"""

from __future__ import annotations

import random


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
