"""What the experiments' parameters have in common: the chamber's range, waits that end, and how frames are taken."""

from __future__ import annotations

from typing import Annotated, Self

from pydantic import BaseModel, ConfigDict, Field, model_validator

Chamber_degC = Annotated[float, Field(ge=-10, le=70)]  # the paper's chamber, section 2
Wait_s = Annotated[float, Field(ge=0, le=7 * 86400)]  # longer is a slip of the keyboard
FrameCount = Annotated[int, Field(ge=1, le=1_000_000)]


class CaptureParameters(BaseModel):
    """How every experiment takes its frames, and where the table stands meanwhile."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    interval_s: float = Field(default=0.5, gt=0, le=86400)
    exposure_s: float = Field(default=0.1, gt=0, le=10)
    table_position: dict[str, float] = Field(default_factory=dict)  # axis -> mm or deg, taken before anything else

    @model_validator(mode="after")
    def _exposed_in_time(self) -> Self:
        if self.exposure_s > self.interval_s:
            raise ValueError(f"exposure_s {self.exposure_s} does not fit into interval_s {self.interval_s}")
        return self
