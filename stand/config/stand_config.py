"""The stand's configuration: YAML -> frozen models. The same schema describes a laboratory and a simulated one; only
addresses differ. A wrong key, unit or range is a ConfigError that names the file and the path in it.
"""

from __future__ import annotations

import difflib
import importlib.resources
import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, Self, cast

from pydantic import (
    AfterValidator,
    BeforeValidator,
    Discriminator,
    Field,
    SerializeAsAny,
    Tag,
    WithJsonSchema,
    model_validator,
)

from thermostand.drivers.camera_preset import CameraPreset
from thermostand.drivers.devices.cameras.cameras_by_protocol import AnyCameraSettings
from thermostand.drivers.devices.chambers.chamber_language import ChamberUnitSettings
from thermostand.drivers.devices.chambers.climate_chamber import ClimateChamberSettings
from thermostand.drivers.devices.imager.thermal_imager import ThermalImagerSettings
from thermostand.drivers.devices.inputs import InputsSettings
from thermostand.drivers.devices.kinds import Equipment, list_equipment, load_built_in_kinds, load_settings
from thermostand.drivers.devices.motion.flap import FlapSettings
from thermostand.drivers.devices.motion.stage import AxisSettings
from thermostand.drivers.devices.probes import ProbeSettings
from thermostand.drivers.devices.regulators.heat_module import HeatModuleSettings
from thermostand.drivers.devices.regulators.pid import split
from thermostand.drivers.devices.regulators.software_regulator import SoftwareRegulatorSettings
from thermostand.drivers.devices.relays import HEAT, RelaysSettings
from thermostand.drivers.devices.thermometers import (
    PLACES,
    Role,
    ThermometerModuleSettings,
    ThermometerSettings,
    list_by_channel,
)
from thermostand.drivers.settings import CameraSettings, DeviceName, Line, OnBus, Polled, check_ascending
from thermostand.drivers.wires.bus import BusSettings
from thermostand.experiments.parameters import Chamber_degC
from thermostand.foundation.documents import Document, load_document
from thermostand.foundation.errors import ConfigError
from thermostand.stand.config.alerts_section import AlertsConfig
from thermostand.stand.config.chamber_section import ChamberConfig
from thermostand.stand.config.dew import DewConfig, EndingConfig
from thermostand.stand.config.guard_section import GuardConfig
from thermostand.stand.config.interface_section import InterfaceConfig
from thermostand.stand.config.safe_ranges import check, find_outside
from thermostand.stand.config.simulation import PrintablePath, SimulatedCamera, SimulationConfig


def _get_kind(regulator: object) -> str:
    """A unit on the bus has no kind."""
    if isinstance(regulator, dict):
        return str(cast("dict[str, object]", regulator).get("kind", "on_bus"))
    return "software" if isinstance(regulator, SoftwareRegulatorSettings) else "on_bus"


RegulatorSettings = Annotated[
    Annotated[OnBus, Tag("on_bus")] | Annotated[SoftwareRegulatorSettings, Tag("software")],
    Discriminator(
        _get_kind,
        custom_error_type="kind",
        custom_error_message="must have kind: software, or no kind and the registers of a unit on the bus",
    ),
]
AddedDevice = Annotated[
    SerializeAsAny[Polled],
    BeforeValidator(load_settings),
    WithJsonSchema({"type": "object", "properties": {"kind": {"type": "string"}}, "required": ["kind"]}),
]
Folder = Literal["", "registers", "recipes", "targets", "optics"]
LEADING = "camera"  # the camera by whose temperature soaks, cool-downs and models go


class LimitsConfig(Document):
    """What no step and no operator may exceed."""

    chamber_degC: Annotated[tuple[Chamber_degC, Chamber_degC], AfterValidator(check_ascending)] = (-10.0, 60.0)


