"""A whole run over every wire, in virtual time, against the simulator in its own process."""

import asyncio
import contextlib
import hashlib
import itertools
import os
import pickle
import resource
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from tests import fork_server
from tests.system.conftest import AS_INSTALLED, CORNER, SHORT_RECIPE, WHOLE_SENSOR
from thermostand.foundation.clock import NS_PER_S, to_ns
from thermostand.foundation.errors import ConfigError, SessionError, StandError, StandTripped, Unreachable
from thermostand.foundation.hub import Hub
from thermostand.foundation.items import Batch, Event, Item, StepMark, StepState
from thermostand.recording.reading.session import Session
from thermostand.stand.assembly.simulator import ControlSocket
from thermostand.stand.running.order import Order
from thermostand.stand.service.run import Interrupted, run_virtual


def digests(session: Path) -> dict[str, str]:
    return {
        str(path.relative_to(session)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(session.rglob("*"))
        if path.is_file()
    }


def ignore(hub: Hub) -> None:
    pass


async def fault(order: Order, name: str, value: object) -> None:
    simulation = order.config.simulation
    assert simulation is not None
    control = ControlSocket(simulation.control)
    await control.open()
    await control.request({"do": "fault", "name": name, "value": value})
    await control.close()


def at_step(kind: str, action: Callable[[], object]) -> Callable[[Hub], None]:
    """Do `action` when the first step of this kind begins."""
    done: list[object] = []

    def follow(item: Item) -> None:
        if isinstance(item, StepMark) and item.kind == kind and item.state is StepState.STARTED and not done:
            done.append(action())

    return lambda hub: hub.subscribe(follow)


async def test_the_same_recipe_and_seed_twice_give_byte_identical_sessions(tmp_path: Path, order: Callable[..., Order]):
    ordered = order()
    first = await run_virtual(ordered, tmp_path / "first", 7, ignore)
    second = await run_virtual(ordered, tmp_path / "second", 7, ignore)
    assert digests(first) == digests(second)
    assert len(digests(first)) >= 2

    session = Session.open(first)
    assert session.frame_count == 5
    captures = {step.step_id: step for step in session.steps() if step.kind == "capture"}
    frames = list(session.frames())
    assert all(frame.step_id in captures for frame in frames)
    assert frames[0].image.shape == (CORNER["height_px"], CORNER["width_px"])
    assert frames[0].image.max() > 150  # the flap was open
    assert [event.kind for event in session.events() if event.kind.startswith("run.")] == ["run.start", "run.end"]
    check_temperatures(session)

    with pytest.raises(Interrupted):  # of another seed the first frames are enough
        await run_virtual(
            ordered, tmp_path / "third", 8, at_step("set_temperature", lambda: os.kill(os.getpid(), signal.SIGINT))
        )
    third = Session.open(next((tmp_path / "third").iterdir()))
    assert not np.array_equal(next(third.frames()).image, frames[0].image)


def check_temperatures(session: Session) -> None:
    """The chamber follows its set-points, the camera heats itself, and the last word is a stand at rest."""
    times_ns, pv_degC = session.readings("regulator.pv")
    marks = [step for step in session.steps() if step.kind == "set_temperature" and step.state is StepState.DONE]
    for mark, end in zip(marks, [*marks[1:], session.steps()[-1]], strict=True):
        before_end = pv_degC[(times_ns > mark.time_ns) & (times_ns < end.time_ns)][-5:]
        wanted = float(str(mark.parameters["chamber_degC"]))
        assert abs(before_end.mean() - wanted) < 2.0  # ten minutes only
    assert session.readings("camera.temperature")[1].max() > 35
    for relay in ("relays.heater_enable", "relays.compressor"):
        assert session.readings(relay)[1][-1] == 0
    assert session.readings("flap.position")[1][-1] == pytest.approx(0, abs=0.02)
    assert session.readings("linear.position")[1][-1] == pytest.approx(2.0, abs=1e-6)
    assert session.readings("rotary.position")[1][-1] == pytest.approx(1.0, abs=1e-6)
    air = session.readings("thermometers.air")[1]
    assert np.isfinite(air).all()


@pytest.mark.parametrize(
    ("name", "value", "reason"),
    [
        ("thermometer.open", "air", "thermometers.air is BAD"),
        ("regulator.sensor_break", True, "regulator.pv is BAD"),
        ("bus.silent", True, "BAD|last good"),
        ("regulator.pv_offset_K", 60, "regulator.pv is 8.* above the limit of 65.0 degC"),
    ],
)
async def test_a_lost_safety_sensor_makes_the_stand_safe_and_ends_the_run(
    tmp_path: Path, order: Callable[..., Order], name: str, value: object, reason: str
):
    ordered = order(bus={"timeout_s": 0.1}, guard={"safe_limit_s": 5})
    tasks: list[asyncio.Task[None]] = []
    events: list[Event] = []

    def watch(hub: Hub) -> None:
        at_step("soak", lambda: tasks.append(asyncio.create_task(fault(ordered, name, value))))(hub)
        hub.subscribe(lambda item: events.append(item) if isinstance(item, Event) else None)

    with pytest.raises(StandTripped, match=reason):
        await run_virtual(ordered, tmp_path / "out", None, watch)
    await asyncio.gather(*tasks)
    session = Session.open(next((tmp_path / "out").iterdir()))
    assert any(event.kind.startswith("guard.") for event in session.events())
    assert [event.text[:8] for event in session.events() if event.kind == "run.end"] == ["aborted:"]
    if name != "bus.silent":
        assert session.readings("relays.heater_enable")[1][-1] == 0
        assert session.readings("regulator.running")[1][-1] == 0
    failed = [step for step in session.steps() if step.state is StepState.FAILED]
    assert [step.kind for step in failed] == ["soak"]


DAEMON = """
import asyncio, pickle, sys
from pathlib import Path
from thermostand.foundation.items import Batch
from thermostand.stand.service.run import run_virtual

order, out = pickle.loads(sys.stdin.buffer.read())

def watch(hub):
    def follow(item):
        if isinstance(item, Batch) and item.device == "regulator" and hub.latest("regulator.mv_heat").value > 50:
            print("heating", flush=True)
    hub.subscribe(follow)

asyncio.run(run_virtual(order, out, None, watch))
"""


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP], ids=["killed", "stopped"])
async def test_a_dead_daemon_does_not_heat(tmp_path: Path, order: Callable[..., Order], number: signal.Signals):
    ordered = order()
    command = [sys.executable, "-m", "tests.code", DAEMON]
    daemon = fork_server.popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    assert daemon.stdin is not None
    assert daemon.stdout is not None
    daemon.stdin.write(pickle.dumps((ordered, tmp_path / "out")))
    daemon.stdin.close()
    assert (await asyncio.to_thread(daemon.stdout.readline)).strip() == b"heating"
    daemon.send_signal(number)
    if number is signal.SIGKILL:
        await asyncio.to_thread(daemon.wait)

    simulation = ordered.config.simulation
    assert simulation is not None
    control = ControlSocket(simulation.control)
    await control.open()
    before, earlier = await control.request({"do": "state"}), None
    while before != earlier:  # what it has sent before it stopped is still on its way
        await asyncio.sleep(0.1)
        before, earlier = await control.request({"do": "state"}), before
    assert before["heater_enabled"] == 1
    assert isinstance(before["now_ns"], int)
    off_ns = before["now_ns"] + to_ns(ordered.config.guard.heater_hold_s + 1)
    await control.advance(off_ns)  # a second later: what was on the wire arrives when time goes on
    after = await control.request({"do": "state"})
    assert after["heater_enabled"] == 0
    assert after["compressor_on"] == 0
    await control.advance(off_ns + NS_PER_S)
    assert (await control.request({"do": "state"}))["heater_W"] == 0
    with contextlib.suppress(Unreachable):  # it may be gone before it has answered
        await control.request({"do": "quit"})
    await control.close()
    if number is signal.SIGSTOP:
        daemon.kill()
        await asyncio.to_thread(daemon.wait)
    daemon.stdout.close()


