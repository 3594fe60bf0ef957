"""What a camera remembers of its thermal past, at many instants.

The recursion that follows it is that of the runtime (drift_runtime.py): fed sample by sample, from a recording
(thermal_history.py) or live, it gives the same state.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thermostand.compensation.drift_runtime import ThermalState

Float = NDArray[np.float64]

_SINGLES = 4


@dataclass(frozen=True, slots=True)
class Memory:
    """What a model needs remembered: lags of ambient, power and camera temperature with these time constants, plays of
    the camera's temperature with these radii. self_heating_K: of a camera over the air that has been on for long.
    part_plays: time constant (one of taus_s), share and radius of plays of parts that nobody measures, see
    drift_runtime.ThermalState."""

    taus_s: tuple[float, ...] = ()
    plays_K: tuple[float, ...] = ()
    self_heating_K: float = 15.0
    part_plays: tuple[tuple[float, float, float], ...] = ()

    @property
    def plays(self) -> int:
        """How many, those of parts among them."""
        return len(self.plays_K) + len(self.part_plays)


@dataclass(frozen=True, slots=True, eq=False)
class States:
    """A camera's thermal state at F instants; K time constants and P plays as `memory` lists them, those of parts last.

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
        """Of rows (F, 4 + 3 K + P) as `row_of` gives them."""
        count = len(memory.taus_s)
        singles, ambient, power, camera, plays = np.split(rows, _SINGLES + count * np.arange(4), axis=1)
        return cls(memory, singles[:, 0], ambient, power, camera, plays, singles[:, 1], singles[:, 2], singles[:, 3])

    @classmethod
    def at_degC(cls, camera_degC: float | Float, count: int, memory: Memory | None = None) -> States:
        """Nothing but the camera's temperature is known, one or (F,), at `count` instants."""
        memory = memory or Memory()
        rows = np.full((count, _SINGLES + 3 * len(memory.taus_s) + memory.plays), np.nan)
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


def state_of(memory: Memory) -> ThermalState:
    """A camera's thermal state that remembers this, before its first sample."""
    return ThermalState(memory.taus_s, memory.plays_K, memory.self_heating_K, memory.part_plays)


def row_of(state: ThermalState) -> Float:
    """The state now, (4 + 3 K + P,), as States.from_rows takes it; all NaN in a gap."""
    singles = [state.camera_degC, state.rate_K_per_h, state.on_s, state.settled_s]
    lags = [state.ambient_lag[1:], state.power_lag[1:], state.camera_lag[1:]]
    return np.concatenate([singles, *lags, state.plays]) + (0.0 if state.begun else math.nan)
