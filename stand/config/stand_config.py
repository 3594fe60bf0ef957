"""The stand's configuration: YAML -> frozen models. The same schema describes a laboratory and a simulated one; only
addresses differ. A wrong key, unit or range is a ConfigError that names the file and the path in it.
"""

from __future__ import annotations

import importlib.resources
import ipaddress
import re
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import AfterValidator, AwareDatetime, Field, model_validator

from experiments.parameters import Chamber_degC
from foundation.documents import Document, load_document
from foundation.errors import ConfigError
from stand.config.guard import GuardConfig
from stand.config.looks import ChamberConfig
from stand.config.safe_ranges import check, outside


def _tcp_address(address: str) -> str:
    found = re.fullmatch(r"tcp:[^:\s]+:([0-9]{1,5})", address)
    if found is None or not 0 < int(found[1]) < 65536:
        raise ValueError("expected tcp:HOST:PORT with a port of 1..65535")
    return address


def _byte_address(address: str) -> str:
    if re.fullmatch(r"serial:[^\s\x00]+", address):
        return address
    if address.startswith("tcp:"):
        return _tcp_address(address)
    raise ValueError("expected serial:PATH (such as serial:/dev/ttyUSB0) or tcp:HOST:PORT")


def _ascending(bounds: tuple[float, float]) -> tuple[float, float]:
    if bounds[0] >= bounds[1]:
        raise ValueError(f"{bounds} is not in ascending order")
    return bounds


def _printable(path: Path) -> Path:
    if not str(path).isprintable():
        raise ValueError("expected a path of printable characters")
    return path


def _of_this_century(start: datetime) -> datetime:
    if not 2000 <= start.year < 2100:
        raise ValueError("expected a time of the years 2000 to 2099")
    return start


def _ip_address(address: str) -> str:
    try:
        return str(ipaddress.IPv4Address(address))
    except ValueError as error:
        raise ValueError("expected an IPv4 address such as 192.168.1.10") from error


ByteAddress = Annotated[str, AfterValidator(_byte_address)]
TcpAddress = Annotated[str, AfterValidator(_tcp_address)]
IpAddress = Annotated[str, AfterValidator(_ip_address)]
Line = Annotated[str, Field(pattern=r"^\P{Cc}*$", max_length=200)]  # free text without control characters
ModuleName = Annotated[str, Field(pattern=r"^[A-Za-z_][A-Za-z0-9_]*(\.[A-Za-z_][A-Za-z0-9_]*)*$")]
PollPeriod_s = Annotated[float, Field(gt=0, le=3600)]
Unit = Annotated[int, Field(ge=1, le=247)]
ThermometerName = Literal["granite_inside", "granite_outside", "artifact", "air", "laboratory"]
RelayName = Literal["heater_enable", "compressor", "camera_power"]


class BusConfig(Document):
    """The RS-485 bus, by a serial adapter or behind a Modbus TCP gateway. timeout_s, gap_s (silence between a reply and
    the next request on a serial line) are real seconds."""

    address: ByteAddress
    baud: int = Field(default=9600, ge=1200, le=921600)
    parity: Literal["N", "E", "O"] = "N"
    stopbits: Literal[1, 2] = 1
    timeout_s: float = Field(default=0.3, gt=0, le=10)
    gap_s: float = Field(default=0.005, ge=0, le=1)


class RegulatorConfig(Document):
    """The chamber's heat/cool PID regulator; `registers` is a file in configs/registers."""

    registers: str
    unit: Unit
    poll_s: PollPeriod_s = 1.0


class RelaysConfig(Document):
    """The relay board: which relay does what (0 is the first). self_test_s: of the timed-on with which the board's
    timer is tested, once at the start of each run; the test takes 2.2 times as long."""

    registers: str
    unit: Unit
    channels: dict[RelayName, Annotated[int, Field(ge=0, le=31)]]
    poll_s: PollPeriod_s = 5.0
    self_test_s: float = Field(default=3.0, ge=0.6, le=10)

    @model_validator(mode="after")
    def _complete(self) -> Self:
        missing = {"heater_enable", "compressor", "camera_power"} - set(self.channels)
        if missing:
            raise ValueError(f"channels lacks {', '.join(sorted(missing))}")
        if len(set(self.channels.values())) < len(self.channels):
            raise ValueError("two channels share one relay")
        return self


