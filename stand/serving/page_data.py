"""What the page is given beyond the state: history, the last frame, and its own files. Made on the control loop, where
it only takes what passes the hub; everything else happens in the thread that serves clients.

The picture and the markers of a frame are made by a process of its own at the lowest priority. It is given the newest
frame when it is done with the one before: on a busy machine frames are skipped, and nothing waits.
"""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from thermostand.foundation.clock import Clock
from thermostand.foundation.errors import StandError
from thermostand.foundation.events import PREVIEW, RUN_BEGINS, RUN_RESUME, RUN_START
from thermostand.foundation.hub import Hub
from thermostand.foundation.items import Batch, Event, Item, StepMark, StepState
from thermostand.foundation.readings import Frame
from thermostand.foundation.worker_process import WorkerProcess
from thermostand.foundation.workers import WorkerConnection
from thermostand.stand.serving.live_history import History
from thermostand.stand.serving.preview_process import MODULE, load_recorded_week, load_run_references, make_previewer
from thermostand.stand.serving.shot import FrameShot, is_reference

if TYPE_CHECKING:
    from thermostand.stand.serving.preview import Preview

_WAITING = 20_000  # items; the thread takes them every second
_TAKE_S = 1.0  # curves have a point a second
# Markers of a 5 MP frame take tens of ms; the process has the lowest priority, and the newest frame goes first.
_SOONEST_S = 0.4  # between two frames that are looked at
_AGAIN_S = 30.0  # before a process that has ended is started again
_LOOK, _READ, _SEARCH = "look", "read", "search"  # what is asked for on one line never waits for another's
_ENDED = "the process that looks at frames for the page has ended"