class CompressorConfig(Document):
    """The refrigeration compressor's own protection and when it is wanted (outputs of the regulator, %).

    state_file: where it is remembered when the compressor last ran; by default compressor.json in the folder of the
    sessions.
    """

    # Cycled with these times the compressor's 600 W swing the air by 0.4 to 1 K, so it runs on while the heater trims.
    min_off_s: float = Field(default=300.0, ge=0, le=3600)
    min_on_s: float = Field(default=180.0, ge=0, le=3600)
    max_starts_per_h: int = Field(default=6, ge=1, le=60)
    start_above_cool_percent: float = Field(default=10.0, gt=0, le=100)
    # Not measured. Too low, an early stop costs min_off_s without cold near the laboratory's temperature; too high, it
    # runs on against the heat, which costs energy and lets frost grow.
    stop_above_heat_percent: float = Field(default=60.0, gt=0, le=100)
    state_file: PrintablePath | None = None


class RecordingConfig(Document):
    """Where sessions go, how often telemetry is committed, and what is left of the disk.

    zstd compresses frames, raw does not, roi keeps the markers' surroundings and a whole frame every `whole_every_s`.
    With less than `stop_frames_below_GB` free no frame is recorded, with less than `alert_below_percent` of the disk
    there is a warning. What is published is on the disk within `durable_within_s`, or the stand is made safe.
    archive_directory: where `stand session archive` copies finished sessions to, another disk. idle_log_days: the
    daemon's records between runs are removed so many days later, unless they have a note or a tag; 0 keeps them all.
    """

    directory: PrintablePath = Path("sessions")
    archive_directory: PrintablePath | None = None
    frame_encoding: Literal["zstd", "raw", "roi"] = "zstd"
    whole_every_s: float = Field(default=60.0, gt=0, le=86400)
    telemetry_commit_s: float = Field(default=1.0, gt=0, le=1)
    # Round number; nothing was measured.
    durable_within_s: float = Field(default=60.0, ge=1, le=300)
    idle_log_days: int = Field(default=90, ge=0, le=36500)
    stop_frames_below_GB: float = Field(default=2.0, ge=0, le=1000)
    alert_below_percent: float = Field(default=10.0, ge=0, le=100)


