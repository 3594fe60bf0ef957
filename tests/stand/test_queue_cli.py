"""The `stand queue` commands, against a desk in this process."""

import asyncio
import json
from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from tests.stand.fake_service import FakeService, serve_fake
from thermostand.stand.commands.queue_cli import app
from thermostand.stand.serving.api_models import QueuedRun, StandState


class Halted(FakeService):
    """Its last run has failed."""

    def state(self) -> StandState:
        return super().state().model_copy(update={"queue_halted": "run 1: too\nwarm"})


async def invoke(out: Path, *arguments: object) -> Result:
    return await asyncio.to_thread(CliRunner().invoke, app, [*map(str, arguments), str(out)])


async def test_runs_are_added_listed_moved_and_removed(tmp_path: Path):
    recipe = tmp_path / "cycle.yaml"
    recipe.write_text("name: night\n")
    async with serve_fake(FakeService(), tmp_path) as desk:
        assert (await invoke(tmp_path, "add", "demo")).stdout == "1\n"
        assert (await invoke(tmp_path, "add", recipe, "--tag", "lens-a", "--note", "new lens")).stdout == "2\n"
        recipe.unlink()  # what is queued is what the file was
        lines = (await invoke(tmp_path, "list")).stdout.splitlines()
        assert lines[0].split() == ["id", "next", "recipe", "state", "added", "(local)", "took", "session", "reason"]
        assert [line.split()[:4] for line in lines[1:]] == [
            ["1", "1", "demo", "waiting"],
            ["2", "2", "written", "waiting"],
        ]
        reported = json.loads((await invoke(tmp_path, "list", "--json")).stdout)
        assert reported["halted"] == ""
        assert [(run["id"], run["recipe"], run["state"]) for run in reported["runs"]] == [
            (1, "demo", "waiting"),
            (2, "written", "waiting"),
        ]
        assert (await invoke(tmp_path, "move", 2, 1)).exit_code == 0
        assert (await invoke(tmp_path, "remove", 1)).exit_code == 0
        missing = await invoke(tmp_path, "remove", 7)
    assert [(verb, arguments) for _, verb, arguments in desk.orders] == [
        ("submit", {"recipe": "demo"}),
        ("submit", {"recipe_text": "name: night\n", "tags": ["lens-a"], "note": "new lens"}),
        ("move", {"run": 2, "to": 1}),
        ("cancel", {"run": 1}),
    ]
    assert (missing.exit_code, "no run 7" in missing.stderr) == (1, True)


async def test_what_has_ended_and_why_nothing_is_begun_are_listed(tmp_path: Path):
    desk, took_ns = Halted(), 7_500_000_000_000
    ended = {"state": "failed", "began_ns": 0, "ended_ns": took_ns, "reason": "too\nwarm"}
    desk.queue = [QueuedRun(id=1, recipe="demo", added_ns=0, **ended)]
    async with serve_fake(desk, tmp_path):
        result = await invoke(tmp_path, "list")
    assert "2:05:00" in result.stdout
    assert result.stdout.rstrip().endswith("too\\nwarm")
    assert result.stderr.startswith("halted by run 1: too\\nwarm; ")


@pytest.mark.parametrize("arguments", [("move", "one", 1), ("move", 1), ("add",)])
async def test_a_mistake_is_reported_in_one_line_and_orders_nothing(tmp_path: Path, arguments: tuple[object, ...]):
    async with serve_fake(FakeService(), tmp_path) as desk:
        result = await asyncio.to_thread(CliRunner().invoke, app, list(map(str, arguments)))
    assert (result.exit_code, len(result.stderr.splitlines()), desk.orders) == (2, 1, [])


async def test_an_empty_queue_has_nothing_to_list(tmp_path: Path):
    async with serve_fake(FakeService(), tmp_path):
        result = await invoke(tmp_path, "list")
        assert (result.exit_code, result.stdout, result.stderr) == (0, "", f"{tmp_path}: nothing is queued there\n")
        assert json.loads((await invoke(tmp_path, "list", "--json")).stdout) == {"halted": "", "runs": []}


async def test_without_a_daemon_nothing_is_queued(tmp_path: Path):
    result = await invoke(tmp_path, "add", "demo")
    assert (result.exit_code, list(tmp_path.iterdir())) == (1, [])
