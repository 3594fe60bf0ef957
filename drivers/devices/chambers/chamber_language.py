"""What the stand asks of a chamber of any make: one file `chamber_<language>.py` answers it for one of them."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

from pydantic import Field

from thermostand.drivers.settings import Line, Polled, Range
from thermostand.drivers.wires.line_client import LineClient
from thermostand.drivers.wires.link import SerialSettings
from thermostand.foundation.addresses import ByteAddress


class ChamberUnitSettings(Polled):
    """What the chambers have in common. address: `serial:PATH` or `tcp:HOST:PORT`. identity: text that must be in what
    the unit says of itself; "" accepts any. limits_at_panel_degC: the set-point limits that somebody has set at the
    panel, for a make that does not tell them. timeout_s, gap_s: real seconds for a reply, and between two requests."""

    address: ByteAddress
    identity: Line = ""
    limits_at_panel_degC: Range | None = None
    timeout_s: float = Field(default=1.0, gt=0, le=10)
    gap_s: float = Field(default=0.1, ge=0, le=5)


@dataclass(frozen=True, slots=True)
class ChamberState:
    """One look: temperatures in degC, whether it controls, its alarms in words; `humidity_on`: None when that is
    unknown; door_open: False where it does not say. ramp_degC: the set-point on its way, None when it does not move.
    objections: a sentence for each thing that acts in the place of its set-point."""

    actual_degC: float
    set_degC: float
    running: bool
    alarms: tuple[str, ...] = ()
    humidity_on: bool | None = None
    ramp_degC: float | None = None
    door_open: bool = False
    objections: tuple[str, ...] = ()


PROGRAM = "a program of its own runs; end it at the panel"


class ChamberLanguage(ABC):
    """One conversation, blocking. All calls raise Unreachable, GarbledReply, Refused or DeviceFault. A make whose unit
    does not have something leaves that as it is here.

    client: of its requests. resolution_K: of a set-point. dead_man: what ends the heat when this computer dies, in
    words. in_force_by, not_reported: by which queries `state` knows that its set-point is the one that acts, and
    what they leave open.
    """

    resolution_K = 0.1
    dead_man = "nothing: it goes on at its set-point, within the limits of its own controller"
    in_force_by = ""
    not_reported = ""

    def __init__(self, name: str, settings: ChamberUnitSettings, line: SerialSettings, *, is_text: bool = True) -> None:
        self._name = name
        times_s = settings.timeout_s, settings.gap_s
        self.client = LineClient.at(name, settings.address, line, times_s, is_text=is_text)

    def identity(self) -> str:
        """Return what it says of itself; "" when it says nothing."""
        return ""

    def limits_degC(self) -> tuple[float, float] | None:
        """The lowest and highest set-point of its own controller; None when it does not tell them."""
        return None

    @abstractmethod
    def state(self) -> ChamberState:
        """Return how it is now."""

    @abstractmethod
    def set_temperature(self, degC: float) -> None:
        """Send a set-point, once."""

    @abstractmethod
    def humidity_off(self) -> None:
        """Switch humidity and condensation off; Refused, with what to do at the panel, when it has no command for
        that."""

    @abstractmethod
    def run(self, on: bool) -> None:
        """Start or stop, once."""

    def renew(self) -> None:  # noqa: B027 - most have no dead-man
        """Keep the chamber's own dead-man, if it has one, from stopping it."""


def parse_line(heard: bytes) -> str | None:
    """The line that has come, ASCII; None until it has ended; ValueError when it is not one."""
    if not heard.endswith(b"\n"):
        return None
    line = heard.decode("ascii").strip("\r\n")
    if not line or "\n" in line:
        raise ValueError("more or less than one line")
    return line
