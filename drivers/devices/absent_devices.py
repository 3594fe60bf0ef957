"""Stand-ins for devices that a stand does not have, so that plans, holds and making safe have one path."""

from __future__ import annotations

from thermostand.drivers.devices.relays import CAMERA_POWER
from thermostand.foundation.clock import Clock, seconds_ns
from thermostand.foundation.errors import Refused
from thermostand.foundation.readings import Reading

_PERMIT, _COMPRESSOR = "heater_enable", "compressor"


class NoFlap:
    """In place of a flap: cameras see the target all the time, and opening and closing are done at once. What was
    commanded last is remembered, nothing is read."""

    identity = None

    def __init__(self, name: str) -> None:
        self.name = name
        self.is_shut = True

    async def open(self) -> None:
        """Nothing to connect to."""

    async def close(self) -> None:
        """Nothing to let go of."""

    async def read(self) -> tuple[Reading, ...]:
        """Nothing is read."""
        return ()

    async def move_open(self) -> None:
        """Nothing moves."""
        self.is_shut = False

    async def move_closed(self) -> None:
        """Nothing moves."""
        self.is_shut = True

    async def make_safe(self) -> None:
        """As closed."""
        self.is_shut = True

    def allow(self) -> None:
        """Nothing was barred."""


class NoRelays:
    """In place of a relay board: the climate chamber enables heat and cold by itself, the cameras always have power.

    A permission to heat is remembered for as long as it was given, so that the guard's rules compare the chamber with
    it; no wire follows it. camera_power always reads on."""

    has_timer = False
    identity = None

    def __init__(self, name: str, clock: Clock) -> None:
        self.name = name
        self._clock = clock
        self._until_ns: dict[str, int | None] = {}  # None: for good

    async def open(self) -> None:
        """Nothing to connect to."""

    async def close(self) -> None:
        """Nothing to let go of."""

    async def read(self) -> tuple[Reading, ...]:
        """heater_enable, compressor, camera_power; 1 on, 0 off."""
        now_ns = self._clock.now_ns()
        states = {_PERMIT: self._is_on(_PERMIT), _COMPRESSOR: self._is_on(_COMPRESSOR), CAMERA_POWER: True}
        return tuple(Reading(f"{self.name}.{channel}", float(on), "1", now_ns) for channel, on in states.items())

    async def switch(self, channel: str, on: bool) -> None:
        """Remember it; Refused for a camera that is to be switched off."""
        if channel == CAMERA_POWER and not on:
            raise Refused(self.name, "no relay switches the cameras: this stand has no relay board")
        if on:
            self._until_ns[channel] = None
        else:
            self._until_ns.pop(channel, None)

    async def hold_on(self, channel: str, duration_s: float) -> None:
        """Remember it for `duration_s` from now."""
        self._until_ns[channel] = self._clock.now_ns() + seconds_ns(duration_s)

    async def make_safe(self) -> None:
        """Nothing is permitted any more."""
        self._until_ns.clear()

    def _is_on(self, channel: str) -> bool:
        until_ns = self._until_ns.get(channel, 0)
        return until_ns is None or self._clock.now_ns() < until_ns
