"""A Modbus TCP gateway between a daemon and its simulated bus, whose link and whose replies a test can take away."""

import contextlib
import socket
import threading
from collections.abc import Callable
from dataclasses import replace

from tests.addresses import find_free_port
from thermostand.stand.running.order import Order


class Gateway:
    """Listens at `port` and passes each request on. The reply to a request (ADU) that `loses` names does not come back;
    between `unplug` and `plug` nobody listens, and no connection lives."""

    def __init__(self, behind: int) -> None:
        self.port = find_free_port()
        self.loses: Callable[[bytes], bool] = lambda request: False
        self._behind = behind
        self._sockets: set[socket.socket] = set()
        self._lock = threading.Lock()
        self._server: socket.socket | None = None
        self.plug()

    def plug(self) -> None:
        server = self._server = socket.create_server(("127.0.0.1", self.port))
        threading.Thread(target=self._accept, args=(server,), daemon=True).start()

    def unplug(self) -> None:
        server, self._server = self._server, None
        if server is None:
            return
        with contextlib.suppress(OSError):
            server.shutdown(socket.SHUT_RDWR)
        server.close()
        with self._lock:
            for each in self._sockets:
                with contextlib.suppress(OSError):
                    each.shutdown(socket.SHUT_RDWR)

    def _accept(self, server: socket.socket) -> None:
        with contextlib.suppress(OSError):
            while True:
                threading.Thread(target=self._serve, args=server.accept()[:1], daemon=True).start()

    def _serve(self, daemon: socket.socket) -> None:
        with contextlib.suppress(OSError), daemon, socket.create_connection(("127.0.0.1", self._behind)) as bus:
            with self._lock:
                self._sockets |= {daemon, bus}
            try:
                while request := daemon.recv(1024):  # one at a time, and smaller than a segment
                    bus.sendall(request)
                    reply = bus.recv(1024)
                    if not self.loses(request):
                        daemon.sendall(reply)
            finally:
                with self._lock:
                    self._sockets -= {daemon, bus}


@contextlib.contextmanager
def gateway(order: Order):
    """The gateway, and the order of a daemon that reaches its bus through it."""
    bus = order.config.bus
    between = Gateway(int(bus.address.rpartition(":")[2]))
    try:
        tunnel = bus.model_copy(update={"address": f"tcp:127.0.0.1:{between.port}"})
        yield between, replace(order, config=order.config.model_copy(update={"bus": tunnel}))
    finally:
        between.unplug()