class PageData:
    """A subscriber of the hub with the page's history and last frames.

    sessions: the folder in which the last week is looked for; target_text: the target's YAML, "" for none, and then
    frames are shown without markers' drift.
    """

    def __init__(self, hub: Hub, clock: Clock, sessions: Path, target_text: str) -> None:
        self.history = History()
        self.sessions = sessions
        self.previews: dict[str, Preview] = {}
        self.skipped = 0
        self.trouble = ""  # why there are no previews
        self._hub, self._clock = hub, clock
        self.target_text = target_text
        self._loop = asyncio.get_running_loop()
        self._items: deque[Item] = deque(maxlen=_WAITING)
        self._newest: dict[str, tuple[Frame, str]] = {}
        self._roles: dict[str, str] = {}
        self._fresh: set[str] = set()  # roles whose next frame is a reference, by camera
        self._helper: WorkerProcess | None = None
        self._knows_target = False
        self._has_to_recall = False  # what drift counts from is in the session of the run, and not known here
        self._session: Callable[[], str] = str
        self._roles_seen: dict[str, str] = {}  # of the frame before, by camera
        self._counted_from_ns: dict[str, int | None] = {}  # the frame that drift was last counted from, by camera
        hub.subscribe(self._follow)

    def _follow(self, item: Item) -> None:
        """Follow the hub on the control loop, in a few assignments."""
        if isinstance(item, Frame):
            camera = item.channel.partition(".")[0]
            if camera in self._newest:
                self.skipped += 1
            self._newest[camera] = (item, self._roles.get(item.step_id, ""))
            return
        if isinstance(item, Event) and item.kind in RUN_BEGINS:
            self._has_to_recall = item.kind == RUN_RESUME
        if isinstance(item, StepMark) and item.state is StepState.STARTED:
            role = item.parameters.get("role")
            self._roles = {item.step_id: role} if isinstance(role, str) else {}
        self._items.append(item)

    def close(self) -> None:
        """Take nothing more from the hub."""
        self._hub.unsubscribe(self._follow)

    def drift_px(self) -> float | None:
        """The mean drift in the last frame that was looked at, of the first camera that gave one."""
        last = next(iter(self.previews.values()), None)
        return None if last is None else last.mean_px

    # From here on: in the thread that serves clients.

    async def run(self, session: Callable[[], str]) -> None:
        """Keep the history and look at frames until cancelled. session: folder of the run under way, "" for none."""
        self._session = session
        try:
            async with asyncio.TaskGroup() as tasks:
                tasks.create_task(self._keep_history())
                tasks.create_task(self._watch_frames())
        finally:
            self._end_helper()

    def get_history(self) -> History:
        """The history with all that has been published."""
        with suppress(IndexError):
            while True:
                item = self._items.popleft()
                if isinstance(item, Event) and item.kind == RUN_START:
                    self._fresh.clear()
                    self._fresh.update(self.previews)
                if isinstance(item, Batch | Event | StepMark):
                    self.history(item)
        return self.history

    async def ask(self, function: Callable[..., Any], *args: object) -> Any:
        """`function(*args)` in the process at the lowest priority; OSError when that has ended."""
        return await asyncio.to_thread(self._start_helper().line(_READ).run, function, *args)

    async def search(self, function: Callable[..., Any], *args: object) -> Any:
        """The same for what takes minutes."""
        return await asyncio.to_thread(self._start_helper().line(_SEARCH).run, function, *args)

    async def _keep_history(self) -> None:
        try:
            await self._load_past()
        except Exception as error:  # noqa: BLE001 - the curves begin now
            self._warn(f"the curves of the last week are not shown: {error}")
        while True:
            self.get_history()
            await asyncio.sleep(_TAKE_S)

    async def _load_past(self) -> None:
        """Load what was recorded before this daemon was started."""
        history, troubles = await self.ask(load_recorded_week, str(self.sessions), self._clock.now_ns())
        for trouble in troubles:
            self._warn(f"not in the curves: {trouble}")
        self.history.merge(history)

    async def _watch_frames(self) -> None:
        loop = asyncio.get_running_loop()
        while True:
            began_s = loop.time()
            for camera in tuple(self._newest):
                frame, role = self._newest.pop(camera)
                await self._look(camera, frame, role)
            await asyncio.sleep(max(0.05, began_s + _SOONEST_S - loop.time()) if self._newest else 0.1)

    async def _look(self, camera: str, frame: Frame, role: str) -> None:
        try:
            line = await self._previewer()
            if self._has_to_recall:
                await self._restore_references(line)
            as_reference = is_reference(role, self._roles_seen.get(camera, ""), is_first=camera in self._fresh)
            shot = FrameShot(camera, frame.time_ns, frame.image, role, as_reference)
            preview: Preview = await asyncio.to_thread(line.call, "previewer", "look", shot)
        except OSError as error:
            await self._handle_end(str(error))
        except Exception as error:  # noqa: BLE001 - a frame that cannot be looked at is not shown
            self._warn(f"a frame of {camera} could not be looked at: {error}")
        else:
            self._fresh.discard(camera)
            self.previews[camera], self._roles_seen[camera] = preview, role
            self.trouble = ""
            self._plot(camera, preview)

    async def _restore_references(self, line: WorkerConnection) -> None:
        """Take the run's own references for drift from its session: this process or the one that looks is a new
        one, or another run came in between."""
        self._has_to_recall = False
        if not (session := self._session()):
            return
        try:
            for recalled in await self.ask(load_run_references, session):
                await asyncio.to_thread(line.call, "previewer", "look", recalled.shot)
                self._roles_seen[recalled.shot.camera] = recalled.last_role
                self._fresh.discard(recalled.shot.camera)
        except StandError as error:
            self._warn(f"drift is measured against the first frame from now on, the run's own is not found: {error}")

    def _plot(self, camera: str, preview: Preview) -> None:
        if preview.reference_ns != self._counted_from_ns.setdefault(camera, preview.reference_ns):
            self._counted_from_ns[camera] = preview.reference_ns
            self.history.reference(camera, preview.time_ns)
        if preview.mean_px is not None and preview.worst_px is not None:
            self.history.add(f"{camera}.drift_mean", preview.time_ns, preview.mean_px, "px")
            self.history.add(f"{camera}.drift_worst", preview.time_ns, preview.worst_px, "px")

    def _start_helper(self) -> WorkerProcess:
        """The process; the target is known to it from the first frame on."""
        if self._helper is None:
            self._helper, self._knows_target = WorkerProcess(MODULE, (_LOOK, _READ, _SEARCH), _ENDED), False
        return self._helper

    async def _previewer(self) -> WorkerConnection:
        line = self._start_helper().line(_LOOK)
        if not self._knows_target:
            await asyncio.to_thread(line.make, "previewer", make_previewer, self.target_text)
            self._knows_target = True
        return line

    async def _handle_end(self, why: str) -> None:
        self._warn(f"no new frames on the page for {_AGAIN_S:g} s: {why}")
        self._end_helper()
        self._has_to_recall = True
        await asyncio.sleep(_AGAIN_S)

    def _end_helper(self) -> None:
        helper, self._helper = self._helper, None
        if helper is not None:
            helper.close()

    def _warn(self, text: str) -> None:
        self.trouble = text
        event = PREVIEW.at(self._clock.now_ns(), text)
        with suppress(RuntimeError):  # the loop has ended
            self._loop.call_soon_threadsafe(self._hub.publish, event)
