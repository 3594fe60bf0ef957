"""The `stand config` commands: what a stand's files look like, and files of older versions."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated

import typer
from pydantic import BaseModel

from drivers.camera_preset import CameraPreset
from drivers.wires.registers import RegisterMap
from foundation.command_app import App
from foundation.documents import read_document
from foundation.errors import ConfigError
from foundation.files import write_whole
from foundation.output import say, show
from foundation.schemas import write_schemas
from markers.target import Target
from stand.config.migration import migrated
from stand.config.recipe import Recipe
from stand.config.stand_config import StandConfig, packaged

app = App(
    no_args_is_help=True,
    help="Configuration files: JSON Schemas for editors, and files of older versions.\n\n"
    "Example: stand config migrate my-stand.yaml",
)

DOCUMENTS: Mapping[str, type[BaseModel]] = {
    "stand": StandConfig,
    "recipe": Recipe,
    "registers": RegisterMap,
    "target": Target,
    "optics": CameraPreset,
}


@app.command()
def migrate(
    file: Annotated[Path, typer.Argument(help="A stand's file of an older version.")],
    out: Annotated[Path | None, typer.Option("--out", "-o", help="Where to; else in its place.")] = None,
) -> None:
    """A stand's file in today's form, with its comments. In its place the older one is kept beside it, as FILE.before.

    Older files open as they are: this is for editing them.

    Example: stand config migrate my-stand.yaml
    """
    text = read_document(file)
    found = migrated(text, str(file))
    if found is None:
        show({"file": None}, [f"{file}: has today's form already; nothing was written"])
        return
    place = out or file.resolve()
    if out is None:
        kept = place.with_name(f"{place.name}.before")
        if kept.exists():
            raise ConfigError(f"{kept}: is there already; move it away, or name another place with --out")
        write_whole(kept, text)
    write_whole(place, found.text)
    lost = list(found.without_comments_of)
    show({"file": place, "without_comments": lost}, [place])
    for section in lost:
        say(f"comments were not kept in: {section}")


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
    written = list(write_schemas(out or packaged("", "simulated").parent / "schema", DOCUMENTS))
    show(written, written)
