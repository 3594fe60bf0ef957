"""What a run asks of its stand, of which the stand in memory has a copy: the type checker holds both against it."""

from typing import Protocol

from tests.stand.small_stand import SmallStand
from thermostand.foundation.readings import Frame
from thermostand.stand.assembly.stand import Stand
from thermostand.stand.imaging.equilibrium import CameraEquilibrium
from thermostand.stand.safety.gate import Gate
from thermostand.stand.safety.making_safe import Safety


class RunChamber(Protocol):
    """Heat and cold."""

    async def start(self, setpoint_degC: float, /) -> None: ...

    async def set_temperature(self, setpoint_degC: float, /) -> None: ...

    async def stop(self) -> None: ...


class RunSupply(Protocol):
    """The camera's supply."""

    @property
    def equilibrium(self) -> CameraEquilibrium: ...

    async def cool_down(self, band_K: float, time_constant_s: float, max_s: float) -> None: ...

    async def restore(self) -> None: ...


class RunImaging(Protocol):
    """Flap and camera."""

    @property
    def supply(self) -> RunSupply: ...

    @property
    def flap_open(self) -> bool: ...

    async def open_flap(self) -> None: ...

    async def close_flap(self) -> None: ...

    async def take_frame(
        self, exposure_s: float, step_id: str, due_ns: int, cameras: tuple[str, ...], flags: tuple[str, ...]
    ) -> bool: ...

    async def look(self, exposure_s: float, step_id: str) -> Frame | None: ...


class RunTable(Protocol):
    """The stages."""

    async def approach_again(self) -> None: ...

    async def check_home(self, axis: str) -> None: ...


class RunStand(Protocol):
    """The whole."""

    @property
    def gate(self) -> Gate: ...

    @property
    def safety(self) -> Safety: ...

    @property
    def chamber(self) -> RunChamber: ...

    @property
    def imaging(self) -> RunImaging: ...

    @property
    def table(self) -> RunTable: ...

    async def prompt(self, text: str) -> None: ...


def alike(stand: Stand, small: SmallStand) -> tuple[RunStand, RunStand]:
    return stand, small
