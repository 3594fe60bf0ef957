"""The composition root: configuration -> devices, stand, guard and pollers, wired to one hub and one clock."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

from thermostand.drivers.devices.kinds import DriverContext, Equipment
from thermostand.drivers.devices.protocols import Controller, Sensor
from thermostand.drivers.devices.regulators.software_regulator import SoftwareRegulator
from thermostand.drivers.devices.thermometers import ThermometerModules, Thermometers
from thermostand.drivers.settings import EquilibriumSettings, OnBus
from thermostand.drivers.wires.bus import Bus
from thermostand.drivers.wires.registers import RegisterMap, load_register_map
from thermostand.foundation.clock import Clock, VirtualClock
from thermostand.foundation.document_faults import nearest
from thermostand.foundation.errors import ConfigError
from thermostand.foundation.hub import Hub
from thermostand.recording.format.batches import RecordedDevice
from thermostand.stand.assembly.poller import Poller
from thermostand.stand.assembly.stand import Devices, Stand
from thermostand.stand.chamber.chamber import ChamberLimits
from thermostand.stand.chamber.permits import PermitLimits
from thermostand.stand.config.stand_config import StandConfig, find_packaged
from thermostand.stand.guarding.channel_check import ChannelCheck
from thermostand.stand.guarding.guard import Guard
from thermostand.stand.guarding.interlocks import (
    Recording,
    forbid_intrusion,
    forbid_uncontrolled_heat,
)
from thermostand.stand.guarding.rules import (
    Announcements,
    list_vital_channels,
    make_channel_models,
    make_watches,
    watch_camera_temperature,
    watch_recording,
)
from thermostand.stand.guarding.step_errors import StepErrors
from thermostand.stand.imaging.camera_supply import SupplyLimits
from thermostand.stand.safety.fault import Fault, Watch


@dataclass(frozen=True, slots=True)
class Assembly:
    """A stand with everything around it, not yet opened."""

    config: StandConfig
    hub: Hub
    clock: Clock
    bus: Bus
    devices: Devices
    stand: Stand
    equipment: tuple[Equipment, ...]
    channels: ChannelCheck

    def make_pollers(self) -> tuple[Poller, ...]:
        """One per device, in the order in which they are read when several are due at one instant; each module of
        thermometers by itself."""
        polled: list[tuple[Sensor, str, float]] = []
        for each in self.equipment:
            device = self.devices.every[each.name]
            if each.poll_s is None:
                continue
            if isinstance(device, ThermometerModules):
                polled += [(module, _get_display_name(module, self.config), each.poll_s) for module in device.modules]
            else:
                polled.append((device, _get_display_name(device, self.config), each.poll_s))
        return tuple(
            Poller(sensor, period_s, self.hub, self.clock, self.channels.make_marker(named))
            for sensor, named, period_s in polled
        )

    def make_guard(
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
        met = StepErrors(list_device_kinds(self.config))
        self.hub.subscribe(met)
        guard = Guard(
            safety=stand.safety,
            latch=stand.latch,
            watches=(
                *make_watches(self.config, announced),
                Watch(forbid_intrusion(lambda: stand.chamber.permits.intrusions), action="hold"),
                *_watch_heat_output(self.devices.regulator),
                *met.watches,
                *watch_camera_temperature(self.config, frames_to_come),
                *(watch_recording(self.config, recording) if recording is not None else ()),
            ),
            hub=self.hub,
            clock=self.clock,
            period_s=self.config.guard.period_s,
            stop=stop,
            hold=hold,
            release=release,
            cut_camera=stand.cut_camera,
            step_errors=met,
            vital=list_vital_channels(self.config),
        )
        stand.chamber.permits.is_allowed = guard.may_permit
        return guard


def _watch_heat_output(regulator: Controller) -> tuple[Watch, ...]:
    """Watch that what a regulator of our own heats by obeys its command."""
    if not isinstance(regulator, SoftwareRegulator):
        return ()
    return (Watch(forbid_uncontrolled_heat(lambda: regulator.heat_uncontrolled), action="hold"),)


def assemble(config: StandConfig, hub: Hub, clock: Clock) -> Assembly:
    """Make every device the configuration names; nothing is opened. ConfigError when a named file is missing, or
    guard.channels does not fit the devices: a plan of the same configuration can be made elsewhere."""
    _check_limited(config)
    bus, equipment = Bus("bus", config.bus, clock), config.equipment
    devices = make_devices(config, bus, hub, clock)
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
    if isinstance(regulator := devices.regulator, SoftwareRegulator):
        regulator.is_permitted = lambda: stand.chamber.permits.may_heat
    check = ChannelCheck(make_channel_models(config), config.guard.sensors, hub.publish)
    stand.imaging.judge_temperature = check.judge_value
    return Assembly(
        config=config,
        hub=hub,
        clock=clock,
        bus=bus,
        devices=devices,
        stand=stand,
        equipment=equipment,
        channels=check,
    )


def _check_limited(config: StandConfig) -> None:
    """ConfigError when guard.channels has what no device measures, or is read too seldom for its limit."""
    known = [
        f"{name}.{each.name}" for name, device in list_recorded_devices(config).items() for each in device.channels
    ]
    polls_s = {each.name: each.poll_s or 0.0 for each in config.equipment}
    for channel, limits in config.guard.channels.items():
        if channel not in known:
            raise ConfigError(
                f"guard.channels: no device of the stand measures {channel}{nearest(channel, known)}; there are "
                f"{', '.join(known)}"
            )
        if limits.after_s < 2 * (poll_s := polls_s[channel.partition(".")[0]]):
            raise ConfigError(
                f"guard.channels.{channel}.after_s must be at least twice the poll_s of its device ({poll_s:g} s)"
            )


def make_devices(config: StandConfig, bus: Bus, hub: Hub, clock: Clock) -> Devices:
    """Every device of the stand's file, not opened; ConfigError when a register map is missing or wrong, or that of
    another kind of unit."""
    made: dict[str, Sensor] = {}
    around = DriverContext(
        clock=clock,
        bus=bus,
        made=made,
        publish=hub.publish,
        known=hub.known,
        of_section=partial(getattr, config),
        map_of=load_unit_map,
    )
    by_kind: dict[str, dict[str, Any]] = {}
    # What controls comes last: it may heat by another device.
    for each in sorted(config.equipment, key=lambda each: each.kind.device == "regulator"):
        made[each.name] = each.made(around)
        by_kind.setdefault(each.kind.section, {})[each.name] = made[each.name]
    return Devices(
        every={each.name: made[each.name] for each in config.equipment},
        axes=by_kind.get("axes", {}),
        cameras=by_kind.get("cameras", {}),
        probes=by_kind.get("probes", {}),
    )


def _get_display_name(sensor: Sensor, config: StandConfig) -> str:
    """Return what a device with several temperatures is called, so that it is found."""
    if not isinstance(sensor, Thermometers):
        return sensor.name
    return f"{sensor.name} (unit {sensor.unit} at {config.bus.address})"


def list_device_kinds(config: StandConfig) -> dict[str, str]:
    """Return what the stand is made of: name -> kind, but for what is in the place of a device and never read."""
    return {each.name: each.kind.name for each in config.equipment if each.poll_s is not None}


def list_recorded_devices(config: StandConfig) -> dict[str, RecordedDevice]:
    """Return what is recorded of each device that is read, by name; ConfigError when one declares what cannot be
    recorded."""
    return {
        each.name: RecordedDevice(
            each.kind.name, each.channels(partial(getattr, config), load_unit_map), each.kind.is_opened
        )
        for each in config.equipment
        if each.poll_s is not None
    }


def load_unit_map(key: str, unit: OnBus) -> RegisterMap:
    """The map of a unit, for its number on the bus; ConfigError when it is missing or wrong."""
    path = find_packaged("registers", unit.registers, key=f"{key}.registers")
    return load_register_map(path).at_unit(unit.unit)
