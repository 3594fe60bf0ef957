"""Ends of a wire for byte-protocol fakes: a pseudo-terminal behind a path, or a TCP port; no protocol here.

An engine is made per connection and has one method, `feed(data) -> bytes`: bytes in, reply bytes out, state kept in
between. Wire time is real time; what a reply says comes from the plant at the simulated time.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import select
import shutil
import socket
import tempfile
import threading
import tty
from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO, Protocol

from thermostand.drivers.sim.faults import LinkFaults


class Engine(Protocol):
    """One protocol conversation."""

    def feed(self, data: bytes) -> bytes:
        """Take bytes as they came; return what to send back now, b"" for nothing."""
        ...


class Lines:
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
        self.address = f"serial:{self._path}"
        self._path.parent.mkdir(parents=True, exist_ok=True)
        self._lock = _held(self._path)
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
            try:
                request = os.read(self._master, 4096)
            except OSError:
                return
            for piece in self._faults.apply(request, self._engine.feed(request)):
                os.write(self._master, piece)

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


def _held(path: Path) -> BinaryIO:
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
        self._connections: set[socket.socket] = set()
        self._lock = threading.Lock()
        self._server = self._listening(port)
        self.port: int = self._server.getsockname()[1]
        self.address = f"tcp:{host}:{self.port}"

    def plug(self) -> None:
        """Listen again, at the same port."""
        self.close()
        self._server = self._listening(self.port)

    def _listening(self, port: int) -> socket.socket:
        server = socket.create_server((self._host, port))
        threading.Thread(target=self._accept, args=(server,), name=f"tcp {port}", daemon=True).start()
        return server

    def _accept(self, server: socket.socket) -> None:
        while True:
            try:
                connection, _ = server.accept()
            except OSError:
                return
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            with self._lock:
                self._connections.add(connection)
            threading.Thread(target=self._serve, args=(connection,), name="tcp connection", daemon=True).start()

    def _serve(self, connection: socket.socket) -> None:
        engine = self._make_engine()
        with contextlib.suppress(OSError), connection:
            is_first = True
            while request := connection.recv(65536):
                if self._faults.swallows_first and is_first:
                    is_first = False
                    continue
                pieces = self._faults.apply(request, engine.feed(request))
                for piece in pieces:
                    connection.sendall(piece)
                if self._faults.hangs_up and pieces:
                    break
        with self._lock:
            self._connections.discard(connection)

    def unplug(self) -> None:
        """As `close`, until it is plugged in again."""
        self.close()

    def close(self) -> None:
        """Stop listening and drop every connection; may be called twice."""
        with contextlib.suppress(OSError):
            self._server.shutdown(socket.SHUT_RDWR)
        self._server.close()
        with self._lock:
            connections = list(self._connections)
        for connection in connections:
            with contextlib.suppress(OSError):
                connection.shutdown(socket.SHUT_RDWR)
