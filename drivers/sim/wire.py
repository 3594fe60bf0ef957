"""Ends of a wire for byte-protocol fakes: a pseudo-terminal behind a path, or a TCP port; no protocol here.

An engine is made per connection and has one method, `feed(data) -> bytes`: bytes in, reply bytes out, state kept in
between. Wire time is real time; what a reply says comes from the plant at the simulated time.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import random
import select
import shutil
import socket
import tempfile
import threading
import time
import tty
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO, Protocol

# How to break a link: byte-level faults between a fake's protocol engine and its descriptor.


@dataclass
class LinkFaults:
    """What happens to replies on one wire. Probabilities are 0..1 per reply; seeded, so that a run repeats.

    silent: no reply leaves. drop, flip, cut, junk: probabilities of losing the reply, flipping one bit, sending only
    its first half, sending 7 random bytes before it; late: of sending it late_by_s late. delay_s: real seconds of
    lateness of every reply (a wire time, not a simulated one); late_s: of the next one alone. garbled: how many of the
    coming replies lose their second half. echo: the request comes back before the reply (a badly wired RS-485
    adapter). byte_by_byte: one write a byte. flow_control: XOFF and XON among the reply. Over TCP: hangs_up: each
    connection is closed after one reply; swallows_first: the first request over each is lost. `injected` counts what
    was done, by name.
    """

    seed: int = 0
    silent: bool = False
    drop: float = 0.0
    flip: float = 0.0
    cut: float = 0.0
    junk: float = 0.0
    delay_s: float = 0.0
    late_s: float = 0.0
    late: float = 0.0
    late_by_s: float = 0.5
    garbled: int = 0
    echo: bool = False
    byte_by_byte: bool = False
    flow_control: bool = False
    hangs_up: bool = False
    swallows_first: bool = False
    injected: dict[str, int] = field(default_factory=dict[str, int])

    def __post_init__(self) -> None:
        self._random = random.Random(self.seed)
        self.is_late = False  # a reply is kept back on purpose

    def _wait(self, late_s: float) -> None:
        """A slow line is slow in real seconds."""
        self.is_late = True
        time.sleep(late_s)  # noqa: TID251 - as above
        self.is_late = False

    def apply(self, request: bytes, reply: bytes) -> list[bytes]:
        """The pieces to write instead of `reply`; may wait delay_s first. Nothing when there was no reply."""
        if not reply:
            return []
        if self._is_sound:
            return [reply]
        if self.delay_s > 0:
            self._count("delay")
            self._wait(self.delay_s)
        if self.late_s > 0:
            late_s, self.late_s = self.late_s, 0.0
            self._count("late")
            self._wait(late_s)
        if self._chance(self.late, "late"):
            self._wait(self.late_by_s)
        if self.garbled > 0:
            self.garbled -= 1
            self._count("garbled")
            return [reply[: max(1, len(reply) // 2)]]
        if self.silent or self._chance(self.drop, "drop"):
            return []
        if self._chance(self.flip, "flip"):
            position = self._random.randrange(len(reply))
            reply = (
                reply[:position] + bytes([reply[position] ^ (1 << self._random.randrange(8))]) + reply[position + 1 :]
            )
        if self._chance(self.cut, "cut"):
            reply = reply[: max(1, len(reply) // 2)]
        if self._chance(self.junk, "junk"):
            reply = self._random.randbytes(7) + reply
        if self.echo:
            self._count("echo")
            reply = request + reply
        if self.flow_control:
            self._count("flow_control")
            reply = b"\x13" + reply[:2] + b"\x11" + reply[2:] + b"\x13\x11"
        return [bytes([byte]) for byte in reply] if self.byte_by_byte else [reply]

    @property
    def _is_sound(self) -> bool:
        probable = self.drop or self.flip or self.cut or self.junk or self.late
        other = self.silent or self.delay_s or self.late_s or self.garbled or self.echo or self.byte_by_byte
        other = other or self.flow_control
        return not (probable or other)

    def _chance(self, probability: float, name: str) -> bool:
        if probability <= 0 or self._random.random() >= probability:
            return False
        self._count(name)
        return True

    def _count(self, name: str) -> None:
        self.injected[name] = self.injected.get(name, 0) + 1


class Engine(Protocol):
    """One protocol conversation."""

    def feed(self, data: bytes) -> bytes:
        """Take bytes as they came; return what to send back now, b"" for nothing."""
        ...


_LOOK_S = 0.0002  # between two looks at a wire that is behind


def _is_behind(source: socket.socket | int, turn: threading.Lock, faults: LinkFaults) -> bool:
    """Return whether something that has arrived there is not answered yet. turn: held from before a request is taken to
    after its reply was sent. What is late on purpose is not behind."""
    if not turn.acquire(blocking=False):
        return not faults.is_late
    try:
        return _await_input(source, 0.0)
    except (OSError, ValueError):
        return False  # closed
    finally:
        turn.release()


def _await_input(source: socket.socket | int, timeout_s: float | None = None) -> bool:
    """Return whether something has arrived, or the other end has closed. OSError, ValueError when it is closed here."""
    arrived = select.poll()  # select() knows no descriptor above 1023
    arrived.register(source, select.POLLIN)
    return bool(arrived.poll(None if timeout_s is None else timeout_s * 1000.0))


class LineEngine:
    """An engine for requests of one line each: `answer(line) -> line`, both without their line feed."""

    def __init__(self, answer: Callable[[bytes], bytes]) -> None:
        self._answer = answer
        self._pending = b""

    def feed(self, data: bytes) -> bytes:
        """Answer every complete line."""
        *lines, self._pending = (self._pending + data).split(b"\n")
        return b"".join(self._answer(line) + b"\n" for line in lines)


class PtyWire:
    """A serial port: `path` becomes a symlink to a fresh pseudo-terminal in raw mode; replug by making a new one.

    Without a path it has one in a folder of its own. `address` is where. OSError when another simulator answers at
    `path`, or something stands there that is no simulator's.
    """

    def __init__(self, path: Path | None, engine: Engine, faults: LinkFaults) -> None:
        self._folder = None if path else Path(tempfile.mkdtemp(prefix="thermostand-port-"))
        self._path = path or Path(f"{self._folder}/port")
        self._engine = engine
        self._faults = faults
        self._is_plugged = False
        self._turn = threading.Lock()
        self.address = f"serial:{self._path}"
        self._path.parent.mkdir(parents=True, exist_ok=True)
        self._lock = _lock_path(self._path)
        self.plug()

    def plug(self) -> None:
        """Answer at a fresh pseudo-terminal behind the same path, unless plugged in."""
        if self._is_plugged:
            return
        self._master, self._slave = os.openpty()  # the slave stays open, or reads fail while no driver is connected
        tty.setraw(self._slave)
        terminal = os.ttyname(self._slave)
        self._path.unlink(missing_ok=True)
        self._path.symlink_to(terminal)
        self._stop_read, self._stop_write = os.pipe()
        self._thread = threading.Thread(target=self._serve, name=f"pty {terminal}", daemon=True)
        self._thread.start()
        self._is_plugged = True

    def _serve(self) -> None:
        while True:
            ready, _, _ = select.select([self._master, self._stop_read], [], [])
            if self._stop_read in ready:
                return
            with self._turn:
                try:
                    request = os.read(self._master, 4096)
                except OSError:
                    return
                for piece in self._faults.apply(request, self._engine.feed(request)):
                    os.write(self._master, piece)

    def settle(self) -> None:
        """Return when all that has arrived is answered, or late on purpose."""
        while self._is_plugged and _is_behind(self._master, self._turn, self._faults):
            time.sleep(_LOOK_S)  # noqa: TID251 - for another thread

    def close(self) -> None:
        """Unplug for good; may be called twice."""
        self.unplug()
        self._lock.close()
        if self._folder is not None:
            shutil.rmtree(self._folder, ignore_errors=True)

    def unplug(self) -> None:
        """The symlink goes and an open driver gets an I/O error."""
        if not self._is_plugged:
            return
        self._is_plugged = False
        with contextlib.suppress(OSError):
            os.write(self._stop_write, b"x")
        self._thread.join()
        self._path.unlink(missing_ok=True)
        for descriptor in (self._master, self._slave, self._stop_read, self._stop_write):
            with contextlib.suppress(OSError):
                os.close(descriptor)


def _lock_path(path: Path) -> BinaryIO:
    """The lock of a path, which ends with the process: a link that a killed simulator has left is taken over, that of a
    living one is not."""
    if path.exists() and not path.is_symlink():
        raise OSError(f"{path} exists, and is no line of a simulator")
    lock = path.with_name(f".{path.name}.lock").open("wb")
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        lock.close()
        raise OSError(f"another simulator answers at serial:{path}") from error
    return lock


class TcpWire:
    """A TCP server; every connection gets its own engine from `make_engine`. Port 0 is a free one; `address` says
    which."""

    def __init__(self, host: str, port: int, make_engine: Callable[[], Engine], faults: LinkFaults) -> None:
        self._make_engine = make_engine
        self._faults = faults
        self._host = host
        self._connections: dict[socket.socket, threading.Lock] = {}
        self._lock = threading.Lock()  # of the connections, and held while one is taken
        self._server = self._listening(port)
        self.port: int = self._server.getsockname()[1]
        self.address = f"tcp:{host}:{self.port}"

    def plug(self) -> None:
        """Listen again, at the same port."""
        self.close()
        self._server = self._listening(self.port)

    def _listening(self, port: int) -> socket.socket:
        server = socket.create_server((self._host, port))
        server.setblocking(False)
        threading.Thread(target=self._accept, args=(server,), name=f"tcp {port}", daemon=True).start()
        return server

    def _accept(self, server: socket.socket) -> None:
        while True:
            try:
                _await_input(server)
                with self._lock:
                    connection, _ = server.accept()
                    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                    turn = self._connections[connection] = threading.Lock()
            except BlockingIOError:
                continue  # who connected has gone
            except (OSError, ValueError):
                return
            threading.Thread(target=self._serve, args=(connection, turn), name="tcp connection", daemon=True).start()

    def _serve(self, connection: socket.socket, turn: threading.Lock) -> None:
        engine = self._make_engine()
        with contextlib.suppress(OSError), connection:
            is_first = self._faults.swallows_first
            while connection.recv(1, socket.MSG_PEEK):
                with turn:
                    request = connection.recv(65536)
                    pieces = [] if is_first else self._faults.apply(request, engine.feed(request))
                    is_first = False
                    is_last = self._faults.hangs_up and bool(pieces)
                    for piece in pieces:
                        # With the end of the connection: who has the reply can know at once that it was the last.
                        connection.sendall(piece, socket.MSG_MORE if is_last else 0)
                    if is_last:
                        connection.shutdown(socket.SHUT_WR)
                        break
        with self._lock:
            self._connections.pop(connection, None)

    def settle(self) -> None:
        """Return when all that has arrived is answered, or late on purpose."""
        while _is_behind(self._server, self._lock, self._faults) or any(
            _is_behind(connection, turn, self._faults) for connection, turn in self._list_connections()
        ):
            time.sleep(_LOOK_S)  # noqa: TID251 - for other threads

    def _list_connections(self) -> list[tuple[socket.socket, threading.Lock]]:
        with self._lock:
            return list(self._connections.items())

    def unplug(self) -> None:
        """Close the wire until it is plugged in again."""
        self.close()

    def close(self) -> None:
        """Stop listening and drop every connection; may be called twice."""
        with contextlib.suppress(OSError):
            self._server.shutdown(socket.SHUT_RDWR)
        self._server.close()
        for connection, _ in self._list_connections():
            with contextlib.suppress(OSError):
                connection.shutdown(socket.SHUT_RDWR)


# The faults that every byte link has: names, worst values, and how each is set on its wire.


_MIXED = ("drop", "flip", "cut", "junk", "late")

# Kind -> worst value, the one that mends it, meaning.
LINK_FAULTS: dict[str, tuple[float, float, str]] = {
    "silent": (True, False, "no reply leaves"),
    "drop": (0.05, 0.0, "share of replies lost"),
    "flip": (0.05, 0.0, "share of replies with one bit flipped"),
    "cut": (0.05, 0.0, "share of replies of which only the first half comes"),
    "junk": (0.05, 0.0, "share of replies with 7 random bytes before them"),
    "late": (0.05, 0.0, "share of replies that come 0.5 s late"),
    "mixed": (0.05, 0.0, "share of replies that are dropped, flipped, cut, late or have junk before them"),
    "delay_s": (0.2, 0.0, "every reply is slow by so many real seconds"),
    "late_s": (1.0, 0.0, "the next reply is late by so many real seconds"),
    "garbled": (3, 0, "so many of the coming replies lose their second half"),
    "echo": (True, False, "the request comes back before the reply"),
    "byte_by_byte": (True, False, "one write a byte"),
    "flow_control": (True, False, "XOFF and XON come among the replies"),
    "hangs_up": (True, False, "over TCP: each connection is closed after one reply"),
    "swallows_first": (True, False, "over TCP: the first request over each connection is lost"),
    "unplugged": (True, False, "connections are cut, and nobody listens; plugged in again by another port"),
}


@dataclass(frozen=True, slots=True)
class FaultyLink:
    """One wire and what breaks its replies."""

    wire: PtyWire | TcpWire
    faults: LinkFaults


def set_link_fault(link: FaultyLink, kind: str, value: Any) -> None:
    """One of LINK_FAULTS; must not be called under a lock that the wire's thread may want."""
    match kind:
        case "unplugged":
            if value:
                link.wire.unplug()
            else:
                link.wire.plug()
        case "mixed":
            for each in _MIXED:
                setattr(link.faults, each, float(str(value or 0)) / len(_MIXED))
        case _:
            _, mended, _ = LINK_FAULTS[kind]
            setattr(link.faults, kind, type(mended)(value or 0))
