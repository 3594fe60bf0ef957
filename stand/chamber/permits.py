"""Heat and cold are permitted for some seconds at a time, and relays are compared with what they were commanded.

The relays of heater and compressor are only ever switched on by the board's own timer: a daemon that dies neither
heats nor cools. Each is read before it is armed again; one that is off before its time has been dropped by something
else (a brown-out of the board, another master), and a compressor that was dropped has stopped: it rests, and its next
start counts.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum

from thermostand.drivers.devices.protocols import Switches
from thermostand.drivers.devices.relays import COMPRESSOR, WATCHED
from thermostand.drivers.devices.relays import HEATER_ENABLE as HEATER
from thermostand.foundation.clock import NS_PER_S, Clock, to_ns
from thermostand.foundation.errors import DeviceError, DeviceFault
from thermostand.foundation.events import (
    COMPRESSOR_DROPPED,
    COMPRESSOR_NOT_ON,
    COMPRESSOR_SWITCHED,
    DEAD_MAN_LATE,
    DEAD_MAN_TESTED,
    HEATER_DROPPED,
    HEATER_NOT_ON,
    LEFT_ON,
    SWITCHED_OFF,
    EventKind,
)
from thermostand.foundation.hub import Hub
from thermostand.stand.chamber.compressor import CompressorState, decide
from thermostand.stand.config.stand_config import CompressorConfig

_EARLY_S = 1.0  # a relay that is off so shortly before its time may just have dropped by itself

# The self-test of the dead-man, in units of self_test_s / 3: armed, armed again, must be on, must be off.
# On a computer with two busy loops commands came more than 1 s late, and a board that does not re-arm passed: so each
# command's instants are compared, and a late test is repeated.
_AGAIN, _STILL_ON, _OFF, _PULSE = 2.0, 4.0, 6.5, 3.0
_LOOK = 0.05  # between looks of a test that is timed
# Three were not enough on a busy computer; a late try says nothing of the board.
_TEST_TRIES = 5  # of that test, when this computer is held up in it


@dataclass(frozen=True, slots=True)
class PermitLimits:
    """hold_s: how long a permission lives unless it is renewed. self_test_s: of the timed-on that tests the board."""

    hold_s: float
    self_test_s: float
    compressor: CompressorConfig


class Permission(StrEnum):
    """revoked: the relays may still be on; withdrawn: they have been confirmed off, and must stay so."""

    GRANTED = "granted"
    REVOKED = "revoked"
    WITHDRAWN = "withdrawn"


class Permits:
    """The relays of heater and compressor; a board may have none of the latter. `allowed` says
    whether the guard looks and finds all well: else nothing is armed. `keep` is called at each change of the
    compressor, and must not wait."""

    def __init__(
        self,
        relays: Switches,
        limits: PermitLimits,
        compressor: CompressorState,
        keep: Callable[[CompressorState], None],
        hub: Hub,
        clock: Clock,
    ) -> None:
        self.name = relays.name
        self.permission = Permission.REVOKED
        self.intrusions = 0  # how often heat or cold were switched on by others since the permission was withdrawn
        self.is_allowed: Callable[[], bool] = lambda: True
        self._relays = relays
        self._limits = limits
        self._compressor = compressor
        self._keep = keep
        self._hub = hub
        self._clock = clock
        self._until_ns: dict[str, int] = {}  # when an armed relay drops unless it is armed again
        self._came_on: set[str] = set()  # those that have read on since they were armed
        self._comparing = asyncio.Lock()  # what is compared must not be switched meanwhile, but for making safe

    @property
    def is_granted(self) -> bool:
        """Whether heat and cold are permitted."""
        return self.permission is Permission.GRANTED

    @property
    def may_heat(self) -> bool:
        """Whether heat may be given now: permitted, and the guard finds all well."""
        return self.is_granted and self.is_allowed()

    @property
    def timer_s(self) -> float | None:
        """How long after the last renewal the board itself switches heat and cold off; None without a board."""
        return self._limits.hold_s if self._relays.has_timer else None

    @property
    def ended_ns(self) -> int | None:
        """The instant at which the board's own timer ended heat that is permitted, because it was not renewed; None
        while it lasts."""
        until_ns = self._until_ns.get(HEATER)
        is_over = until_ns is not None and until_ns <= self._clock.now_ns()
        return until_ns if is_over and self.is_granted and self._relays.has_timer else None

    def grant(self) -> None:
        """Permit heat and cold; `arm` switches."""
        self.permission, self.intrusions = Permission.GRANTED, 0

    def revoke(self) -> None:
        """Stop arming: nothing is armed from now on."""
        self.permission = Permission.REVOKED

    def clear_intrusions(self) -> None:
        """An operator has found out what switched heat or cold on."""
        self.intrusions = 0

    async def make_safe(self) -> None:
        """Switch both permits off and confirm it; DeviceError when that fails."""
        self.revoke()
        await self._relays.make_safe()
        self._note_off()

    async def switch_off_left_on(self) -> None:
        """Switch off, before anything else, what another daemon or a hand left on, event `left_on`. A compressor that
        ran until now begins its rest now."""
        left_on = {name for name, on in (await self._read_coils()).items() if on} & set(WATCHED)
        await self._relays.make_safe()
        for channel in sorted(left_on):
            self._publish_event(LEFT_ON, channel)
        if COMPRESSOR in left_on:
            self._set_compressor(CompressorState(False, self._clock.now_ns(), self._compressor.starts_ns))
        self._note_off()

    async def arm(self, mv_heat: float, mv_cool: float) -> dict[str, bool]:
        """Compare and, while permitted and allowed, arm the relays again; the regulator's outputs in %. Returns what
        the coils read before that. Both drop by themselves `hold_s` later."""
        async with self._comparing:
            coils = await self._read_coils()
            if self.is_granted:
                self._compare(coils)
            if self.is_granted and coils.get(COMPRESSOR) and not self._compressor.running:
                await self._undo_intrusion(COMPRESSOR)
            if self.may_heat:
                await self._hold_on(HEATER)
            if self.may_heat and COMPRESSOR in coils:  # still, after the wait
                await self._arm_compressor(mv_heat, mv_cool)
            return coils

    async def supervise(self) -> dict[str, bool]:
        """Switch off a relay that reads on while the permission is withdrawn, event `switched_off`. Returns what the
        coils read before that."""
        async with self._comparing:
            was_withdrawn = self.permission is Permission.WITHDRAWN
            coils = await self._read_coils()
            for channel in WATCHED:
                if coils.get(channel) and was_withdrawn and self.permission is Permission.WITHDRAWN:
                    await self._undo_intrusion(channel)
            return coils

    async def test_dead_man(self, *, is_timed: bool) -> None:
        """Test, before the heater's relay is trusted, whether the board drops it in time, and whether arming it again
        starts its time again. DeviceFault when not: such a board would cut the heat at random, or never.

        The regulator must be stopped, with an output of 0. Event "dead_man_tested" with what was found; is_timed: the
        board is looked at all the time, and `held_s` is how long after the second arming its relay was seen to drop.
        """
        for test in range(_TEST_TRIES):
            if (found := await self._measure_timer(is_timed)) is not None:
                break
            self._hub.publish(DEAD_MAN_LATE.at(self._clock.now_ns(), device=self.name, test=test + 1))
        else:
            text = "its timer could not be tested: this computer was held up in each of the tests; see what loads it"
            raise DeviceFault(self.name, text)
        on, off, held_s = found
        tested = {"rearmed": on, "dropped": off, "pulse_s": self._limits.self_test_s}
        data: dict[str, object] = {"device": self.name, **tested}
        if is_timed:
            data["held_s"] = held_s
        if on and off:
            text = "the heater's relay is held by timed commands and drops without them"
            self._hub.publish(DEAD_MAN_TESTED.at(self._clock.now_ns(), text, **data))
            return
        fault = "does not drop by itself when its time is over" if on else "does not start its time again when re-armed"
        text = f"this board is not suited: a timed-on of the heater's relay {fault}; heat could not be guarded with it"
        self._hub.publish(DEAD_MAN_TESTED.at(self._clock.now_ns(), text, **data))
        raise DeviceFault(self.name, text)

    async def _measure_timer(self, is_timed: bool) -> tuple[bool, bool, float | None] | None:
        """Return whether the relay was held by the second arming, whether it then dropped, and after how many s; None
        when the commands came so late that this says nothing: a second arming after the first one's time arms any
        board."""
        pulse_s, sent_ns = self._limits.self_test_s, self._clock.now_ns()
        unit_s, held_s = pulse_s / _PULSE, None
        try:
            await self._relays.hold_on(HEATER, pulse_s)
            begin_ns = self._clock.now_ns()  # it may count from here

            async def at(units: float) -> bool:
                await self._clock.sleep_until(begin_ns + to_ns(units * unit_s))
                return (await self._read_coils())[HEATER]

            await at(_AGAIN)
            again_ns = self._clock.now_ns()
            await self._relays.hold_on(HEATER, pulse_s)
            is_late = self._clock.now_ns() >= sent_ns + to_ns(pulse_s)
            on = await at(_STILL_ON)
            is_late = is_late or (not on and self._clock.now_ns() >= again_ns + to_ns(pulse_s))
            units = _STILL_ON
            while is_timed and held_s is None and (units := units + _LOOK) < _OFF:
                if not await at(units):
                    held_s = round((self._clock.now_ns() - again_ns) / NS_PER_S, 2)
            off = not await at(_OFF)
        finally:
            await self._relays.switch(HEATER, on=False)
        return None if is_late else (on, off, held_s)

    def _compare(self, coils: dict[str, bool]) -> None:
        """Report what has dropped though its time was not over."""
        now_ns = self._clock.now_ns()
        for channel in (HEATER, COMPRESSOR):
            until_ns = self._until_ns.get(channel, 0)
            if coils.get(channel):
                self._came_on.add(channel)
            if coils.get(channel) or not until_ns:
                continue
            del self._until_ns[channel]
            early = until_ns - now_ns > to_ns(_EARLY_S)
            came_on = channel in self._came_on
            self._came_on.discard(channel)
            if channel == COMPRESSOR and self._compressor.running:
                # One that was not renewed in time has dropped by itself: its rest began there.
                self._set_compressor(
                    CompressorState(False, now_ns if early else min(now_ns, until_ns), self._compressor.starts_ns)
                )
            if early and not came_on:
                self._publish_event(HEATER_NOT_ON if channel == HEATER else COMPRESSOR_NOT_ON, channel)
            elif early:
                left_s = (until_ns - now_ns) / NS_PER_S
                self._publish_event(HEATER_DROPPED if channel == HEATER else COMPRESSOR_DROPPED, channel, left_s=left_s)

    async def _arm_compressor(self, mv_heat: float, mv_cool: float) -> None:
        wanted = decide(self._compressor, self._limits.compressor, mv_heat, mv_cool, self._clock.now_ns())
        switched = wanted.running != self._compressor.running
        if wanted.running:
            if switched:
                self._set_compressor(wanted)  # before it runs: a start that is not confirmed counts, too
            await self._hold_on(COMPRESSOR)
        elif switched:
            await self._relays.switch(COMPRESSOR, on=False)
            self._until_ns.pop(COMPRESSOR, None)
        self._set_compressor(wanted)
        if switched:
            text = "started" if wanted.running else "stopped"
            self._hub.publish(COMPRESSOR_SWITCHED.at(self._clock.now_ns(), text, running=wanted.running))

    async def _undo_intrusion(self, channel: str) -> None:
        """It was switched on, and not by this daemon."""
        self.intrusions += 1
        now_ns = self._clock.now_ns()
        await self._relays.switch(channel, on=False)
        if channel == COMPRESSOR:
            self._set_compressor(CompressorState(False, self._clock.now_ns(), (*self._compressor.starts_ns, now_ns)))
        self._publish_event(SWITCHED_OFF, channel)

    async def _hold_on(self, channel: str) -> None:
        """Armed from the instant of the call at the earliest."""
        until_ns = self._clock.now_ns() + to_ns(self._limits.hold_s)
        try:
            await self._relays.hold_on(channel, self._limits.hold_s)
        except DeviceError:  # it may be on all the same: a compressor that then drops has run, and has to rest
            self._until_ns.setdefault(channel, until_ns)
            raise
        self._until_ns[channel] = until_ns

    def _note_off(self) -> None:
        """Note that both have been confirmed off."""
        self._until_ns.clear()
        if not self.is_granted:
            self.permission = Permission.WITHDRAWN
        if self._compressor.running:
            self._set_compressor(CompressorState(False, self._clock.now_ns(), self._compressor.starts_ns))

    def _set_compressor(self, compressor: CompressorState) -> None:
        was, self._compressor = self._compressor, compressor
        if (compressor.running, compressor.since_ns) != (was.running, was.since_ns):
            self._keep(compressor)

    async def _read_coils(self) -> dict[str, bool]:
        readings = await self._relays.read()
        return {reading.channel.partition(".")[2]: reading.value == 1 for reading in readings}

    def _publish_event(self, kind: EventKind, channel: str, **data: object) -> None:
        now_ns = self._clock.now_ns()
        self._hub.publish(kind.at(now_ns, device=self.name, relay=channel, times=self.intrusions, **data))
