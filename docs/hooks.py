"""Pages that are made when the site is: the references of the configuration files, from their schemas, and what a stand
says, from its table of events."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files

from thermostand.stand.commands.remedies import troubleshooting
from thermostand.stand.config.reference import reference

_PAGES = {
    "stand": "A stand's file",
    "recipe": "A recipe",
    "registers": "A register map",
    "target": "A target",
    "geometry": "A stand's geometry",
    "details": "Details of a measurement",
}


def on_files(files: Files, config: Any) -> Files:
    """Add a page for each schema."""
    schemas = Path(__file__).parents[1] / "configs" / "schema"
    for name, title in _PAGES.items():
        schema = json.loads((schemas / f"{name}.json").read_text(encoding="utf-8"))
        files.append(File.generated(config, f"reference-{name}.md", content=reference(title, schema)))
    files.append(File.generated(config, "troubleshooting.md", content=troubleshooting()))
    return files
