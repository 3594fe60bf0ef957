"""The verbs an experiment's steps may use, and the one gate before them: the latch and the limits."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path

from drivers.devices.camera import Camera
from drivers.devices.flap import Flap
from drivers.devices.protocols import Actuator
from drivers.devices.regulator import Regulator
from drivers.devices.relays import CAMERA_POWER, Relays
from drivers.devices.stage import Axis
from drivers.devices.thermometers import Thermometers
from foundation.clock import Clock, boot_of, seconds_ns
from foundation.errors import ConfigError, DeviceError, DeviceFault, Occupied, StandTripped, Unreachable
from foundation.hub import Hub
from foundation.items import Event
from foundation.readings import Frame
from foundation.tasks import cancelled
from stand.chamber.compressor import restored
from stand.chamber.compressor_file import CompressorFile
from stand.chamber.keeper import Keeper
from stand.chamber.permits import PermitLimits, Permits
from stand.fault import Fault
from stand.gate import CAMERA_LOST, INTERLOCK, OPERATOR, STOPPING, Gate
from stand.imaging.camera_cooling import Cooling, cool_down, last_word
from stand.imaging.camera_opening import LOST_LIMIT_S, RETRY_S, CameraOpening
from stand.imaging.equilibrium import CameraEquilibrium, EquilibriumLimits
from stand.safety import Safety
from stand.table.motions import Motions
from stand.table.stage_care import check_home, ready

_JAMMED_AGAIN_S = 60.0  # between tries to close a flap that jams: its motor must not be worn
_OCCUPIED_AGAIN_S = 5.0
_CAMERA_BOOT_LIMIT_S = 60.0


class Interlocked(StandTripped):
    """The guard has made the stand safe and an operator has not cleared it yet: nothing may move meanwhile."""


@dataclass(frozen=True, slots=True)
class Devices:
    """Everything the stand is made of."""

    regulator: Regulator
    relays: Relays
    thermometers: Thermometers
    axes: Mapping[str, Axis]
    flap: Flap
    camera: Camera


@dataclass(frozen=True, slots=True)
class Limits:
    """What no step may exceed, how long a permission to heat or cool lives and how often it is renewed (s), how long
    the camera takes to boot (s)."""

    chamber_degC: tuple[float, float]
    permits: PermitLimits
    renew_s: float
    camera_boot_s: float
    equilibrium: EquilibriumLimits = field(default_factory=EquilibriumLimits)
    compressor_file: Path | None = None  # what the compressor did last, for the next daemon


class _CameraSupply:
    """The camera's supply as an actuator that is safe when it is off."""

    def __init__(self, relays: Relays) -> None:
        self.name = f"{relays.name}.{CAMERA_POWER}"
        self._relays = relays

    async def make_safe(self) -> None:
        """Off, confirmed."""
        await self._relays.switch(CAMERA_POWER, on=False)


