"""The configuration's dew and ending sections: what keeps water off camera and target, and how a run ends."""

from __future__ import annotations

import math
from typing import Self

from pydantic import Field, model_validator

from thermostand.drivers.settings import DeviceName
from thermostand.foundation.documents import Document

# Magnus' formula over water, with the constants of Sonntag, Z. Meteorol. 70 (1990) 340, -45..60 degC.
_A, _B_degC = 17.62, 243.12


def compute_dew_point_degC(air_degC: float, humidity_percent: float) -> float:
    """The dew point of air at that temperature and relative humidity (above 0); NaN when either is."""
    if math.isnan(air_degC) or math.isnan(humidity_percent):
        return math.nan
    exponent = math.log(humidity_percent / 100) + _A * air_degC / (_B_degC + air_degC)
    return _B_degC * exponent / (_A - exponent)


class DewConfig(Document):
    """The laboratory's air at its wettest. dew_point_degC: of it; or humidity_percent, with the laboratory's
    thermometer. With the flap open no camera and no target may be less than margin_K above it for flap_s: the run is
    held and the flap closes. A plan that captures below a given dew_point_degC is refused. hygrometer: the one of
    probes that measures that air; what is given counts while it reports nothing.
    """

    dew_point_degC: float | None = Field(default=None, ge=-40, le=40)
    humidity_percent: float | None = Field(default=None, ge=1, le=100)
    hygrometer: DeviceName | None = None
    margin_K: float = Field(default=1.0, ge=0, le=10)
    flap_s: float = Field(default=10.0, ge=0, le=300)

    @model_validator(mode="after")
    def _check_one_source(self) -> Self:
        if (self.dew_point_degC is None) == (self.humidity_percent is None):
            raise ValueError("give dew_point_degC or humidity_percent, one of them")
        return self

    def lowest_degC(self, laboratory_degC: float, measured_degC: float = math.nan) -> float:
        """Return what nothing may be below that meets the laboratory's air at that temperature and, where it is
        measured, with that dew point; NaN while neither is known."""
        if not math.isnan(measured_degC):
            return measured_degC + self.margin_K
        if self.dew_point_degC is not None:
            return self.dew_point_degC + self.margin_K
        return compute_dew_point_degC(laboratory_degC, self.humidity_percent or math.nan) + self.margin_K


class EndingConfig(Document):
    """The end of a run whose plan is done. to_ambient: the chamber is brought back to the laboratory's temperature
    first, to ambient_degC on a stand that does not measure it: until the air is within band_K of it, and camera and
    target are above the dew point, or no more than band_K below the laboratory; for max_s at the most."""

    to_ambient: bool = True
    ambient_degC: float = Field(default=23.0, ge=10, le=35)
    band_K: float = Field(default=3.0, gt=0, le=10)
    max_s: float = Field(default=10_800.0, ge=0, le=86_400)
