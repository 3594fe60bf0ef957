"""A host that is suspended, and whose system clock is stepped, under a run in real time over real wires."""

import asyncio
import contextlib
import itertools
import json
import os
import signal
import struct
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from tests.system.conftest import FAST
from thermostand.foundation.clock import NS_PER_S, to_ns
from thermostand.foundation.errors import StandError
from thermostand.foundation.events import CLOCK_STEP
from thermostand.foundation.hub import Hub
from thermostand.foundation.items import Item, StepMark
from thermostand.recording.reading.session import Session
from thermostand.stand.assembly.simulator import ControlSocket, Simulator, describe_laboratory
from thermostand.stand.commands.sessions.session_commands import app
from thermostand.stand.config.stand_config import StandConfig
from thermostand.stand.running.order import Order
from thermostand.stand.service.run import run_real

MOVED = Path(__file__).parent / "moved_clocks"
COLD = """
name: cold
experiments:
  - thermal_cycle: {reference_degC: 5, equilibrium_s: 3600, set_points_degC: [5], reference_frames: 1}
"""
BRIEF = """
name: brief
steps: [start_chamber: 26, soak: 1.5, stop_chamber]
"""
LIMIT_S = 90.0  # of real time for what should take a few seconds


class MovedTime:
    """What foundation.clock knows of the module `time`, of a host that a test suspends and steps."""

    def __init__(self) -> None:
        self.suspended_ns = self.step_ns = 0
        self.monotonic_ns, self.sleep = time.monotonic_ns, time.sleep  # noqa: TID251

    def clock_gettime_ns(self, clock: int) -> int:
        return time.clock_gettime_ns(clock) + self.suspended_ns

    def time_ns(self) -> int:
        return time.time_ns() + self.suspended_ns + self.step_ns  # noqa: TID251


async def test_a_suspend_and_a_step_of_the_system_clock_are_recorded_and_instants_go_on(
    tmp_path: Path, order: Callable[..., Order], simulator: Callable[..., object], monkeypatch: pytest.MonkeyPatch
):
    """The run may go on or trip on readings so old; either way it is recorded in instants that have passed."""
    ordered, host = order(BRIEF, **FAST), MovedTime()
    await asyncio.to_thread(simulator, ordered.config, False)
    monkeypatch.setattr("thermostand.foundation.clock.time", host)

    def watch(hub: Hub) -> None:
        def move(item: Item) -> None:
            if isinstance(item, StepMark) and item.kind == "soak" and not host.step_ns:
                host.suspended_ns, host.step_ns = to_ns(40), to_ns(-3600)

        hub.subscribe(move)

    with contextlib.suppress(StandError):
        await run_real(ordered, tmp_path / "out", watch)
    (directory,) = (tmp_path / "out").glob("*-brief")
    session = Session.open(directory)
    events = {event.kind: event for event in session.events()}
    assert events["host_suspended"].data["length_s"] == pytest.approx(40, abs=0.1)
    step = events[CLOCK_STEP]
    assert step.data["offset_before_ns"] == 0
    assert step.data["offset_after_ns"] == pytest.approx(to_ns(-3600), abs=to_ns(0.5))
    times_ns = session.readings("regulator.pv")[0]
    assert np.all(np.diff(times_ns) > 0)
    assert times_ns[-1] - times_ns[0] > to_ns(40)
    reported = json.loads(CliRunner().invoke(app, ["info", str(directory), "--json"]).stdout)
    assert reported["duration_s"] > 40
    assert reported["end"] < reported["start"]  # as the system clock had it
    assert reported["end_ns"] > reported["begin_ns"]


