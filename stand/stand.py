"""One stand: chamber, imaging and table behind one gate, one interlock and one owner of making them safe."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from thermostand.drivers.devices.imager.thermal_imager import ThermalImager
from thermostand.drivers.devices.inputs import Inputs
from thermostand.drivers.devices.motion.stage import Axis
from thermostand.drivers.devices.probes import Probe
from thermostand.drivers.devices.protocols import Actuator, Camera, Controller, Shutter, Switches
from thermostand.drivers.devices.regulators.heat_module import HeatModule
from thermostand.drivers.devices.thermometers import SeveralModules, Thermometers
from thermostand.foundation.clock import Clock
from thermostand.foundation.events import PROMPT, PROMPT_SKIPPED
from thermostand.foundation.hub import Hub
from thermostand.stand.chamber.chamber import Chamber, ChamberLimits
from thermostand.stand.gate import OPERATOR, Gate
from thermostand.stand.imaging.camera_supply import CameraSupply, SupplyLimits
from thermostand.stand.imaging.cameras import Cameras
from thermostand.stand.imaging.imaging import Imaging
from thermostand.stand.interlock import Interlock, Motions
from thermostand.stand.safety import Safety
from thermostand.stand.table.stages import Table

_JAMMED_AGAIN_S = 60.0  # between tries to close a flap that jams: its motor must not be worn


@dataclass(frozen=True, slots=True)
class Devices:
    """Everything the stand is made of."""

    regulator: Controller
    relays: Switches
    thermometers: Thermometers | SeveralModules
    axes: Mapping[str, Axis]
    flap: Shutter
    cameras: Mapping[str, Camera]
    heat_module: HeatModule | None = None
    inputs: Inputs | None = None
    imager: ThermalImager | None = None
    probes: Mapping[str, Probe] = field(default_factory=dict[str, Probe])


class Stand:
    """Its verbs are those of `chamber`, `imaging` and `table`. After a latched fault each but close_flap raises
    StandTripped, while an interlock holds the gate Interlocked. `safety` is the one owner of making it safe."""

    def __init__(self, devices: Devices, chamber: ChamberLimits, supply: SupplyLimits, hub: Hub, clock: Clock) -> None:
        self.devices = devices
        self.gate = Gate()
        self.motions = Motions()
        self.attended = False  # whether an operator does what is prompted for
        self._hub = hub
        self._clock = clock
        self.interlock = interlock = Interlock(self.gate, (devices.flap, *devices.axes.values()))
        cameras = Cameras(devices.cameras)
        power = CameraSupply(cameras, devices.relays, supply, interlock, self.gate, hub, clock)
        self.imaging = Imaging(devices.cameras, devices.flap, power, interlock, self.gate, self.motions, hub, clock)
        self.chamber = Chamber(devices.regulator, devices.relays, chamber, interlock, power.compare, hub, clock)
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
        clears the hold."""
        self.imaging.supply.is_on = False
        self.safety.take_until_cleared(self.imaging.supply)
        self.safety.demand()

    async def prompt(self, text: str) -> None:
        """Ask the operator for something, and wait until it is done (a pause that the operator ends); when nobody
        attends the run continues, with the event `prompt_skipped`."""
        self.interlock.check()
        self._hub.publish(PROMPT.at(self._clock.now_ns(), what=text, attended=self.attended))
        if self.attended:
            self.gate.hold(OPERATOR)
            return await self.gate.passed()
        self._hub.publish(PROMPT_SKIPPED.at(self._clock.now_ns(), what=text))
