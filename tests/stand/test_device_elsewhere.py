"""`stand device` in a folder that no daemon has, while one runs elsewhere."""

import asyncio
from pathlib import Path

from typer.testing import CliRunner

from tests.stand.fake_service import FakeService, serve_fake
from thermostand.stand.commands.command_table import app as order_app


async def test_devices_by_hand_name_the_daemon_that_runs_elsewhere(tmp_path: Path):
    async with serve_fake(FakeService(), tmp_path):
        listed = await asyncio.to_thread(CliRunner().invoke, order_app, ["device", "flap", "--config", "simulated"])
    first = listed.stdout.splitlines()[0]
    assert "runs in sessions" in first
    assert str(tmp_path) in first
    assert "--dir" in first
