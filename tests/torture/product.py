"""One life of the program under torture: `python -m tests.torture.product FOLDER LIFE COMMAND...` is `stand COMMAND...`
on the case of that folder.

The laboratory is an observed one, sleepers and ready tasks run in a drawn order, and what people do to a stand is done
at its instant of virtual time, over the same doors: HTTP, signals, the bus. What the doors say is written down
(doors-N.jsonl).
"""

from __future__ import annotations

import asyncio
import errno
import faulthandler
import json
import os
import random
import signal
import sys
from functools import partial
from pathlib import Path
from typing import Any

import thermostand.stand.service.run as run_module
from tests.torture.case import Case, Order, read_case
from tests.torture.laboratory import FOLDER, LIFE
from tests.torture.lives import HIDDEN, find_folder
from tests.torture.operator_actions import OperatorActions
from thermostand.foundation.clock import NS_PER_S, VirtualClock, to_ns
from thermostand.recording.writing import notices
from thermostand.stand.assembly.simulator import Simulator
from thermostand.stand.serving.client import Server, find_session_server

LOOK_EVERY_S, LOOKS = 300.0, 200  # at what HTTP says
_TASKS = ("TaskStepMethWrapper", "TaskWakeupMethWrapper", "builtin_function_or_method")
_SIGNALS = {"stop": signal.SIGTERM, "interrupt": signal.SIGINT}


class ShuffledLoop(asyncio.SelectorEventLoop):
    """Tasks that are ready at one turn run in a drawn order; all other callbacks stay where they are. What is drawn
    depends on the instant alone, so that turns of the loop that a busy machine adds change nothing later."""

    seed = 0
    clock: VirtualClock | None = None
    _drawn, _at_ns = random.Random(), -1

    def _run_once(self) -> None:
        ready = self._ready
        if len(ready) > 1:
            places = [place for place, handle in enumerate(ready) if type(handle._callback).__name__ in _TASKS]
            if len(places) > 1:
                now_ns = 0 if self.clock is None else self.clock.now_ns()
                if now_ns != self._at_ns:
                    self._at_ns, self._drawn = now_ns, random.Random(f"{self.seed} {now_ns}")
                handles = [ready[place] for place in places]
                self._drawn.shuffle(handles)
                for place, handle in zip(places, handles, strict=True):
                    ready[place] = handle
        super()._run_once()


class TortureClock(VirtualClock):
    """Virtual time in which somebody does things to the stand."""

    def __init__(self, schedule: Schedule, start_ns: int, *simulator: Any) -> None:
        super().__init__(start_ns, *simulator)
        self._schedule, self._begun = schedule, None
        loop = asyncio.get_running_loop()
        if schedule.case.drawn_order:
            drawn = random.Random(f"{schedule.case.seed} {start_ns}")
            self._order = iter(lambda: drawn.getrandbits(62), -1)
        if isinstance(loop, ShuffledLoop):
            loop.clock = self

    async def run(self) -> None:
        if self._begun is None:
            self._begun = asyncio.create_task(self._schedule.run(self))
        await super().run()


class Disk:
    """That of the session, as the system's calls show it; it is the real one until something is set."""

    is_full = refuses = False

    def __init__(self) -> None:
        synced, space = os.fdatasync, notices.read_disk_space

        def sync(file: int) -> None:
            if self.refuses:
                raise OSError(errno.EIO, os.strerror(errno.EIO))
            synced(file)

        os.fdatasync = sync
        notices.read_disk_space = self._read_space
        self._read_host_space = space

    def _read_space(self, folder: Path) -> notices.Space:
        """Full or empty: how full the host's is adds nothing to what is recorded."""
        space = self._read_host_space(folder)
        return space._replace(free_bytes=0 if self.is_full else space.total_bytes)


class Schedule:
    """What people do, in its order."""

    def __init__(self, case: Case, folder: Path, life: int) -> None:
        self.case, self._folder, self.disk = case, folder, Disk()
        bus = partial(os.environ.get, "TORTURE_BUS", "")
        self.doors = OperatorActions(case, folder / f"doors-{life}.jsonl", self._server, bus, self._name)
        before = folder / f"doors-{life - 1}.jsonl"
        rows = before.read_text().splitlines() if before.exists() else []
        # A life may begin before the last one's end: its orders are not given twice.
        self._done_ns = int(json.loads(rows[-1])["time_ns"]) if rows else 0

    async def run(self, clock: VirtualClock) -> None:
        begin_s = (max(clock.now_ns(), self._done_ns) - self.case.start_ns) / NS_PER_S
        kills = [Order("kill", at_s) for at_s in self.case.kills_s]
        looks = [Order("state", begin_s + LOOK_EVERY_S * (number + 1)) for number in range(LOOKS)]
        for order in sorted((*self.case.orders, *kills, *looks), key=lambda order: order.at_s):
            if order.at_s > begin_s:
                await clock.sleep_until(self.case.start_ns + to_ns(order.at_s))
                with clock.hold():
                    await asyncio.to_thread(self._do, order, clock.now_ns())

    def _do(self, order: Order, now_ns: int) -> None:
        match order.verb:
            case "kill":
                self.doors.note(order, now_ns, self.doors.asked("GET", "state"))
                os.kill(os.getpid(), signal.SIGKILL)
            case "stop" | "interrupt":
                self.doors.note(order, now_ns, None)
                os.kill(os.getpid(), _SIGNALS[order.verb])
            case "lose_folder" | "find_folder" | "fill_disk" | "empty_disk" | "refuse_writes" | "take_writes":
                self.doors.note(order, now_ns, self._change_disk(order.verb, self._session()))
            case _:
                self.doors.give(order, now_ns)

    def _session(self) -> Path | None:
        found = next(iter(sorted((self._folder / "out").glob("*/journal.jsonl"))), None)
        return found and found.parent

    def _name(self) -> str:
        session = self._session()
        return session.name if session else ""

    def _server(self) -> Server:
        return find_session_server(self._session() or self._folder)

    def _change_disk(self, verb: str, session: Path | None) -> bool:
        """Whether it could be done."""
        if verb == "lose_folder" and session is not None:
            session.rename(self._folder / HIDDEN / session.name)
        elif verb == "find_folder":
            return find_folder(self._folder)
        elif verb in ("fill_disk", "empty_disk"):
            self.disk.is_full = verb == "fill_disk"
        else:
            self.disk.refuses = verb == "refuse_writes"
        return True


def _say_where() -> None:
    """What waits for what, of a program that hangs."""
    faulthandler.dump_traceback()
    for task in asyncio.all_tasks():
        task.print_stack(limit=3, file=sys.stderr)


def main() -> None:
    signal.signal(signal.SIGUSR1, lambda *_: _say_where())
    folder, life, *command = sys.argv[1:]
    case = read_case(Path(folder) / "case.yaml")
    schedule = Schedule(case, Path(folder), int(life))
    os.environ |= {FOLDER: folder, LIFE: life}
    Simulator.module = "tests.torture.laboratory"
    begin = Simulator.__init__

    def begun(self: Simulator, laboratory: dict[str, object]) -> None:
        begin(self, laboratory)
        os.environ["TORTURE_BUS"] = self.addresses["bus"]

    Simulator.__init__ = begun
    run_module.VirtualClock = partial(TortureClock, schedule)
    if case.drawn_order:
        ShuffledLoop.seed = case.seed
        asyncio.events.new_event_loop = asyncio.runners.events.new_event_loop = ShuffledLoop
    sys.argv = ["stand", *command]
    from thermostand.stand.cli import app

    app()


if __name__ == "__main__":
    main()
