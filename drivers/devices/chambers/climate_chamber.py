"""A climate chamber with a controller of its own, in the place of a regulator: it heats and cools by itself.

None of the makes has a watchdog of its communications that anybody documents: when this computer dies the chamber goes
on at its last set-point. So the limits of its own controller are part of what is checked before anything is commanded.
"""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Callable
from typing import TYPE_CHECKING, Annotated, Any, Protocol, Union, cast

from pydantic import Field

import thermostand.drivers.devices.chambers
from thermostand.drivers.devices.chambers.chamber_language import ChamberLanguage, ChamberState, ChamberUnitSettings
from thermostand.drivers.devices.device_check import check_controller
from thermostand.drivers.devices.exclusive import Exclusive
from thermostand.drivers.devices.kinds import CONTROL, CONTROLLED, DeviceKind, DriverContext
from thermostand.drivers.devices.protocols import InForce
from thermostand.drivers.settings import Identity, check_same_device
from thermostand.foundation.clock import Clock, compute_call_pause_s, to_ns
from thermostand.foundation.errors import DeviceError, DeviceFault, GarbledReply, Refused, Unreachable
from thermostand.foundation.readings import Reading
from thermostand.foundation.workers import Result, WorkerThread

_LOOKS = 3  # at a state that follows its command a scan of the unit later
_RENEW_S = 60.0  # of a command that the chamber forgets; not measured


class _Module(Protocol):
    Settings: type[ChamberUnitSettings]

    def Language(self, name: str, settings: Any) -> ChamberLanguage: ...


def _load_languages() -> dict[str, _Module]:
    """Import the languages. Each is a file next to this one, named for its protocol, with `Language` and `Settings`."""
    names = sorted(module.name for module in pkgutil.iter_modules(thermostand.drivers.devices.chambers.__path__))
    modules = {
        name.removeprefix("chamber_"): importlib.import_module(f"thermostand.drivers.devices.chambers.{name}")
        for name in names
        if name.startswith("chamber_")
    }
    return {name: cast("_Module", module) for name, module in modules.items() if hasattr(module, "Language")}


LANGUAGES = _load_languages()
if TYPE_CHECKING:
    ClimateChamberSettings = ChamberUnitSettings
else:
    _any_of_them = Union[tuple(language.Settings for language in LANGUAGES.values())]  # noqa: UP007 - of a tuple
    ClimateChamberSettings = Annotated[_any_of_them, Field(discriminator="protocol")]


