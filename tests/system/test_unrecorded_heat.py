"""Heat only while it is recorded: in real time, on a disk that hangs, and in a folder that is taken away."""

import asyncio
import os
import shutil
import signal
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import asynccontextmanager
from dataclasses import replace
from pathlib import Path

import pytest

from tests.daemon_queries import ask, ask_status
from tests.recording.disks import ext4
from tests.system.conftest import FAST
from tests.system.test_disk_process import frozen, gone
from tests.system.test_guard_run import Watcher, telling
from tests.system.test_run import at_step
from thermostand.foundation.clock import NS_PER_S, WallClock
from thermostand.foundation.errors import StandError, StandTripped
from thermostand.recording.reading.session import Session
from thermostand.recording.repair.salvage import salvage_session
from thermostand.recording.writing.disk import MODULE
from thermostand.stand.assembly.simulator import ControlSocket
from thermostand.stand.running.opening.writer_restarts import MOST_PER_H
from thermostand.stand.running.order import Order
from thermostand.stand.running.resume import load_interruption
from thermostand.stand.service.run import run_real

SOAK = """
name: soak
experiments:
  - thermal_cycle:
      reference_degC: 40
      equilibrium_s: 400000
      set_points_degC: [41]
      reference_frames: 1
      frames_per_point: 1
"""
LIMIT_S = 60.0  # for anything that happens within a second on a machine without other work


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Path]:
    with ext4(tmp_path / "disk", 6 << 30) as folder:
        yield folder


async def plant(order: Order, quantity: str) -> float:
    assert order.config.simulation is not None
    control = ControlSocket(order.config.simulation.control)
    await control.open()
    try:
        return float(str((await control.request({"do": "state"}))[quantity]))
    finally:
        await control.close()


async def heater_is(order: Order, enabled: int) -> None:
    async with asyncio.timeout(LIMIT_S):
        while await plant(order, "heater_enabled") != enabled:
            await asyncio.sleep(0.05)


@asynccontextmanager
async def heating(order: Order, out: Path) -> AsyncIterator[tuple[asyncio.Task[Path], Watcher]]:
    """A run in real time that has come to its first soak, and heats."""
    watcher, soaking = Watcher(), asyncio.Event()

    def watch(hub) -> None:
        hub.subscribe(watcher)
        at_step("soak", soaking.set)(hub)

    task = asyncio.create_task(run_real(order, out, watch))
    started = asyncio.create_task(soaking.wait())
    try:
        await asyncio.wait([task, started], timeout=LIMIT_S, return_when=asyncio.FIRST_COMPLETED)
        assert not task.done(), task.exception()
        assert started.done(), [event.text for event in watcher.events]
        await heater_is(order, 1)
        yield task, watcher
    finally:
        started.cancel()
        if not task.done():
            os.kill(os.getpid(), signal.SIGINT)
            await asyncio.wait([task], timeout=LIMIT_S)


async def happens(watcher: Watcher, kind: str) -> None:
    async with asyncio.timeout(LIMIT_S):
        await watcher.until(lambda: kind in {event.kind for event in watcher.events})


async def says(path: Path, text: str) -> None:
    async with asyncio.timeout(LIMIT_S):
        while not (path.exists() and text in path.read_text()):
            await asyncio.sleep(0.05)


@pytest.mark.usefixtures("own_helpers")
async def test_a_disk_that_hangs_withdraws_the_heat_until_it_is_back_and_keeps_nobody_from_leaving(
    disk: Path, tmp_path: Path, order: Callable[..., Order], simulator: Callable[..., object]
):
    """Somebody is notified while it hangs; when it hangs again, the run is stopped."""
    reported, clock = tmp_path / "reported", WallClock()
    ordered = telling(order(SOAK, **FAST), reported)
    await asyncio.to_thread(simulator, ordered.config, False)
    async with heating(ordered, disk / "out") as (task, watcher):
        watcher.events.clear()
        with frozen(disk):
            await happens(watcher, "guard.not_recorded")
            await heater_is(ordered, 0)
            await says(reported, "is not on the disk yet")
            assert [event.kind for event in watcher.events if event.kind == "guard_late"] == []
        await happens(watcher, "hold_ended")
        await happens(watcher, "restored")
        await heater_is(ordered, 1)
        writer = disk_process()
        with frozen(disk):
            begun_ns = clock.now_ns()
            os.kill(os.getpid(), signal.SIGQUIT)
            await heater_is(ordered, 0)
            safe_ns = clock.now_ns()
            with pytest.raises(StandError, match="stopped by the operator"):
                await asyncio.wait_for(task, LIMIT_S)
            left_ns = clock.now_ns()
    assert (safe_ns - begun_ns) / NS_PER_S < 10.0
    assert (left_ns - safe_ns) / NS_PER_S < 15.0  # 5 s where nothing else keeps the machine busy
    gone(writer)
    (directory,) = (disk / "out").glob("2*")
    salvage_session(directory)
    kinds = [event.kind for event in Session.open(directory).events()]
    assert {"guard.not_recorded", "hold_ended", "restored"} <= set(kinds)


