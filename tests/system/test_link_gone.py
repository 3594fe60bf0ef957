"""The link to heater, compressor and regulator is gone while the stand is made safe: tried until they confirm, or until
an operator, or the limit, ends that; what is not safe is the last word."""

import asyncio
import os
import signal
import subprocess
import sys
from collections.abc import AsyncGenerator, Callable, Coroutine
from contextlib import asynccontextmanager
from pathlib import Path
from typing import cast

import pytest

from tests.system.conftest import FAST
from tests.system.test_guard_run import LONG_SOAK, Watcher, check_safe
from tests.system.test_run import at_step, fault
from tests.system.test_run_ends import break_now
from tests.system.test_unrecorded_heat import SOAK, heater_is, plant
from thermostand.foundation.clock import NS_PER_S, WallClock
from thermostand.foundation.errors import StandTripped
from thermostand.foundation.hub import Hub
from thermostand.foundation.items import Event
from thermostand.recording.reading.session import Session
from thermostand.stand.config.stand_config import find_packaged
from thermostand.stand.running.order import Order
from thermostand.stand.service.daemon import Daemon, serve
from thermostand.stand.service.run import Interrupted, run_virtual
from thermostand.stand.service.stand_service import StandService, SubmitRequest
from thermostand.stand.serving.api_models import Requester

LIMIT_S = 90.0  # for what takes a few seconds, on a machine that has other things to do
QUICK = {"timeout_s": 0.1}


class Cut:
    """A run whose link is gone from its first soak on, and what is then done, on the stand's time."""

    def __init__(self, order: Order) -> None:
        self.order = order
        self.watcher = Watcher()
        self.tasks: list[asyncio.Task[None]] = []

    def watch(self, then: Callable[[], Coroutine[None, None, None]]) -> Callable[[Hub], None]:
        def cut() -> None:
            break_now(self.order, "bus.unplugged", True)
            self.tasks.append(asyncio.create_task(then()))

        def follow(hub: Hub) -> None:
            hub.subscribe(self.watcher)
            at_step("soak", cut)(hub)

        return follow

    async def trying(self, times: int) -> None:
        """Return when it has been reported so often that the stand is not safe."""
        await self.watcher.until(lambda: len(self.reports()) >= times)

    def reports(self) -> list[Event]:
        return [event for event in self.watcher.events if event.data.get("unconfirmed") and "still" in event.text]


def interrupt() -> None:
    os.kill(os.getpid(), signal.SIGINT)


async def test_it_is_made_safe_when_the_link_is_back(tmp_path: Path, order: Callable[..., Order]):
    cut = Cut(order(LONG_SOAK, bus=QUICK))

    async def then() -> None:
        interrupt()
        await cut.trying(2)
        break_now(cut.order, "bus.unplugged", False)

    with pytest.raises(Interrupted, match="stopped by the operator"):
        await run_virtual(cut.order, tmp_path / "out", None, cut.watch(then))
    await asyncio.gather(*cut.tasks)
    session = Session.open(next((tmp_path / "out").iterdir()))
    check_safe(session)
    first_s, second_s = (event.time_ns / NS_PER_S for event in cut.reports())
    assert second_s - first_s == pytest.approx(120, abs=2)
    for device in ("relays", "regulator"):
        assert all(f"{device} did not confirm" in event.text for event in cut.reports())
    assert "confirmed_safe" in [event.kind for event in session.events()]


async def test_a_second_signal_a_minute_later_ends_the_wait_and_earlier_ones_do_not(
    tmp_path: Path, order: Callable[..., Order]
):
    cut = Cut(order(LONG_SOAK, bus=QUICK))

    async def then() -> None:
        interrupt()
        await cut.watcher.wait(20)
        interrupt()
        await cut.trying(1)  # after a minute
        interrupt()

    with pytest.raises(Interrupted, match="NOT SAFE: re") as caught:
        await run_virtual(cut.order, tmp_path / "out", None, cut.watch(then))
    await asyncio.gather(*cut.tasks)
    assert "relays did not confirm" in str(caught.value)
    assert "regulator did not confirm" in str(caught.value)
    session = Session.open(next((tmp_path / "out").iterdir()))
    begun = next(mark for mark in session.steps() if mark.kind == "soak")
    assert 60 <= (session.events()[-1].time_ns - begun.time_ns) / NS_PER_S < 90
    assert len(cut.reports()) == 1


