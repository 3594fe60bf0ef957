"""Rehearsals: recipes that somebody has designed, run in virtual time beside the stand."""

from __future__ import annotations

import asyncio
import os
import signal
import sys
from pathlib import Path

from thermostand.foundation.clock import Clock
from thermostand.foundation.errors import SessionError
from thermostand.foundation.events import NOT_REHEARSED, REHEARSED
from thermostand.foundation.hub import Hub
from thermostand.foundation.tasks import cancel_all

_END_WITHIN_S = 5.0  # a virtual run closes its segment in a fraction of it


class Rehearsals:
    """Recipes run in virtual time by a program of its own at a low priority, one after another. config: the
    stand's file, or the name of an installed one; sessions: where they go."""

    def __init__(self, hub: Hub, clock: Clock, config: str, sessions: Path) -> None:
        self._hub, self._clock = hub, clock
        self._config, self._sessions = config, sessions
        self._turn = asyncio.Lock()
        self._works: set[asyncio.Task[None]] = set()

    def add(self, recipe: str, recipe_text: str) -> None:
        """Rehearse it when its turn has come; event `rehearsed` or `not_rehearsed`."""
        work = asyncio.create_task(self._rehearse(recipe, recipe_text))
        self._works.add(work)
        work.add_done_callback(self._works.discard)

    async def close(self) -> None:
        """End what is under way; its session stays, as one that was stopped."""
        await cancel_all(list(self._works))

    async def _rehearse(self, recipe: str, recipe_text: str) -> None:
        async with self._turn:
            try:
                event = REHEARSED.at(self._clock.now_ns(), recipe=recipe, session=await self._run(recipe_text))
            except (OSError, SessionError) as error:
                event = NOT_REHEARSED.at(self._clock.now_ns(), str(error), recipe=recipe)
            self._hub.publish(event)

    async def _run(self, recipe_text: str) -> str:
        """The name of the session; SessionError with what the program says when it ends otherwise."""
        # In memory: this is the control loop, which waits for no disk.
        recipe = os.memfd_create("recipe.yaml")
        try:
            os.write(recipe, recipe_text.encode())
            process = await asyncio.create_subprocess_exec(
                "nice",  # a run that is under way, and its guard, get three times its share of a busy processor
                "-n5",
                *(sys.executable, "-m", "thermostand.stand.cli", "run", f"/dev/fd/{recipe}"),
                *("--config", self._config, "--virtual-time", "--out", str(self._sessions)),
                pass_fds=(recipe,),
                stdin=asyncio.subprocess.DEVNULL,
                stdout=asyncio.subprocess.PIPE,
                stderr=asyncio.subprocess.PIPE,
                start_new_session=True,
            )
        finally:
            os.close(recipe)
        try:
            out, err = await process.communicate()
        finally:
            await _end(process)
        if process.returncode:
            last = err.decode(errors="replace").strip().splitlines()
            raise SessionError(last[-1] if last else f"status {process.returncode}")
        return Path(out.decode().strip().splitlines()[-1]).name


async def _end(process: asyncio.subprocess.Process) -> None:
    """End a program that has not ended, at last with all that it has started."""
    if process.returncode is not None:
        return
    process.terminate()
    try:
        await asyncio.wait_for(process.wait(), _END_WITHIN_S)
    except TimeoutError:
        os.killpg(process.pid, signal.SIGKILL)
        await process.wait()
