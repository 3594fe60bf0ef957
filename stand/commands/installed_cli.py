"""`stand recipes` and `stand configs`: what is installed, by the names that commands take."""

from __future__ import annotations

import importlib.resources
import json
from pathlib import Path

import typer
import yaml

from foundation.exit_codes import one_line_errors
from foundation.usage import OneLineUsage, one_line
from stand.commands.session_args import JsonOption

app = typer.Typer(cls=OneLineUsage, no_args_is_help=True, add_completion=False)


@app.command()
def recipes(as_json: JsonOption = False) -> None:
    """The installed recipes. A file of your own is given by its path.

    Example: stand recipes
    """
    _list("recipes", "description", as_json)


@app.command()
def configs(as_json: JsonOption = False) -> None:
    """The installed stands' files. Copy laboratory.yaml for your own stand.

    Example: stand configs
    """
    _list("", "name", as_json)


def _list(folder: str, told_by: str, as_json: bool) -> None:
    with one_line_errors():
        found: list[dict[str, str]] = []
        for path in sorted((Path(str(importlib.resources.files("configs"))) / folder).glob("*.yaml")):
            data: object = yaml.safe_load(path.read_text(encoding="utf-8"))
            text = str(data.get(told_by, "")) if isinstance(data, dict) else ""
            found.append({"name": path.stem, "text": text, "path": str(path)})
        if as_json:
            typer.echo(json.dumps(found, indent=2))
            return
        width = max((len(each["name"]) for each in found), default=0)
        for each in found:
            typer.echo(one_line(f"{each['name']:<{width}}  {each['text']}"))
