"""What only shows when something moves: the timer that guards the heat, the flap, the stages, the cameras' frames.

All of it goes through the verbs of the stand, so through its gate and interlock. Nothing is heated: the heater's relay
is held for some seconds while the permissions are withdrawn and the regulator is stopped with an output of 0.
"""

from __future__ import annotations

from collections.abc import Awaitable
from typing import cast

from thermostand.drivers.devices.cameras.cameras_by_protocol import check_settings
from thermostand.drivers.devices.device_check import Add, Finding, check_identity
from thermostand.drivers.devices.kinds import Equipment
from thermostand.drivers.devices.protocols import Actuator, Camera
from thermostand.foundation.clock import NS_PER_S, Clock
from thermostand.foundation.errors import DeviceError, StandError, StandTripped, Superseded
from thermostand.foundation.events import DEAD_MAN_TESTED, HOME_RESIDUAL, HOME_RESIDUAL_LARGE
from thermostand.foundation.items import Event, Item
from thermostand.foundation.readings import Quality
from thermostand.stand.assembly.assemble import Assembly

_FRAMES = 6  # enough for a rate; round number, nothing was measured
_SLOW = 0.8  # of the longest travel that the stand's file allows
_MOST_APART_K = 10.0  # a chamber so far from its laboratory keeps its flap shut


