"""Sessions of the simulated laboratory without its wires and images: its physics, thermometers and noise-free centres.

A session is a list of things to do; what comes back are observations as a recording would give them, and the truth.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from thermostand.compensation.history.thermal_history import ThermalHistory, refine_temperature
from thermostand.compensation.observations import Observations, SessionFacts
from thermostand.drivers.camera_preset import CameraPreset, Effect
from thermostand.drivers.sim.physics.optics import CameraKind, compute_true_centres_px
from thermostand.drivers.sim.physics.plant import Plant, PlantSpec, STEP_s
from thermostand.drivers.sim.physics.published_camera import PublishedCamera
from thermostand.foundation.documents import load_document

from .synthetic import SIZE, TARGET

Float = NDArray[np.float64]
Seen = tuple[Observations, Float]
"""Observations, and the noise-free centres (F, 54, 2) of their frames, px."""

NS_PER_S = 1_000_000_000
START_NS = 1_767_290_400 * NS_PER_S
POLL_S = 5
CENTRE_NOISE_PX, AIR_NOISE_K, CAMERA_STEP_K = 0.0024, 0.003, 0.25


@dataclass(frozen=True)
class Published:
    """A camera of configs/optics: its number, and what it has beyond smooth and quick."""

    preset: str
    drawn: int
    effects: tuple[Effect, ...] = ()

    def made(self, plant: Plant, seed: int) -> PublishedCamera:
        """In this plant; seed: of what does not repeat."""
        file = Path(__file__).parents[2] / "configs" / "optics" / f"{self.preset}.yaml"
        preset = load_document(file, CameraPreset)
        return PublishedCamera(preset, plant, STEP_s, self.effects, self.drawn, str(seed))


@dataclass(frozen=True)
class WarmUp:
    """The camera off for `off_s` at the chamber temperature, then on with a frame every `interval_s`."""

    chamber_degC: float
    frames: int = 60
    interval_s: int = 30
    off_s: int = 7200


@dataclass(frozen=True)
class Dwell:
    """A set-point, `soak_s`, then `frames` of one role half a second apart."""

    chamber_degC: float
    role: str
    soak_s: int = 2700
    frames: int = 5


@dataclass
class Log:
    """What is recorded, and the truth: (time, role, chamber, camera's temperature, step) of frames; centres (54, 2)."""

    air: list[tuple[int, float]] = field(default_factory=list)
    powered: list[tuple[int, float]] = field(default_factory=list)
    camera: list[tuple[int, float]] = field(default_factory=list)
    frames: list[tuple[int, str, float, float, str]] = field(default_factory=list)
    truth: list[Float] = field(default_factory=list)


class PlantSession:
    """One session; the chamber is held by a plain PI controller, a heater against a compressor that always runs."""

    def __init__(self, kind: CameraKind | Published, seed: int) -> None:
        self.log = Log()
        self._rng = np.random.default_rng(seed)
        own = isinstance(kind, Published)
        self._plant = Plant(PlantSpec(camera="modified" if own else kind, seed=seed, camera_powered=True), START_NS)
        self._published = kind.made(self._plant, seed) if own else None
        if self._published is not None:
            self._plant.on_step.append(self._published.step)
        self._plant.heater_enabled = self._plant.compressor_on = True
        self._integral = 0.3
        self._target_degC = 24.0
        self.log.powered.append((START_NS, 1.0))
        self._plant.on_step.append(self._control)

    def _control(self, time_ns: int, dt_s: float) -> None:
        error_K = self._target_degC - self._plant.chamber_degC
        wanted = 0.12 * error_K + self._integral
        if 0 < wanted < 1:
            self._integral += 0.12 * error_K * dt_s / 300
        self._plant.heater_on_fraction = min(max(wanted, 0.0), 1.0)

    def wait(self, seconds: int) -> None:
        """Poll while the time passes."""
        for _ in range(seconds // POLL_S):
            now_ns = self._plant.now_ns + POLL_S * NS_PER_S
            self._plant.advance(now_ns)
            self.log.air.append((now_ns, self._air_degC() + AIR_NOISE_K * self._rng.standard_normal()))
            if self._plant.camera_powered:
                self.log.camera.append((now_ns, self._camera_degC()))

    def _camera_degC(self) -> float:
        degC = self._plant.sensor_degC if self._published is None else self._published.sensor_degC
        return CAMERA_STEP_K * round(degC / CAMERA_STEP_K)

    def _air_degC(self) -> float:
        far_degC = None if self._published is None else self._published.far_air_degC
        return self._plant.air_degC if far_degC is None else far_degC

    def switch(self, on: bool) -> None:
        """The camera's supply."""
        self._plant.camera_powered = on
        self.log.powered.append((self._plant.now_ns, float(on)))

    def take(self, role: str, chamber_degC: float, count: int, interval_s: float) -> None:
        """Frames; the flap opens for them."""
        step = f"capture-{len(self.log.frames)}"
        self._plant.flap_open_at = lambda _: 1.0
        for number in range(count):
            due_ns = self._plant.now_ns + round(interval_s * NS_PER_S)
            if number and interval_s >= POLL_S:
                self.wait(round(interval_s))
            else:
                self._plant.advance(due_ns)
            now_ns = self._plant.now_ns
            self.log.frames.append((now_ns, role, chamber_degC, self._camera_degC(), step))
            self.log.truth.append(compute_true_centres_px(self._plant.optics(now_ns, self._published)))
        self._plant.flap_open_at = lambda _: 0.0

    def perform(self, part: WarmUp | Dwell) -> None:
        """One part of the session."""
        self._target_degC = part.chamber_degC
        if isinstance(part, Dwell):
            self.wait(part.soak_s)
            self.take(part.role, part.chamber_degC, part.frames, 0.5)
            return
        self.switch(False)
        self.wait(part.off_s)
        self.switch(True)
        self._plant.advance(self._plant.now_ns + 4 * NS_PER_S)  # it boots
        self.take("warm_up", part.chamber_degC, part.frames, part.interval_s)

    def observations(self, session_id: str) -> Observations:
        """What a recording would give, with the noise of marker centres."""
        log, count = self.log, len(self.log.frames)
        times, roles, chamber, camera, steps = zip(*log.frames, strict=True)
        truth = np.array(log.truth)
        air, powered, stated = (np.array(part) for part in (log.air, log.powered, log.camera))
        return Observations(
            target=TARGET,
            sessions=(SessionFacts(session_id, "cycle", "TS-0001", "operator", "0.1.0", True, 0),),
            image_size=SIZE,
            preview=np.full((682, 816), 200, np.uint8),
            session=np.zeros(count, np.int64),
            frame=np.arange(count),
            time_ns=np.array(times, np.int64),
            role=np.array(roles),
            step_id=steps,
            chamber_degC=np.array(chamber),
            camera_degC=np.array(camera),
            air_degC=np.interp(np.array(times) - START_NS, air[:, 0] - START_NS, air[:, 1]),
            centres_px=truth + CENTRE_NOISE_PX * self._rng.standard_normal(truth.shape),
            covariance_px2=np.tile(np.eye(2) * CENTRE_NOISE_PX**2, (count, 54, 1, 1)),
            flags=np.zeros((count, 54), np.uint8),
            reasons=("",) * count,
            histories=(
                refine_temperature(
                    ThermalHistory(
                        *(np.array([time_ns for time_ns, _ in log.air], np.int64), air[:, 1]),
                        *(np.array([time_ns for time_ns, _ in log.powered], np.int64), powered[:, 1]),
                        *(np.array([time_ns for time_ns, _ in log.camera], np.int64), stated[:, 1]),
                    )
                ),
            ),
        )


def record_plant_session(
    kind: CameraKind | Published, seed: int, parts: Sequence[WarmUp | Dwell], session_id: str = "cycle-1"
) -> Seen:
    """One session from a cold camera in a chamber at 24 degC."""
    session = PlantSession(kind, seed)
    session.wait(600)
    for part in parts:
        session.perform(part)
    return session.observations(session_id), np.array(session.log.truth)


UP_AND_DOWN_DEGC = (27, 31, 34, 38, 41, 45, 48, 52, 48, 45, 41, 38, 34, 31, 27, 24, 20, 17, 14, 10, 14, 17, 20, 24)
HELD_OUT_DEGC = (14, 20, 27, 34, 41, 48)


def warm_up_and_cycles(cycles: int = 1, warm_up: bool = True) -> list[WarmUp | Dwell]:
    """A warm-up at 24 degC, the reference, and the installed thermal cycle."""
    parts: list[WarmUp | Dwell] = [WarmUp(24.0)] if warm_up else []
    parts.append(Dwell(24.0, "reference", 2700, 20))
    for chamber_degC in UP_AND_DOWN_DEGC * cycles:
        parts.append(Dwell(chamber_degC, "validation" if chamber_degC in HELD_OUT_DEGC else "fit"))
    return parts
