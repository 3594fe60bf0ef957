"""A session from somebody else is resumed: its experiment goes on, on this stand, and nothing that it names is run."""

import asyncio
import json
import os
import re
import signal
from collections.abc import Callable
from pathlib import Path

import pytest
import yaml
from typer.testing import CliRunner

from tests.sections import change
from tests.system.conftest import FAST
from tests.system.test_real_time import BRIEF
from tests.system.test_resume import findable
from tests.system.test_run import at_step, fault
from thermostand.drivers.wires.camera_settings import TemperatureFeature
from thermostand.foundation.errors import ConfigError, SessionError, StandTripped
from thermostand.foundation.sealed import seal
from thermostand.recording.reading.session import Session
from thermostand.stand.commands.command_table import app
from thermostand.stand.config.stand_config import StandConfig, find_packaged, load_config
from thermostand.stand.running.order import Order, load_order
from thermostand.stand.running.resume import load_interruption, make_resume_config
from thermostand.stand.service import queue
from thermostand.stand.service.queue_file import QUEUE_NAME, start_working
from thermostand.stand.service.run import Interrupted, resume, run_real, run_virtual

CAPTURES = """
name: captures
experiments:
  - calibration: {equilibrium_s: 30, linear_mm: [0], rotary_deg: [0], frames_per_position: 2}
"""
LIMIT_S = 90.0


def config_of(tmp_path: Path, name: str = "laboratory", **sections: dict[str, object]) -> StandConfig:
    """An installed configuration with some entries of its sections replaced."""
    data = yaml.safe_load(find_packaged("", name).read_text())
    change(data, sections)
    file = tmp_path / "changed.yaml"
    file.write_text(yaml.safe_dump(data))
    return load_config(file)


def stopped(kind: str = "soak") -> Callable[..., None]:
    return at_step(kind, lambda: os.kill(os.getpid(), signal.SIGINT))


def test_a_program_named_in_a_session_is_not_run_and_what_is_used_instead_is_reported_and_recorded(
    tmp_path: Path, order: Callable[..., Order]
):
    """The resumed run trips, of which the session's alert program would be reported; then it is resumed to its end."""
    trace, state, tasks = tmp_path / "was-run", tmp_path / "compressor.json", list[asyncio.Task[None]]()
    hostile = order(
        CAPTURES,
        alerts={"command": ["/bin/sh", "-c", f"touch {trace}"]},
        compressor={"state_file": str(state)},
    )
    with pytest.raises(Interrupted):
        asyncio.run(run_virtual(hostile, tmp_path / "out", None, stopped()))
    (directory,) = (tmp_path / "out").iterdir()
    assert not trace.exists()  # an operator who stops a run knows

    def broken() -> None:
        tasks.append(asyncio.get_running_loop().create_task(fault(hostile, "thermometer.open", "air")))

    before = findable(load_interruption(directory))
    assert "touch" in before.order.config_text  # what is recorded stays as it was
    with pytest.raises(StandTripped, match=r"thermometers\.air is BAD"):
        asyncio.run(resume(before, at_step("soak", broken)))
    resumed = CliRunner().invoke(app, ["resume", str(directory), "--reset"])
    assert resumed.exit_code == 0, resumed.output
    lines = [line for line in resumed.stderr.splitlines() if "as on this stand" in line]
    assert len(lines) == 2
    assert "compressor.state_file is not given" in lines[0]
    assert 'not ["/bin/sh", "-c"' in lines[1]
    session = Session.open(directory)
    recorded = [event.data for event in session.events() if event.kind == "stand_differs"]
    assert [data["path"] for data in recorded] == ["compressor.state_file", "alerts.command"] * 2
    assert recorded[1]["stand"] == []
    assert session.frame_count == 2
    assert not trace.exists()


async def test_a_session_of_a_stand_at_other_addresses_is_resumed_at_those_of_this_one(
    tmp_path: Path, order: Callable[..., Order], simulator: Callable[..., object]
):
    ordered = order(BRIEF, **FAST)
    await asyncio.to_thread(simulator, ordered.config, False)
    async with asyncio.timeout(LIMIT_S):
        with pytest.raises(Interrupted):
            await run_real(ordered, tmp_path / "out", stopped())
    (directory,) = (tmp_path / "out").glob("*-brief")
    own = config_of(tmp_path, "simulated", guard={"max_air_degC": 64.0})
    before = load_interruption(directory, own)
    before.release()
    config = before.order.config
    assert config.bus == own.bus
    assert config.axes == own.axes
    assert config.cameras["camera"].address == own.cameras["camera"].address
    assert config.guard == own.guard
    paths = [difference.path for difference in before.differences]
    assert {
        "bus.address",
        "axes.linear.address",
        "cameras.camera.address",
        "guard.max_air_degC",
        "simulation.control",
    } <= set(paths)
    with pytest.raises(ConfigError, match="'laboratory-stand' is a real"):
        load_interruption(directory, config_of(tmp_path))