class ThermometerConfig(Document):
    """One Pt100: the module's channel and the sensor's calibration, degC = t + offset_K + sum polynomial[k] * t**k,
    where t is what the module indicates."""

    channel: int = Field(ge=0, le=15)
    offset_K: float = Field(default=0.0, ge=-10, le=10)  # a Pt100 that is further off is broken
    polynomial: tuple[float, ...] = Field(default=(), max_length=8)
    certificate: Line = ""
    plausible_degC: Annotated[tuple[float, float], AfterValidator(_ascending)] = (-40.0, 100.0)


class ThermometersConfig(Document):
    """The five contact thermometers on one RTD module."""

    registers: str
    unit: Unit
    channels: dict[ThermometerName, ThermometerConfig]
    poll_s: PollPeriod_s = 1.0

    @model_validator(mode="after")
    def _complete(self) -> Self:
        missing = {"granite_inside", "granite_outside", "artifact", "air", "laboratory"} - set(self.channels)
        if missing:
            raise ValueError(f"channels lacks {', '.join(sorted(missing))}")
        if len({entry.channel for entry in self.channels.values()}) < len(self.channels):
            raise ValueError("two thermometers share one channel")
        return self


class AxisConfig(Document):
    """A stage behind a Standa XIMC controller; lengths in `unit`, software limits included."""

    address: ByteAddress
    serial_number: int = Field(ge=0, le=0xFFFFFFFF)
    profile: Literal["8MT160-300", "8MR151"]
    limits: Annotated[tuple[float, float], AfterValidator(_ascending)]
    poll_s: PollPeriod_s = 5.0

    @model_validator(mode="after")
    def _within_travel(self) -> Self:
        travel = 300.0 if self.unit == "mm" else 360.0  # the table goes round, its cables do not
        if max(map(abs, self.limits)) > travel:
            raise ValueError(f"limits {self.limits} are beyond the travel of {travel:g} {self.unit}")
        return self

    @property
    def unit(self) -> Literal["mm", "deg"]:
        """The axis' unit."""
        return "mm" if self.profile == "8MT160-300" else "deg"


class FlapConfig(Document):
    """The inspection flap's Pololu Jrk G2, found by its USB serial number.

    backend: a module with `get_backend(address)` that gives a pyusb backend; none means libusb, the real bus.
    open_target, closed_target, tolerance: scaled feedback counts.
    """

    serial_number: str = Field(pattern=r"^[!-~]{1,32}$")
    backend: ModuleName | None = None
    backend_address: TcpAddress | None = None
    open_target: int = Field(default=3500, ge=0, le=4095)
    closed_target: int = Field(default=500, ge=0, le=4095)
    tolerance: int = Field(default=40, ge=1, le=500)
    travel_s: float = Field(default=5.0, gt=0, le=60)
    poll_s: PollPeriod_s = 1.0

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if abs(self.open_target - self.closed_target) <= 2 * self.tolerance:
            raise ValueError("open_target and closed_target are closer than twice the tolerance")
        if (self.backend is None) != (self.backend_address is None):
            raise ValueError("backend and backend_address go together")
        return self


class CameraTemperatureConfig(Document):
    """Where the camera's own temperature is; without this section DeviceTemperature, then TemperatureAbs are tried."""

    feature: str = "DeviceTemperature"
    selector: str | None = "DeviceTemperatureSelector"
    entry: str | None = "Sensor"
    min_degC: float = -40.0
    max_degC: float = 120.0

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if self.min_degC >= self.max_degC:
            raise ValueError(f"min_degC {self.min_degC} is not below max_degC {self.max_degC}")
        if (self.selector is None) != (self.entry is None):
            raise ValueError("selector and entry go together")
        return self


class EquilibriumConfig(Document):
    """When a camera that was or may have been off is in thermal equilibrium again: its own temperature has moved by
    less than rate_K_per_min for duration_s; without a temperature, 5 x time_constant_s (of its slowest part) are
    over."""

    rate_K_per_min: float = Field(default=0.2, gt=0, le=5)
    duration_s: float = Field(default=600.0, ge=60, le=7200)
    time_constant_s: float = Field(default=1500.0, ge=10, le=36000)


