"""Where a queue is: with the daemon that works on it, else in the files of its folder."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer

from thermostand.foundation.clock import WallClock
from thermostand.foundation.command_app import with_parameters
from thermostand.foundation.errors import ConfigError, InUse, SessionError
from thermostand.foundation.output import say
from thermostand.stand.commands.reached import OPTIONS
from thermostand.stand.commands.submitted import submit_recipe
from thermostand.stand.commissioning.answering import not_answering
from thermostand.stand.config.stand_config import StandConfig, load_config, packaged
from thermostand.stand.estimating.run_estimate import price_night, small_disk
from thermostand.stand.queueing import queue
from thermostand.stand.queueing.queue_file import Entry
from thermostand.stand.running.order import load_order
from thermostand.stand.serving.client import API, Server, server_at
from thermostand.stand.serving.desk import QueuedRun
from thermostand.stand.serving.presence import living

OutOption = Annotated[
    Path | None, typer.Option("--out", help="Where the queue is and its sessions go; else recording.directory.")
]


class DaemonDoor:
    """Through the daemon, which checks wires, identities, the disk and its limits when it is given a run. ConfigError
    and SessionError say what is wrong."""

    def __init__(self, server: Server) -> None:
        self.name = server.name
        self._server = server

    def add(self, recipe: str) -> int:
        """Its number; checked before as far as can be."""
        return submit_recipe(self._server, recipe).id

    def runs(self) -> tuple[str, list[Entry | QueuedRun]]:
        """Why it is halted, "" when it is not, and the runs."""
        state = self._server.state()
        return state.queue_halted, list(state.queue)

    def move(self, number: int, position: int) -> None:
        """1 is the next to be run."""
        self._server.request("POST", f"{API}/queue/{number}/move", {"to": position})

    def remove(self, number: int) -> None:
        """What it has recorded stays."""
        self._server.request("DELETE", f"{API}/queue/{number}")


class FileDoor:
    """The queue of a folder that no daemon has: limits, the disk and, of a real stand, wires and identities are checked
    here. A simulated one may be run in virtual time, on a laboratory of its own, and is not asked."""

    def __init__(self, directory: Path, config: str) -> None:
        self.name = str(directory)
        self._directory, self._config = directory, config

    def add(self, recipe: str) -> int:
        """As DaemonDoor."""
        order = load_order(recipe, self._config)
        night = price_night(tuple(order.recipe.plan()), order.config, self._directory)
        if lack := small_disk(self._directory, night.steps, order.config):
            raise SessionError(f"{self._directory}: {lack}")
        if order.config.simulation is None:
            self._check_wires(order.config)
        return queue.add(self._directory, order, self._config, WallClock().now_ns()).id

    def _check_wires(self, config: StandConfig) -> None:
        """SessionError for what keeps the run from beginning; that a stand is busy is shown, and keeps it from nothing:
        what is queued has its turn later."""
        try:
            lacks = asyncio.run(not_answering(config))
        except InUse as error:
            say(f"warning: queued without asking the devices: {error}")
            return
        if lacks:
            raise SessionError(f"this stand cannot run it now, and nothing was queued: {'; '.join(lacks)}")

    def runs(self) -> tuple[str, list[Entry | QueuedRun]]:
        """As DaemonDoor."""
        found = queue.queued(self._directory)
        return found.halted, list(found.entries)

    def move(self, number: int, position: int) -> None:
        """As DaemonDoor."""
        queue.move(self._directory, number, position)

    def remove(self, number: int) -> None:
        """As DaemonDoor."""
        queue.remove(self._directory, number)


Door = DaemonDoor | FileDoor


def door(config: str, out: Path | None, url: str, token_file: Path | None) -> Door:
    """The daemon at `url`; else the one of this machine that works on the queue of that folder; else its files."""
    if url:
        if out is not None:
            raise ConfigError(f"--out {out}: the stand at {url} has its own folder")
        return DaemonDoor(server_at(url, token_file))
    directory = directory_of(config, out)
    known = {str(directory.absolute()), str(directory.resolve())}
    found = next((each for each in living() if known & {each.entry.session, each.entry.real_path}), None)
    return FileDoor(directory, config) if found is None else DaemonDoor(Server(found.entry.session, found.socket))


def directory_of(config: str, out: Path | None) -> Path:
    """Where a queue and its sessions are."""
    return out or load_config(packaged("", config)).recording.directory


def at_door(function: Callable[..., None]) -> Callable[..., None]:
    """A command whose first parameter is the Door it goes through: what finds that is taken from the command line."""

    def command(*arguments: Any, config: str, out: Path | None, url: str, token_file: Path | None, **more: Any) -> None:
        function(door(config, out, url, token_file), *arguments, **more)

    command.__name__, command.__doc__ = function.__name__, function.__doc__
    return with_parameters(command, function, {"out": (OutOption, None), **OPTIONS}, without="door")
