"""What a camera remembers of its thermal past, at many instants.

The recursion that follows it is that of the runtime (drift_runtime.py): fed sample by sample, from a recording
(thermal_history.py) or live, it gives the same state.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermostand.compensation.drift_runtime import INPUTS, ThermalState
from thermostand.compensation.expression import AIR

Float = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class ThermalMemory:
    """What a model needs remembered: lags and plays (compensation/expression.py), each after those it is made of.
    self_heating_K: of a camera over the air that has been on for long."""

    parts: tuple[Any, ...] = ()
    self_heating_K: float = 15.0

    @property
    def at(self) -> dict[Any, int]:
        """Where in a state's values each input, lag and play is."""
        return {part: place for place, part in enumerate((*INPUTS, *self.parts))}

    @property
    def longest_s(self) -> float:
        """Its longest time constant; 0 without one."""
        return max((tau_s for kind, _, tau_s in self.parts if kind == "lag"), default=0.0)

    @property
    def ambient_lag(self) -> Any:
        """The quickest lag of the air; ValueError without one."""
        return min((part for part in self.parts if part[:2] == ("lag", AIR)), key=lambda part: part[2])


@dataclass(frozen=True, slots=True, eq=False)
class States:
    """A camera's thermal state at F instants. rows (F, 3 + P + 2): camera, air and supply, the P lags and plays of
    `memory`, then on_s and settled_s. NaN where unknown."""

    memory: ThermalMemory
    rows: Float

    @classmethod
    def at_degC(cls, camera_degC: float | Float, count: int, memory: ThermalMemory | None = None) -> States:
        """Nothing but the camera's temperature is known, one or (F,), at `count` instants."""
        memory = memory or ThermalMemory()
        rows = np.full((count, len(memory.at) + 2), np.nan)
        rows[:, 0] = camera_degC
        return cls(memory, rows)

    @property
    def columns(self) -> Float:
        """(3 + P, F): the values, as `memory.at` places them."""
        return self.rows.T[:-2]

    @property
    def camera_degC(self) -> Float:
        """(F,): its own temperature."""
        return self.rows[:, 0]

    @property
    def on_s(self) -> Float:
        """(F,): since it was switched on, inf when that was before the record."""
        return self.rows[:, -2]

    @property
    def settled_s(self) -> Float:
        """(F,): how long ago the state was a guess, inf when it began as cold as the air."""
        return self.rows[:, -1]

    def of(self, parts: Iterable[Any]) -> Float:
        """(F, N): these inputs, lags or plays. KeyError for what is not remembered."""
        at = self.memory.at
        return np.take(self.rows, [at[part] for part in parts], axis=1)

    def where(self, rows: NDArray[np.int64] | NDArray[np.bool_]) -> States:
        """The instants of an index or a mask, in its order."""
        return States(self.memory, self.rows[rows])


def state_of(memory: ThermalMemory) -> ThermalState:
    """A camera's thermal state that remembers this, before its first sample."""
    return ThermalState(memory.parts, memory.self_heating_K)


def row_of(state: ThermalState) -> Float:
    """The state now, a row of States; all NaN in a gap."""
    return np.array([*state.values, state.on_s, state.settled_s]) + (0.0 if state.begun else math.nan)
