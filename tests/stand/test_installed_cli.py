"""What is installed is listed, and both programs say their version."""

import importlib.metadata
import json

import pytest
from typer.testing import CliRunner

from thermostand.compensation.cli import app as compensate
from thermostand.stand.commands.command_table import app as stand
from thermostand.stand.config.stand_config import find_packaged


def ask(app, *words: str) -> str:
    result = CliRunner().invoke(app, list(words))
    assert result.exit_code == 0, result.output
    return result.stdout


@pytest.mark.parametrize("app", [stand, compensate])
def test_the_version_is_shown(app):
    assert ask(app, "--version") == f"thermostand {importlib.metadata.version('thermostand')}\n"


def test_each_recipe_and_each_stand_is_listed_by_the_name_that_commands_take():
    lines = ask(stand, "recipes").splitlines()
    assert any(line.startswith("thermal-cycle ") and "Two cycles over 10..52 degC" in line for line in lines)
    for each in json.loads(ask(stand, "recipes", "--json")):
        assert str(find_packaged("recipes", each["name"])) == each["path"]
    names = [line.split()[0] for line in ask(stand, "configs").splitlines()]
    assert names == ["laboratory", "simulated", "software-regulator"]
    assert json.loads(ask(stand, "configs", "--json"))[1]["text"] == "simulated-stand"
