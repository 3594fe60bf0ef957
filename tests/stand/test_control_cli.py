"""The commands for a run that is under way, against a daemon in this process."""

import asyncio
import json
import os
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import yaml
from typer.testing import CliRunner, Result

from tests.daemon_queries import ask
from tests.host import Host
from tests.stand.fake_service import STATUS, FakeService, serve_fake
from thermostand.foundation.clock import NS_PER_S
from thermostand.foundation.hub import Hub
from thermostand.foundation.items import Event
from thermostand.stand.commands.command_table import app as stand
from thermostand.stand.commands.control_cli import format_status_lines
from thermostand.stand.config.stand_config import find_packaged
from thermostand.stand.estimating.run_estimate import PlanEstimate
from thermostand.stand.running.memory.state import RunState
from thermostand.stand.running.opening.stop import Stop
from thermostand.stand.running.status import StatusBoard
from thermostand.stand.safety.gate import Gate
from thermostand.stand.safety.latch import Latch
from thermostand.stand.serving.api.access import get_user_name
from thermostand.stand.serving.api_models import FaultState, NotConfirmed, RunStatus

runner = CliRunner()


async def invoke(*arguments: str | Path) -> Result:
    return await asyncio.to_thread(runner.invoke, stand, [str(argument) for argument in arguments])


def session(root: Path, name: str) -> Path:
    path = root / name
    path.mkdir()
    return path


async def test_status_tells_all_of_the_run_in_lines_and_as_json(tmp_path: Path):
    path = session(tmp_path, "cycle")
    async with serve_fake(FakeService(run=STATUS), path):
        lines = (await invoke("status", tmp_path)).stdout.splitlines()
        reported = json.loads((await invoke("status", path, "--json")).stdout)
    *lines, archive_line, pause_line = lines
    assert (archive_line[:5], "`stand session archive`" in archive_line) == ("next ", True)
    assert (pause_line[:5], "`stand continue`" in pause_line) == ("next ", True)
    assert lines == [
        f"session       {path}",
        "recipe        thermal-cycle",
        "state         held: disk_low, operator, since 2026-01-01 17:59:00 UTC (0:01:00)",
        "step          12/87 soak duration_s=2700",
        "ends          2026-01-01 19:00:00 UTC (in 1:00:00)",
        "temperatures  thermometers.air 23.98 degC",
        "temperatures  camera.temperature BAD",
        "frames        120 saved, 1 lost",
        "disk          12.3 GB free",
        "last warning  a line\\nand another",
    ]
    assert RunStatus.model_validate(reported) == STATUS.model_copy(update={"session": str(path)})


@pytest.mark.parametrize("run", [STATUS, None])
async def test_status_begins_with_what_is_not_confirmed_safe(tmp_path: Path, run: RunStatus | None):
    path, failure = session(tmp_path, "cycle"), "relays did not confirm its safe state: relays: no answer"
    async with serve_fake(FakeService(run=run), path) as desk:
        desk.not_confirmed = (NotConfirmed(name="relays", since_ns=STATUS.since_ns, reason=failure, timer_s=15.0),)
        lines = (await invoke("status", path)).stdout.splitlines()
        desk.not_confirmed = ()
        assert "not safe" not in (await invoke("status", path)).stdout
    assert lines[0].startswith(f"not safe yet  since 2026-01-01 17:59:00 UTC: {failure}; ")
    assert (lines[1][:14], "15 s" in lines[1]) == ("not safe yet  ", True)


def test_status_tells_utc_when_the_system_clock_was_stepped_after_the_present_state_began():
    hour_ns = 3600 * NS_PER_S
    stepped = STATUS.model_copy(
        update={"utc_offset_ns": hour_ns, "warning_ns": STATUS.since_ns, "warning_utc_offset_ns": -hour_ns}
    )
    lines = [line for line in format_status_lines(Path("cycle"), stepped) if " UTC" in line]
    assert lines == [
        "state         held: disk_low, operator, since 2026-01-01 17:59:00 UTC (0:01:00)",
        "ends          2026-01-01 20:00:00 UTC (in 1:00:00)",
        "last warning  2026-01-01 16:59:00 UTC: a line\\nand another",
    ]


def test_the_board_keeps_the_offset_to_utc_that_held_when_its_state_began_and_its_warning_came():
    host, gate = Host(), Gate()
    clock = host.clock()
    recorder: Any = SimpleNamespace(saved=SimpleNamespace(frames=0, frames_lost=0), disk_free_bytes=0)
    board = StatusBoard(
        "cycle", PlanEstimate(()), RunState(()), gate, Stop(), Latch(gate, Hub(), clock), recorder=recorder, clock=clock
    )
    host.step(3600)
    board(Event(clock.now_ns(), "warning", "odd", "it is so"))
    host.step(-60)
    reported = board.status()
    offsets_ns = (reported.since_utc_offset_ns, reported.warning_utc_offset_ns, reported.utc_offset_ns)
    assert offsets_ns == (0, 3600 * NS_PER_S, 3540 * NS_PER_S)


