"""The one physics model behind every fake: chamber, stand and camera as a thermal network on a fixed time grid.

`advance(now_ns)` and nothing else moves it. A front end does, for each request,

    with plant.at(clock) as now_ns:
        ...                             # read outputs, set inputs

Temperatures are in degC, heat capacities in J/K, conductances in W/K. What the chamber is made of is a `ChamberSpec`.
"""

from __future__ import annotations

import math
import random
import threading
from collections.abc import Callable, Generator
from contextlib import contextmanager
from dataclasses import dataclass, fields, replace
from typing import Protocol

from thermostand.drivers.sim.physics.hysteresis import BoucWen
from thermostand.drivers.sim.physics.optics import (
    CameraDeformation,
    CameraKind,
    Nodes,
    Optics,
    StandPlacement,
    compute_optics,
    compute_optics_at,
)
from thermostand.foundation.clock import NS_PER_S, Now

# What one simulated chamber is made of: heat capacities, conductances, powers and lags of its thermal network.
#
# Temperatures are in degC, heat capacities in J/K, conductances in W/K. The chamber is a chest freezer of
# 1.2 x 0.9 x 0.8 m; its evaporator is bonded to the liner and the fan-heater stirs the air. It reaches -10 to +70 degC.


@dataclass(frozen=True, slots=True)
class ChamberSpec:
    """The standard chamber; another one has other numbers.

    air: 0.86 m3 of air, ducts and racks. wall: the steel liner with the evaporator's tubes; wall_laboratory: the
    insulation. flap_leak: exchange of air through the open flap. heater: lag 25 s. coil: the evaporator, lag 60 s.
    compressor_W: at an evaporator of 0 degC and above, where the motor limits it; compressor_per_K: capacity lost per K
    of evaporator below that (suction pressure). granite: slab through the wall, lag inside over an hour. probe_lag_s,
    near_lag_s: of the regulator's probe and of the thermometer near the camera. body: the camera's housing.
    """

    air_J_K: float = 6_000.0
    wall_J_K: float = 40_000.0
    air_wall_W_K: float = 60.0
    wall_laboratory_W_K: float = 8.0
    fan_W: float = 20.0
    flap_leak_W_K: float = 12.0
    heater_W: float = 2_000.0
    heater_J_K: float = 500.0
    heater_air_W_K: float = 20.0
    coil_J_K: float = 2_500.0
    coil_wall_W_K: float = 38.0
    coil_air_W_K: float = 4.0
    compressor_W: float = 600.0
    compressor_per_K: float = 0.010
    granite_J_K: float = 60_000.0
    granite_air_W_K: float = 14.0
    granite_inside_outside_W_K: float = 0.6
    granite_laboratory_W_K: float = 9.0
    probe_lag_s: float = 10.0
    near_lag_s: float = 40.0
    body_J_K: float = 120.0
    body_air_W_K: float = 0.19


_CONDUCTANCES = tuple(field.name for field in fields(ChamberSpec) if field.name.endswith("_W_K"))
# Heat capacity -> the conductance with which it makes the lag that is drawn.
_LAGS = {
    "air_J_K": "air_wall_W_K",
    "wall_J_K": "air_wall_W_K",
    "heater_J_K": "heater_air_W_K",
    "coil_J_K": "coil_wall_W_K",
    "granite_J_K": "granite_air_W_K",
    "body_J_K": "body_air_W_K",
}
_ALONE = ("heater_W", "compressor_W", "probe_lag_s", "near_lag_s")


# The limits of the guard were chosen on ten chambers drawn so, and judged on others.
def draw_chamber(seed: int, spread: float = 0.3) -> ChamberSpec:
    """Draw another chamber of the kind: every conductance, every lag, the heater and the compressor independently and
    evenly within +-`spread` of the standard one's. A heat capacity is its lag times its conductance."""
    draw = random.Random(f"chamber {seed}")
    standard = ChamberSpec()

    def factor() -> float:
        return draw.uniform(1.0 - spread, 1.0 + spread)

    factors = {name: factor() for name in (*_CONDUCTANCES, *_ALONE)}
    factors |= {capacity: factor() * factors[conductance] for capacity, conductance in _LAGS.items()}
    return replace(standard, **{name: getattr(standard, name) * value for name, value in factors.items()})