class StandConfig(Document):
    """The whole file. What holds the chamber's temperature is a regulator, a unit on the bus or (kind: software) ours,
    with a relay board that enables its heat, or a climate_chamber with a controller of its own, which needs none. Ours
    heats by a relay of that board, or by a heat_module, an analog output. devices: each with its kind, ups or one that
    another package adds."""

    name: Line = Field(min_length=1)
    operator: Line = ""
    target: str
    bus: BusSettings
    regulator: RegulatorSettings | None = None
    climate_chamber: ClimateChamberSettings | None = None
    relays: RelaysSettings | None = None
    heat_module: HeatModuleSettings | None = None
    thermometer_module: ThermometerModuleSettings
    thermometers: dict[DeviceName, ThermometerSettings]
    probes: dict[DeviceName, ProbeSettings] = Field(default_factory=dict)
    axes: dict[DeviceName, AxisSettings] = Field(default_factory=dict)
    flap: FlapSettings | None = None
    inputs: InputsSettings | None = None
    imager: ThermalImagerSettings | None = None
    cameras: dict[DeviceName, AnyCameraSettings] = Field(default_factory=dict)
    devices: dict[DeviceName, AddedDevice] = Field(default_factory=dict)
    chamber: ChamberConfig = ChamberConfig()
    limits: LimitsConfig = LimitsConfig()
    guard: GuardConfig = GuardConfig()
    compressor: CompressorConfig = CompressorConfig()
    recording: RecordingConfig = RecordingConfig()
    alerts: AlertsConfig = AlertsConfig()
    interface: InterfaceConfig = InterfaceConfig()
    dew: DewConfig | None = None
    ending: EndingConfig = EndingConfig()
    simulation: SimulationConfig | None = None

    @model_validator(mode="before")
    @classmethod
    def _check_current_format(cls, data: object) -> object:
        if not isinstance(data, dict):
            return data
        keys = cast("dict[str, object]", data)
        thermometers = keys.get("thermometers")
        if "bus" not in keys and ("experiments" in keys or "steps" in keys):
            raise ValueError(
                "is a recipe, and a stand's file is wanted here (one with `bus:`); give a recipe's name first, as in "
                "`stand run RECIPE --config STAND`"
            )
        if "camera" in keys or (isinstance(thermometers, dict) and "channels" in thermometers):
            raise ValueError(
                "was made for an earlier, unreleased version; put the camera below `cameras:` by its name, the module "
                "of the thermometers into `thermometer_module:`, and its channels by their names into `thermometers:`"
            )
        return keys

    @model_validator(mode="after")
    def _cross_checks(self) -> Self:
        faults = next(self._find_faults(), None)
        if faults is not None:
            raise ValueError(faults)
        check(self, self.thermometers, self.guard.overrides)
        return self

    def _find_faults(self) -> Iterator[str]:
        """Return what of one section does not fit another."""
        yield from _find_role_faults(self.thermometers)
        yield from self._find_control_faults()
        yield from self._find_device_faults()
        yield from self._find_limit_faults()
        yield from self._find_period_faults()

    def _find_control_faults(self) -> Iterator[str]:
        if (self.regulator is None) == (self.climate_chamber is None):
            yield "a stand has either a regulator or a climate_chamber, which holds the chamber's temperature"
        if self.regulator is not None and self.relays is None:
            yield "relays is missing: a board has to enable the regulator's heat; only a climate_chamber needs none"
        if isinstance(self.regulator, SoftwareRegulatorSettings):
            yield from self._find_software_faults(self.regulator)
            yield from self._find_output_faults(self.regulator)
        elif self.relays is not None and HEAT in self.relays.channels:
            yield f"relays.channels has {HEAT}, which is the output of a regulator of kind: software, and this is none"
        elif self.heat_module is not None:
            yield "heat_module is the output of a regulator of kind: software, and this is none"

    def _find_output_faults(self, regulator: SoftwareRegulatorSettings) -> Iterator[str]:
        module, guard = self.heat_module, self.guard
        has_relay = self.relays is not None and HEAT in self.relays.channels
        if module is None:
            if self.relays is not None and not has_relay:
                yield f"relays.channels lacks {HEAT}, the relay by which a regulator of kind: software heats"
            if regulator.pulses.cycle_s > guard.heater_hold_s:
                yield "regulator.pulses.cycle_s is longer than guard.heater_hold_s, within which heat ends by itself"
            return
        if has_relay:
            yield f"relays.channels has {HEAT}, and there is a heat_module: take one of them to heat with"
        if module.watchdog_s > guard.heater_hold_s:
            yield "heat_module.watchdog_s is longer than guard.heater_hold_s, within which heat ends by itself"
        if module.watchdog_s < 2 * regulator.sample_s:
            yield "heat_module.watchdog_s must be at least twice regulator.sample_s, or it trips between two steps"

    def _find_software_faults(self, regulator: SoftwareRegulatorSettings) -> Iterator[str]:
        if regulator.thermometer not in self.sensors:
            known = ", ".join(self.sensors)
            yield f"regulator.thermometer: there is no thermometer {regulator.thermometer}, by its role {known}"
        if regulator.sample_s < self.thermometer_module.poll_s:
            yield "regulator.sample_s is shorter than thermometer_module.poll_s: between two readings nothing is new"
        if regulator.thermometer == "air" and not self.independent_air_sensors:
            yield (
                "regulator controls by the air's thermometer, and no other would show that this one is wrong; give "
                "another one `role: granite_inside`, or `role: safety` in the chamber's air"
            )
        law, compressor = regulator.law, self.compressor
        _, coldest_percent = split(law.lowest_percent, law.dead_band_percent)
        if law.lowest_percent < 0 and coldest_percent <= compressor.start_above_cool_percent:
            yield (
                f"regulator.law.lowest_percent {law.lowest_percent:g} never starts the compressor, which waits for "
                f"more than {compressor.start_above_cool_percent:g} %; take 0 for a chamber that only heats"
            )

    def _find_device_faults(self) -> Iterator[str]:
        regulator = self.regulator_unit
        units = [each.unit for each in (regulator, self.heat_module, self.relays) if each is not None]
        units += self.thermometer_module.units
        if len(set(units)) < len(units):
            yield f"regulator, relays, heat_module and thermometer_module need different units on one bus, not {units}"
        others = [each.unit for each in (regulator, self.heat_module) if each is not None]
        if self.inputs is not None and self.inputs.unit in (*others, *self.thermometer_module.units):
            yield "inputs.unit is that of the regulator or the thermometers; take the relay board's, or another"
        equipment = self.equipment
        remote = [place for each in equipment if each.settings is not None for place in each.kind.places(each.settings)]
        addresses = [self.bus.address, *(place.text for place in remote if place.how in ("wire", "host"))]
        if twice := [address for address in addresses if addresses.count(address) > 1]:
            yield f"bus and devices need addresses of their own, {twice[0]} is given twice"
        if unknown := [] if self.simulation is None else sorted(set(self.simulation.cameras) - set(self.cameras)):
            yield f"simulation.cameras has {unknown[0]}, and no camera of the stand is named so"
        taken = {"bus", "stand", "control", *(kind.device for kind in load_built_in_kinds())}
        names = [*(each.name for each in equipment if not each.kind.device), *taken]
        if twice := [name for name in names if names.count(name) > 1]:
            yield f"the name {twice[0]} is that of two devices; each needs one of its own"
        if len({entry.channel for entry in self.thermometers.values()}) < len(self.thermometers):
            yield "thermometers: two thermometers share one channel"
        if self.cameras and LEADING not in self.cameras:
            yield f"cameras: one of them has to be named {LEADING}: soaks, cool-downs and models go by its temperature"
        if self.cameras and self.relays is not None and "camera_power" not in self.relays.channels:
            yield "relays.channels lacks camera_power, the supply of the cameras"

    def _find_limit_faults(self) -> Iterator[str]:
        highest_degC, guard = self.limits.chamber_degC[1], self.guard
        if highest_degC >= guard.max_air_degC:
            yield "guard.max_air_degC must be above the upper limits.chamber_degC, or a normal run trips it"
        if guard.heat_max_Wh_per_h >= self.chamber.heater_W:
            yield (
                f"guard.heat_max_Wh_per_h {guard.heat_max_Wh_per_h:g} is never reached by a heater of "
                f"{self.chamber.heater_W:g} W (chamber.heater_W); take about 0.7 of its power"
            )
        low_degC, high_degC = self.set_points_degC
        if low_degC >= high_degC:
            yield "limits.chamber_degC and the ambient_degC of the cameras have no temperature in common"
        if self.dew is not None and self.dew.humidity_percent is not None and "laboratory" not in self.sensors:
            yield "dew.humidity_percent needs a thermometer with role: laboratory; give dew.dew_point_degC instead"
        if self.dew is not None and self.dew.hygrometer is not None:
            hygrometer = self.probes.get(self.dew.hygrometer)
            if hygrometer is None or hygrometer.protocol != "vaisala":
                yield f"dew.hygrometer {self.dew.hygrometer}: none of probes that measures humidity is named so"
        for name, limit_degC in (("granite", guard.max_granite_degC), ("camera", guard.max_camera_degC)):
            if limit_degC < highest_degC:  # they follow the air
                yield f"guard.max_{name}_degC {limit_degC} is below the upper limits.chamber_degC"

    def _find_period_faults(self) -> Iterator[str]:
        guard, cameras_s = self.guard, [camera.poll_s for camera in self.cameras.values()]
        if self.flap is not None and self.flap.poll_s * 2 > guard.flap_open_s:
            yield f"guard.flap_open_s must be at least twice flap.poll_s ({self.flap.poll_s} s)"
        slowest_s = max(self.controller.poll_s, self.thermometer_module.poll_s, *cameras_s)
        if slowest_s * 2 > guard.stale_after_s:
            yield f"guard.stale_after_s must be at least twice the slowest safety poll ({slowest_s} s)"
        if max(cameras_s, default=0.0) * 2 > guard.camera_temperature_s:
            yield f"guard.camera_temperature_s must be at least twice the poll_s of each camera ({max(cameras_s)} s)"
        slowest_s = max(self.controller.poll_s, self.relays.poll_s if self.relays is not None else 0.0)
        if slowest_s * 2 > guard.panel_change_grace_s:
            yield f"guard.panel_change_grace_s must be at least twice the poll of regulator and relays ({slowest_s} s)"

    @property
    def sensors(self) -> dict[str, ThermometerSettings]:
        """The thermometers by what they are read as: their roles, or their own names."""
        return list_by_channel(self.thermometers)

    @property
    def independent_air_sensors(self) -> list[str]:
        """The thermometers that show when the regulator's probe and the air's are wrong alike."""
        regulator = self.regulator
        controlling = regulator.thermometer if isinstance(regulator, SoftwareRegulatorSettings) else ""
        return _independent_air_sensors(self.thermometers, controlling)

    @property
    def set_points_degC(self) -> tuple[float, float]:
        """The lowest and the highest set-point that the stand and all its cameras may be given."""
        ranges = [self.limits.chamber_degC, *(each.ambient_degC for each in self.cameras.values() if each.ambient_degC)]
        return max(low for low, _ in ranges), min(high for _, high in ranges)

    @property
    def set_point_K_per_min(self) -> float:
        """How fast the set-point may change for all cameras; inf when none says."""
        rates = (each.ambient_K_per_min for each in self.cameras.values())
        return min((rate for rate in rates if rate is not None), default=math.inf)

    @property
    def equipment(self) -> tuple[Equipment, ...]:
        """Every device, in the order in which they are opened, and what is in the place of those that it lacks."""
        return list_equipment(self, self.devices)

    def replace_settings(self, changed: Mapping[str, Any]) -> dict[str, Any]:
        """The sections, by their keys, with the settings of these devices, by name, in the place of their own."""
        update: dict[str, Any] = {}
        for name, kind, _ in self.equipment:
            if name in changed and kind.device:
                update[kind.section] = changed[name]
            elif name in changed:
                update.setdefault(kind.section, {**getattr(self, kind.section)})[name] = changed[name]
        return update

    @property
    def units(self) -> dict[str, OnBus]:
        """The units on the bus, which have a register map, by their sections."""
        return {each.kind.section: each.settings for each in self.equipment if isinstance(each.settings, OnBus)}

    def list_accepted(self) -> dict[str, float]:
        """The values outside their safe ranges, which guard.overrides names, by their paths."""
        return find_outside(self, self.thermometers)

    @property
    def regulator_unit(self) -> OnBus | None:
        """The regulator that is a unit on the bus."""
        return self.regulator if isinstance(self.regulator, OnBus) else None

    @property
    def controller(self) -> OnBus | SoftwareRegulatorSettings | ChamberUnitSettings:
        """What holds the chamber's temperature."""
        if self.regulator is not None:
            return self.regulator
        if self.climate_chamber is None:
            raise ConfigError(f"{self.name}: neither a regulator nor a climate_chamber")
        return self.climate_chamber

    @property
    def camera(self) -> CameraSettings | None:
        """The leading camera: soaks, cool-downs and models go by its temperature. None on a stand without cameras."""
        return self.cameras.get(LEADING)


