"""Ids of steps, as an immutable set to which one is added quickly: a plan may have 100,000 steps."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Set
from itertools import chain


class Ids(Set[str]):
    """Disjoint parts, each larger than the one behind it, as the digits of a binary counter: adding copies an id about
    log2(n) times over a whole run, where a frozenset would copy all of them each time."""

    __slots__ = ("_parts",)

    def __init__(self, ids: Iterable[str] = ()) -> None:
        first = frozenset(ids)
        self._parts: tuple[frozenset[str], ...] = (first,) if first else ()

    def __contains__(self, step_id: object) -> bool:
        return any(step_id in part for part in self._parts)

    def __iter__(self) -> Iterator[str]:
        return chain.from_iterable(self._parts)

    def __len__(self) -> int:
        return sum(map(len, self._parts))

    def __repr__(self) -> str:
        return f"Ids({sorted(self)})"

    def plus(self, step_id: str) -> Ids:
        """With this one."""
        if step_id in self:
            return self
        parts, last = list(self._parts), frozenset((step_id,))
        while parts and len(parts[-1]) <= len(last):
            last |= parts.pop()
        more = Ids()
        more._parts = (*parts, last)
        return more

    def minus(self, gone: Set[str]) -> Ids:
        """Without those."""
        return Ids(step_id for step_id in self if step_id not in gone)
