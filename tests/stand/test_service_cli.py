"""`stand service install` shows a unit and rules, and writes them when it is asked to."""

import configparser
import shlex
import shutil
import subprocess
from pathlib import Path

from typer.testing import CliRunner, Result

from thermostand.stand.commands.command_table import app
from thermostand.stand.config.stand_config import find_packaged
from thermostand.stand.safety.latch import SYSTEM_FOLDER
from thermostand.stand.serving.instances import STANDS_FOLDER

CONFIG = find_packaged("", "simulated")


def installed(*options: str) -> Result:
    return CliRunner().invoke(app, ["service", "install", str(CONFIG), *options])


def test_the_files_are_shown_and_not_written_without_a_yes(tmp_path: Path):
    shown = installed("--root", str(tmp_path), "--user", "operator")
    assert shown.exit_code == 0
    assert "Type=notify" in shown.stdout
    assert "nothing was written" in shown.stderr
    assert list(tmp_path.iterdir()) == []


def test_the_unit_starts_the_daemon_and_gives_it_time_to_make_safe(tmp_path: Path):
    assert installed("--root", str(tmp_path), "--user", "operator", "--port", "8080", "--yes").exit_code == 0
    unit = configparser.ConfigParser(interpolation=None, strict=False)
    unit.optionxform = str  # pyright: ignore[reportAttributeAccessIssue] - as its documentation says
    unit.read(tmp_path / "etc/systemd/system/thermostand-simulated-stand.service")
    command = shlex.split(unit["Service"]["ExecStart"])
    assert command[1:] == ["-m", "thermostand.stand.cli", "serve", str(CONFIG.absolute()), "--port", "8080"]
    assert unit["Service"]["User"] == "operator"
    assert int(unit["Service"]["WatchdogSec"]) == 60
    assert unit["Service"]["ExecReload"] == "/bin/kill -HUP $MAINPID"
    rules = (tmp_path / "etc/udev/rules.d/60-thermostand.rules").read_text()
    assert 'ATTR{idVendor}=="1ffb", OWNER="operator"' in rules
    assert 'SYMLINK+="ximc/%s{serial}"' in rules
    lines = [line for line in rules.replace("\\\n", "").splitlines() if not line.startswith("#")]
    assert len(lines) == 3
    assert all('ENV{ID_MM_DEVICE_IGNORE}="1"' in line for line in lines)  # ModemManager sends no AT commands there


def test_the_unit_may_do_little_and_systemd_reads_it(tmp_path: Path):
    options = ("--root", str(tmp_path), "--user", "root", "--group", "optics", "--yes")
    assert installed(*options).exit_code == 0
    path = tmp_path / "etc/systemd/system/thermostand-simulated-stand.service"
    wanted = {"NoNewPrivileges=yes", "ProtectSystem=full", "PrivateTmp=yes", "CapabilityBoundingSet="}
    assert wanted <= set(path.read_text().splitlines())
    folders = (tmp_path / "etc/tmpfiles.d/thermostand.conf").read_text().splitlines()
    assert {f"d {folder} 2770 root optics -" for folder in (STANDS_FOLDER, SYSTEM_FOLDER)} <= set(folders)
    if systemd := shutil.which("systemd-analyze"):
        checked = subprocess.run([systemd, "verify", str(path)], capture_output=True, text=True, check=False)
        assert [line for line in checked.stderr.splitlines() if path.name in line] == []


def test_a_user_is_a_name(tmp_path: Path):
    assert installed("--root", str(tmp_path), "--user", "a\nExecStart=b", "--yes").exit_code == 2
    assert list(tmp_path.iterdir()) == []
    assert installed("--root", str(tmp_path), "--group", "a b", "--yes").exit_code == 2
