"""The chamber's verbs: start, set-point, stop, and the test of the relay that guards the heat."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

from thermostand.drivers.devices.chambers.climate_chamber import ClimateChamber
from thermostand.drivers.devices.protocols import Controller, Switches
from thermostand.drivers.devices.regulators.software_regulator import SoftwareRegulator
from thermostand.foundation.clock import Clock, get_boot, to_ns
from thermostand.foundation.errors import ConfigError, DeviceError, DeviceFault, Occupied
from thermostand.foundation.events import NO_DEAD_MAN, PERMIT_NOT_RENEWED, REGULATOR_OCCUPIED, SWITCHED_OFF
from thermostand.foundation.hub import Hub
from thermostand.stand.chamber.compressor import CompressorFile, load_state
from thermostand.stand.chamber.permits import Permission, PermitLimits, Permits
from thermostand.stand.safety.fault import get_value
from thermostand.stand.safety.interlock import Interlock

# Renews the permits while the guard finds all well, and sees to it that nothing is on that is not permitted.
#
# It speaks to the bus, and may have to wait for it; the guard's looks do not. When it cannot renew, the relays drop by
# themselves, which is their safe state.

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


_OCCUPIED_AGAIN_S = 5.0  # round number; nothing was measured
_STEP_K = 0.5  # of a set-point that is brought to its place no faster than the cameras may follow


@dataclass(frozen=True, slots=True)
class ChamberLimits:
    """The set-points allowed (lowest, highest), how long a permission to heat or cool lives, how often it is renewed
    (s), the file that keeps what the compressor did last for the next daemon, and how fast a set-point may change."""

    setpoint_degC: tuple[float, float]
    permits: PermitLimits
    renew_s: float
    compressor_file: Path | None = None
    K_per_min: float = math.inf


@dataclass(frozen=True, slots=True)
class ChamberOrder:
    """What the chamber was commanded, whether or not the regulator answers now: the set-point, and since when heat and
    cold are permitted (ns)."""

    setpoint_degC: float
    since_ns: int


class Chamber:
    """Set-point, heat and cold. `permits` owns the permissions to heat and cool, `keeper` renews them; `coils_read` is
    given what the relays read each time it does."""

    def __init__(
        self,
        *,
        regulator: Controller,
        relays: Switches,
        limits: ChamberLimits,
        interlock: Interlock,
        coils_read: Callable[[Mapping[str, bool]], None],
        hub: Hub,
        clock: Clock,
    ) -> None:
        self._regulator = regulator
        self._relays = relays
        self._limits = limits
        self._interlock = interlock
        self._hub = hub
        self._clock = clock
        self._latest_order = object()  # the last order; one that is under way ends with the next
        self._order: ChamberOrder | None = None
        self.compressor_file = CompressorFile(limits.compressor_file, hub, clock)
        compressor = load_state(limits.compressor_file, clock.now_ns(), get_boot(clock))
        self.permits = Permits(relays, limits.permits, compressor, self.compressor_file.note, hub, clock)
        self.permit_renewer = PermitRenewer(self.permits, regulator, hub, clock, limits.renew_s, coils_read)

    @property
    def ordered(self) -> ChamberOrder | None:
        """The order that is in effect; None while nothing is permitted: the set-point that the regulator remembers is
        then nobody's wish."""
        return self._order if self.permits.is_granted else None

    async def start(self, setpoint_degC: float) -> None:
        """Permit heating and cooling, set the set-point, run the regulator; done when the set-point is there. A
        regulator that does not run leaves no permission."""
        way_degC = await self._plan_set_points(setpoint_degC)
        asked = self._latest_order = object()
        await self._send(way_degC[0])
        self._interlock.check()  # after every wait: a fault may have closed it meanwhile
        since_ns = self._clock.now_ns() if self.ordered is None else self.ordered.since_ns
        self._order = ChamberOrder(setpoint_degC, since_ns)
        self.permits.grant()
        try:
            await self.permit_renewer.renew_once()
            self._interlock.check()
            await self._regulator.run()
        except DeviceError:
            with suppress(DeviceError):  # then the relays drop by themselves: they are not renewed
                await self.permits.make_safe()
            raise
        except BaseException:
            self.permits.revoke()
            raise
        await self._ramp(way_degC[1:], asked)

    async def set_temperature(self, setpoint_degC: float) -> None:
        """A new set-point, done when it is there; ConfigError outside the limits. While an operator has the regulator
        autotune this waits until that ends or the guard holds the stand; event `regulator_occupied`."""
        way_degC = await self._plan_set_points(setpoint_degC)
        asked = self._latest_order = object()
        await self._send(way_degC[0])
        if self._order is not None:
            self._order = replace(self._order, setpoint_degC=setpoint_degC)
        await self._ramp(way_degC[1:], asked)

    async def _plan_set_points(self, setpoint_degC: float) -> list[float]:
        """The set-points from where the air is to this one, no two further apart than _STEP_K where there is a limit to
        their rate."""
        low, high = self._limits.setpoint_degC
        if not low <= setpoint_degC <= high:
            raise ConfigError(f"chamber set-point {setpoint_degC} degC is outside limits.chamber_degC {low}..{high}")
        if math.isinf(self._limits.K_per_min):
            return [setpoint_degC]
        self._interlock.check()
        found = {reading.channel: reading.value for reading in await self._regulator.read()}
        pv_degC, sp_degC = (found.get(f"{self._regulator.name}.{name}", math.nan) for name in ("pv", "sp"))
        begin_degC = next((each for each in (pv_degC, sp_degC) if not math.isnan(each)), setpoint_degC)
        # Here, and neither in the plan, whose steps would then differ from stand to stand, nor in the regulator's own
        # ramp, which not every make has.
        steps = max(1, math.ceil(abs(setpoint_degC - begin_degC) / _STEP_K))
        way_degC = (begin_degC + (setpoint_degC - begin_degC) * step / steps for step in range(1, steps))
        return [*(min(max(each, low), high) for each in way_degC), setpoint_degC]

    async def _ramp(self, way_degC: list[float], asked: object) -> None:
        """One after another at the rate allowed; another order takes over from it."""
        for setpoint_degC in way_degC:
            step_ns = to_ns(60.0 * _STEP_K / self._limits.K_per_min)
            await self._clock.sleep_until(self._clock.now_ns() + step_ns)
            if asked is not self._latest_order:
                return
            await self._send(setpoint_degC)

    async def _send(self, setpoint_degC: float) -> None:
        is_waiting = False
        while True:
            self._interlock.check()
            try:
                return await self._regulator.set_temperature(setpoint_degC)
            except Occupied as error:
                if not is_waiting:
                    self._hub.publish(REGULATOR_OCCUPIED.at(self._clock.now_ns(), str(error)))
                is_waiting = True
            await self._clock.sleep_until(self._clock.now_ns() + to_ns(_OCCUPIED_AGAIN_S))

    async def stop(self) -> None:
        """Stop the regulator; heating and cooling lose their permission at once, also when it does not stop."""
        self._latest_order = object()
        self.permits.revoke()
        try:
            await self._regulator.stop()
        finally:
            await self.permits.make_safe()

    async def test_dead_man(self, *, is_timed: bool = False) -> None:
        """Test the relay board's timer on the heater's relay while the regulator is stopped, and the watchdog of a
        module that heats; DeviceFault when the regulator gives heat all the same, or one of them cannot be relied upon.
        is_timed: as of Permits. Event `no_dead_man` without a board."""
        if not self._relays.has_timer:
            return self._report_missing_dead_man()
        output = {reading.channel: reading.value for reading in await self._regulator.read()}
        name = self._regulator.name
        if not output.get(f"{name}.mv_heat", 0.0) <= 0:
            raise DeviceFault(name, f"is stopped and yet gives {output[f'{name}.mv_heat']:g} % heat; look at the unit")
        await self.permits.test_dead_man(is_timed=is_timed)
        if isinstance(self._regulator, SoftwareRegulator):
            await self._regulator.test_dead_man()

    def _report_missing_dead_man(self) -> None:
        """Record with the session that no board drops the heat when this daemon dies, and what ends it then."""
        what = self._regulator.dead_man if isinstance(self._regulator, ClimateChamber) else "nothing"
        self._hub.publish(NO_DEAD_MAN.at(self._clock.now_ns(), device=self._regulator.name, ends_it=what))
