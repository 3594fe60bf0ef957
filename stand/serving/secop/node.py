"""The node: what each request is answered, and what has changed since the last look. No socket.

What is read comes from the bridge's snapshot; what is ordered passes the bridge as the HTTP interface's orders do, and
is an event of the recording. Nothing here is called by the control loop.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass

from pydantic import BaseModel, JsonValue, ValidationError

from thermostand.foundation.clock import NS_PER_S
from thermostand.foundation.errors import (
    ConfigError,
    DeviceError,
    DeviceFault,
    GarbledReply,
    StandError,
    StandTripped,
    Unreachable,
)
from thermostand.stand.serving.api.bridge import Bridge, NoAnswer, StateSnapshot
from thermostand.stand.serving.api_models import Conflict, DeviceState, QueuedRun, StandState, Who
from thermostand.stand.serving.secop.datainfo import check_value
from thermostand.stand.serving.secop.devices import make_modules
from thermostand.stand.serving.secop.modules import (
    Drive,
    Module,
    ModuleCommand,
    ModuleView,
    Report,
    ServiceOrder,
    TimedValue,
)
from thermostand.stand.serving.secop.secop_lines import (
    ANSWERS,
    IDENTIFICATION,
    IDENTIFY,
    ErrorClass,
    Refusal,
    SecopRequest,
    make_message,
    make_report,
)

WHO = Who(name="", how="secop")
_OLD_S = 10.0  # a snapshot is made twice a second: the control loop hangs
_SILENT = Refusal("CommunicationFailed", "the stand's control loop does not answer")
_HELP = (
    "*IDN?, describe, activate [module], deactivate [module], read module:parameter, change module:parameter value, "
    "do module:command [argument], ping id; `do run:stop` makes the stand safe"
)

ParameterPath = tuple[str, str]


@dataclass(frozen=True, slots=True)
class _Reported:
    """A parameter as clients know it; t_s: s since the epoch, UTC."""

    report: Report
    t_s: float


class Node:
    """The SECoP node of a stand with these devices. `tell` is given each parameter that has changed, with the line that
    says so; `failed` what should not happen. read_only: nothing is ordered but STOP."""

    def __init__(
        self,
        bridge: Bridge,
        devices: Iterable[DeviceState],
        tell: Callable[[ParameterPath, bytes], None],
        failed: Callable[[Exception], None],
        *,
        read_only: bool = False,
    ) -> None:
        state = bridge.snapshot.state
        found = make_modules(devices, state.readings, bridge.commands)
        self.modules: dict[str, Module] = (
            {n: each.make_read_only() for n, each in found.items()} if read_only else found
        )
        self._read_only = read_only
        self.description = make_message("describing", ".", _make_description(state, self.modules))
        self._bridge = bridge
        self._tell, self._failed = tell, failed
        self._drives = {name: Drive() for name in self.modules}
        self._reported: dict[ParameterPath, _Reported] = {}
        self.look()

    def look(self) -> None:
        """Tell what is not as it was at the last look."""
        snapshot = self._bridge.snapshot
        for name, module in self.modules.items():
            is_busy = module.device in snapshot.state.busy
            self._drives[name].look(is_busy, snapshot.state.now_ns, module.read_ns(snapshot.state))
            for parameter in module.parameters:
                if self._has_changed(snapshot, name, parameter):
                    self._tell((name, parameter), self.make_update((name, parameter)))

    def list_parameters(self, module: str = "") -> list[ParameterPath]:
        """Every parameter, of one module or of all."""
        return [place for place in self._reported if module in ("", place[0])]

    def make_update(self, place: ParameterPath) -> bytes:
        """The line that tells a parameter's value, or why there is none."""
        return self._make_line("update", "error_update", place)

    def is_stop(self, request: SecopRequest) -> bool:
        """Whether this is STOP, which nothing may delay."""
        module, name = request.place
        command = self.modules[module].commands.get(name) if module in self.modules else None
        return request.action == "do" and command is not None and command.is_stop

    async def stop(self, request: SecopRequest) -> bytes:
        """STOP; Refusal when the control loop does not answer."""
        try:
            await self._bridge.stop(WHO)
        except NoAnswer as error:
            raise Refusal("TimeoutError", str(error)) from error
        await self._bridge.get_fresh_snapshot()
        self.look()
        return self._make_done(request, None)

    async def answer(self, request: SecopRequest) -> bytes:
        """The answer to all but `activate`, `deactivate` and STOP; Refusal."""
        match request.action:
            case "describe":
                return self.description
            case "read":
                place = self._get_parameter_path(request, "value")
                return self._make_line("reply", "error_read", place, request.specifier)
            case "change":
                return await self._change(request)
            case "do":
                return await self._do(request)
            case "ping":
                return make_message("pong", request.specifier, make_report(None, self._now_s()))
            case "help":
                return make_message("helping", "", _HELP)
            case action if action == IDENTIFY:
                return f"{IDENTIFICATION}\n".encode()
            case _:
                raise Refusal("ProtocolError", f"there are {IDENTIFY}, {', '.join(ANSWERS)}")

    def get_module(self, name: str) -> Module:
        """Refusal when there is none of that name."""
        if name not in self.modules:
            raise Refusal("NoSuchModule", f"there are {', '.join(self.modules)}")
        return self.modules[name]

    async def _change(self, request: SecopRequest) -> bytes:
        name, parameter = place = self._get_parameter_path(request, "target")
        module = self.modules[name]
        found = module.parameters[parameter]
        if found.change is None:
            raise Refusal("ReadOnly", f"{name}:{parameter} can only be read")
        value = check_value(found.info, request.value())
        await self._perform_order(found.change(value), name, value)
        return self._make_line("changed", "error_change", place, request.specifier)

    async def _do(self, request: SecopRequest) -> bytes:
        name, word = request.place
        module = self.get_module(name)
        command = module.commands.get(word)
        if command is None:
            raise Refusal("NoSuchCommand", f"{name} has {', '.join(module.commands) or 'no commands'}")
        argument = self._get_argument(command, request)
        if command.order is None:
            return self._make_done(request, None)
        if self._read_only:
            raise Refusal("Disabled", "SECoP may look and do run:stop here, but order nothing: it is read-only")
        came = await self._perform_order(command.order(argument), name, None)
        return self._make_done(request, came.id if isinstance(came, QueuedRun) else None)

    def _get_argument(self, command: ModuleCommand, request: SecopRequest) -> JsonValue:
        value = request.value()
        if command.argument is not None:
            return check_value(command.argument, value)
        if value is not None:
            raise Refusal("WrongType", "this command takes no argument")
        return None

    async def _perform_order(self, order: ServiceOrder, name: str, target: JsonValue) -> BaseModel:
        """What came of it; what it changes at once has been sent when this returns."""

        module, began_ns = self.modules[name], self._bridge.snapshot.state.now_ns

        argument = self._bridge.commands[order.command].argument
        try:
            given = None if argument is None else argument.model_validate(order.fields)
            came = await self._bridge.perform(order.command, WHO, given)
        except ValidationError as error:
            raise Refusal("RangeError", error.errors()[0]["msg"]) from error
        except (StandError, NoAnswer) as error:
            raise _make_refusal(error, (await self._bridge.get_fresh_snapshot()).state) from error
        except Exception as error:
            self._failed(error)
            raise Refusal("InternalError", f"failed ({type(error).__name__}); the stand's events say more") from error
        snapshot = await self._bridge.get_fresh_snapshot()
        if module.device:
            self._drives[name].order(target, began_ns if module.is_read_after else snapshot.state.now_ns)
        self.look()
        return came

    def _get_parameter_path(self, request: SecopRequest, default: str) -> ParameterPath:
        name, parameter = request.place
        module = self.get_module(name)
        parameter = parameter or default
        if parameter not in module.parameters:
            raise Refusal("NoSuchParameter", f"{name} has {', '.join(module.parameters)}")
        return name, parameter

    def _has_changed(self, snapshot: StateSnapshot, name: str, parameter: str) -> bool:
        place, state = (name, parameter), snapshot.state
        seen = ModuleView(state, self._drives[name])
        now = _SILENT if snapshot.age_s > _OLD_S else self.modules[name].parameters[parameter].make_report(seen)
        before = self._reported.get(place)
        if before is not None and before.report == now:
            return False
        time_ns = now.time_ns if isinstance(now, TimedValue) else None
        self._reported[place] = _Reported(now, _compute_utc_s(state, state.now_ns if time_ns is None else time_ns))
        return True

    def _make_line(self, word: str, error_word: str, place: ParameterPath, specifier: str = "") -> bytes:
        last, specifier = self._reported[place], specifier or ":".join(place)
        if isinstance(last.report, Refusal):
            qualifiers = {"t": round(last.t_s, 6)}
            return make_message(error_word, specifier, [last.report.error, last.report.text, qualifiers])
        return make_message(word, specifier, make_report(last.report.value, last.t_s))

    def _make_done(self, request: SecopRequest, result: JsonValue) -> bytes:
        return make_message("done", request.specifier, make_report(result, self._now_s()))

    def _now_s(self) -> float:
        snapshot = self._bridge.snapshot
        return _compute_utc_s(snapshot.state, snapshot.state.now_ns) + snapshot.age_s


