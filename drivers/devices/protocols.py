"""What every device can do, of any make."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from thermostand.drivers.settings import CameraSettings, Identity
from thermostand.foundation.readings import Frame, Reading


class Device(Protocol):
    """Anything with a name that is opened before use; close never raises and may be called twice."""

    @property
    def name(self) -> str:
        """The configured name, the first part of its channels."""
        ...

    @property
    def identity(self) -> Identity | None:
        """The device that has answered; None while that is not known, or when no device can be asked."""
        ...

    async def open(self) -> None:
        """Connect, check identity and settings; raises DeviceError."""
        ...

    async def close(self) -> None:
        """Let go of the wire; leaves actuators as they are."""
        ...


class Sensor(Device, Protocol):
    """A device that is polled."""

    async def read(self) -> tuple[Reading, ...]:
        """All its channels, e.g. (Reading("thermometers.air", 23.98, "degC", ...), ...); raises DeviceError when
        nothing could be read, else marks single channels BAD."""
        ...


class Actuator(Device, Protocol):
    """A device that can do harm."""

    async def make_safe(self) -> None:
        """Bring it to its safe state, now; raises DeviceError when that could not be confirmed."""
        ...


@dataclass(frozen=True, slots=True)
class InForce:
    """What a controller says of whether the set-point that was written is the one that acts. It can be written and read
    back and yet not be what the unit goes to: another set-point bank, a remote set-point, a sensor outside, a program,
    a ramp, an operator at the panel, degrees Fahrenheit.

    known_by: the registers or queries that tell it; "" when none does. not_reported: what they leave open; "" for
    nothing. objections: a sentence for each thing that acts in its place, with what to do; () while it is in force."""

    known_by: str
    not_reported: str = ""
    objections: tuple[str, ...] = ()


class Controller(Sensor, Actuator, Protocol):
    """What holds the chamber's temperature: a regulator, or a climate chamber with a controller of its own. Channels
    pv, sp (degC), running, fault, and where it has outputs mv_heat, mv_cool (%). A set-point that is not in force is a
    fault at each `read`, and keeps `set_temperature` and `run` from being obeyed: DeviceFault."""

    async def in_force(self) -> InForce:
        """Return whether the set-point that it has is the one that acts, as it reports now; raises DeviceError."""
        ...

    async def set_temperature(self, degC: float) -> None:
        """Send a set-point and read it back; Refused, or Occupied while a person has it."""
        ...

    async def run(self) -> None:
        """Start control, confirmed."""
        ...

    async def stop(self) -> None:
        """Stop control, confirmed."""
        ...


class Switches(Sensor, Actuator, Protocol):
    """What enables heat and cold, and feeds the cameras. has_timer: a board drops what it holds by itself."""

    has_timer: bool

    async def switch(self, channel: str, on: bool) -> None:
        """Switch on or off, confirmed."""
        ...

    async def hold_on(self, channel: str, duration_s: float) -> None:
        """Switch on for so long from now."""
        ...


class HeatOutput(Protocol):
    """The output by which a regulator of our own heats: pulses of a relay, or a current. Without us it ends by itself.
    uncontrolled: why it may heat though it was commanded off, "" while it obeys, and once it was confirmed `off`."""

    uncontrolled: str

    @property
    def identity(self) -> Identity | None:
        """The identity of a device of its own that has answered; else None."""
        ...

    async def open(self) -> None:
        """See that it answers, and is safe without us; DeviceError. Gives nothing."""
        ...

    async def arm(self) -> None:
        """Prepare before control begins; DeviceError when it could not be relied upon."""
        ...

    async def give(self, percent: float, *, at_once: bool = False) -> None:
        """The output from now on, called at each step of the law; DeviceError."""
        ...

    async def off(self) -> None:
        """Stop all heat and confirm it; DeviceError when that fails."""
        ...

    async def test_dead_man(self) -> None:
        """Return whether it ends by itself, without heating; DeviceFault when not."""
        ...


class Shutter(Sensor, Actuator, Protocol):
    """What is between the cameras and their target: a flap, or nothing. is_shut: the last movement has confirmed it."""

    is_shut: bool

    async def move_open(self) -> None:
        """Open, confirmed."""
        ...

    async def move_closed(self) -> None:
        """Shut, confirmed."""
        ...

    def allow(self) -> None:
        """Allow new commands to move it again after it was made safe."""
        ...


class Camera(Sensor, Protocol):
    """A camera; channels `<name>.image` and `<name>.temperature`. When it is lost, its calls raise Unreachable until it
    is opened again. `restarted`: why it has, or may have, restarted between the last open and the one before; "" if
    it has not."""

    restarted: str

    @property
    def settings(self) -> CameraSettings:
        """What it is set to at each open."""
        ...

    @property
    def identity(self) -> Identity:
        """The camera that has answered; Unreachable before `open`."""
        ...

    @property
    def is_usable(self) -> bool:
        """Whether it is open and has not been lost since."""
        ...

    async def grab(self, exposure_s: float | None = None, due_ns: int = 0) -> Frame:
        """One complete frame that was exposed after the call, at `due_ns` when that is still ahead; `exposure_s` holds
        for this frame, that of the settings otherwise. Unreachable when the camera was lost."""
        ...

    async def describe_temperature_place(self) -> str:
        """Return where its temperature is read, and what else the camera offers, in words; "" when nothing was
        found."""
        ...