GUARDED: tuple[Role, ...] = ("air",)  # without which nothing is heated


def _independent_air_sensors(thermometers: Mapping[str, ThermometerSettings], controlling: str = "") -> list[str]:
    """The thermometers by which the guard finds that the regulator's probe and the air's are wrong alike: the granite
    inside, which follows the air, and safety ones; not the one that `controlling` names."""
    sensors = list_by_channel(thermometers)
    return [
        name for name, each in sensors.items() if (name == "granite_inside" or each.is_safety) and name != controlling
    ]


def _find_role_faults(thermometers: Mapping[str, ThermometerSettings]) -> Iterator[str]:
    """A sentence for each role that nobody has, that two have, or that another name belies."""
    places = [each.role or name for name, each in thermometers.items()]
    for place in PLACES:
        if places.count(place) > 1:
            yield f"thermometers: two of them have the role {place}; one place is one thermometer's"
    for name, each in thermometers.items():
        if name in PLACES and each.role not in (None, name):
            yield f"thermometers.{name} has the role {each.role}; give it another name, or the role {name}"
    if missing := [place for place in GUARDED if place not in list_by_channel(thermometers)]:
        yield (
            f"thermometers lacks {', '.join(missing)}, without which nothing is heated; name one so, or give one "
            f"`role: {missing[0]}`"
        )


