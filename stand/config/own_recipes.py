"""Recipes by name: those that are installed, and a laboratory's own beside its sessions."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from thermostand.foundation.documents import parse_document, read_document
from thermostand.foundation.errors import ConfigError, NotFound, SessionError
from thermostand.foundation.files import make_folder, replace_file
from thermostand.stand.config.recipe import Recipe
from thermostand.stand.config.stand_config import find_packaged

OWN_RECIPES = "recipes"  # the folder, in that of the sessions
_NAME = re.compile(r"[a-z0-9][a-z0-9-]{0,99}")  # of a recipe


@dataclass(frozen=True, slots=True)
class NamedRecipe:
    """A recipe. own: saved here by somebody, and not installed with the program."""

    name: str
    text: str
    own: bool


def list_recipes(sessions: Path) -> Iterator[NamedRecipe]:
    """The installed recipes, then the own ones of the stand with these sessions, each by name."""
    for folder, own in ((_get_installed(), False), (sessions / OWN_RECIPES, True)):
        for path in sorted(folder.glob("*.yaml")):
            if _NAME.fullmatch(path.stem):
                # One that is no text is listed, too; reading it says what is wrong with it.
                yield NamedRecipe(path.stem, path.read_text("utf-8", errors="replace"), own)


def read_recipe(sessions: Path, name: str) -> str:
    """The text of the recipe of that name; NotFound lists what there is, ConfigError when it cannot be read."""
    if _NAME.fullmatch(name):
        for folder in (_get_installed(), sessions / OWN_RECIPES):
            if (path := folder / f"{name}.yaml").is_file():
                return read_document(path)
    known = ", ".join(each.name for each in list_recipes(sessions))
    raise NotFound(f"no recipe of that name is installed or saved here; there are {known}")


def save_recipe(sessions: str, name: str, text: str) -> None:
    """Keep an own recipe, in the place of one of that name; ConfigError when it is none, is called otherwise, or has
    the name of an installed one; SessionError when the disk refuses."""
    recipe = parse_document(text, Recipe, "the recipe")
    if recipe.name != name:
        raise ConfigError(f"the recipe's own name is {recipe.name}; save it under that, or change it to {name}")
    if (_get_installed() / f"{name}.yaml").is_file():
        raise ConfigError(f"{name} is an installed recipe, which stays as it is; give yours another name")
    folder = Path(sessions) / OWN_RECIPES
    make_folder(folder)
    try:
        replace_file(folder / f"{name}.yaml", text.encode())
    except OSError as error:
        raise SessionError(f"{folder}: the recipe cannot be saved ({error.strerror})") from error


def remove_recipe(sessions: str, name: str) -> None:
    """Remove an own recipe; NotFound when there is none of that name, SessionError when the disk refuses."""
    path = Path(sessions) / OWN_RECIPES / f"{name}.yaml"
    if not _NAME.fullmatch(name) or not path.is_file():
        raise NotFound("no recipe of that name was saved here; those that are installed stay")
    try:
        path.unlink()
    except OSError as error:
        raise SessionError(f"{path}: cannot be removed ({error.strerror})") from error


def _get_installed() -> Path:
    return find_packaged("recipes", "thermal-cycle").parent
