"""YAML file -> validated, frozen pydantic model, or a ConfigError that names the file and the path inside it."""

from __future__ import annotations

from pathlib import Path
from typing import TypeVar

import yaml
from pydantic import BaseModel, ConfigDict, ValidationError

from drivers.interface import ConfigError


class Document(BaseModel):
    """Base of every configuration model: unknown keys are errors, values do not change after loading."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


Model = TypeVar("Model", bound=BaseModel)


def load_document(path: Path, model: type[Model]) -> Model:
    """The file as `model`; raises ConfigError with one line per fault, each naming file and path."""
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: cannot be read ({error})") from error
    return parse_document(text, model, str(path))


def parse_document(text: str, model: type[Model], where: str) -> Model:
    """YAML text as `model`; `where` (a file name) begins every message of the ConfigError it may raise."""
    try:
        data = yaml.safe_load(text)
    except yaml.YAMLError as error:
        raise ConfigError(f"{where}: not YAML ({' '.join(str(error).split())})") from error
    if not isinstance(data, dict):
        raise ConfigError(f"{where}: expected keys and values at the top, found {type(data).__name__}")
    try:
        return model.model_validate(data)
    except ValidationError as error:
        raise ConfigError("\n".join(_sentence(where, fault) for fault in error.errors())) from error


def _sentence(where: str, fault: object) -> str:
    """One pydantic fault as `file: path: what is wrong (got value)`."""
    details = fault if isinstance(fault, dict) else {}
    path = ".".join(str(part) for part in details.get("loc", ())) or "(top)"
    text = str(details.get("msg", "invalid")).removeprefix("Value error, ")
    value = details.get("input")
    shown = "" if isinstance(value, dict | list) or value is None else f" (got {value!r})"
    if details.get("type") == "extra_forbidden":
        text = "unknown key"
        shown = ""
    return f"{where}: {path}: {text}{shown}"
