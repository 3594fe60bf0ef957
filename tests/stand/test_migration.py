"""`stand config migrate`: files of before as files of today, with their comments."""

from pathlib import Path

import pytest
import yaml
from typer.testing import CliRunner

from foundation.documents import parse_document
from foundation.errors import ConfigError
from stand.commands.command_table import app
from stand.config.migration import migrated
from stand.config.older_forms import renewed
from stand.config.stand_config import StandConfig, packaged

OLDER = """\
# Our stand.
name: of before
target: paper-9x6   # the plate
bus: {address: "tcp:127.0.0.1:15020"}
regulator: {registers: omron-e5cc, unit: 1}
relays: {registers: waveshare-relay, unit: 2, channels: {heater_enable: 0, compressor: 1, camera_power: 2}}

thermometers:                      # the module on the wall
  registers: icpdas-m7015
  unit: 3
  channels:                        # as labelled
    # near the heater
    air: {channel: 3, polynomial: [0, 0.2]}
    granite_inside:                # the old one

      channel: 0
  poll_s: 1.0

# The optics.
camera:                            # by address
  address: 127.0.0.20
# at the edge
  exposure_s: 0.2                  # s
  temperature:
    entry: Mainboard
flap: {serial_number: "00351210"}
guard:
  accept: [thermometers.channels.air.polynomial]   # a known slip
"""
NEWER = """\
# Our stand.
name: of before
target: paper-9x6   # the plate
bus: {address: "tcp:127.0.0.1:15020"}
regulator: {registers: omron-e5cc, unit: 1}
relays: {registers: waveshare-relay, unit: 2, channels: {heater_enable: 0, compressor: 1, camera_power: 2}}

thermometer_module:                      # the module on the wall
  registers: icpdas-m7015
  unit: 3
  poll_s: 1.0

thermometers:                        # as labelled
  # near the heater
  air: {channel: 3, polynomial: [0, 0.2]}
  granite_inside:                # the old one

    channel: 0

# The optics.
cameras:
  camera:                            # by address
    address: 127.0.0.20
# at the edge
    exposure_s: 0.2                  # s
    temperature:
      entry: Mainboard
flap: {serial_number: "00351210"}
guard:
  accept: [thermometers.air.polynomial]   # a known slip
"""
FLOW = """\
name: of before
target: paper-9x6
bus: {address: "tcp:127.0.0.1:15020"}
regulator: {registers: omron-e5cc, unit: 1}
relays: {registers: waveshare-relay, unit: 2, channels: {heater_enable: 0, compressor: 1, camera_power: 2}}
thermometers: {registers: icpdas-m7015, unit: 3, channels: {air: {channel: 3},   # near the heater
  granite_inside: {channel: 0}}}
flap: {serial_number: "00351210"}   # the spare
camera: {address: 127.0.0.20}   # left
"""


def run(*words: object):
    return CliRunner().invoke(app, ["config", "migrate", *map(str, words)])


def test_comments_and_order_are_kept():
    found = migrated(OLDER, "stand.yaml")
    assert found is not None
    assert found.text == NEWER
    assert found.without_comments_of == ()


def test_entries_that_do_not_stand_on_their_lines_lose_their_comments_which_is_said():
    found = migrated(FLOW, "stand.yaml")
    assert found is not None
    assert found.without_comments_of == ("thermometers",)
    assert "# the spare" in found.text
    assert "  camera: {address: 127.0.0.20}   # left" in found.text


def test_a_file_that_is_one_flow_mapping_is_written_again():
    found = migrated(yaml.safe_dump(yaml.safe_load(FLOW), default_flow_style=True, width=10**6), "stand.yaml")
    assert found is not None
    assert found.without_comments_of == ("the whole file",)


@pytest.mark.parametrize("text", [OLDER, FLOW], ids=["block", "flow"])
def test_the_content_is_the_same(text: str):
    found = migrated(text, "stand.yaml")
    assert found is not None
    assert yaml.safe_load(found.text) == renewed(yaml.safe_load(text))
    assert parse_document(found.text, StandConfig, "new") == parse_document(text, StandConfig, "old")
    assert migrated(found.text, "stand.yaml") is None


def test_in_its_place_the_older_file_is_kept_beside(tmp_path: Path):
    file = tmp_path / "stand.yaml"
    file.write_text(OLDER)
    result = run(file)
    assert (result.exit_code, result.stdout) == (0, f"{file}\n"), result.output
    assert file.read_text() == NEWER
    assert (tmp_path / "stand.yaml.before").read_text() == OLDER
    assert run(file).stdout == f"{file}: has today's form already; nothing was written\n"
    file.write_text(OLDER)
    again = run(file)
    assert (again.exit_code, file.read_text()) == (2, OLDER)
    assert "stand.yaml.before: is there already; move it away" in again.stderr


def test_elsewhere_the_older_file_stays_as_it_is(tmp_path: Path):
    file, out = tmp_path / "stand.yaml", tmp_path / "new.yaml"
    file.write_text(FLOW)
    result = run(file, "--out", out)
    assert (result.exit_code, file.read_text()) == (0, FLOW)
    assert result.stderr == "comments were not kept in: thermometers\n"
    assert {path.name for path in tmp_path.iterdir()} == {"stand.yaml", "new.yaml"}


def test_a_link_stays_one(tmp_path: Path):
    (tmp_path / "there.yaml").write_text(OLDER)
    (tmp_path / "link.yaml").symlink_to(tmp_path / "there.yaml")
    assert run(tmp_path / "link.yaml").exit_code == 0
    assert (tmp_path / "link.yaml").is_symlink()
    assert (tmp_path / "there.yaml").read_text() == NEWER


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        (
            OLDER.replace("exposure_s: 0.2", "exposure_s: 0"),
            "cameras.camera.exposure_s: must be greater than 0",
        ),
        ("name: x\ncamera: [", "not YAML"),
        ("name: night\nexperiments: []\n", "is a recipe"),
    ],
    ids=["value", "yaml", "recipe"],
)
def test_what_could_not_be_opened_is_left_alone(tmp_path: Path, text: str, sentence: str):
    file = tmp_path / "stand.yaml"
    file.write_text(text)
    result = run(file)
    assert result.exit_code == 2
    assert sentence in result.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["stand.yaml"]


@pytest.mark.parametrize("name", ["simulated", "laboratory"])
def test_installed_files_have_todays_form(name: str):
    assert migrated(packaged("", name).read_text(), name) is None


def test_a_fault_is_a_config_error_with_the_files_name():
    with pytest.raises(ConfigError, match=r"^stand.yaml: "):
        migrated("name: x", "stand.yaml")
