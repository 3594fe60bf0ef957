"""The drift in the frames of a run that no daemon looks at, by the process that looks at frames for the page."""

from __future__ import annotations

from collections.abc import Generator
from contextlib import contextmanager, suppress
from pathlib import Path
from threading import Event as Flag
from threading import Thread

from thermostand.foundation.calls import Line
from thermostand.foundation.errors import StandError
from thermostand.foundation.helper import Helper
from thermostand.foundation.hub import Hub
from thermostand.foundation.items import Item, StepMark, StepState
from thermostand.foundation.readings import Frame
from thermostand.stand.serving.preview_process import MODULE, previewer, run_references
from thermostand.stand.serving.shot import DRIFT_ROLES, Shot, is_reference

_LOOK_S = 1.0
_LOOK = "look"
_ENDED = "the process that looks at frames has ended"


class DriftWatch:
    """A subscriber that keeps the newest frame; a thread asks for its drift at the lowest priority. `mean_px`: of the
    last frame that was looked at, None before there is one, or when it shows no drift. resumed: the session of a run
    that goes on, whose own reference is what its drift counts from."""

    def __init__(self, target_text: str, resumed: Path | None = None) -> None:
        self.mean_px: float | None = None
        self._target_text, self._resumed = target_text, resumed
        self._role = self._camera = ""  # drift is shown of the first camera that gives a frame
        self._newest: tuple[Frame, str] | None = None
        self._ending = Flag()
        self._thread = Thread(target=self._work, name="drift", daemon=True)
        self._helper: Helper | None = None

    def subscribe(self, hub: Hub) -> None:
        """To the hub of the run."""
        hub.subscribe(self._follow)

    def _follow(self, item: Item) -> None:
        if isinstance(item, StepMark) and item.state is StepState.STARTED:
            self._role = str(item.parameters.get("role", ""))
        elif isinstance(item, Frame) and (camera := item.channel.partition(".")[0]) == (self._camera or camera):
            self._camera = camera
            self._newest = item, self._role
            if not self._thread.ident:
                self._thread.start()

    def close(self) -> None:
        """Look at no more."""
        self._ending.set()
        if self._helper is not None:
            self._helper.close()

    def _work(self) -> None:
        """A process that ends, or cannot be started, takes the drift with it, and nothing else."""
        with suppress(OSError, StandError):
            self._helper = helper = Helper(MODULE, (_LOOK,), _ENDED)
            try:
                self._look_on(helper.line(_LOOK))
            finally:
                helper.close()
        self.mean_px = None

    def _look_on(self, line: Line) -> None:
        line.make("previewer", previewer, self._target_text)
        before = self._recalled(line)
        while not self._ending.wait(_LOOK_S):
            newest, self._newest = self._newest, None
            if newest is None or newest[1] not in DRIFT_ROLES:
                continue
            frame, role = newest
            as_reference = is_reference(role, before or "", is_first=before is None)
            shot = Shot(self._camera, frame.time_ns, frame.image, role, as_reference)
            self.mean_px, before = line.call("previewer", "mean_px", shot), role

    def _recalled(self, line: Line) -> str | None:
        """The role of the last frame before a run was resumed; what that counted from is known then."""
        if self._resumed is None:
            return None
        with suppress(StandError):  # what cannot be read has no reference: the next frame is one
            for recalled in line.run(run_references, str(self._resumed)):
                if recalled.shot.camera == self._camera:
                    line.call("previewer", "mean_px", recalled.shot)
                    return recalled.last_role
        return None


@contextmanager
def drift_watched(target_text: str, resumed: Path | None = None) -> Generator[DriftWatch]:
    """While inside."""
    watch = DriftWatch(target_text, resumed)
    try:
        yield watch
    finally:
        watch.close()