def test_the_board_says_that_a_camera_soaks_again_and_for_how_long():
    recorder: Any = SimpleNamespace(saved=SimpleNamespace(frames=0, frames_lost=0), disk_free_bytes=0)
    soaked: list[float | None] = [720.0, None]
    clock, gate = Host().clock(), Gate()
    board = StatusBoard(
        "cycle",
        PlanEstimate(()),
        RunState(()),
        gate,
        Stop(),
        Latch(gate, Hub(), clock),
        recorder=recorder,
        clock=clock,
        soaked_again_s=lambda: soaked.pop(0),
    )
    assert "for 12 min" in board.status().doing
    assert board.status().doing == ""


async def test_each_command_does_its_own_and_says_what_still_holds_the_run(tmp_path: Path):
    path = session(tmp_path, "cycle")
    async with serve_fake(FakeService("interlock", run=STATUS), path) as desk:
        assert "paused" in (await invoke("pause", tmp_path)).stdout
        assert desk.gate.reasons == {"operator", "interlock"}
        held = (await invoke("continue", tmp_path)).stdout
        assert "still held: interlock" in held
        assert (await invoke("reset", tmp_path)).stdout.startswith(f"{path}: reset; ")
        nothing = await invoke("reset", tmp_path)
        assert nothing.exit_code == 1
        assert "nothing to reset" in nothing.stderr
        desk.gate.hold("interlock")
        desk.tripped = FaultState(rule="stage_alarm", text="the stage is in alarm", since_ns=0)
        again = await invoke("reset", tmp_path)
        assert "held again: stage_alarm" in again.stdout
        assert "step under way" in (await invoke("pause", tmp_path, "--at-next-step")).stdout
        assert (await invoke("skip", "1", tmp_path)).stdout == f"{path}: step 1 is left out\n"
        assert (await invoke("extend", "0-soak", "30", tmp_path)).stdout == f"{path}: step 0-soak takes 30 min longer\n"
        assert (await invoke("skip", "7", tmp_path)).exit_code == 1
        assert json.loads((await invoke("stop", path, "--json")).stdout)["verb"] == "stop"
    orders = [(verb, arguments) for _, verb, arguments in desk.orders]
    assert orders == [
        ("pause", {"when": "now"}),
        ("continue", {}),
        ("reset", {}),
        ("reset", {}),
        ("pause", {"when": "step"}),
        ("skip", {"step_id": "1"}),
        ("extend", {"step_id": "0-soak", "by_s": 1800.0}),
        ("stop", {}),
    ]
    assert {(who.name, who.how) for who, _, _ in desk.orders} == {(get_user_name(os.geteuid()), "socket")}


async def test_the_plan_and_what_happens_are_shown(tmp_path: Path):
    path = session(tmp_path, "cycle")
    async with serve_fake(FakeService(run=STATUS), path):
        assert (await invoke("status", path, "--plan")).stdout == "    1  waiting     soak\n"


@pytest.mark.parametrize(
    ("moving", "sentence"), [(("linear to 250 mm", "flap opening"), "still moving"), ((), "paused")]
)
async def test_a_pause_says_what_still_moves(tmp_path: Path, moving: tuple[str, ...], sentence: str):
    path, desk = session(tmp_path, "cycle"), FakeService(run=STATUS)
    desk.moving = moving
    async with serve_fake(desk, path):
        text = (await invoke("pause", tmp_path)).stdout
        assert sentence in text
        assert all(each in text for each in moving)
        assert (await asyncio.to_thread(ask, path, "pause"))["moving"] == list(moving)


async def test_without_a_name_the_only_running_session_is_meant(tmp_path: Path):
    first, second = session(tmp_path, "first"), session(tmp_path, "second")
    nobody = await invoke("status", tmp_path)
    assert nobody.exit_code == 1
    assert f"(looked in {tmp_path})" in nobody.stderr  # behind it: a stand that this computer runs elsewhere
    async with serve_fake(FakeService(run=STATUS), second):
        assert str(second) in (await invoke("status", tmp_path)).stdout
        async with serve_fake(FakeService(run=STATUS), first):
            both = await invoke("pause", tmp_path)
    assert both.exit_code == 2
    assert both.stderr.endswith(f": {first}, {second}\n")


async def test_the_recording_directory_of_the_configuration_is_searched(tmp_path: Path):
    data = yaml.safe_load(find_packaged("", "simulated").read_text())
    data["recording"] = {"directory": str(tmp_path / "recordings")}
    config = tmp_path / "stand.yaml"
    config.write_text(yaml.safe_dump(data))
    (tmp_path / "recordings").mkdir()
    path = session(tmp_path / "recordings", "cycle")
    async with serve_fake(FakeService(run=STATUS), path):
        found = await invoke("status", "--config", config)
    assert str(path) in found.stdout


async def test_a_session_that_has_ended_is_reported_as_ended(tmp_path: Path):
    path = session(tmp_path, "cycle")
    (path / "telemetry").mkdir()
    (path / "telemetry" / "0001.mcap").touch()
    result = await invoke("stop", path)
    assert result.exit_code == 1
    assert result.stderr.startswith(f"error: {path}: ")
