"""JSON Schemas of what a user edits, for editors: generated from the models, so that they always agree."""

from __future__ import annotations

import json
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

from pydantic import BaseModel

from drivers.wires.registers import RegisterMap
from foundation.files import write_whole
from markers.target import Target
from stand.config.recipe import Recipe
from stand.config.stand_config import StandConfig

DOCUMENTS: Mapping[str, type[BaseModel]] = {
    "stand": StandConfig,
    "recipe": Recipe,
    "registers": RegisterMap,
    "target": Target,
}


def schema_text(name: str) -> str:
    """The schema of this kind of document."""
    schema = DOCUMENTS[name].model_json_schema()
    return json.dumps({"$schema": "https://json-schema.org/draft/2020-12/schema", **schema}, indent=1) + "\n"


def write_schemas(directory: Path) -> tuple[Path, ...]:
    """Write the schema of each kind of document; SessionError when the place refuses."""
    with suppress(OSError):  # what cannot be made cannot be written into either, which is reported
        directory.mkdir(parents=True, exist_ok=True)
    written: list[Path] = []
    for name in DOCUMENTS:
        write_whole(directory / f"{name}.json", schema_text(name))
        written.append(directory / f"{name}.json")
    return tuple(written)
