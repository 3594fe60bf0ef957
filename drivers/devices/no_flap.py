"""A stand without a flap: its cameras see the target all the time, and opening and closing are done at once."""

from __future__ import annotations

from foundation.readings import Reading


class NoFlap:
    """The calls of a flap, over nothing: what was commanded last is remembered, nothing is read."""

    identity = None

    def __init__(self, name: str) -> None:
        self.name = name
        self.is_shut = True

    async def open(self) -> None:
        """Nothing to connect to."""

    async def close(self) -> None:
        """Nothing to let go of."""

    async def read(self) -> tuple[Reading, ...]:
        """Nothing is read."""
        return ()

    async def move_open(self) -> None:
        """Nothing moves."""
        self.is_shut = False

    async def move_closed(self) -> None:
        """Nothing moves."""
        self.is_shut = True

    async def make_safe(self) -> None:
        """As closed."""
        self.is_shut = True

    def allow(self) -> None:
        """Nothing was barred."""
