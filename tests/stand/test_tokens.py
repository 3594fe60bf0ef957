"""Tokens for the network: their file, and the commands that write it."""

import stat
from pathlib import Path

import pytest
import yaml
from typer.testing import CliRunner, Result

from thermostand.foundation.errors import ConfigError
from thermostand.stand.commands.token_cli import app
from thermostand.stand.config.interface_section import TokenFile, load_tokens, write_tokens
from thermostand.stand.config.stand_config import find_packaged, load_config

TOKEN = "correct-horse-battery-staple"


@pytest.fixture
def config(tmp_path: Path) -> Path:
    data = yaml.safe_load(find_packaged("", "simulated").read_text())
    data["interface"] = {"secrets": str(tmp_path / "private" / "tokens.yaml"), "hosts": ["stand.example"]}
    path = tmp_path / "stand.yaml"
    path.write_text(yaml.safe_dump(data))
    return path


def invoke(*arguments: object) -> Result:
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


def test_a_token_is_made_listed_known_and_taken_back(config: Path):
    made = invoke("add", "rose", "--config", config)
    token = made.stdout.strip()
    assert (made.exit_code, len(token) >= 40) == (0, True)
    path = load_config(config).interface.secrets
    assert path is not None
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    assert load_tokens(path) == TokenFile(tokens={"rose": token})
    assert "has a token already" in invoke("add", "rose", "--config", config).stderr
    assert invoke("add", "<script>", "--config", config).exit_code == 2
    assert invoke("add", "li.wei@home", "--config", config).exit_code == 0
    assert invoke("add", "wall", "--read-only", "--config", config).exit_code == 0
    assert "has a token already" in invoke("add", "wall", "--config", config).stderr
    assert invoke("add", "ann", "--role", "operate", "--config", config).exit_code == 0
    assert load_tokens(path).list_by_name()["ann"][1] == "operate"
    assert invoke("remove", "ann", "--config", config).exit_code == 0
    unknown = invoke("add", "ann", "--role", "boss", "--config", config)
    assert (unknown.exit_code, "look, operate, commission" in unknown.stderr) == (2, True)
    assert invoke("list", "--config", config).stdout == "li.wei@home  commission\nrose  commission\nwall  look\n"
    removed = invoke("remove", "rose", "--config", config)
    assert (removed.exit_code, "SIGHUP" in removed.stderr) == (0, True)
    assert "has no token" in invoke("remove", "rose", "--config", config).stderr
    assert invoke("remove", "li.wei@home", "--config", config).exit_code == 0
    left = load_tokens(path)
    assert (left.tokens, list(left.read_only)) == ({}, ["wall"])


def test_without_a_file_in_the_configuration_the_error_says_where_to_name_one():
    reported = invoke("add", "rose")
    assert reported.exit_code == 2
    assert "has no interface.secrets" in reported.stderr


@pytest.mark.parametrize(
    "content",
    [
        f"tokens: {{rose: short{TOKEN[:5]}}}",
        f"tokens: [{TOKEN}]",
        f"tokens: {{rose: [{TOKEN}]}}",
        f"- {TOKEN}",
        f"tokens: {{rose: {TOKEN}}}\nread_only: {{rose: {TOKEN}s}}",
        f"tokens: {{rose: {TOKEN}}}\nread_only: {{wall: {TOKEN}}}",
        f"tokens: {{rose: {TOKEN}}}\noperate: {{rose: {TOKEN}s}}",
        f"read_olny: {{wall: {TOKEN}}}",
    ],
)
def test_what_is_wrong_in_the_file_is_reported_without_a_word_of_it(tmp_path: Path, content: str):
    path = tmp_path / "tokens.yaml"
    path.write_text(content)
    path.chmod(0o600)
    with pytest.raises(ConfigError, match="as it should be") as raised:
        load_tokens(path)
    assert TOKEN[:5] not in str(raised.value)


def test_a_file_that_others_may_read_is_refused(tmp_path: Path):
    path = tmp_path / "tokens.yaml"
    write_tokens(path, TokenFile(tokens={"rose": TOKEN}))
    assert load_tokens(path) == TokenFile(tokens={"rose": TOKEN})
    path.chmod(0o640)
    with pytest.raises(ConfigError, match="others may read"):
        load_tokens(path)
