"""Temperature regulator: a register map with the points pv, sp, mv_heat, mv_cool and the commands run and stop."""

from __future__ import annotations

from thermostand.drivers.devices.device_check import check_controller
from thermostand.drivers.devices.exclusive import Exclusive
from thermostand.drivers.devices.kinds import CONTROL, CONTROLLED, DeviceKind, DriverContext, MapOf, OfSection
from thermostand.drivers.devices.protocols import InForce
from thermostand.drivers.settings import Identity, OnBus
from thermostand.drivers.wires.bus import Bus
from thermostand.drivers.wires.modbus_unit import (
    CONFIRM_LOOKS,
    ModbusUnit,
    Sample,
    Snapshot,
    find_objection,
    is_confirmed,
)
from thermostand.drivers.wires.registers import RegisterMap
from thermostand.foundation.clock import Clock, to_ns
from thermostand.foundation.errors import ConfigError, DeviceFault, Occupied, Refused
from thermostand.foundation.readings import Channel, Reading, bad_reading

PROBE_PERIOD_S = 30.0  # one in some 30 polls; not measured
AUTOTUNE = "autotune"
_OUTPUTS = (Channel("mv_heat", "%", "output"), Channel("mv_cool", "%", "output"))


class Regulator:
    """A heat/cool regulator that does the PID by itself; we give it set points and watch it. A set point that the unit
    wants refreshed (a remote set point) is sent again at each `read`.

    It is "ready" while every start-up command of the map is confirmed by its bit (E5CC: communications writing on, RAM
    write mode, so that set points do not wear the EEPROM). When that is lost, or the unit was unreachable and may have
    been power-cycled, the start-up sequence runs again and the set point is sent again; it never runs or stops
    control by itself. `start_ups` counts completed sequences.

    The set-point is in force while none of the map's `in_force` objects: asked before one is sent and before it runs,
    once more when it does, and at each poll.
    """

    def __init__(self, name: str, bus: Bus, register_map: RegisterMap, clock: Clock) -> None:
        missing = [point for point in ("pv", "sp") if point not in register_map.points]
        missing += [command for command in ("run", "stop") if command not in register_map.commands]
        if missing or not register_map.safe_state:
            raise ConfigError(f"{name}: register map {register_map.model} lacks {', '.join(missing) or 'safe_state'}")
        for command in ("run", *register_map.startup):
            if (point := register_map.commands[command].confirm.point) not in register_map.polled():
                raise ConfigError(
                    f"{name}: {point}, which confirms {command}, needs poll: fast in {register_map.model}"
                )
        for check in register_map.in_force:
            for point in (check.point, check.follows):
                if point and point not in register_map.polled():
                    raise ConfigError(f"{name}: {point} of in_force needs poll: fast in {register_map.model}")
        self.name = name
        self.start_ups = 0
        self._unit = ModbusUnit(name, bus, register_map)
        self._map = register_map
        self._clock = clock
        self._exclusive = Exclusive()
        self._sp_degC: float | None = None  # the set point as the unit took it, to be sent again
        self._probe_ns = 0
        confirming = {register_map.commands[name].confirm.point for name in register_map.startup}
        self._status = [
            name for name, point in register_map.points.items() if name in confirming or AUTOTUNE in point.bits.values()
        ]

    @property
    def identity(self) -> Identity | None:
        """The unit that has answered; None before `open`."""
        return self._unit.identity

    async def open(self) -> None:
        """Probe identity and scaling, enable writing, RAM mode, each confirmed; neither runs nor stops control."""
        async with self._exclusive:
            await self._start_up()

    async def close(self) -> None:
        """Do nothing: the bus belongs to the stand; control continues in the unit."""

    async def read(self) -> tuple[Reading, ...]:
        """pv, sp (degC), mv_heat, mv_cool (%), running, fault (1 or 0); raises DeviceError.

        The reason of `fault` names the bits that are set, and says when somebody changed the set point at the unit.
        """
        async with self._exclusive:
            await self._ensure_started()
            if self._clock.now_ns() >= self._probe_ns:
                await self._probe()
            snapshot = await self._unit.snapshot(self._map.polled())
            if not self._is_ready(snapshot):
                await self._start_up()
                snapshot = await self._unit.snapshot(self._map.polled())
            readings = self._readings(snapshot)
            if self._map.points["sp"].refresh and self._sp_degC is not None:
                await self._unit.write("sp", self._sp_degC)
            return readings

    async def in_force(self) -> InForce:
        """Return how it is known that the written set-point acts, as Controller.in_force states."""
        async with self._exclusive:
            await self._ensure_started()
            known_by = "; ".join(map(str, self._map.in_force))
            unverified = self._map.unverified or ("" if known_by else "its register map has no in_force")
            return InForce(known_by, unverified, self._objections(await self._unit.snapshot(self._map.polled())))

    async def set_temperature(self, degC: float) -> None:
        """Send a set point and read it back.

        Refused: outside the map's limits (nothing is sent), RAM mode not confirmed, not taken over. Occupied:
        autotuning, started at the unit, is active. DeviceFault: it would not be in force (nothing is sent), or is not.
        """
        async with self._exclusive:
            await self._ensure_started()
            status = await self._unit.snapshot(self._status)
            if not self._is_ready(status):
                await self._start_up()
            if status.bits.get(AUTOTUNE):
                raise Occupied(self.name, "autotuning is active; no set point was sent")
            await self._check_in_force(is_sent=False)
            self._sp_degC = await self._write_set_point(degC)
            await self._check_in_force(is_sent=True)

    async def run(self) -> None:
        """Start control, confirmed. DeviceFault when the set-point is not in force: then it is stopped again."""
        async with self._exclusive:
            await self._ensure_started()
            await self._check_in_force(is_sent=False)
            await self._unit.command("run")
            try:
                await self._check_in_force(is_sent=True)
            except DeviceFault:
                await self._commands(self._map.safe_state)
                raise

    async def _check_in_force(self, *, is_sent: bool) -> None:
        """is_sent: the set-point just now, so what follows it is asked, too, and may be a scan of the unit behind."""
        if not self._map.in_force:
            return
        objections: tuple[str, ...] = ()
        for _ in range(CONFIRM_LOOKS if is_sent else 1):
            objections = self._objections(await self._unit.snapshot(self._map.polled()), are_followed=is_sent)
            if not objections:
                return
        raise DeviceFault(self.name, f"its set-point is not in force: {'; '.join(objections)}")

    def _objections(self, snapshot: Snapshot, *, are_followed: bool = True) -> tuple[str, ...]:
        """List the objections to a poll. What is refreshed falls back before the first set-point, and is followed from
        that on."""
        running = is_confirmed(self._map.commands["run"], snapshot)
        asked = [check for check in self._map.in_force if running or not check.while_running]
        return tuple(
            text
            for check in asked
            if not check.follows
            or (are_followed and not (self._map.points[check.follows].refresh and self._sp_degC is None))
            if (text := find_objection(check, snapshot))
        )

    async def stop(self) -> None:
        """Stop control, confirmed; the outputs go to the unit's "MV at stop"."""
        await self._send_at_once(("stop",))

    async def make_safe(self) -> None:
        """The map's safe state (stop), confirmed."""
        await self._send_at_once(self._map.safe_state)

    async def _send_at_once(self, commands: tuple[str, ...]) -> None:
        """Send commands at once, also to a unit that has been power-cycled and refuses writing at first."""
        async with self._exclusive:
            try:
                await self._commands(commands)
            except Refused:
                await self._commands(self._map.startup)
                await self._commands(commands)

    async def _ensure_started(self) -> None:
        if not self._exclusive.is_known:
            await self._start_up()

    async def _start_up(self) -> None:
        self._exclusive.is_known = False
        await self._probe()
        await self._commands(self._map.startup)
        if self._sp_degC is not None:
            await self._write_set_point(self._sp_degC)
        self._exclusive.is_known = True
        self.start_ups += 1

    async def _write_set_point(self, degC: float) -> float:
        """Write the set-point and return it as the unit took it. A unit that every write wears is not given the value
        it has."""
        wears = self._map.points["sp"].eeprom and not self._map.startup
        if wears and (await self._unit.snapshot(["sp"])).samples["sp"].value == degC:
            return degC
        return await self._unit.write("sp", degC)

    async def _probe(self) -> None:
        """The decimal point above all: a constant that also exposes a reply that is not the unit's."""
        await self._unit.probe()
        self._probe_ns = self._clock.now_ns() + to_ns(PROBE_PERIOD_S)

    async def _commands(self, names: tuple[str, ...]) -> None:
        for name in names:
            await self._unit.command(name)

    def _is_ready(self, snapshot: Snapshot) -> bool:
        return all(is_confirmed(self._map.commands[name], snapshot) for name in self._map.startup)

    def _readings(self, snapshot: Snapshot) -> tuple[Reading, ...]:
        now_ns = self._clock.now_ns()
        faults = [bit for bit in self._map.fault_bits if snapshot.bits.get(bit)]
        sp_degC = snapshot.samples["sp"].value
        if self._sp_degC is not None and sp_degC != self._sp_degC:
            faults.append("set point changed at the unit")
        faults += self._objections(snapshot)
        running = is_confirmed(self._map.commands["run"], snapshot)
        quantities = [each for each in (*CONTROLLED[:2], *_OUTPUTS) if each.name in snapshot.samples]
        return (
            *(self._reading(each, snapshot.samples[each.name], now_ns) for each in quantities),
            Reading(f"{self.name}.running", float(running), "1", now_ns),
            Reading(f"{self.name}.fault", float(bool(faults)), "1", now_ns, reason=", ".join(faults)),
        )

    def _reading(self, quantity: Channel, sample: Sample, now_ns: int) -> Reading:
        channel = f"{self.name}.{quantity.name}"
        if sample.reason:
            return bad_reading(channel, quantity.unit, now_ns, sample.reason)
        return Reading(channel, sample.value, quantity.unit, now_ns)


def _make(name: str, settings: OnBus, around: DriverContext) -> Regulator:
    return Regulator(name, around.bus, around.map_of("regulator", settings), around.clock)


def _channels(settings: OnBus, of_section: OfSection, map_of: MapOf) -> tuple[Channel, ...]:
    """Return what every controller reports, and the outputs that its map has."""
    points = map_of("regulator", settings).points
    return (*CONTROLLED, *(each for each in _OUTPUTS if each.name in points))


KIND = DeviceKind(
    name="regulator",
    settings=OnBus,
    make=_make,
    channels=_channels,
    section="regulator",
    device="regulator",
    rank=20,
    address_key="",
    simulated_map="omron-e5cc",
    check=check_controller,
    verbs=CONTROL,
)
