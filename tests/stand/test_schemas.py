"""The JSON Schemas of what a user edits: current, named in each file, and true of each installed one."""

import json
import re
from datetime import datetime
from pathlib import Path
from typing import Any

import pytest
import yaml
from jsonschema import Draft202012Validator
from typer.testing import CliRunner

from thermostand.compensation.cli import app as compensate
from thermostand.compensation.commands.schema_cli import DOCUMENTS as OFFLINE
from thermostand.foundation.documents import format_schema
from thermostand.stand.commands.command_table import app as stand
from thermostand.stand.commands.config_cli import DOCUMENTS

CONFIGS = Path(__file__).parents[2] / "configs"
FILES = sorted(CONFIGS.rglob("*.yaml"))
ALL = {**DOCUMENTS, **OFFLINE}
KINDS = {
    "configs": "stand",
    "recipes": "recipe",
    "registers": "registers",
    "targets": "target",
    "geometry": "geometry",
    "optics": "optics",
}


def validator(kind: str) -> Draft202012Validator:
    return Draft202012Validator(json.loads(format_schema(ALL[kind])))


def as_json(value: object) -> Any:
    """As an editor sees it: YAML's instants are texts, and keys too."""
    if isinstance(value, dict):
        return {str(key): as_json(each) for key, each in value.items()}
    if isinstance(value, list):
        return [as_json(each) for each in value]
    return value.isoformat() if isinstance(value, datetime) else value


@pytest.mark.parametrize("kind", ALL)
def test_the_schemas_are_current(kind: str):
    """When not: stand config schema, compensate schema."""
    assert (CONFIGS / "schema" / f"{kind}.json").read_text() == format_schema(ALL[kind])


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_each_installed_file_names_its_schema_and_fits_it(path: Path):
    found = re.match(r"# yaml-language-server: \$schema=(\S+)\n", path.read_text())
    assert found is not None
    kind = KINDS[path.parent.name]
    assert (path.parent / found[1]).resolve() == CONFIGS / "schema" / f"{kind}.json"
    faults = [fault.message for fault in validator(kind).iter_errors(as_json(yaml.safe_load(path.read_text())))]
    assert faults == []


def test_a_slip_is_found_by_the_schema():
    data = yaml.safe_load((CONFIGS / "laboratory.yaml").read_text())
    data["cameras"]["camera"]["pixle_format"] = "Mono8"
    data["guard"]["period_s"] = -1
    assert len(list(validator("stand").iter_errors(data))) == 2


def test_a_recipe_that_waits_until_settled_fits():
    dwell = {"table_position": {}, "reference_degC": 24, "equilibrium_s": 2700, "set_points_degC": [24, 31]}
    dwell |= {"held_out_degC": [], "soak_s": 2700, "reference_frames": 1, "frames_per_point": 1}
    for until in ("settled", {"settled": {"min_s": 900}}):
        recipe = {"name": "settled", "experiments": [{"thermal_cycle": {**dwell, "until": until}}]}
        assert [fault.message for fault in validator("recipe").iter_errors(recipe)] == []


def test_the_commands_write_them_at_the_place_given(tmp_path: Path):
    for app, words in ((stand, ["config", "schema"]), (compensate, ["schema"])):
        result = CliRunner().invoke(app, [*words, "--out", str(tmp_path / "new" / "folder")])
        assert result.exit_code == 0, result.output
    assert {path.stem for path in (tmp_path / "new" / "folder").iterdir()} == set(ALL)


def test_a_place_that_refuses_is_reported(tmp_path: Path):
    (tmp_path / "file").write_text("")
    result = CliRunner().invoke(stand, ["config", "schema", "--out", str(tmp_path / "file")])
    assert (result.exit_code, result.stderr.count("\n")) == (1, 1), result.output
