"""`compensate schema`: JSON Schemas for editors."""

from __future__ import annotations

from thermostand.compensation.budget.geometry import Geometry
from thermostand.compensation.datasheet.measurement_details import MeasurementDetails
from thermostand.foundation.command_app import App
from thermostand.foundation.schemas import Documents, add_schema_command

DOCUMENTS: Documents = {"geometry": Geometry, "details": MeasurementDetails}

app = App()
add_schema_command(app, "compensate", DOCUMENTS)
