"""What the simulated laboratory itself costs: absolute figures of this machine, there is no peer to compare with."""

from __future__ import annotations

from pathlib import Path

from tests.bench.figures import Figure, absolute, milliseconds, progress
from thermostand.drivers.sim.physics.plant import Plant, PlantSpec, STEP_ns
from thermostand.drivers.sim.physics.scene import SceneSpec, SimulatedScene
from thermostand.drivers.sim.units.regulator import FakeRegulator
from thermostand.drivers.sim.units.relays import FakeRelays
from thermostand.foundation.clock import NS_PER_S, FollowedClock

ROUNDS = 7
STEPS = 5000  # in one measurement
START_NS = 1_767_290_400 * NS_PER_S


def figures(directory: Path) -> list[Figure]:
    """ms per rendered frame, us per step of the plant with the devices that act in every step."""
    progress("simulator, scene and plant")
    return [_scene(), _plant()]


def _scene() -> Figure:
    scene, optics = SimulatedScene(SceneSpec(), 1), Plant(PlantSpec(), START_NS).optics(START_NS)
    times_ms = [
        milliseconds(lambda number=number: scene.render(optics, START_NS + number, 0.1, 0.0, 1.0))
        for number in range(ROUNDS + 1)
    ]
    return absolute("scene renderer, 5 MP", "ms/frame", times_ms[1:])


def _plant() -> Figure:
    plant, clock = Plant(PlantSpec(), START_NS), FollowedClock(START_NS)
    FakeRegulator(plant, clock, 1)
    FakeRelays(plant, clock, 2, {"heater_enable": 0})
    times_ms = [milliseconds(lambda: plant.advance(plant.now_ns + STEPS * STEP_ns)) for _ in range(ROUNDS)]
    return absolute("plant with regulator and relays", "us/step", [1e3 * time_ms / STEPS for time_ms in times_ms])
