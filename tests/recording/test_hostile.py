"""Sessions and files from somebody else: every command answers soon, with a sentence and never a traceback."""

from __future__ import annotations

import asyncio
import csv
import os
import shutil
import signal
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from typer.testing import CliRunner

from tests.recording.full_session import record
from tests.recording.runs import SECONDS, entries, second, write_journal
from thermostand.foundation.documents import parse_yaml
from thermostand.foundation.errors import ConfigError
from thermostand.recording.exporting.tables import Column, CsvTable
from thermostand.recording.repair.salvage import salvage_unfinished
from thermostand.stand.commands.sessions.session_commands import app
from thermostand.stand.config.stand_config import find_packaged, load_config
from thermostand.stand.estimating.learned_durations import learn_durations

LONGEST_S = 60  # for 10 s of a machine that has nothing else to do


@pytest.fixture(autouse=True)
def _not_for_ever() -> Iterator[None]:
    """What hangs is interrupted, and so fails."""

    def interrupt(number: int, frame: object) -> None:
        raise AssertionError(f"no answer within {LONGEST_S} s")

    before = signal.signal(signal.SIGALRM, interrupt)
    signal.alarm(LONGEST_S)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A short run of the installed stand."""
    folder = tmp_path_factory.mktemp("recorded") / "cycle"
    config_text = find_packaged("", "simulated").read_text("utf-8")
    asyncio.run(record(folder, SECONDS, second, segment_s=60.0, attachments={"config.yaml": config_text}))
    write_journal(folder, *entries())
    return folder


@pytest.fixture
def session(recorded: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(recorded, tmp_path / "sessions" / recorded.name))


HOSTILE: dict[str, Callable[[Path], object]] = {
    "a pipe as telemetry": lambda session: os.mkfifo(session / "telemetry" / "0001.mcap"),
    "a pipe as a frame": lambda session: os.mkfifo(session / "frames" / "0001.mcap"),
    "a pipe as an unfinished segment": lambda session: os.mkfifo(session / "telemetry" / "0001.mcap.part"),
    "a pipe as a copy": lambda session: os.mkfifo(session / "telemetry" / "0001.mcap.tmp"),
    "a folder as telemetry": lambda session: (session / "telemetry" / "0001.mcap").mkdir(),
    "a folder as an unfinished segment": lambda session: (session / "frames" / "0001.mcap.part").mkdir(),
    "a device as telemetry": lambda session: (session / "telemetry" / "0001.mcap").symlink_to("/dev/zero"),
    "an endless link": lambda session: (session / "telemetry" / "0001.mcap").symlink_to("0001.mcap"),
}


@pytest.mark.parametrize("hostile", HOSTILE)
def test_every_command_answers_on_what_is_no_file(session: Path, hostile: str, tmp_path: Path):
    HOSTILE[hostile](session)
    commands = (
        ["list", session.parent],
        ["info", session],
        ["verify", session],
        ["replay", session, "--speed", "max", "--record", tmp_path / "replayed"],
        ["export", session, "--out", tmp_path / "exported"],
        ["trim", session, "--from", "step:1", "--to", "+1h", "--out", tmp_path / "trimmed"],
        ["repair", session],
    )
    for command in commands:
        result = CliRunner().invoke(app, [str(word) for word in command])
        assert result.exception is None or isinstance(result.exception, SystemExit), (command, result.exc_info)
        assert result.exit_code in (0, 1, 2), (command, result.output)
        assert "Traceback" not in result.output


def test_a_run_is_not_held_up_by_other_files_among_its_sessions(session: Path):
    """What `stand run` does before it begins, on pipes under the names of unfinished segments."""
    for name in ("0007.mcap.part", "0008.mcap.tmp"):
        os.mkfifo(session / "telemetry" / name)
    assert salvage_unfinished(session.parent) == []


@pytest.mark.parametrize(
    "text",
    [
        "name: 2026-99-99\n",
        "name: " + "[\n" * 100_000,
        "a: &a [1,1,1,1,1,1,1,1,1,1]\n"
        + "".join(f"{n}: &{n} [{','.join([f'*{p}'] * 10)}]\n" for p, n in zip("abcdefgh", "bcdefghi", strict=True)),
        "name: !!python/object:os.system x\n",
        "\x00",
    ],
    ids=["no date", "deep", "aliases", "tag", "nul"],
)
def test_an_odd_neighbour_never_ends_a_run(session: Path, text: str, monkeypatch: pytest.MonkeyPatch):
    """Its attached configuration is what somebody made it."""
    monkeypatch.setattr("thermostand.recording.reading.session.Session.attachment", lambda self, name: text)
    config = load_config(find_packaged("", "simulated"))
    learn_durations(session.parent, config)


def test_a_neighbour_that_breaks_the_reader_never_ends_a_run(session: Path, monkeypatch: pytest.MonkeyPatch):
    def broken(self: object) -> object:
        raise RuntimeError("a mistake of the program")

    monkeypatch.setattr("thermostand.recording.reading.session.Session.steps", broken)
    learn_durations(session.parent, load_config(find_packaged("", "simulated")))


def merges(depth: int) -> str:
    """Each mapping merges ten times the one before it."""
    lines = ["a0: &a0 {x: 1}"]
    lines += [f"a{n}: &a{n} {{<<: [{', '.join([f'*a{n - 1}'] * 10)}]}}" for n in range(1, depth)]
    return "\n".join(lines)


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        (merges(12), "aliases stand for more than 100000 values"),
        ("a: &a [*a]", "nested too deeply|aliases stand for|not YAML"),
        ("x: " + "a" * 300_000, "has 300003 characters; a file of this kind has at most 250000"),
    ],
    ids=["merge keys", "itself", "long"],
)
def test_a_document_that_stands_for_millions_of_values_is_refused(text: str, reason: str):
    with pytest.raises(ConfigError, match=rf"^hostile\.yaml: .*({reason})"):
        parse_yaml(text, "hostile.yaml")


def test_a_document_of_thousands_of_keys_is_refused_in_a_short_line(tmp_path: Path):
    path = tmp_path / "keys.yaml"
    path.write_text("\n".join(f"k{n}: 1" for n in range(20_000)))
    with pytest.raises(ConfigError, match=r"and [0-9]+ more$") as refused:
        load_config(path)
    assert len(str(refused.value)) < 5_000


@pytest.mark.parametrize(
    ("text", "cell"),
    [
        ("=cmd|'/C calc'!A0", "'=cmd|'/C calc'!A0"),
        ("  +1", "'  +1"),
        ("@SUM(A1)", "'@SUM(A1)"),
        ("-2+3", "'-2+3"),
        ("\t=1", "' =1"),
        ("\x1b[2Jgone", "[2Jgone"),
        ("two\nlines", "two lines"),
        ("\u202egpj.exe", "gpj.exe"),
        ("a - b = c", "a - b = c"),
        ("20 degC, ok", "20 degC, ok"),
    ],
)
def test_a_text_in_a_table_is_no_formula_and_has_no_control_characters(tmp_path: Path, text: str, cell: str):
    table = CsvTable(tmp_path / "t.csv", (Column("text", "text"), Column("value", "value")))
    table.add((text, -1.5))
    table.close()
    with (tmp_path / "t.csv").open(encoding="utf-8", newline="") as file:
        assert list(csv.reader(file)) == [["text", "value"], [cell, "-1.5"]]