STEP_s = 0.5
STEP_ns = 500_000_000
DAY_s = 86_400.0

# Five kelvins above the highest limit that a stand's file may give.
CUT_OUT_degC = 85.0  # hard-wired, latching

# Laboratory side
LABORATORY_PEAK_s = 15.0 * 3600.0  # warmest time of the day, UTC
ARTIFACT_LAG_s = 1_200.0
ARTIFACT_FLAP_SHARE = 0.02  # of the chamber's excess reaches the target through the open flap

# The air near the camera feels its plume, the walls and the flap
NEAR_BODY_SHARE, NEAR_WALL_SHARE, NEAR_FLAP_SHARE = 0.012, 0.03, 0.05

# Camera: steady body +19 K, sensor +20 K, lens +16 K above the air at 24 degC; two thirds of it in 11, 11 and 24 min
CAMERA_W, SENSOR_W = 3.65, 0.9  # electronics in the body, sensor chip
SENSOR_J_K, SENSOR_BODY_W_K = 25.0, 0.65
BODY_RADIATION_W_K = 0.03  # at a mean of 310 K
BODY_GRANITE_W_K = 0.018
BODY_LENS_W_K, LENS_AIR_W_K, LENS_J_K = 0.0440, 0.0078, 34.0

TENSION_LIMITS_K = (4.0, 9.0)


@dataclass(frozen=True)
class PlantSpec:
    """What one simulated laboratory is; plain fields, so that a stand file can carry them.

    initial_degC: every node at the start, None for laboratory_degC. seed: irregularity of the unmodified camera's
    joints. chamber_seed: which chamber is drawn (`chamber_spec.drawn`), None for the standard one. The remaining fields
    are those of `optics.Placement`.
    """

    camera: CameraKind = "modified"
    seed: int = 1
    laboratory_degC: float = 24.0
    laboratory_swing_K: float = 0.4
    initial_degC: float | None = None
    camera_powered: bool = False
    camera_roll_deg: float = 0.0
    distance_mm: float = 826.0
    chamber_seed: int | None = None


class OwnPhysics(Protocol):
    """A camera whose temperatures are its own (published_camera.py)."""

    def optics(self, camera_roll_rad: float) -> CameraDeformation:
        """Return the places of its parts at the last grid time."""
        ...


def _at_zero(time_ns: int) -> float:
    return 0.0