SHORTER = SHORT_RECIPE.replace("600", "60").replace("[30, 20, 24]", "[26]").replace("held_out_degC: [20]", "")
EVERY_KIND = SHORT_RECIPE.replace("frames_per_point: 1", "frames_per_point: 20")


@pytest.mark.parametrize("kind", ["move_to", "start_chamber", "soak", "open_flap", "capture", "close_flap"])
async def test_an_interrupt_in_any_step_leaves_the_stand_safe(tmp_path: Path, order: Callable[..., Order], kind: str):
    """The step's own command is on the wire when the interrupt comes: it must not win over making safe."""
    with pytest.raises(Interrupted, match="stopped by the operator"):
        await run_virtual(
            order(EVERY_KIND), tmp_path / "out", None, at_step(kind, lambda: os.kill(os.getpid(), signal.SIGINT))
        )
    session = Session.open(next((tmp_path / "out").iterdir()))
    assert session.incomplete == ()
    for channel in ("regulator.running", "relays.heater_enable", "relays.compressor", "linear.moving"):
        assert session.readings(channel)[1][-1] == 0, channel
    assert session.readings("flap.position")[1][-1] == pytest.approx(0, abs=0.02)
    assert [event.text[:7] for event in session.events() if event.kind == "run.end"] == ["aborted"]


