"""The documentation: each block of code runs or is read by what it is for, and sentences stay short. Files that a page
includes have tests of their own."""

from __future__ import annotations

import json
import re
import shlex
import sys
import tomllib
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
import yaml
from typer.testing import CliRunner, Result

from tests.addresses import find_free_port
from tests.installed import install
from tests.stand.fake_service import FakeService, serve_fake
from thermostand.compensation.certificate.order import Order
from thermostand.compensation.cli import app as compensate
from thermostand.compensation.datasheet.measurement_details import MeasurementDetails
from thermostand.compensation.measurement_mapping import MeasurementMapping
from thermostand.experiments.steps import make_step
from thermostand.foundation.documents import parse_document
from thermostand.foundation.events import GUARD, KINDS
from thermostand.stand.commands.command_table import app as stand
from thermostand.stand.config.alerts_section import AlertSecrets
from thermostand.stand.config.recipe import Recipe
from thermostand.stand.config.stand_config import StandConfig, find_packaged
from thermostand.stand.serving.api.listeners import Interface

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
EXAMPLES = DOCS / "examples"
PAGES = sorted(page for page in DOCS.rglob("*.md") if page.parent.name != "adr" and EXAMPLES not in page.parents)
PROGRAMS = {"stand": stand, "compensate": compensate}
OTHERS = {"arv-tool-0.8", "cc", "colcon", "cp", "pip", "pipx", "ros2", "ssh", "systemctl", "uv"}
"""Programs that are not ours: what is typed for them is not tried."""
NOT_OURS = {"nginx", "matlab", "text", "math"}
"""Blocks of these are for other programs, or shown only; equations are drawn by the site's test."""
ROUTES = set(json.loads((ROOT / "tests/golden/data/openapi.json").read_text("utf-8"))["paths"])


class Block(NamedTuple):
    page: Path
    language: str
    text: str


def blocks_of(page: Path) -> Iterator[Block]:
    for found in re.finditer(r"^( *)```(\w*)\n(.*?)^\1```$", page.read_text("utf-8"), re.MULTILINE | re.DOTALL):
        yield Block(page, found[2], re.sub(rf"(?m)^{found[1]}", "", found[3]))


BLOCKS = [block for page in PAGES for block in blocks_of(page)]


def those(language: str) -> list[Any]:
    found = [block for block in BLOCKS if block.language == language]
    return [pytest.param(block, id=f"{block.page.stem}-{number}") for number, block in enumerate(found)]


def called(words: list[str]) -> Result:
    return CliRunner().invoke(PROGRAMS[words[0]], words[1:], prog_name=words[0])


def test_each_block_says_what_it_is_and_has_its_test():
    tried = {"console", "yaml", "python", "json", "c"}
    assert {block.language for block in BLOCKS} <= tried | NOT_OURS
    assert [block.page.name for block in BLOCKS if block.language == "c"] == ["apply-in-c.md"]  # test_c_header.py
    assert len(BLOCKS) > 80


@pytest.mark.parametrize("block", those("console"))
def test_what_is_typed_exists_with_its_options(block: Block):
    """A wrong option is refused before the help is shown."""
    for line in block.text.splitlines():
        words = [word.removeprefix(".venv/bin/") for word in shlex.split(re.sub(r" > .*", "", line))]
        words = words[1:] if words[0] == "sudo" else words
        if words[0] in PROGRAMS:
            result = called([*words, "--help"])
            assert result.exit_code == 0, f"{line}\n{result.output}"
        elif words[:2] == ["python", "-m"]:
            assert find_spec(words[2]) is not None, line
        elif words[0] == "make":
            assert f"\n{words[1]}:" in (ROOT / "Makefile").read_text(encoding="utf-8"), line
        elif words[0] == "curl":
            assert re.sub(r"^\w+://[^/]+", "", words[-1]) in ROUTES, line
        else:
            assert words[0] in OTHERS, line


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_a_command_in_the_text_exists_with_its_options(page: Path):
    text = re.sub(r"```.*?```", "", page.read_text("utf-8"), flags=re.DOTALL)
    for command in sorted(set(re.findall(r"`((?:stand|compensate) [a-z][^`]*)`", text))):
        typed = re.sub(r"[\[\]]| --[a-z-]+$", "", command)  # a last option lacks its value
        result = called([*shlex.split(typed), "--help"])
        assert result.exit_code == 0, f"{command}\n{result.output}"


