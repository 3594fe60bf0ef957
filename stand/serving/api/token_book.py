"""The tokens of a stand as they are now: read at the start, and again when that is asked for."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from contextlib import suppress

from thermostand.stand.config.interface_section import TokenFile


class TokenBook:
    """known: None where no file is named, so that nobody needs a token; with an empty file nobody has one. `renew` may
    be called by any thread."""

    def __init__(self, known: TokenFile | None = None) -> None:
        self.known = known
        self._watchers: list[tuple[asyncio.AbstractEventLoop, Callable[[], None]]] = []

    def watch(self, call: Callable[[], None]) -> None:
        """Call it, in the running loop, whenever tokens have been read again."""
        self._watchers.append((asyncio.get_running_loop(), call))

    def renew(self, known: TokenFile) -> None:
        """These from now on."""
        self.known = known
        for loop, call in self._watchers:
            with suppress(RuntimeError):  # it has ended
                loop.call_soon_threadsafe(call)
