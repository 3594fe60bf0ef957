"""The stand's lengths, materials and air, each with its standard uncertainty, from configs/geometry/*.yaml."""

from __future__ import annotations

import importlib.resources
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

from pydantic import Field, model_validator

from thermostand.foundation.documents import Document, load_document


class UncertainValue(Document):
    """A value and its standard uncertainty `u`, in the unit that the key names."""

    value: float
    u: Annotated[float, Field(ge=0)]


class Geometry(Document):
    """Lengths along the optical axis from the lens, mm; expansion coefficients per K.

    granite_inside_mm, granite_outside_mm: of the base between camera and target, on either side of the chamber's wall.
    post_mm: height of the granite under the camera. interface_mm: from the lens to where warm meets laboratory air
    (the flap). pressure_Pa, relative_humidity: of the laboratory; the chamber's air is taken to hold as much water as
    the laboratory's, up to saturation. thermometer_K, granite_gradient_K: standard uncertainties of a thermometer, and
    of the granite's mean temperature given one thermometer on it. image_px: width and height. camera_roll_deg: turns
    the picture anticlockwise. linear_mm, rotary_deg: what the table's maker promises.
    """

    name: str
    distance_mm: UncertainValue
    granite_inside_mm: UncertainValue
    granite_outside_mm: UncertainValue
    post_mm: UncertainValue
    interface_mm: UncertainValue
    granite_per_K: UncertainValue
    target_per_K: UncertainValue
    pressure_Pa: UncertainValue
    relative_humidity: UncertainValue
    wavelength_um: Annotated[float, Field(ge=0.35, le=1.7)]
    thermometer_K: Annotated[float, Field(ge=0)]
    granite_gradient_K: Annotated[float, Field(ge=0)]
    focal_px: Annotated[float, Field(gt=0)]
    image_px: tuple[Annotated[int, Field(gt=0)], Annotated[int, Field(gt=0)]]
    linear_mm: Annotated[float, Field(ge=0)]
    rotary_deg: Annotated[float, Field(ge=0)]
    camera_roll_deg: float = 0.0
    interface_tilt_deg: Annotated[float, Field(ge=0, lt=60)] = 0.0

    @model_validator(mode="after")
    def _check_possible(self) -> Geometry:
        if not 0 <= self.interface_mm.value < self.distance_mm.value:
            raise ValueError(
                f"interface_mm is between the lens and the target, 0 to {self.distance_mm.value:g} mm, "
                f"not {self.interface_mm.value:g}"
            )
        if not 0 <= self.relative_humidity.value <= 1:
            raise ValueError(f"relative_humidity is a part of 1, not {self.relative_humidity.value:g}")
        if self.pressure_Pa.value < 1e4:
            raise ValueError(f"pressure_Pa is in pascal (101325 at sea level), not {self.pressure_Pa.value:g}")
        return self


@dataclass(frozen=True, slots=True)
class ThermometerState:
    """The five thermometers at an instant, or the mean of a while, degC."""

    granite_inside_degC: float
    granite_outside_degC: float
    artifact_degC: float
    air_degC: float
    laboratory_degC: float

    def warmer_by(self, **change_K: float) -> ThermometerState:
        """The state with some thermometers (field names) changed by so many K."""
        return replace(self, **{name: getattr(self, name) + change for name, change in change_K.items()})


def load_geometry(name: str) -> Geometry:
    """The geometry of a file, or of an installed name (`paper`); ConfigError naming file and key."""
    folder = Path(str(importlib.resources.files("thermostand.configs"))) / "geometry"
    installed = folder / f"{name.removesuffix('.yaml')}.yaml"
    return load_document(installed if installed.is_file() and not Path(name).is_file() else Path(name), Geometry)