@pytest.mark.parametrize("delay_s", [0.0, 0.2, 0.6, 1.0])
async def test_an_interrupt_while_the_stand_is_opened_leaves_no_simulator(
    tmp_path: Path, order: Callable[..., Order], delay_s: float
):
    ordered = order()
    asyncio.get_running_loop().call_later(delay_s, os.kill, os.getpid(), signal.SIGTERM)
    with pytest.raises(Interrupted, match="stopped by the operator"):
        await run_virtual(ordered, tmp_path / "out", None, ignore)
    simulation = ordered.config.simulation
    assert simulation is not None
    with pytest.raises(Unreachable, match="nobody listens"):
        await ControlSocket(simulation.control).open()


async def test_a_compressor_that_dropped_by_itself_rests_before_it_starts_again(
    tmp_path: Path, order: Callable[..., Order]
):
    """The relay board is silent for longer than the compressor's timed-on relay holds, then answers again."""
    recipe = SHORT_RECIPE.replace("[30, 20, 24]", "[10]").replace("held_out_degC: [20]", "held_out_degC: []")
    ordered = order(recipe.replace("soak_s: 600", "soak_s: 1500"), bus={"timeout_s": 0.1})
    states: list[tuple[int, float]] = []
    tasks: list[asyncio.Task[None]] = []

    def follow(item: Item) -> None:
        if isinstance(item, Batch) and item.device == "relays":
            states.append((item.time_ns, next(r.value for r in item.readings if r.channel == "relays.compressor")))
            if states[-1][1] == 1 and not tasks:
                tasks.append(asyncio.create_task(fault(ordered, "relays.silent_s", 40)))

    await run_virtual(ordered, tmp_path / "out", None, lambda hub: hub.subscribe(follow))
    await asyncio.gather(*tasks)
    known = [(time_ns, value) for time_ns, value in states if value == value]
    offs = [later for (_, was), (later, value) in itertools.pairwise(known) if was == 1 and value == 0]
    ons = [later for (_, was), (later, value) in itertools.pairwise(known) if was == 0 and value == 1]
    assert offs
    rests_s = [(min(on for on in ons if on > off) - off) / 1e9 for off in offs if any(on > off for on in ons)]
    assert rests_s
    assert min(rests_s) >= 270  # min_off_s 300, seen by a poll every 10 s after a drop during the silence


