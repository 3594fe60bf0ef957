"""All cameras of a stand as one: opened and closed together, and each exposes whenever frames are taken."""

from __future__ import annotations

import asyncio
from collections.abc import Collection, Coroutine, Iterable, Mapping

from drivers.devices.protocols import Camera
from drivers.settings import identity_event
from foundation.clock import Clock, seconds_ns
from foundation.errors import ConfigError
from foundation.items import Event
from foundation.readings import Frame

_APART_S = 0.001  # between two cameras' frames: an image and its description are found by their instant


class Cameras:
    """The cameras by name; there may be none, on which only `close` may be called."""

    def __init__(self, cameras: Mapping[str, Camera], clock: Clock) -> None:
        self.names = tuple(cameras)
        self._cameras = tuple(cameras.values())
        self._clock = clock

    @property
    def is_usable(self) -> bool:
        """Whether each is open and has not been lost since."""
        return all(camera.is_usable for camera in self._cameras)

    @property
    def restarted(self) -> str:
        """Why one has, or may have, restarted by itself; "" when none has."""
        return "; ".join(camera.restarted for camera in self._cameras if camera.restarted)

    def identities(self, now_ns: int) -> tuple[Event, ...]:
        """Which have answered, as events; Unreachable when one is not open."""
        return tuple(identity_event(each.name, each.identity, now_ns, each.settings) for each in self._cameras)

    async def open(self) -> None:
        """Open every camera, those that are open already again."""
        if not self._cameras:
            raise ConfigError("the plan needs a camera, and this stand has none; name it under cameras in its file")
        for camera in self._cameras:
            await camera.open()

    async def close(self, *meanwhile: Coroutine[None, None, None]) -> None:
        """Close every camera, all at once: a dead one takes seconds. Never raises by itself, only what is done
        `meanwhile` does."""
        await asyncio.gather(*(camera.close() for camera in self._cameras), *meanwhile)

    async def grab(self, exposure_s: float, due_ns: int = 0, names: Collection[str] = ()) -> tuple[Frame, ...]:
        """One frame of each, or of those named, the first at `due_ns` when that is still ahead, the others a little
        later each. Unreachable when one was lost: then there is a frame of none.

        In real time they expose and send together; in virtual time, which stands still meanwhile, one after the other.
        """
        cameras = [each for name, each in zip(self.names, self._cameras, strict=True) if not names or name in names]
        if not self._clock.lead_ns or len(cameras) == 1:
            return await self._one_by_one(cameras, exposure_s, due_ns)
        first_ns = max(due_ns, self._clock.now_ns())
        grabs = (
            camera.grab(exposure_s, first_ns + number * seconds_ns(_APART_S)) for number, camera in enumerate(cameras)
        )
        results = await asyncio.gather(*grabs, return_exceptions=True)  # each ends: none may be in the wire's lane
        frames: list[Frame] = []
        for result in results:
            if isinstance(result, BaseException):
                raise result
            frames.append(result)
        return tuple(frames)

    async def _one_by_one(self, cameras: Iterable[Camera], exposure_s: float, due_ns: int) -> tuple[Frame, ...]:
        frames: list[Frame] = []
        for camera in cameras:
            if frames:
                await self._clock.sleep_until(self._clock.now_ns() + seconds_ns(_APART_S))
            frames.append(await camera.grab(exposure_s, due_ns if not frames else 0))
        return tuple(frames)
