"""What every device gives and raises.

Errors (who is to blame decides the class; `retryable` is a property of the class):

    StandError
    ├── ConfigError            the user's file is wrong; names the file and the path in it
    ├── DeviceError            carries the device's name
    │   ├── Unreachable        no answer within the deadline (retryable)
    │   ├── GarbledReply       an answer that cannot be right: CRC, length, wrong unit (retryable)
    │   ├── Refused            the device says no: exception code, errv, access denied
    │   ├── InUse              another run of this machine has it; nothing was touched
    │   ├── DeviceFault        the device works and reports trouble: sensor break, jam, alarm
    │   ├── Occupied           somebody has it do something else at the unit; it takes no orders until that ends
    │   └── Superseded         a newer command, or making safe, has overtaken this one: nobody is to blame
    ├── StandTripped           the guard has made the stand safe; an operator must clear it
    └── SessionError           a recorded session cannot be read

Programming mistakes stay ValueError. Bad calls raise; bad measurements are values with a quality.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum
from typing import ClassVar, Literal, Protocol

import numpy as np
from numpy.typing import NDArray


class StandError(Exception):
    """Anything thermostand raises on purpose; its text is one sentence for the user."""

    retryable: ClassVar[bool] = False


class ConfigError(StandError):
    """A configuration, recipe, register map or target file is wrong; the text names file and path."""


class DeviceError(StandError):
    """A device failed; `device` is its configured name."""

    def __init__(self, device: str, text: str) -> None:
        super().__init__(f"{device}: {text}")
        self.device = device


class Unreachable(DeviceError):
    """No answer within the deadline, or the port, bus or address is gone."""

    retryable = True


class GarbledReply(DeviceError):
    """An answer arrived that cannot belong to the request."""

    retryable = True


class Refused(DeviceError):
    """The device understood and declined; repeating the request would not help."""


class InUse(DeviceError):
    """Another run on this machine has the device: it was neither opened nor made safe."""


class DeviceFault(DeviceError):
    """The device reports a fault of its own or of what it moves, heats or measures."""


class Occupied(DeviceError):
    """Somebody at the unit has it do something of its own, such as autotuning: it takes no orders until that ends."""


class Superseded(DeviceError):
    """A newer command, or making safe, has taken the actuator over; what was asked for before was not carried out."""


class StandTripped(StandError):
    """The guard has latched: actuators are safe and nothing may move until an operator clears it."""


class SessionError(StandError):
    """A recorded session is missing, damaged or not of our making."""


class Quality(StrEnum):
    """How far a reading may be trusted. STALE: not confirmed in this poll. BAD: no measurement at all."""

    GOOD = "good"
    STALE = "stale"
    BAD = "bad"


# Why a reading is BAD: "wire", the poll failed or its reply was garbled, and the device may be all right; "device", the
# device itself says that it has no measurement (sensor break, converter error, out of range); "" when that is unknown.
Cause = Literal["", "wire", "device"]


@dataclass(frozen=True, slots=True)
class Reading:
    """One measured value. `value` is NaN exactly when `quality` is BAD; `reason` then says why, `cause` who says so.

    `channel` is "device.quantity" (`thermometers.air`), `unit` as in the file formats (degC, %, mm, deg, mA,
    1 for a flag or count), `time_ns` ns since the epoch on the stand's clock.
    """

    channel: str
    value: float
    unit: str
    time_ns: int
    quality: Quality = Quality.GOOD
    reason: str = ""
    cause: Cause = ""

    def __post_init__(self) -> None:
        if math.isnan(self.value) != (self.quality is Quality.BAD):
            raise ValueError(
                f"{self.channel}: a reading is NaN exactly when it is BAD, not {self.value} {self.quality}"
            )


def bad_reading(channel: str, unit: str, time_ns: int, reason: str, cause: Cause = "device") -> Reading:
    """A BAD reading: value NaN, with the reason."""
    return Reading(channel, math.nan, unit, time_ns, Quality.BAD, reason, cause)


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """One image and what belongs to it.

    image: uint8 or uint16, shape (height, width), [row, column], not to be modified. time_ns: middle of the exposure
    on the stand's clock. camera_degC: the camera's own temperature, NaN when it has none or could not be read.
    block_id: own 64-bit count of frames of this device since it was opened, gaps included. camera_ticks: the
    camera's own time stamp, ns. dropped: frames lost since the previous one. step_id: the plan's step that asked
    for it, "" when none did. windows: x, y, width, height of the parts of the image that were recorded, px, shape
    (n, 4), the rest is filled; None when the whole image is there.
    """

    channel: str
    image: NDArray[np.uint8] | NDArray[np.uint16]
    time_ns: int
    exposure_s: float
    gain_dB: float
    camera_degC: float
    block_id: int
    camera_ticks: int
    dropped: int = 0
    step_id: str = ""
    windows: NDArray[np.int32] | None = None


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
