"""What the steps already done have set up, so that it can be brought about again: of each kind only the last counts."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType

from experiments.steps import (
    CloseFlap,
    MoveTo,
    OpenFlap,
    PlannedStep,
    PowerCamera,
    SetTemperature,
    Soak,
    SoakUntilSettled,
    StartChamber,
    StopChamber,
)


@dataclass(frozen=True, slots=True)
class SetUp:
    """chamber_degC: the set-point, None when the chamber is stopped. positions: axis -> mm or deg. soaks: the soaks
    since the last set-point, worth something only as long as the chamber stays at it. Before any step the camera is on
    and the flap closed."""

    chamber_degC: float | None = None
    soaks: tuple[PlannedStep, ...] = ()
    camera_on: bool = True
    flap_open: bool = False
    positions: Mapping[str, float] = field(default_factory=lambda: MappingProxyType({}))

    def after(self, planned: PlannedStep) -> SetUp:
        """What it is when that step, too, is done."""
        match planned.step:
            case StartChamber(chamber_degC) | SetTemperature(chamber_degC):
                return replace(self, chamber_degC=chamber_degC, soaks=())
            case StopChamber():
                return replace(self, chamber_degC=None, soaks=())
            case Soak() | SoakUntilSettled():
                return replace(self, soaks=(*self.soaks, planned))
            case PowerCamera(on):
                return replace(self, camera_on=on)
            case OpenFlap():
                return replace(self, flap_open=True)
            case CloseFlap():
                return replace(self, flap_open=False)
            case MoveTo(axis, position):
                return replace(self, positions=MappingProxyType({**self.positions, axis: position}))
            case _:
                return self

    @property
    def text(self) -> str:
        """As in `chamber at 30 degC, camera on, flap open, linear at 2`."""
        parts = [f"camera {'on' if self.camera_on else 'off'}", f"flap {'open' if self.flap_open else 'closed'}"]
        parts += [f"{axis} at {position:g}" for axis, position in self.positions.items()]
        chamber = "stopped" if self.chamber_degC is None else f"at {self.chamber_degC:g} degC"
        return f"chamber {chamber}, {', '.join(parts)}"