def _compute_utc_s(state: StandState, time_ns: int) -> float:
    return (time_ns + state.utc_offset_ns) / NS_PER_S


def _make_description(state: StandState, found: dict[str, Module]) -> dict[str, object]:
    return {
        "equipment_id": f"thermostand.{re.sub(r'[^A-Za-z0-9_.-]+', '-', state.stand)}",
        "firmware": f"thermostand {state.version}",
        "description": f"{state.stand}: a thermal chamber for cameras" + (", simulated" if state.simulated else ""),
        "modules": {name: module.describe() for name, module in found.items()},
    }


def _make_refusal(error: Exception, state: StandState) -> Refusal:
    """SECoP's class of what an order was refused for. What a device reported is the cause of a Conflict."""
    while isinstance(error, Conflict) and isinstance(error.__cause__, StandError):
        error = error.__cause__
    return Refusal(_get_error_class(error, state), str(error))


def _get_error_class(error: Exception, state: StandState) -> ErrorClass:
    match error:
        case NoAnswer():
            return "TimeoutError"
        case ConfigError():
            return "RangeError"
        case Unreachable() | GarbledReply():
            return "CommunicationFailed"
        case DeviceFault():
            return "HardwareError"
        case StandTripped():
            return "Disabled"
        case DeviceError():
            return "Impossible"
        case Conflict() if state.phase != "idle" and state.fault is None:
            return "IsBusy"
        case Conflict() if state.fault is not None or state.reasons:
            return "Disabled"
        case _:
            return "Impossible"
