"""JSON Schemas of documents, for editors: made from the models, so that they always agree; and the command that gives
them."""

import json
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any

import typer
from pydantic import BaseModel

from thermostand.foundation.command_app import App
from thermostand.foundation.errors import ConfigError
from thermostand.foundation.files import write_atomically
from thermostand.foundation.output import show

Documents = Mapping[str, type[BaseModel]]


def make_schema(model: type[BaseModel]) -> dict[str, Any]:
    """Make the schema of documents of this model."""
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **model.model_json_schema()}


def add_schema_command(app: App, program: str, documents: Documents) -> None:
    """Add the command `schema` to `app`. program: the words before it; documents: the model of each kind."""
    text = (
        "Print the JSON Schema of a kind of document, or write those of all. An editor explains and checks a file by "
        "the schema that its first line names: `# yaml-language-server: $schema=schema/KIND.json`.\n\n"
        f"Example: {program} schema --out schema"
    )

    @app.command("schema", help=text)
    def _(
        kind: Annotated[str, typer.Argument(help=f"{', '.join(documents)}; all of them without it.")] = "",
        out: Annotated[Path | None, typer.Option("--out", "-o", help="A folder that gets a KIND.json of each.")] = None,
    ) -> None:
        if kind and kind not in documents:
            raise ConfigError(f"{kind}: no such kind of document; there are {', '.join(documents)}")
        schemas = {name: make_schema(documents[name]) for name in ([kind] if kind else documents)}
        if out is None:
            asked = schemas[kind] if kind else schemas
            show(asked, [json.dumps(asked, indent=1)])
            return
        with suppress(OSError):  # what cannot be made cannot be written into either, which is reported
            out.mkdir(parents=True, exist_ok=True)
        written = [out / f"{name}.json" for name in schemas]
        for path, schema in zip(written, schemas.values(), strict=True):
            write_atomically(path, json.dumps(schema, indent=1) + "\n")
        show(written, written)
