"""A camera's GenICam file before the camera is there: which features would be used, or which one is missing."""

import json
import zipfile
from pathlib import Path

import pytest
from typer.testing import CliRunner

from tests.dialects import DIALECTS
from tests.system.conftest import require_aravis
from thermostand.foundation.errors import ConfigError
from thermostand.stand.commands.command_table import app
from thermostand.stand.commissioning.genicam_rehearsal import rehearse
from thermostand.stand.config.stand_config import find_packaged, load_config


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
    assert "no ExposureTime" in reported.refusal


@pytest.mark.parametrize("dialect", ["selected", "ticks of a clock"])
async def test_a_file_whose_values_depend_on_registers_of_the_camera_is_played(tmp_path: Path, dialect: str):
    require_aravis()
    file = tmp_path / "camera.xml"
    file.write_bytes(DIALECTS[dialect].xml(dialect))
    reported = await rehearse(file)
    assert (reported.refusal, reported.unplayed, reported.is_played) == ("", (), True)
    assert reported.features["trigger"] == "FrameStart Software"


async def test_what_the_rehearsal_cannot_play_is_not_reported_of_the_camera(tmp_path: Path):
    """A formula that no value of its register gives a time; a trigger whose register it does not find."""
    require_aravis()
    file, text = tmp_path / "camera.xml", DIALECTS["ticks of a clock"].xml("base").decode()
    file.write_text(text.replace("<FormulaFrom>TO * T / 1000<", "<FormulaFrom>TO * T * 0<"))
    reported = await rehearse(file)
    assert reported.refusal.startswith("the rehearsal cannot play")
    assert not reported.is_played
    file.write_text(text.replace("(TO &amp; 0x80000000) &gt;&gt; 31", "0"))
    reported = await rehearse(file)
    assert (reported.unplayed, reported.is_played) == (("TriggerSoftware",), False)


async def test_an_entry_that_no_register_offers_is_not_taken_for_the_cameras(tmp_path: Path):
    require_aravis()
    file, text = tmp_path / "camera.xml", DIALECTS["abs"].xml("never").decode()
    never = (
        '<IntSwissKnife Name="Never"><pVariable Name="A">WidthReg</pVariable><Formula>A * 0</Formula></IntSwissKnife>'
    )
    text = text.replace('<EnumEntry Name="Mono8">', '<EnumEntry Name="Mono8"><pIsImplemented>Never</pIsImplemented>')
    file.write_text(text.replace('<Integer Name="Width">', never + '<Integer Name="Width">'))
    reported = await rehearse(file)
    assert (reported.unplayed, reported.is_played) == (("PixelFormat",), False)


async def test_the_file_of_a_transport_layers_module_is_refused_by_a_sentence(tmp_path: Path):
    require_aravis()
    file, text = tmp_path / "stream.xml", DIALECTS["abs"].xml("stream").decode()
    width = '<Integer Name="Width"><Value>0x7FFFFFFFFFFFFFFF</Value></Integer>'
    begin, end = text.index('<Integer Name="Width">'), text.index('<Integer Name="Height">')
    file.write_text(text[:begin] + width + text[end:])
    with pytest.raises(ConfigError, match=r"its Width is 9\.223e\+18.*transport layer's module"):
        await rehearse(file)


async def test_a_zipped_file_is_read(tmp_path: Path):
    require_aravis()
    file = tmp_path / "camera.zip"
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("abs.xml", DIALECTS["abs"].xml("abs"))
        archive.writestr("__MACOSX/._abs.xml", bytes(8))
    assert (await rehearse(file)).refusal == ""
    with zipfile.ZipFile(file, "w") as archive:
        archive.writestr("readme.txt", "nothing")
    with pytest.raises(ConfigError, match="an archive with 0 XML files, not one"):
        await rehearse(file)
    file.write_bytes(b"PK\x03\x04" + bytes(40))
    with pytest.raises(ConfigError, match="archive that cannot"):
        await rehearse(file)


ITSELF = '<Integer Name="Width"><pValue>A</pValue></Integer><Integer Name="A"><pValue>Width</pValue></Integer>'


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        ("<?xml", "<html/><?xml", "is no GenICam file"),
        ("utf-8", "nobodys", "is no GenICam file: unknown encoding"),
        ('<Integer Name="Width">', ITSELF + '<Integer Name="Width2">', "the value of its (Width|A) is made of itself"),
        ("<Length>4<", "<Length>0<", "its WidthMaxReg has the Length 0, not 1 to 8 bytes"),
        ("<CommandValue>1<", "<CommandValue>one<", "has the CommandValue 'one', no whole number"),
    ],
)
async def test_what_is_no_cameras_genicam_file_is_refused(tmp_path: Path, old: str, new: str, sentence: str):
    require_aravis()
    file, text = tmp_path / "other.xml", DIALECTS["abs"].xml("other").decode()
    file.write_text(text.replace(old, new))
    with pytest.raises(ConfigError, match=sentence):
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
    refused = await rehearse(file, load_config(find_packaged("", "simulated")))
    assert "exposure 0.1 s was asked for" in refused.refusal