def disk_process() -> int:
    """The id of the process that writes the session for this one."""
    children = [pid for task in Path("/proc/self/task").iterdir() for pid in (task / "children").read_text().split()]
    commands = {pid: Path(f"/proc/{pid}/cmdline").read_bytes().decode().split("\0") for pid in children}
    (pid,) = [int(pid) for pid, command in commands.items() if MODULE in command]
    return pid


@pytest.mark.usefixtures("own_helpers")
async def test_a_run_whose_disk_process_is_killed_goes_on_with_another_until_it_is_killed_too_often(
    tmp_path: Path, order: Callable[..., Order], simulator: Callable[..., object]
):
    """Safe each time, and with all that was acknowledged."""
    ordered = order(SOAK, **FAST)
    await asyncio.to_thread(simulator, ordered.config, False)
    async with heating(ordered, tmp_path / "out") as (task, watcher):
        for _ in range(MOST_PER_H):
            watcher.events.clear()
            os.kill(disk_process(), signal.SIGKILL)
            await happens(watcher, "guard.recording_ended")
            await happens(watcher, "restored")
            await heater_is(ordered, 1)
        watcher.events.clear()
        os.kill(disk_process(), signal.SIGKILL)
        with pytest.raises(StandTripped, match=r"has ended.*stand is safe"):
            await asyncio.wait_for(task, LIMIT_S)
        await heater_is(ordered, 0)
        assert [event.data["action"] for event in watcher.events if event.kind == "guard.recording_ended"] == ["abort"]
    (directory,) = (tmp_path / "out").glob("2*")
    assert salvage_session(directory)
    assert "run.start" in [event.kind for event in Session.open(directory).events()]
    before = load_interruption(directory)
    before.release()
    assert before.state.done or before.state.soaked_s
    begun = [event.kind for event in Session.open(directory).events() if event.kind in ("run.start", "run.resume")]
    assert begun == ["run.start", *["run.resume"] * MOST_PER_H]


@pytest.mark.parametrize("how", ["removed", pytest.param("renamed", marks=pytest.mark.nightly)])
async def test_a_folder_that_is_taken_away_holds_the_run_until_an_operator_clears_it(
    tmp_path: Path, order: Callable[..., Order], simulator: Callable[..., object], how: str
):
    ordered = order(SOAK, **FAST)
    await asyncio.to_thread(simulator, ordered.config, False)
    async with heating(ordered, tmp_path / "out") as (task, watcher):
        (directory,) = (tmp_path / "out").glob("2*")
        watcher.events.clear()
        if how == "removed":
            shutil.rmtree(directory, ignore_errors=True)
        else:
            directory.rename(tmp_path / "elsewhere")
        await happens(watcher, "guard.folder_lost")
        await heater_is(ordered, 0)
        assert (await asyncio.to_thread(ask_status, directory)).state == "held"
        await asyncio.to_thread(ask, directory, "reset")
        await happens(watcher, "restored")
        await heater_is(ordered, 1)
        await asyncio.to_thread(ask, directory, "stop")
        with pytest.raises(StandError, match="stopped by the operator"):
            await asyncio.wait_for(task, LIMIT_S)
    session = Session.open(directory)
    assert "recording_lost" in {event.kind for event in session.events()}
    numbers = [path.name for path in (directory / "telemetry").iterdir()]
    assert "0000.mcap" not in numbers


@pytest.mark.nightly
async def test_a_lack_of_memory_is_reported_in_words(
    tmp_path: Path, order: Callable[..., Order], simulator: Callable[..., object]
):
    """Raised where a reading is taken over, as any allocation may."""
    ordered = order(SOAK, **FAST)
    await asyncio.to_thread(simulator, ordered.config, False)
    hungry = list[bool]()

    def watch(hub) -> None:
        def listen(item) -> None:
            if hungry:
                hungry.clear()
                raise MemoryError

        hub.subscribe(listen)
        at_step("soak", lambda: hungry.append(True))(hub)

    with pytest.raises(StandError, match="out of memory"):
        await asyncio.wait_for(run_real(replace(ordered), tmp_path / "out", watch), LIMIT_S)
    assert await plant(ordered, "heater_enabled") == 0
    (directory,) = (tmp_path / "out").glob("2*")
    assert Session.open(directory).events()[-1].text == "failed: out of memory"
