"""What is raised on purpose (who is to blame decides the class; `retryable` is a property of the class):

    StandError
    ├── ConfigError            the user's file is wrong; names the file and the path in it
    ├── DeviceError            carries the device's name
    │   ├── Unreachable        no answer within the deadline (retryable)
    │   ├── GarbledReply       an answer that cannot be right: CRC, length, wrong unit (retryable)
    │   ├── Refused            the device says no: exception code, errv, access denied
    │   ├── InUse              another run of this machine has it; nothing was touched
    │   ├── DeviceFault        the device works and reports trouble: sensor break, jam
    │   │   └── DeviceAlarm    an alarm that it has latched: nothing moves before somebody has looked
    │   ├── Occupied           operated at the unit by hand; it takes no orders until that ends
    │   └── Superseded         a newer command, or making safe, has overtaken this one: not a fault
    ├── Interrupted            the operator ended the run
    ├── StandTripped           the guard has made the stand safe; an operator must reset it
    │   └── NotReset           ... and nobody has, in virtual time
    ├── SessionError           a recorded session cannot be read
    │   └── NotFound           what was named is not there: bad input, for a program
    ├── DetectionError         no target in the image, or one that is not identified with certainty
    └── CalibrationError       observations that do not determine a camera, or a pose

Programming mistakes stay ValueError. Bad calls raise; bad measurements are values with a quality.
"""

from __future__ import annotations

from typing import ClassVar


class StandError(Exception):
    """Anything thermostand raises on purpose; its text is one sentence for the user."""

    retryable: ClassVar[bool] = False


class ConfigError(StandError):
    """A configuration, recipe, register map or target file is wrong; the text names file and path."""


class DeviceError(StandError):
    """A device failed; `device` is its configured name, `text` what it did."""

    def __init__(self, device: str, text: str) -> None:
        super().__init__(f"{device}: {text}")
        self.device = device
        self.text = text


class Unreachable(DeviceError):
    """The device gives no answer within the deadline, or the port, bus or address is gone."""

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


class DeviceAlarm(DeviceFault):
    """The device has latched an alarm of its own; an operator decides whether it may go on."""


class Occupied(DeviceError):
    """A person at the unit has started something there, such as autotuning: it takes no orders until that ends."""


class Superseded(DeviceError):
    """A newer command, or making safe, has taken the actuator over; what was asked for before was not carried out."""


class Interrupted(StandError):
    """The operator ended the run (Ctrl-C, SIGTERM or `stand stop`); the text says whether the stand confirmed its safe
    state."""


class StandTripped(StandError):
    """The guard has latched: actuators are safe and nothing may move until an operator resets it."""


class NotReset(StandTripped):
    """A run in virtual time was held until an operator resets the hold, and none came."""


class SessionError(StandError):
    """A recorded session is missing, damaged or not of our making."""


class NotFound(SessionError):
    """What was named is not there: no such folder or file, or a folder that is no session."""


class DetectionError(StandError):
    """The target was not found or not identified with certainty; `found` counts the markers that were."""

    def __init__(self, text: str, found: int = 0) -> None:
        super().__init__(text)
        self.found = found


class CalibrationError(StandError):
    """Observations that do not determine a camera, or a pose; the sentence says why."""