class Plant:
    """The laboratory's state. Inputs and outputs are plain attributes; take `lock` around any use.

    Inputs: heater_on_fraction (0..1 of the coming step), heater_enabled, compressor_on, camera_powered, flap_open_at
    (0..1 at a time), linear_mm_at, rotary_deg_at, and cut_out_open (latches by itself; an operator resets it).
    `on_step` callables get (time_ns of the step's begin, dt_s) before the heat of that step is integrated.
    """

    def __init__(self, spec: PlantSpec, start_ns: int) -> None:
        self.spec = spec
        self._chamber = ChamberSpec() if spec.chamber_seed is None else draw_chamber(spec.chamber_seed)
        self.lock = threading.RLock()
        self.now_ns = start_ns
        self.on_step: list[Callable[[int, float], None]] = []
        self.heater_on_fraction = 0.0
        self.heater_enabled = False
        self.compressor_on = False
        self.cut_out_open = False
        self.flap_open_at: Callable[[int], float] = _at_zero
        self.linear_mm_at: Callable[[int], float] = _at_zero
        self.rotary_deg_at: Callable[[int], float] = _at_zero
        self._camera_powered = spec.camera_powered
        self.camera_power_on_ns: int | None = start_ns if spec.camera_powered else None
        self.heater_W = 0.0

        self.laboratory_degC = self._laboratory_degC(start_ns)
        initial_degC = spec.laboratory_degC if spec.initial_degC is None else spec.initial_degC
        self.bulk_air_degC = self.wall_degC = self.coil_degC = self.element_degC = initial_degC
        self.chamber_degC = self.air_degC = self.granite_inside_degC = initial_degC
        self.granite_outside_degC = self.artifact_degC = self.laboratory_degC
        self.body_degC = self.sensor_degC = self.lens_degC = initial_degC
        draw = random.Random(spec.seed)
        limits_K = TENSION_LIMITS_K if spec.camera == "unmodified" else ()
        self._joints = tuple(BoucWen(limit_K * draw.uniform(0.9, 1.1), draw.getrandbits(32)) for limit_K in limits_K)

    @property
    def camera_powered(self) -> bool:
        """Whether the camera's supply is on; `camera_power_on_ns` keeps when it last came on."""
        return self._camera_powered

    @camera_powered.setter
    def camera_powered(self, powered: bool) -> None:
        if powered and not self._camera_powered:
            self.camera_power_on_ns = self.now_ns
        self._camera_powered = powered

    @contextmanager
    def at(self, clock: Now) -> Generator[int]:
        """Nobody else has it meanwhile, and it is at the clock's present time, ns."""
        with self.lock:
            now_ns = clock.now_ns()
            self.advance(now_ns)
            yield now_ns

    def advance(self, now_ns: int) -> None:
        """Integrate whole steps up to `now_ns`; an earlier time changes nothing."""
        while self.now_ns + STEP_ns <= now_ns:
            for callback in self.on_step:
                callback(self.now_ns, STEP_s)
            self._step()
            self.now_ns += STEP_ns

    def optics(self, time_ns: int, camera: CameraKind | OwnPhysics | None = None) -> Optics:
        """The true camera and target pose: temperatures of the last grid time, stage positions of `time_ns`. Of another
        camera than the spec's, if asked: an unmodified one has joints only where the spec's is unmodified."""
        nodes = Nodes(
            sensor_degC=self.sensor_degC,
            body_degC=self.body_degC,
            lens_degC=self.lens_degC,
            granite_inside_degC=self.granite_inside_degC,
            granite_outside_degC=self.granite_outside_degC,
            artifact_degC=self.artifact_degC,
            tensions_K=tuple(joint.tension_K for joint in self._joints),
        )
        placement = StandPlacement(
            linear_mm=self.linear_mm_at(time_ns),
            rotary_deg=self.rotary_deg_at(time_ns),
            camera_roll_deg=self.spec.camera_roll_deg,
            distance_mm=self.spec.distance_mm,
        )
        if camera is None or isinstance(camera, str):
            return compute_optics_at(camera or self.spec.camera, nodes, placement)
        return compute_optics(camera.optics(math.radians(placement.camera_roll_deg)), nodes, placement)

    def state(self) -> dict[str, float]:
        """Every temperature, input and power by its attribute's name, at grid time; booleans as 0 or 1."""
        names = (
            "bulk_air_degC wall_degC coil_degC element_degC chamber_degC air_degC granite_inside_degC "
            "granite_outside_degC artifact_degC laboratory_degC body_degC sensor_degC lens_degC heater_W "
            "heater_on_fraction heater_enabled compressor_on cut_out_open camera_powered"
        )
        values = {name: float(getattr(self, name)) for name in names.split()}
        values["flap_open"] = self.flap_open_at(self.now_ns)
        values |= {f"tension_{index}_K": joint.tension_K for index, joint in enumerate(self._joints)}
        return values

    def _laboratory_degC(self, time_ns: int) -> float:
        phase = 2.0 * math.pi * ((time_ns / NS_PER_S - LABORATORY_PEAK_s) % DAY_s) / DAY_s
        return self.spec.laboratory_degC + self.spec.laboratory_swing_K * math.cos(phase)

    def _step(self) -> None:
        """One explicit Euler step; the fastest node (the probe, 10 s) is 20 steps slow. All flows use old values."""
        flap_open = self.flap_open_at(self.now_ns)
        laboratory = self._laboratory_degC(self.now_ns)
        self._step_camera(flap_open, laboratory)
        self._step_stand(flap_open, laboratory)
        self._step_chamber(flap_open, laboratory)
        self.laboratory_degC = laboratory

    def _step_chamber(self, flap_open: float, laboratory: float) -> None:
        of = self._chamber
        air, wall, coil, element = self.bulk_air_degC, self.wall_degC, self.coil_degC, self.element_degC
        if air > CUT_OUT_degC:
            self.cut_out_open = True
        heating = self.heater_enabled and not self.cut_out_open
        self.heater_W = heater_W = of.heater_W * self.heater_on_fraction if heating else 0.0
        pumped_W = 0.0
        if self.compressor_on:
            pumped_W = of.compressor_W * max(0.0, 1.0 + of.compressor_per_K * min(0.0, coil))
        from_element_W = of.heater_air_W_K * (element - air)
        air_to_wall_W = of.air_wall_W_K * (air - wall)
        wall_to_coil_W = of.coil_wall_W_K * (wall - coil)
        air_to_coil_W = of.coil_air_W_K * (air - coil)
        leak_W = of.flap_leak_W_K * flap_open * (air - laboratory)
        to_granite_W = of.granite_air_W_K * (air - self.granite_inside_degC)
        camera_W = CAMERA_W + SENSOR_W if self._camera_powered else 0.0
        gain_W = from_element_W + of.fan_W + camera_W - air_to_wall_W - air_to_coil_W - leak_W - to_granite_W
        self.bulk_air_degC = air + gain_W * (STEP_s / of.air_J_K)
        wall_gain_W = air_to_wall_W - wall_to_coil_W - of.wall_laboratory_W_K * (wall - laboratory)
        self.wall_degC = wall + wall_gain_W * (STEP_s / of.wall_J_K)
        self.coil_degC = coil + (wall_to_coil_W + air_to_coil_W - pumped_W) * (STEP_s / of.coil_J_K)
        self.element_degC = element + (heater_W - from_element_W) * (STEP_s / of.heater_J_K)

    def _step_stand(self, flap_open: float, laboratory: float) -> None:
        of = self._chamber
        air, inside, outside = self.bulk_air_degC, self.granite_inside_degC, self.granite_outside_degC
        through_W = of.granite_inside_outside_W_K * (inside - outside)
        self.granite_inside_degC = inside + (of.granite_air_W_K * (air - inside) - through_W) * (
            STEP_s / of.granite_J_K
        )
        to_laboratory_W = of.granite_laboratory_W_K * (outside - laboratory)
        self.granite_outside_degC = outside + (through_W - to_laboratory_W) * (STEP_s / of.granite_J_K)
        around_target = laboratory + ARTIFACT_FLAP_SHARE * flap_open * (air - laboratory)
        self.artifact_degC += (around_target - self.artifact_degC) * (STEP_s / ARTIFACT_LAG_s)
        self.chamber_degC += (air - self.chamber_degC) * (STEP_s / of.probe_lag_s)
        near_camera = (
            air
            + NEAR_BODY_SHARE * (self.body_degC - air)
            + NEAR_WALL_SHARE * (self.wall_degC - air)
            + NEAR_FLAP_SHARE * flap_open * (laboratory - air)
        )
        self.air_degC += (near_camera - self.air_degC) * (STEP_s / of.near_lag_s)

    def _step_camera(self, flap_open: float, laboratory: float) -> None:
        of = self._chamber
        around, body, sensor, lens = self.air_degC, self.body_degC, self.sensor_degC, self.lens_degC
        wall = self.wall_degC
        electronics_W, chip_W = (CAMERA_W, SENSOR_W) if self._camera_powered else (0.0, 0.0)
        mean = (0.5 * (body + wall) + 273.15) / 310.0
        radiated_W = BODY_RADIATION_W_K * mean * mean * mean * (body - wall)
        to_body_W = SENSOR_BODY_W_K * (sensor - body)
        to_lens_W = BODY_LENS_W_K * (body - lens)
        lost_W = of.body_air_W_K * (body - around) + radiated_W + BODY_GRANITE_W_K * (body - self.granite_inside_degC)
        change_K = (electronics_W + to_body_W - to_lens_W - lost_W) * (STEP_s / of.body_J_K)
        self.body_degC = body + change_K
        self.sensor_degC = sensor + (chip_W - to_body_W) * (STEP_s / SENSOR_J_K)
        self.lens_degC = lens + (to_lens_W - LENS_AIR_W_K * (lens - around)) * (STEP_s / LENS_J_K)
        for joint in self._joints:
            joint.step(change_K, STEP_s)
