"""The `stand config` commands: what a stand's files look like."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated

import typer
from pydantic import BaseModel

from thermostand.drivers.camera_preset import CameraPreset
from thermostand.drivers.wires.registers import RegisterMap
from thermostand.foundation.command_app import App
from thermostand.foundation.documents import write_schemas
from thermostand.foundation.output import show
from thermostand.markers.target import Target
from thermostand.stand.config.recipe import Recipe
from thermostand.stand.config.stand_config import StandConfig, find_packaged

app = App(
    no_args_is_help=True,
    help="Configuration files: JSON Schemas for editors.\n\nExample: stand config schema --out schema",
)

DOCUMENTS: Mapping[str, type[BaseModel]] = {
    "stand": StandConfig,
    "recipe": Recipe,
    "registers": RegisterMap,
    "target": Target,
    "optics": CameraPreset,
}


@app.command()
def schema(
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="A folder; else the installed configs/schema.")
    ] = None,
) -> None:
    """Write the JSON Schemas of stands, recipes, register maps, targets and simulated optics. A file's first line names
    its schema to an editor: `# yaml-language-server: $schema=schema/stand.json`.

    Example: stand config schema --out schema
    """
    written = list(write_schemas(out or find_packaged("", "simulated").parent / "schema", DOCUMENTS))
    show(written, written)
