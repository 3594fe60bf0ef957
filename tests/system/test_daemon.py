"""A stand that is served for days, over real wires, its socket and the command line: runs are guests, and what is done
by hand between them goes through the same gate."""

import asyncio
import gc
import itertools
import signal
import subprocess
import sys
import threading
import time
from collections.abc import AsyncGenerator, Callable, Iterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import cast

import pytest

from tests import fork_server
from tests.nightly import mark_nightly
from tests.system.test_real_time import BRIEF as CYCLE
from tests.system.test_two_runs import Laboratory
from thermostand.foundation.clock import WallClock
from thermostand.foundation.errors import SessionError
from thermostand.foundation.hub import Hub
from thermostand.foundation.items import Event
from thermostand.recording.reading.notes import read_notes
from thermostand.recording.reading.session import Session
from thermostand.stand.assembly.assemble import assemble
from thermostand.stand.config.stand_config import find_packaged, load_config
from thermostand.stand.running.run import Run
from thermostand.stand.service.daemon import Daemon
from thermostand.stand.service.daemon import serve as serve_stand
from thermostand.stand.service.stand_service import DeviceRequest, StandService, SubmitRequest
from thermostand.stand.serving.api_models import Conflict, Requester, StandState
from thermostand.stand.serving.client import Server, find_session_server

LIMIT_S = 120.0  # for a busy machine
BRIEF = """
name: brief
steps: [start_chamber: 26, soak: 0.5, stop_chamber]
"""
LONG = CYCLE.replace("equilibrium_s: 0.5", "equilibrium_s: 3600").replace("[26]", "[40]")


class Served:
    """A daemon of its own process, and what it answers."""

    def __init__(self, config_file: Path, out: Path) -> None:
        self.out = out
        arguments = ["--config", str(config_file), "--out", str(out), "--no-reports"]
        command = [sys.executable, "-m", "thermostand.stand.cli", "serve", *arguments]
        self.process = fork_server.popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)

    @property
    def server(self) -> Server:
        return find_session_server(self.out)

    def state(self) -> StandState:
        return self.server.state(20.0)

    def until(self, wanted: Callable[[StandState], bool]) -> StandState:
        """The first state that is as wanted; the last one and what the daemon said when there is none in time."""
        end_s, state = time.monotonic() + LIMIT_S, None
        while time.monotonic() < end_s:
            if self.process.poll() is not None:
                pytest.fail(f"the daemon has ended: {self.process.communicate()[0]}")
            try:
                state = self.state()
            except SessionError:
                state = None
            if state is not None and wanted(state):
                return state
            threading.Event().wait(0.1)
        pytest.fail(f"not in time; {None if state is None else state.model_dump(exclude={'readings'})}")

    def post(self, path: str, **body: object) -> dict[str, object]:
        answer = self.server.request("POST", f"/api/v1/{path}", body, 20.0)
        assert isinstance(answer, dict)
        return answer

    def submit(self, recipe: str, key: str = "", **more: object) -> dict[str, object]:
        return self.post("queue", recipe_text=recipe, key=key, **more)

    def reported(self) -> str:
        """What it said, after its end."""
        return self.process.communicate(timeout=LIMIT_S)[0]


@pytest.fixture
def serve(tmp_path: Path, laboratory: Path) -> Iterator[Callable[[], Served]]:
    """Start daemons of this laboratory; whatever is left of them ends with the test."""
    started: list[Served] = []

    def start() -> Served:
        started.append(Served(laboratory, tmp_path / "out"))
        return started[-1]

    yield start
    for served in started:
        served.process.kill()
        served.process.communicate()


def is_idle(state: StandState) -> bool:
    return state.phase == "idle" and len(state.readings) > 10


def states_of(state: StandState) -> list[str]:
    return [run.state for run in state.queue]


