"""The `stand queue` commands on real files; no run is begun."""

import asyncio
import json
from pathlib import Path
from types import SimpleNamespace

import pytest
from typer.testing import CliRunner, Result

from tests.stand.a_desk import ADesk, served
from thermostand.stand.commands.queue_cli import app
from thermostand.stand.queueing import queue
from thermostand.stand.queueing.queue_file import QUEUE_NAME, State, working

runner = CliRunner()


def invoke(out: Path, *arguments: object) -> Result:
    return runner.invoke(app, [*map(str, arguments), "--out", str(out)])


@pytest.mark.parametrize("command", ["add", "list", "move", "remove", "start"])
def test_every_queue_command_explains_itself_with_an_example(command: str):
    result = runner.invoke(app, [command, "--help"])
    assert result.exit_code == 0
    assert "Example: stand queue" in result.output


def test_runs_are_added_listed_moved_and_removed(tmp_path: Path):
    for number, recipe in enumerate(("warm-up", "demo", "warm-up"), 1):
        assert invoke(tmp_path, "add", recipe).stdout == f"{number}\n"
    assert invoke(tmp_path, "move", 3, 1).exit_code == 0
    assert invoke(tmp_path, "remove", 1).exit_code == 0
    lines = invoke(tmp_path, "list").stdout.splitlines()
    assert lines[0].split() == ["id", "next", "recipe", "state", "added", "(local)", "took", "session", "reason"]
    assert [line.split()[:4] for line in lines[1:]] == [
        ["3", "1", "warm-up", "waiting"],
        ["2", "2", "demo", "waiting"],
    ]
    reported = json.loads(invoke(tmp_path, "list", "--json").stdout)
    assert reported["halted"] == ""
    assert [(run["id"], run["recipe"], run["state"]) for run in reported["runs"]] == [
        (3, "warm-up", "waiting"),
        (2, "demo", "waiting"),
    ]


def test_what_has_ended_and_why_nothing_is_begun_are_listed(tmp_path: Path):
    invoke(tmp_path, "add", "demo")
    with working(tmp_path):
        queue.take(tmp_path, 0)
        queue.finish(tmp_path, 1, State.FAILED, 7_500_000_000_000, "too\nwarm", halt=True)
    result = invoke(tmp_path, "list")
    assert "2:05:00" in result.stdout
    assert result.stdout.rstrip().endswith("too\\nwarm")
    assert result.stderr == "halted by run 1: too\\nwarm; remove the cause, then `stand queue start --clear`\n"
    invoke(tmp_path, "add", "demo")
    refused = invoke(tmp_path, "start", "--virtual-time")
    assert refused.exit_code == 1
    assert "the queue was halted: run 1" in refused.stderr
    invoke(tmp_path, "remove", 2)
    assert invoke(tmp_path, "start", "--clear").exit_code == 0
    assert invoke(tmp_path, "list").stderr == ""


@pytest.mark.parametrize(
    ("arguments", "status", "sentence"),
    [
        (["add", "no-such-recipe"], 2, "no-such-recipe: no such file"),
        (["add", "demo", "--config", "nowhere"], 2, "nowhere: no such file"),
        (["move", "9", "1"], 1, "no run 9 in the queue; `stand queue list` shows those there are"),
        (["move", "1", "0"], 1, "position 0: the next run has position 1"),
        (["move", "one", "1"], 2, "Invalid value for 'ID'"),
        (["remove", "9"], 1, "no run 9 in the queue"),
    ],
)
def test_a_mistake_is_reported_in_one_sentence_and_changes_nothing(
    tmp_path: Path, arguments: list[str], status: int, sentence: str
):
    invoke(tmp_path, "add", "demo")
    before = (tmp_path / QUEUE_NAME).read_bytes()
    result = invoke(tmp_path, *arguments)
    assert result.exit_code == status
    assert sentence in result.stderr
    assert len(result.stderr.splitlines()) == 1
    assert (tmp_path / QUEUE_NAME).read_bytes() == before


def test_an_empty_queue_has_nothing_to_list_or_start(tmp_path: Path):
    for command in ("list", "start"):
        result = invoke(tmp_path, command)
        assert result.exit_code == 0
        assert (result.stdout, result.stderr) == ("", f"{tmp_path}: nothing is queued there\n")
        assert json.loads(invoke(tmp_path, command, "--json").stdout) == {"halted": "", "runs": []}
    assert list(tmp_path.iterdir()) == []


def test_a_damaged_queue_is_reported_not_shown(tmp_path: Path):
    invoke(tmp_path, "add", "demo")
    (tmp_path / QUEUE_NAME).write_text("{")
    result = invoke(tmp_path, "list")
    assert result.exit_code == 1
    assert "queue.json: is damaged" in result.stderr


def test_a_folder_that_is_not_there_is_named(tmp_path: Path):
    refused = invoke(tmp_path / "nowhere", "move", 1, 1)
    assert refused.exit_code == 2
    assert refused.stderr == f"error: {tmp_path / 'nowhere'}: no such folder; `stand queue add` makes it\n"


async def test_a_queue_that_a_daemon_has_is_reached_through_it(tmp_path: Path):
    async with served(ADesk(), tmp_path) as desk:

        async def through(*arguments: object) -> Result:
            return await asyncio.to_thread(invoke, tmp_path, *arguments)

        assert (await through("add", "demo")).stdout == "1\n"
        assert (await through("add", "warm-up")).stdout == "2\n"
        lines = (await through("list")).stdout.splitlines()
        assert [line.split()[:4] for line in lines[1:]] == [
            ["1", "1", "demo", "waiting"],
            ["2", "2", "warm-up", "waiting"],
        ]
        assert (await through("move", 2, 1)).exit_code == 0
        assert (await through("remove", 1)).exit_code == 0
        missing = await through("remove", 7)
    assert [(verb, arguments) for _, verb, arguments in desk.orders][2:] == [
        ("move", {"run": 2, "to": 1}),
        ("cancel", {"run": 1}),
    ]
    assert (missing.exit_code, "no run 7" in missing.stderr) == (1, True)
    assert not (tmp_path / QUEUE_NAME).exists()


def test_a_night_that_the_disk_has_no_room_for_is_not_queued(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(
        "thermostand.stand.estimating.run_estimate.shutil.disk_usage", lambda _: SimpleNamespace(free=1_000_000)
    )
    refused = invoke(tmp_path, "add", "demo")
    assert (refused.exit_code, "GB are free" in refused.stderr) == (1, True)
    assert not (tmp_path / QUEUE_NAME).exists()
