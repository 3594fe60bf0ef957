import json
import os
import re
import shutil
import signal
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
import yaml
from typer.testing import CliRunner

from tests import fork_server
from tests.addresses import move_to_free
from thermostand.stand.commands.command_table import app
from thermostand.stand.config.stand_config import find_packaged
from thermostand.stand.estimating.estimate import price_plan
from thermostand.stand.estimating.run_estimate import explain_small_disk
from thermostand.stand.running.order import load_order

runner = CliRunner()


@pytest.mark.parametrize("command", ["demo", "simulate", "plan", "run"])
def test_every_command_explains_itself_with_an_example(command: str):
    result = runner.invoke(app, [command, "--help"])
    assert result.exit_code == 0
    assert "Example: stand" in result.output


def test_plan_lists_steps_and_totals():
    result = runner.invoke(app, ["plan", "thermal-cycle"])
    assert result.exit_code == 0
    assert "set_temperature chamber_degC=31.0" in " ".join(result.output.split())
    assert "started now" in result.output
    assert "image from 50 mpx" in result.output


def test_the_json_plan_adds_up():
    result = runner.invoke(app, ["plan", "warm-up", "--json"])
    plan = json.loads(result.stdout)
    assert plan["frames"] == 2 * 3600  # upright and rolled
    assert plan["duration_s"] == pytest.approx(sum(step["duration_s"] for step in plan["steps"]))
    assert plan["duration_s"] == pytest.approx(2 * (4427 + 3599 * 0.5), rel=0.02)
    assert plan["bytes"] == pytest.approx(2 * 3600 * 2448 * 2048 * 0.573, rel=0.05)
    assert [step["index"] for step in plan["steps"]] == list(range(len(plan["steps"])))


def test_a_plan_counts_the_cameras_own_boot_time():
    plan = json.loads(runner.invoke(app, ["plan", "warm-up", "--json"]).stdout)
    boot = [step["duration_s"] for step in plan["steps"] if step["parameters"] == {"on": True}]
    assert boot == [4.0, 4.0]  # camera.boot_s of the simulated stand


def recipe_file(tmp_path: Path, **parameters: object) -> str:
    cycle = {"set_points_degC": [30], **parameters}
    path = tmp_path / "recipe.yaml"
    path.write_text(yaml.safe_dump({"name": "bad", "experiments": [{"thermal_cycle": cycle}]}))
    return str(path)


@pytest.mark.parametrize(
    ("parameters", "sentence"),
    [
        ({"set_points_degC": [65]}, "outside limits.chamber_degC -10.0..60.0"),
        ({"table_position": {"vertical": 1}}, "this stand has no axis 'vertical'"),
        ({"table_position": {"linear": 290}}, "outside the limits (0.0, 280.0) of linear"),
        ({"interval_s": 0.2, "frames_per_point": 2}, "faster than cameras.camera.frame_rate_hz"),
        ({"soak_s": 604800, "cycles": 60}, "the plan takes 420 days"),
        ({"soa_s": 3}, "experiments.1.thermal_cycle.soa_s: unknown key"),
    ],
)
def test_a_plan_the_stand_may_not_do_is_refused_before_anything_moves(
    tmp_path: Path, parameters: dict[str, object], sentence: str
):
    result = runner.invoke(app, ["run", recipe_file(tmp_path, **parameters), "--out", str(tmp_path / "out")])
    assert result.exit_code == 2
    assert sentence in result.output
    assert len(result.output.strip().splitlines()) == 1
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (
            ["plan", "no-such-recipe"],
            "no-such-recipe: no such file, and not one of those installed; there are calibration, demo,",
        ),
        (["plan", "demo", "--config", "nowhere.yaml"], "nowhere.yaml: no such file"),
        (["run", "demo", "--seed", "3"], "--seed belongs to --virtual-time"),
        (["run", "demo", "--virtual-time", "--seed", "-1"], "--seed is 0 or more, not -1"),
        (["run", "demo", "--out", "/proc/x"], "/proc/x: no session can be written there"),
        (["run", "demo", "--out", __file__], "no session can be written there (Not a directory)"),
        (["demo", "--out", "/proc/x"], "/proc/x: no session can be written there"),
        (["demo", "--out", "."], "a demo needs a folder of its own name"),
        (["plan", "two\nlines"], "two\\nlines: no such file"),
        (["plan", "x" * 300], "cannot be looked up (File name too long)"),
        (["simulate", "laboratory"], "no `simulation` section"),
    ],
)
def test_bad_input_ends_with_status_2_and_one_line(arguments: list[str], sentence: str):
    result = runner.invoke(app, arguments)
    assert result.exit_code == 2
    assert sentence in result.output
    assert len(result.output.strip().splitlines()) == 1


