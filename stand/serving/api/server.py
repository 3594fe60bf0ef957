"""The threads that serve a stand's clients: `serve` is on the control loop, STOP has a thread of its own, and all else
the loop of another."""

from __future__ import annotations

import asyncio
import gc
import importlib
import os
import socket
import threading
from collections.abc import AsyncGenerator, Callable
from contextlib import asynccontextmanager, suppress
from functools import cache
from pathlib import Path
from typing import Any

from thermostand.foundation.clock import Clock
from thermostand.foundation.errors import ConfigError, SessionError, StandError
from thermostand.foundation.events import INTERFACE_FAILED, NO_CONTROL, EventKind
from thermostand.foundation.hub import Hub
from thermostand.foundation.shutdown_deadline import ShutdownDeadline
from thermostand.foundation.tasks import describe_failure
from thermostand.stand.serving.api.access import Access
from thermostand.stand.serving.api.bridge import Bridge
from thermostand.stand.serving.api.listeners import Interface, ProtocolListener
from thermostand.stand.serving.api.stop_thread import ListenerKind, StopThread
from thermostand.stand.serving.commands import Served
from thermostand.stand.serving.instances import DaemonEntry, DaemonInstance

_UNIX: tuple[ListenerKind, ...] = ("socket", "stop")
_TCP: ListenerKind = "tcp"
_LOOK_S = 1.0  # how late a dead thread is noticed; not measured
_CLOSE_LIMIT_S = 5.0  # round number; nothing was measured
_READY_LIMIT_S = 30.0  # imports take half a second or more


@asynccontextmanager
async def serve(
    service: Served, session: Path, stand: str, interface: Interface, deadline: ShutdownDeadline | None = None
) -> AsyncGenerator[DaemonInstance]:
    """Answer for the daemon that runs `session` on the stand of this name while inside; at the end for as long as
    `deadline` lasts.

    SessionError when the runtime folder cannot be used, ConfigError when it cannot listen at the port. A socket or
    entry that somebody removes is made again within some seconds.
    """
    hub, clock = service.hub, service.clock
    interface.check()
    presence = DaemonInstance(DaemonEntry(os.path.abspath(session), os.getpid(), stand, url=interface.url))  # noqa: ASYNC240 - no disk is asked
    report, deadline = _make_reporter(hub, clock), deadline or ShutdownDeadline()
    everything, stopping = presence.publish()
    doors = {"socket": everything, "stop": stopping}
    try:
        doors.update(_open_tcp_sockets(interface))
        bridge = Bridge(service)
        access = Access(interface.tokens, interface.hosts, interface.trusts_loopback, interface.single_sign_on)
        stop = StopThread(bridge.request_stop, access, lambda error: report(INTERFACE_FAILED, _describe_failure(error)))
    except BaseException:
        for door in doors.values():
            door.close()
        presence.withdraw()
        raise
    thread = _ServerThread(bridge, doors, presence, interface, access, stop, report=report)
    try:
        for door in (*_UNIX, _TCP):
            if door in doors:
                stop.listen(door, doors[door])
        stop.start()
        thread.start()
        presence.identify()
        with clock.hold():  # virtual time would be over before the first client is answered
            await asyncio.to_thread(thread.is_ready.wait, _READY_LIMIT_S)
        freeze_loaded_objects()
        yield presence
    finally:
        bridge.close()
        with clock.hold():  # a client that does not read must not be where virtual time goes on
            for ending in (thread, stop):
                await asyncio.to_thread(ending.end, deadline.limit_s(_CLOSE_LIMIT_S))
        for door in doors.values():
            door.close()
        presence.withdraw()


@cache
def freeze_loaded_objects() -> None:
    """Leave the 105,000 objects of the modules that are loaded by now out of every later search for garbage, once in a
    process: a search of them all keeps the guard, and a stop, waiting for 57 ms."""
    # Collection stays on: tracebacks of failed exchanges are cycles.
    gc.freeze()


def preload() -> None:
    """Begin to import what serving needs, which takes half a second or more, before there is anybody to serve."""

    def load() -> None:
        for name in ("app", "http_clients"):
            importlib.import_module(f"thermostand.stand.serving.api.{name}")

    threading.Thread(target=load, name="interface-imports", daemon=True).start()


def check_ports(interface: Interface) -> None:
    """ConfigError when nobody can listen at one of its ports: a port in use is reported before a device is opened."""
    for door in _open_tcp_sockets(interface).values():
        door.close()


def _open_tcp_sockets(interface: Interface) -> dict[str, socket.socket]:
    """Listening at each of its ports, or at none of them."""
    doors: dict[str, socket.socket] = {}
    try:
        if interface.port is not None:
            doors["tcp"] = _open_tcp_socket("--port", interface.host, interface.port)
        for each in interface.doors:
            doors[each.option] = _open_tcp_socket(each.option, each.host, each.port)
    except ConfigError:
        for door in doors.values():
            door.close()
        raise
    return doors


