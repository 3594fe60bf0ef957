"""A night queued while no daemon has the stand: every device is asked over the wires before, and nothing is written."""

import asyncio
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml
from typer.testing import CliRunner, Result

from tests.addresses import free_port
from tests.system.conftest import AS_INSTALLED, require_aravis
from tests.system.gateway import Gateway
from thermostand.foundation.addresses import tcp_place
from thermostand.foundation.clock import WallClock
from thermostand.foundation.hub import Hub
from thermostand.stand.assembly import assemble
from thermostand.stand.commands.queue_cli import app
from thermostand.stand.config.stand_config import load_config, packaged
from thermostand.stand.queueing.queue import queued
from thermostand.stand.running.opening.claim import claimed
from thermostand.stand.running.order import Order
from thermostand.stand.simulator import Simulator

POLLED = AS_INSTALLED

READS = {1, 2, 3, 4, 0x11, 0x2B}  # Modbus function codes

Change = Callable[[dict[str, Any]], object]


class Bench:
    """A stand that answers, and what is said to its bus."""

    def __init__(self, folder: Path, config: Path) -> None:
        self.out = folder / "out"
        self.said: list[int] = []
        self._folder, self._config = folder, config
        self._gateway = Gateway(tcp_place(load_config(config).bus.address)[1])
        self._gateway.loses = self._note

    def close(self) -> None:
        self._gateway.unplug()

    def _note(self, request: bytes) -> bool:
        self.said.append(request[7])
        return False

    def real(self, change: Change = lambda _: None) -> Path:
        """Its file as that of a real stand, as far as the program can tell; `change` makes it of another one."""
        data = yaml.safe_load(self._config.read_text())
        del data["simulation"]
        data["bus"]["address"] = f"tcp:127.0.0.1:{self._gateway.port}"
        change(data)
        path = self._folder / "real.yaml"
        path.write_text(yaml.safe_dump(data))
        return path

    def add(self, config: Path) -> Result:
        return CliRunner().invoke(app, ["add", "warm-up", "--config", str(config), "--out", str(self.out)])


@pytest.fixture
def bench(tmp_path: Path, order: Callable[..., Order], simulator: Callable[..., Simulator]) -> Iterator[Bench]:
    require_aravis()
    order(camera={"boot_s": 0.2, "serial_number": "TS-0001"})
    config = tmp_path / "config.yaml"
    simulator(load_config(config), False)
    asyncio.run(_supply(config))
    found = Bench(tmp_path, config)
    yield found
    found.close()


async def _supply(config: Path) -> None:
    assembly = assemble(load_config(config), Hub(), WallClock())
    await assembly.bus.open()
    await assembly.devices.relays.switch("camera_power", True)
    await assembly.bus.close()
    await asyncio.sleep(0.3)  # the camera starts


def test_a_night_is_queued_when_every_device_answers_and_nothing_is_written(bench: Bench):
    result = bench.add(bench.real())
    assert (result.exit_code, result.stdout, result.stderr) == (0, "1\n", "")
    assert bench.said
    assert set(bench.said) <= READS


def test_another_unit_than_the_configured_one_keeps_a_night_from_the_queue(bench: Bench):
    def other(data: dict[str, Any]) -> None:
        data["axes"]["linear"]["serial_number"] = 9
        data["cameras"]["camera"]["serial_number"] = "TS-0002"
        data["flap"]["serial_number"] = "7"

    result = bench.add(bench.real(other))
    assert (result.exit_code, result.stdout) == (1, "")
    assert len(result.stderr.splitlines()) == 1
    camera = "camera: serial number TS-0002 is expected, TS-0001 answers"
    for sentence in ("linear: controller 4101 answers", "flap: ", camera):
        assert sentence in result.stderr
    assert not bench.out.exists()


def test_a_bus_that_does_not_answer_keeps_a_night_from_the_queue(bench: Bench):
    result = bench.add(bench.real(lambda data: data["bus"].update(address=f"tcp:127.0.0.1:{free_port()}")))
    assert (result.exit_code, result.stdout) == (1, "")
    assert "this stand cannot run it now, and nothing was queued: bus: " in result.stderr
    assert not bench.out.exists()


def test_an_analog_output_that_does_not_answer_keeps_a_night_from_the_queue(bench: Bench):
    def heats_by_a_current(data: dict[str, Any]) -> None:
        data["regulator"] = yaml.safe_load(packaged("", "software-regulator").read_text())["regulator"]
        data["heat_module"] = {"registers": "icpdas-m7024", "unit": 9, "watchdog_s": 12.0}

    result = bench.add(bench.real(heats_by_a_current))
    assert (result.exit_code, result.stdout) == (1, "")
    assert "this stand cannot run it now, and nothing was queued: heat_module: " in result.stderr
    assert not bench.out.exists()
    assert set(bench.said) <= READS


def test_while_the_stand_is_busy_a_night_is_queued_and_that_nobody_asked_is_said(bench: Bench):
    config = bench.real()

    async def beside() -> Result:
        async with claimed(load_config(config), bench.out / "a-session"):
            return await asyncio.to_thread(bench.add, config)

    result = asyncio.run(beside())
    assert (result.exit_code, result.stdout) == (0, "1\n")
    assert "warning: queued without asking the devices" in result.stderr
    assert "a-session" in result.stderr
    assert bench.said == []
    assert [entry.recipe for entry in queued(bench.out).entries] == ["warm-up"]
