"""Two runs on one stand, over the wire and the command line: the second one touches nothing, and says who has it."""

import asyncio
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from pathlib import Path

import pytest

from tests import fork_server
from tests.daemon_queries import ask_status
from tests.stand.test_listening import connected
from tests.system.conftest import FAST, require_aravis
from tests.system.test_real_time import BRIEF
from thermostand.foundation.errors import SessionError
from thermostand.stand.assembly.simulator import ControlSocket
from thermostand.stand.config.stand_config import load_config
from thermostand.stand.running.order import Order
from thermostand.stand.serving.client import list_running_sessions

LIMIT_S = 90.0  # for a busy machine
LONG = BRIEF.replace("equilibrium_s: 0.5", "equilibrium_s: 3600").replace("[26]", "[40]")


@pytest.fixture
def stand(tmp_path: Path) -> Iterator[Callable[..., "subprocess.Popen[str]"]]:
    """Start a `stand` command; whatever is left of it ends with the test."""
    require_aravis()
    started: list[subprocess.Popen[str]] = []

    def start(*arguments: str | Path) -> "subprocess.Popen[str]":
        command = [sys.executable, "-m", "thermostand.stand.cli", *arguments]
        started.append(fork_server.popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True))
        return started[-1]

    yield start
    for process in started:
        process.kill()
        process.communicate()


class Laboratory:
    """What the simulated plant says of the heater's relay."""

    def __init__(self, config_file: Path) -> None:
        simulation = load_config(config_file).simulation
        assert simulation is not None
        self._control = ControlSocket(simulation.control)
        self.heater_was_on: list[bool] = []

    async def heater_is_on(self) -> bool:
        self.heater_was_on.append(bool((await self._control.request({"do": "state"}))["heater_enabled"]))
        return self.heater_was_on[-1]

    async def __aenter__(self) -> "Laboratory":
        await self._control.open()
        return self

    async def __aexit__(self, *_: object) -> None:
        await self._control.close()


async def until(condition: Callable[[], bool], process: "subprocess.Popen[str]") -> None:
    deadline_s = time.monotonic() + LIMIT_S
    while not condition():
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < deadline_s
        await asyncio.sleep(0.02)


@pytest.mark.parametrize("ending", ["killed", pytest.param("stopped", marks=pytest.mark.nightly)])
async def test_a_second_run_touches_nothing_until_the_first_has_ended(
    tmp_path: Path,
    order: Callable[..., Order],
    simulator: Callable[..., object],
    stand: Callable[..., "subprocess.Popen[str]"],
    ending: str,
):
    ordered = order(LONG, **FAST)
    await asyncio.to_thread(simulator, ordered.config, False)
    out, other = tmp_path / "out", tmp_path / "other"
    run = ("run", tmp_path / "recipe.yaml", "--config", tmp_path / "config.yaml", "--out")
    async with Laboratory(tmp_path / "config.yaml") as laboratory:
        first = stand(*run, out)
        await until(lambda: bool(list_running_sessions(out)), first)
        async with asyncio.timeout(LIMIT_S):
            while not await laboratory.heater_is_on():
                assert first.poll() is None
                await asyncio.sleep(0.02)
        (session,) = out.iterdir()
        laboratory.heater_was_on.clear()
        second = stand(*run, other)
        async with asyncio.timeout(LIMIT_S):
            while second.poll() is None:
                await laboratory.heater_is_on()
        assert second.returncode == 1
        output = second.communicate()[1]
        in_use = rf"error: [a-z]+: [^\n]* is in use by session {session} \(pid {first.pid}\); nothing was touched\n"
        assert re.search(in_use, output), output
        assert not other.exists()
        for _ in range(100):
            await laboratory.heater_is_on()
        assert all(laboratory.heater_was_on)
        assert len(laboratory.heater_was_on) > 200

        renamed = session.rename(out / "renamed")
        with ExitStack() as silent:
            for _ in range(70):
                silent.enter_context(closing(await asyncio.to_thread(connected, session)))
            for name in (session, renamed):
                status = await asyncio.to_thread(ask_status, name)
                assert status.recipe == "brief"
                assert status.state in ("running", "held")  # held as soon as the guard misses the folder
            if ending == "killed":
                first.kill()
            else:
                assert stand("stop", renamed).wait(LIMIT_S) == 0
            assert first.wait(LIMIT_S) == (-signal.SIGKILL if ending == "killed" else 130)
        with pytest.raises(SessionError, match="no daemon is running"):
            ask_status(renamed)

        third = stand(*run, other)
        await until(lambda: bool(list_running_sessions(other)), third)
        stopping = stand("stop", other)
        assert await asyncio.to_thread(stopping.wait, LIMIT_S) == 0
        assert await asyncio.to_thread(third.wait, LIMIT_S) == 130
        assert "stopped by the operator" in third.communicate()[1]
        assert not await laboratory.heater_is_on()
