"""What a camera remembers of its thermal past: the recursion that follows it, and its values at many instants.

`ThermalState.advance` is fed sample by sample, from a recording (history.py) or live; both give the
same state.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from compensation.history.lags import Float, lagged, played

RATE_TAU_S = 600.0
"""The ambient's rate of change is that of its 10 min lag."""

SETTLED_TAUS = 3.0
"""After so many time constants a state that began with a guess has forgotten it (5 % are left)."""

_COLD_K = 3.0
"""A camera this close to the air around it has been off for long: nothing of it is warm."""

_UNPOWERED_TAU_S = 900.0
"""An unpowered camera tells no temperature; its excess over the air is taken to decay like this until it does again."""

_SINGLES = 4


@dataclass(frozen=True, slots=True)
class Memory:
    """What a model needs remembered: lags of ambient, power and camera temperature with these time constants, plays of
    the camera's temperature with these radii. self_heating_K: of a camera over the air that has been on for long."""

    taus_s: tuple[float, ...] = ()
    plays_K: tuple[float, ...] = ()
    self_heating_K: float = 15.0


@dataclass(frozen=True, slots=True, eq=False)
class States:
    """A camera's thermal state at F instants; K time constants and P plays as `memory` lists them.

    camera_degC (F,): its own temperature. ambient_lag_degC, power_lag, camera_lag_degC (F, K): of the air near the
    camera, of its supply (0..1), of its own temperature. play_degC (F, P). rate_K_per_h (F,): of the ambient.
    on_s (F,): since it was switched on, inf when that was before the record. settled_s (F,): how long ago the state was
    a guess, inf when it began as cold as the air. NaN where unknown.
    """

    memory: Memory
    camera_degC: Float
    ambient_lag_degC: Float
    power_lag: Float
    camera_lag_degC: Float
    play_degC: Float
    rate_K_per_h: Float
    on_s: Float
    settled_s: Float

    @classmethod
    def from_rows(cls, memory: Memory, rows: Float) -> States:
        """Of rows (F, 4 + 3 K + P) as ThermalState.row gives them."""
        count = len(memory.taus_s)
        singles, ambient, power, camera, plays = np.split(rows, _SINGLES + count * np.arange(4), axis=1)
        return cls(memory, singles[:, 0], ambient, power, camera, plays, singles[:, 1], singles[:, 2], singles[:, 3])

    @classmethod
    def at_degC(cls, camera_degC: float | Float, count: int, memory: Memory | None = None) -> States:
        """Nothing but the camera's temperature is known, one or (F,), at `count` instants."""
        memory = memory or Memory()
        rows = np.full((count, _SINGLES + 3 * len(memory.taus_s) + len(memory.plays_K)), np.nan)
        rows[:, 0] = camera_degC
        return cls.from_rows(memory, rows)

    @property
    def rows(self) -> Float:
        """(F, 4 + 3 K + P), as `from_rows` takes them."""
        singles = np.column_stack([self.camera_degC, self.rate_K_per_h, self.on_s, self.settled_s])
        return np.hstack([singles, self.ambient_lag_degC, self.power_lag, self.camera_lag_degC, self.play_degC])

    def where(self, rows: NDArray[np.int64] | NDArray[np.bool_]) -> States:
        """The instants of an index or a mask, in its order."""
        return States.from_rows(self.memory, self.rows[rows])


class ThermalState:
    """The state of one camera, followed from sample to sample.

    It begins, and begins again after a gap, in equilibrium: lags of temperatures at these temperatures, lags of the
    power at the part of its self-heating that the camera shows. Unless the camera is as cold as the air, that is a
    guess, which is forgotten after about three of the time constants.
    """

    def __init__(self, memory: Memory) -> None:
        self._memory = memory
        self._taus_s = np.array([RATE_TAU_S, *memory.taus_s])
        self._radii_K = np.array(memory.plays_K, np.float64)
        self._begun = False
        self._settled_s = self._on_s = math.nan
        self._air_degC = self._camera_degC = math.nan
        self._ambient_lag = self._power_lag = self._camera_lag = np.full(len(self._taus_s), math.nan)
        self._plays = np.full(len(self._radii_K), math.nan)

    def advance(self, dt_s: float, ambient_degC: float, power_on: float, camera_degC: float) -> None:
        """dt_s have passed, with this mean ambient temperature and this share of them powered; at their end the camera
        tells its temperature (NaN: it does not). An ambient of NaN is a gap."""
        if math.isnan(ambient_degC) or math.isnan(power_on):
            self._begun = False
            return
        if not self._begun:
            self._begin(ambient_degC, power_on, camera_degC)
        excess_K = (self._camera_degC - self._air_degC) * math.exp(-dt_s / _UNPOWERED_TAU_S)
        before_degC, self._air_degC = self._camera_degC, ambient_degC
        self._camera_degC = ambient_degC + excess_K if math.isnan(camera_degC) else camera_degC
        self._ambient_lag = lagged(self._ambient_lag, ambient_degC, dt_s, self._taus_s)
        self._power_lag = lagged(self._power_lag, power_on, dt_s, self._taus_s)
        self._camera_lag = lagged(self._camera_lag, (before_degC + self._camera_degC) / 2, dt_s, self._taus_s)
        self._plays = played(self._plays, self._camera_degC, self._radii_K)
        self._settled_s += dt_s
        self._on_s = self._on_s + dt_s if power_on == 1 else dt_s * power_on

    @property
    def row(self) -> Float:
        """The state now, (4 + 3 K + P,); all NaN in a gap."""
        rate_K_per_h = 3600 / RATE_TAU_S * (self._air_degC - self._ambient_lag[0])
        singles = [self._camera_degC, rate_K_per_h, self._on_s, self._settled_s]
        lags = [self._ambient_lag[1:], self._power_lag[1:], self._camera_lag[1:]]
        return np.concatenate([singles, *lags, self._plays]) + (0.0 if self._begun else math.nan)

    @property
    def states(self) -> States:
        """The state now, as one instant."""
        return States.from_rows(self._memory, self.row[None])

    def _begin(self, ambient_degC: float, power_on: float, camera_degC: float) -> None:
        excess_K = 0.0 if math.isnan(camera_degC) else camera_degC - ambient_degC
        cold = abs(excess_K) < _COLD_K and not math.isnan(camera_degC)
        warmed = 0.0 if cold else min(max(excess_K / self._memory.self_heating_K, 0.0), 1.0)
        count = len(self._taus_s)
        self._begun = True
        self._settled_s = math.inf if cold else 0.0
        self._on_s = 0.0 if cold or power_on == 0 else math.inf
        self._air_degC, self._camera_degC = ambient_degC, ambient_degC + excess_K
        self._ambient_lag = np.full(count, ambient_degC)
        self._power_lag = np.full(count, warmed)
        self._camera_lag = np.full(count, self._camera_degC)
        self._plays = np.full(len(self._radii_K), self._camera_degC)
