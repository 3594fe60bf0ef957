"""The camera's own temperature over the wire: there before the first step, held for when it goes, excused when the
configuration says that there is none."""

import asyncio
from collections.abc import Callable
from pathlib import Path

import pytest
import yaml
from typer.testing import CliRunner

from tests.system.test_run import at_step, fault
from thermostand.experiments.steps import Capture, PlannedStep, Role, Soak
from thermostand.foundation.clock import NS_PER_S
from thermostand.foundation.hub import Hub
from thermostand.foundation.items import Batch, Event, Item
from thermostand.foundation.readings import Reading, bad_reading
from thermostand.recording.reading.session import Session
from thermostand.stand.commands.command_table import app
from thermostand.stand.config.stand_config import find_packaged, load_config
from thermostand.stand.guarding.rules import watch_camera_temperature
from thermostand.stand.running.memory.entries import Restarted, StepChanged
from thermostand.stand.running.memory.fold import apply_entry, fold
from thermostand.stand.running.order import Order
from thermostand.stand.service.run import run_virtual

CAPTURES = """
name: captures
experiments:
  - calibration: {equilibrium_s: 300, linear_mm: [0], rotary_deg: [0, 5], frames_per_position: 2}
"""


@pytest.mark.parametrize(
    ("temperature", "sentence"),
    [
        (
            {"entry": "sensor"},
            "DeviceTemperature of DeviceTemperatureSelector 'sensor' cannot be read",
        ),
        (
            {"entry": "Sensor", "min_degC": 100},
            "is outside 100..120 (DeviceTemperature of DeviceTemperatureSelector 'Sensor'",
        ),
    ],
)
def test_a_session_whose_camera_shows_no_temperature_is_refused_before_the_first_step(
    tmp_path: Path, config_text: Callable[..., str], temperature: dict[str, object], sentence: str
):
    recipe, config = tmp_path / "recipe.yaml", tmp_path / "stand.yaml"
    recipe.write_text(CAPTURES)
    config.write_text(config_text(camera={"temperature": temperature}))
    arguments = ["run", str(recipe), "--config", str(config), "--virtual-time", "--out", str(tmp_path / "sessions")]
    refused = CliRunner().invoke(app, arguments, catch_exceptions=False)
    assert refused.exit_code != 0
    assert "temperature is BAD before" in refused.stderr
    assert sentence in refused.stderr
    assert "offers Sensor, Mainboard" in refused.stderr
    assert "camera.has_temperature: false" in refused.stderr
    assert not list(tmp_path.glob("sessions/*"))


async def test_a_temperature_that_goes_holds_the_run_until_it_is_back(tmp_path: Path, order: Callable[..., Order]):
    ordered, events, tasks = order(CAPTURES), list[Event](), list[asyncio.Task[None]]()

    def follow(item: Item) -> None:
        if not isinstance(item, Event):
            return
        events.append(item)
        if item.kind == "guard.camera_temperature_bad":
            tasks.append(asyncio.create_task(fault(ordered, "camera.no_temperature", False)))

    def watch(hub: Hub) -> None:
        hub.subscribe(follow)
        break_it = at_step(
            "soak", lambda: tasks.append(asyncio.create_task(fault(ordered, "camera.no_temperature", True)))
        )
        break_it(hub)

    directory = await run_virtual(ordered, tmp_path / "out", None, watch)
    await asyncio.gather(*tasks)
    (held,) = [event for event in events if event.kind == "guard.camera_temperature_bad"]
    assert (held.level, held.data) == (
        "error",
        {"rule": "camera_temperature_bad", "action": "hold", "ends_itself": True},
    )
    assert "exactly 0 degC, for 60 s" in held.text
    (over,) = [event for event in events if event.kind == "hold_ended"]
    assert over.data["rule"] == "camera_temperature_bad"
    session = Session.open(directory)
    times_ns, camera_degC = session.readings("camera.temperature")
    bad_ns = times_ns[camera_degC != camera_degC]
    assert 55 <= (held.time_ns - bad_ns[0]) / NS_PER_S <= 75
    assert [meta.camera_degC > 20 for meta in session.frame_metas()] == [True] * 4
    for command, place in (("list", directory.parent), ("verify", directory), ("info", directory)):
        assert "no frame has" not in CliRunner().invoke(app, ["session", command, str(place)]).stdout


async def test_a_camera_that_is_configured_to_have_no_temperature_is_not_asked_for_one(
    tmp_path: Path, order: Callable[..., Order]
):
    directory = await run_virtual(
        order(CAPTURES, camera={"has_temperature": False}), tmp_path / "out", None, lambda hub: None
    )
    session = Session.open(directory)
    kinds = [event.kind for event in session.events()]
    assert "no_camera_temperature" in kinds
    assert "guard.camera_temperature_bad" not in kinds
    assert session.frame_count == 4
    assert not (session.readings("camera.temperature")[1] > -300).any()
    verified = CliRunner().invoke(app, ["session", "verify", str(directory)])
    assert verified.exit_code == 0
    assert "no drift over temperature" in verified.stdout
    for command, place in (("list", directory.parent), ("info", directory)):
        shown = CliRunner().invoke(app, ["session", command, str(place)])
        assert "good camera temperature" in shown.stdout


def test_no_temperature_is_asked_of_a_camera_that_is_off_lost_or_has_taken_its_last_frame():
    config, hub = load_config(find_packaged("", "simulated")), Hub()
    (watch,) = watch_camera_temperature(config, lambda: is_due)
    now_ns, is_due = 0, True

    def held(reading: Reading) -> bool:
        nonlocal now_ns
        found = False
        for _ in range(20):
            now_ns += 5 * NS_PER_S
            hub.publish(Batch("camera", now_ns, (reading,)))
            found = watch.check(hub, now_ns) is not None or found
        return found

    bad, lost = (bad_reading("camera.temperature", "degC", 0, "why", cause) for cause in ("device", "wire"))
    assert not held(lost)
    assert held(bad)
    assert not held(Reading("camera.temperature", 30.0, "degC", 0))
    assert not held(lost)
    is_due = False
    assert not held(bad)


def test_frames_are_to_come_until_the_last_capture_of_the_plan_is_done():
    capture = Capture(1, 1.0, 0.1, Role.CALIBRATION, 20.0)
    plan = [PlannedStep(0, "a", Soak(1.0)), PlannedStep(1, "b", capture), PlannedStep(2, "c", capture)]
    state = fold(plan, [StepChanged(0, "a", "done"), StepChanged(0, "b", "done")])
    assert state.frames_to_come
    state = apply_entry(state, StepChanged(0, "c", "started"))
    assert state.frames_to_come
    state = apply_entry(state, StepChanged(0, "c", "done"))
    assert not state.frames_to_come
    assert apply_entry(state, Restarted(0, ["c"])).frames_to_come
    assert not apply_entry(state, Restarted(0, ["a"])).frames_to_come
    assert not fold(plan[:1], []).frames_to_come


def test_a_camera_without_a_temperature_must_not_say_where_it_is(tmp_path: Path):
    data = yaml.safe_load(find_packaged("", "simulated").read_text())
    data["cameras"]["camera"] |= {"has_temperature": False, "temperature": {"entry": "Sensor"}}
    config = tmp_path / "stand.yaml"
    config.write_text(yaml.safe_dump(data))
    with pytest.raises(Exception, match="has_temperature is false"):
        load_config(config)