def test_a_served_stand_runs_what_is_queued_and_is_operated_by_hand_in_between(serve: Callable[[], Served]):
    served = serve()
    idle = served.until(is_idle)
    assert idle.run is None
    assert served.server.request("GET", "/api/v1/history?from_ns=0&to_ns=4000000000000000000&points=10")
    assert idle.readings["thermometers.air"].value is not None
    assert not idle.heater_permitted
    served.submit(BRIEF, "one")
    served.submit(BRIEF, "one")  # asked again: the same
    with pytest.raises(SessionError, match="one word"):
        served.submit(BRIEF, "three", tags=["two words"])
    second = served.submit(BRIEF.replace("name: brief", "name: other"), "two", note="a new lens", tags=["lens-b"])
    running = served.until(lambda state: state.run is not None and bool(state.queue[0].session))
    with pytest.raises(SessionError, match="has the stand"):
        served.post("devices/flap/open")
    with pytest.raises(SessionError, match="another one"):
        served.submit(LONG, "two")
    done = served.until(lambda state: states_of(state) == ["done", "done"] and state.phase == "idle")
    assert [run.recipe for run in done.queue] == ["brief", "other"]
    assert second["id"] == 2
    assert running.queue[0].session.endswith("-brief")
    served.post(f"sessions/{done.queue[1].session}/notes", text="all well", tags=["good"])
    by_operator = read_notes(served.out / done.queue[1].session)
    assert ([note.text for note in by_operator.notes], by_operator.tags) == (
        ["a new lens", "all well"],
        ("lens-b", "good"),
    )
    with pytest.raises(SessionError, match="no session of that"):
        served.post("sessions/no-such/notes", text="x")
    assert not done.heater_permitted
    served.post("devices/flap/open")
    served.until(lambda state: state.flap == "open")
    served.post("devices/flap/close")
    served.until(lambda state: state.flap == "closed")
    served.post("devices/linear/move", arguments={"position": 3.0})
    served.until(lambda state: abs((state.axes["linear"] or 0.0) - 3.0) < 0.01)
    served.post("devices/camera/frame", arguments={"exposure_s": 0.01})
    served.post("devices/regulator/set", arguments={"setpoint_degC": 30.0})
    served.until(lambda state: state.setpoint_degC == 30.0 and state.readings["relays.heater_enable"].value == 1)
    assert (by_hand := served.state().by_hand) is not None
    assert (by_hand.setpoint_degC, by_hand.since_ns > done.now_ns) == (30.0, True)
    with pytest.raises(SessionError, match=r"outside|limits"):
        served.post("devices/regulator/set", arguments={"setpoint_degC": 300.0})
    served.post("run/stop")
    served.until(lambda state: state.readings["relays.heater_enable"].value == 0 and state.setpoint_degC is None)
    assert served.state().by_hand is None
    counters = served.state().counters
    assert counters["flap_cycles"] >= 1
    assert counters["stage_cycles.linear"] >= 1
    served.process.send_signal(signal.SIGHUP)  # it has no tokens to be read again
    assert served.server.request("GET", "/api/v1/state")
    served.process.send_signal(signal.SIGTERM)
    reported = served.reported()
    assert served.process.returncode == 0, reported
    (folder,) = served.out.glob("*-idle-log*")  # all of a day is in one session
    session = Session.open(folder)
    assert session.incomplete == ()
    assert any(event.kind == "tokens_not_read" for event in session.events())
    assert any(event.kind == "command" and event.data.get("verb") == "device" for event in session.events())
    assert len(list(session.frames())) == 1
    for name in ("brief", "other"):
        (run,) = [path for path in served.out.iterdir() if path.name.endswith(f"-{name}")]
        events = Session.open(run).events()
        assert events[-1].data.get("status") == "complete"
        assert [event.text for event in events if event.kind == "repaired"] == []


def test_a_stop_ends_the_run_and_leaves_the_daemon_with_a_safe_stand(serve: Callable[[], Served]):
    served = serve()
    served.until(is_idle)
    served.submit(LONG)
    served.until(lambda state: state.run is not None and state.heater_permitted)
    served.post("run/stop")
    idle = served.until(lambda state: is_idle(state) and states_of(state) == ["stopped"])
    assert "stopped by the operator" in idle.queue[0].reason
    assert idle.readings["relays.heater_enable"].value == 0
    assert idle.fault is None
    served.submit(BRIEF)
    served.until(lambda state: states_of(state) == ["stopped", "done"])


async def heater_goes_off(config_file: Path) -> None:
    async with Laboratory(config_file) as laboratory:
        end_s = time.monotonic() + LIMIT_S
        while await laboratory.heater_is_on():
            assert time.monotonic() < end_s
            await asyncio.sleep(0.2)


async def leave_flap_open(config_file: Path) -> None:
    """As a daemon that died in a capture does: the driver leaves the flap where it is."""
    assembly = assemble(load_config(config_file), Hub(), WallClock())
    flap = assembly.devices.flap
    await flap.open()
    await flap.move_open()
    await flap.close()


