"""Commands are listed without being imported; each is where its line says."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from typer.main import get_command
from typer.testing import CliRunner

from thermostand.compensation.cli import app as compensate
from thermostand.foundation.usage import LazyCommand, make_lazy_app
from thermostand.stand.commands.command_table import app as stand

APPS = {"stand": stand, "compensate": compensate}
EACH = [(name, command) for name, app in APPS.items() for command in get_command(app).commands]


@pytest.mark.parametrize(("name", "command"), EACH)
def test_each_command_of_the_list_exists(name: str, command: str):
    shown = CliRunner().invoke(APPS[name], [command, "--help"], prog_name=name)
    assert shown.exit_code == 0
    assert f"Usage: {name} {command} " in shown.output
    assert "Example: " in shown.output or command in ("continue", "reset", "stop", "simulate")


def test_the_list_says_what_each_does():
    shown = CliRunner().invoke(stand, ["--help"])
    assert "session   Recorded sessions" in shown.output
    assert {("stand", "run"), ("stand", "devices"), ("compensate", "fit"), ("compensate", "datasheet")} <= set(EACH)


def test_ctrl_c_while_a_command_is_imported_ends_with_a_line(tmp_path: Path):
    (tmp_path / "slow.py").write_text(
        "import signal\nprint('importing', flush=True)\nwhile True:\n    signal.pause()\n"
    )
    code = "from thermostand.foundation.usage import *; make_lazy_app('x', {'go': LazyCommand('slow', 'go')})(['go'])"
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(tmp_path), *sys.path])}
    with subprocess.Popen(
        [sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment
    ) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        assert process.stdout.readline() == "importing\n"
        process.send_signal(signal.SIGINT)
        assert process.wait(30) == 130
        assert process.stderr.read() == "interrupted; nothing was started\n"


def test_an_unknown_command_is_reported_with_the_nearest_one():
    app = make_lazy_app("x", {"go": LazyCommand("nowhere", "go")})
    result = CliRunner().invoke(app, ["goo"])
    assert (result.exit_code, "Did you mean 'go'?" in result.stderr) == (2, True)


@pytest.mark.parametrize(("reported", "used"), [(None, "1"), ("3", "3")])
def test_a_command_computes_with_one_thread_unless_the_environment_says_otherwise(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, reported: str | None, used: str
):
    (tmp_path / f"shows_{used}.py").write_text(
        "import os, typer\napp = typer.Typer()\nthreads = os.environ['OPENBLAS_NUM_THREADS']\n"
        "@app.command()\ndef go() -> None:\n    print('threads:', threads)\n"
    )
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setenv("OPENBLAS_NUM_THREADS", reported or "")  # pytest puts back what was there
    if reported is None:
        monkeypatch.delenv("OPENBLAS_NUM_THREADS")
    result = CliRunner().invoke(make_lazy_app("x", {"go": LazyCommand(f"shows_{used}", "go")}), ["go"])
    assert result.output == f"threads: {used}\n"
