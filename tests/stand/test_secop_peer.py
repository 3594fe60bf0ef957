"""The SECoP node and a client that was not written here: frappy's, by which NICOS reaches a node."""

import asyncio
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tests.stand.secop_service import SecopService, node

client = pytest.importorskip("frappy.client")
errors = pytest.importorskip("frappy.errors")
LIMIT_S = 20.0


class Follower:
    """What the client has received, and a way to wait for it."""

    def __init__(self, port: int) -> None:
        self.peer = client.SecopClient(f"tcp://127.0.0.1:{port}", log=None)
        self._changed = threading.Condition()
        self.peer.register_callback(None, updateItem=self._update)

    def _update(self, module: str, parameter: str, item: object) -> None:
        with self._changed:
            self._changed.notify_all()

    def item(self, module: str, parameter: str) -> Any:
        return self.peer.cache[module, parameter]

    def until(self, wanted: Callable[[], bool]) -> None:
        end_s = time.monotonic() + LIMIT_S
        with self._changed:
            while not wanted():
                assert self._changed.wait(end_s - time.monotonic()), "not in time"


def converse(port: int, desk: SecopService, on_loop: Callable[[Callable[[], object]], object]) -> None:
    """In a thread: the peer's client is of threads."""
    follower = Follower(port)
    peer = follower.peer
    peer.connect()
    try:
        assert peer.online
        assert peer.properties["equipment_id"] == "thermostand.a-stand"
        assert next(iter(peer.modules)) == "chamber"
        assert peer.modules["chamber"]["properties"]["interface_classes"] == ["Drivable"]
        assert set(peer.modules["linear"]["commands"]) == {"stop", "home"}
        assert follower.item("thermometers_air", "value").value == 24.0
        assert follower.item("thermometers_granite", "value").readerror.args == ("wire is broken",)
        assert isinstance(follower.item("thermometers_granite", "value").readerror, errors.HardwareError)
        assert follower.item("flap", "value").value.name == "closed"
        assert peer.setParameter("chamber", "target", 30.0).value == 30.0
        follower.until(lambda: follower.item("chamber", "status").value[0] == 300)
        desk.air_degC = 30.1
        on_loop(desk.poll)
        follower.until(lambda: follower.item("chamber", "status").value[0] == 100)
        assert follower.item("chamber", "value").formatted().endswith("degC")
        on_loop(lambda: desk.lose("regulator.pv"))
        follower.until(lambda: follower.item("chamber", "value").readerror is not None)
        assert isinstance(follower.item("chamber", "value").readerror, errors.CommunicationFailedError)
        with pytest.raises(errors.RangeError, match="at most 280"):
            peer.request("change", "linear:target", 300)
        assert peer.setParameter("flap", "target", "open").value == 1
        assert peer.execCommand("run", "submit", "overnight")[0] == 1
        peer.execCommand("run", "stop")
        desk.phase = "running"
        with pytest.raises(errors.IsBusyError, match="has the stand"):
            peer.setParameter("linear", "target", 3.0)
    finally:
        peer.disconnect()


async def test_frappys_client_describes_follows_and_operates_the_stand(tmp_path: Path):
    desk, loop = SecopService(), asyncio.get_running_loop()

    def on_loop(call: Callable[[], object]) -> None:
        async def called() -> None:
            call()

        asyncio.run_coroutine_threadsafe(called(), loop).result(LIMIT_S)

    async with node(desk, tmp_path) as port:
        await asyncio.to_thread(converse, port, desk, on_loop)
    assert [verb for _, verb, _ in desk.orders] == ["device", "device", "submit", "stop"]
    assert {who.how for who, _, _ in desk.orders} == {"secop"}
