"""One thing that can be broken in a simulated laboratory, and the usual ways to break it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from operator import attrgetter

from thermostand.drivers.sim.laboratory import Laboratory

Setter = Callable[[Laboratory, object], None]


@dataclass(frozen=True, slots=True)
class Fault:
    """How something is broken: by a value, `worst` when none is given; the one that mends it; what it means. `locks`:
    set under the plant's lock; a wire that is unplugged waits for its thread, which may want that lock."""

    apply: Setter
    worst: object
    mended: object
    text: str
    locks: bool = True


def number(value: object) -> float:
    """A value as given, 0 for none."""
    return float(str(value or 0))


def number_or_none(value: object) -> float | None:
    """A value as given."""
    return None if value is None else float(str(value))


def to(path: str, kind: Callable[[object], object] = bool) -> Setter:
    """Sets one attribute of one fake, by its path from the laboratory."""
    owner, _, attribute = path.rpartition(".")

    def apply(laboratory: Laboratory, value: object) -> None:
        setattr(attrgetter(owner)(laboratory) if owner else laboratory, attribute, kind(value))

    return apply


def given(path: str) -> Setter:
    """Gives a number to a method of one fake, unless the value is none."""
    return lambda laboratory, value: None if value is None else attrgetter(path)(laboratory)(float(str(value)))


def flag(path: str, text: str) -> Fault:
    """One attribute of one fake is true."""
    return Fault(to(path), True, False, text)


def shown(path: str, word: str, text: str) -> Fault:
    """One attribute of one fake is this word, None once it is mended."""
    return Fault(to(path, lambda value: word if value else None), True, False, text)


@dataclass(frozen=True, slots=True)
class Once:
    """Something that happens when the fault is set, and is not undone."""

    act: Callable[[Laboratory], None]

    def __call__(self, laboratory: Laboratory, value: object) -> None:
        """It happens, unless the value is none."""
        if value:
            self.act(laboratory)


def once(path: str, text: str) -> Fault:
    """A method of one fake is called."""
    return Fault(Once(lambda laboratory: attrgetter(path)(laboratory)()), True, False, text)
