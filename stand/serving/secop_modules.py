"""The modules of a stand for SECoP, all derived: what a device reads and takes by hand gives its modules, the state of
the stand their values, and the commands of the stand's service those of the module `run`."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple, cast

from pydantic import JsonValue

from thermostand.stand.config.chamber_section import BAND_K
from thermostand.stand.serving.api_models import DeviceState, DeviceVerb, ReadingState, RunStatus, StandState
from thermostand.stand.serving.commands import STOP, Command

IDLE, WARN, BUSY, RAMPING, ERROR = 100, 200, 300, 370, 400  # of a status (specification, "status")
DataInfo = dict[str, Any]
Order = tuple[str, dict[str, JsonValue]]  # a command of the stand's service, and the fields of its argument
Read = Callable[[StandState], ReadingState | JsonValue]
GetStatus = Callable[[StandState], tuple[int, str]]
_PLACED_BY = {"set": ("pv", "sp"), "move": ("position", "position")}  # by a verb: the channels of value and target
_OWN_NAMES = {STOP: "stop", "reset": "clear_errors"}  # that SECoP has itself; all others get an underscore

# SECoP's data types, as far as this node has them.
_TEXT: DataInfo = {"type": "string", "isUTF8": True}
_WHOLE: DataInfo = {"type": "int", "min": 0, "max": (1 << 31) - 1}  # of 32 bits: what EPICS takes for a limit
_FLAG: DataInfo = {"type": "bool"}
_PHASES: DataInfo = {"type": "enum", "members": {"idle": 0, "running": 1, "held": 2, "stopping": 3}}
_PLACES: DataInfo = {"type": "enum", "members": {"closed": 0, "open": 1}}
_CODES = {"IDLE": IDLE, "WARN": WARN, "BUSY": BUSY, "RAMPING": RAMPING, "ERROR": ERROR}
_STATUS: DataInfo = {"type": "tuple", "members": [{"type": "enum", "members": _CODES}, _TEXT]}
_BY_TYPE: dict[object, DataInfo] = {str: _TEXT, int: _WHOLE, float: {"type": "double"}}
_TYPES: dict[str, tuple[type, ...]] = {"double": (int, float), "int": (int,), "enum": (int,), "string": (str,)}


class Refusal(Exception):
    """What is answered instead of a value: SECoP's class of the error, and a sentence."""

    def __init__(self, error: str, text: str) -> None:
        super().__init__(text)
        self.error, self.text = error, text


def check_value(info: DataInfo, value: JsonValue) -> JsonValue:
    """The value, when it is of that type; Refusal WrongType or RangeError. An enum takes its names, too."""
    kind, members = info["type"], info.get("members", {})
    if kind == "enum" and isinstance(value, str):
        value = members.get(value)
    if isinstance(value, bool) or not isinstance(value, _TYPES[kind]):
        raise Refusal("WrongType", f"one of {', '.join(members)} is needed" if members else f"a {kind} is needed")
    if members and value not in members.values():
        raise Refusal("RangeError", f"there are {', '.join(f'{name} ({each})' for name, each in members.items())}")
    low, high = info.get("min", -1e308), info.get("max", 1e308)
    if isinstance(value, int | float) and not members and not low <= value <= high:
        raise Refusal("RangeError", f"at least {low:g} and at most {high:g}")
    return float(value) if kind == "double" and isinstance(value, int) else value


@dataclass(frozen=True, slots=True)
class Parameter:
    """read: a value or a reading, None for what is not known. change: the order for a value of that type; without it
    the parameter is read-only."""

    text: str
    info: DataInfo
    read: Read
    change: Callable[[JsonValue], Order] | None = None


@dataclass(frozen=True, slots=True)
class ModuleCommand:
    """order: by the argument; None for what needs nothing to be done. is_stop: passes every queue."""

    text: str
    order: Callable[[JsonValue], Order] | None
    argument: DataInfo | None = None
    result: DataInfo | None = None
    is_stop: bool = False


class Drive:
    """What is under way with one device. target: where to, by this node; None when somebody else moved it since.
    channel: by which it is seen to have arrived, "" for the state of the stand. is_read_after: whether the end of each
    order is followed by a reading, and not only by the next poll."""

    def __init__(self, device: str, channel: str = "", *, is_read_after: bool = False) -> None:
        self.device, self.channel, self.is_read_after = device, channel, is_read_after
        self.target: JsonValue = None
        self.is_ordering = False  # an order of this node is on its way
        self._busy_ns, self._is_ours = -1, False

    def order(self, target: JsonValue, now_ns: int) -> None:
        """An order of this node is accepted; busy until something is read that is newer."""
        self.target, self._is_ours, self._busy_ns = target, True, max(self._busy_ns, now_ns)

    def look(self, state: StandState) -> None:
        """See whether it carries out an order."""
        if self.device in state.busy:
            self._busy_ns = state.now_ns
            self.target = self.target if self._is_ours else None
        elif not self.is_busy(state):
            self._is_ours = False

    def is_busy(self, state: StandState) -> bool:
        """Until it has been read after the end of its order: who waits for the end reads where it is, not was."""
        reading = state.readings.get(self.channel)
        read_ns = state.now_ns if not self.channel else -1 if reading is None else reading.time_ns
        return self.is_ordering or read_ns <= self._busy_ns


