"""tests/capabilities.md: each line names a test that exists, and whatever a user can do has a line."""

from __future__ import annotations

import ast
import json
import re
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import Any

import pytest

from tests.golden.product import commands
from thermostand.experiments.recipe_steps import StepEntry
from thermostand.stand.config.recipe import Experiment
from thermostand.stand.config.stand_config import StandConfig

ROOT = Path(__file__).parents[1]
TEXT = (ROOT / "tests" / "capabilities.md").read_text("utf-8")
LINES = [line for line in TEXT.splitlines() if line.startswith("- ")]
OPENAPI = ROOT / "tests" / "golden" / "data" / "openapi.json"


def named(word: str) -> str:
    return f"`{word}`"


def cli() -> Iterator[str]:
    """Each verb; what it takes as --format."""
    for path, command in commands():
        if not hasattr(command, "list_commands"):
            yield named(" ".join(path))
        for parameter in command.params:
            if "--format" in parameter.opts:
                yield from map(str, parameter.type.choices)


def routes() -> Iterator[str]:
    for path, entry in json.loads(OPENAPI.read_text("utf-8"))["paths"].items():
        yield from (named(f"{method.upper()} {path}") for method in entry)


def steps_and_experiments() -> Iterator[str]:
    yield from map(named, {*StepEntry.model_fields, *Experiment.model_fields} - {"steps"})


def sections() -> Iterator[str]:
    yield from (named(f"{name}:") for name in StandConfig.model_fields)


def kinds() -> Iterator[str]:
    """Of devices: what the stand's file may say as protocol, kind or profile, and each register map."""
    yield from (named(path.stem) for path in (ROOT / "configs" / "registers").glob("*.yaml"))

    def choices(schema: Any) -> Iterator[str]:
        if isinstance(schema, dict):
            yield from (str(each) for each in (schema.get("const"), *schema.get("enum", ())) if each is not None)
            for each in schema.get("anyOf", ()):
                yield from choices(each)

    for model in StandConfig.model_json_schema()["$defs"].values():
        for name in ("protocol", "kind", "profile"):
            yield from map(named, choices(model.get("properties", {}).get(name)))


def installed() -> Iterator[str]:
    """Recipes and targets."""
    for folder in ("recipes", "targets"):
        yield from (named(path.stem) for path in (ROOT / "configs" / folder).glob("*.yaml"))


def headings() -> Iterator[str]:
    """Of pages, from their templates: what stands in a heading, or one of two texts."""
    for path in (ROOT / "compensation" / "reporting").glob("*.jinja"):
        for text in re.findall(r"<h(?:[23]|{{ level }})>(.*?)</h", path.read_text("utf-8")):
            yield from ([f'"{text}"'] if "{{" not in text else re.findall(r'"[A-Z][^"]+"', text))


@cache
def _defined(file: str) -> set[str]:
    kinds = ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef
    return {node.name for node in ast.parse((ROOT / file).read_text("utf-8")).body if isinstance(node, kinds)}


def test_each_line_names_tests_that_exist():
    without = [line for line in LINES if "~~" not in line and not re.search(r"`tests/[\w/]+\.py::\w+`$", line)]
    assert without == []
    named_tests = re.findall(r"`(tests/[\w/]+\.py)::(\w+)`", TEXT)
    assert [f"{file}::{name}" for file, name in named_tests if name not in _defined(file)] == []


@pytest.mark.parametrize("offered", [cli, routes, steps_and_experiments, sections, kinds, installed, headings])
def test_what_is_offered_has_a_line(offered: Callable[[], Iterator[str]]):
    words = list(offered())
    assert len(words) > 3
    assert [word for word in words if not any(word in line for line in LINES)] == []
