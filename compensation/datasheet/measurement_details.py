"""What no recording knows of a measurement, and its reader asks for: lens, certificates, places of sensors.

    lens: 25 mm f/1.4, serial 1234
    aperture: f/8
    working_distance_mm: 826
    target_certificate: CMM report 2026-014, k=2, 2 um
    thermometer_certificate: DAkkS D-K-15000, 2026-03
    sensor_positions:
      air: 40 mm next to the camera, shielded
    u_air_K: 0.05

All of it is optional; what is missing is printed as not stated.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from pydantic import Field

from thermostand.foundation.documents import Document, load_document


class MeasurementDetails(Document):
    """u_air_K: standard uncertainty of the air's temperature near the camera, thermometer and place together, K; 0.1 is
    assumed when nobody knows. u_target_ppm_per_K: standard uncertainty of how much the target's scale follows the
    chamber's air, ppm/K; 0.1 is a steel target that sees 1 % of it."""

    lens: str = ""
    aperture: str = ""
    working_distance_mm: Annotated[float, Field(gt=0)] | None = None
    mount: str = ""
    target_certificate: str = ""
    thermometer_certificate: str = ""
    sensor_positions: dict[str, str] = Field(default_factory=dict)
    laboratory: str = ""
    note: str = ""
    u_air_K: Annotated[float, Field(gt=0)] = 0.1
    u_target_ppm_per_K: Annotated[float, Field(ge=0)] = 0.1

    @property
    def states_u_air(self) -> bool:
        """Whether the air's uncertainty was stated rather than assumed."""
        return "u_air_K" in self.model_fields_set


def load_details(path: Path | None) -> MeasurementDetails:
    """Load the details of a file, or none when no file is given; ConfigError names what is wrong in it."""
    return MeasurementDetails() if path is None else load_document(path, MeasurementDetails)
