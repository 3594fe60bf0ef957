"""Models of stages: what their controllers are delivered with. Others than these two are written in a stand's file."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from thermostand.drivers.settings import Line
from thermostand.foundation.documents import Document


class StageProfile(Document):
    """A stage of an XIMC controller: mm or deg for a full step, the way that every move ends upwards at least, how far
    it travels; its settings as delivered, in full steps/s and full steps/s2. power_off_s: so long after a stop its
    motor is switched off, none: never. source: where this is written, such as a manual and its page.

    home_from: from where the homing procedure, which seeks its switch downwards, has a short way to it; none: from
    anywhere. The rotary table's switch is 12.5 deg above its zero (HomeDelta -1250): from below it would go all the way
    round, and its cables with it.
    """

    unit: Literal["mm", "deg"]
    unit_per_step: float = Field(gt=0, le=10)
    overshoot: float = Field(gt=0, le=100)
    travel: float = Field(gt=0, le=10_000)
    speed: float = Field(gt=0, le=100_000)
    acceleration: float = Field(ge=1, le=65_535)
    deceleration: float = Field(ge=1, le=65_535)
    homing_speed: float = Field(gt=0, le=100_000)
    power_off_s: float | None = Field(default=None, ge=0, le=65_535)
    home_from: float | None = None
    source: Line = Field(min_length=1)


ProfileName = Literal["8MT160-300", "8MR151"]
_STANDA = "libximc, python-profiles/STANDA"
PROFILES: dict[ProfileName, StageProfile] = {
    "8MT160-300": StageProfile(
        unit="mm",
        unit_per_step=0.0025,
        overshoot=0.5,
        travel=300.0,
        speed=1000.0,
        acceleration=2000.0,
        deceleration=4000.0,
        homing_speed=500.0,
        power_off_s=60.0,
        source=_STANDA,
    ),
    "8MR151": StageProfile(
        unit="deg",
        unit_per_step=0.01,
        overshoot=1.0,
        travel=360.0,
        speed=2000.0,
        acceleration=2000.0,
        deceleration=5000.0,
        homing_speed=100.0,
        home_from=16.0,  # it goes round, its cables do not
        source=_STANDA,
    ),
}