def test_a_killed_daemon_drops_the_heat_and_its_run_is_offered_and_resumed(
    serve: Callable[[], Served], laboratory: Path
):
    served = serve()
    served.until(is_idle)
    served.submit(LONG.replace("3600", "20"))
    served.until(lambda state: state.run is not None and state.readings["relays.heater_enable"].value == 1)
    served.process.send_signal(signal.SIGKILL)
    served.process.wait()
    asyncio.run(heater_goes_off(laboratory))  # nobody is there to switch it
    asyncio.run(leave_flap_open(laboratory))
    again = serve()
    offered = again.until(is_idle)
    assert offered.flap == "closed"
    assert states_of(offered) == ["interrupted"]
    assert "resume it" in offered.queue_halted
    assert not offered.heater_permitted
    assert offered.readings["relays.heater_enable"].value == 0
    session = offered.queue[0].session
    command = [
        sys.executable,
        "-m",
        "thermostand.stand.cli",
        "resume",
        str(again.out / session),
        "--config",
        str(laboratory),
    ]
    follower = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
    again.until(lambda state: state.run is not None)
    with pytest.raises(subprocess.TimeoutExpired):
        follower.wait(1.0)  # it looks twice a second
    again.process.send_signal(signal.SIGTERM)
    reported = again.reported()
    follower.kill()
    follower.communicate()
    assert again.process.returncode == 0, reported
    kinds = [event.kind for event in Session.open(again.out / session).events()]
    assert "run.resume" in kinds


