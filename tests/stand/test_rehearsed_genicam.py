"""A camera's GenICam file before the camera is there: which features would be used, or which one is missing."""

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from foundation.errors import ConfigError
from stand.commands.command_table import app
from stand.commissioning.genicam_rehearsal import rehearse
from stand.config.stand_config import load_config, packaged
from tests.dialects import DIALECTS
from tests.system.conftest import require_aravis


async def test_a_file_tells_which_features_would_be_used(tmp_path: Path):
    require_aravis()
    file = tmp_path / "abs.xml"
    file.write_bytes(DIALECTS["abs"].xml("abs"))
    reported = await rehearse(file)
    assert (reported.camera, reported.refusal) == ("Dialects abs", "")
    assert reported.features["exposure"] == "ExposureTimeAbs"
    assert reported.features["temperature"].startswith("TemperatureAbs of TemperatureSelector 'Sensorboard'")
    assert reported.features["frame"].startswith("2448 x 2048 px, Mono8")


async def test_a_file_that_lacks_something_says_what(tmp_path: Path):
    require_aravis()
    file = tmp_path / "none.xml"
    file.write_bytes(DIALECTS["no exposure"].xml("none"))
    reported = await rehearse(file)
    assert "the camera has no ExposureTime" in reported.refusal


async def test_what_is_no_genicam_file_is_refused(tmp_path: Path):
    file = tmp_path / "other.xml"
    file.write_text("<html/>")
    with pytest.raises(ConfigError, match="is no GenICam file"):
        await rehearse(file)


@pytest.mark.parametrize(
    ("dialect", "status", "shown"),
    [
        ("abs", 0, "exposure      ExposureTimeAbs"),
        ("no exposure", 1, "refused: camera: the camera has no ExposureTime"),
    ],
)
def test_the_command_says_it_and_its_status_whether_it_opened(tmp_path: Path, dialect: str, status: int, shown: str):
    require_aravis()
    file = tmp_path / "camera.xml"
    file.write_bytes(DIALECTS[dialect].xml(dialect))
    result = CliRunner().invoke(app, ["check", "--genicam", str(file)])
    assert result.exit_code == status
    assert shown in result.output
    if status:
        checked = json.loads(CliRunner().invoke(app, ["check", "--genicam", str(file), "--json"]).stdout)
        assert "ExposureTime" in checked["refusal"]


async def test_the_exposure_of_ones_own_stand_is_tried_and_without_one_such_as_each_camera_makes(tmp_path: Path):
    """The installed file's exposure is nobody's: a camera with a shorter longest one is not refused for it."""
    require_aravis()
    file = tmp_path / "short.xml"
    text = DIALECTS["abs"].xml("abs").decode()
    begin = text.index('<Float Name="ExposureTimeAbs">')
    end = text.index("</FloatReg>", begin) + len("</FloatReg>")
    words = text[begin:end].replace("FloatReg", "IntReg").replace("Float", "Integer").replace("<Length>8", "<Length>2")
    file.write_text(text[:begin] + words + text[end:])  # 16 bits: no more than 65.535 ms
    assert (await rehearse(file)).refusal == ""
    refused = await rehearse(file, load_config(packaged("", "simulated")))
    assert "exposure 0.1 s was asked for" in refused.refusal
