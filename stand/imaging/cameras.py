"""All cameras of a stand as one: opened and closed together."""

from __future__ import annotations

import asyncio
from collections.abc import Coroutine, Mapping

from thermostand.drivers.devices.protocols import Camera
from thermostand.drivers.settings import make_identity_event
from thermostand.foundation.errors import ConfigError
from thermostand.foundation.items import Event


class Cameras:
    """The cameras by name; there may be none, on which only `close` may be called."""

    def __init__(self, cameras: Mapping[str, Camera]) -> None:
        self.names = tuple(cameras)
        self._cameras = tuple(cameras.values())

    @property
    def is_usable(self) -> bool:
        """Whether each is open and has not been lost since."""
        return all(camera.is_usable for camera in self._cameras)

    @property
    def restarted(self) -> str:
        """Why one has, or may have, restarted by itself; "" when none has."""
        return "; ".join(camera.restarted for camera in self._cameras if camera.restarted)

    def identities(self, now_ns: int) -> tuple[Event, ...]:
        """Return which cameras have answered, as events; Unreachable when one is not open."""
        return tuple(make_identity_event(each.name, each.identity, now_ns, each.settings) for each in self._cameras)

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