def test_a_trip_between_runs_is_latched_over_a_restart_until_it_is_cleared(
    serve: Callable[[], Served], laboratory: Path, tmp_path: Path
):
    served = serve()
    served.until(is_idle)
    (folder,) = [path for path in served.out.iterdir() if path.name.endswith("-idle-log")]
    served.post("devices/regulator/set", arguments={"setpoint_degC": 30.0})
    served.until(lambda state: state.readings["relays.heater_enable"].value == 1)
    folder.rename(folder.with_name("elsewhere"))
    tripped = served.until(lambda state: state.fault is not None)
    assert tripped.fault is not None
    assert tripped.fault.rule == "folder_lost"
    served.until(lambda state: state.readings["relays.heater_enable"].value == 0)
    with pytest.raises(SessionError, match="the stand has tripped"):
        served.post("devices/regulator/set", arguments={"setpoint_degC": 30.0})
    served.submit(BRIEF)
    assert states_of(served.state()) == ["waiting"]
    served.process.send_signal(signal.SIGKILL)
    served.process.wait()
    elsewhere = Served(laboratory, tmp_path / "other")
    try:
        assert (found := elsewhere.until(is_idle).fault) is not None
        assert found.rule == tripped.fault.rule
    finally:
        elsewhere.process.send_signal(signal.SIGKILL)
        elsewhere.process.communicate()
    run = [
        sys.executable,
        "-m",
        "thermostand.stand.cli",
        "run",
        "warm-up",
        "--config",
        str(laboratory),
        "--out",
        str(tmp_path),
    ]
    refused = fork_server.popen(run, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    assert "the stand has tripped" in refused.communicate()[0]
    assert refused.returncode == 1
    again = serve()
    latched = again.until(is_idle)
    assert latched.fault is not None
    assert latched.counters["relay_cycles.heater_enable"] >= 1  # of the daemon before
    assert latched.fault.rule == tripped.fault.rule
    again.post("run/reset")
    again.until(lambda state: state.fault is None and states_of(state) == ["done"])


@pytest.mark.parametrize("kills", [2, mark_nightly(20)])
def test_a_trip_that_somebody_has_heard_of_is_never_forgotten(laboratory: Path, tmp_path: Path, kills: int):
    """Killed as soon as the stand's state says it; what is left is reset without a daemon."""
    for kill in range(kills):
        served = Served(laboratory, tmp_path / f"out-{kill}")
        try:
            served.until(is_idle)
            (folder,) = [path for path in served.out.iterdir() if path.name.endswith("-idle-log")]
            folder.rename(folder.with_name("elsewhere"))
            served.until(lambda state: state.fault is not None)
        finally:
            served.process.send_signal(signal.SIGKILL)
            served.process.communicate()
        command = [sys.executable, "-m", "thermostand.stand.cli", "reset", "--config", str(laboratory)]
        process = fork_server.popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
        assert "reset: the folder" in process.communicate()[0]
        assert process.returncode == 0


def test_a_second_daemon_and_a_second_run_touch_nothing(serve: Callable[[], Served], laboratory: Path, tmp_path: Path):
    served = serve()
    served.until(is_idle)
    second = Served(laboratory, tmp_path / "other")
    reported = second.reported()
    assert second.process.returncode == 1
    assert "daemon of `stand serve`" in reported
    assert served.state().fault is None


def test_the_end_of_the_daemon_ends_its_run_which_may_be_resumed(serve: Callable[[], Served]):
    served = serve()
    served.until(is_idle)
    served.submit(LONG)
    served.until(lambda state: state.run is not None and state.heater_permitted)
    began_s = time.monotonic()
    served.process.send_signal(signal.SIGTERM)
    reported = served.reported()
    assert served.process.returncode == 0, reported
    assert time.monotonic() - began_s < 30.0
    assert states_of(serve().until(is_idle)) == ["interrupted"]


def run_command(config_file: Path, recipe: str, *options: str) -> "subprocess.Popen[str]":
    recipe_file = config_file.with_name("recipe.yaml")
    recipe_file.write_text(recipe)
    command = [
        sys.executable,
        "-m",
        "thermostand.stand.cli",
        "run",
        str(recipe_file),
        "--config",
        str(config_file),
        *options,
    ]
    return fork_server.popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def test_stand_run_goes_through_the_daemon_that_has_the_stand(serve: Callable[[], Served], laboratory: Path):
    served = serve()
    served.until(is_idle)
    run = run_command(laboratory, BRIEF)
    out, err = run.communicate(timeout=LIMIT_S)
    assert run.returncode == 0, err
    assert Path(out.strip()).name.endswith("-brief")
    assert Session.open(Path(out.strip())).events()[-1].data.get("status") == "complete"
    long = run_command(laboratory, LONG)
    served.until(lambda state: state.run is not None and state.heater_permitted)
    detached = run_command(laboratory, BRIEF, "--detach")
    assert "run 3 is queued" in detached.communicate(timeout=LIMIT_S)[0]
    long.send_signal(signal.SIGINT)
    _, err = long.communicate(timeout=LIMIT_S)
    assert long.returncode == 130
    assert "the stand is safe" in err
    halted = served.until(lambda state: is_idle(state) and states_of(state) == ["done", "stopped", "waiting"])
    assert halted.queue_halted  # who presses stop does not want the next one to begin
    served.post("run/reset")
    served.until(lambda state: states_of(state) == ["done", "stopped", "done"])


async def test_a_run_leaves_nothing_of_itself_in_the_daemon_and_nothing_is_heated_without_a_record(
    laboratory: Path, tmp_path: Path
):
    """In this process, in which the daemon's objects can be counted and its record taken away."""
    config, out, who = load_config(laboratory), tmp_path / "out", Requester(name="a test", how="terminal")
    texts = {"config.yaml": laboratory.read_text(), "target.yaml": find_packaged("targets", config.target).read_text()}
    subscribers: list[int] = []
    lines: set[str] = set()

    async def tell(hub: Hub, clock: WallClock) -> None:
        for number in itertools.count():
            lines.add(str(number))
            hub.publish(Event(clock.now_ns(), "info", "tick", str(number)))
            await asyncio.sleep(0.02)

    of_other_tests = {id(found) for found in gc.get_objects() if isinstance(found, Run)}  # whose failures hold them

    async def until(desk: StandService, wanted: Callable[[StandState], bool]) -> None:
        end_s = time.monotonic() + LIMIT_S
        while not wanted(desk.state()):
            assert time.monotonic() < end_s
            await asyncio.sleep(0.05)

    @asynccontextmanager
    async def front(desk: StandService, hub: Hub, clock: WallClock) -> AsyncGenerator[None]:
        daemon = cast("Daemon", desk.host)

        async def work() -> None:
            telling = asyncio.create_task(tell(hub, clock))
            for number in (1, 2):
                await desk.submit(who, SubmitRequest(recipe_text=BRIEF))
                await until(desk, lambda state, done=number: states_of(state) == ["done"] * done)
                await until(desk, is_idle)
                subscribers.append(len(getattr(hub, "_subscribers")))  # noqa: B009 - as above
            gc.collect()
            left = [found for found in gc.get_objects() if isinstance(found, Run)]
            assert [found for found in left if id(found) not in of_other_tests] == []
            del left
            telling.cancel()
            await daemon.record.end()
            with pytest.raises(Conflict, match="without a recording"):
                await desk.device(who, DeviceRequest(device="regulator", verb="set", arguments={"setpoint_degC": 30.0}))
            assert not desk.state().heater_permitted

        working = asyncio.create_task(work())
        working.add_done_callback(lambda _: daemon.leave())
        yield
        await working

    await asyncio.wait_for(serve_stand(config, "a stand", texts, out, front), 3 * LIMIT_S)
    assert len(set(subscribers)) == 1
    recorded = {event.text for path in out.glob("2*") for event in Session.open(path).events() if event.kind == "tick"}
    assert (
        len(lines - recorded) <= len(lines) / 20
    )  # a third of them, where nothing is recorded while a run is completed
