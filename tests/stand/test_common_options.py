"""The options that every command of both programs has, and that completion finds commands without importing them."""

from __future__ import annotations

import importlib.metadata
import json
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from typer.main import get_command
from typer.testing import CliRunner

from thermostand.compensation.cli import app as compensate
from thermostand.foundation.command_app import App
from thermostand.foundation.errors import ConfigError
from thermostand.foundation.exit_codes import BAD_INPUT, exit_on_error
from thermostand.foundation.output import get_output, say, show
from thermostand.foundation.version import read_version
from thermostand.stand.commands.command_table import app as stand

PROGRAMS = {"stand": stand, "compensate": compensate}


def commands_of(name: str, group: Any) -> Iterator[tuple[str, Any]]:
    """Every command below a group, by what is typed."""
    context = group.make_context(name, [], resilient_parsing=True)
    for word in group.list_commands(context):
        _, found, _ = group.resolve_command(context, [word])
        if hasattr(found, "list_commands"):
            yield from commands_of(f"{name} {word}", found)
        else:
            yield f"{name} {word}", found


EACH = [each for name, app in PROGRAMS.items() for each in commands_of(name, get_command(app))]


@pytest.mark.parametrize(("typed", "command"), EACH, ids=[typed for typed, _ in EACH])
def test_each_command_has_the_common_options(typed: str, command: Any):
    words = {word for parameter in command.params for word in parameter.opts}
    assert {"-q", "--quiet", "-v", "--verbose", "--version", "--json"} <= words


def test_the_list_of_commands_is_whole():
    typed = {typed for typed, _ in EACH}
    assert len(typed) > 40
    assert typed >= {"stand run", "stand session list", "stand queue add", "compensate fit", "stand serve"}


def test_the_version_is_that_of_the_installed_distribution():
    assert read_version() == importlib.metadata.version("thermostand")


app = App()


@app.command()
def go(fail: bool = False) -> None:
    """Example: go."""
    with exit_on_error():
        say("on the way")
        if fail:
            raise ConfigError("it is wrong")
        show({"value": float("nan"), "verbose": get_output().verbose}, ["as people read it"])


def test_the_result_goes_to_standard_output_and_all_else_elsewhere():
    plain = CliRunner().invoke(app, [])
    assert (plain.stdout, plain.stderr) == ("as people read it\n", "on the way\n")
    asked = CliRunner().invoke(app, ["-q", "-v", "--json"])
    assert (json.loads(asked.stdout), asked.stderr) == ({"value": None, "verbose": True}, "")
    assert "thermostand" in CliRunner().invoke(app, ["--version"]).stdout


def test_an_error_is_a_line_and_with_v_says_where_it_came_from():
    quiet = CliRunner().invoke(app, ["--fail", "-q"])
    assert (quiet.exit_code, quiet.stderr) == (2, "error: it is wrong\n")
    verbose = CliRunner().invoke(app, ["--fail", "-v"])
    assert "Traceback" in verbose.stderr
    assert verbose.stderr.endswith("error: it is wrong\n")


@pytest.mark.parametrize(
    ("program", "words", "found"),
    [
        ("stand", "stand ses", "session"),
        ("stand", "stand session li", "list"),
        ("stand", "stand run --virt", "--virtual-time"),
        ("compensate", "compensate dat", "datasheet"),
    ],
)
def test_the_shell_completes_commands_and_options(program: str, words: str, found: str):
    module = {"stand": "thermostand.stand.cli", "compensate": "thermostand.compensation.cli"}[program]
    code = f"import sys; sys.argv[0] = {program!r}; from {module} import app; app()"
    environment = {
        **os.environ,
        f"_{program.upper()}_COMPLETE": "complete_bash",
        "COMP_WORDS": words,
        "COMP_CWORD": str(len(words.split()) - 1),
        "PYTHONPATH": os.pathsep.join(sys.path),
    }
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=False)
    assert done.stdout.split() == [found], done.stderr


@pytest.mark.parametrize(
    ("program", "words", "status"),
    [
        ("stand", "plan no-such-recipe --json", 2),
        ("stand", "--json plan no-such-recipe", 2),
        ("stand", "session info no-such-session --json", 2),
        ("stand", "session --json nothing", 2),
        ("stand", "plan --json --no-such-option", 2),
        ("stand", "queue add --json", 2),
        ("stand", "status . --json", 1),
        ("stand", "no-such-command --json", 2),
        ("compensate", "fit no-such-session -o x.json --json", 2),
        ("compensate", "apply --json", 2),
        ("compensate", "calibrate-photographs no.png --target paper-9x6 --export . --json", 2),
    ],
)
def test_an_error_is_json_where_that_was_asked_for(program: str, words: str, status: int, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    asked = CliRunner().invoke(PROGRAMS[program], words.split())
    found = json.loads(asked.stdout)
    assert (asked.exit_code, found["exit_status"]) == (status, status)
    assert asked.stderr == f"error: {found['error']}\n"
    plain = CliRunner().invoke(PROGRAMS[program], words.replace("--json", "").split())
    assert (plain.exit_code, plain.stdout) == (status, "")


# What each command is reported besides the session that is not there.
ORDER = Path(__file__).parents[2] / "configs" / "orders" / "example.yaml"
OF_A_SESSION = {
    "stand resume": "",
    **{f"stand {verb}": "" for verb in ("status", "watch", "foxglove", "pause", "continue", "reset", "stop")},
    **{f"stand {verb}": "" for verb in ("session list", "session info", "session verify", "session repair")},
    "stand session replay": "",
    "stand session note": "a note",
    "stand session tag": "a-tag",
    "stand session export": "-o out",
    "stand session trim": "-o out --from +0 --to +1",
    "compensate fit": "-o m.json",
    "compensate report": "-o r.html",
    "compensate datasheet": "-o d.html",
    "compensate certificate": f"--order {ORDER} -o d.html",
    "compensate calibrate": "-o c.json",
    "compensate detect": "-o c.csv",
    "compensate validate": "-o v.html --camera nowhere --model nowhere",
    "compensate budget": "",
    "compensate apply": "nowhere -o p.csv",
    "compensate rereference": "nowhere -o b.json",
}


@pytest.mark.parametrize(("typed", "more"), OF_A_SESSION.items(), ids=list(OF_A_SESSION))
def test_a_missing_session_has_one_status_in_both_programs(typed: str, more: str, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    program, *words = typed.split()
    asked = CliRunner().invoke(PROGRAMS[program], [*words, "nowhere", *more.split()])
    assert (asked.exit_code, asked.stdout) == (BAD_INPUT, ""), asked.output
    assert asked.stderr.startswith("error: nowhere: "), asked.stderr
    assert not list(tmp_path.iterdir())


def test_every_command_of_a_session_is_in_that_table():
    named = {"session", "sessions", "directory", "sources"}
    found = {typed for typed, command in EACH if named & {each.name for each in command.params[:1]}}
    assert found - OF_A_SESSION.keys() == {
        "stand init",
        "stand session archive",
        "stand token login",
        "stand queue list",
    }
