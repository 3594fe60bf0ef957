"""The verbs an experiment's steps may use, and the one gate before them: the latch and the limits."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from drivers.camera import Camera
from drivers.clock import Clock, seconds_ns
from drivers.flap import Flap
from drivers.interface import Actuator, ConfigError, Frame, GarbledReply, StandTripped, Unreachable
from drivers.regulator import Regulator
from drivers.relays import Relays
from drivers.stage import Axis
from drivers.thermometers import Thermometers
from stand.guarding.compressor import CompressorLimits, CompressorState, decide, keep, restored
from stand.guarding.interlocks import Fault
from stand.hub import Event, Hub
from stand.running.camera_cooling import Cooling, cool_down, last_word
from stand.running.gate import CAMERA_LOST, INTERLOCK, OPERATOR, STOPPING, Gate
from stand.running.stage_care import check_home, ready

# Real seconds for all actuators together to reach their safe state; the dead-man relay drops by itself after that.
_SAFE_LIMIT_S = 10.0
_CAMERA_BOOT_LIMIT_S = 60.0
_CAMERA_LOST_LIMIT_S = 1800.0
_CAMERA_RETRY_S, _CAMERA_LONGEST_RETRY_S = 1.0, 10.0


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
    """What no step may exceed, how long a permission to heat or cool lives, how long the camera takes to boot."""

    chamber_degC: tuple[float, float]
    hold_s: float
    camera_boot_s: float
    compressor: CompressorLimits
    compressor_file: Path | None = None  # what the compressor did last, for the next daemon


class Stand:
    """One stand. After a latched fault every verb but close_flap and make_safe raises StandTripped, while an interlock
    holds the gate Interlocked."""

    def __init__(self, devices: Devices, limits: Limits, hub: Hub, clock: Clock) -> None:
        self.devices = devices
        self.fault: Fault | None = None
        self.gate = Gate()
        self.attended = False  # whether an operator does what is prompted for
        self._limits = limits
        self._hub = hub
        self._clock = clock
        self._permitted = False
        self._compressor = restored(limits.compressor_file, clock.now_ns())
        self._compressor_until_ns = 0  # when its timed-on relay drops unless renewed
        self._making_safe = asyncio.Lock()
        self._commanded: dict[str, float] = {}  # axis -> mm or deg, where the plan put it last
        self._cooling: Cooling | None = None  # the camera's last word before it was switched off
        self.unconfirmed: tuple[str, ...] = ()  # what the last make_safe could not confirm

    def latch(self, fault: Fault) -> None:
        """Close the gate for good; the first fault stays. Nothing earns time while the stand is being made safe."""
        self.fault = self.fault or fault
        self.gate.hold(STOPPING)
        self._permitted = False

    async def start_chamber(self, chamber_degC: float) -> None:
        """Permit heating and cooling, set the set-point, run the regulator."""
        self._check(chamber_degC)
        await self.devices.regulator.set_temperature(chamber_degC)
        self._check()  # after every wait: a fault may have closed the gate meanwhile
        self._permitted = True
        await self.renew_permits()
        self._check()
        await self.devices.regulator.run()

    async def set_temperature(self, chamber_degC: float) -> None:
        """A new chamber set-point, degC; ConfigError outside the limits."""
        self._check(chamber_degC)
        await self.devices.regulator.set_temperature(chamber_degC)

    async def withdraw_permits(self) -> None:
        """Before anything else: heater and compressor lose what permission another daemon, or somebody by hand, left
        them, which is told. A compressor that ran until now begins its rest now."""
        left_on = {reading.channel for reading in await self.devices.relays.read() if reading.value == 1}
        await self.devices.relays.make_safe()
        for channel in sorted(left_on & {"relays.heater_enable", "relays.compressor"}):
            self._hub.publish(Event(self._clock.now_ns(), "warning", "left_on", f"{channel} was on; switched off"))
        if "relays.compressor" in left_on:
            self._compressor = CompressorState(False, self._clock.now_ns(), self._compressor.starts_ns)

    async def stop_chamber(self) -> None:
        """Stop the regulator; heating and cooling lose their permission at once."""
        self._permitted = False
        await self.devices.regulator.stop()
        await self.devices.relays.switch("heater_enable", on=False)
        await self.devices.relays.switch("compressor", on=False)
        await self._compressor_is_off()

    async def renew_permits(self) -> None:
        """Re-arm the timed-on relays of the heater and the compressor; only the guard calls this, while all is well.

        Both drop by themselves `hold_s` after the last call: a dead daemon neither heats nor cools.
        """
        if self._permitted:
            await self.devices.relays.hold_on("heater_enable", self._limits.hold_s)
        if self._permitted:  # still, after the wait
            await self._renew_compressor()

    async def _renew_compressor(self) -> None:
        now_ns = self._clock.now_ns()
        if self._compressor.running and now_ns >= self._compressor_until_ns:
            # It could not be renewed in time and has dropped by itself: its rest began there.
            await self._keep(CompressorState(False, self._compressor_until_ns, self._compressor.starts_ns))
        wanted = decide(
            self._compressor,
            self._limits.compressor,
            self._latest("regulator.mv_heat"),
            self._latest("regulator.mv_cool"),
            now_ns,
        )
        if wanted.running:
            await self.devices.relays.hold_on("compressor", self._limits.hold_s)
            self._compressor_until_ns = now_ns + seconds_ns(self._limits.hold_s)
        elif self._compressor.running:
            await self.devices.relays.switch("compressor", on=False)
        if wanted.running != self._compressor.running:
            text = "compressor started" if wanted.running else "compressor stopped"
            self._hub.publish(Event(self._clock.now_ns(), "info", "compressor", text))
        await self._keep(wanted)

    async def open_flap(self) -> None:
        """Open the flap and confirm it."""
        self._check()
        await self.devices.flap.move_open()

    async def close_flap(self) -> None:
        """Close the flap and confirm it; allowed after a trip too."""
        await self.devices.flap.move_closed()

    async def approach_again(self) -> None:
        """Before frames: stages whose motors have been switched off meanwhile are approached anew, from below."""
        self._check()
        await ready(self.devices.axes, self._commanded, self._hub, self._clock)

    async def take_frame(self, exposure_s: float, step_id: str, due_ns: int = 0) -> None:
        """One frame of the step, published; exposed at `due_ns` when that is still ahead. A camera lost meanwhile holds
        the gate until it has answered again and given the frame; Unreachable after 30 min."""
        self._check()
        deadline_ns = self._clock.now_ns() + seconds_ns(_CAMERA_LOST_LIMIT_S)
        try:
            frame = await self._grab(exposure_s, due_ns, deadline_ns)
        finally:
            self.gate.clear(CAMERA_LOST)
        self._hub.publish(replace(frame, step_id=step_id))

    async def look(self, exposure_s: float, step_id: str) -> Frame | None:
        """One frame of the step through the flap, which is open for it only; published. None when the camera was lost:
        it answers again then, or Unreachable after 30 min."""
        await self.open_flap()
        try:
            frame = replace(await self.devices.camera.grab(exposure_s), step_id=step_id)
            self._hub.publish(frame)
            return frame
        except Unreachable as error:
            lost = error
        finally:
            await self.close_flap()
        try:
            await self._regain(lost, self._clock.now_ns() + seconds_ns(_CAMERA_LOST_LIMIT_S))
        finally:
            self.gate.clear(CAMERA_LOST)
        return None

    async def _grab(self, exposure_s: float, due_ns: int, deadline_ns: int) -> Frame:
        while True:
            try:
                return await self.devices.camera.grab(exposure_s, due_ns)
            except Unreachable as error:
                if self._clock.now_ns() >= deadline_ns:
                    raise
                lost = error
            await self._regain(lost, deadline_ns)

    async def _regain(self, lost: Unreachable, deadline_ns: int) -> None:
        """Hold the gate until the camera, lost for that reason, is open again."""
        self._hub.publish(Event(self._clock.now_ns(), "warning", "camera_lost", str(lost)))
        self.gate.hold(CAMERA_LOST)
        await self._open_camera(deadline_ns, _CAMERA_LONGEST_RETRY_S)
        self._hub.publish(Event(self._clock.now_ns(), "info", "camera_back", "the camera answers again"))

    async def move_to(self, axis: str, position: float) -> None:
        """Move a stage (mm or deg), homing it first when it lost its scale."""
        stage = self._axis(axis)
        self._commanded.pop(axis, None)  # nobody knows where it stands when the move fails
        if not await stage.homed():
            await stage.home()
            self._check()
        await stage.move_to(position)
        self._commanded[axis] = position

    async def check_home(self, axis: str) -> None:
        """Home a stage again, record how far its scale had gone astray, and go back to where the plan had put it."""
        stage = self._axis(axis)
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
            self._cooling = last_word(self._hub.latest("camera.temperature")) or self._cooling
            await self.devices.camera.close()
            await self.devices.relays.switch("camera_power", on=False)
            return
        self._cooling = None
        await self.devices.relays.switch("camera_power", on=True)
        await self._clock.sleep_until(self._clock.now_ns() + seconds_ns(self._limits.camera_boot_s))
        await self._open_camera(self._clock.now_ns() + seconds_ns(_CAMERA_BOOT_LIMIT_S), _CAMERA_RETRY_S)

    def camera_is_off(self, cooling: Cooling | None) -> None:
        """What an earlier daemon left: the camera is off, and this was its last word before it was switched off."""
        self._cooling = cooling

    async def make_safe(self) -> None:
        """Every actuator to its safe state, all at once, within a real-time limit; what failed is in `unconfirmed`."""
        self._permitted = False
        async with self._making_safe:
            devices = self.devices
            actuators = (devices.regulator, devices.relays, devices.flap, *devices.axes.values())
            failures = await asyncio.gather(*(self._safely(actuator) for actuator in actuators))
            unconfirmed, told = tuple(failure for failure in failures if failure), self.unconfirmed
            self.unconfirmed = unconfirmed
            for text in unconfirmed:
                if text not in told:
                    self._hub.publish(Event(self._clock.now_ns(), "error", "not_confirmed_safe", text))
            if told and not unconfirmed:
                self._hub.publish(Event(self._clock.now_ns(), "info", "confirmed_safe", "the stand is safe"))
            await self._compressor_is_off()

    async def _safely(self, actuator: Actuator) -> str:
        """Why the actuator's safe state is not confirmed, "" when it is; a lost answer is worth a second try."""
        try:
            async with asyncio.timeout(_SAFE_LIMIT_S):
                try:
                    await actuator.make_safe()
                except (Unreachable, GarbledReply):
                    await actuator.make_safe()
        except Exception as error:  # noqa: BLE001 - whatever one actuator does, the others must still be made safe
            return f"{actuator.name} did not confirm its safe state: {str(error) or 'no answer in time'}"
        return ""

    async def _open_camera(self, deadline_ns: int, longest_retry_s: float) -> None:
        """Open the camera, trying again after 1 s, 2 s, 4 s ... until `deadline_ns`; what the last try raised."""
        retry_s = _CAMERA_RETRY_S
        while True:
            self._check()
            try:
                return await self.devices.camera.open()
            except Unreachable:
                if self._clock.now_ns() >= deadline_ns:
                    raise
            await self._clock.sleep_until(self._clock.now_ns() + seconds_ns(retry_s))
            retry_s = min(2 * retry_s, longest_retry_s)

    async def _compressor_is_off(self) -> None:
        if self._compressor.running:
            await self._keep(CompressorState(False, self._clock.now_ns(), self._compressor.starts_ns))

    async def _keep(self, compressor: CompressorState) -> None:
        """From now on the compressor is in this state; that it was switched is kept for the next daemon."""
        was, self._compressor = self._compressor, compressor
        if compressor.running == was.running or self._limits.compressor_file is None:
            return
        try:
            with self._clock.hold():
                await asyncio.to_thread(keep, self._limits.compressor_file, compressor)
        except OSError as error:
            text = f"the next start will not know when the compressor last ran: {error}"
            self._hub.publish(Event(self._clock.now_ns(), "warning", "compressor_not_kept", text))

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

    def _latest(self, channel: str) -> float:
        reading = self._hub.latest(channel)
        return float("nan") if reading is None else reading.value
