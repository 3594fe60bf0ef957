"""How soon a STOP is answered, over TCP and from the command line: alone, beside ten viewers, and beside each flood.

The daemon is a process of its own with a desk that publishes as a stand does, so that what is measured is the way of a
STOP and not what makes a stand safe (`abort`, `viewers`). Each STOP comes when the one before it is over.
"""

from __future__ import annotations

import http.client
import os
import random
import subprocess
import sys
import time
from collections.abc import Generator
from contextlib import contextmanager, suppress
from pathlib import Path

from tests.bench.figures import Figure, report_progress, set_upper_goal
from tests.bench.viewers import VIEWERS, run_viewers
from tests.bench.waiting import compare_with_waiting, compute_p99, run_waiting_process
from tests.stand import floods
from tests.stand.test_interface_access import free_port
from thermostand.foundation.errors import SessionError
from thermostand.stand.serving.client import Server, find_session_server

STOPS, FLOODED_STOPS = 200, 10
LIMIT_ms, FLOODED_LIMIT_ms = 20.0, 1000.0
GIVEN_UP_S = 10.0
BETWEEN_S = 0.12  # two STOPs within 0.1 s would be one

DAEMON = """
import asyncio, sys
from pathlib import Path
from thermostand.stand.serving.api.listeners import Interface
from thermostand.stand.serving.secop import make_secop_listener
from tests.stand.fake_service import FakeService, serve_fake

async def run():
    folder, port, secop_port = Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3])
    interface = Interface(folder.parent, port=port, doors=(make_secop_listener(secop_port),))
    async with serve_fake(FakeService(), folder, interface) as desk:
        print("ready", flush=True)
        number = 0
        while True:
            number += 1
            desk.hub.publish(desk.batch(21.5 + number % 10))
            if number % 10 == 0:
                desk.tell("a second has gone", number=number)
            await asyncio.sleep(0.1)

asyncio.run(run())
"""


def figures(directory: Path) -> list[Figure]:
    """99th percentiles alone and beside viewers, the longest of some beside each flood, ms."""
    session = directory / "cycle"
    session.mkdir()
    found: list[Figure] = []
    with _run_daemon(session) as ports:
        local, remote = find_session_server(session), Server("the daemon", url=f"http://127.0.0.1:{ports[0]}")
        local.state(30.0)  # everything is imported
        ways = {"over TCP": remote, "by `stand stop`": local}
        found += _measure_ways(ways, "alone")
        with run_viewers(session):
            time.sleep(2.0)
            found += _measure_ways(ways, f"{VIEWERS} viewers")
        for name in floods.FLOODS:
            report_progress(f"STOP beside {name}")
            with _run_flood(name, ports):
                for way, server in ways.items():
                    times_ms = [_stop_ms(server) for _ in range(FLOODED_STOPS)]
                    seen = f"longest of {FLOODED_STOPS}; shortest {min(times_ms):.1f} ms"
                    what = f"STOP {way} to its answer, {name}"
                    found.append(set_upper_goal(FLOODED_LIMIT_ms, Figure(what, "ms", max(times_ms), seen)))
    return found


def _measure_ways(ways: dict[str, Server], load: str) -> list[Figure]:
    found: list[Figure] = []
    for way, server in ways.items():
        report_progress(f"STOP {way}, {STOPS} times, {load}")
        with run_waiting_process() as waited_ms:
            times_ms = [_stop_ms(server) for _ in range(STOPS)]
        seen = f"p99 of {STOPS}; median {sorted(times_ms)[STOPS // 2]:.1f}, longest {max(times_ms):.1f} ms"
        figure = Figure(f"STOP {way} to its answer, {load}", "ms", compute_p99(times_ms), seen)
        found.append(set_upper_goal(LIMIT_ms, compare_with_waiting(figure, waited_ms)))
    return found


def _stop_ms(server: Server) -> float:
    """From the press to the answer, tries that failed included, as the page and an operator try again."""
    time.sleep(BETWEEN_S + random.uniform(0.0, 0.05))
    begun_s = time.perf_counter()
    while time.perf_counter() < begun_s + GIVEN_UP_S:
        with suppress(SessionError, OSError, http.client.HTTPException):
            server.order("stop")
            break
    return 1e3 * (time.perf_counter() - begun_s)


@contextmanager
def _run_daemon(session: Path) -> Generator[tuple[int, int]]:
    ports = free_port(), free_port()
    command = [sys.executable, "-c", DAEMON, str(session), *map(str, ports)]
    with subprocess.Popen(command, stdout=subprocess.PIPE) as process:
        try:
            if process.stdout is None or process.stdout.readline() != b"ready\n":
                raise ValueError("the daemon of the bench has not begun")
            yield ports
        finally:
            process.kill()


@contextmanager
def _run_flood(name: str, ports: tuple[int, int]) -> Generator[None]:
    command, variables = [sys.executable, "-S", floods.__file__, name], {"PORTS": f"{ports[0]} {ports[1]}"}
    with subprocess.Popen(command, stdout=subprocess.PIPE, env={**os.environ, **variables}) as process:
        try:
            if process.stdout is None or process.stdout.readline() != b"begun\n":
                raise ValueError(f"the flood {name} has not begun")
            yield
        finally:
            process.kill()