class Module(NamedTuple):
    """drive: of the device that carries out its orders, None for none."""

    text: str
    group: str
    parameters: Mapping[str, Parameter]
    commands: Mapping[str, ModuleCommand]
    drive: Drive | None = None

    def describe(self, *, read_only: bool) -> dict[str, object]:
        """Return what a client gets of it."""
        accessibles: dict[str, object] = {
            name: {"description": each.text, "datainfo": each.info, "readonly": read_only or each.change is None}
            for name, each in self.parameters.items()
        }
        for name, each in self.commands.items():
            given = {"type": "command", "argument": each.argument, "result": each.result}
            info = {key: value for key, value in given.items() if value is not None}
            accessibles[name] = {"description": each.text, "datainfo": info}
        classes = ["Readable" if self.drive is None else "Drivable"]
        about = {"description": self.text, "interface_classes": classes, "features": [], "group": self.group}
        return {**about, "accessibles": accessibles}


def make_modules(
    devices: Iterable[DeviceState], readings: Mapping[str, ReadingState], commands: Mapping[str, Command]
) -> dict[str, Module]:
    """Make the modules by name, in the order in which clients show them: a temperature's has the name of its channel,
    with an underscore."""
    found: dict[str, Module] = {}
    made = (pair for device in devices for pair in _make_device_modules(device, readings))
    for name, module in (*made, ("run", _make_run(commands))):
        while name in found:  # such as an axis that is called chamber
            name += "_"
        found[name] = module
    return found


def _make_device_modules(device: DeviceState, readings: Mapping[str, ReadingState]) -> Iterator[tuple[str, Module]]:
    to_place = next((each for each in device.verbs if each.verb in _PLACED_BY), None)
    if device.kind == "flap":
        yield device.name, _make_flap(device.name)
    elif to_place is not None:
        yield "chamber" if device.kind == "regulator" else device.name, _make_drive(device, to_place, readings)
    else:
        for channel in device.channels:
            if channel in readings and readings[channel].unit == "degC":
                parameters = {
                    "value": _make_value(channel, "degC"),
                    "status": _make_status(lambda state, channel=channel: _get_reading_status(state, channel)),
                }
                yield channel.replace(".", "_"), Module(f"temperature {channel}", device.name, parameters, {})


def _make_drive(device: DeviceState, to_place: DeviceVerb, readings: Mapping[str, ReadingState]) -> Module:
    """The chamber, or a stage."""
    is_chamber = device.kind == "regulator"
    name, given = device.name, to_place.arguments[0]
    channel, set_point = (f"{name}.{each}" for each in _PLACED_BY[to_place.verb])
    drive = Drive(name, set_point, is_read_after=not is_chamber)
    unit = readings[channel].unit if channel in readings else given.unit
    limits = {"min": given.minimum, "max": given.maximum}

    def get_status(state: StandState) -> tuple[int, str]:
        code, sentence = _get_drive_status(state, channel, drive)
        target, air_degC = state.setpoint_degC, state.readings[channel].value if channel in state.readings else None
        if not is_chamber or code not in (IDLE, WARN) or air_degC is None:
            return code, sentence
        if target is not None and abs(air_degC - target) > BAND_K:
            return RAMPING, f"on the way to {target:g} degC"
        return code, sentence or ("neither heats nor cools" if target is None else f"at {target:g} degC")

    parameters = {
        "value": _make_value(channel, unit),
        "status": _make_status(get_status),
        "target": Parameter(
            "where it is to be",
            {"type": "double", "unit": unit, **{key: value for key, value in limits.items() if value is not None}},
            lambda state: state.readings.get(set_point) if drive.target is None else drive.target,
            lambda value: _order_device(name, to_place.verb, **{given.name: value}),
        ),
        **(_OF_CHAMBER if is_chamber else {}),
    }
    commands = {
        _OWN_NAMES.get(each.verb, f"_{each.verb}"): ModuleCommand(
            each.text, lambda _, verb=each.verb: _order_device(name, verb)
        )
        for each in device.verbs
        if not each.arguments
    }
    text, group = ("the chamber's temperature", "chamber") if is_chamber else (f"the stage {name}", "stages")
    return Module(text, group, parameters, commands, drive)


_OF_CHAMBER = {
    "control_active": Parameter("whether it heats or cools", _FLAG, lambda state: state.setpoint_degC is not None),
    "_tolerance": Parameter("so close it is IDLE", {"type": "double", "unit": "K"}, lambda state: BAND_K),
    "_output": Parameter("heat; below zero cold", {"type": "double", "unit": "%"}, lambda state: state.output_percent),
    "_heat_permitted": Parameter("whether heat is permitted", _FLAG, lambda state: state.heater_permitted),
    "_compressor_on": Parameter("whether the compressor's relay is on", _FLAG, lambda state: state.compressor_on),
}


