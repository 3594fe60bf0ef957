"""A daemon of a stand in this process, with something to do while it serves; it leaves when that is done."""

import asyncio
from collections.abc import AsyncGenerator, Awaitable, Callable
from contextlib import AbstractAsyncContextManager, asynccontextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import cast

from tests.system.test_daemon import LIMIT_S
from thermostand.foundation.clock import WallClock
from thermostand.foundation.hub import Hub
from thermostand.stand.config.stand_config import find_packaged, load_config
from thermostand.stand.service.daemon import Daemon, serve
from thermostand.stand.service.stand_service import StandService


@dataclass
class DaemonHere:
    desk: StandService
    hub: Hub
    clock: WallClock

    @property
    def daemon(self) -> Daemon:
        return cast("Daemon", self.desk.host)


async def until(wanted: Callable[[], bool]) -> None:
    async with asyncio.timeout(LIMIT_S):
        while not wanted():
            await asyncio.sleep(0.02)


async def served_here(
    config_file: Path,
    out: Path,
    work: Callable[[DaemonHere], Awaitable[None]],
    doors: Callable[[StandService], AbstractAsyncContextManager[object]] = lambda _: nullcontext(),
) -> None:
    """Serve that stand until `work` is done, with these doors open; what `work` raises is raised."""
    config = load_config(config_file)
    texts = {"config.yaml": config_file.read_text(), "target.yaml": find_packaged("targets", config.target).read_text()}

    @asynccontextmanager
    async def front(desk: StandService, hub: Hub, clock: WallClock) -> AsyncGenerator[None]:
        here = DaemonHere(desk, hub, clock)
        async with doors(desk):
            working = asyncio.ensure_future(work(here))
            working.add_done_callback(lambda _: here.daemon.leave())
            yield
            await working

    await asyncio.wait_for(serve(config, "a stand", texts, out, front), 3 * LIMIT_S)
