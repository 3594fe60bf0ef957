"""A camera of numbers that others have published (`configs/optics`): five parts that warm each other, what they move,
and what does not come back.

Chip on body, body on mount and lens cell, glass in the cell; all lose heat to the air, the chip hardly any. The
chamber gets the heat of the plant's own camera instead.
"""

from __future__ import annotations

import math
import random
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from thermostand.drivers.camera_preset import Bounds, CameraPreset, Effect
from thermostand.drivers.sim.physics.hysteresis import Backlash, Fixings, Lag, StickSlip
from thermostand.drivers.sim.physics.optics import CameraDeformation, PITCH_mm, REFERENCE_degC

CHIP, BODY, CELL, GLASS, MOUNT = range(5)
# Assumed; what these parts move is published (configs/optics), and of what does not repeat nobody has published a
# number.
_CAPACITY_J_K = (25.0, 260.0, 180.0, 90.0, 900.0)
_LOSS_W_K = (0.005, 0.14, 0.07, 0.012, 0.18)
_JOINTS_W_K = ((CHIP, BODY, 0.35), (BODY, CELL, 0.25), (CELL, GLASS, 0.15), (BODY, MOUNT, 0.12))
_SCATTER = 0.3  # of capacities, losses and joints, each drawn within this factor's logarithm either way
_TILT_per_K, _TURN_rad_per_K = 3e-6, 1e-6
_K1 = -0.12


class PublishedPlant(Protocol):
    """What the camera needs of drivers.sim.physics.plant.Plant."""

    air_degC: float

    @property
    def camera_powered(self) -> bool:
        """Whether the cameras' supply is on."""
        ...


@dataclass(frozen=True, eq=False)
class _Network:
    """A step of the parts' temperatures: keep (5, 5) of them, from_air (5,) of the air, heat_K (5,) while powered."""

    keep: NDArray[np.float64]
    from_air: NDArray[np.float64]
    heat_K: NDArray[np.float64]


class PublishedCamera:
    """One camera of a preset. drawn: its number, None for the middle of each range. seed: of what does not repeat, so
    that another session of the same camera differs.

    `step` is for Plant.on_step: it takes the air and the supply of the step that begins.
    """

    def __init__(
        self,
        preset: CameraPreset,
        plant: PublishedPlant,
        dt_s: float,
        effects: Sequence[Effect] = (),
        drawn: int | None = None,
        seed: str = "",
    ) -> None:
        draw = _Draw(drawn)
        self._plant = plant
        self._effects = frozenset(effects)
        self._network = _network(preset, draw, dt_s)
        self._degC = np.full(5, plant.air_degC)
        self._bend_per_K = draw.within(preset.bend_per_K)
        self._scale_per_K = 1e-6 * draw.within(preset.scale_ppm_per_K)
        self._cell_share = draw.within((0.3, 0.7))
        self._radial_per_K = draw.within(preset.radial_per_K)
        drift_px_per_K, body_share = draw.within(preset.principal_point_px_per_K), draw.within((0.3, 0.8))
        self._body_px_per_K = _scale(draw.direction(), drift_px_per_K * body_share)
        self._cell_px_per_K = _scale(draw.direction(), drift_px_per_K * (1 - body_share))
        self._tilt_per_K = _scale(draw.direction(), _TILT_per_K)
        self._turn_per_K = _scale((*draw.direction(), 1.0), _TURN_rad_per_K)
        self._give_px, self._softening_K = draw.within(preset.sag.give_px), draw.within(preset.sag.softening_K)
        zone, slip, places = preset.dead_zone, preset.stick_slip, preset.unrepeated
        self._backlashes = [
            (Backlash(draw.within(zone.half_K)), _scale(draw.direction(), draw.within(zone.px_per_K))) for _ in range(2)
        ]
        self._creep = Lag(3600 * draw.within(preset.creep.hours), plant.air_degC - REFERENCE_degC)
        self._creep_px_per_K = _scale(draw.direction(), drift_px_per_K * draw.within(preset.creep.share))
        self._slip = StickSlip(draw.within(slip.threshold_K), f"{seed} slip")
        self._slip_px_per_K = _scale(draw.direction(), draw.within(slip.px_per_K))
        self._fixings = Fixings(draw.within(places.scatter_px), draw.within(places.travel_K), f"{seed} fixings")
        sensor, far = preset.coarse_sensor, preset.far_air
        self._sensor = Lag(draw.within(sensor.lag_s), plant.air_degC)
        self._sensor_offset_K, self._sensor_step_K = draw.within(sensor.offset_K), sensor.step_K
        self._far = Lag(draw.within(far.lag_s), plant.air_degC)
        self._far_share = draw.within(far.share)
        self.held_chip_degC: float | None = None  # of a chip that is not cooled

    def step(self, time_ns: int, dt_s: float) -> None:
        """One step of the plant's, which begins at time_ns."""
        air_degC, heat = self._plant.air_degC, 1.0 if self._plant.camera_powered else 0.0
        before_degC = float(self._degC[BODY])
        if self.held_chip_degC is not None:
            self._degC[CHIP] = self.held_chip_degC
        self._degC = self._network.keep @ self._degC + self._network.from_air * air_degC + self._network.heat_K * heat
        away_K = (self._degC - REFERENCE_degC).tolist()
        self._sensor.step(self._degC[CHIP], dt_s)
        self._far.step(air_degC, dt_s)
        self._creep.step(away_K[CELL], dt_s)
        for play, _ in self._backlashes:
            play.step(away_K[MOUNT])
        self._slip.step(away_K[BODY])
        self._fixings.step(abs(float(self._degC[BODY]) - before_degC), dt_s)

    @property
    def sensor_degC(self) -> float:
        """What the chip's thermometer has to report."""
        if "coarse_sensor" not in self._effects:
            return float(self._degC[CHIP])
        return round((self._sensor.value + self._sensor_offset_K) / self._sensor_step_K) * self._sensor_step_K

    @property
    def body_degC(self) -> float:
        """The temperature of its housing."""
        return float(self._degC[BODY])

    @property
    def far_air_degC(self) -> float | None:
        """What a thermometer of the air far from the camera reads; None when it hangs next to the camera."""
        if "far_air" not in self._effects:
            return None
        return REFERENCE_degC + self._far_share * (self._far.value - REFERENCE_degC)

    def optics(self, camera_roll_rad: float) -> CameraDeformation:
        """Return the places of its parts now."""
        away_K = (self._degC - REFERENCE_degC).tolist()
        bent_K = [each * (1 + self._bend_per_K * each) for each in away_K]
        glass_share = 1 - self._cell_share
        stretch = self._scale_per_K * (self._cell_share * bent_K[CELL] + glass_share * bent_K[GLASS])
        moved = [_scale(self._body_px_per_K, bent_K[BODY]), _scale(self._cell_px_per_K, bent_K[CELL])]
        moved += self._compute_shifts(camera_roll_rad, away_K)
        lean_K = away_K[BODY] - away_K[CELL]
        return CameraDeformation(
            sensor_mm=(PITCH_mm * sum(each[0] for each in moved), PITCH_mm * sum(each[1] for each in moved)),
            stretch=stretch,
            k1=_K1 + self._radial_per_K * away_K[GLASS],
            sensor_tilt_rad=(self._tilt_per_K[0] * lean_K, self._tilt_per_K[1] * lean_K),
            turn_rad=(
                self._turn_per_K[0] * away_K[MOUNT],
                self._turn_per_K[1] * away_K[MOUNT],
                self._turn_per_K[2] * away_K[MOUNT],
            ),
        )

    def _compute_shifts(self, camera_roll_rad: float, away_K: list[float]) -> Iterator[tuple[float, ...]]:
        """Return what the effects move the principal point by, px."""
        if "sag" in self._effects:
            down = (math.sin(camera_roll_rad), math.cos(camera_roll_rad))
            yield _scale(down, self._give_px * math.expm1(away_K[CELL] / self._softening_K))
        if "dead_zone" in self._effects:
            yield from (_scale(weight, play.place_K) for play, weight in self._backlashes)
        if "creep" in self._effects:
            yield _scale(self._creep_px_per_K, self._creep.value)
        if "stick_slip" in self._effects:
            yield _scale(self._slip_px_per_K, self._slip.place_K)
        if "unrepeated" in self._effects:
            yield self._fixings.place_px


