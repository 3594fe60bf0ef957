"""The fakes of a simulated laboratory: which there are, and how each is built from what the stand's file has.

Each fake's module states how it is built, under the section of the stand's file that it answers for, and the protocol
where that section has several: `@fake("climate_chamber.espec")`. Another package adds one by an entry point of the
group `thermostand.fakes`, named as its kind of device, which is such a function. Fakes hold no physics: what they tell
comes from the plant.
"""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from importlib.metadata import entry_points
from typing import TYPE_CHECKING, Any

import thermostand.drivers.sim
from thermostand.foundation.plugins import load_point

if TYPE_CHECKING:
    from thermostand.drivers.sim.laboratory import Laboratory as Bench
else:
    Bench = object  # the laboratory that is being built, which knows its fakes

GROUP = "thermostand.fakes"


Build = Callable[[Bench, str, Mapping[str, Any]], object]


@dataclass(frozen=True, slots=True)
class Fake:
    """rank: the order in which fakes are built, and so in which those that act on the plant do."""

    build: Build
    rank: int


FAKES: dict[str, Fake] = {}


def fake(*keys: str, rank: int) -> Callable[[Build], Build]:
    """The decorated function builds the fakes of these: the bench, the name of the device, and its settings."""

    def registered(build: Build) -> Build:
        FAKES.update(dict.fromkeys(keys, Fake(build, rank)))
        return build

    return registered


@cache
def _load() -> None:
    root = thermostand.drivers.sim
    for module in pkgutil.walk_packages(root.__path__, f"{root.__name__}."):
        if not module.name.endswith("__main__"):
            importlib.import_module(module.name)


def get_fake(key: str) -> Fake:
    """The fake of a section, of one of its protocols, or of another package's kind; ValueError when there is none,
    ConfigError when it cannot be loaded."""
    _load()
    if key in FAKES:
        return FAKES[key]
    for point in entry_points(group=GROUP, name=key):
        return Fake(load_point(point), ADDED)
    raise ValueError(f"there is no fake of a device of kind {key}")


# Ranks. What heats and cools comes first, in the order in which it acts on the plant; then what shares the bus.
CONTROL, SWITCHES, OUTPUT, MEASURE, CONTACTS, OWN_LINE, ADDED, STAGES, FLAP, PICTURES, CAMERAS = range(11)
