"""The control socket of a running daemon, `control.sock` in the session's folder: one JSON object a line in, one out.

    {"do": "status"}    -> {"ok": true, "status": {...}}           the fields of RunStatus
    {"do": "pause"}     -> {"ok": true, "reasons": ["operator"]}   held before the next action; a dwell keeps its time
    {"do": "continue"}  -> {"ok": true, "reasons": [...]}          ends a pause; what still holds the run, if anything
    {"do": "clear"}     -> {"ok": true, "reasons": [...]}          an operator has seen to what tripped an interlock
    {"do": "stop"}      -> {"ok": true}                            the stand is made safe, then the run ends

Anything wrong is answered with {"ok": false, "error": sentence}. A connection may carry many requests; one that is
longer than 64 KiB, has no line end or does not come for 60 s is the last one. Only the user who started the daemon
may connect (mode 0600). Every time-out here is in real seconds.
"""

from __future__ import annotations

import asyncio
import fcntl
import inspect
import json
import os
import socket
import stat
from collections.abc import AsyncGenerator, Awaitable, Callable, Generator, Mapping
from contextlib import asynccontextmanager, contextmanager, suppress
from pathlib import Path
from typing import Literal, cast

from pydantic import BaseModel, ConfigDict

from drivers.interface import SessionError, StandError
from stand.running.gate import INTERLOCK, OPERATOR, Gate

SOCKET_NAME = "control.sock"
LINE_LIMIT_BYTES = 1 << 16
_MOST_CLIENTS = 64  # a script that leaks connections must not take the files the recording needs
_IDLE_LIMIT_S = 60.0
_ACCEPTING_TURNS = 5  # of the loop, from a connection that is taken from the kernel to its first task
_FAREWELL_LIMIT_S = 1.0  # for a client that does not read its last answer

Answer = dict[str, object]
Handler = Callable[[Mapping[str, object]], "Answer | Awaitable[Answer]"]
Handlers = Mapping[str, Handler]


class RunStatus(BaseModel):
    """What a run tells of itself. Instants are ns since the epoch on the stand's clock, which may be virtual.

    step: number of the step under way, 1 is the first. since_ns: when the present state began. end_ns: when the run is
    expected to end, None when unknown. temperatures_degC: by channel, None for a BAD reading. warning: the last one.
    """

    model_config = ConfigDict(frozen=True, allow_inf_nan=False)

    recipe: str
    step: int
    steps: int
    doing: str
    state: Literal["running", "held", "stopping"]
    reasons: tuple[str, ...]
    now_ns: int
    since_ns: int
    end_ns: int | None
    temperatures_degC: dict[str, float | None]
    frames_saved: int
    frames_lost: int
    disk_free_bytes: int
    warning: str = ""


def handlers(gate: Gate, stop: Callable[[], object], status: Callable[[], RunStatus]) -> Handlers:
    """The requests of the module's table; `stop` latches and cancels, and returns at once."""

    def held() -> Answer:
        return {"reasons": sorted(gate.reasons)}

    def pause(_: Mapping[str, object]) -> Answer:
        gate.hold(OPERATOR)
        return held()

    def continue_(_: Mapping[str, object]) -> Answer:
        gate.clear(OPERATOR)
        return held()

    def clear(_: Mapping[str, object]) -> Answer:
        if INTERLOCK not in gate.reasons:
            raise SessionError("there is nothing to clear: no interlock holds this run")
        gate.clear(INTERLOCK)
        return held()

    def end(_: Mapping[str, object]) -> Answer:
        stop()
        return {}

    def tell(_: Mapping[str, object]) -> Answer:
        return {"status": status().model_dump(mode="json")}

    return {"status": tell, "pause": pause, "continue": continue_, "clear": clear, "stop": end}


@asynccontextmanager
async def serve(path: Path, handlers: Handlers) -> AsyncGenerator[None]:
    """Answer requests at the Unix socket `path` while inside; what a handler returns is sent with "ok": true, the text
    of a StandError it raises as the error.

    The socket that a dead daemon left is replaced. SessionError when a living daemon answers for this folder already,
    something else has the name, or the file system has no sockets.
    """
    with opened_folder(path.parent) as folder:
        listening = _bound(folder, path)
        try:
            clients = _Clients(handlers)
            server = await asyncio.start_unix_server(clients.accept, sock=listening, limit=LINE_LIMIT_BYTES)
            try:
                yield
            finally:
                await _stop_accepting(listening)
                server.close()
                await clients.close()
        finally:
            listening.close()
            with suppress(OSError):
                os.unlink(path.name, dir_fd=folder)


async def _stop_accepting(listening: socket.socket) -> None:
    """A connection that asyncio is just taking from the kernel when its server closes would be lost, unclosed."""
    asyncio.get_running_loop().remove_reader(listening)
    for _ in range(_ACCEPTING_TURNS):
        await asyncio.sleep(0)


