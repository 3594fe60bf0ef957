"""The SECoP node at its TCP port: what each request is answered, and what its clients follow (SECoP 1.0, specification,
"Messages" and "Reports").

    read chamber:value         ->  reply chamber:value [24.0, {"t": 1795416390.44}]
    change chamber:target 300  ->  error_change chamber:target ["RangeError", "at least -10 and at most 60", {}]

What is read comes from the bridge's snapshot; what is ordered passes the bridge as the HTTP interface's orders do. A
client's requests are answered in the order of coming; STOP passes them. A first line that is no SECoP ends the
connection: a page in a browser could be made to send commands here.
"""

from __future__ import annotations

import asyncio
import json
import re
import socket
from collections.abc import Awaitable, Callable
from contextlib import nullcontext, suppress
from typing import NamedTuple, NoReturn

from pydantic import BaseModel, JsonValue, ValidationError

from thermostand.foundation.clock import NS_PER_S
from thermostand.foundation.errors import (
    ConfigError,
    DeviceFault,
    GarbledReply,
    StandError,
    StandTripped,
    Unreachable,
)
from thermostand.stand.serving.api.bridge import Bridge, NoAnswer
from thermostand.stand.serving.api.listeners import ProtocolListener
from thermostand.stand.serving.api_models import Conflict, QueuedRun, ReadingState, Requester, StandState
from thermostand.stand.serving.secop_modules import Module, Order, Parameter, Refusal, check_value, make_modules

WHO = Requester(name="", how="secop")
IDENTIFY, IDENTIFICATION = "*IDN?", "ISSE&SINE2020,SECoP,V2019-09-16,v1.0"  # clients compare the first two fields
WORDS = (IDENTIFY, "describe", "activate", "deactivate", "read", "change", "do", "ping", "help")
# Round numbers; nothing was measured.
LINE_LIMIT_BYTES = 1 << 14
MOST_CLIENTS = 16
_MOST_WAITING = 64  # requests of a client
_MOST_UNREAD_BYTES = 1 << 20  # some minutes of all values
_SEND_LIMIT_S = 10.0
_LOOK_S = 0.1
_SPEAK_WITHIN_S = 10.0  # the first request
_FAREWELL_S = 1.0
_OLD_S = 10.0  # a snapshot is made twice a second: the control loop hangs
_CLASSES: tuple[tuple[type[Exception], str], ...] = (
    (NoAnswer, "TimeoutError"),
    (ConfigError, "RangeError"),
    (Unreachable, "CommunicationFailed"),
    (GarbledReply, "CommunicationFailed"),
    (DeviceFault, "HardwareError"),
    (StandTripped, "Disabled"),
)

Place = tuple[str, str]  # a module and its parameter


class SecopRequest(NamedTuple):
    """A line: `action [specifier [data]]`. data: JSON as it came, "" for none."""

    action: str
    specifier: str = ""
    data: str = ""

    @property
    def place(self) -> Place:
        """The module and its parameter or command, "" where there is none."""
        module, _, accessible = self.specifier.partition(":")
        return module, accessible.partition(":")[0]

    def value(self) -> JsonValue:
        """The data, None for none; Refusal when it is no JSON."""
        try:
            return json.loads(self.data, parse_constant=_refuse_constant) if self.data.strip() else None
        except (ValueError, RecursionError):
            raise Refusal("BadJSON", "the data is no JSON value") from None


def _refuse_constant(text: str) -> NoReturn:
    raise ValueError(text)


def parse_request(line: bytes) -> SecopRequest:
    """A line without its end; a CR before that is left out. An empty one asks for help. Refusal when it is no UTF-8."""
    try:
        text = line.removesuffix(b"\r").decode()
    except UnicodeDecodeError:
        raise Refusal("ProtocolError", "a line is UTF-8") from None
    action, _, rest = text.partition(" ")
    specifier, _, data = rest.partition(" ")
    return SecopRequest(action or "help", specifier, data)


def make_message(action: str, specifier: str = "", content: object = None) -> bytes:
    """A line with its end; `content` as JSON, none without it. NaN and infinities are a ValueError: SECoP has none."""
    words = action if content is None and not specifier else f"{action} {specifier}"
    if content is not None:
        words += f" {json.dumps(content, ensure_ascii=False, allow_nan=False)}"
    return words.encode("utf-8", "replace") + b"\n"


