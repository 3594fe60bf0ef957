"""What the experiments' parameters have in common: the chamber's range, waits that end, and how frames are taken."""

from __future__ import annotations

from typing import Annotated, Self

from pydantic import BaseModel, ConfigDict, Field, model_validator

Chamber_degC = Annotated[float, Field(ge=-10, le=70)]  # the paper's chamber, section 2
Wait_s = Annotated[float, Field(ge=0, le=7 * 86400)]  # longer is a slip of the keyboard
FrameCount = Annotated[int, Field(ge=1, le=1_000_000)]
Linear_mm = Annotated[float, Field(ge=-300, le=300)]  # the linear table's travel is 300 mm
Rotary_deg = Annotated[float, Field(ge=-360, le=360)]


class CaptureParameters(BaseModel):
    """How every experiment takes its frames."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    interval_s: float = Field(default=0.5, gt=0, le=86400)
    exposure_s: float = Field(default=0.1, gt=0, le=10)

    @model_validator(mode="after")
    def _exposed_in_time(self) -> Self:
        if self.exposure_s > self.interval_s:
            raise ValueError(f"exposure_s {self.exposure_s} does not fit into interval_s {self.interval_s}")
        return self


class StillTable(CaptureParameters):
    """An experiment with the target in one place: axis -> mm or deg."""

    table_position: dict[str, float] = Field(default_factory=dict)


class TablePosition(BaseModel):
    """Where the table holds the target."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    linear_mm: Linear_mm
    rotary_deg: Rotary_deg


class MovingTable(CaptureParameters):
    """An experiment that moves the target; `settle_s` after each move the table has stopped ringing."""

    settle_s: Wait_s = 5.0
    frames_per_position: FrameCount = 5