def _make_flap(name: str) -> Module:
    drive, members = Drive(name), cast("dict[str, int]", _PLACES["members"])

    def read(state: StandState) -> int:
        return members.get(state.flap, len(members))

    def get_status(state: StandState) -> tuple[int, str]:
        is_under_way = read(state) == len(members)
        return (BUSY, "under way") if is_under_way else _get_drive_status(state, f"{name}.position", drive)

    parameters = {
        "value": Parameter("where it is", {"type": "enum", "members": {**members, "moving": len(members)}}, read),
        "status": _make_status(get_status),
        "target": Parameter(
            "where it is to be",
            _PLACES,
            lambda state: min(read(state), members["open"]) if drive.target is None else drive.target,
            lambda value: _order_device(name, "open" if value else "close"),
        ),
    }
    stop = ModuleCommand("nothing: a flap is not left half open, its move of seconds is completed", None)
    return Module("the flap between chamber and camera", name, parameters, {"stop": stop}, drive)


_OF_RUN = {
    "_recipe": ("recipe", "what is run"),
    "_session": ("run_id", "the name of its session"),
    "_doing": ("doing", "the step under way"),
    "_step": ("step", "the number of the step under way"),
    "_steps": ("steps", "how many there are"),
    "_frames_saved": ("frames_saved", "frames on the disk"),
    "_frames_lost": ("frames_lost", "frames that were lost"),
}


def _make_run(commands: Mapping[str, Command]) -> Module:
    def of_run(name: str, text: str) -> Parameter:
        kind = cast("type[str] | type[int]", RunStatus.model_fields[name].annotation)
        return Parameter(text, _BY_TYPE[kind], lambda state: getattr(state.run, name) if state.run else kind())

    parameters = {
        "value": Parameter("the phase of the stand", _PHASES, lambda state: _PHASES["members"][state.phase]),
        "status": _make_status(_get_run_status),
        **{name: of_run(*found) for name, found in _OF_RUN.items()},
        "_prompt": Parameter("what an operator is asked for", _TEXT, lambda s: s.prompt.text if s.prompt else ""),
        "_held_by": Parameter("what holds it", _TEXT, lambda state: ", ".join(state.reasons)),
        "_fault": Parameter("what has tripped", _TEXT, lambda state: state.fault.text if state.fault else ""),
    }
    made = {_OWN_NAMES.get(name, f"_{name}"): _make_run_command(each) for name, each in commands.items()}
    offered = {name: each for name, each in made.items() if each is not None}
    return Module("runs, and the stand as a whole", "run", parameters, offered)


def _make_run_command(command: Command) -> ModuleCommand | None:
    """A command of the stand's service, when it takes at most one word or number; what it queues has a number."""
    name, taken, argument = command.secop_field, command.argument, None
    if name and taken is not None:
        argument = _BY_TYPE.get(taken.model_fields[name].annotation)
    if name is None or (name and argument is None):
        return None
    result = _WHOLE if "id" in command.answer.model_fields else None

    def order(value: JsonValue) -> Order:
        return command.name, {name: value} if name else {}

    return ModuleCommand(command.summary, order, argument, result, command.name == STOP)


def _make_value(channel: str, unit: str) -> Parameter:
    return Parameter("what it reads", {"type": "double", "unit": unit}, lambda state: state.readings.get(channel))


def _make_status(get: GetStatus) -> Parameter:
    return Parameter("what it does, and why", _STATUS, lambda state: list(get(state)))


def _get_reading_status(state: StandState, channel: str) -> tuple[int, str]:
    reading = state.readings.get(channel)
    if reading is None or reading.value is None:
        return ERROR, "it has not been read" if reading is None else reading.reason or "this is no measurement"
    return (WARN, reading.reason) if reading.quality != "good" else (IDLE, "")


def _get_drive_status(state: StandState, channel: str, drive: Drive) -> tuple[int, str]:
    code, sentence = _get_reading_status(state, channel)
    if code == ERROR:
        return code, sentence
    if state.fault is not None:
        return ERROR, f"the stand has tripped: {state.fault.text}; reset it once the cause is removed"
    if drive.is_busy(state):
        return BUSY, "under way"
    if code == IDLE and state.phase != "idle":
        return IDLE, "a run has the stand"
    if code == IDLE and state.reasons:
        return WARN, f"the stand is held: {', '.join(state.reasons)}"
    return code, sentence


def _get_run_status(state: StandState) -> tuple[int, str]:
    if state.fault is not None:
        return ERROR, state.fault.text
    if state.reasons:
        return (BUSY if state.run else WARN), f"held: {', '.join(state.reasons)}"
    if state.by_hand is not None:
        text = f"heat by hand, set-point {state.by_hand.setpoint_degC:g} degC"
        return (IDLE, text) if state.by_hand.cut_ns is None else (WARN, f"{text}; cut by the relay board's timer")
    return (IDLE, "") if state.phase == "idle" else (BUSY, "a run is under way" if state.run is None else "")


def _order_device(device: str, verb: str, **arguments: JsonValue) -> Order:
    """An order to a device, through the gate of all that is done by hand."""
    return "device", {"device": device, "verb": verb, "arguments": arguments}