def make_secop_listener(port: int, *, read_only: bool = False) -> ProtocolListener:
    """The node's door, for this machine only, as the protocol knows neither user nor password. read_only: who comes may
    look, and order nothing but STOP."""

    async def serve(listening: socket.socket, bridge: Bridge, failed: Callable[[Exception], None]) -> None:
        devices = await bridge.ask(lambda desk: desk.devices())
        modules = make_modules(devices, bridge.snapshot.state.readings, bridge.commands)
        await Node(modules, bridge, failed, read_only=read_only).serve(listening)

    return ProtocolListener("--secop", "127.0.0.1", port, serve)


class Report(NamedTuple):
    """What a client gets of a parameter. error: SECoP's class, and `content` is its sentence; "" of a value. time_ns:
    when it was obtained, on the stand's clock; None: as long as the state says so."""

    error: str
    content: JsonValue
    time_ns: int | None = None


def _make_report(parameter: Parameter, state: StandState) -> Report:
    """Return what is read now; a BAD reading is an error, never an old value."""
    found = parameter.read(state)
    if found is None:
        return Report("ReadFailed", "it has not been read")
    if not isinstance(found, ReadingState):
        return Report("", found)
    if found.value is not None:
        return Report("", found.value, found.time_ns)
    kind = "CommunicationFailed" if found.cause == "wire" else "HardwareError"
    return Report(kind, found.reason or "this is no measurement", found.time_ns)


_SILENT = Report("CommunicationFailed", "the stand's control loop does not answer")


