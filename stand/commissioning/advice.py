"""What to do about a device that does not answer, or answers wrongly: by the kind of error, never by its text."""

from __future__ import annotations

from thermostand.drivers.settings import OnBus
from thermostand.foundation.errors import DeviceError, GarbledReply, InUse, Refused, Unreachable
from thermostand.stand.config.stand_config import StandConfig


def for_bus(error: DeviceError, *, is_simulated: bool) -> str:
    """The line that all units share."""
    if isinstance(error, InUse):
        return "end the other program"
    if is_simulated:
        return "this stand is simulated: start its laboratory with `stand simulate FILE` in another terminal"
    return (
        "is the adapter plugged in, its address right, and no other program using it? `stand devices` lists the ports"
    )


def for_unit(error: DeviceError, unit: OnBus, config: StandConfig) -> str:
    """A unit on the bus."""
    bus = config.bus
    line = f"{bus.baud} baud, parity {bus.parity}, {bus.stopbits} stop bit{'s' * (bus.stopbits - 1)}"
    gateway = "; does the gateway speak Modbus TCP, not RTU over TCP?" if bus.address.startswith("tcp:") else ""
    if isinstance(error, GarbledReply):
        text = f"is the unit set to {line}, is the line terminated, and does no other unit have the number {unit.unit}?"
        return f"{text}{gateway}"
    if isinstance(error, Unreachable):
        text = f"is it powered, its number {unit.unit} and its line {line}, and are A and B the right way round?"
        return f"{text}{gateway}"
    return f"set the unit as its register map {unit.registers} says, or take the map of the unit that is there"


def for_chamber(error: DeviceError) -> str:
    """A climate chamber."""
    if isinstance(error, Unreachable):
        return "is it on, its interface the one in the file, and no other program connected to it?"
    return "compare climate_chamber in the stand's file with the unit, and its limits with limits.chamber_degC"


def for_axis(error: DeviceError, name: str) -> str:
    """A stage."""
    if isinstance(error, Refused):
        return f"compare axes.{name}.address and serial_number with the controller's label; were two plugs exchanged?"
    if isinstance(error, Unreachable):
        return "is it plugged in and powered, and this user in the group dialout? `stand devices` lists the ports"
    return "look at the stage, remove the cause, and switch its controller off and on"


def for_probe(error: DeviceError, name: str) -> str:
    """A thermometer or hygrometer with a line of its own."""
    if isinstance(error, Unreachable):
        return f"is it plugged in and on, and baud as probes.{name} has it? `stand devices` lists the ports"
    return f"compare probes.{name} with the instrument: its protocol, serial number and unit (degC)"


def for_flap(error: DeviceError) -> str:
    """The flap."""
    if isinstance(error, Unreachable):
        return "is it plugged in and powered, and flap.serial_number its own? `stand devices` lists all with theirs"
    return "is something in its way? its counts are of the feedback: compare open_target, closed_target and travel_s"


def for_camera(error: DeviceError, name: str, address: str) -> str:
    """A camera."""
    if isinstance(error, Unreachable):
        return f"is it plugged in, and its address right? `stand devices --ask {address}` asks there"
    return f"compare cameras.{name} in the stand's file with the camera"