def load_config(path: Path) -> StandConfig:
    """The configuration file, checked. Register maps and optics in its folder, and GenICam files, are named by
    their whole path."""
    config = load_document(path, StandConfig)
    simulation = config.simulation and config.simulation.model_copy(
        update={
            "cameras": {name: _resolve_camera_files(path, each) for name, each in config.simulation.cameras.items()}
        }
    )
    units = config.units
    return config.model_copy(
        update={
            name: unit.model_copy(update={"registers": _resolve_path(path, unit.registers)})
            for name, unit in units.items()
        }
        | {"simulation": simulation}
    )


def _resolve_camera_files(path: Path, camera: SimulatedCamera) -> SimulatedCamera:
    """Resolve the camera's GenICam file, and the optics' where they have one, from where the stand's file at `path` is.
    ConfigError where there are no such optics."""
    file = None if camera.genicam is None else (path.parent / camera.genicam).absolute()
    optics = camera.optics
    if camera.is_preset:
        optics = _resolve_path(path, str(optics))
        load_document(find_packaged("optics", optics, key=f"{path}: simulation.cameras.optics"), CameraPreset)
    return camera.model_copy(update={"genicam": file, "optics": optics})


def _resolve_path(path: Path, name: str) -> str:
    """The whole path of the file of this name next to the configuration at `path`; the name where there is none."""
    file = path.parent / name
    try:
        is_another = file.is_file() and not (Path(name).is_file() and file.samefile(name))
    except OSError:  # such as a name longer than the file system takes, which is reported when it is looked up
        return name
    return str(file.absolute()) if is_another else name


