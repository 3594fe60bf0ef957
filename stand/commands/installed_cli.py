"""`stand recipes` and `stand configs`: what is installed, by the names that commands take."""

from __future__ import annotations

import importlib.resources
from pathlib import Path

import yaml

from thermostand.foundation.command_app import App
from thermostand.foundation.output import show
from thermostand.foundation.usage import escape_line

app = App(no_args_is_help=True)


@app.command()
def recipes() -> None:
    """List the installed recipes. A file of your own is given by its path.

    Example: stand recipes
    """
    _list("recipes", "description")


@app.command()
def configs() -> None:
    """List the installed configurations of stands. Copy laboratory.yaml for your own stand.

    Example: stand configs
    """
    _list("", "name")


def _list(folder: str, described_by: str) -> None:
    found: list[dict[str, str]] = []
    for path in sorted((Path(str(importlib.resources.files("thermostand.configs"))) / folder).glob("*.yaml")):
        data: object = yaml.safe_load(path.read_text(encoding="utf-8"))
        text = str(data.get(described_by, "")) if isinstance(data, dict) else ""
        found.append({"name": path.stem, "text": text, "path": str(path)})
    width = max((len(each["name"]) for each in found), default=0)
    show(found, (escape_line(f"{each['name']:<{width}}  {each['text']}") for each in found))