def _open_tcp_socket(option: str, host: str, port: int) -> socket.socket:
    from thermostand.stand.serving.api.http_clients import open_listening_socket

    try:
        return open_listening_socket(host, port)
    except OSError as error:
        raise ConfigError(f"{option} {port}: cannot listen at {host} ({error.strerror or error})") from error


def _make_reporter(hub: Hub, clock: Clock) -> Callable[[EventKind, str], None]:
    """A function for any thread: a warning of this kind, once for each text."""
    loop, reported = asyncio.get_running_loop(), set[str]()

    def report(kind: EventKind, text: str) -> None:
        if text not in reported and len(reported) < 100:
            reported.add(text)
            with suppress(RuntimeError):  # the loop has ended
                loop.call_soon_threadsafe(lambda: hub.publish(kind.at(clock.now_ns(), text)))

    return report


class _ServerThread:
    def __init__(
        self,
        bridge: Bridge,
        doors: dict[str, socket.socket],
        presence: DaemonInstance,
        interface: Interface,
        access: Access,
        stop: StopThread,
        *,
        report: Callable[[EventKind, str], None],
    ) -> None:
        self._bridge = bridge
        self._doors = doors
        self._presence = presence
        self._interface = interface
        self._access = access
        self._stop = stop
        self._report = report
        self._loop: asyncio.AbstractEventLoop | None = None
        self._ended: asyncio.Event | None = None
        self.is_ready = threading.Event()
        self._is_over = threading.Event()
        self._thread = threading.Thread(target=self._run, name="interface", daemon=True)

    def start(self) -> None:
        self._thread.start()

    def end(self, within_s: float) -> None:
        """Wait for it so long; it ends by itself when the process does, whatever keeps it."""
        self._is_over.set()
        loop, ended = self._loop, self._ended
        if loop is not None and ended is not None:
            with suppress(RuntimeError):
                loop.call_soon_threadsafe(ended.set)
        self._thread.join(within_s)

    def _run(self) -> None:
        try:
            asyncio.run(self._main())
        except Exception as error:  # noqa: BLE001 - the run goes on without it
            self._report(NO_CONTROL, f"the run cannot be queried or paused: {describe_failure(error)}")
        finally:
            self.is_ready.set()
            for door, listening in self._doors.items():
                if door not in (*_UNIX, _TCP):
                    listening.close()

    async def _main(self) -> None:
        # Imported here: nothing else of the program needs them, and they take half a second.
        from thermostand.stand.serving.api.app import make_app
        from thermostand.stand.serving.api.http_clients import Clients
        from thermostand.stand.serving.api.stream import Stream

        stream = Stream(self._bridge)
        app = make_app(self._bridge, stream, self._access, self._interface, self._report_failure)
        clients = Clients(app)
        self._stop.hand_over = clients.take
        self._loop, self._ended = asyncio.get_running_loop(), asyncio.Event()
        if self._is_over.is_set():
            self._ended.set()
        working = [asyncio.create_task(stream.run()), asyncio.create_task(self._look_after(clients))]
        working += [asyncio.create_task(self._serve(each)) for each in self._interface.doors]
        self.is_ready.set()
        try:
            await self._ended.wait()
        finally:
            for task in working:
                task.cancel()
            await asyncio.gather(*working, return_exceptions=True)
            await clients.close()

    async def _serve(self, door: ProtocolListener) -> None:
        try:
            await door.serve(self._doors[door.option], self._bridge, self._report_failure)
        except Exception as error:  # noqa: BLE001 - the other doors stay open
            self._report(NO_CONTROL, f"what {door.option} asked for is not served: {describe_failure(error)}")

    async def _look_after(self, clients: Any) -> None:
        """A logout removes $XDG_RUNTIME_DIR with the sockets that are in it."""
        is_alone = False
        while True:
            await asyncio.sleep(_LOOK_S)
            clients.look_after()
            if self._stop.has_failed and not is_alone:
                is_alone = True
                for door in {"socket", "tcp"} & {*self._doors}:
                    await clients.accept_at(door, self._doors[door])
            if not self._presence.is_published():
                with suppress(SessionError, StandError):  # tried again the next time
                    self._doors["socket"], self._doors["stop"] = self._presence.publish()
                    for door in _UNIX:
                        self._stop.listen(door, self._doors[door])

    def _report_failure(self, error: Exception) -> None:
        self._report(INTERFACE_FAILED, _describe_failure(error))


def _describe_failure(error: Exception) -> str:
    return f"the interface has failed: {describe_failure(error)}"
