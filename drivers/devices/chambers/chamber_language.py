"""What the stand asks of a chamber of any make: one file `chamber_<language>.py` answers it for one of them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from drivers.wires.line_client import LineClient


@dataclass(frozen=True, slots=True)
class ChamberState:
    """One look: temperatures in degC, whether it controls, its alarms in words; `humidity_on`: None when that is
    unknown; program: a program of its own runs; door_open: False where it does not say. ramp_degC: the set-point on
    its way, None when it does not move."""

    actual_degC: float
    set_degC: float
    running: bool
    alarms: tuple[str, ...] = ()
    humidity_on: bool | None = None
    program: bool = False
    ramp_degC: float | None = None
    door_open: bool = False
    by_hand: str = ""


class ChamberLanguage(Protocol):
    """One conversation, blocking. All calls raise Unreachable, GarbledReply, Refused or DeviceFault.

    client: of its requests. resolution_K: of a set-point. dead_man: what ends the heat when this computer dies, in
    words.
    """

    client: LineClient
    resolution_K: float
    dead_man: str

    def identity(self) -> str:
        """What it says of itself; "" when it says nothing."""
        ...

    def limits_degC(self) -> tuple[float, float] | None:
        """The lowest and highest set-point of its own controller; None when it does not tell them."""
        ...

    def state(self) -> ChamberState:
        """How it is now."""
        ...

    def set_temperature(self, degC: float) -> None:
        """Send a set-point, once."""
        ...

    def humidity_off(self) -> None:
        """Switch humidity and condensation off; Refused, with what to do at the panel, when it has no command for
        that."""
        ...

    def run(self, on: bool) -> None:
        """Start or stop, once."""
        ...

    def renew(self) -> None:
        """What keeps its own dead-man, if it has one, from stopping it."""
        ...
