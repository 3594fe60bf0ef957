"""The queue of a daemon: what may be queued, and what is in it.

A run is checked when it is queued: recipe, limits, devices that answer, space on the disk. All that
touches the disk is done in a thread of its own, which keeps no daemon from leaving.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

from thermostand.experiments.steps import Capture
from thermostand.foundation.clock import to_ns
from thermostand.foundation.errors import ConfigError, NotFound, SessionError, StandError
from thermostand.foundation.readings import Quality
from thermostand.foundation.workers import WorkerThread
from thermostand.recording.reading.session import Session
from thermostand.recording.writing.disk import NOTES_LINE, QUEUE_LINE, REPAIR_LINE, DiskCalls, DiskProcess
from thermostand.stand.config.check_record import ATTACHMENT
from thermostand.stand.config.own_recipes import read_recipe, remove_recipe, save_recipe
from thermostand.stand.estimating.run_estimate import PlanEstimate, estimate_plan, explain_small_disk
from thermostand.stand.running.opening.open_stand import OpenStand
from thermostand.stand.running.opening.stop import Stop
from thermostand.stand.running.order import Order, check_plan, parse_order, select_optics
from thermostand.stand.running.resume import repair_session
from thermostand.stand.running.run_control import OperatorNote
from thermostand.stand.service import queue
from thermostand.stand.service.queue import RunOrigin
from thermostand.stand.service.queue_file import Queue, QueueEntry, QueueState, start_working
from thermostand.stand.service.queue_worker import is_complete
from thermostand.stand.service.run_preview import Turn, preview_order
from thermostand.stand.serving.alerts import missing_command
from thermostand.stand.serving.api_models import Conflict, Missing, QueuedRun, Requester, RunPreview, RunRequest

_SHOWN = 50  # runs that have ended


class RunQueue:
    """The queue of the daemon that has `open_stand`. texts: config.yaml, target.yaml, optics of simulated cameras and
    the record of `stand check` where there is one, as they were when it began.

    rehearse: is given a recipe's name and text, and runs it in virtual time.

    queued: as it was last read. stop: of the run under way. leaving: the daemon ends, and its run is interrupted by it.
    """

    def __init__(
        self,
        open_stand: OpenStand,
        disk: DiskProcess,
        directory: Path,
        config_name: str,
        texts: dict[str, str],
        rehearse: Callable[[str, str], None] | None = None,
    ) -> None:
        self.queued = Queue()
        self.stop: Stop | None = None
        self.leaving = False
        self.directory = directory
        clock = open_stand.assembly.clock
        # What writes is done by the disk's process: a thread that writes to a disk that hangs keeps its process.
        self.disk = DiskCalls(disk, QUEUE_LINE, clock)
        self.notes, self.repair = DiskCalls(disk, NOTES_LINE, clock), DiskCalls(disk, REPAIR_LINE, clock)
        self.reading = WorkerThread("orders", open_stand.assembly.clock, patient=False)
        self._open_stand = open_stand
        self._config_name = config_name
        self._texts = texts
        self._rehearse = rehearse
        self._expected_s: dict[int, float] = {}

    async def read(self) -> None:
        """Know the queue as it is on the disk."""
        self.queued = await self.disk.call(queue.load_queue, self.directory)

    async def ready(self) -> None:
        """The queue is this daemon's while the disk's process lives; SessionError when another program runs it. What a
        daemon that was killed had under way is not resumed by itself: somebody has to ask for it."""
        await self.disk.keep("worker", start_working, self.directory)
        await self.read()
        first = next((entry for entry in self.queued.entries if entry.is_open), None)
        if first is not None and first.state is QueueState.INTERRUPTED:
            reason = f"run {first.id} ({first.recipe}) was interrupted: {first.reason}; resume it, or take it out"
            await self.disk.call(queue.halt, self.directory, reason)
            await self.read()

    async def reset(self) -> None:
        """The queue may continue."""
        await self.disk.call(queue.reset, self.directory)
        await self.read()

    async def submit(self, who: Requester, request: RunRequest, key: str) -> QueueEntry:
        """ConfigError for what is wrong with the request, Conflict for what is wrong with the stand."""
        order = await self.reading.call(self._load_order, request)
        make_note(who, request.note, request.tags)
        estimate = await self.reading.call(self._estimate, order)
        self._check_wires(order)
        digest = hashlib.sha256(request.model_dump_json().encode()).hexdigest()[:16]
        asked = RunOrigin(key, digest, who.name, request.note, request.tags)
        now_ns = self._open_stand.assembly.clock.now_ns()
        try:
            wanted = queue.make_entry(order, self._config_name, now_ns, asked)
            entry: QueueEntry = await self.disk.call(queue.append, self.directory, wanted)
        except SessionError as error:
            raise Conflict(str(error)) from error
        self._expected_s[entry.id] = estimate.duration_s
        await self.read()
        return entry

    async def preview(self, request: RunRequest, run_end_ns: int | None) -> RunPreview:
        """Return what the request would do if it were queued now; ConfigError for what is wrong with it. run_end_ns:
        when the run under way is expected to end, None without one or when that is not known."""
        order = await self.reading.call(self._load_order, request)
        turn, lacks = self._find_turn(run_end_ns), self._list_lacks(order)
        return await self.reading.call(preview_order, order, self.directory, turn, lacks)

    def _find_turn(self, run_end_ns: int | None) -> Turn:
        """Return when a run that is queued now has its turn."""
        entries = self.queued.entries
        is_running = any(entry.state is QueueState.RUNNING for entry in entries)
        before = [entry for entry in entries if entry.is_open]
        ahead = len(before) + is_running
        if self.queued.halted:
            return Turn("halted", ahead, None)
        now_ns = self._open_stand.assembly.clock.now_ns()
        expected_s = [self._expected_s.get(entry.id) for entry in before]
        known_s = [each for each in expected_s if each is not None]
        begin_ns = run_end_ns if is_running else now_ns
        if begin_ns is None or len(known_s) < len(expected_s):
            return Turn("queued", ahead, None)
        return Turn("queued" if ahead else "now", ahead, begin_ns + to_ns(sum(known_s)))

    async def cancel(self, number: int) -> None:
        """Take it out; what it was halted for is over when it was that run."""
        entry = self._find_entry(number)
        await self._change(queue.remove, number)
        if entry.state is QueueState.INTERRUPTED and not any(each.is_open for each in self.queued.entries):
            await self.reset()

    async def move(self, number: int, to: int) -> None:
        """Make it the `to`-th of those to be done."""
        self._find_entry(number)
        await self._change(queue.move, number, to)

    async def resume(self, session: str) -> QueueEntry:
        """Put the session first in the queue: its run is the next one."""
        folder = await self.reading.call(self.find_session, session)
        try:
            is_whole = await self.repair.call(is_complete, folder)
        except StandError as error:
            raise Conflict(str(error)) from error
        if is_whole:
            raise Conflict(f"{session}: its run is complete; there is nothing to resume")
        # A session whose process was killed has no finished segment yet, and cannot be opened.
        try:
            await self.repair.call(repair_session, folder)
        except SessionError as error:
            raise Conflict(str(error)) from error
        order = await self.reading.call(self._load_recorded_order, session)
        now_ns = self._open_stand.assembly.clock.now_ns()
        wanted = queue.make_entry(order, self._config_name, now_ns)
        entry: QueueEntry = await self.disk.call(queue.prepend, self.directory, wanted, session)
        await self.read()
        return entry

    def list_runs(self) -> tuple[QueuedRun, ...]:
        """The queue for clients: the last that have ended, the run under way, those to be done."""
        ended = [entry for entry in self.queued.entries if not entry.is_open and entry.state is not QueueState.RUNNING]
        first = ended[-_SHOWN:][:1]
        since = self.queued.entries.index(first[0]) if first else 0
        return tuple(self.describe_run(entry) for entry in self.queued.entries[since:])

    def describe_run(self, entry: QueueEntry) -> QueuedRun:
        """One of it."""
        same = entry.model_dump(mode="json", include=set(QueuedRun.model_fields))
        return QueuedRun(**same, expected_s=self._expected_s.get(entry.id))

    async def _change(self, change: Callable[..., object], *arguments: object) -> None:
        try:
            await self.disk.call(change, self.directory, *arguments)
        except SessionError as error:
            raise Conflict(str(error)) from error
        await self.read()

    def _find_entry(self, number: int) -> QueueEntry:
        entry = next((entry for entry in self.queued.entries if entry.id == number), None)
        if entry is None:
            raise Missing(f"no run {number} is in the queue")
        return entry

    def _load_order(self, request: RunRequest) -> Order:
        """ConfigError when the recipe cannot be run on this stand."""
        if bool(request.recipe) == bool(request.recipe_text):
            raise ConfigError("either the name of an installed recipe, or the text of one")
        text = request.recipe_text or self._read_named(request.recipe)
        names = {
            "config.yaml": self._config_name,
            "recipe.yaml": request.recipe or "the recipe",
            "target.yaml": "target",
        }
        order = replace(parse_order({**self._texts, "recipe.yaml": text}, names), attended=request.attended)
        return self._adapt_to_stand(order)

    def _read_named(self, name: str) -> str:
        try:
            return read_recipe(self.directory, name)
        except NotFound as error:
            raise Missing(str(error)) from error

    async def save_recipe(self, name: str, text: str) -> None:
        """Keep a recipe of one's own; ConfigError for what is wrong with it."""
        try:
            await self.disk.call(save_recipe, str(self.directory), name, text)
        except SessionError as error:
            raise Conflict(str(error)) from error

    async def remove_recipe(self, name: str) -> None:
        """Remove a recipe of one's own; Missing when there is none."""
        try:
            await self.disk.call(remove_recipe, str(self.directory), name)
        except NotFound as error:
            raise Missing(str(error)) from error
        except SessionError as error:
            raise Conflict(str(error)) from error

    async def rehearse_order(self, request: RunRequest) -> str:
        """Begin a rehearsal in virtual time; the recipe's name. ConfigError for what is wrong with it."""
        order = await self.reading.call(self._load_order, request)
        if self._rehearse is None:
            raise Conflict("this program makes no rehearsals")
        self._rehearse(order.recipe.name, order.recipe_text)
        return order.recipe.name

    def get_order(self, entry: QueueEntry) -> Order:
        """Return what it asks for, on the stand as it is open now; ConfigError as `queue.order_of`."""
        return self._adapt_to_stand(replace(queue.make_order(entry), attended=entry.attended))

    def _adapt_to_stand(self, order: Order) -> Order:
        """The same on the stand as it is open now."""
        config = self._open_stand.assembly.config
        check_plan(order.recipe.plan(), config)
        return replace(
            order,
            config=config,
            config_text=self._texts["config.yaml"],
            optics_texts=select_optics(config, self._texts),
            commissioning_text=self._texts.get(ATTACHMENT, ""),
        )

    def find_session(self, session: str) -> Path:
        """Missing when there is no session of that name here; it waits for the disk."""
        folder = self.directory / session
        if not session or "/" in session or "\0" in session or session.startswith(".") or not folder.is_dir():
            raise Missing("there is no session of that name")
        return folder

    def _load_recorded_order(self, session: str) -> Order:
        """Return what a session was to run; Missing when there is no such session, Conflict when it cannot be
        resumed."""
        folder = self.find_session(session)
        try:
            texts = dict(Session.open(folder).attachments)
            return parse_order({**self._texts, **texts}, {name: f"{session}: {name}" for name in texts})
        except (StandError, LookupError) as error:
            raise Conflict(str(error)) from error

    def _estimate(self, order: Order) -> PlanEstimate:
        """Return what the run will take; Conflict when the disk has no space for it."""
        estimate = estimate_plan(tuple(order.recipe.plan()), order.config, self.directory)
        if lack := explain_small_disk(self.directory, estimate.steps, order.config):
            raise Conflict(f"{self.directory}: {lack}")
        return estimate

    def _check_wires(self, order: Order) -> None:
        if lacks := self._list_lacks(order):
            raise Conflict(f"this stand cannot run it now: {'; '.join(lacks)}")

    def _list_lacks(self, order: Order) -> list[str]:
        """Return what does not answer now, and what else would end the run at its beginning."""
        assembly = self._open_stand.assembly
        lacks = [
            f"{channel} is not read: {reading.reason}"
            for channel, reading in assembly.hub.readings.items()
            if reading.quality is Quality.BAD and reading.cause == "wire"
        ]
        captures = any(isinstance(planned.step, Capture) for planned in order.recipe.plan())
        cameras = assembly.devices.cameras.values()
        if captures and assembly.stand.imaging.supply.is_on and not all(camera.is_usable for camera in cameras):
            lacks.append("a camera does not answer")
        if missing := missing_command(assembly.config.alerts):
            lacks.append(missing)
        return lacks


def make_note(who: Requester, note: str, tags: Sequence[str]) -> OperatorNote | None:
    """A note and tags, None without either; ConfigError for what is no tag."""
    return OperatorNote(who, note, tags) if note.strip() or tags else None