class Node:
    """The node of a stand with these modules. `failed` is called with errors that should not happen. read_only: nothing
    is ordered but STOP."""

    def __init__(
        self, modules: dict[str, Module], bridge: Bridge, failed: Callable[[Exception], None], *, read_only: bool
    ) -> None:
        self.modules, self.failed = modules, failed
        self._bridge, self._read_only = bridge, read_only
        self._reported: dict[Place, tuple[Report, float]] = {}  # as clients know it, since when: s since the epoch, UTC
        self._clients: dict[_Client, asyncio.Task[None]] = {}
        self._seen = bridge.snapshot
        self._look()

    async def serve(self, listening: socket.socket) -> None:
        """Serve until cancelled."""
        server = await asyncio.start_server(self._welcome, sock=listening)
        try:
            while True:
                try:
                    if self._bridge.snapshot is not self._seen or self._seen.age_s > 1.0:
                        self._look()
                except Exception as error:  # noqa: BLE001 - what one value is must not end the door
                    self.failed(error)
                await asyncio.sleep(_LOOK_S)
        finally:
            server.close()
            tasks = tuple(self._clients.values())
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)

    def _welcome(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """There is room for one more: who was silent longest leaves, those first who have asked nothing that is
        SECoP."""
        silent = sorted(self._clients, key=lambda each: (not each.is_stranger, each.heard_s))
        for left in silent[: max(0, len(silent) - MOST_CLIENTS + 1)]:
            self._clients.pop(left).cancel()
        client = _Client(self, reader, writer)
        task = self._clients[client] = asyncio.create_task(client.run())
        task.add_done_callback(lambda _: (self._clients.pop(client, None), client.close()))  # also before it has begun

    def _look(self) -> None:
        """Tell clients what is not as it was at the last look."""
        self._seen = self._bridge.snapshot
        state, is_old = self._seen.state, self._seen.age_s > _OLD_S
        for name, module in self.modules.items():
            if module.drive is not None:
                module.drive.look(state)
            for each, parameter in module.parameters.items():
                place, now = (name, each), _SILENT if is_old else _make_report(parameter, state)
                if place in self._reported and self._reported[place][0] == now:
                    continue
                time_ns = state.now_ns if now.time_ns is None else now.time_ns
                self._reported[place] = now, (time_ns + state.utc_offset_ns) / NS_PER_S
                for client in tuple(self._clients):
                    if name in client.followed:
                        client.say(self._make_line("update", "error_update", place))

    async def _refresh_state(self) -> StandState:
        snapshot = await self._bridge.get_fresh_snapshot()
        if snapshot is not self._seen:
            self._look()
        return snapshot.state

    def _make_line(self, word: str, error_word: str, place: Place, specifier: str = "") -> bytes:
        """The line that reports a parameter's value, or why there is none."""
        (error, content, _), t_s = self._reported[place]
        qualifiers, specifier = {"t": round(t_s, 6)}, specifier or ":".join(place)
        return make_message(
            error_word if error else word, specifier, [*([error] if error else ()), content, qualifiers]
        )

    def is_stop(self, request: SecopRequest) -> bool:
        """Return whether this is STOP, which nothing may delay."""
        module, name = request.place
        command = self.modules[module].commands.get(name) if module in self.modules else None
        return request.action == "do" and command is not None and command.is_stop

    async def answer(self, request: SecopRequest, client: _Client) -> bytes:
        """The answer; Refusal."""
        if self.is_stop(request):
            await self._perform(self._bridge.stop(WHO))
            await self._refresh_state()
            return self._make_done("done", request)
        match request.action:
            case "describe":
                return make_message("describing", ".", self._describe())
            case "activate" | "deactivate":
                return self._follow(request, client)
            case "read":
                place, _ = self._get_parameter(request, "value")
                return self._make_line("reply", "error_read", place, request.specifier)
            case "change":
                place, parameter = self._get_parameter(request, "target")
                if parameter.change is None or self._read_only:
                    raise Refusal("ReadOnly", f"{':'.join(place)} can only be read")
                value = check_value(parameter.info, request.value())
                await self._order(parameter.change(value), self.modules[place[0]], value)
                return self._make_line("changed", "error_change", place, request.specifier)
            case "do":
                return self._make_done("done", request, await self._do(request))
            case "ping":
                return self._make_done("pong", request)
            case "help":
                return make_message("helping", "", f"{', '.join(WORDS)}; `do run:stop` makes the stand safe")
            case action if action == IDENTIFY:
                client.followed.clear()
                return f"{IDENTIFICATION}\n".encode()
            case _:
                raise Refusal("ProtocolError", f"there are {', '.join(WORDS)}")

    def _follow(self, request: SecopRequest, client: _Client) -> bytes:
        module = request.place[0]
        names = [module] if module else list(self.modules)
        found = {name: self._get(name).parameters for name in names}
        if request.action == "deactivate":
            client.followed -= found.keys()
            return make_message("inactive", module)
        client.followed |= found.keys()
        lines = [self._make_line("update", "error_update", (name, each)) for name in found for each in found[name]]
        return b"".join(lines) + make_message("active", module)

    def _describe(self) -> dict[str, object]:
        state = self._bridge.snapshot.state
        return {
            "equipment_id": f"thermostand.{re.sub(r'[^A-Za-z0-9_.-]+', '-', state.stand)}",
            "firmware": f"thermostand {state.version}",
            "description": f"{state.stand}: a thermal chamber for cameras" + (", simulated" if state.simulated else ""),
            "modules": {name: each.describe(read_only=self._read_only) for name, each in self.modules.items()},
        }

    def _get(self, name: str) -> Module:
        if name not in self.modules:
            raise Refusal("NoSuchModule", f"there are {', '.join(self.modules)}")
        return self.modules[name]

    def _get_parameter(self, request: SecopRequest, default: str) -> tuple[Place, Parameter]:
        name, parameter = request.place
        found, parameter = self._get(name).parameters, parameter or default
        if parameter not in found:
            raise Refusal("NoSuchParameter", f"{name} has {', '.join(found)}")
        return (name, parameter), found[parameter]

    async def _do(self, request: SecopRequest) -> JsonValue:
        name, word = request.place
        module, value = self._get(name), request.value()
        command = module.commands.get(word)
        if command is None:
            raise Refusal("NoSuchCommand", f"{name} has {', '.join(module.commands) or 'no commands'}")
        if command.argument is None and value is not None:
            raise Refusal("WrongType", "this command takes no argument")
        value = None if command.argument is None else check_value(command.argument, value)
        if command.order is None:
            return None
        if self._read_only:
            raise Refusal("Disabled", "SECoP may look and do run:stop here, but order nothing: it is read-only")
        return await self._order(command.order(value), module, None)

    async def _order(self, order: Order, module: Module, target: JsonValue) -> JsonValue:
        """The number of what it has queued; what it changes at once has been sent when this returns."""
        (name, fields), began_ns = order, self._bridge.snapshot.state.now_ns
        argument = self._bridge.commands[name].argument
        try:
            given = None if argument is None else argument.model_validate(fields)
        except ValidationError as error:
            raise Refusal("RangeError", error.errors()[0]["msg"]) from error
        if (drive := module.drive) is None:
            came = await self._perform(self._bridge.perform(name, WHO, given))
            await self._refresh_state()
            return came.id if isinstance(came, QueuedRun) else None
        drive.is_ordering = True
        try:
            await self._perform(self._bridge.perform(name, WHO, given))
            now_ns = (await self._bridge.get_fresh_snapshot()).state.now_ns
            drive.order(target, began_ns if drive.is_read_after else now_ns)
        finally:
            drive.is_ordering = False
        self._look()
        return None

    async def _perform(self, work: Awaitable[BaseModel]) -> BaseModel:
        """Do it; Refusal of SECoP's class. What a device reported is the cause of a Conflict."""
        try:
            return await work
        except (StandError, NoAnswer) as error:
            state = await self._refresh_state()
            while isinstance(error, Conflict) and isinstance(error.__cause__, StandError):
                error = error.__cause__
            found = next((name for kind, name in _CLASSES if isinstance(error, kind)), "Impossible")
            if isinstance(error, Conflict) and state.fault is None and state.phase != "idle":
                found = "IsBusy"
            elif isinstance(error, Conflict) and (state.fault is not None or state.reasons):
                found = "Disabled"
            raise Refusal(found, str(error)) from error

    def _make_done(self, word: str, request: SecopRequest, result: JsonValue = None) -> bytes:
        snapshot = self._bridge.snapshot
        t_s = (snapshot.state.now_ns + snapshot.state.utc_offset_ns) / NS_PER_S + snapshot.age_s
        return make_message(word, request.specifier, [result, {"t": round(t_s, 6)}])


class _Client:
    """followed: the modules of which it gets what changes."""

    def __init__(self, node: Node, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._loop = asyncio.get_running_loop()
        self.is_stranger, self.heard_s = True, self._loop.time()
        self.followed: set[str] = set()
        self._node, self._reader, self._writer = node, reader, writer
        self._tasks: set[asyncio.Task[None]] = set()
        self._order = asyncio.Lock()  # whose waiters have their turn in the order of coming

    def say(self, line: bytes) -> None:
        """Send a line, whether or not it reads."""
        if not self._writer.is_closing():
            self._writer.write(line)
        if self._writer.transport.get_write_buffer_size() > _MOST_UNREAD_BYTES:
            self._writer.transport.abort()

    async def run(self) -> None:
        """Serve it until it leaves, or has to."""
        try:
            with suppress(OSError):  # TimeoutError, too
                await self._receive()
        except Refusal as refusal:
            self._refuse(SecopRequest("line"), refusal)

    def close(self) -> None:
        """Hang up; what was written last still arrives."""
        for task in self._tasks:
            task.cancel()
        self._writer.close()
        self._loop.call_later(_FAREWELL_S, self._writer.transport.abort)

    async def _receive(self) -> None:
        rest = b""
        while True:
            async with asyncio.timeout(_SPEAK_WITHIN_S if self.is_stranger else None):
                data = await self._reader.read(LINE_LIMIT_BYTES)
            if not data:
                return
            self.heard_s = self._loop.time()
            *lines, rest = (rest + data).split(b"\n")
            for line in lines:
                self._take(line)
            if len(rest) > LINE_LIMIT_BYTES:
                raise Refusal("ProtocolError", f"a line has at most {LINE_LIMIT_BYTES} bytes")
            if len(self._tasks) >= _MOST_WAITING:
                await asyncio.wait(self._tasks)

    def _take(self, line: bytes) -> None:
        try:
            request = parse_request(line)
        except Refusal as refusal:
            if self.is_stranger:
                raise
            return self._refuse(SecopRequest("line"), refusal)
        if self.is_stranger and request.action not in WORDS:
            raise Refusal("ProtocolError", "this is no SECoP")
        self.is_stranger = False
        task = asyncio.create_task(self._answer(request))
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    async def _answer(self, request: SecopRequest) -> None:
        async with nullcontext() if self._node.is_stop(request) else self._order:
            try:
                self.say(await self._node.answer(request, self))
            except Refusal as refusal:
                self._refuse(request, refusal)
            except Exception as error:  # noqa: BLE001 - the stand's events say more, and nobody else is concerned
                self._node.failed(error)
                self._refuse(request, Refusal("InternalError", f"failed ({type(error).__name__})"))
            try:
                async with asyncio.timeout(_SEND_LIMIT_S):
                    await self._writer.drain()
            except OSError:  # gone, or it does not read
                self._writer.transport.abort()

    def _refuse(self, request: SecopRequest, refusal: Refusal) -> None:
        action, content = f"error_{request.action[:200]}", [refusal.error, refusal.text, {}]
        self.say(make_message(action, request.specifier[:200], content))
