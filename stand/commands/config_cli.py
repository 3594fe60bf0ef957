"""The `stand config` commands: what a stand's files look like."""

from __future__ import annotations

from thermostand.drivers.camera_preset import CameraPreset
from thermostand.drivers.wires.registers import RegisterMap
from thermostand.foundation.command_app import App
from thermostand.foundation.schemas import Documents, add_schema_command
from thermostand.markers.target import Target
from thermostand.stand.config.recipe import Recipe
from thermostand.stand.config.stand_config import StandConfig

DOCUMENTS: Documents = {
    "stand": StandConfig,
    "recipe": Recipe,
    "registers": RegisterMap,
    "target": Target,
    "optics": CameraPreset,
}

app = App(
    no_args_is_help=True,
    help="Configuration files: JSON Schemas for editors.\n\nExample: stand config schema --out schema",
)
add_schema_command(app, "stand config", DOCUMENTS)