def test_a_target_that_is_none_is_refused_before_anything_moves(tmp_path: Path):
    target = tmp_path / "target.yaml"
    target.write_text("name: no grid\n")
    data = yaml.safe_load(find_packaged("", "simulated").read_text())
    config = tmp_path / "config.yaml"
    config.write_text(yaml.safe_dump({**data, "target": str(target)}))
    result = runner.invoke(app, ["run", "demo", "--config", str(config), "--out", str(tmp_path / "out")])
    assert result.exit_code == 2
    assert result.output.startswith(f"error: {target}: columns: is missing")
    assert len(result.output.strip().splitlines()) == 1


def test_a_usage_error_is_reported_in_plain_lines():
    result = runner.invoke(app, ["run", "demo", "--seed", "many"])
    assert result.exit_code == 2
    assert "'--seed'" in result.output.strip().splitlines()[-1]
    assert result.output.isascii()


def test_a_stand_that_does_not_answer_ends_with_status_1_and_leaves_nothing(tmp_path: Path):
    data = move_to_free(yaml.safe_load(find_packaged("", "simulated").read_text()), tmp_path)
    data["bus"]["address"] = f"serial:{tmp_path / 'unplugged'}"
    config = tmp_path / "config.yaml"
    config.write_text(yaml.safe_dump(data))
    # In a process of its own: asyncio.run and signal handlers belong to a main thread.
    result = fork_server.run(
        [
            sys.executable,
            "-m",
            "thermostand.stand.cli",
            "run",
            "demo",
            "--config",
            str(config),
            "--out",
            str(tmp_path / "out"),
        ],
        capture_output=True,
        text=True,
        env={**os.environ, "COLUMNS": "200"},
    )
    assert result.returncode == 1
    assert "unplugged" in result.stderr
    assert "Traceback" not in result.stderr
    assert not (tmp_path / "out").exists()


def test_a_disk_that_is_too_small_for_the_plan_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    def free(size_bytes: int) -> None:
        monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=size_bytes))

    order = load_order("overnight", "simulated")
    steps = price_plan(order.recipe.plan(), order.config)
    free(11_000_000_000)
    assert re.findall(r"[\d.]+ GB", explain_small_disk(tmp_path, steps, order.config)) == [
        "11.0 GB",
        "11.1 GB",
        "2.0 GB",
    ]
    free(13_200_000_000)
    assert explain_small_disk(tmp_path, steps, order.config) == ""


def test_ctrl_c_while_the_commands_are_imported_ends_with_a_line(tmp_path: Path):
    # An import that tells when it is under way, and then waits for the interrupt.
    (tmp_path / "typer.py").write_text(
        "import signal\nprint('importing', flush=True)\nwhile True:\n    signal.pause()\n"
    )
    environment = {**os.environ, "PYTHONPATH": f"{tmp_path}{os.pathsep}{os.environ.get('PYTHONPATH', '')}"}
    command = [sys.executable, "-m", "thermostand.stand.cli", "plan", "demo"]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment
    ) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        assert process.stdout.readline() == "importing\n"
        process.send_signal(signal.SIGINT)
        assert process.wait(30) == 130
        assert process.stderr.read() == "interrupted; nothing was started\n"


def test_what_can_be_broken_is_listed_and_a_wrong_name_is_refused():
    listed = runner.invoke(app, ["simulate", "--faults"])
    assert listed.exit_code == 0
    assert "bus.drop" in listed.output
    refused = runner.invoke(app, ["simulate", "--fault", "bus.drip"])
    assert refused.exit_code == 2
    assert "did you mean bus.drop" in refused.output
