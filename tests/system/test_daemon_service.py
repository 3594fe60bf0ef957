"""What a service manager, and a receiver of alerts that hangs, may ask of a daemon: neither delays guard or door."""

import asyncio
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import pytest
import yaml

from tests.stand.alert_receiver import Receiver
from tests.system.daemon_here import DaemonHere, served_here, until
from thermostand.foundation.items import Event
from thermostand.stand.config.stand_config import load_config
from thermostand.stand.serving.api.listeners import Interface
from thermostand.stand.serving.api.server import serve as serve_clients
from thermostand.stand.serving.client import find_session_server

WATCHDOG_S = 1.5


@pytest.fixture
def hung() -> Iterator[Receiver]:
    receiver = Receiver()
    receiver.let_go.clear()
    yield receiver
    receiver.close()


def fed(manager: socket.socket) -> int:
    """How often, since it was asked last."""
    count = 0
    with suppress(BlockingIOError):
        while True:
            count += manager.recv(1000) == b"WATCHDOG=1"
    return count


async def test_a_receiver_that_hangs_delays_neither_guard_nor_door_nor_watchdog(
    laboratory: Path, tmp_path: Path, hung: Receiver, monkeypatch: pytest.MonkeyPatch
):
    data = yaml.safe_load(laboratory.read_text())
    data["alerts"] = {"secrets": str(hung.secrets(tmp_path / "secrets.yaml")), "alive_every_s": 1, "grace_s": 0}
    laboratory.write_text(yaml.safe_dump(data))
    out = tmp_path / "out"
    manager = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    manager.bind(str(tmp_path / "notify"))
    manager.setblocking(False)
    monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "notify"))
    monkeypatch.setenv("WATCHDOG_USEC", str(round(WATCHDOG_S * 1e6)))
    late: list[str] = []

    async def work(here: DaemonHere) -> None:
        hub, clock, daemon = here.hub, here.clock, here.daemon
        await until(lambda: bool(hung.calls))  # the sign of life hangs
        for _ in range(20):
            hub.publish(Event(clock.now_ns(), "error", "device_lost", "a device does not answer", {"device": "x"}))
        fed(manager)
        end_s = time.monotonic() + 3 * WATCHDOG_S
        while time.monotonic() < end_s:
            began_s = time.monotonic()
            await asyncio.to_thread(find_session_server(out).state, 20.0)
            if (took_s := time.monotonic() - began_s) > 2.0 or not daemon.open_stand.guard.is_on_time:
                late.append(f"{took_s:.1f} s")
            await asyncio.sleep(0.1)
        assert fed(manager) >= 3
        fed(manager)
        threading.Event().wait(WATCHDOG_S)  # the event loop is blocked: nobody feeds from beside it
        assert fed(manager) == 0
        monkeypatch.setattr(type(daemon.open_stand.guard), "is_on_time", property(lambda _: False))
        await asyncio.sleep(0.2)
        fed(manager)
        await asyncio.sleep(WATCHDOG_S)
        assert fed(manager) == 0  # the service manager will end a daemon whose guard does not look

    name = load_config(laboratory).name
    with manager:
        await served_here(laboratory, out, work, lambda desk: serve_clients(desk, out, name, Interface(out)))
    assert late == []
    assert hung.messages == []
