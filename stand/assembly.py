"""The composition root: configuration -> devices, stand, guard and pollers, wired to one hub and one clock."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, cast

import usb.backend

from thermostand.drivers.devices.absent_devices import NoFlap, NoRelays
from thermostand.drivers.devices.cameras.cameras_by_protocol import make_camera
from thermostand.drivers.devices.chambers.climate_chamber import ClimateChamber
from thermostand.drivers.devices.imager.thermal_imager import ThermalImager
from thermostand.drivers.devices.inputs import Inputs
from thermostand.drivers.devices.motion.flap import Flap, FlapSettings
from thermostand.drivers.devices.motion.stage import Axis
from thermostand.drivers.devices.probes import Probe
from thermostand.drivers.devices.protocols import Controller, Sensor, Shutter, Switches
from thermostand.drivers.devices.regulators.heat_module import HeatModule
from thermostand.drivers.devices.regulators.heat_pulses import HeatPulses
from thermostand.drivers.devices.regulators.regulator import Regulator
from thermostand.drivers.devices.regulators.software_regulator import SoftwareRegulator, SoftwareRegulatorSettings
from thermostand.drivers.devices.relays import Relays, RelaysSettings
from thermostand.drivers.devices.thermometers import SeveralModules, Thermometers
from thermostand.drivers.settings import EquilibriumSettings, OnBus
from thermostand.drivers.wires.bus import Bus
from thermostand.drivers.wires.modbus_unit import ModbusUnit
from thermostand.drivers.wires.registers import RegisterMap, load_register_map
from thermostand.foundation.clock import Clock, VirtualClock
from thermostand.foundation.errors import ConfigError
from thermostand.foundation.hub import Hub
from thermostand.stand.chamber.chamber import ChamberLimits
from thermostand.stand.chamber.permits import PermitLimits
from thermostand.stand.config.stand_config import StandConfig, packaged
from thermostand.stand.estimating.camera_lines import sharing
from thermostand.stand.fault import Fault
from thermostand.stand.guarding.channels import ChannelCheck
from thermostand.stand.guarding.guard import Guard
from thermostand.stand.guarding.interlocks import Recording, Watch, heat_uncontrolled, intrusion
from thermostand.stand.guarding.met_errors import MetErrors
from thermostand.stand.guarding.notify import Notifier
from thermostand.stand.guarding.rules import Announcements, camera_measured, natures, recorded, vital, watches
from thermostand.stand.imaging.camera_supply import SupplyLimits
from thermostand.stand.poller import Poller
from thermostand.stand.stand import Devices, Stand

_NO_BOARD_POLL_S = 5.0


@dataclass(frozen=True, slots=True)
class Assembly:
    """A stand with everything around it, not yet opened."""

    config: StandConfig
    hub: Hub
    clock: Clock
    bus: Bus
    devices: Devices
    stand: Stand
    notifier: Notifier  # notifies people when nobody is at the stand
    channels: ChannelCheck

    def pollers(self) -> tuple[Poller, ...]:
        """One per device, in the order in which they are read when several are due at one instant."""
        config, devices = self.config, self.devices
        first: list[tuple[Sensor, float]] = [
            (devices.regulator, config.controller.poll_s),
            *((module, config.thermometer_module.poll_s) for module in devices.thermometers.modules),
        ]
        if isinstance(devices.regulator, SoftwareRegulator):  # which shows what the thermometers have read
            first.reverse()
        timed: list[tuple[Sensor, float]] = [
            *first,
            *(
                ((devices.heat_module, config.heat_module.poll_s),)
                if devices.heat_module is not None and config.heat_module is not None
                else ()
            ),
            *((devices.probes[name], probe.poll_s) for name, probe in config.probes.items()),
            (devices.relays, config.relays.poll_s if config.relays is not None else _NO_BOARD_POLL_S),
            *(
                ((devices.inputs, config.inputs.poll_s),)
                if devices.inputs is not None and config.inputs is not None
                else ()
            ),
            *((devices.cameras[name], camera.poll_s) for name, camera in config.cameras.items()),
            *(((devices.flap, config.flap.poll_s),) if config.flap is not None else ()),
            *((devices.axes[name], axis.poll_s) for name, axis in config.axes.items()),
            *(
                ((devices.imager, config.imager.poll_s),)
                if devices.imager is not None and config.imager is not None
                else ()
            ),
        ]
        return tuple(
            Poller(sensor, period_s, self.hub, self.clock, self.channels.marking(self._module(sensor)))
            for sensor, period_s in timed
        )

    def _module(self, sensor: Sensor) -> str:
        """What a device with several temperatures is called, so that it is found."""
        if not isinstance(sensor, Thermometers):
            return sensor.name
        number = self.devices.thermometers.modules.index(sensor)
        return f"{sensor.name} (unit {self.config.thermometer_module.units[number]} at {self.config.bus.address})"

    def guard(
        self,
        stop: Callable[[Fault], None],
        hold: Callable[[Fault], None] | None = None,
        release: Callable[[], None] | None = None,
        recording: Recording | None = None,
        frames_to_come: Callable[[], bool] = lambda: False,
        announced: Announcements | None = None,
    ) -> Guard:
        """The guard with the configured rules, those of `recording` and of a camera with `frames_to_come` among them;
        on a fault it calls `stop`, or `hold` where waiting is enough, and `release` when a hold has ended by itself.
        From now on nothing is permitted without it."""
        announced, stand = announced or Announcements(), self.stand
        self.hub.subscribe(announced.receive)
        met = MetErrors(device_kinds(self.config))
        self.hub.subscribe(met)
        guard = Guard(
            stand.safety,
            (
                *watches(self.config, announced),
                Watch(intrusion(lambda: stand.chamber.permits.intrusions), action="hold"),
                *_obeyed(self.devices.regulator),
                *met.watches,
                *camera_measured(self.config, frames_to_come),
                *(recorded(self.config, recording) if recording is not None else ()),
            ),
            self.hub,
            self.clock,
            self.config.guard.period_s,
            stop,
            hold,
            release,
            stand.cut_camera,
            self.notifier,
            met,
            vital(self.config),
        )
        stand.chamber.permits.allowed = guard.may_permit
        return guard


def _obeyed(regulator: Controller) -> tuple[Watch, ...]:
    """Of a regulator of our own: that what it heats by obeys its command."""
    if not isinstance(regulator, SoftwareRegulator):
        return ()
    return (Watch(heat_uncontrolled(lambda: regulator.heat_uncontrolled), action="hold"),)


def assemble(config: StandConfig, hub: Hub, clock: Clock) -> Assembly:
    """Make every device the configuration names; nothing is opened. ConfigError when a named file, or the program of
    guard.notify, is missing: a plan of the same configuration can be made elsewhere."""
    notifier = Notifier(config.guard.notify, config.guard.notify_limit_s, clock)
    if missing := notifier.missing():
        raise ConfigError(missing)
    bus = Bus("bus", config.bus, clock)
    regulator, relays, thermometers, heat_module = bus_units(config, bus, hub, clock)
    devices = Devices(
        regulator=regulator,
        relays=relays,
        thermometers=thermometers,
        heat_module=heat_module,
        axes={name: Axis(name, axis, clock) for name, axis in config.axes.items()},
        flap=_flap(config.flap, clock),
        cameras={
            name: make_camera(name, sharing(config, name) or camera, clock) for name, camera in config.cameras.items()
        },
        inputs=inputs_of(config, bus, clock),
        probes={name: Probe(name, probe, clock) for name, probe in config.probes.items()},
        imager=config.imager and ThermalImager("imager", config.imager, clock, hub.publish),
    )
    state_file = config.compressor.state_file
    if state_file is None and not isinstance(clock, VirtualClock):  # what is simulated leaves no traces
        state_file = config.recording.directory / "compressor.json"
    self_test_s = config.relays.self_test_s if config.relays is not None else 0.0
    permits = PermitLimits(config.guard.heater_hold_s, self_test_s, config.compressor)
    renew_s = config.guard.heater_renew_s
    chamber = ChamberLimits(config.set_points_degC, permits, renew_s, state_file, config.set_point_K_per_min)
    boots_s = [camera.boot_s for camera in config.cameras.values()]
    equilibrium = config.camera.equilibrium if config.camera is not None else EquilibriumSettings()
    channels: dict[str, int] = {} if config.relays is None else {**config.relays.channels}
    supply = SupplyLimits(max(boots_s, default=0.0), config.guard.heater_hold_s, equilibrium, channels)
    stand = Stand(devices, chamber, supply, hub, clock)
    if isinstance(regulator, SoftwareRegulator):
        regulator.permitted = lambda: stand.chamber.permits.gives
    check = ChannelCheck(natures(config), config.guard.sensors, config.guard.frozen, hub.publish)
    stand.imaging.doubt_of = check.doubt_of
    return Assembly(config, hub, clock, bus, devices, stand, notifier, check)


def bus_units(
    config: StandConfig, bus: Bus, hub: Hub, clock: Clock
) -> tuple[Controller, Switches, Thermometers | SeveralModules, HeatModule | None]:
    """Regulator or climate chamber, relays, thermometers, and the module that a regulator of ours may heat by;
    ConfigError when a register map is missing or wrong, or that of another kind of unit."""
    relays, module = _switches(config.relays, bus, clock), _heat_module(config, bus, clock)
    return _controller(config, bus, relays, module, hub, clock), relays, _thermometers(config, bus, clock), module


def _heat_module(config: StandConfig, bus: Bus, clock: Clock) -> HeatModule | None:
    if (settings := config.heat_module) is None:
        return None
    return HeatModule(ModbusUnit("heat_module", bus, register_map("heat_module", settings)), settings, clock)


def _thermometers(config: StandConfig, bus: Bus, clock: Clock) -> Thermometers | SeveralModules:
    """Each sensor on the module that has its channel."""
    settings = config.thermometer_module
    first = register_map("thermometer_module", settings)
    count = sum(name.startswith("value_") for name in first.points)
    if not count:
        raise ConfigError(
            f"thermometer_module: register map {first.model} lacks value_0; it is of no thermometer module"
        )
    modules: list[Thermometers] = []
    for number, unit in enumerate(settings.units):
        here = {
            name: each.model_copy(update={"channel": each.channel - number * count})
            for name, each in config.sensors.items()
            if each.channel // count == number or (each.channel // count > number and unit == settings.units[-1])
        }
        if not here:
            raise ConfigError(f"thermometer_module: no thermometer has a channel of unit {unit}")
        modules.append(Thermometers("thermometers", bus, first.at_unit(unit), here, clock))
    return modules[0] if len(modules) == 1 else SeveralModules(modules)


def _controller(
    config: StandConfig, bus: Bus, relays: Switches, module: HeatModule | None, hub: Hub, clock: Clock
) -> Controller:
    settings = config.controller
    if isinstance(settings, OnBus):
        return Regulator("regulator", bus, register_map("regulator", settings), clock)
    if isinstance(settings, SoftwareRegulatorSettings):
        return SoftwareRegulator(
            "regulator",
            settings,
            module or HeatPulses(relays, settings.pulses, clock),
            lambda: hub.known(f"thermometers.{settings.thermometer}"),
            config.limits.chamber_degC,
            config.guard.stale_after_s,
            clock,
            hub.publish,
        )
    return ClimateChamber("regulator", settings, config.limits.chamber_degC, clock)


def _switches(relays: RelaysSettings | None, bus: Bus, clock: Clock) -> Switches:
    if relays is None:
        return NoRelays("relays", clock)
    channels = {str(name): number for name, number in relays.channels.items()}
    return Relays("relays", bus, register_map("relays", relays), channels)


def inputs_of(config: StandConfig, bus: Bus, clock: Clock) -> Inputs | None:
    """The stand's contacts, None when it has none; ConfigError as bus_units."""
    if config.inputs is None:
        return None
    channels = {name: contact.channel for name, contact in config.inputs.contacts.items()}
    return Inputs("inputs", bus, register_map("inputs", config.inputs), channels, clock)