@contextmanager
def opened_folder(path: Path) -> Generator[int]:
    """The folder's descriptor while inside; SessionError when it cannot be opened."""
    try:
        folder = os.open(path, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    except OSError as error:
        raise SessionError(f"{path}: cannot be opened ({error.strerror})") from error
    try:
        yield folder
    finally:
        os.close(folder)


def address_in(folder: int, name: str) -> str:
    """The socket by its opened folder: the kernel takes no more than 107 bytes of a path."""
    return f"/proc/self/fd/{folder}/{name}"


def _bound(folder: int, path: Path) -> socket.socket:
    """A listening socket at `path`, mode 0600. The folder stays locked as long as it is open: whoever holds the lock
    knows that a socket found there belongs to nobody."""
    try:
        fcntl.flock(folder, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise SessionError(f"{path.parent}: another daemon is running this session") from None
    except OSError as error:
        raise SessionError(f"{path.parent}: cannot be locked ({error.strerror})") from error
    listening = socket.socket(socket.AF_UNIX)
    try:
        _remove_stale(folder, path)
        os.fchmod(listening.fileno(), 0o600)  # before bind, so that the name never has another mode
        listening.bind(address_in(folder, path.name))
        listening.listen(_MOST_CLIENTS)
    except OSError as error:
        listening.close()
        raise SessionError(f"{path}: the control socket cannot be made ({error.strerror})") from error
    except SessionError:
        listening.close()
        raise
    return listening


def _remove_stale(folder: int, path: Path) -> None:
    with suppress(FileNotFoundError):
        if not stat.S_ISSOCK(os.stat(path.name, dir_fd=folder, follow_symlinks=False).st_mode):
            raise SessionError(f"{path}: is in the way of the control socket; move it away")
        os.unlink(path.name, dir_fd=folder)


class _Clients:
    """Everybody who is connected."""

    def __init__(self, handlers: Handlers) -> None:
        self._handlers = handlers
        self._writers: dict[asyncio.Task[None], asyncio.StreamWriter] = {}

    def accept(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Serve one connection from its first request to its end."""
        task = asyncio.create_task(self._serve(reader, writer))
        self._writers[task] = writer
        task.add_done_callback(self._writers.pop)

    async def close(self) -> None:
        """End every connection; answers that were given still arrive."""
        writers = dict(self._writers)
        for task in writers:
            task.cancel()
        await asyncio.gather(*writers, return_exceptions=True)
        for writer in writers.values():  # a task that had not begun yet has not done it
            await _hang_up(writer)

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            with suppress(OSError, TimeoutError):
                if len(self._writers) > _MOST_CLIENTS:
                    writer.write(_encoded(_refusal(f"{_MOST_CLIENTS} clients are connected already; try again later")))
                else:
                    await self._converse(reader, writer)
        finally:
            await _hang_up(writer)

    async def _converse(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        while True:
            try:
                async with asyncio.timeout(_IDLE_LIMIT_S):
                    line = await reader.readline()
            except ValueError:  # longer than the reader's limit: where the next request begins is not known
                writer.write(_encoded(_refusal(f"a request has at most {LINE_LIMIT_BYTES} bytes")))
                return
            if not line:
                return
            writer.write(_encoded(await self._answer(line)))
            async with asyncio.timeout(_IDLE_LIMIT_S):
                await writer.drain()

    async def _answer(self, line: bytes) -> Answer:
        if not line.endswith(b"\n"):
            return _refusal("the request broke off before the end of its line; nothing was done")
        request = object_of(line)
        if request is None:
            return _refusal('expected a JSON object such as {"do": "status"}')
        do = request.get("do")
        handler = self._handlers.get(do) if isinstance(do, str) else None
        if handler is None:
            return _refusal(f'"do" is one of {", ".join(self._handlers)}')
        try:
            answer = handler(request)
            return {"ok": True, **(await answer if inspect.isawaitable(answer) else answer)}
        except StandError as error:
            return _refusal(str(error))


async def _hang_up(writer: asyncio.StreamWriter) -> None:
    writer.close()
    try:
        async with asyncio.timeout(_FAREWELL_LIMIT_S):
            await writer.wait_closed()
    except OSError:  # gone, or (TimeoutError) it does not read
        writer.transport.abort()


def _refusal(sentence: str) -> Answer:
    return {"ok": False, "error": sentence}


def _encoded(answer: Answer) -> bytes:
    return json.dumps(answer).encode() + b"\n"


def object_of(line: bytes) -> dict[str, object] | None:
    """The JSON object of a line, or None when it is none."""
    try:
        value: object = json.loads(line)
    except (ValueError, RecursionError):
        return None
    return cast("dict[str, object]", value) if isinstance(value, dict) else None
