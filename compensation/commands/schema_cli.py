"""`compensate schema`: JSON Schemas for editors."""

from __future__ import annotations

import importlib.resources
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated

import typer
from pydantic import BaseModel

from thermostand.compensation.budget.geometry import Geometry
from thermostand.compensation.datasheet.measurement_details import MeasurementDetails
from thermostand.foundation.command_app import App
from thermostand.foundation.documents import write_schemas
from thermostand.foundation.output import show

DOCUMENTS: Mapping[str, type[BaseModel]] = {"geometry": Geometry, "details": MeasurementDetails}

app = App()


@app.command("schema")
def schema(
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="A folder; else the installed configs/schema.")
    ] = None,
) -> None:
    """Write the JSON Schemas of geometries and of details of a measurement. A file's first line names its schema to
    an editor: `# yaml-language-server: $schema=schema/geometry.json`.

    Example: compensate schema --out schema
    """
    installed = Path(str(importlib.resources.files("thermostand.configs"))) / "schema"
    written = list(write_schemas(out or installed, DOCUMENTS))
    show(written, written)
