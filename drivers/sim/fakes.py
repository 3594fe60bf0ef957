"""Fakes that other packages add to the simulated laboratory, for their kinds of devices.

An entry point of the group `thermostand.fakes`, named as the kind, is what makes one: called with the plant, the clock,
the settings of the device and the laboratory's seed it gives what has `engine()`, a new conversation with it, and
answers at the device's address. Fakes hold no physics: what they tell comes from the plant.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from importlib.metadata import entry_points
from typing import Protocol, cast

from thermostand.drivers.sim.physics.plant import Plant
from thermostand.drivers.sim.wire import Engine
from thermostand.foundation.clock import Now

GROUP = "thermostand.fakes"


class FakeDevice(Protocol):
    """One device."""

    def engine(self) -> Engine:
        """A new conversation."""
        ...


Make = Callable[[Plant, Now, Mapping[str, object], int], FakeDevice]


def added_fake(kind: str) -> Make:
    """What makes the fake of that kind; ValueError when there is none, or it cannot be loaded."""
    for point in entry_points(group=GROUP, name=kind):
        try:
            return cast("Make", point.load())
        except Exception as error:  # importing a stranger's module may raise anything
            raise ValueError(f"the fake of {kind} cannot be loaded ({error})") from error
    raise ValueError(f"no package has a fake of a device of kind {kind}")