class MovementChecks:
    """Movement checks of the devices that answer, by their names in `opened`; each says what it found."""

    def __init__(self, assembly: Assembly, opened: set[str], add: Add) -> None:
        self._assembly = assembly
        self._opened = opened
        self._add = add
        self._events: list[Event] = []
        assembly.hub.subscribe(self._follow)

    async def of(self, each: Equipment) -> None:
        """What moves of this device; from now on it is made safe at the end."""
        device = self._assembly.devices.every[each.name]
        if each.name in self._opened and hasattr(device, "make_safe"):
            self._assembly.stand.opened(cast("Actuator", device))
        if each.kind.device == "regulator":
            await self.check_heat_timer()
        elif device is self._assembly.devices.flap:
            await self.check_flap()
        elif each.name in self._assembly.devices.axes:
            await self.check_axis(each.name)

    async def check_heat_timer(self) -> None:
        """Does the board drop the heater's relay in time, and does a timed-on sent again start its time again?"""
        stand, devices = self._assembly.stand, self._assembly.devices
        name, what = devices.relays.name, "timed-on"
        if not {name, devices.regulator.name} <= self._opened:
            text = "not measured, since relay board and regulator do not both answer"
            self._add(Finding(name, what, "unverified", text, "mend them, and check again"))
            return
        try:
            await stand.chamber.permits.switch_off_left_on()
            await devices.regulator.stop()
            await stand.chamber.test_dead_man(is_timed=True)
        except StandTripped:
            raise
        except StandError as error:
            text = error.text if isinstance(error, DeviceError) else str(error)
            to_do = "nothing may be heated with it: take a board with a timer that re-arms, and look at the wiring"
            self._add(Finding(name, what, "failed", text, to_do, self._find_last_event(DEAD_MAN_TESTED)))
            return
        data = self._find_last_event(DEAD_MAN_TESTED)
        if not devices.relays.has_timer:
            self._add(Finding(name, what, "ok", "no relay board, so none to be measured"))
            return
        text = f"a timed-on of {data.get('pulse_s')} s that was sent again held for {data.get('held_s')} s from then"
        self._add(Finding(name, what, "ok", text, data=data))

    async def check_flap(self) -> None:
        """Open and close, each with its time."""
        name, flap = self._assembly.devices.flap.name, self._assembly.config.flap
        if flap is None or name not in self._opened:
            return
        if apart_K := await self._measure_offset_K():
            text = f"not moved: the chamber is {apart_K:+.0f} K from the laboratory"
            self._add(
                Finding(name, "travel", "unverified", text, "check again when it is at the laboratory's temperature")
            )
            return
        imaging, clock, travel_s = self._assembly.stand.imaging, self._assembly.clock, flap.travel_s
        try:
            await imaging.close_flap()
            open_s = await _measure_duration_s(imaging.open_flap(), clock)
            close_s = await _measure_duration_s(imaging.close_flap(), clock)
        except Superseded:
            raise
        except DeviceError as error:
            self._add(Finding(name, "travel", "failed", error.text, self._advice(error, name)))
            return
        data: dict[str, object] = {"open_s": open_s, "close_s": close_s, "travel_s": travel_s}
        text = f"opens in {open_s:.1f} s, closes in {close_s:.1f} s"
        if max(open_s, close_s) > _SLOW * travel_s:
            to_do = f"nearly flap.travel_s ({travel_s:g} s): raise that, or look what holds it"
            self._add(Finding(name, "travel", "warning", text, to_do, data))
            return
        self._add(Finding(name, "travel", "ok", text, data=data))

    async def check_axis(self, name: str) -> None:
        """Home; one that had a home before tells how far it was off, and goes back to where it was."""
        if name not in self._opened:
            return
        stand, axis = self._assembly.stand, self._assembly.devices.axes[name]
        try:
            position, *_ = await axis.read()
            was_homed = await axis.homed()
            took_s = await _measure_duration_s(stand.table.check_home(name), self._assembly.clock)
            low, high = self._assembly.config.axes[name].limits
            if was_homed and low <= position.value <= high:
                await stand.table.move_to(name, position.value)
        except Superseded:
            raise
        except DeviceError as error:
            self._add(Finding(name, "home", "failed", error.text, self._advice(error, name)))
            return
        if not was_homed:
            text = f"homed in {took_s:.1f} s; it had no home before, so there is nothing to compare"
            self._add(Finding(name, "home", "ok", text, data={"took_s": took_s}))
            return
        data = {**self._find_last_event(HOME_RESIDUAL, HOME_RESIDUAL_LARGE), "took_s": took_s}
        text = f"its home was off by {data['residual']} {data['unit']} ({data['steps']} steps)"
        if any(event.kind == HOME_RESIDUAL_LARGE and event.data.get("axis") == name for event in self._events):
            to_do = "it has lost steps, or its switch moves: look at load, speed and switch, and check again"
            self._add(Finding(name, "home", "warning", text, to_do, data))
            return
        self._add(Finding(name, "home", "ok", text, data=data))

    async def cameras(self) -> None:
        """Frames as fast as they come, and the temperature behind them; a supply that was off is off again at the
        end, also when an operator breaks the check off: it is then made safe with what moved."""
        stand = self._assembly.stand
        if not self._assembly.devices.cameras or self._assembly.devices.relays.name not in self._opened:
            return  # there are none, or that their relay does not answer was reported
        try:
            await self._check_supplied_cameras()
        finally:
            if stand.imaging.supply.was_on is False:
                stand.safety.take(stand.imaging.supply)

    async def _check_supplied_cameras(self) -> None:
        devices, supply = self._assembly.devices, self._assembly.stand.imaging.supply
        try:
            await supply.switch_on()
        except Superseded:
            raise
        except DeviceError as error:
            name = error.device if error.device in devices.cameras else next(iter(devices.cameras))
            to_do = self._advice(error, name)
            self._add(Finding(name, "link", "failed", error.text, to_do))
            return
        for name, camera in devices.cameras.items():
            if name not in self._opened:
                self._opened.add(name)
                self._add(check_identity(camera))
                await check_settings(camera, self._add)
            await self._check_frames(name, camera)
        if supply.was_on is False:
            await supply.switch_off()

    async def _check_frames(self, name: str, camera: Camera) -> None:
        wanted_hz = camera.settings.frame_rate_hz
        try:
            first = await camera.grab()  # starts the acquisition
            begin_ns = self._assembly.clock.now_ns()
            frames = [await camera.grab() for _ in range(_FRAMES)]
            took_s = (self._assembly.clock.now_ns() - begin_ns) / NS_PER_S
            temperature, *_ = await camera.read()
        except DeviceError as error:
            self._add(Finding(name, "frames", "failed", error.text, self._advice(error, name)))
            return
        rate_hz, dropped = _FRAMES / took_s, sum(frame.dropped for frame in frames)
        megabytes = first.image.nbytes / 1e6
        data: dict[str, object] = {
            "rate_hz": round(rate_hz, 2),
            "MB_s": round(rate_hz * megabytes, 1),
            "dropped": dropped,
            "mean_grey": round(float(first.image.mean()), 1),
        }
        text = f"{rate_hz:.1f} frames per s, {rate_hz * megabytes:.0f} MB/s, {dropped} lost"
        if dropped or rate_hz < wanted_hz:
            to_do = f"{wanted_hz:g} per s are asked for: jumbo frames (MTU 9000, packet_size 8000)? a packet_delay_ns?"
            self._add(Finding(name, "frames", "warning", text, to_do, data))
        else:
            self._add(Finding(name, "frames", "ok", text, data=data))
        if temperature.quality is Quality.GOOD:
            found: dict[str, object] = {"camera_degC": temperature.value}
            self._add(Finding(name, "temperature", "ok", f"{temperature.value:.1f} degC", data=found))
        elif camera.settings.has_temperature:
            to_do = "say where it is in cameras.NAME.temperature, or has_temperature: false"
            self._add(Finding(name, "temperature", "failed", temperature.reason, to_do))

    async def _measure_offset_K(self) -> float:
        """How far the chamber's air is from the laboratory; 0 when it is near, or not known."""
        devices = self._assembly.devices
        if devices.thermometers.name not in self._opened:
            return 0.0
        try:
            readings = {each.channel.partition(".")[2]: each for each in await devices.thermometers.read()}
        except DeviceError:
            return 0.0
        air, outside = readings.get("air"), readings.get("laboratory", readings.get("granite_outside"))
        if air is None or outside is None or {air.quality, outside.quality} != {Quality.GOOD}:
            return 0.0
        apart_K = air.value - outside.value
        return apart_K if abs(apart_K) > _MOST_APART_K else 0.0

    def _advice(self, error: DeviceError, name: str) -> str:
        each = next(each for each in self._assembly.equipment if each.name == name)
        return each.kind.advise(error, name, each.settings)

    def _follow(self, item: Item) -> None:
        if isinstance(item, Event):
            self._events.append(item)

    def _find_last_event(self, *kinds: str) -> dict[str, object]:
        """The data of the last such event."""
        return next((dict(event.data) for event in reversed(self._events) if event.kind in kinds), {})


async def _measure_duration_s(work: Awaitable[object], clock: Clock) -> float:
    begin_ns = clock.now_ns()
    await work
    return round((clock.now_ns() - begin_ns) / NS_PER_S, 2)