class CameraConfig(Document):
    """The GigE Vision camera, by IP address. boot_s: from its supply being switched on until it answers.
    has_temperature: whether it measures its own temperature; false has to be said, a run needs no GOOD one then."""

    address: IpAddress
    serial_number: str | None = Field(default=None, pattern=r"^[ -~]{1,16}$")  # as the bootstrap register holds it
    pixel_format: Literal["Mono8", "Mono12", "Mono16"] = "Mono8"
    width_px: int | None = Field(default=None, ge=16, le=65535)
    height_px: int | None = Field(default=None, ge=16, le=65535)
    exposure_s: float = Field(default=0.1, gt=0, le=10)
    gain_dB: float = Field(default=0.0, ge=0, le=60)
    trigger: Literal["software", "free_run"] = "software"
    frame_rate_hz: float = Field(default=2.0, gt=0, le=1000)
    packet_size: int | None = Field(default=None, ge=220, le=16112)
    heartbeat_s: float = Field(default=3.0, ge=1.5, le=60)  # Aravis asks once a second
    temperature: CameraTemperatureConfig | None = None
    has_temperature: bool = True
    boot_s: float = Field(default=8.0, ge=0, le=600)
    equilibrium: EquilibriumConfig = EquilibriumConfig()
    poll_s: PollPeriod_s = 1.0

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if self.temperature is not None and not self.has_temperature:
            raise ValueError("has_temperature is false, yet temperature says where it is; leave one of them out")
        return self


class LimitsConfig(Document):
    """What no step and no operator may exceed."""

    chamber_degC: Annotated[tuple[Chamber_degC, Chamber_degC], AfterValidator(_ascending)] = (-10.0, 60.0)


class CompressorConfig(Document):
    """The refrigeration compressor's own protection and when it is wanted (outputs of the regulator, %).

    state_file: where it is remembered when the compressor last ran; by default compressor.json beside the sessions.
    """

    min_off_s: float = Field(default=300.0, ge=0, le=3600)
    min_on_s: float = Field(default=180.0, ge=0, le=3600)
    max_starts_per_h: int = Field(default=6, ge=1, le=60)
    start_above_cool_percent: float = Field(default=10.0, gt=0, le=100)
    stop_above_heat_percent: float = Field(default=60.0, gt=0, le=100)
    state_file: Annotated[Path, AfterValidator(_printable)] | None = None


class RecordingConfig(Document):
    """Where sessions go, how often telemetry is committed, and what is left of the disk.

    roi keeps the markers' surroundings and a whole frame every `whole_every_s`. With less than `stop_frames_below_GB`
    free no frame is recorded, with less than `alert_below_percent` of the disk there is a warning. What is published is
    on the disk within `durable_within_s`, or the stand is made safe.
    """

    directory: Annotated[Path, AfterValidator(_printable)] = Path("sessions")
    frame_encoding: Literal["png", "raw", "roi"] = "png"
    whole_every_s: float = Field(default=60.0, gt=0, le=86400)
    telemetry_commit_s: float = Field(default=1.0, gt=0, le=1)
    durable_within_s: float = Field(default=60.0, ge=1, le=300)
    stop_frames_below_GB: float = Field(default=2.0, ge=0, le=1000)
    alert_below_percent: float = Field(default=10.0, ge=0, le=100)


class SimulationConfig(Document):
    """The simulated laboratory behind these addresses; a real laboratory has no such section. chamber_seed: another
    chamber than the standard one, its conductances, lags and powers drawn within +-30 %."""

    control: TcpAddress
    start: Annotated[AwareDatetime, AfterValidator(_of_this_century)] = datetime(2026, 1, 1, 18, tzinfo=UTC)
    seed: int = Field(default=1, ge=0)
    camera: Literal["modified", "unmodified"] = "modified"
    laboratory_degC: float = Field(default=24.0, ge=-10, le=40)
    chamber_seed: int | None = Field(default=None, ge=0)