def find_packaged(folder: Folder, name: str, relative_to: Path | None = None, key: str = "") -> Path:
    """The file `name` of the installed configs/`folder`, or `name` itself when that is a path that exists; first of all
    next to the file that names it, under `key`.

    Raises ConfigError that lists what there is.
    """
    root = Path(str(importlib.resources.files("thermostand.configs"))) / folder
    known = sorted(path.stem for path in root.glob("*.yaml"))
    named_by = (f"{relative_to}: " if relative_to else "") + (f"{key}: " if key else "")
    for candidate in (
        relative_to.parent / name if relative_to else Path(name),
        Path(name),
        root / name,
        root / f"{name}.yaml",
    ):
        try:
            if candidate.is_file():
                return candidate
        except OSError as error:  # such as a name longer than the file system takes
            raise ConfigError(f"{named_by}{name}: cannot be looked up ({error.strerror})") from error
    if any(path.is_dir() for path in (Path(name), *((relative_to.parent / name,) if relative_to else ()))):
        raise ConfigError(
            f"{named_by}{name}: is a folder; give a file in it, or one of those installed: {', '.join(known)}"
        )
    near = difflib.get_close_matches(name, known, 1, 0.6)
    meant = f"did you mean {near[0]}? " if near else ""
    raise ConfigError(
        f"{named_by}{name}: no such file, and not one of those installed; {meant}there are {', '.join(known)}"
    )