def device_kinds(config: StandConfig) -> dict[str, str]:
    """What the stand is made of: name -> kind."""
    return {
        "regulator": "regulator",
        "relays": "relays",
        **({} if config.heat_module is None else {"heat_module": "output"}),
        "thermometers": "thermometers",
        **({} if config.inputs is None else {"inputs": "contacts"}),
        **({} if config.imager is None else {"imager": "imager"}),
        **({} if config.flap is None else {"flap": "flap"}),
        **dict.fromkeys(config.probes, "thermometers"),
        **dict.fromkeys(config.axes, "axis"),
        **dict.fromkeys(config.cameras, "camera"),
    }


def register_map(key: str, unit: OnBus) -> RegisterMap:
    """The map of a unit, for its number on the bus; ConfigError when it is missing or wrong."""
    path = packaged("registers", unit.registers, key=f"{key}.registers")
    return load_register_map(path).at_unit(unit.unit)


class _BackendModule(Protocol):
    def get_backend(self, address: str) -> usb.backend.IBackend: ...


def _flap(flap: FlapSettings | None, clock: Clock) -> Shutter:
    if flap is None:
        return NoFlap("flap")
    backend: usb.backend.IBackend | None = None
    if flap.backend is not None and flap.backend_address is not None:
        try:
            module = cast("_BackendModule", importlib.import_module(flap.backend))
        except ImportError as error:
            raise ConfigError(f"flap.backend: no module {flap.backend!r} ({error})") from error
        if not callable(getattr(module, "get_backend", None)):
            raise ConfigError(f"flap.backend: module {flap.backend!r} has no get_backend(address)")
        try:
            backend = module.get_backend(flap.backend_address)
        except ValueError as error:
            raise ConfigError(f"flap.backend_address: {error}") from error
    return Flap("flap", flap, clock, backend)