class StandConfig(Document):
    """The whole file."""

    name: Line = Field(min_length=1)
    operator: Line = ""
    target: str
    bus: BusConfig
    regulator: RegulatorConfig
    relays: RelaysConfig
    thermometers: ThermometersConfig
    axes: dict[Literal["linear", "rotary"], AxisConfig] = Field(default_factory=dict)
    flap: FlapConfig
    camera: CameraConfig
    chamber: ChamberConfig = ChamberConfig()
    limits: LimitsConfig = LimitsConfig()
    guard: GuardConfig = GuardConfig()
    compressor: CompressorConfig = CompressorConfig()
    recording: RecordingConfig = RecordingConfig()
    simulation: SimulationConfig | None = None

    @model_validator(mode="after")
    def _cross_checks(self) -> Self:
        units = [self.regulator.unit, self.relays.unit, self.thermometers.unit]
        if len(set(units)) < len(units):
            raise ValueError(f"regulator, relays and thermometers need different units on one bus, not {units}")
        addresses = [self.bus.address, *(axis.address for axis in self.axes.values())]
        twice = next((address for address in addresses if addresses.count(address) > 1), None)
        if twice is not None:
            raise ValueError(f"bus and axes need addresses of their own, {twice} is given twice")
        if self.limits.chamber_degC[1] >= self.guard.max_air_degC:
            raise ValueError("guard.max_air_degC must be above the upper limits.chamber_degC, or a normal run trips it")
        if self.guard.heat_max_Wh_per_h >= self.chamber.heater_W:
            raise ValueError(
                f"guard.heat_max_Wh_per_h {self.guard.heat_max_Wh_per_h:g} is never reached by a heater of "
                f"{self.chamber.heater_W:g} W (chamber.heater_W); take about 0.7 of its power"
            )
        for name in ("granite", "camera"):  # they follow the air
            limit_degC = getattr(self.guard, f"max_{name}_degC")
            if limit_degC < self.limits.chamber_degC[1]:
                raise ValueError(f"guard.max_{name}_degC {limit_degC} is below the upper limits.chamber_degC")
        if self.flap.poll_s * 2 > self.guard.flap_open_s:
            raise ValueError(f"guard.flap_open_s must be at least twice flap.poll_s ({self.flap.poll_s} s)")
        slowest_s = max(self.regulator.poll_s, self.thermometers.poll_s, self.camera.poll_s)
        if slowest_s * 2 > self.guard.stale_after_s:
            raise ValueError(f"guard.stale_after_s must be at least twice the slowest safety poll ({slowest_s} s)")
        if self.camera.poll_s * 2 > self.guard.camera_temperature_s:
            raise ValueError(
                f"guard.camera_temperature_s must be at least twice camera.poll_s ({self.camera.poll_s} s)"
            )
        slowest_s = max(self.regulator.poll_s, self.relays.poll_s)
        if slowest_s * 2 > self.guard.keys_s:
            raise ValueError(f"guard.keys_s must be at least twice the poll of regulator and relays ({slowest_s} s)")
        check(self, self._thermometers(), self.guard.accept)
        return self

    def accepted(self) -> dict[str, float]:
        """The values outside their safe ranges, which guard.accept names, by their paths."""
        return outside(self, self._thermometers())

    def _thermometers(self) -> dict[str, ThermometerConfig]:
        return {str(name): entry for name, entry in self.thermometers.channels.items()}


def load_config(path: Path) -> StandConfig:
    """The configuration file, checked."""
    return load_document(path, StandConfig)


def packaged(folder: Literal["", "registers", "recipes", "targets"], name: str) -> Path:
    """The file `name` of the installed configs/`folder`, or `name` itself when that is a path that exists.

    Raises ConfigError that lists what there is.
    """
    root = Path(str(importlib.resources.files("configs"))) / folder
    known = sorted(path.stem for path in root.glob("*.yaml"))
    for candidate in (Path(name), root / name, root / f"{name}.yaml"):
        try:
            if candidate.is_file():
                return candidate
        except OSError as error:  # such as a name longer than the file system takes
            raise ConfigError(f"{name}: cannot be looked up ({error.strerror})") from error
    raise ConfigError(f"{name}: no such file, and not one of those installed: {', '.join(known)}")