async def test_without_an_operator_the_wait_ends_at_its_limit(tmp_path: Path, order: Callable[..., Order]):
    """The guard has found that nothing is read any more; 10 min, here 130 s."""
    cut = Cut(order(LONG_SOAK, bus=QUICK, guard={"safe_limit_s": 130}))

    async def nothing() -> None:
        return

    with pytest.raises(StandTripped, match="NOT SAFE: re"):
        await run_virtual(cut.order, tmp_path / "out", None, cut.watch(nothing))
    session = Session.open(next((tmp_path / "out").iterdir()))
    trip = next(event for event in session.events() if event.kind.startswith("guard."))
    last_ns = max(item.time_ns for item in session.items())
    assert 130 <= (last_ns - trip.time_ns) / NS_PER_S < 160
    assert len(cut.reports()) >= 2


async def test_a_daemon_that_is_ended_once_tries_beyond_the_time_after_which_a_second_signal_ends_it(
    tmp_path: Path, order: Callable[..., Order], simulator: Callable[..., object], monkeypatch: pytest.MonkeyPatch
):
    """A minute, here a tenth of a second."""
    ordered = order(SOAK, **FAST | {"bus": QUICK})
    await asyncio.to_thread(simulator, ordered.config, False)
    monkeypatch.setattr("thermostand.stand.safety.making_safe._GIVEN_UP_AFTER_S", 0.1)
    monkeypatch.setattr("thermostand.stand.service.daemon._LOOK_S", 0.2)
    text = (tmp_path / "config.yaml").read_text()
    texts = {"config.yaml": text, "target.yaml": find_packaged("targets", ordered.config.target).read_text()}
    watcher = Watcher()

    async def broken(daemon: Daemon, desk: StandService) -> None:
        await desk.submit(Requester(name="a test", how="terminal"), SubmitRequest(recipe_text=SOAK))
        await heater_is(ordered, 1)
        await fault(ordered, "bus.unplugged", True)
        daemon.leave()
        await asyncio.sleep(0.8)  # what waits for the run has looked four times
        tries = daemon.has_admitted_run
        await fault(ordered, "bus.unplugged", False)
        assert tries

    @asynccontextmanager
    async def front(desk: StandService, hub: Hub, _: WallClock) -> AsyncGenerator[None]:
        hub.subscribe(watcher)
        breaking = asyncio.create_task(broken(cast("Daemon", desk.host), desk))
        yield
        await breaking

    async with asyncio.timeout(LIMIT_S):
        await serve(ordered.config, "a stand", texts, tmp_path / "out", front)  # StandTripped when it is not safe
    kinds = [event.kind for event in watcher.events]
    assert kinds.index("not_confirmed_safe") < kinds.index("confirmed_safe")
    assert await plant(ordered, "heater_enabled") == 0


@pytest.mark.nightly
@pytest.mark.parametrize(("comes_back", "ending"), [(True, "the stand is safe"), (False, "NOT SAFE: re")])
async def test_as_a_command_in_real_time_it_ends_with_that_word_and_its_exit_code(
    tmp_path: Path, order: Callable[..., Order], simulator: Callable[..., object], comes_back: bool, ending: str
):
    ordered = order(SOAK, **FAST)
    await asyncio.to_thread(simulator, ordered.config, False)
    run = ["run", tmp_path / "recipe.yaml", "--config", tmp_path / "config.yaml", "--out", tmp_path / "out"]
    process = subprocess.Popen(
        [sys.executable, "-m", "thermostand.stand.cli", *run],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        async with asyncio.timeout(LIMIT_S):
            while await plant(ordered, "heater_W") == 0:
                await asyncio.sleep(0.05)
        await fault(ordered, "bus.unplugged", True)
        process.send_signal(signal.SIGINT)
        await heater_is(ordered, 0)  # by the board's own timer
        await asyncio.sleep(5)
        process.send_signal(signal.SIGTERM)  # too early
        if comes_back:
            await fault(ordered, "bus.unplugged", False)
        else:
            await asyncio.sleep(62)
            assert process.poll() is None
            process.send_signal(signal.SIGINT)
        assert await asyncio.to_thread(process.wait, LIMIT_S) == 130
        reports = process.stderr.read()
    finally:
        process.kill()
        process.wait(LIMIT_S)
        process.stderr.close()
    assert f"stopped by the operator; {ending}" in reports.splitlines()[-1]
    assert ("still trying: re" in reports) is not comes_back
    assert await plant(ordered, "heater_enabled") == 0
