"""What moves at this moment, for an operator who pauses and wants to know whether a hand may be put in."""

from __future__ import annotations

from collections.abc import Generator
from contextlib import contextmanager


class Motions:
    """By what moves (an axis, the flap): where to."""

    def __init__(self) -> None:
        self._under_way: dict[str, str] = {}

    @property
    def texts(self) -> list[str]:
        """As in `["linear to 250 mm", "flap closing"]`."""
        return [f"{name} {text}" for name, text in self._under_way.items()]

    @property
    def names(self) -> tuple[str, ...]:
        """What moves: axes, the flap."""
        return tuple(self._under_way)

    def moves(self, name: str) -> bool:
        """Whether this one is under way."""
        return name in self._under_way

    @contextmanager
    def under_way(self, name: str, text: str) -> Generator[None]:
        """It moves while inside; where one motion is part of another, the inner one is shown."""
        before = self._under_way.get(name)
        self._under_way[name] = text
        try:
            yield
        finally:
            if before is None:
                self._under_way.pop(name, None)
            else:
                self._under_way[name] = before
