"""`compensate schema`: JSON Schemas for editors."""

from __future__ import annotations

from thermostand.compensation.budget.geometry import Geometry
from thermostand.compensation.certificate.order import Order
from thermostand.compensation.datasheet.measurement_details import MeasurementDetails
from thermostand.compensation.measurement_mapping import MeasurementMapping
from thermostand.foundation.command_app import App
from thermostand.foundation.schemas import Documents, add_schema_command

DOCUMENTS: Documents = {
    "geometry": Geometry,
    "details": MeasurementDetails,
    "mapping": MeasurementMapping,
    "order": Order,
}

app = App()
add_schema_command(app, "compensate", DOCUMENTS)
