"""Frames through the flap, and how long a lost camera is waited for."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import replace
from functools import partial

from thermostand.drivers.devices.protocols import Camera, Shutter
from thermostand.foundation.clock import Clock, to_ns
from thermostand.foundation.errors import Unreachable
from thermostand.foundation.events import CAMERA_BACK, CAMERA_LOST
from thermostand.foundation.hub import Hub
from thermostand.foundation.readings import TEMPERATURE_SUSPECT, Frame
from thermostand.stand.config.stand_config import LEADING
from thermostand.stand.imaging.camera_recovery import LOST_LIMIT_S, RETRY_S
from thermostand.stand.imaging.camera_supply import CameraSupply
from thermostand.stand.safety import gate as reasons
from thermostand.stand.safety.gate import Gate
from thermostand.stand.safety.interlock import Interlock, Motions


class Imaging:
    """Flap and cameras; `supply` is theirs."""

    def __init__(
        self,
        *,
        cameras: Mapping[str, Camera],
        flap: Shutter,
        supply: CameraSupply,
        interlock: Interlock,
        gate: Gate,
        motions: Motions,
        hub: Hub,
        clock: Clock,
    ) -> None:
        self.supply = supply
        self._cameras = cameras
        self._flap = flap
        self._interlock = interlock
        self._gate = gate
        self._motions = motions
        self._hub = hub
        self._clock = clock
        self._moving_flap = asyncio.Lock()  # one command after the other; making safe waits for none
        self.judge_temperature: Callable[[str, float, int], str] = lambda channel, value, time_ns: (
            ""
        )  # of a temperature
        self._without_camera_ns = 0  # how long a lost camera was waited for since its last frame
        self._exposed_ns = 0  # when the last exposure ended

    @property
    def flap_open(self) -> bool:
        """Whether the flap has not been confirmed shut since it was last opened."""
        return not self._flap.is_shut

    async def open_flap(self) -> None:
        """Open the flap and confirm it."""
        async with self._moving_flap:
            self._interlock.check()
            with self._motions.under_way("flap", "opening"):
                await self._flap.move_open()

    async def close_flap(self) -> None:
        """Close the flap and confirm it; allowed after a trip too."""
        async with self._moving_flap:
            with self._motions.under_way("flap", "closing"):
                await self._flap.move_closed()

    async def power_camera(self, *, on: bool) -> None:
        """Switch the supply as the plan has it: what is known of the camera's equilibrium counts no longer."""
        self.supply.equilibrium.forget()
        await (self.supply.switch_on() if on else self.supply.switch_off())

    async def cool_down(self, band_K: float, time_constant_s: float, max_s: float) -> None:
        """Wait until the camera, which is off, is as cold as the air."""
        await self.supply.cool_down(band_K, time_constant_s, max_s)

    async def take_frame(
        self,
        exposure_s: float,
        step_id: str,
        due_ns: int = 0,
        cameras: Collection[str] = (),
        flags: tuple[str, ...] = (),
    ) -> bool:
        """One frame of each camera, or of those named, for the step, published with these flags; the first exposed at
        `due_ns` when that is still ahead. False when a camera was lost: see `_regain`; the flap may have been shut
        meanwhile."""
        self._interlock.check()
        try:
            self._publish(await self._grab(exposure_s, due_ns, cameras), step_id, flags)
        except Unreachable as error:
            await self._regain(error, exposure_s, cameras)
            return False
        return True

    async def look(self, exposure_s: float, step_id: str) -> Frame | None:
        """The leading camera's frame of the step through the flap, which is open for it only; each camera's is
        published. None when a camera was lost: see `_regain`."""
        await self.open_flap()
        try:
            return self._publish(await self._grab(exposure_s), step_id)[f"{LEADING}.image"]
        except Unreachable as error:
            lost = error
        finally:
            await self.close_flap()
        await self._regain(lost, exposure_s)
        return None

    async def _grab(self, exposure_s: float, due_ns: int = 0, names: Collection[str] = ()) -> tuple[Frame, ...]:
        """Grab frames; in virtual time a grab takes none: what exposes is not exposed again meanwhile."""
        if self._clock.now_ns() < self._exposed_ns:
            await self._clock.sleep_until(self._exposed_ns)
        cameras = [camera for name, camera in self._cameras.items() if not names or name in names]
        frames = await grab_together(cameras, self._clock, exposure_s, due_ns)
        self._exposed_ns = max((frame.time_ns + to_ns(frame.exposure_s / 2) for frame in frames), default=0)
        return frames

    def _publish(self, frames: Iterable[Frame], step_id: str, flags: tuple[str, ...] = ()) -> dict[str, Frame]:
        """Publish the values by channel."""
        self._without_camera_ns = 0
        published: dict[str, Frame] = {}
        for frame in frames:
            name, _, _ = frame.channel.partition(".")
            is_suspect = self.judge_temperature(f"{name}.temperature", frame.camera_degC, frame.time_ns)
            of_it = (*flags, TEMPERATURE_SUSPECT) if is_suspect else flags
            published[frame.channel] = replace(frame, step_id=step_id, flags=(*frame.flags, *of_it))
            self._hub.publish(published[frame.channel])
        return published

    async def _regain(self, lost: Unreachable, exposure_s: float, cameras: Collection[str] = ()) -> None:
        """Hold the gate until the camera, lost for that reason, is open again, or is found to be without supply; the
        second time in a row until it gives a frame, too. `lost` when there was no frame for 30 min of such waiting."""
        begin_ns, limit_ns = self._clock.now_ns(), to_ns(LOST_LIMIT_S)
        if self._without_camera_ns >= limit_ns:
            raise lost
        self._hub.publish(CAMERA_LOST.at(begin_ns, str(lost)))
        self._gate.hold(reasons.CAMERA_LOST)
        deadline_ns = begin_ns + limit_ns - self._without_camera_ns
        supply, proof = self.supply, None
        if self._without_camera_ns:
            # It opened and gave no frame. The gate stays held until it gives one, which is not kept: else a hold would
            # begin with each try, and the flap would never be shut in it.
            proof = partial(self._grab, exposure_s, 0, cameras)
        try:
            is_back = await supply.recovery.open_with_retries(
                self._interlock.check, deadline_ns, is_vain=lambda: not supply.is_on, proof=proof
            )
        finally:
            self._gate.clear(reasons.CAMERA_LOST)
            self._without_camera_ns += max(self._clock.now_ns() - begin_ns, to_ns(RETRY_S))
        if is_back:
            self._hub.publish(CAMERA_BACK.at(self._clock.now_ns(), "the camera answers again"))


async def grab_together(
    cameras: Collection[Camera], clock: Clock, exposure_s: float, due_ns: int = 0
) -> tuple[Frame, ...]:
    """One frame of each, exposed at the same instant, `due_ns` when that is still ahead. Unreachable when one was lost:
    then there is a frame of none.

    In real time they expose and send together; in virtual time, which stands still meanwhile, they are asked one after
    the other.
    """
    if not clock.lead_ns or len(cameras) == 1:
        return tuple([await camera.grab(exposure_s, due_ns) for camera in cameras])
    grabs = (camera.grab(exposure_s, max(due_ns, clock.now_ns())) for camera in cameras)
    # Together, 1 ms apart: one after the other 0.23 s each would not fit into the usual interval of 0.5 s.
    results = await asyncio.gather(*grabs, return_exceptions=True)  # each ends: none may be in the wire's lane
    together: list[Frame] = []
    for result in results:
        if isinstance(result, BaseException):
            raise result
        together.append(result)
    return tuple(together)
