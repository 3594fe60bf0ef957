"""What every device can do, whatever its make."""

from __future__ import annotations

from typing import Protocol

from foundation.readings import Reading


class Device(Protocol):
    """Anything with a name that is opened before use; close never raises and may be called twice."""

    @property
    def name(self) -> str:
        """The configured name, the first part of its channels."""
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
