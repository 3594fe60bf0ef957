"""Whether the camera is in thermal equilibrium with the chamber, as far as its supply is concerned.

A camera that was off, or may have been, is cold: what it was soaked before does not count. It has come to equilibrium
when its own temperature moves slowly for a while, or, when it has none, after five time constants of its slowest
part.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Mapping

import numpy as np

from thermostand.drivers.settings import EquilibriumSettings
from thermostand.foundation.clock import NS_PER_S, Clock, to_ns
from thermostand.foundation.events import (
    CAMERA_EQUILIBRIUM,
    CAMERA_EQUILIBRIUM_LATE,
    CAMERA_EQUILIBRIUM_LOST,
    EventKind,
)
from thermostand.foundation.hub import Hub
from thermostand.foundation.items import Batch, Item
from thermostand.foundation.readings import Quality
from thermostand.stand.imaging.settling import Float, find_digit_K, fit_camera_rate, to_seconds

CAMERA = "camera.temperature"
# 0.7 % of a step are left then; half of it leaves 8 %, twice holds a run without a temperature for twice as long.
_TIME_CONSTANTS = 5.0
_LOOK_S = 10.0  # a camera takes minutes
_UNKNOWN_S = 60.0  # without a reading; a longer gap leaves open what happened in it


class CameraEquilibrium:
    """The thermal equilibrium of one camera; `is_lost` from `lose` until `wait_until_regained` has returned, or
    `forget`."""

    def __init__(self, limits: EquilibriumSettings, hub: Hub, clock: Clock) -> None:
        self.is_lost = False
        self._limits = limits
        self._hub = hub
        self._clock = clock
        self._since_ns = clock.now_ns()  # what is read before counts for nothing
        self._readings: deque[tuple[float, float]] = deque()
        self._listeners: list[Callable[[], None]] = []
        hub.subscribe(self._receive)

    def subscribe(self, listener: Callable[[], None]) -> None:
        """Call `listener()` at once whenever the equilibrium is lost."""
        self._listeners.append(listener)

    def unsubscribe(self, listener: Callable[[], None]) -> None:
        """Call it no more; nothing happens when it was not subscribed."""
        self._listeners = [each for each in self._listeners if each != listener]

    def lose(self, reason: str, data: Mapping[str, object] | None = None) -> None:
        """It is lost from now on; event `camera_equilibrium_lost`."""
        self.is_lost = True
        self.begin()
        self._hub.publish(CAMERA_EQUILIBRIUM_LOST.at(self._clock.now_ns(), **{"reason": reason, **(data or {})}))
        for listener in self._listeners:
            listener()

    def begin(self) -> None:
        """The camera is on from now on."""
        self._since_ns = self._clock.now_ns()
        self._readings.clear()

    def forget(self) -> None:
        """The plan itself switches the camera: what follows in it is made for that."""
        self.is_lost = False

    def soaked_s(self) -> float | None:
        """Return how long the camera has been soaked since its equilibrium was lost; None when it need not be."""
        return (self._clock.now_ns() - self._since_ns) / NS_PER_S if self.is_lost else None

    async def wait_until_regained(self, is_disturbed: Callable[[], bool]) -> None:
        """Return when the camera is in equilibrium, with the event `camera_equilibrium`, or when it is disturbed."""
        tell_ns = self._since_ns + self._longest_ns
        while self.is_lost and not is_disturbed():
            now_ns = self._clock.now_ns()
            rate_K_per_min = self._rate_K_per_min(now_ns)
            if self._is_reached(now_ns, rate_K_per_min):
                return self._end_equilibration(now_ns, rate_K_per_min)
            if now_ns >= tell_ns:
                tell_ns += self._longest_ns
                self._publish(CAMERA_EQUILIBRIUM_LATE, now_ns, rate_K_per_min)
            await self._clock.sleep_until(now_ns + to_ns(_LOOK_S))

    @property
    def _longest_ns(self) -> int:
        return to_ns(_TIME_CONSTANTS * self._limits.time_constant_s)

    def _is_reached(self, now_ns: int, rate_K_per_min: float) -> bool:
        if math.isnan(rate_K_per_min):
            has_temperature = bool(self._readings) and to_seconds(now_ns) - self._readings[-1][0] <= _UNKNOWN_S
            return not has_temperature and now_ns - self._since_ns >= self._longest_ns
        return rate_K_per_min < self._limits.rate_K_per_min

    def _rate_K_per_min(self, now_ns: int) -> float:
        """Return how fast the camera's temperature may have moved within the last `duration_s`; NaN when it was not
        known throughout."""
        end_s, length_s = to_seconds(now_ns), self._limits.duration_s
        if to_seconds(self._since_ns) > end_s - length_s:
            return math.nan
        readings: Float = np.array([each for each in self._readings if each[0] >= end_s - length_s], np.float64)
        times_s = np.concatenate(([end_s - length_s], readings.reshape(-1, 2)[:, 0], [end_s]))
        if len(readings) < 8 or np.diff(times_s).max() > min(_UNKNOWN_S, length_s / 4):
            return math.nan
        digit = find_digit_K(readings[:, 1])
        # An exponential approach is fastest at the window's beginning: its first half must be slow by itself, too.
        first = readings[readings[:, 0] < end_s - length_s / 2]
        rates = (fit_camera_rate(readings.T, digit).bound, abs(fit_camera_rate(first.T, digit).per_min))
        return float(np.max(rates))  # NaN when one of them is

    def _end_equilibration(self, now_ns: int, rate_K_per_min: float) -> None:
        self.is_lost = False
        self._publish(CAMERA_EQUILIBRIUM, now_ns, rate_K_per_min)

    def _publish(self, kind: EventKind, now_ns: int, rate_K_per_min: float) -> None:
        soaked_s, rate = (now_ns - self._since_ns) / NS_PER_S, None if math.isnan(rate_K_per_min) else rate_K_per_min
        self._hub.publish(kind.at(now_ns, soaked_s=soaked_s, rate_K_per_min=rate))

    def _receive(self, item: Item) -> None:
        """The hub's subscriber."""
        if isinstance(item, Batch):
            for reading in item.readings:
                is_good = reading.channel == CAMERA and reading.quality is Quality.GOOD
                if is_good and reading.time_ns >= self._since_ns:
                    self._keep(to_seconds(reading.time_ns), reading.value)

    def _keep(self, time_s: float, camera_degC: float) -> None:
        """Keep a value as long as a rate is judged by it."""
        self._readings.append((time_s, camera_degC))
        while self._readings[0][0] < time_s - self._limits.duration_s:
            self._readings.popleft()
