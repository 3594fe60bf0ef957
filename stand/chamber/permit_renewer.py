"""Renews the permits while the guard finds all well, and sees to it that nothing is on that is not permitted.

It speaks to the bus, and may have to wait for it; the guard's looks do not. When it cannot renew, the relays drop by
themselves, which is their safe state.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from thermostand.drivers.devices.protocols import Controller
from thermostand.foundation.clock import Clock, to_ns
from thermostand.foundation.errors import DeviceError
from thermostand.foundation.events import PERMIT_NOT_RENEWED, SWITCHED_OFF
from thermostand.foundation.hub import Hub
from thermostand.stand.chamber.permits import Permission, Permits
from thermostand.stand.safety.fault import get_value

SUPERVISION_PERIOD_S = 2.5  # between looks at relays and regulator while nothing is permitted: off again within 5 s


@dataclass
class PermitRenewer:
    """Every `renew_s` the permits while they are granted; without them every 2.5 s a look at what must be off.

    `coils_read` is given what the relays read each time, by channel.
    """

    permits: Permits
    regulator: Controller
    hub: Hub
    clock: Clock
    renew_s: float
    coils_read: Callable[[Mapping[str, bool]], None]
    _last_failure: tuple[type[DeviceError], str] | None = None  # the kind of error, and the device, of the last renewal

    async def run(self) -> None:
        """Keep until cancelled. What keeps it from that is an event when it begins, and when it is another."""
        due_ns = self.clock.now_ns()
        while True:
            try:
                await self.renew_once()
                self._last_failure = None
            except DeviceError as error:
                kept_by = type(error), error.device
                if self._last_failure != kept_by:
                    self._last_failure = kept_by
                    self.hub.publish(PERMIT_NOT_RENEWED.at(self.clock.now_ns(), str(error)))
            period_s = self.renew_s if self.permits.is_granted else min(self.renew_s, SUPERVISION_PERIOD_S)
            due_ns = max(due_ns + to_ns(period_s), self.clock.now_ns())
            await self.clock.sleep_until(due_ns)

    async def renew_once(self) -> None:
        """Compare the relays once; arm them while that is permitted, else stop the timer. DeviceError."""
        if self.permits.is_granted:
            mv_heat, mv_cool = (get_value(self.hub, f"{self.regulator.name}.{name}") for name in ("mv_heat", "mv_cool"))
            coils = await self.permits.arm(mv_heat, mv_cool)
        else:
            coils = await self.permits.supervise()
            await self._stop_regulator()
        self.coils_read(coils)

    async def _stop_regulator(self) -> None:
        """A regulator that runs, or gives an output, while nothing is permitted."""
        if self.permits.permission is not Permission.WITHDRAWN:
            return
        readings = {reading.channel: reading.value for reading in await self.regulator.read()}
        found = [
            name for name in ("running", "mv_heat", "mv_cool") if readings.get(f"{self.regulator.name}.{name}", 0) > 0
        ]
        if not found or self.permits.permission is not Permission.WITHDRAWN:  # after the wait it may be permitted
            return
        self.permits.intrusions += 1
        await self.regulator.make_safe()
        device, times = self.regulator.name, self.permits.intrusions
        self.hub.publish(SWITCHED_OFF.at(self.clock.now_ns(), ", ".join(found), device=device, times=times))