class _Draw:
    """Numbers within bounds: the middle of each without a number of the camera, else evenly drawn. Directions are drawn
    in both cases."""

    def __init__(self, number: int | None) -> None:
        self._is_middle = number is None
        self._random = random.Random(f"published camera {number}")

    def within(self, bounds: Bounds) -> float:
        drawn = self._random.uniform(*bounds)
        return sum(bounds) / 2 if self._is_middle else drawn

    def direction(self) -> tuple[float, float]:
        angle = self._random.uniform(-math.pi, math.pi)
        return math.cos(angle), math.sin(angle)


def _scale(vector: Sequence[float], factor: float) -> tuple[float, ...]:
    return tuple(factor * each for each in vector)


def _network(preset: CameraPreset, draw: _Draw, dt_s: float) -> _Network:
    """The parts' steps, with capacities and heat such that the slowest time constant and the chip's self-heating are
    what the preset says."""

    def scattered(value: float) -> float:
        return value * math.exp(draw.within((-_SCATTER, _SCATTER)))

    capacity = np.array([scattered(each) for each in _CAPACITY_J_K])
    loss = np.array([scattered(each) for each in _LOSS_W_K])
    joints = np.zeros((5, 5))
    for one, other, conductance in _JOINTS_W_K:
        joints[one, other] = joints[other, one] = scattered(conductance)
    rates = (joints - np.diag(joints.sum(axis=1) + loss)) / capacity[:, None]
    slowest_s = float(np.max(-1 / np.linalg.eigvals(rates).real))
    quicker = slowest_s / (60 * draw.within(preset.settling_min))
    rates, to_air = rates * quicker, loss / capacity * quicker
    chip_only = np.zeros(5)
    chip_only[CHIP] = 1.0
    warm_K = np.linalg.solve(-rates, chip_only)
    heat_K_per_s = chip_only * draw.within(preset.self_heating_K) / warm_K[CHIP]
    values, vectors = np.linalg.eig(rates)  # real: the network is symmetric but for its capacities
    inverse = np.linalg.inv(vectors)
    keep = (vectors * np.exp(values * dt_s)) @ inverse
    during = (vectors * (np.expm1(values * dt_s) / values)) @ inverse
    return _Network(keep.real, (during @ to_air).real, (during @ heat_K_per_s).real)