class Host:
    """Processes whose clocks are moved together: a simulated laboratory, and daemons one after another."""

    def __init__(self, folder: Path, order: Order, monkeypatch: pytest.MonkeyPatch) -> None:
        self._file, self._out, self._config = folder / "clocks", folder / "out", order.config
        self.moves(0, 0)
        self._environment = {
            "THERMOSTAND_MOVED_CLOCKS": str(self._file),
            "PYTHONPATH": os.pathsep.join([str(MOVED), *filter(None, [os.environ.get("PYTHONPATH")])]),
        }
        self._order = (str(folder / "recipe.yaml"), "--config", str(folder / "config.yaml"), "--out", str(self._out))
        with monkeypatch.context() as changed:
            for name, value in self._environment.items():
                changed.setenv(name, value)
            self.laboratory = Simulator(describe_laboratory(order.config, virtual=False, seed=None))

    def moves(self, suspended_s: float, step_s: float) -> None:
        """In all since the begin."""
        with self._file.open("r+b" if self._file.exists() else "wb") as file:
            file.write(struct.pack("qq", to_ns(suspended_s), to_ns(step_s)))

    @contextlib.contextmanager
    def daemon(self, *command: str) -> Iterator[subprocess.Popen[str]]:
        words = [sys.executable, "-m", "thermostand.stand.cli", *(command or ("run", *self._order))]
        environment = {**os.environ, **self._environment, "OPENBLAS_NUM_THREADS": "1"}
        process = subprocess.Popen(words, env=environment, stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        try:
            yield process
        finally:
            process.send_signal(signal.SIGINT)
            self.output = process.communicate(timeout=LIMIT_S)[1]

    def session(self) -> Path:
        return next(self._out.glob("*-cold"))

    async def until(self, wanted: Callable[[dict[str, float]], bool], what: str) -> dict[str, float]:
        """The laboratory's state as soon as it is so."""
        control = ControlSocket(_control(self._config))
        await control.open()
        try:
            for _ in range(round(LIMIT_S / 0.05)):
                state = await control.request({"do": "state"})
                if wanted(state):  # type: ignore[arg-type]
                    return state  # type: ignore[return-value]
                await asyncio.sleep(0.05)
        finally:
            await control.close()
        pytest.fail(f"not within {LIMIT_S} s: {what}")


def _control(config: StandConfig) -> str:
    assert config.simulation is not None
    return config.simulation.control


@pytest.mark.nightly
@pytest.mark.parametrize("step_s", [3600.0, -3600.0])
async def test_the_compressor_rests_whatever_the_system_clock_does_between_two_daemons(
    tmp_path: Path, order: Callable[..., Order], monkeypatch: pytest.MonkeyPatch, step_s: float
):
    """And `resume` goes on in a session that is an hour ahead of the system clock."""
    rest_s = 20.0
    compressor = {"min_off_s": rest_s, "min_on_s": 0, "state_file": str(tmp_path / "compressor.json")}
    accept = {"overrides": ["compressor.min_off_s", "compressor.min_on_s"]}
    host = Host(tmp_path, order(COLD, compressor=compressor, guard=accept), monkeypatch)
    try:
        with host.daemon() as first:
            await host.until(lambda state: state["compressor_on"] == 1, "the compressor runs")
            first.send_signal(signal.SIGINT)
            off = await host.until(lambda state: state["compressor_on"] == 0, "the compressor is off")
        host.moves(0, step_s)
        with host.daemon("resume", str(host.session()), "--config", str(tmp_path / "config.yaml")) as going_on:
            on = await host.until(lambda state: state["compressor_on"] == 1, "the compressor runs again")
            assert going_on.poll() is None
        assert rest_s - 1 <= (on["now_ns"] - off["now_ns"]) / NS_PER_S <= rest_s + 20
        await host.until(lambda state: state["compressor_on"] == 0, "the compressor is off")
    finally:
        host.laboratory.stop()
    session = Session.open(host.session())
    times_ns = session.readings("regulator.pv")[0]
    assert np.all(np.diff(times_ns) > 0)
    steps = [event.data["offset_after_ns"] for event in session.events() if event.kind == CLOCK_STEP]
    if step_s < 0:
        assert steps[0] == pytest.approx(to_ns(step_s), abs=to_ns(60))
        assert all(one == steps[0] for one, _ in itertools.pairwise(steps))
    else:
        assert steps == []  # the session goes on at the hour that the system clock has now
