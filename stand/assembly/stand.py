"""One stand: chamber, imaging and table behind one gate, one interlock and one owner of making them safe."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import cast

from thermostand.drivers.devices.imager.thermal_imager import ThermalImager
from thermostand.drivers.devices.inputs import Inputs
from thermostand.drivers.devices.motion.stage import Axis
from thermostand.drivers.devices.probes import Probe
from thermostand.drivers.devices.protocols import Actuator, Camera, Controller, Sensor, Shutter, Switches
from thermostand.drivers.devices.regulators.heat_module import HeatModule
from thermostand.drivers.devices.thermometers import ThermometerModules, Thermometers
from thermostand.foundation.clock import Clock
from thermostand.foundation.events import PROMPT, PROMPT_SKIPPED
from thermostand.foundation.hub import Hub
from thermostand.stand.chamber.chamber import Chamber, ChamberLimits
from thermostand.stand.imaging.camera_supply import CameraSupply, SupplyLimits
from thermostand.stand.imaging.cameras import Cameras
from thermostand.stand.imaging.imaging import Imaging
from thermostand.stand.imaging.table import Table
from thermostand.stand.safety.gate import OPERATOR, Gate
from thermostand.stand.safety.interlock import Interlock, Motions
from thermostand.stand.safety.latch import Latch
from thermostand.stand.safety.making_safe import Safety

_JAMMED_AGAIN_S = 60.0  # between tries to close a flap that jams: its motor must not be worn


@dataclass(frozen=True, slots=True)
class Devices:
    """Everything the stand is made of, by name in the order of their ranks; and what its packages need of that. A relay
    board and a flap that it lacks have stand-ins."""

    every: Mapping[str, Sensor]
    axes: Mapping[str, Axis]
    cameras: Mapping[str, Camera]
    probes: Mapping[str, Probe] = field(default_factory=dict[str, Probe])

    @property
    def regulator(self) -> Controller:
        """What holds the chamber's temperature."""
        return cast("Controller", self.every["regulator"])

    @property
    def relays(self) -> Switches:
        """What enables heat and cold, and feeds the cameras."""
        return cast("Switches", self.every["relays"])

    @property
    def thermometers(self) -> Thermometers | ThermometerModules:
        """The contact thermometers."""
        return cast("Thermometers | ThermometerModules", self.every["thermometers"])

    @property
    def flap(self) -> Shutter:
        """What is between the cameras and their target."""
        return cast("Shutter", self.every["flap"])

    @property
    def heat_module(self) -> HeatModule | None:
        """The module by which a regulator of our own heats; None where that is a relay, or there is no such
        regulator."""
        return cast("HeatModule | None", self.every.get("heat_module"))

    @property
    def inputs(self) -> Inputs | None:
        """The contacts."""
        return cast("Inputs | None", self.every.get("inputs"))

    @property
    def imager(self) -> ThermalImager | None:
        """The thermal imager."""
        return cast("ThermalImager | None", self.every.get("imager"))


class Stand:
    """Its verbs are those of `chamber`, `imaging` and `table`. While a run is being ended each but close_flap raises
    StandTripped, while something is latched Interlocked. `latch` is the one answer to whether it has tripped, `safety`
    the one owner of making it safe."""

    def __init__(self, devices: Devices, chamber: ChamberLimits, supply: SupplyLimits, hub: Hub, clock: Clock) -> None:
        self.devices = devices
        self.gate = Gate()
        self.motions = Motions()
        self.attended = False  # whether an operator does what is prompted for
        self._hub = hub
        self._clock = clock
        self.latch = Latch(self.gate, hub, clock)
        self.interlock = interlock = Interlock(self.latch, self.gate, (devices.flap, *devices.axes.values()))
        cameras = Cameras(devices.cameras)
        power = CameraSupply(
            cameras=cameras,
            relays=devices.relays,
            limits=supply,
            interlock=interlock,
            gate=self.gate,
            hub=hub,
            clock=clock,
        )
        self.imaging = Imaging(
            cameras=devices.cameras,
            flap=devices.flap,
            supply=power,
            interlock=interlock,
            gate=self.gate,
            motions=self.motions,
            hub=hub,
            clock=clock,
        )
        self.chamber = Chamber(
            regulator=devices.regulator,
            relays=devices.relays,
            limits=chamber,
            interlock=interlock,
            coils_read=power.compare,
            hub=hub,
            clock=clock,
        )
        self.table = Table(devices.axes, interlock, self.motions, hub, clock)
        self.safety = Safety(self.chamber.permits.revoke, hub, clock)

    def opened(self, actuator: Actuator) -> None:
        """This actuator answers: from now on it is made safe whenever that is demanded."""
        if actuator is self.devices.relays:
            self.safety.take(self.chamber.permits)
        elif actuator is self.devices.flap:
            self.safety.take(actuator, _JAMMED_AGAIN_S)
        else:
            self.safety.take(actuator)

    def cut_camera(self) -> None:
        """The camera itself is too warm: its supply goes off, too, whenever the stand is made safe, until an operator
        resets the hold."""
        self.imaging.supply.is_on = False
        self.safety.add_until_cleared(self.imaging.supply)
        self.safety.demand()

    async def prompt(self, text: str) -> None:
        """Ask the operator for something, and wait until it is done (a pause that the operator ends); when nobody
        attends the run continues, with the event `prompt_skipped`."""
        self.interlock.check()
        self._hub.publish(PROMPT.at(self._clock.now_ns(), what=text, attended=self.attended))
        if self.attended:
            self.gate.hold(OPERATOR)
            return await self.gate.wait_until_open()
        self._hub.publish(PROMPT_SKIPPED.at(self._clock.now_ns(), what=text))
