"""The modules of a stand: one for each temperature, the chamber, the flap, each stage, and one for runs."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping

from pydantic import JsonValue

from thermostand.stand.estimating.chamber_model import BAND_K
from thermostand.stand.serving.api_models import DeviceState, ReadingState, RunStatus, StandState
from thermostand.stand.serving.commands import STOP
from thermostand.stand.serving.commands import Command as Ordered
from thermostand.stand.serving.secop import datainfo
from thermostand.stand.serving.secop.modules import (
    BUSY,
    DRIVE_CODES,
    ERROR,
    IDLE,
    RAMPING,
    SENSOR_CODES,
    WARN,
    Module,
    ModuleCommand,
    ModuleView,
    Parameter,
    ServiceOrder,
    TimedValue,
    get_drive_status,
    get_sensor_status,
    make_device_order,
    make_status_parameter,
)
from thermostand.stand.serving.secop.secop_lines import Refusal

CHAMBER, RUN = "chamber", "run"
_NAMES = {STOP: "stop", "reset": "clear_errors"}  # that SECoP has itself; all others are our own
_INFOS: dict[object, Callable[[], datainfo.DataInfo]] = {
    str: datainfo.text,
    int: datainfo.whole,
    float: datainfo.double,
}
_CLOSED, _OPEN, _MOVING = 0, 1, 2
_PHASES = {"idle": 0, "running": 1, "held": 2, "stopping": 3}


def make_modules(
    devices: Iterable[DeviceState], readings: Mapping[str, ReadingState], commands: Mapping[str, Ordered]
) -> dict[str, Module]:
    """Make the modules by name, in the order in which clients show them: the channel's with an underscore for a
    temperature."""
    found: dict[str, Module] = {}
    for name, module in (*_iterate_modules(devices, readings), (RUN, _make_run(commands))):
        while name in found:  # such as an axis that is called chamber
            name += "_"
        found[name] = module
    return found


def _iterate_modules(
    devices: Iterable[DeviceState], readings: Mapping[str, ReadingState]
) -> Iterator[tuple[str, Module]]:
    for device in devices:
        match device.kind:
            case "regulator":
                yield CHAMBER, _make_chamber(device)
            case "flap":
                yield device.name, _make_flap(device)
            case "axis":
                yield device.name, _make_axis(device, readings)
            case "thermometers" | "camera":
                for channel in device.channels:
                    if readings[channel].unit == "degC":
                        yield channel.replace(".", "_"), _make_thermometer(device, channel)
            case _:
                pass


def _make_thermometer(device: DeviceState, channel: str) -> Module:
    return Module(
        f"temperature {channel}",
        "Readable",
        device.name,
        {
            "value": Parameter("the temperature", datainfo.double("degC"), lambda seen: seen.number(channel)),
            "status": make_status_parameter(SENSOR_CODES, lambda seen: get_sensor_status(seen, channel)),
        },
    )


def _make_chamber(device: DeviceState) -> Module:
    name, pv, sp = device.name, f"{device.name}.pv", f"{device.name}.sp"
    low, high = _get_range(device, "set")

    def read_ns(state: StandState) -> int:
        reading = state.readings.get(sp)
        return -1 if reading is None else reading.time_ns

    def read_status(seen: ModuleView) -> tuple[int, str]:
        code, sentence = get_drive_status(seen, pv, read_ns(seen.state))
        target = seen.state.setpoint_degC
        if code not in (IDLE, WARN):
            return code, sentence
        if target is None:
            return code, sentence or "neither heats nor cools"
        if abs((seen.number(pv).value or 0.0) - target) > BAND_K:  # pyright: ignore[reportOperatorIssue]
            return RAMPING, f"on the way to {target:g} degC"
        return code, sentence or f"at {target:g} degC"

    def read_target(seen: ModuleView) -> TimedValue:
        return seen.number(sp) if seen.drive.ordered is None else TimedValue(seen.drive.ordered)

    def change(value: JsonValue) -> ServiceOrder:
        return make_device_order(name, "set", setpoint_degC=value)

    parameters = {
        "value": Parameter("the air, as the regulator reads it", datainfo.double("degC"), lambda s: s.number(pv)),
        "status": make_status_parameter(DRIVE_CODES, read_status),
        "target": Parameter("the set-point", datainfo.double("degC", low, high), read_target, change),
        "control_active": Parameter(
            "whether it heats or cools", datainfo.boolean(), lambda s: TimedValue(s.state.setpoint_degC is not None)
        ),
        "_tolerance": Parameter(
            "so close to the target it is IDLE", datainfo.double("K"), lambda _: TimedValue(BAND_K, 0)
        ),
        "_output": Parameter("heat; below zero cold", datainfo.double("%"), _read_output),
        "_heat_permitted": Parameter(
            "whether heat is permitted", datainfo.boolean(), lambda s: TimedValue(s.state.heater_permitted)
        ),
        "_compressor_on": Parameter(
            "whether the compressor's relay is on", datainfo.boolean(), lambda s: TimedValue(s.state.compressor_on)
        ),
    }
    stop = ModuleCommand(
        "stop heating and cooling; the air drifts to the laboratory's", lambda _: make_device_order(name, "stop")
    )
    return Module("the chamber's temperature", "Drivable", CHAMBER, parameters, {"stop": stop}, name, read_ns)


def _read_output(seen: ModuleView) -> TimedValue:
    if seen.state.output_percent is None:
        raise Refusal("ReadFailed", "the regulator's output is not known")
    return TimedValue(seen.state.output_percent)


def _make_flap(device: DeviceState) -> Module:
    name, channel = device.name, f"{device.name}.position"
    places = {"closed": _CLOSED, "open": _OPEN}

    def read(seen: ModuleView) -> int:
        return {**places, "moving": _MOVING}.get(seen.state.flap, _MOVING)

    def read_status(seen: ModuleView) -> tuple[int, str]:
        return (BUSY, "under way") if read(seen) == _MOVING else get_drive_status(seen, channel, seen.state.now_ns)

    def read_target(seen: ModuleView) -> TimedValue:
        ordered = seen.drive.ordered
        return TimedValue(ordered if ordered is not None else min(read(seen), _OPEN))

    def change(value: JsonValue) -> ServiceOrder:
        return make_device_order(name, "open" if value == _OPEN else "close")

    parameters = {
        "value": Parameter(
            "where it is", datainfo.choice({**places, "moving": _MOVING}), lambda seen: TimedValue(read(seen))
        ),
        "status": make_status_parameter(DRIVE_CODES, read_status),
        "target": Parameter("where it is to be", datainfo.choice(places), read_target, change),
    }
    stop = ModuleCommand("nothing: a flap is not left half open, its move of seconds is completed", None)
    return Module("the flap between chamber and camera", "Drivable", name, parameters, {"stop": stop}, name)


def _make_axis(device: DeviceState, readings: Mapping[str, ReadingState]) -> Module:
    name, channel = device.name, f"{device.name}.position"
    reading = readings.get(channel)
    info = datainfo.double("" if reading is None else reading.unit)

    def read_ns(state: StandState) -> int:
        reading = state.readings.get(channel)
        return -1 if reading is None else reading.time_ns

    def read_status(seen: ModuleView) -> tuple[int, str]:
        return get_drive_status(seen, channel, read_ns(seen.state))

    def read_target(seen: ModuleView) -> TimedValue:
        return seen.number(channel) if seen.drive.ordered is None else TimedValue(seen.drive.ordered)

    def change(value: JsonValue) -> ServiceOrder:
        return make_device_order(name, "move", position=value)

    parameters = {
        "value": Parameter("where it is", info, lambda seen: seen.number(channel)),
        "status": make_status_parameter(DRIVE_CODES, read_status),
        "target": Parameter("where it is to be", {**info, **_get_limits(device, "move")}, read_target, change),
    }
    commands = {
        "stop": ModuleCommand("stop where it is", lambda _: make_device_order(name, "stop")),
        "_home": ModuleCommand("find the home switch", lambda _: make_device_order(name, "home")),
    }
    return Module(f"the stage {name}", "Drivable", "stages", parameters, commands, name, read_ns, is_read_after=True)


def _make_run(commands: Mapping[str, Ordered]) -> Module:
    def parameter(text: str, info: datainfo.DataInfo, read: Callable[[RunStatus], JsonValue], none: JsonValue):
        return Parameter(text, info, lambda s: TimedValue(none if s.state.run is None else read(s.state.run)))

    parameters = {
        "value": Parameter(
            "the phase of the stand", datainfo.choice(_PHASES), lambda s: TimedValue(_PHASES[s.state.phase])
        ),
        "status": make_status_parameter(DRIVE_CODES, _get_run_status),
        "_recipe": parameter("what is run", datainfo.text(), lambda run: run.recipe, ""),
        "_session": parameter("the name of its session", datainfo.text(), lambda run: run.run_id, ""),
        "_doing": parameter("the step under way", datainfo.text(), lambda run: run.doing, ""),
        "_step": parameter("the number of the step under way", datainfo.whole(), lambda run: run.step, 0),
        "_steps": parameter("how many there are", datainfo.whole(), lambda run: run.steps, 0),
        "_frames_saved": parameter("frames on the disk", datainfo.whole(), lambda run: run.frames_saved, 0),
        "_frames_lost": parameter("frames that were lost", datainfo.whole(), lambda run: run.frames_lost, 0),
        "_prompt": Parameter(
            "what an operator is asked for",
            datainfo.text(),
            lambda s: TimedValue(s.state.prompt.text if s.state.prompt else ""),
        ),
        "_held_by": Parameter("what holds it", datainfo.text(), lambda s: TimedValue(", ".join(s.state.reasons))),
        "_fault": Parameter(
            "what has tripped",
            datainfo.text(),
            lambda s: TimedValue("" if s.state.fault is None else s.state.fault.text),
        ),
    }
    ordered = {
        _NAMES.get(name, f"_{name}"): _make_command(each) for name, each in commands.items() if _is_offered(each)
    }
    return Module("runs, and the stand as a whole", "Readable", RUN, parameters, ordered)


def _get_run_status(seen: ModuleView) -> tuple[int, str]:
    state = seen.state
    if state.fault is not None:
        return ERROR, state.fault.text
    if state.reasons:
        return (BUSY if state.run else WARN), f"held: {', '.join(state.reasons)}"
    if state.by_hand is not None:
        text = f"heat by hand, set-point {state.by_hand.setpoint_degC:g} degC"
        return (IDLE, text) if state.by_hand.cut_ns is None else (WARN, f"{text}; cut by the relay board's timer")
    return (IDLE, "") if state.phase == "idle" else (BUSY, "a run is under way" if state.run is None else "")


def _is_offered(command: Ordered) -> bool:
    field = command.secop_field
    return field is not None and (not field or _get_field_type(command, field) in _INFOS)


def _get_field_type(command: Ordered, field: str) -> object:
    return None if command.argument is None else command.argument.model_fields[field].annotation


def _make_command(command: Ordered) -> ModuleCommand:
    """A command of the stand's service, with at most one field of its argument; what it queues has a number."""
    field = command.secop_field

    def order(value: JsonValue) -> ServiceOrder:
        return ServiceOrder(command.name, {field: value} if field else {})

    argument = _INFOS[_get_field_type(command, field)]() if field else None
    result = datainfo.whole() if "id" in command.answer.model_fields else None
    return ModuleCommand(command.summary, order, argument, result, is_stop=command.name == STOP)


def _get_range(device: DeviceState, verb: str) -> tuple[float | None, float | None]:
    arguments = [each.arguments[0] for each in device.verbs if each.verb == verb and each.arguments]
    return (arguments[0].minimum, arguments[0].maximum) if arguments else (None, None)


def _get_limits(device: DeviceState, verb: str) -> dict[str, JsonValue]:
    low, high = _get_range(device, verb)
    return {} if low is None or high is None else {"min": low, "max": high}
