"""The JSON Schemas of what a user edits: printed and written by commands, and true of each installed file."""

import json
import re
from datetime import date
from pathlib import Path
from typing import Any

import pytest
import yaml
from jsonschema import Draft202012Validator
from typer.testing import CliRunner

from thermostand.compensation.cli import app as compensate
from thermostand.compensation.commands.schema_cli import DOCUMENTS as OFFLINE
from thermostand.foundation.schemas import make_schema
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
    "orders": "order",
}


def validator(kind: str) -> Draft202012Validator:
    return Draft202012Validator(make_schema(ALL[kind]))


def as_json(value: object) -> Any:
    """As an editor sees it: YAML's instants are texts, and keys too."""
    if isinstance(value, dict):
        return {str(key): as_json(each) for key, each in value.items()}
    if isinstance(value, list):
        return [as_json(each) for each in value]
    return value.isoformat() if isinstance(value, date) else value


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


COMMANDS = ((stand, ["config", "schema"], DOCUMENTS), (compensate, ["schema"], OFFLINE))


def test_the_commands_write_them_at_the_place_given_and_print_them(tmp_path: Path):
    folder = tmp_path / "new" / "folder"
    for app, words, kinds in COMMANDS:
        result = CliRunner().invoke(app, [*words, "--out", str(folder)])
        assert result.exit_code == 0, result.output
        assert result.stdout.split() == [str(folder / f"{kind}.json") for kind in kinds]
        for kind in kinds:
            printed = json.loads(CliRunner().invoke(app, [*words, kind]).stdout)
            assert json.loads((folder / f"{kind}.json").read_text()) == printed
            Draft202012Validator.check_schema(printed)
        assert json.loads(CliRunner().invoke(app, words).stdout).keys() == kinds.keys()
    assert {path.stem for path in folder.iterdir()} == set(ALL)


def test_one_kind_alone_is_written_and_another_is_refused(tmp_path: Path):
    for app, words, kinds in COMMANDS:
        kind = next(iter(kinds))
        assert CliRunner().invoke(app, [*words, kind, "--out", str(tmp_path)]).exit_code == 0
        refused = CliRunner().invoke(app, [*words, "nothing", "--out", str(tmp_path)])
        assert (refused.exit_code, refused.stderr.count("\n"), kind in refused.stderr) == (2, 1, True)
    assert {path.name for path in tmp_path.iterdir()} == {"stand.json", "geometry.json"}


def test_a_place_that_refuses_is_reported(tmp_path: Path):
    (tmp_path / "file").write_text("")
    result = CliRunner().invoke(stand, ["config", "schema", "--out", str(tmp_path / "file")])
    assert (result.exit_code, result.stderr.count("\n")) == (1, 1), result.output