def test_of_a_session_of_a_real_stand_only_what_its_frames_depend_on_is_kept(tmp_path: Path):
    own = config_of(tmp_path)
    session = config_of(
        tmp_path,
        bus={"address": "tcp:192.168.1.99:502"},
        relays={"channels": {"heater_enable": 2, "compressor": 1, "camera_power": 0}},
        regulator={"registers": "/tmp/somebody.yaml"},
        flap={"backend": "somebodys.module", "backend_address": "tcp:192.168.1.99:1"},
        camera={"exposure_s": 0.2, "address": "192.168.1.98", "temperature": {"entry": "Mainboard"}},
        recording={"directory": "/somewhere", "frame_encoding": "raw"},
        guard={"max_camera_degC": 99.0},
        alerts={"command": ["/bin/rm", "-r", "/"]},
        limits={"chamber_degC": [-10, 59]},
        compressor={"state_file": "/etc/passwd", "min_off_s": 181},
    )
    config, differences = make_resume_config(session, own, tmp_path, is_virtual=False)
    temperature = TemperatureFeature(entry="Mainboard")
    kept = {
        "cameras": {"camera": own.cameras["camera"].model_copy(update={"exposure_s": 0.2, "temperature": temperature})},
        "recording": own.recording.model_copy(update={"frame_encoding": "raw"}),
    }
    assert config == own.model_copy(update=kept)
    lines = [str(difference) for difference in differences]
    assert "bus.address is" in lines[0]
    assert len(lines) == len({difference.path for difference in differences}) == 13
    assert any('not ["/bin/rm", "-r", "/"]' in line for line in lines)


def test_a_thermometer_that_was_renamed_is_reported_as_one_that_came_and_one_that_went(tmp_path: Path):
    session = config_of(tmp_path)
    named = {"lens" if name == "artifact" else name: each for name, each in session.thermometers.items()}
    own = session.model_copy(update={"thermometers": named})
    config, differences = make_resume_config(session, own, tmp_path, is_virtual=False)
    assert list(config.sensors) == list(own.sensors)
    went, came = map(str, differences)
    assert went.startswith("thermometers.artifact is not given")
    assert came.startswith('thermometers.lens is {"')
    assert came.endswith("given in the session")


def test_the_same_configuration_does_not_differ(tmp_path: Path):
    own = config_of(tmp_path)
    assert make_resume_config(own, own, tmp_path, is_virtual=False) == (own, ())


def test_a_simulated_session_never_reaches_a_real_flap_or_file(tmp_path: Path):
    """Also where this stand is a real one."""
    session = config_of(
        tmp_path, "simulated", flap={"backend": "somebodys.module"}, relays={"registers": "/tmp/somebody.yaml"}
    )
    config, differences = make_resume_config(session, config_of(tmp_path), tmp_path, is_virtual=True)
    assert config.flap.backend == "thermostand.drivers.sim.usb"
    assert config.relays.registers == "waveshare-relay"
    assert {difference.path for difference in differences} == {"relays.registers", "flap.backend"}


@pytest.mark.parametrize(
    "session",
    ["../elsewhere", "..", ".", "/etc", "a/b", "a\\b", "a\x1b[2J", "a\nb", "a\0b", "x" * 256, 7, None, ["a"]],
)
def test_a_queue_that_names_another_folder_is_refused_and_nothing_is_run(tmp_path: Path, session: object):
    queue.append(tmp_path, queue.make_entry(load_order("warm-up", "simulated"), "simulated", 1))
    file = tmp_path / QUEUE_NAME
    document = json.loads(file.read_text())
    document["entries"][0] |= {"session": session, "state": "interrupted"}
    file.write_bytes(seal("queue", json.dumps(document)))
    before = sorted(tmp_path.rglob("*"))
    for take in (queue.load_queue, start_working):
        with pytest.raises(SessionError, match=re.escape(f"{file}: is damaged (entries.1.session: ")):
            take(tmp_path)
    assert {path for path in tmp_path.rglob("*") if not path.name.startswith(".")} <= set(before)
