"""A simulated laboratory of its own for each test: free ports, a folder for the pseudo-terminals, a camera address."""

import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml

from tests.addresses import move_to_free
from tests.fork_server import OWN_HELPERS
from tests.sections import change
from tests.still_plant import StillPlant
from tests.system.camera_bench import START_NS, run_simulated_camera
from thermostand.drivers.framing.aravis_library import load_library
from thermostand.drivers.sim.gige.camera import FakeCamera
from thermostand.foundation.clock import WallClock
from thermostand.foundation.documents import load_document, parse_yaml
from thermostand.foundation.errors import StandError
from thermostand.stand.assembly.simulator import Simulator, describe_laboratory
from thermostand.stand.config.recipe import Recipe
from thermostand.stand.config.stand_config import StandConfig, find_packaged, load_config
from thermostand.stand.running.order import Order

WHOLE_SENSOR: dict[str, object] = {"width_px": None, "height_px": None}
# Rendered and sent whole a frame costs as much as ten minutes of a session.
CORNER: dict[str, object] = {"width_px": 612, "height_px": 64}
AS_INSTALLED: dict[str, dict[str, object]] = {
    "regulator": {"poll_s": 5.0},
    "thermometer_module": {"poll_s": 5.0},
    "camera": {"poll_s": 5.0},
    "guard": {"period_s": 5.0, "stale_after_s": 15.0, "heater_hold_s": 15.0, "heater_renew_s": 5.0},
}
# Half as often: a session of virtual time then takes half the processor time.
CALM: dict[str, dict[str, object]] = {
    "regulator": {"poll_s": 10.0},
    "thermometer_module": {"poll_s": 10.0},
    "camera": {"poll_s": 10.0},
    "guard": {"period_s": 10.0, "stale_after_s": 20.0, "heater_hold_s": 30.0, "heater_renew_s": 10.0},
}
# For runs in real time: what happens each second or in seconds on a stand happens several times a second.
FAST: dict[str, dict[str, object]] = {
    "regulator": {"poll_s": 0.25},
    "thermometer_module": {"poll_s": 0.25},
    "relays": {"poll_s": 0.5, "self_test_s": 0.6},
    "flap": {"poll_s": 0.5},
    "camera": {"poll_s": 0.5, "boot_s": 0.2},
    "guard": {"period_s": 0.25, "stale_after_s": 15.0, "heater_hold_s": 3.0, "heater_renew_s": 0.5},
    # Longer than a commit takes on the busy disk of a shared machine: the fourth hold within an hour waits for `reset`.
    "recording": {"telemetry_commit_s": 0.2, "durable_within_s": 3.0},
}

SHORT_RECIPE = """
name: short
experiments:
  - thermal_cycle:
      table_position: {linear: 2, rotary: 1}
      equilibrium_s: 600
      set_points_degC: [30, 20, 24]
      held_out_degC: [20]
      soak_s: 600
      reference_frames: 2
      frames_per_point: 1
"""


def require_aravis() -> None:
    """Skip where libaravis is missing, but fail in CI."""
    try:
        load_library()
    except StandError as error:
        if os.environ.get("CI") == "true":
            pytest.fail(f"CI must have libaravis: {error}")
        pytest.skip(str(error))


@pytest.fixture
def config_text(tmp_path: Path, request: pytest.FixtureRequest) -> Callable[..., str]:
    """The installed simulated configuration at free addresses; keyword arguments replace whole sections' entries.

    Frames show the upper left corner of the sensor; one that needs the target says `camera=WHOLE_SENSOR`. Devices are
    polled and guarded calmly, but in files that ask for another `POLLED`: those of the guard and the relays, whose
    subject is time. By night all have the whole sensor and are polled as installed.
    """
    require_aravis()
    by_day = request.node.get_closest_marker("nightly") is None
    frame, polled = (CORNER, getattr(request.module, "POLLED", CALM)) if by_day else (WHOLE_SENSOR, AS_INSTALLED)

    def build(wire: str = "tcp", **sections: dict[str, object]) -> str:
        installed: Any = parse_yaml(find_packaged("", "simulated").read_text(), "simulated")
        data = move_to_free(installed, tmp_path)
        if wire == "serial":
            data["bus"]["address"] = f"serial:{tmp_path / 'bus'}"
        data["cameras"]["camera"] |= frame
        data["recording"]["alert_below_percent"] = 0  # of this machine's disk
        change(data, polled)
        change(data, sections)
        return yaml.safe_dump(data)

    return build


@pytest.fixture
def order(tmp_path: Path, config_text: Callable[..., str]) -> Callable[..., Order]:
    """An order for a recipe text against a simulated laboratory of its own, to be found where the order's configuration
    says."""

    def build(recipe: str = SHORT_RECIPE, **options: object) -> Order:
        text = config_text(**options)
        config_file, recipe_file = tmp_path / "config.yaml", tmp_path / "recipe.yaml"
        config_file.write_text(text)
        recipe_file.write_text(recipe)
        target = find_packaged("targets", "paper-9x6").read_text()
        config = load_config(config_file)
        return Order(config, load_document(recipe_file, Recipe), text, recipe, target, at_configured_addresses=True)

    return build


@pytest.fixture
def own_helpers(monkeypatch: pytest.MonkeyPatch) -> None:
    """A daemon's helpers are its children, to be found by their command."""
    monkeypatch.setenv(OWN_HELPERS, "1")


@pytest.fixture
def simulator() -> Iterator[Callable[[StandConfig, bool], Simulator]]:
    """Start simulator processes that end with the test."""
    started: list[Simulator] = []

    def start(config: StandConfig, virtual: bool) -> Simulator:
        started.append(Simulator(describe_laboratory(config, virtual=virtual, seed=None)))
        return started[-1]

    yield start
    for process in started:
        process.stop()


@pytest.fixture
def laboratory(tmp_path: Path, config_text: Callable[..., str], simulator: Callable[..., object]) -> Path:
    """The configuration of a simulated stand that answers, with a guard that looks often."""
    data: Any = parse_yaml(config_text(regulator={"poll_s": 0.5}, relays={"poll_s": 0.5}), "laboratory")
    data["relays"]["self_test_s"] = 1.0
    data["cameras"]["camera"] |= {"boot_s": 0.5, "poll_s": 1.0}
    data["flap"]["poll_s"] = 0.5
    data["guard"] |= {"period_s": 1.0}
    for axis in data["axes"].values():
        axis["poll_s"] = 1.0
    path = tmp_path / "stand.yaml"
    path.write_text(yaml.safe_dump(data))
    simulator(load_config(path), False)
    return path


@pytest.fixture
def plant() -> StillPlant:
    """What a camera by itself sees."""
    return StillPlant(START_NS, sensor=41.5, body=38.0)


@pytest.fixture
def fake(plant: StillPlant) -> Iterator[FakeCamera]:
    """A camera in real time."""
    with run_simulated_camera(WallClock(), plant) as camera:
        yield camera
