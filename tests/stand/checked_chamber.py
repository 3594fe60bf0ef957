"""A drawn chamber whose readings pass the check of channels, as the stand's pollers publish them, with a camera of the
plant or a published one that is shown in steps and with noise."""

from __future__ import annotations

import random
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

from tests.stand.guarded_chamber import Action, Chamber
from thermostand.drivers.camera_preset import CameraPreset
from thermostand.drivers.sim.physics.plant import STEP_s
from thermostand.drivers.sim.physics.published_camera import PublishedCamera
from thermostand.foundation.documents import load_document
from thermostand.foundation.items import Event
from thermostand.foundation.readings import Reading
from thermostand.stand.config.stand_config import StandConfig, find_packaged, load_config
from thermostand.stand.guarding.channel_check import ChannelCheck
from thermostand.stand.guarding.rules import make_channel_models

CONFIG = load_config(find_packaged("", "simulated"))
CAMERA = "camera.temperature"


@dataclass(frozen=True)
class Shown:
    """Which camera, a preset or "" for the plant's, and how temperatures are shown: steps and noise, K."""

    preset: str = ""
    camera_step_K: float = 0.25
    camera_noise_K: float = 0.0
    module_step_K: float = 0.003


class CheckedChamber(Chamber):
    """said: what the check says. camera_degC: what the camera shows for its true temperature."""

    def __init__(
        self,
        seed: int | None,
        shown: Shown,
        config: StandConfig = CONFIG,
        draw: random.Random | None = None,
        **more: Any,
    ) -> None:
        super().__init__(seed, **more)
        self.messages: list[Event] = []
        self.camera_degC: Callable[[float], float] = lambda true_degC: true_degC
        self._shown, self._draw = shown, draw or random.Random(0)
        self._published: PublishedCamera | None = None
        if shown.preset:
            preset = load_document(find_packaged("optics", shown.preset), CameraPreset)
            self._published = PublishedCamera(preset, self.plant, STEP_s, (), self._draw.randrange(1000))
            self.plant.on_step.append(self._published.step)
        self.check = ChannelCheck(make_channel_models(config), config.guard.sensors, self.messages.append)
        self._marks = {name: self.check.make_marker(name) for name in ("regulator", "thermometers", "camera")}

    @property
    def warnings(self) -> list[tuple[str, list[str]]]:
        """Rule and channels of each warning."""
        found: list[Any] = [event.data for event in self.messages if event.level != "info"]
        return [(str(data["rule"]), list(data["channels"])) for data in found]

    def _read(self, now_ns: int) -> Iterator[tuple[str, tuple[Reading, ...]]]:
        for device, readings in super()._read(now_ns):
            if device == "camera" and self.plant.camera_powered:
                readings = (Reading(CAMERA, self._camera_degC(), "degC", now_ns),)
            elif device == "thermometers":
                step_K = self._shown.module_step_K
                readings = tuple(
                    each if each.value != each.value else replace(each, value=round(each.value / step_K) * step_K)
                    for each in readings
                )
            yield device, self._marks[device](readings, now_ns) if device in self._marks else readings

    def _camera_degC(self) -> float:
        source = self._published or self.plant
        noisy_degC = self.camera_degC(source.sensor_degC) + self._draw.gauss(0.0, self._shown.camera_noise_K)
        return round(noisy_degC / self._shown.camera_step_K) * self._shown.camera_step_K


def draw_good_run(seed: int) -> tuple[CheckedChamber, list[tuple[float, Action]]]:
    """A drawn session of one to two hours in which nothing is wrong: set-points far and near, the camera switched, the
    flap opened, the chamber stopped."""
    draw = random.Random(seed)
    shown = Shown(
        draw.choice(["", "nac", "dic", "navcam", "phone"]),
        draw.choice([0.05, 0.1, 0.25, 0.5, 1.0]),
        draw.choice([0.0, 0.02, 0.1]),
        draw.choice([0.003, 0.01, 0.1]),
    )
    chamber = CheckedChamber(
        seed if seed % 10 else None,
        shown,
        draw=draw,
        laboratory_degC=draw.uniform(16, 30),
        camera_powered=draw.random() < 0.5,
    )

    def to(degC: float) -> Action:
        return lambda chamber: chamber.start(degC)

    actions = [(draw.uniform(30, 600), _nothing), (draw.uniform(30, 300), to(draw.uniform(10, 50)))]
    for _ in range(4):
        actions.append((draw.uniform(300, 1500), to(draw.choice([-5, 5, 24, 40, 60, draw.uniform(-10, 60)]))))
        what = draw.random()
        if what < 0.3:
            actions.append((draw.uniform(10, 900), lambda chamber: _power(chamber, not chamber.plant.camera_powered)))
            actions.append((draw.uniform(10, 900), lambda chamber: _power(chamber, True)))
        elif what < 0.65:
            actions.append((draw.uniform(10, 250), lambda chamber: setattr(chamber, "forbid_open_flap", 1.0)))
            actions.append((draw.uniform(10, 300), lambda chamber: setattr(chamber, "forbid_open_flap", 0.0)))
        elif what < 0.8:
            actions.append((draw.uniform(60, 900), lambda chamber: chamber.stop()))
    return chamber, actions


def _nothing(chamber: Chamber) -> None: ...


def _power(chamber: Chamber, on: bool) -> None:
    chamber.plant.camera_powered = on