def refusing_from_the_first_capture(until: Callable[[Item], bool]) -> Callable[[Hub], None]:
    """The kernel refuses files beyond 1 MB from then on, as a full disk would; telemetry still fits."""
    hard = resource.getrlimit(resource.RLIMIT_FSIZE)[1]

    def watch(hub: Hub) -> None:
        def lift(item: Item) -> None:
            if until(item):
                resource.setrlimit(resource.RLIMIT_FSIZE, (hard, hard))

        at_step("capture", lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (1_000_000, hard)))(hub)
        hub.subscribe(lift)

    return watch


@pytest.fixture
def _file_size_restored() -> Iterator[None]:
    hard = resource.getrlimit(resource.RLIMIT_FSIZE)[1]
    yield
    resource.setrlimit(resource.RLIMIT_FSIZE, (hard, hard))


@pytest.mark.usefixtures("_file_size_restored")
async def test_frames_the_disk_refuses_are_counted_and_hold_the_run_until_it_takes_frames_again(
    tmp_path: Path, order: Callable[..., Order]
):
    watch = refusing_from_the_first_capture(
        until=lambda item: isinstance(item, Event) and item.kind == "guard.not_recorded"
    )
    ordered = order(SHORTER, **AS_INSTALLED | {"camera": AS_INSTALLED["camera"] | WHOLE_SENSOR})
    with pytest.raises(SessionError, match="complete, but 2 frames were lost"):
        await run_virtual(ordered, tmp_path / "out", None, watch)
    session = Session.open(next((tmp_path / "out").iterdir()))
    assert session.frame_count == 1
    kinds = [event.kind for event in session.events()]
    assert [kind for kind in kinds if kind in ("frames_dropped", "guard.not_recorded", "hold_ended", "run.end")] == [
        "frames_dropped",
        "guard.not_recorded",
        "hold_ended",
        "run.end",
    ]


@pytest.mark.usefixtures("_file_size_restored")
async def test_a_virtual_run_whose_disk_never_takes_frames_ends_with_a_sentence(
    tmp_path: Path, order: Callable[..., Order]
):
    watch = refusing_from_the_first_capture(until=lambda item: False)
    ordered = order(SHORTER, camera=WHOLE_SENSOR, guard={"pause_limit_h": 0.1})
    with pytest.raises(StandError, match=r"held for 0.2 h of virtual time .*, and nobody continued it"):
        await run_virtual(ordered, tmp_path / "out", None, watch)
    session = Session.open(next((tmp_path / "out").iterdir()))
    assert session.frame_count == 0
    assert next(event.text for event in session.events() if event.kind == "run.end").startswith(
        "failed: held for 0.2 h"
    )
    # Two frames, and again two each of the three times that the capture is taken again.
    assert any("8 in all" in event.text for event in session.events() if event.kind == "frames_dropped")


async def test_a_second_laboratory_at_the_same_addresses_is_refused_with_a_reason(
    tmp_path: Path, order: Callable[..., Order], simulator: Callable[..., object]
):
    ordered = order()
    await asyncio.to_thread(simulator, ordered.config, False)
    with pytest.raises(ConfigError, match="is one running already"):
        await run_virtual(ordered, tmp_path / "out", None, ignore)
    assert not (tmp_path / "out").exists()


async def test_an_existing_session_is_never_overwritten(tmp_path: Path, order: Callable[..., Order]):
    ordered = order()
    taken = tmp_path / "out" / "20260101T180000Z-short"
    taken.mkdir(parents=True)
    (tmp_path / "out" / "20260101T180000Z-short-2").symlink_to("nowhere")
    watch = at_step("move_to", lambda: os.kill(os.getpid(), signal.SIGINT))
    with pytest.raises(Interrupted):
        await run_virtual(ordered, tmp_path / "out", None, watch)
    assert not list(taken.iterdir())
    session = Session.open(tmp_path / "out" / "20260101T180000Z-short-3")
    assert session.metadata["session_id"] == session.path.name