@pytest.fixture
def added(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """The packages of docs/examples, installed, in an empty folder with the files that pages name."""
    monkeypatch.syspath_prepend(tmp_path / "site")
    for folder in ("lamp", "ambient-rule"):
        project = tomllib.loads((EXAMPLES / folder / "pyproject.toml").read_text("utf-8"))["project"]
        modules = {path.stem: path.read_text("utf-8") for path in (EXAMPLES / folder).glob("*.py")}
        points = {
            group: "\n".join(f"{name} = {what}" for name, what in found.items())
            for group, found in project["entry-points"].items()
        }
        install(tmp_path / "site", project["name"], modules, points)
    (tmp_path / "my-camera.xml").write_text("<RegisterDescription/>")
    monkeypatch.chdir(tmp_path)
    yield
    KINDS.pop(f"{GUARD}ambient_hot", None)
    for module in ("acme_lamp", "acme_fake", "acme_ambient"):
        sys.modules.pop(module, None)


JOINED = {"guard", "chamber", "interface", "limits", "simulation"}
INSTEAD = {"climate_chamber": ("regulator", "relays", "heat_module")}
WHOLE = {"heat_module": "software-regulator", "simulation": "simulated"}
"""The stand whose file has what goes with a section; else the laboratory's."""


def with_section(base: dict[str, Any], changes: dict[str, Any]) -> dict[str, Any]:
    """A stand's file with what a page shows of one: sections that are mappings of settings are joined."""
    return {
        **base,
        **{key: {**base.get(key, {}), **value} if key in JOINED else value for key, value in changes.items()},
    }


@pytest.mark.usefixtures("added")
@pytest.mark.parametrize("block", those("yaml"))
def test_what_is_written_in_a_file_is_taken(block: Block):
    data = yaml.safe_load(block.text)
    name = block.page.name
    if {"steps", "experiments"} & set(data):
        assert list(parse_document(block.text, Recipe, name).plan())
    elif "urls" in data:
        parse_document(block.text, AlertSecrets, name)
    elif "customer" in data:
        parse_document(block.text, Order, name)
    elif "lens" in data:
        parse_document(block.text, MeasurementDetails, name)
    elif "columns" in data:
        parse_document(block.text, MeasurementMapping, name)
    elif "scrape_configs" in data:  # Prometheus'
        assert data["scrape_configs"][0]["static_configs"]
    else:
        whole = next((WHOLE[section] for section in data if section in WHOLE), "laboratory")
        base = yaml.safe_load(find_packaged("", whole).read_text("utf-8"))
        for section in data:
            for other in INSTEAD.get(section, ()):
                base.pop(other, None)
        if "heat_module" in data:
            base["relays"]["channels"].pop("heat")
            base["regulator"].pop("pulses", None)
        parse_document(yaml.safe_dump(with_section(base, data)), StandConfig, name)


@pytest.mark.parametrize("block", those("json"))
def test_json_is_what_the_interface_takes_or_gives(block: Block):
    data = json.loads(block.text)
    for step in data.get("steps", ()):
        assert make_step(step["kind"], step["parameters"]).kind == step["kind"]


PYTHON = {
    "use-from-python.md",  # tests/compensation/test_public_api.py
    "http-api.md",
    "markers.md",
}


def test_each_page_with_python_is_run_by_a_test():
    assert {block.page.name for block in BLOCKS if block.language == "python"} == PYTHON


async def test_the_http_client_of_the_page_reads_and_commands(tmp_path: Path):
    import asyncio

    (block,) = blocks_named("http-api.md")
    port = find_free_port()
    async with serve_fake(FakeService(), tmp_path / "now", Interface(tmp_path, port=port)):
        code = compile(block.text.replace("127.0.0.1:8000", f"127.0.0.1:{port}"), "http-api.md", "exec")
        await asyncio.to_thread(exec, code, {})


def test_the_detection_of_the_page_finds_all_markers():
    from tests.compensation.conftest import photo

    (block,) = blocks_named("markers.md")
    names: dict[str, Any] = {"image": np.asarray(photo(4))}
    exec(compile(block.text, "markers.md", "exec"), names)
    assert names["first"].found == names["following"].found == 54


def blocks_named(page: str) -> list[Block]:
    return [each for each in BLOCKS if each.page.name == page and each.language == "python"]


def test_the_example_packages_name_what_they_have():
    for folder in (path.parent for path in EXAMPLES.glob("*/pyproject.toml")):
        project = tomllib.loads((folder / "pyproject.toml").read_text("utf-8"))["project"]
        for points in project["entry-points"].values():
            for target in points.values():
                module, _, what = target.partition(":")
                assert re.search(rf"^(?:def |class )?{what}\b", (folder / f"{module}.py").read_text(), re.MULTILINE)


def sentences(text: str) -> list[str]:
    """Of prose: without code, tables, pictures and addresses; an item of a list ends a sentence."""
    text = re.sub(r"```.*?```|<!--.*?-->|!\[[^\]]*\]\([^)]*\)(\{[^}]*\})?", "", text, flags=re.DOTALL)
    text = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", text)
    lines = [line for line in text.splitlines() if not re.match(r"\s*(\||#|    )", line)]
    text = re.sub(r"\n\s*(?:[-*]|\d+\.) ", "\n\n", "\n".join(lines))
    parts = (part for paragraph in text.split("\n\n") for part in re.split(r"(?<=[.:!?;])\s+", paragraph))
    return [part for part in parts if len(part.split()) > 1]


@pytest.mark.parametrize("page", [*PAGES, ROOT / "README.md", ROOT / "CONTRIBUTING.md"], ids=lambda page: page.stem)
def test_sentences_have_25_words_at_most_on_average(page: Path):
    counts = [len(each.split()) for each in sentences(page.read_text("utf-8"))]
    assert not counts or sum(counts) / len(counts) <= 25, page


def test_the_readme_is_one_page():
    assert len((ROOT / "README.md").read_text("utf-8").splitlines()) <= 70


def test_the_six_files_that_a_newcomer_looks_for_are_linked_from_the_readme():
    links = re.findall(r"\]\(([\w./-]+)\)", (ROOT / "README.md").read_text("utf-8"))
    assert [link for link in links if not (ROOT / link).exists()] == []
    assert {
        "drivers/devices/kinds.py",
        "stand/guarding/interlocks.py",
        "stand/running/executing/actions.py",
        "compensation/drift/terms.py",
        "stand/serving/page/stop.js",
        "docs/reference/session-format.md",
    } <= set(links)
