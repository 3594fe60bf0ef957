"""Packages that are installed only by those who want them: the extras in pyproject.toml."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from thermostand.foundation.errors import SessionError


def import_extra(module: str, extra: str, otherwise: str = "") -> Any:
    """The module of a package that the extra brings. SessionError that names both when it is not installed;
    `otherwise` ends its sentence with what else can be done."""
    try:
        return import_module(module)
    except ImportError as error:
        package = module.partition(".")[0]
        raise SessionError(
            f"{package} is not installed, and this needs it: pip install 'thermostand[{extra}]'{otherwise}"
        ) from error
