"""Opening the camera again after it was lost: for a step that wants a frame, and in the background meanwhile."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable

from thermostand.foundation.clock import Clock, to_ns
from thermostand.foundation.errors import DeviceError, Unreachable
from thermostand.foundation.events import CAMERA_BACK
from thermostand.foundation.hub import Hub
from thermostand.foundation.items import Batch, Item
from thermostand.stand.imaging.cameras import Cameras

# Round number; nothing was measured.
LOST_LIMIT_S = 1800.0
RETRY_S, LONGEST_RETRY_S = 1.0, 10.0  # doubled between tries; not measured


class CameraRecovery:
    """Opens the camera; one after the other. `is_wanted`: its supply is on, and it was open before. `restarted` is
    called with the reason when it has, or may have, restarted by itself since its last answer."""

    def __init__(
        self, cameras: Cameras, hub: Hub, clock: Clock, is_wanted: Callable[[], bool], restarted: Callable[[str], None]
    ) -> None:
        self._cameras = cameras
        self._hub = hub
        self._clock = clock
        self._is_wanted = is_wanted
        self._restarted = restarted
        self._turn = asyncio.Lock()
        self._missed = asyncio.Event()
        self._given_up = False  # until it is open again
        hub.subscribe(self._receive)

    async def open_with_retries(
        self,
        check: Callable[[], None],
        deadline_ns: int,
        longest_retry_s: float = LONGEST_RETRY_S,
        is_vain: Callable[[], bool] = lambda: False,
        proof: Callable[[], Awaitable[object]] | None = None,
    ) -> bool:
        """Try again after 1 s, 2 s, 4 s ... until `deadline_ns`; raises what the last try raised, and what `check`
        raises before each. False when it is in vain. proof: what has to succeed as well, such as a frame."""
        retry_s = RETRY_S
        while not is_vain():
            check()
            try:
                async with self._turn:
                    await self._open()
                if proof is not None:
                    await proof()
            except Unreachable:
                if self._clock.now_ns() >= deadline_ns:
                    raise
            else:
                return True
            await self._clock.sleep_until(self._clock.now_ns() + to_ns(retry_s))
            retry_s = min(2 * retry_s, longest_retry_s)
        return False

    async def keep_open(self) -> None:
        """Whenever a poll finds the camera lost, until cancelled. What is not back
        within 30 min is left to the next step that wants a frame."""
        while True:
            await self._missed.wait()
            if self._is_lost():
                await self._reopen()
            self._missed.clear()

    async def _reopen(self) -> None:
        begin_ns, retry_s = self._clock.now_ns(), RETRY_S
        while self._is_lost() and self._clock.now_ns() - begin_ns < to_ns(LOST_LIMIT_S):
            try:
                async with self._turn:
                    if not self._is_lost():
                        return
                    await self._open()
            except DeviceError:  # its poller publishes that
                await self._clock.sleep_until(self._clock.now_ns() + to_ns(retry_s))
                retry_s = min(2 * retry_s, LONGEST_RETRY_S)
            else:
                text = "the camera was lost and answers again; its settings are written and read back"
                self._hub.publish(CAMERA_BACK.at(self._clock.now_ns(), text))
        self._given_up = self._is_lost()

    async def _open(self) -> None:
        await self._cameras.open()
        if self._is_wanted() and (reason := self._cameras.restarted):
            self._restarted(reason)

    def _is_lost(self) -> bool:
        return self._is_wanted() and not self._cameras.is_usable

    def _receive(self, item: Item) -> None:
        """The hub's subscriber."""
        if isinstance(item, Batch) and item.device in self._cameras.names:
            is_lost = self._is_lost()
            self._given_up = self._given_up and is_lost
            if is_lost and not self._given_up:
                self._missed.set()
