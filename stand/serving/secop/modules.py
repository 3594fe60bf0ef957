"""What a module of the node is: parameters that are read from the state of the stand, and what they order."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Literal, NamedTuple

from pydantic import JsonValue

from thermostand.stand.serving.api_models import ReadingState, StandState
from thermostand.stand.serving.secop import datainfo
from thermostand.stand.serving.secop.datainfo import DataInfo
from thermostand.stand.serving.secop.secop_lines import Refusal

# Codes of a status (specification, "status"); BUSY is 300 to 399.
IDLE, WARN, BUSY, RAMPING, ERROR = 100, 200, 300, 370, 400
SENSOR_CODES = {"IDLE": IDLE, "WARN": WARN, "ERROR": ERROR}
DRIVE_CODES = {"IDLE": IDLE, "WARN": WARN, "BUSY": BUSY, "RAMPING": RAMPING, "ERROR": ERROR}

InterfaceClass = Literal["Readable", "Writable", "Drivable"]


@dataclass(frozen=True, slots=True)
class TimedValue:
    """A value. time_ns: when it was obtained, on the stand's clock; None: as long as the state says so."""

    value: JsonValue
    time_ns: int | None = None


Report = TimedValue | Refusal


class Drive:
    """What is under way with one device. ordered: where to, by this node; None when somebody else moved it since."""

    def __init__(self) -> None:
        self.ordered: JsonValue = None
        self._busy_ns = -1
        self._is_ours = False

    def order(self, target: JsonValue, now_ns: int) -> None:
        """An order of this node is accepted; busy until something is read that is newer."""
        self.ordered, self._is_ours = target, True
        self._busy_ns = max(self._busy_ns, now_ns)

    def look(self, is_busy: bool, now_ns: int, read_ns: int) -> None:
        """The device as it is now; read_ns: when it was read last."""
        if is_busy:
            self._busy_ns = now_ns
            if not self._is_ours:
                self.ordered = None
        elif not self.is_busy(read_ns):
            self._is_ours = False

    def is_busy(self, read_ns: int) -> bool:
        """Until it has been read after the end of its order: who waits for the end reads where it is, not was."""
        return read_ns <= self._busy_ns


@dataclass(frozen=True, slots=True)
class ModuleView:
    """What parameters are read from."""

    state: StandState
    drive: Drive

    def reading(self, channel: str) -> ReadingState:
        """Refusal when it was never read."""
        found = self.state.readings.get(channel)
        if found is None:
            raise Refusal("ReadFailed", f"{channel} has not been read")
        return found

    def number(self, channel: str) -> TimedValue:
        """The value of a channel; Refusal when it is BAD: never an old one."""
        reading = self.reading(channel)
        if reading.value is None:
            kind = "CommunicationFailed" if reading.cause == "wire" else "HardwareError"
            raise Refusal(kind, reading.reason or "this is no measurement")
        return TimedValue(reading.value, reading.time_ns)


class ServiceOrder(NamedTuple):
    """A command of the stand's service, and the fields of its argument."""

    command: str
    fields: Mapping[str, JsonValue]


@dataclass(frozen=True, slots=True)
class Parameter:
    """read: a Refusal that it raises is reported instead of a value. change: the order for a value of that type;
    without it the parameter is read-only."""

    text: str
    info: DataInfo
    read: Callable[[ModuleView], TimedValue]
    change: Callable[[JsonValue], ServiceOrder] | None = None

    def make_report(self, seen: ModuleView) -> Report:
        """What is read now."""
        try:
            return self.read(seen)
        except Refusal as refusal:
            return refusal

    def describe(self) -> dict[str, object]:
        """Describe the module for the node's description."""
        return {"description": self.text, "datainfo": self.info, "readonly": self.change is None}


@dataclass(frozen=True, slots=True)
class ModuleCommand:
    """order: by the argument; None for what needs nothing to be done. is_stop: passes every queue."""

    text: str
    order: Callable[[JsonValue], ServiceOrder] | None
    argument: DataInfo | None = None
    result: DataInfo | None = None
    is_stop: bool = False

    def describe(self) -> dict[str, object]:
        """Describe the module for the node's description."""
        return {"description": self.text, "datainfo": datainfo.command(self.argument, self.result)}


@dataclass(frozen=True, slots=True)
class Module:
    """device: whose orders keep it busy, "" for none. read_ns: when that was read last. is_read_after: whether the end
    of each order is followed by a reading, and not only by the next poll."""

    text: str
    interface: InterfaceClass
    group: str
    parameters: Mapping[str, Parameter]
    commands: Mapping[str, ModuleCommand] = field(default_factory=dict[str, ModuleCommand])
    device: str = ""
    read_ns: Callable[[StandState], int] = lambda state: state.now_ns
    is_read_after: bool = False

    def make_read_only(self) -> Module:
        """The same, of which nothing can be changed."""
        return replace(self, parameters={name: replace(each, change=None) for name, each in self.parameters.items()})

    def describe(self) -> dict[str, object]:
        """Describe the module for the node's description."""
        return {
            "description": self.text,
            "interface_classes": [self.interface],
            "features": [],
            "group": self.group,
            "accessibles": {
                name: accessible.describe() for name, accessible in (*self.parameters.items(), *self.commands.items())
            },
        }


def make_status_parameter(codes: Mapping[str, int], read: Callable[[ModuleView], tuple[int, str]]) -> Parameter:
    """The parameter of that name."""

    def reported(seen: ModuleView) -> TimedValue:
        code, sentence = read(seen)
        return TimedValue([code, sentence])

    return Parameter("what it does, and why", datainfo.status(codes), reported)


def get_sensor_status(seen: ModuleView, channel: str) -> tuple[int, str]:
    """The status of what is read from one channel."""
    reading = seen.state.readings.get(channel)
    if reading is None or reading.value is None:
        return ERROR, "has not been read" if reading is None else reading.reason or "this is no measurement"
    return (WARN, reading.reason) if reading.quality != "good" else (IDLE, "")


def get_drive_status(seen: ModuleView, channel: str, read_ns: int) -> tuple[int, str]:
    """The status of what moves, but for what only the device itself knows."""
    code, sentence = get_sensor_status(seen, channel)
    state = seen.state
    if code == ERROR:
        return code, sentence
    if state.fault is not None:
        return ERROR, f"the stand has tripped: {state.fault.text}; reset it once the cause is removed"
    if seen.drive.is_busy(read_ns):
        return BUSY, "under way"
    if code == IDLE and state.phase != "idle":
        return IDLE, "a run has the stand"
    if code == IDLE and state.reasons:
        return WARN, f"the stand is held: {', '.join(state.reasons)}"
    return code, sentence


def make_device_order(device: str, verb: str, **arguments: JsonValue) -> ServiceOrder:
    """An order to a device, through the gate of all that is done by hand."""
    return ServiceOrder("device", {"device": device, "verb": verb, "arguments": arguments})