class Stand:
    """One stand. After a latched fault every verb but close_flap raises StandTripped, while an interlock holds the gate
    Interlocked. `safety` is the one owner of making it safe, `permits` of heat and cold, `keeper` renews those."""

    def __init__(self, devices: Devices, limits: Limits, hub: Hub, clock: Clock) -> None:
        self.devices = devices
        self.fault: Fault | None = None
        self.gate = Gate()
        self.attended = False  # whether an operator does what is prompted for
        self._limits = limits
        self._hub = hub
        self._clock = clock
        self.compressor_file = CompressorFile(limits.compressor_file, hub, clock)
        compressor = restored(limits.compressor_file, clock.now_ns(), boot_of(clock))
        self.permits = Permits(devices.relays, limits.permits, compressor, self.compressor_file.note, hub, clock)
        self.safety = Safety(self.permits.revoke, hub, clock)
        self.keeper = Keeper(
            self.permits, devices.regulator, hub, clock, limits.renew_s, lambda: self._camera_supplied, self._dropped
        )
        self.camera_was_supplied: bool | None = None  # before this daemon switched it on
        self._camera_supplied = False  # its supply is on, as far as we know
        self._commanded: dict[str, float] = {}  # axis -> mm or deg, where the plan put it last
        self.motions = Motions()
        self.equilibrium = CameraEquilibrium(limits.equilibrium, hub, clock)
        self.opening = CameraOpening(
            devices.camera, hub, clock, lambda: self._camera_supplied, lambda reason: self.lose_equilibrium(reason)
        )
        self._moving_flap = asyncio.Lock()  # one after the other; making safe waits for nobody
        self._without_camera_ns = 0  # how long a lost camera was waited for since its last frame
        self._cooling: Cooling | None = None  # the camera's last word before it was switched off

    def latch(self, fault: Fault) -> None:
        """Close the gate for good; the first fault stays. Nothing earns time while the stand is being made safe."""
        self.fault = self.fault or fault
        self.gate.hold(STOPPING)
        self.permits.revoke()

    def opened(self, actuator: Actuator) -> None:
        """This actuator answers: from now on it is made safe whenever that is demanded."""
        if actuator is self.devices.relays:
            self.safety.take(self.permits)
        elif actuator is self.devices.flap:
            self.safety.take(actuator, _JAMMED_AGAIN_S)
        else:
            self.safety.take(actuator)

    async def start_chamber(self, chamber_degC: float) -> None:
        """Permit heating and cooling, set the set-point, run the regulator."""
        await self.set_temperature(chamber_degC)
        self._check()  # after every wait: a fault may have closed the gate meanwhile
        self.permits.grant()
        await self.keeper.beat()
        self._check()
        await self.devices.regulator.run()

    async def set_temperature(self, chamber_degC: float) -> None:
        """A new chamber set-point, degC; ConfigError outside the limits. While somebody has the regulator autotune,
        which its readings tell as well, this waits until that ends or the guard holds the stand."""
        told = False
        while True:
            self._check(chamber_degC)
            try:
                return await self.devices.regulator.set_temperature(chamber_degC)
            except Occupied as error:
                if not told:
                    text = f"{error}; the run waits"
                    self._hub.publish(Event(self._clock.now_ns(), "warning", "regulator_occupied", text))
                told = True
            await self._clock.sleep_until(self._clock.now_ns() + seconds_ns(_OCCUPIED_AGAIN_S))

    async def withdraw_permits(self) -> None:
        """Before anything else: heater and compressor lose what permission another daemon, or somebody by hand, left
        them, which is told. A compressor that ran until now begins its rest now."""
        await self.permits.withdraw_left_on()

    async def test_dead_man(self) -> None:
        """The relay board's timer, on the heater's relay, while the regulator is stopped and gives no output;
        DeviceFault when it gives one, or when the board cannot be relied upon."""
        output = {reading.channel: reading.value for reading in await self.devices.regulator.read()}
        name = self.devices.regulator.name
        if not output.get(f"{name}.mv_heat", 0.0) <= 0:
            raise DeviceFault(name, f"is stopped and yet gives {output[f'{name}.mv_heat']:g} % heat; look at the unit")
        await self.permits.test_dead_man()

    async def stop_chamber(self) -> None:
        """Stop the regulator; heating and cooling lose their permission at once."""
        self.permits.revoke()
        await self.devices.regulator.stop()
        await self.permits.make_safe()

    @property
    def flap_open(self) -> bool:
        """Whether the flap has not been confirmed shut since it was last opened."""
        return not self.devices.flap.is_shut

    async def open_flap(self) -> None:
        """Open the flap and confirm it."""
        async with self._moving_flap:
            self._check()
            with self.motions.under_way("flap", "opening"):
                await self.devices.flap.move_open()

    async def close_flap(self) -> None:
        """Close the flap and confirm it; allowed after a trip too."""
        async with self._moving_flap:
            with self.motions.under_way("flap", "closing"):
                await self.devices.flap.move_closed()

    async def approach_again(self) -> None:
        """Before frames: stages whose motors have been switched off meanwhile are approached anew, from below."""
        self._check()
        with self.motions.under_way("stages", "back to where the plan put them, should they stand elsewhere"):
            await ready(self.devices.axes, self._commanded, self._hub, self._clock)

    async def take_frame(self, exposure_s: float, step_id: str, due_ns: int = 0) -> bool:
        """One frame of the step, published; exposed at `due_ns` when that is still ahead. False when the camera was
        lost: see `_regain`; the flap may have been shut meanwhile."""
        self._check()
        try:
            frame = await self.devices.camera.grab(exposure_s, due_ns)
        except Unreachable as error:
            await self._regain(error)
            return False
        self._without_camera_ns = 0
        self._hub.publish(replace(frame, step_id=step_id))
        return True

    async def look(self, exposure_s: float, step_id: str) -> Frame | None:
        """One frame of the step through the flap, which is open for it only; published. None when the camera was lost:
        see `_regain`."""
        await self.open_flap()
        try:
            frame = replace(await self.devices.camera.grab(exposure_s), step_id=step_id)
        except Unreachable as error:
            lost = error
        else:
            self._without_camera_ns = 0
            self._hub.publish(frame)
            return frame
        finally:
            await self.close_flap()
        await self._regain(lost)
        return None

    async def _regain(self, lost: Unreachable) -> None:
        """Hold the gate until the camera, lost for that reason, is open again, or is found to be without supply; `lost`
        when there was no frame for 30 min of such waiting."""
        begin_ns, limit_ns = self._clock.now_ns(), seconds_ns(LOST_LIMIT_S)
        if self._without_camera_ns >= limit_ns:
            raise lost
        self._hub.publish(Event(begin_ns, "warning", "camera_lost", str(lost)))
        self.gate.hold(CAMERA_LOST)
        deadline_ns = begin_ns + limit_ns - self._without_camera_ns
        try:
            is_open = await self.opening.until_open(self._check, deadline_ns, is_vain=lambda: not self._camera_supplied)
        finally:
            self.gate.clear(CAMERA_LOST)
            # One that opens at once and never gives a frame does not go on for ever either.
            self._without_camera_ns += max(self._clock.now_ns() - begin_ns, seconds_ns(RETRY_S))
        if is_open:
            self._hub.publish(Event(self._clock.now_ns(), "info", "camera_back", "the camera answers again"))

    async def move_to(self, axis: str, position: float) -> None:
        """Move a stage (mm or deg), homing it first when it lost its scale."""
        stage = self._axis(axis)
        self._commanded.pop(axis, None)  # nobody knows where it stands when the move fails
        with self.motions.under_way(axis, f"to {position:g} {stage.profile.unit}"):
            homed = await stage.homed()
            self._check()  # after every wait: a fault may have closed the gate meanwhile
            if not homed:
                with self.motions.under_way(axis, f"homing, then to {position:g} {stage.profile.unit}"):
                    await stage.home()
                self._check()
            await stage.move_to(position)
        self._commanded[axis] = position

    async def check_home(self, axis: str) -> None:
        """Home a stage again, record how far its scale had gone astray, and go back to where the plan had put it."""
        stage = self._axis(axis)
        with self.motions.under_way(axis, "homing"):
            await check_home(stage, self._hub, self._clock)
            self._check()
            if axis in self._commanded:
                await stage.move_to(self._commanded[axis])

    async def prompt(self, text: str) -> None:
        """Tell the operator what to do, and wait until it is done (a pause that the operator ends); when nobody attends
        the run goes on and says so."""
        self._check()
        self._hub.publish(Event(self._clock.now_ns(), "warning" if self.attended else "info", "prompt", text))
        if self.attended:
            self.gate.hold(OPERATOR)
            await self.gate.passed()
            return
        self._hub.publish(Event(self._clock.now_ns(), "warning", "prompt_skipped", f"nobody attends; not done: {text}"))

    async def cool_down(self, band_K: float, time_constant_s: float, max_s: float) -> None:
        """Wait until the camera, which is off, should be within `band_K` of the air near it."""
        self._check()
        await cool_down(self._cooling, band_K, time_constant_s, max_s, self._hub, self._clock)

    async def power_camera(self, *, on: bool) -> None:
        """Switch the camera's supply; on: return when the camera is open and configured."""
        self._check()
        if not on:
            # One that was off already has nothing new to say.
            self._cooling = last_word(self._hub.known("camera.temperature")) or self._cooling
            self._camera_supplied = False
            await self.devices.camera.close()
            await self.devices.relays.switch(CAMERA_POWER, on=False)
            return
        self._cooling = None
        await self._supply_camera()
        self._camera_supplied = True
        self.equilibrium.begin()

    @property
    def camera_supplied(self) -> bool:
        """Whether the camera's supply is on and the camera has been opened since."""
        return self._camera_supplied

    def lose_equilibrium(self, reason: str) -> None:
        """The camera's supply was or may have been off: whoever runs a plan calls `restore_camera` where it wants the
        camera on, and soaks it anew."""
        self.equilibrium.lose(reason)

    async def restore_camera(self) -> None:
        """After its equilibrium was lost: the camera's supply on again, should it be off, and the camera open; tried
        for 30 min, the gate being held."""
        if self._camera_supplied:
            return
        deadline_ns = self._clock.now_ns() + seconds_ns(LOST_LIMIT_S)
        self.gate.hold(CAMERA_LOST)
        try:
            while not self._camera_supplied:
                try:
                    await self.power_camera(on=True)
                except Unreachable:
                    if self._clock.now_ns() >= deadline_ns:
                        raise
        finally:
            self.gate.clear(CAMERA_LOST)

    async def _supply_camera(self) -> None:
        """Camera's supply on and the camera open. A relay that reads off is only held for some seconds at a time until
        the camera has answered: it might be another one than the configuration says, such as the heater's."""
        relays, hold_s = self.devices.relays, self._limits.permits.hold_s
        is_on = any(
            reading.channel == f"{relays.name}.{CAMERA_POWER}" and reading.value == 1 for reading in await relays.read()
        )
        self.camera_was_supplied = is_on if self.camera_was_supplied is None else self.camera_was_supplied
        holding: asyncio.Task[None] | None = None
        if is_on:
            await relays.switch(CAMERA_POWER, on=True)  # for good, should it have been timed
        else:
            await relays.hold_on(CAMERA_POWER, hold_s)
            holding = asyncio.create_task(self._hold_supply(hold_s))
        try:
            await self._clock.sleep_until(self._clock.now_ns() + seconds_ns(self._limits.camera_boot_s))
            deadline_ns = self._clock.now_ns() + seconds_ns(_CAMERA_BOOT_LIMIT_S)
            await self.opening.until_open(self._check, deadline_ns, RETRY_S)
        except BaseException:
            if holding is not None:
                await cancelled([holding])
                await relays.switch(CAMERA_POWER, on=False)
            raise
        if holding is not None:
            await cancelled([holding])
            self._check()
            await relays.switch(CAMERA_POWER, on=True)

    async def _hold_supply(self, hold_s: float) -> None:
        """Arm the camera's supply again until cancelled; a lost command is made up for by the next one."""
        while True:
            await self._clock.sleep_until(self._clock.now_ns() + seconds_ns(hold_s / 3))
            with suppress(DeviceError):
                await self.devices.relays.hold_on(CAMERA_POWER, hold_s)

    def cut_camera(self) -> None:
        """The camera itself is too warm: its supply goes off, too, whenever the stand is made safe from now on."""
        self._camera_supplied = False
        self.safety.take(_CameraSupply(self.devices.relays))
        self.safety.demand()

    def camera_is_off(self, cooling: Cooling | None) -> None:
        """What an earlier daemon left: the camera is off, and this was its last word before it was switched off."""
        self._cooling = cooling

    def _dropped(self) -> None:
        """The camera's supply reads off though it was switched on."""
        self._camera_supplied = False
        text = "the camera's supply is off though it was switched on: a brown-out of the relay board, or somebody else"
        self._hub.publish(Event(self._clock.now_ns(), "error", "camera_supply_off", text))
        self.lose_equilibrium(text)

    def _axis(self, axis: str) -> Axis:
        self._check()
        if axis not in self.devices.axes:
            raise ConfigError(
                f"the plan moves axis {axis}, but this stand has {', '.join(self.devices.axes) or 'none'}"
            )
        return self.devices.axes[axis]

    def _check(self, chamber_degC: float | None = None) -> None:
        if self.fault is not None:
            raise StandTripped(f"the stand is latched: {self.fault.text}")
        if INTERLOCK in self.gate.reasons:
            raise Interlocked("an interlock holds the stand until an operator clears it")
        low, high = self._limits.chamber_degC
        if chamber_degC is not None and not low <= chamber_degC <= high:
            raise ConfigError(f"chamber set-point {chamber_degC} degC is outside limits.chamber_degC {low}..{high}")
        for mover in (self.devices.flap, *self.devices.axes.values()):
            mover.allow()  # what making safe has barred, and bars again should it begin before the command is sent
