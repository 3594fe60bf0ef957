"""What of a stand's file describes the simulated laboratory behind its addresses."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Literal

from pydantic import AfterValidator, AwareDatetime, Field

from drivers.settings import DeviceName
from foundation.addresses import TcpAddress
from foundation.documents import Document


def _printable(path: Path) -> Path:
    if not str(path).isprintable():
        raise ValueError("expected a path of printable characters")
    return path


def _of_this_century(start: datetime) -> datetime:
    if not 2000 <= start.year < 2100:
        raise ValueError("expected a time of the years 2000 to 2099")
    return start


PrintablePath = Annotated[Path, AfterValidator(_printable)]
FaultText = Annotated[str, Field(pattern=r"^[A-Za-z_]+\.[A-Za-z_]+(=.+)?(@[\d.]+(s|min|h)?)?(:[\d.]+(s|min|h)?)?$")]


class SimulatedCamera(Document):
    """One camera of a simulated laboratory; optics: modified or as bought. genicam: a camera's own GenICam file, whose
    features it then shows (`arv-tool-0.8 -a ADDRESS genicam > FILE` writes that of a real one)."""

    optics: Literal["modified", "unmodified"] | None = None
    genicam: PrintablePath | None = None


class SimulationConfig(Document):
    """The simulated laboratory behind these addresses; a real laboratory has no such section. camera: the optics of all
    cameras; cameras: what one of the stand's cameras, by its name, has of its own. chamber_seed: another
    chamber than the standard one, its conductances, lags and powers drawn within +-30 %. faults: what breaks, each
    NAME[=VALUE][@TIME][:DURATION], times in s unless they end in s, min or h (`stand simulate --faults` lists the
    names)."""

    control: TcpAddress
    start: Annotated[AwareDatetime, AfterValidator(_of_this_century)] = datetime(2026, 1, 1, 18, tzinfo=UTC)
    seed: int = Field(default=1, ge=0)
    camera: Literal["modified", "unmodified"] = "modified"
    cameras: dict[DeviceName, SimulatedCamera] = Field(default_factory=dict)
    laboratory_degC: float = Field(default=24.0, ge=-10, le=40)
    chamber_seed: int | None = Field(default=None, ge=0)
    faults: tuple[FaultText, ...] = Field(default=(), max_length=1000)
