"""What of a stand's file describes the simulated laboratory behind its addresses."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import AfterValidator, AwareDatetime, Field, model_validator

from thermostand.drivers.camera_preset import Effect
from thermostand.drivers.settings import DeviceName
from thermostand.foundation.addresses import TcpAddress
from thermostand.foundation.documents import Document


def _check_printable(path: Path) -> Path:
    if not str(path).isprintable():
        raise ValueError("expected a path of printable characters")
    return path


def _check_century(start: datetime) -> datetime:
    if not 2000 <= start.year < 2100:
        raise ValueError("expected a time of the years 2000 to 2099")
    return start


BUILT_IN = ("modified", "unmodified")
OPTICS = [*BUILT_IN, "nac", "navcam", "dic", "phone"]
PrintablePath = Annotated[Path, AfterValidator(_check_printable)]
FaultText = Annotated[str, Field(pattern=r"^[A-Za-z_]+\.[A-Za-z_]+(=.+)?(@[\d.]+(s|min|h)?)?(:[\d.]+(s|min|h)?)?$")]


class SimulatedCamera(Document):
    """One camera of a simulated laboratory; optics: modified, unmodified (as bought), or a file of configs/optics (nac,
    navcam, dic, phone), by its name or path. Of such a one, effects: what it has beyond smooth and quick; drawn: its
    number, another camera for each, else the middle of each range. genicam: a camera's own GenICam file, whose
    features it then shows (`arv-tool-0.8 -a ADDRESS genicam > FILE` writes that of a real one)."""

    optics: Annotated[str, Field(min_length=1, max_length=200, examples=OPTICS)] | None = None
    effects: tuple[Effect, ...] = ()
    drawn: int | None = Field(default=None, ge=0)
    genicam: PrintablePath | None = None

    @model_validator(mode="after")
    def _check_effects(self) -> Self:
        if not self.is_preset and (self.effects or self.drawn is not None):
            raise ValueError(
                f"effects and drawn need optics of a file of configs/optics, such as nac; these are {self.optics}"
            )
        return self

    @property
    def is_preset(self) -> bool:
        """Whether its optics are those of a file."""
        return self.optics not in (None, *BUILT_IN)


class SimulationConfig(Document):
    """The simulated laboratory behind these addresses; a real laboratory has no such section. camera: the optics of all
    cameras; cameras: what one of the stand's cameras, by its name, has of its own. chamber_seed: another
    chamber than the standard one, its conductances, lags and powers drawn within +-30 %. faults: what breaks, each
    NAME[=VALUE][@TIME][:DURATION], times in s unless they end in s, min or h (`stand simulate --faults` lists the
    names)."""

    control: TcpAddress
    start: Annotated[AwareDatetime, AfterValidator(_check_century)] = datetime(2026, 1, 1, 18, tzinfo=UTC)
    seed: int = Field(default=1, ge=0)
    camera: Literal["modified", "unmodified"] = "modified"
    cameras: dict[DeviceName, SimulatedCamera] = Field(default_factory=dict)
    laboratory_degC: float = Field(default=24.0, ge=-10, le=40)
    chamber_seed: int | None = Field(default=None, ge=0)
    faults: tuple[FaultText, ...] = Field(default=(), max_length=1000)
