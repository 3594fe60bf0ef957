"""A daemon that was stopped for longer than two of the guard's periods (SIGSTOP, a debugger, a suspended host) and goes
on: heat is permitted again on readings taken since only, and the gap is recorded."""

import asyncio
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import yaml

from tests import fork_server
from tests.system.conftest import FAST
from tests.system.gateway import gateway
from tests.system.test_unrecorded_heat import SOAK, heater_is, plant
from thermostand.recording.reading.session import Session
from thermostand.stand.running.order import Order

LIMIT_S = 90.0  # for what takes a few seconds, on a machine that has other things to do
STOPPED_S = 1.5  # 6 periods of the guard, and less than the camera waits for its client
RELAYS, THERMOMETERS = 2, 3  # units
HEATER_FOR_A_TIME = bytes([RELAYS, 5, 0x02, 0x00])  # unit, function, address


async def until(condition: Callable[[], bool]) -> None:
    async with asyncio.timeout(LIMIT_S):
        while not condition():
            await asyncio.sleep(0.02)


async def test_after_a_stop_heat_waits_for_readings_taken_since(
    tmp_path: Path, order: Callable[..., Order], simulator: Callable[..., object]
):
    """The thermometers' replies are lost from the stop on: until one comes the heater's relay drops, not armed."""
    ordered = order(SOAK, **{**FAST, "bus": {"timeout_s": 0.1}, "recording": {"telemetry_commit_s": 0.2}})
    await asyncio.to_thread(simulator, ordered.config, False)
    with gateway(ordered) as (between, through):
        config = yaml.safe_load((tmp_path / "config.yaml").read_text())
        config["bus"]["address"] = through.config.bus.address
        (tmp_path / "through.yaml").write_text(yaml.safe_dump(config))
        run = ["run", tmp_path / "recipe.yaml", "--config", tmp_path / "through.yaml", "--out", tmp_path / "out"]
        process = fork_server.popen([sys.executable, "-m", "thermostand.stand.cli", *run], stdout=subprocess.DEVNULL)
        asked, answered = list[bytes](), list[bytes]()

        def loses(request: bytes) -> bool:
            asked.append(request[6:])
            return request[6] == THERMOMETERS

        def armed() -> int:
            return sum(request.startswith(HEATER_FOR_A_TIME) for request in asked)

        try:
            async with asyncio.timeout(LIMIT_S):
                while await plant(ordered, "heater_W") == 0:
                    await asyncio.sleep(0.05)
            process.send_signal(signal.SIGSTOP)
            await asyncio.sleep(STOPPED_S)
            between.loses = loses
            process.send_signal(signal.SIGCONT)
            await heater_is(ordered, 0)
            await until(lambda: any(request[0] == THERMOMETERS for request in asked))
            assert armed() == 0
            between.loses = lambda request: bool(answered.append(request[6:]))
            await heater_is(ordered, 1)
            first = next(i for i, request in enumerate(answered) if request.startswith(HEATER_FOR_A_TIME))
            assert THERMOMETERS in [request[0] for request in answered[:first]]
            process.send_signal(signal.SIGINT)
            assert await asyncio.to_thread(process.wait, LIMIT_S) == 130
        finally:
            process.kill()
            process.wait(LIMIT_S)
    events = Session.open(next((tmp_path / "out").iterdir())).events()
    late = [event.data["gap_s"] for event in events if event.kind == "guard_late"]
    assert any(isinstance(gap_s, float) and gap_s >= STOPPED_S for gap_s in late)
    assert [event.kind for event in events if event.kind.startswith("guard.")] == []
