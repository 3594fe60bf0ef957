"""What the simulator process reads on its standard input: which fakes there are, and where each answers."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

from pydantic import Field

from thermostand.drivers.camera_preset import CameraPreset, Effect
from thermostand.drivers.sim.motion.ximc_table import LINEAR_8MT160_300, ROTARY_8MR151, Profile
from thermostand.drivers.sim.physics.optics import CameraKind
from thermostand.drivers.sim.units.probes import ProbeKind
from thermostand.foundation.documents import Document

PROFILES = {"8MT160-300": LINEAR_8MT160_300, "8MR151": ROTARY_8MR151}


class StageSpec(Document, extra="ignore"):
    """Another stage, in mm or degrees, full steps/s and full steps/s2."""

    unit_per_step: float
    travel: float
    speed: float
    acceleration: float
    deceleration: float
    homing_speed: float
    power_off_s: float | None

    @property
    def profile(self) -> Profile:
        """As the two stages of this kind that are known, a switch at each end."""
        stage = LINEAR_8MT160_300
        move, power, homing = (stage.settings[name] for name in ("mov", "pwr", "hom"))
        is_off = self.power_off_s is not None
        settings = {
            "mov": (round(self.speed), 0, round(self.acceleration), round(self.deceleration), *move[4:]),
            "pwr": (*power[:2], round(self.power_off_s or 0), power[3], 7 if is_off else 5),
            "hom": (round(self.homing_speed), 0, round(self.homing_speed), *homing[3:]),
        }
        end_steps = round(self.travel / self.unit_per_step)
        switches = replace(stage.switches, right=end_steps - 500)
        return replace(
            stage, unit_per_step=self.unit_per_step, switches=switches, settings={**stage.settings, **settings}
        )


class AxisSpec(Document):
    """A stage: where its controller answers and which profile it was delivered with, by name or written out."""

    address: str
    profile: Literal["8MT160-300", "8MR151"] | StageSpec
    serial_number: int

    @property
    def stage(self) -> Profile:
        """The profile itself."""
        return self.profile.profile if isinstance(self.profile, StageSpec) else PROFILES[self.profile]


class ProbeSpec(Document):
    """An instrument that answers in text."""

    protocol: ProbeKind
    address: str
    serial_number: str | None


class EndpointSpec(Document):
    """A device with an address and a serial number."""

    address: str | None
    serial_number: str | None


class CameraSpec(EndpointSpec):
    """A camera; optics: none is as `camera_kind`. preset: the camera's own physics instead, with these effects, and its
    number where it is drawn. genicam: the file of another make, which it then shows. still: it
    renders a picture once and shows it from then on, for measurements of time on the machine that simulates."""

    optics: CameraKind | None = None
    preset: CameraPreset | None = None
    effects: tuple[Effect, ...] = ()
    drawn: int | None = None
    genicam: Path | None = None
    still: bool = False


class ChamberUnitSpec(Document):
    """A commercial climate chamber: its protocol, where it answers, and the set-points that its controller allows (by
    default as the stand asks for)."""

    protocol: Literal["espec", "cts", "ascii2", "simserv", "julabo"]
    address: str
    unit: int
    limits_degC: tuple[float, float] | None = None


class ImagerSpec(Document):
    """A thermal imager: where its pictures go, None for a folder of its own, and where it sees what (x, y in px)."""

    folder: Path | None
    spots: dict[str, tuple[int, int]]


class LaboratorySpec(Document):
    """What the simulator process reads on its standard input.

    devices: those of other packages, by name, as the stand's file has them, with the address at which each answers.
    Port 0, "serial:" without a path and a camera without an address stand for free ones. All cameras see the same.
    """

    virtual: bool
    control: str
    start_ns: int = Field(ge=0)
    seed: int
    camera_kind: CameraKind
    laboratory_degC: float
    chamber_seed: int | None = None
    bus: str
    regulator_unit: int | None
    chamber: ChamberUnitSpec | None = None
    relays_unit: int | None
    relay_channels: dict[str, int]
    heat_module_unit: int | None = None
    heat_module_output: int = 0
    inputs_unit: int | None = None
    input_channels: dict[str, int] = Field(default_factory=dict[str, int])
    inputs_closed: tuple[int, ...] = ()
    thermometers_units: tuple[int, ...]
    thermometers_model: Literal["m7015", "adam4015"] = "m7015"
    thermometer_channels: dict[str, int]
    axes: dict[Literal["linear", "rotary"], AxisSpec]
    probes: dict[str, ProbeSpec] = Field(default_factory=dict[str, ProbeSpec])
    flap: EndpointSpec | None
    cameras: dict[str, CameraSpec]
    imager: ImagerSpec | None = None
    devices: dict[str, dict[str, Any]] = Field(default_factory=dict[str, dict[str, Any]])
    camera_boot_s: float = Field(default=3.0, ge=0)
    faults: tuple[str, ...] = ()
