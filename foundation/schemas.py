"""JSON Schemas of documents, for editors: generated from the models, so that they always agree."""

from __future__ import annotations

import json
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

from pydantic import BaseModel

from thermostand.foundation.files import write_whole


def schema_text(model: type[BaseModel]) -> str:
    """The schema of documents of this model."""
    schema = model.model_json_schema()
    return json.dumps({"$schema": "https://json-schema.org/draft/2020-12/schema", **schema}, indent=1) + "\n"


def write_schemas(directory: Path, documents: Mapping[str, type[BaseModel]]) -> tuple[Path, ...]:
    """Write NAME.json for each kind of document; SessionError when the place refuses."""
    with suppress(OSError):  # what cannot be made cannot be written into either, which is reported
        directory.mkdir(parents=True, exist_ok=True)
    written: list[Path] = []
    for name, model in documents.items():
        write_whole(directory / f"{name}.json", schema_text(model))
        written.append(directory / f"{name}.json")
    return tuple(written)
