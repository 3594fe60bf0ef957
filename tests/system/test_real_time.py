"""The same daemon in real time over serial wires: Modbus RTU and XIMC on pseudo-terminals, USB, GigE."""

import asyncio
import os
import signal
import sys
import urllib.request
from collections.abc import Callable
from pathlib import Path
from typing import cast

import numpy as np
import pytest

from tests.addresses import allocate_camera_address, find_free_port
from tests.stand.secop_talk import talking
from tests.system.conftest import CORNER, FAST
from thermostand.foundation.errors import SessionError, Unreachable
from thermostand.foundation.hub import Hub
from thermostand.foundation.items import Item, StepMark
from thermostand.recording.reading.session import Session
from thermostand.stand.assembly.simulator import ControlSocket
from thermostand.stand.commands.live import RunFollower
from thermostand.stand.commands.status_snapshot import StatusSnapshot
from thermostand.stand.config.interface_section import InterfaceConfig
from thermostand.stand.running.order import Order
from thermostand.stand.service.run import Interrupted, run_real
from thermostand.stand.serving.client import API, make_server
from thermostand.stand.serving.interface import make_interface

BRIEF = """
name: brief
experiments:
  - thermal_cycle:
      equilibrium_s: 0.5
      set_points_degC: [26]
      soak_s: 1.0
      reference_frames: 3
      interval_s: 0.5
"""
FRAMES = """
name: frames
steps:
  - start_chamber: 26
  - soak: 0.5
  - open_flap
  - capture: {frames: 3, role: reference, interval_s: 0.5}
  - close_flap
  - stop_chamber
"""


def ignore(hub: Hub) -> None:
    pass


async def test_a_brief_run_in_real_time_over_serial_wires(
    tmp_path: Path, order: Callable[..., Order], simulator: Callable[..., object]
):
    """With a camera that is triggered and one that runs free."""
    side = {
        **FAST["camera"],
        **CORNER,
        "address": allocate_camera_address(),
        "serial_number": "TS-0002",
        "trigger": "free_run",
    }
    ordered = order(FRAMES, wire="serial", **FAST, cameras={"side": side})
    await asyncio.to_thread(simulator, ordered.config, False)
    session = Session.open(await run_real(ordered, tmp_path / "out", ignore))
    assert session.metadata["clock_source"] == "wall"
    for name in ("camera", "side"):
        frames = [frame for frame in session.frames() if frame.channel == f"{name}.image"]
        assert len(frames) == 3
        times_s = np.diff([frame.time_ns for frame in frames]) / 1e9
        assert np.all(times_s > 0.3)
        assert all(frame.image.max() > 150 for frame in frames)
    assert session.readings("regulator.pv")[1].size >= 4


async def test_an_interrupt_leaves_the_stand_safe_and_the_session_readable(
    tmp_path: Path, order: Callable[..., Order], simulator: Callable[..., object]
):
    ordered = order(BRIEF.replace("equilibrium_s: 0.5", "equilibrium_s: 3600"), **FAST)
    await asyncio.to_thread(simulator, ordered.config, False)

    def watch(hub: Hub) -> None:
        def interrupt(item: Item) -> None:
            if isinstance(item, StepMark) and item.kind == "soak":
                os.kill(os.getpid(), signal.SIGINT)

        hub.subscribe(interrupt)

    with pytest.raises(Interrupted, match="stopped by the operator"):
        await run_real(ordered, tmp_path / "out", watch)
    session = Session.open(next((tmp_path / "out").iterdir()))
    assert session.incomplete == ()
    assert session.readings("regulator.running")[1][-1] == 0
    assert session.readings("relays.heater_enable")[1][-1] == 0
    assert any("stopped by the operator" in event.text for event in session.events())


async def test_a_run_by_itself_has_the_page_and_secop_of_its_file_and_either_stops_it(
    tmp_path: Path, order: Callable[..., Order], simulator: Callable[..., object]
):
    ordered = order(BRIEF.replace("equilibrium_s: 0.5", "equilibrium_s: 3600"), **FAST)
    await asyncio.to_thread(simulator, ordered.config, False)
    ports = InterfaceConfig(port=find_free_port(), secop_port=find_free_port())
    config = ordered.config.model_copy(update={"interface": ports})
    lines, moments, out = list[str](), list[StatusSnapshot](), tmp_path / "out"
    shown = RunFollower(moments.append, lines.append, out)
    front = shown.make_front(make_interface(config, out), ordered.target_text)
    run = asyncio.create_task(run_real(ordered, out, shown.watch, front=front))
    server = make_server(f"http://127.0.0.1:{ports.port}")
    async with asyncio.timeout(60.0):
        while not moments:
            await asyncio.sleep(0.1)
    state = await asyncio.to_thread(server.state, 30.0)
    assert [(each.recipe, each.state) for each in state.queue] == [("brief", "running")]
    devices = cast("list[dict[str, str]]", await asyncio.to_thread(server.request, "GET", f"{API}/devices", None, 30.0))
    assert all(each["refused"] for each in devices)
    with pytest.raises(SessionError, match="kept"):
        await asyncio.to_thread(server.request, "POST", f"{API}/queue", {"recipe": "demo"}, 30.0)
    with urllib.request.urlopen(f"http://127.0.0.1:{ports.port}/") as page:
        assert b"thermostand" in page.read()
    async with talking(ports.secop_port or 0) as talk:
        assert (await talk.asked("read run:_recipe"))[2][0] == "brief"
        assert (await talk.asked("do run:stop"))[0] == "done"
    with pytest.raises(Interrupted):
        await run
    assert (moments[-1].title, lines[-1].partition(":")[0]) == ("brief on simulated-stand", "error")
    assert Session.open(next(path for path in out.iterdir() if path.is_dir())).readings("regulator.running")[1][-1] == 0


@pytest.mark.parametrize("number", [signal.SIGINT, pytest.param(signal.SIGTERM, marks=pytest.mark.nightly)])
async def test_a_simulated_laboratory_that_is_ended_leaves_nothing_behind(
    tmp_path: Path, order: Callable[..., Order], number: signal.Signals
):
    """Also when other threads, here those of OpenBLAS, could be handed the signal."""
    ordered = order(BRIEF)
    command = await asyncio.create_subprocess_exec(
        *(sys.executable, "-m", "thermostand.stand.cli", "simulate", str(tmp_path / "config.yaml")),
        stderr=asyncio.subprocess.PIPE,
        env={**os.environ, "OPENBLAS_NUM_THREADS": "4"},
    )
    assert command.stderr is not None
    assert b"answers; Ctrl-C ends it" in await command.stderr.readline()
    assert (tmp_path / "linear").is_symlink()
    command.send_signal(number)
    assert await command.wait() == 0
    assert not (tmp_path / "linear").is_symlink()
    assert ordered.config.simulation is not None
    with pytest.raises(Unreachable, match="nobody listens"):
        await ControlSocket(ordered.config.simulation.control).open()
