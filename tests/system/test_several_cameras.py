"""Stands with two cameras, and with none: recorded, verified, and read again."""

import asyncio
import os
import signal
from collections import Counter
from pathlib import Path

import pytest
import yaml

from tests.dialects import DIALECTS
from tests.sections import change
from thermostand.compensation.observations import observe
from thermostand.foundation.documents import parse_document
from thermostand.recording.reading.scan import Files, verify
from thermostand.recording.reading.session import Session
from thermostand.stand.config.recipe import Recipe
from thermostand.stand.config.stand_config import StandConfig, find_packaged, load_config
from thermostand.stand.running.opening.stop import Interrupted
from thermostand.stand.running.order import Order
from thermostand.stand.running.resume import load_interruption
from thermostand.stand.service.run import resume, run_virtual

from .conftest import CALM, require_aravis
from .test_run import at_step

CAPTURES = """
name: captures
experiments:
  - calibration: {equilibrium_s: 60, linear_mm: [0, 40], rotary_deg: [0], frames_per_position: 2}
"""
NO_FRAMES = """
name: no-frames
experiments:
  - steps: [{start_chamber: 24}, {soak: 30}, stop_chamber]
"""


def order(data: dict[str, dict[str, object]], recipe: str) -> Order:
    text, target = yaml.safe_dump(data), find_packaged("targets", "paper-9x6").read_text()
    return Order(
        parse_document(text, StandConfig, "config"), parse_document(recipe, Recipe, "recipe"), text, recipe, target
    )


def recorded(data: dict[str, dict[str, object]], recipe: str, out: Path) -> Path:
    return asyncio.run(run_virtual(order(data, recipe), out, 1, lambda _: None))


def simulated() -> dict[str, dict[str, object]]:
    data = yaml.safe_load(find_packaged("", "simulated").read_text())
    change(data, CALM)
    return data


@pytest.mark.usefixtures("compiled_fit")
@pytest.mark.parametrize("encoding", [pytest.param("zstd", marks=pytest.mark.nightly), "roi"])
def test_each_camera_exposes_at_each_capture_and_a_model_takes_the_leading_ones_frames(tmp_path: Path, encoding: str):
    require_aravis()
    data = simulated()
    data["cameras"]["side"] = {"address": "127.0.0.21", "serial_number": "TS-0002", "boot_s": 4.0, "poll_s": 5.0}
    data["recording"]["frame_encoding"] = encoding
    file = tmp_path / "another make.xml"
    file.write_bytes(DIALECTS["abs"].xml("abs"))
    data["simulation"]["cameras"] = {"side": {"optics": "unmodified", "genicam": str(file)}}
    session = Session.open(recorded(data, CAPTURES, tmp_path))
    assert verify(session.path).files is Files.SOUND
    assert session.metadata["camera_serial"] == "TS-0001, TS-0002"
    metas = session.frame_metas()
    assert Counter(meta.channel for meta in metas) == {"camera.image": 4, "side.image": 4}
    assert len({meta.time_ns for meta in metas}) == 4  # both expose at the same instant
    assert {frame.channel for frame in session.frames()} == {"camera.image", "side.image"}
    if encoding == "roi":  # each camera has a whole frame at each step, and only there
        whole = Counter(frame.channel for frame in session.frames() if frame.windows is None)
        assert whole == {"camera.image": 2, "side.image": 2}
    assert {"camera.temperature", "side.temperature"} <= set(session.channels())
    own_ns = [meta.time_ns for meta in metas if meta.channel == "camera.image"]
    assert observe(session.path).time_ns.tolist() == own_ns


def test_an_interrupted_run_of_two_cameras_is_resumed(tmp_path: Path):
    require_aravis()
    data = simulated()
    for number, name in ((2, "side"), (1, "camera")):
        camera = {"address": f"127.0.0.2{number}", "serial_number": f"TS-000{number}", "width_px": 64, "height_px": 64}
        data["cameras"][name] = {**camera, "boot_s": 4.0, "poll_s": 5.0}
    stopped = at_step("close_flap", lambda: os.kill(os.getpid(), signal.SIGINT))
    with pytest.raises(Interrupted):
        asyncio.run(run_virtual(order(data, CAPTURES), tmp_path, 1, stopped))
    (directory,) = tmp_path.glob("*-captures")
    before = load_interruption(directory, load_config(find_packaged("", "simulated")))
    asyncio.run(resume(before, lambda _: None))
    session = Session.open(directory)
    assert verify(directory).files is Files.SOUND
    steps = Counter((meta.channel, meta.step_id) for meta in session.frame_metas())
    assert sorted(steps.values()) == [2, 2, 2, 2]


def test_a_stand_without_cameras_axes_and_spare_thermometers_runs(tmp_path: Path):
    data = simulated()
    del data["cameras"], data["axes"]
    data["relays"]["channels"] = {"heater_enable": 0, "compressor": 1}
    data["thermometers"] = {name: data["thermometers"][name] for name in ("air", "granite_inside")}
    session = Session.open(recorded(data, NO_FRAMES, tmp_path))
    assert verify(session.path).files is Files.SOUND
    assert session.frame_count == 0
    assert {name for name in session.channels() if "thermometers" in name} == {
        f"thermometers.{name}" for name in ("air", "air_raw", "granite_inside", "granite_inside_raw")
    }
