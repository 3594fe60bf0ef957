"""What ten viewers of the stream cost: the stop command to the heater confirmed off, the jitter of frames, the control
loop's lateness, and processor time; each beside the same without them.

The viewers are a process of their own that follows the stream of the Unix socket, as ten open pages do.
"""

from __future__ import annotations

import asyncio
import math
import subprocess
import sys
import time
from collections.abc import Generator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

from tests.bench import abort, jitter
from tests.bench.figures import Figure, report_progress, require_aravis
from tests.bench.waiting import run_waiting_process
from tests.system.simulated_orders import simulated_order
from thermostand.stand.assembly.assemble import Assembly
from thermostand.stand.assembly.stand import Stand
from thermostand.stand.config.stand_config import StandConfig
from thermostand.stand.running.opening.stop import Interrupted, Stop
from thermostand.stand.service.stand_service import StandService
from thermostand.stand.serving.api.listeners import Interface
from thermostand.stand.serving.api.server import serve
from thermostand.stand.serving.api_models import Requester
from thermostand.stand.serving.client import Server, find_session_server
from thermostand.stand.serving.instances import list_daemons

VIEWERS = 10
TRIPS = 60

FOLLOW = """
import asyncio, sys
from contextlib import suppress
from websockets.asyncio.client import unix_connect
from websockets.exceptions import ConnectionClosed

async def follow():
    async with unix_connect(sys.argv[1], "ws://localhost/api/v1/stream?from=0") as viewer:
        with suppress(ConnectionClosed):
            async for message in viewer:
                pass

async def main():
    await asyncio.gather(*(follow() for _ in range(int(sys.argv[2]))))

asyncio.run(main())
"""


def figures(directory: Path) -> list[Figure]:
    """99th percentiles, ms."""
    config = simulated_order(directory, abort.RECIPE, abort.POLL_s).config
    session = directory / "stops"
    session.mkdir()
    report_progress(f"stop command, {TRIPS} times without and {TRIPS} times with {VIEWERS} viewers")
    with asyncio.Runner() as runner:
        (alone_ms, alone_waited_ms), (viewed_ms, viewed_waited_ms) = runner.run(_measure_stops(config, session))
    return [
        abort.make_figure("`stop` over HTTP", alone_ms, alone_waited_ms),
        abort.make_figure(f"`stop` over HTTP, {VIEWERS} viewers", viewed_ms, viewed_waited_ms),
        *_frames(directory),
    ]


class _Service(StandService):
    """Of a stand on which nothing is run but the stop."""

    stop_run: Stop

    def stop(self, who: Requester) -> str:
        self.stop_run()
        return ""


_Times = tuple[list[float], list[float]]  # of stops, and of a process that only waited meanwhile


async def _measure_stops(config: StandConfig, session: Path) -> tuple[_Times, _Times]:
    async with abort.open_polled_stand(config) as (assembly, control):
        service = _Service(cast("Any", SimpleNamespace(assembly=assembly, active_run=None, latched=None)))

        async def by_command(stand: Stand, _: Assembly) -> float:
            begun_s = math.nan
            with suppress(Interrupted):
                async with Stop() as stop:
                    stop.watch(stand)
                    service.stop_run = stop
                    begun_s = time.perf_counter()
                    await asyncio.to_thread(server.order, "stop")
                    await asyncio.Event().wait()
            return begun_s

        async with serve(service, session, config.name, Interface(session.parent)):
            server: Server = find_session_server(session)
            await asyncio.to_thread(server.state, 30.0)  # everything is imported
            with run_waiting_process() as alone_waited_ms:
                alone_ms = [await abort.measure_trip_ms(assembly, control, by_command, 0.03) for _ in range(TRIPS)]
            with run_viewers(session), run_waiting_process() as viewed_waited_ms:
                await asyncio.sleep(2.0)
                viewed_ms = [await abort.measure_trip_ms(assembly, control, by_command, 0.03) for _ in range(TRIPS)]
    return (alone_ms, alone_waited_ms), (viewed_ms, viewed_waited_ms)


@contextmanager
def run_viewers(session: Path) -> Generator[None]:
    """Viewers of the daemon that runs `session`, while inside."""
    (daemon,) = [each for each in list_daemons() if each.entry.session == str(session)]
    process = subprocess.Popen([sys.executable, "-c", FOLLOW, str(daemon.socket), str(VIEWERS)])
    try:
        yield
    finally:
        process.kill()
        process.wait()


def _frames(directory: Path) -> list[Figure]:
    what = f"frame schedule at {1 / jitter.INTERVAL_s:g} fps, {VIEWERS} viewers, deviation"
    require_aravis()
    report_progress(f"{jitter.FRAMES} frames in real time with {VIEWERS} viewers")
    order = simulated_order(directory, jitter.RECIPE, poll_s=1.0)
    out, viewers = directory / "viewed", list[subprocess.Popen[bytes]]()

    async def begun(session: Path) -> None:
        """Viewers that come as soon as the run can be asked."""
        script = "import time, sys\nfrom pathlib import Path\n"
        script += "from thermostand.stand.serving.instances import list_daemons\n"
        script += "while not (found := [d for d in list_daemons() if d.entry.session == sys.argv[1]]):\n"
        script += "    time.sleep(0.2)\n"
        script += "sys.argv[1] = str(found[0].socket)\n" + FOLLOW
        viewers.append(subprocess.Popen([sys.executable, "-c", script, str(session), str(VIEWERS)]))

    began_s, used_s = time.monotonic(), time.process_time()
    try:
        with jitter.run_laboratory(order):
            late_ms, bare_ms = jitter.measure_deviations_ms(order, out, begun)
        share = (time.process_time() - used_s) / (time.monotonic() - began_s)
    finally:
        for viewer in viewers:
            viewer.kill()
            viewer.wait()
    return [jitter.make_schedule_figure(what, late_ms, bare_ms, f"; the daemon took {100 * share:.0f} % of a core")]
