"""A camera whose supply was off is soaked again: what it was soaked before is not credited, and no frame is of a cold
one."""

import asyncio
from collections.abc import Callable
from pathlib import Path

import numpy as np

from tests.journals import read_lines
from tests.system.resume_process import Daemon
from tests.system.test_guard_run import Watcher
from tests.system.test_guard_wire import write_by_another_master
from tests.system.test_run import at_step
from thermostand.foundation.clock import NS_PER_S
from thermostand.foundation.hub import Hub
from thermostand.recording.reading.session import Session
from thermostand.stand.running.memory.entries import Soaked
from thermostand.stand.running.memory.journal import JOURNAL_NAME
from thermostand.stand.running.order import Order
from thermostand.stand.service.run import run_virtual

RECIPE = """
name: supply
experiments:
  - thermal_cycle:
      table_position: {linear: 2, rotary: 1}
      equilibrium_s: 900
      set_points_degC: [26]
      soak_s: 600
      reference_frames: 2
      frames_per_point: 1
"""
CAMERA_RELAY = 2


def check_soaked(session: Session, since_ns: int) -> None:
    """The equilibrium was found once after `since_ns`, before any frame, with a camera that hardly moves any more."""
    reached = [event for event in session.events() if event.kind == "camera_equilibrium" and event.time_ns > since_ns]
    assert len(reached) == 1
    rate, soaked_s = reached[0].data["rate_K_per_min"], reached[0].data["soaked_s"]
    assert isinstance(rate, float)
    assert isinstance(soaked_s, float)
    assert rate < 0.2
    assert soaked_s >= 600.0
    later_ns = [meta.time_ns for meta in session.frame_metas() if meta.time_ns > since_ns]
    assert later_ns
    assert min(later_ns) > reached[0].time_ns
    times_ns, camera_degC = session.readings("camera.temperature")
    window = (times_ns > reached[0].time_ns - 600 * NS_PER_S) & (times_ns <= reached[0].time_ns)
    assert np.ptp(camera_degC[window]) < 0.2 * 10 * 1.3


async def test_a_soak_with_a_cold_camera_is_not_credited(tmp_path: Path, order: Callable[..., Order]):
    ordered, out, watcher = order(RECIPE), tmp_path / "out", Watcher()
    tasks: list[asyncio.Task[None]] = []

    async def drop() -> None:
        await watcher.wait(600)
        await asyncio.to_thread(write_by_another_master, ordered, 2, 5, CAMERA_RELAY, 0)

    def watch(hub: Hub) -> None:
        hub.subscribe(watcher)
        at_step("soak", lambda: tasks.append(asyncio.create_task(drop())))(hub)

    directory = await run_virtual(ordered, out, None, watch)
    await asyncio.gather(*tasks)
    session = Session.open(directory)
    (lost,) = [event for event in session.events() if event.kind == "camera_equilibrium_lost"]
    assert "camera_supply_off" in {event.kind for event in session.events() if event.time_ns == lost.time_ns}
    check_soaked(session, lost.time_ns)
    entries = read_lines((directory / JOURNAL_NAME).read_bytes())[0]
    soaked = [(entry.time_ns, entry.soaked_s) for entry in entries if isinstance(entry, Soaked)]
    restarts = [time_ns for time_ns, soaked_s in soaked if soaked_s == 0.0]
    assert len(restarts) == 1
    assert 0 <= restarts[0] - lost.time_ns < 90 * NS_PER_S
    assert max(soaked_s for time_ns, soaked_s in soaked if time_ns < restarts[0]) > 300.0
    powered_ns, powered = session.readings("relays.camera_power")
    assert powered[powered_ns > restarts[0] + 60 * NS_PER_S].min() == 1


def test_after_a_power_cut_the_camera_is_soaked_again(tmp_path: Path, order: Callable[..., Order]):
    """The laboratory that a run is resumed in has no camera on: its supply is found off."""
    daemon = Daemon(order(RECIPE), tmp_path / "out")
    assert daemon.lives_for(3, "Frame")  # reference and first set-point are settled
    daemon.kill()
    (directory,) = (tmp_path / "out").iterdir()
    assert Daemon(None, directory).wait() == 0
    session = Session.open(directory)
    (gap,) = [event for event in session.events() if event.kind == "gap"]
    after = [event for event in session.events() if event.time_ns >= gap.time_ns]
    (lost,) = [event for event in after if event.kind == "camera_equilibrium_lost"]
    assert set(lost.data) == {"reason"}
    assert "soak_restarted" in [event.kind for event in after]
    check_soaked(session, lost.time_ns)
    # Soaks as short as here leave the camera on its way: there is nothing to compare (tests/stand/test_equilibrium.py).
    assert [event.kind for event in after if event.kind.startswith("camera_offset_")] == []