class ClimateChamber:
    """The calls of a regulator: channels pv, sp (degC), running, fault (1 or 0), and no outputs.

    allowed_degC: the set-points that the stand may ask for; a chamber whose own controller allows more is refused.
    Identity, limits and humidity are looked at before the first command and after every loss, and at each look whether
    the set-point is in force. A set-point is sent only when it differs from what the unit has. What somebody changed at
    the panel is reported, and never overwritten unasked.
    """

    def __init__(
        self, name: str, settings: ChamberUnitSettings, allowed_degC: tuple[float, float], clock: Clock
    ) -> None:
        self.name = name
        self.identity: Identity | None = None
        self._settings = settings
        self._allowed_degC = allowed_degC
        self._clock = clock
        module = next(language for language in LANGUAGES.values() if type(settings) is language.Settings)
        gap_s = compute_call_pause_s(clock, settings.gap_s)
        self._language = module.Language(name, settings.model_copy(update={"gap_s": gap_s}))
        self._language.client.clock = clock
        self.dead_man = self._language.dead_man
        self._worker: WorkerThread | None = None
        self._exclusive = Exclusive()
        self._sp_degC: float | None = None
        self._from_degC: float | None = None  # where a ramp to it began
        self._is_run = False
        self._renew_ns = 0

    async def open(self) -> None:
        """Identity and limits; nothing is commanded. DeviceFault when it is another unit, or may be set too far."""
        if self._worker is None:
            self._worker = WorkerThread(self.name, self._clock)
        async with self._exclusive:
            await self._call(self._check)

    async def close(self) -> None:
        """Let go of the wire; the chamber goes on."""
        lane, self._worker = self._worker, None
        if lane is not None:
            await lane.call(self._language.client.close)
            lane.close()

    async def read(self) -> tuple[Reading, ...]:
        """pv, sp, running, fault; the reason of `fault` has its alarms and what was done at the panel."""
        async with self._exclusive:
            state = await self._call(self._identify_and_read)
            if self._is_run and state.running and self._clock.now_ns() >= self._renew_ns:
                await self._call(self._language.renew)
                self._renew_ns = self._clock.now_ns() + to_ns(_RENEW_S)
            return self._readings(state)

    async def in_force(self) -> InForce:
        """Return how it is known that the written set-point acts, as Controller.in_force states."""
        async with self._exclusive:
            state = await self._call(self._identify_and_read)
            return InForce(self._language.in_force_by, self._language.not_reported, state.objections)

    async def set_temperature(self, degC: float) -> None:
        """Send a set-point, unless the unit has it, and read it back. Refused: outside what is allowed (nothing is
        sent), clamped, or without effect. DeviceFault: it would not be in force; nothing is sent."""
        low_degC, high_degC = self._allowed_degC
        if not low_degC <= degC <= high_degC:
            raise Refused(self.name, f"{degC:g} degC is outside {low_degC:g}..{high_degC:g} degC; nothing was sent")
        async with self._exclusive:
            await self._call(self._set, degC)
            self._sp_degC = degC

    async def run(self) -> None:
        """Switch humidity off, start, confirmed. DeviceFault: an alarm stands, which only an operator may reset, or
        its set-point is not in force."""
        async with self._exclusive:
            await self._call(self._start)
            self._is_run, self._renew_ns = True, self._clock.now_ns() + to_ns(_RENEW_S)

    async def stop(self) -> None:
        """Stop, confirmed."""
        async with self._exclusive:
            self._is_run = False
            await self._call(self._switch, False)

    async def make_safe(self) -> None:
        """Stopped, confirmed; DeviceFault when it is not."""
        await self.stop()

    async def _call(self, function: Callable[..., Result], *args: object) -> Result:
        if self._worker is None:
            raise Unreachable(self.name, "not open")
        return await self._worker.call(function, *args)

    # Below: in the lane's thread.

    def _check(self) -> None:
        answer = self._language.identity()
        if self._settings.identity not in answer:
            raise DeviceFault(self.name, f"it says that it is {answer!r}, not {self._settings.identity!r}; not used")
        protocol = str(self._settings.model_dump()["protocol"])
        found = Identity("", answer or f"climate chamber that speaks {protocol}", "", "", by_map=not answer)
        self.identity = check_same_device(self.name, found, self.identity)
        self._check_limits()
        self._exclusive.is_known = True

    def _check_limits(self) -> None:
        found, low, high = self._language.limits_degC(), *self._allowed_degC
        limits = found or self._settings.limits_at_panel_degC
        if limits is None:
            text = (
                "it does not tell the set-point limits of its controller, on which its safety rests when this computer "
                "dies; set them at the panel, and say so by limits_at_panel_degC"
            )
            raise DeviceFault(self.name, text)
        if limits[0] < low or limits[1] > high:
            whose = "its controller allows" if found else "limits_at_panel_degC allows"
            raise DeviceFault(
                self.name,
                f"{whose} set-points of {limits[0]:g}..{limits[1]:g} degC, the stand {low:g}..{high:g} degC; nothing "
                "else limits it when this computer dies: set its limits at the panel",
            )

    def _identify_and_read(self) -> ChamberState:
        """Read the state, after making sure which unit answers."""
        if not (self._exclusive.is_known and self._language.client.connected):
            self._check()
        return self._language.state()

    def _set(self, degC: float) -> None:
        state = self._identify_and_read()
        self._refuse_out_of_force(state)
        near_K = self._language.resolution_K / 2
        if abs(state.set_degC - degC) < near_K and (state.ramp_degC is None or self._sp_degC == degC):
            return  # one that moves may only pass there
        self._from_degC = state.set_degC
        self._language.set_temperature(degC)
        for _ in range(_LOOKS):
            state = self._language.state()
            if abs(state.set_degC - degC) < near_K or self._is_ramping(state, degC):
                return self._refuse_out_of_force(state)
        if abs(state.set_degC - self._from_degC) < near_K:
            text = f"not in control: the set-point {degC:g} degC had no effect"
            raise Refused(self.name, f"{text}; is remote control (EXTERN) on at the panel?")
        raise Refused(self.name, f"set to {degC:g} degC, it reads {state.set_degC:g} degC: clamped by the unit")

    def _is_ramping(self, state: ChamberState, degC: float) -> bool:
        """A nominal value that moves with the ramp lies between where it began and where it goes."""
        if state.ramp_degC is None or self._from_degC is None:
            return False
        low_degC, high_degC = sorted((self._from_degC, degC))
        return low_degC <= state.ramp_degC <= high_degC

    def _refuse_out_of_force(self, state: ChamberState) -> None:
        if state.objections:
            raise DeviceFault(self.name, f"its set-point is not in force: {'; '.join(state.objections)}")

    def _start(self) -> None:
        state = self._identify_and_read()
        if state.alarms:
            raise DeviceFault(self.name, f"{', '.join(state.alarms)}; look at the chamber, and reset it there")
        self._refuse_out_of_force(state)
        if state.humidity_on:
            self._language.humidity_off()
            if self._language.state().humidity_on:
                raise DeviceFault(self.name, "humidity cannot be switched off; do so at the panel")
        self._switch(True)

    def _switch(self, on: bool) -> None:
        if not self._exclusive.is_known and on:
            self._check()
        if not on and self._try_stop():
            return
        self._language.run(on)
        for _ in range(_LOOKS):
            if self._language.state().running is on:
                return
        what = "start" if on else "stop"
        text = f"not in control: it did not {what}; is remote control (EXTERN) on at the panel?"
        raise DeviceFault(self.name, text)

    def _try_stop(self) -> bool:
        """False also when that cannot be read: then it is stopped all the same."""
        try:
            return not self._language.state().running
        except (GarbledReply, Refused):
            return False

    def _readings(self, state: ChamberState) -> tuple[Reading, ...]:
        now_ns = self._clock.now_ns()
        faults, sp_degC = [*state.alarms, *state.objections], state.set_degC
        if self._sp_degC is not None:
            if self._is_ramping(state, self._sp_degC):
                sp_degC = self._sp_degC
            elif abs(sp_degC - self._sp_degC) >= self._language.resolution_K / 2:
                faults.append(f"set point changed at the unit, from {self._sp_degC:g} to {sp_degC:g} degC")
        suspicion = "the door is open" if state.door_open else ""
        faults += [suspicion] if suspicion and self._is_run else []
        if state.humidity_on and self._is_run:
            faults.append("humidity is on")
        return (
            Reading(f"{self.name}.pv", state.actual_degC, "degC", now_ns, reason=suspicion),
            Reading(f"{self.name}.sp", sp_degC, "degC", now_ns),
            Reading(f"{self.name}.running", float(state.running), "1", now_ns),
            Reading(f"{self.name}.fault", float(bool(faults)), "1", now_ns, reason=", ".join(faults)),
        )


def _make(name: str, settings: ChamberUnitSettings, around: DriverContext) -> ClimateChamber:
    return ClimateChamber(name, settings, around.of_section("limits").chamber_degC, around.clock)


def _advise(error: DeviceError, name: str, settings: ChamberUnitSettings) -> str:
    if isinstance(error, Unreachable):
        return "is it on, its interface the one in the file, and no other program connected to it?"
    return "compare climate_chamber in the stand's file with the unit, and its limits with limits.chamber_degC"


KIND = DeviceKind(
    name="regulator",
    settings=ChamberUnitSettings,
    make=_make,
    channels=CONTROLLED,
    section="climate_chamber",
    device="regulator",
    rank=20,
    advise=_advise,
    check=check_controller,
    verbs=CONTROL,
    fakes=tuple(f"climate_chamber.{protocol}" for protocol in LANGUAGES),
)
