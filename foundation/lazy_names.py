"""Public names that are imported when they are first used (PEP 562): `import recording` loads no library."""

from __future__ import annotations

import ast
import importlib
import sys
from collections.abc import Callable
from pathlib import Path


def make_lazy_names(package: str, file: str) -> tuple[Callable[[str], object], Callable[[], list[str]], list[str]]:
    """`__getattr__`, `__dir__` and `__all__` of a package whose names are in the `__init__.pyi` next to its `file`:
    lines such as `from thermostand.recording.reading.session import Session as Session`, which type checkers read as
    well, and `other_name = known_name`. What begins with _ is not public."""
    text = Path(file).with_suffix(".pyi").read_text(encoding="utf-8")
    places = {
        alias.asname or alias.name: (statement.module or "", alias.name)
        for statement in ast.parse(text).body
        if isinstance(statement, ast.ImportFrom)
        for alias in statement.names
    }
    for statement in ast.parse(text).body:
        match statement:
            case ast.Assign([ast.Name(name)], ast.Name(known)):
                places[name] = places[known]
            case _:
                pass

    def get(name: str) -> object:
        if name not in places:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        module, attribute = places[name]
        found: object = getattr(importlib.import_module(module), attribute)
        setattr(sys.modules[package], name, found)
        return found

    def names() -> list[str]:
        return sorted(name for name in places if not name.startswith("_"))

    return get, names, names()
