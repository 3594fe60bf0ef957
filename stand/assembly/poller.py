"""Reads one device on its period and publishes what it gave; a failed read is a BAD reading, never an old value.

Whether the wire failed (it is asked again soon) or the device itself declines is in the readings' cause.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from thermostand.drivers.devices.protocols import Sensor
from thermostand.foundation.clock import NS_PER_S, Clock, to_ns
from thermostand.foundation.errors import DeviceError
from thermostand.foundation.events import DEVICE_BACK, DEVICE_FAST, DEVICE_LOST, DEVICE_SLOW
from thermostand.foundation.hub import Hub
from thermostand.foundation.items import Batch
from thermostand.foundation.readings import Cause, Reading, bad_reading

_AGAIN_S = 1.0  # after a poll that failed on the wire


@dataclass
class Poller:
    """Polls `sensor` every `period_s` (absolute deadlines) until cancelled; 1 s after a poll that failed on the wire.

    `first()` must succeed before `run()`: what it returns defines which channels to declare BAD when a later read
    fails; a device that has nothing new gives none, and none are published. mark: what is published of the readings of
    a poll at an instant (ns); it may mark some as STALE. A device whose read takes longer than the period is an event,
    and one more when a read is within half a period again.
    """

    sensor: Sensor
    period_s: float
    hub: Hub
    clock: Clock
    mark: Callable[[tuple[Reading, ...], int], tuple[Reading, ...]] = lambda readings, now_ns: readings

    def __post_init__(self) -> None:
        self._known: tuple[Reading, ...] = ()
        self._failing = False
        self._lost_ns = 0
        self._is_slow = False
        self._ask_again = False

    async def first(self) -> None:
        """The first read, published; raises DeviceError, because a stand that cannot read does not start."""
        self._publish(await self.sensor.read())

    async def run(self) -> None:
        """Poll until cancelled."""
        due_ns = self.clock.now_ns()
        while True:
            period_ns = to_ns(min(self.period_s, _AGAIN_S) if self._ask_again else self.period_s)
            due_ns = max(due_ns + period_ns, self.clock.now_ns())  # a late poll is not made up for by a burst
            await self.clock.sleep_until(due_ns)
            await self.poll()

    async def poll(self) -> None:
        """Read once and publish; a failed read is published as BAD readings."""
        begin_ns = self.clock.now_ns()
        try:
            readings = await self.sensor.read()
        except DeviceError as error:
            self._publish_loss(error)
            return
        self._ask_again = False
        self._check_duration(self.clock.now_ns() - begin_ns)
        if self._failing:
            self._failing = False
            now_ns, name = self.clock.now_ns(), self.sensor.name
            lost_s = round((now_ns - self._lost_ns) / NS_PER_S, 3)
            self.hub.publish(DEVICE_BACK.at(now_ns, device=name, lost_s=lost_s))
        self._publish(readings)

    def _check_duration(self, took_ns: int) -> None:
        """Check the duration of one read that succeeded."""
        is_slow = took_ns > to_ns(self.period_s / 2 if self._is_slow else self.period_s)
        if is_slow == self._is_slow:
            return
        self._is_slow = is_slow
        took_s, kind = round(took_ns / NS_PER_S, 3), DEVICE_SLOW if is_slow else DEVICE_FAST
        now_ns = self.clock.now_ns()
        self.hub.publish(kind.at(now_ns, device=self.sensor.name, took_s=took_s, period_s=self.period_s))

    def _publish(self, readings: tuple[Reading, ...]) -> None:
        if not readings:
            return
        readings = self._known = self.mark(readings, self.clock.now_ns())
        self.hub.publish(Batch(self.sensor.name, self.clock.now_ns(), readings))

    def _publish_loss(self, error: DeviceError) -> None:
        now_ns, reason = self.clock.now_ns(), str(error)
        self._ask_again = error.retryable
        cause: Cause = "wire" if error.retryable else "device"
        if not self._failing:
            self._failing, self._lost_ns = True, now_ns
            data = {"device": self.sensor.name, "error": type(error).__name__, "cause": cause}
            self.hub.publish(DEVICE_LOST.at(now_ns, reason, **data))
        bad = tuple(bad_reading(reading.channel, reading.unit, now_ns, reason, cause) for reading in self._known)
        self.hub.publish(Batch(self.sensor.name, now_ns, bad))
