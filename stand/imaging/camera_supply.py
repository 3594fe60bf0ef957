"""The camera's supply: on and off by the plan, restored after a loss, and what each means for its equilibrium."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field

from thermostand.drivers.devices.protocols import Switches
from thermostand.drivers.devices.relays import CAMERA_POWER
from thermostand.drivers.settings import EquilibriumSettings
from thermostand.foundation.clock import Clock, to_ns
from thermostand.foundation.errors import DeviceError, Unreachable
from thermostand.foundation.events import CAMERA_SUPPLY_OFF
from thermostand.foundation.hub import Hub
from thermostand.foundation.tasks import cancel_all
from thermostand.stand.imaging.camera_cooling import CameraTemperature, cool_down, get_last_temperature
from thermostand.stand.imaging.camera_recovery import LOST_LIMIT_S, RETRY_S, CameraRecovery
from thermostand.stand.imaging.cameras import Cameras
from thermostand.stand.imaging.equilibrium import CAMERA, CameraEquilibrium
from thermostand.stand.safety.gate import CAMERA_LOST, Gate
from thermostand.stand.safety.interlock import Interlock

_BOOT_LIMIT_S = 60.0  # round number; nothing was measured


@dataclass(frozen=True, slots=True)
class SupplyLimits:
    """How long the camera takes to boot (s), for how long its relay is held at a time until it has answered (s), and
    when it counts as being in equilibrium. channels: of the relay board, for the sentence about exchanged ones."""

    boot_s: float
    hold_s: float
    equilibrium: EquilibriumSettings = field(default_factory=EquilibriumSettings)
    channels: Mapping[str, int] = field(default_factory=dict[str, int])


class CameraSupply:
    """The relay of all cameras, and an actuator that is safe when it is off.

    is_on: the supply is on and the camera has been opened since, as far as is known. was_on: what the relay read before
    this daemon switched it on; None before that. last: the camera's temperature when it was switched off.
    """

    def __init__(
        self,
        *,
        cameras: Cameras,
        relays: Switches,
        limits: SupplyLimits,
        interlock: Interlock,
        gate: Gate,
        hub: Hub,
        clock: Clock,
    ) -> None:
        self.name = f"{relays.name}.{CAMERA_POWER}"
        self.is_on = False
        self.was_on: bool | None = None
        self.last: CameraTemperature | None = None
        self._cameras = cameras
        self._relays = relays
        self._limits = limits
        self._interlock = interlock
        self._gate = gate
        self._hub = hub
        self._clock = clock
        self.equilibrium = CameraEquilibrium(limits.equilibrium, hub, clock)
        self.recovery = CameraRecovery(cameras, hub, clock, lambda: self.is_on, self.equilibrium.lose)

    async def switch_on(self) -> None:
        """Return when the camera is open and configured."""
        self._interlock.check()
        self.last = None
        await self._supply()
        self.is_on = True
        self.publish_identities()
        self.equilibrium.begin()

    def publish_identities(self) -> None:
        """Publish which cameras are on, for the recording; nothing when one was lost meanwhile."""
        if self._cameras.is_usable:
            for event in self._cameras.identities(self._clock.now_ns()):
                self._hub.publish(event)

    async def switch_off(self) -> None:
        """Close the camera, then switch it off."""
        self._interlock.check()
        # A camera that was off already has no newer temperature.
        self.last = get_last_temperature(self._hub.known(CAMERA)) or self.last
        self.is_on = False
        await self._cameras.close()
        await self._relays.switch(CAMERA_POWER, on=False)

    async def cool_down(self, band_K: float, time_constant_s: float, max_s: float) -> None:
        """Wait until the camera, which is off, should be within `band_K` of the air near it."""
        self._interlock.check()
        await cool_down(self.last, band_K, time_constant_s, max_s, self._hub, self._clock)

    async def restore(self) -> None:
        """Switch the supply on again after the equilibrium was lost, should it be off, and open the camera; tried for
        30 min, the gate being held. Nothing on a stand without cameras."""
        if self.is_on or not self._cameras.names:
            return
        deadline_ns = self._clock.now_ns() + to_ns(LOST_LIMIT_S)
        self._gate.hold(CAMERA_LOST)
        try:
            while not self.is_on:
                try:
                    await self.switch_on()
                except Unreachable:
                    if self._clock.now_ns() >= deadline_ns:
                        raise
        finally:
            self._gate.clear(CAMERA_LOST)

    async def make_safe(self) -> None:
        """Off, confirmed; the cameras are let go meanwhile, since Aravis waits for seconds for one that is off."""
        self.is_on = False
        await self._cameras.close(self._relays.switch(CAMERA_POWER, on=False))

    def compare(self, coils: Mapping[str, bool]) -> None:
        """Compare what the relays read, by channel: a supply that is off though it was switched on has lost the
        camera's equilibrium; event `camera_supply_off`."""
        if self.is_on and not coils.get(CAMERA_POWER, True):
            self.is_on = False
            off = CAMERA_SUPPLY_OFF.at(self._clock.now_ns())
            self._hub.publish(off)
            self.equilibrium.lose(off.text)

    async def _supply(self) -> None:
        """Supply on and the camera open. A relay that reads off is only held for some seconds at a time until the
        camera has answered: it might be another one than the configuration says, such as the heater's."""
        relays, hold_s = self._relays, self._limits.hold_s
        is_on = any(reading.channel == self.name and reading.value == 1 for reading in await relays.read())
        self.was_on = is_on if self.was_on is None else self.was_on
        holding: asyncio.Task[None] | None = None
        if is_on:
            await relays.switch(CAMERA_POWER, on=True)  # for good, should it have been timed
        else:
            await relays.hold_on(CAMERA_POWER, hold_s)
            holding = asyncio.create_task(self._hold(hold_s))
        try:
            await self._clock.sleep_until(self._clock.now_ns() + to_ns(self._limits.boot_s))
            deadline_ns = self._clock.now_ns() + to_ns(_BOOT_LIMIT_S)
            await self.recovery.open_with_retries(self._interlock.check, deadline_ns, RETRY_S)
        except BaseException as error:
            if holding is not None:
                await cancel_all([holding])
                await relays.switch(CAMERA_POWER, on=False)
                if isinstance(error, Unreachable):
                    raise Unreachable(error.device, f"{error.text}; {self._explain_relay()}") from error
            raise
        if holding is not None:
            await cancel_all([holding])
            self._interlock.check()
            await relays.switch(CAMERA_POWER, on=True)

    def _explain_relay(self) -> str:
        """Return what to look at when the camera does not answer though its relay was switched on: it may be another
        one."""
        channels = self._limits.channels
        others = ", ".join(f"{name} is {number}" for name, number in channels.items() if name != CAMERA_POWER)
        number = f" (number {channels[CAMERA_POWER]}; {others})" if CAMERA_POWER in channels else ""
        return (
            f"the relay {self.name}{number} was on meanwhile and is off again: see that it is the camera it switches, "
            f"and correct {self._relays.name}.channels if it is not"
        )

    async def _hold(self, hold_s: float) -> None:
        """Arm the supply again until cancelled; a lost command is made up for by the next one."""
        while True:
            await self._clock.sleep_until(self._clock.now_ns() + to_ns(hold_s / 3))
            with suppress(DeviceError):
                await self._relays.hold_on(CAMERA_POWER, hold_s)
