"""What a run tells of itself while it goes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

from drivers.clock import Clock, seconds_ns
from drivers.interface import Quality
from stand.estimating.estimate import PricedStep
from stand.estimating.eta import Eta
from stand.estimating.follow import parameters_text
from stand.hub import Batch, Event, Item, StepMark
from stand.recording.recorder import Recorder
from stand.recording.space import disk_space
from stand.remote.control import RunStatus
from stand.running.gate import Gate, Phase
from stand.running.scheduler import Progress
from stand.running.stop import Stop

State = Literal["running", "held", "stopping"]
_STATES: dict[Phase, State] = {
    Phase.IDLE: "running",
    Phase.RUNNING: "running",
    Phase.HELD: "held",
    Phase.ABORTING: "stopping",
    Phase.ENDED: "stopping",
}


class StatusBoard:
    """A subscriber of the hub that remembers what an operator asks for."""

    def __init__(
        self,
        recipe: str,
        steps: Sequence[PricedStep],
        progress: Progress,
        gate: Gate,
        stop: Stop,
        recorder: Recorder,
        clock: Clock,
    ) -> None:
        self._recipe = recipe
        self._count = len(steps)
        self._eta = Eta(steps, progress.done, progress.earned_s)
        self._gate = gate
        self._stop = stop
        self._recorder = recorder
        self._clock = clock
        self._step = 0
        self._doing = ""
        self._state: State = _STATES[stop.phase]
        self._since_ns = clock.now_ns()
        self._temperatures_degC: dict[str, float | None] = {}
        self._warning = ""

    def __call__(self, item: Item) -> None:
        """Follow one item."""
        self._follow_state()
        match item:
            case StepMark():
                self._eta.mark(item)
                self._step = item.index + 1
                self._doing = f"{item.kind} {parameters_text(item.parameters)}".rstrip()
            case Event():
                self._eta.event(item)
                self._warning = self._warning if item.level == "info" else item.text
            case Batch():
                for reading in item.readings:
                    if reading.unit == "degC":
                        is_bad = reading.quality is Quality.BAD
                        self._temperatures_degC[reading.channel] = None if is_bad else reading.value
            case _:
                pass

    def status(self) -> RunStatus:
        """As it is now."""
        self._follow_state()
        now_ns, saved = self._clock.now_ns(), self._recorder.saved
        return RunStatus(
            recipe=self._recipe,
            step=self._step,
            steps=self._count,
            doing=self._doing,
            state=self._state,
            reasons=tuple(sorted(self._gate.reasons)),
            now_ns=now_ns,
            since_ns=self._since_ns,
            end_ns=None if self._state == "stopping" else now_ns + seconds_ns(self._eta.left_s(now_ns)),
            temperatures_degC=self._temperatures_degC,
            frames_saved=saved.frames,
            frames_lost=saved.frames_lost,
            disk_free_bytes=_free_bytes(self._recorder),
            warning=self._warning,
        )

    def _follow_state(self) -> None:
        state = _STATES[self._stop.phase]
        if state != self._state:
            self._state, self._since_ns = state, self._clock.now_ns()


def _free_bytes(recorder: Recorder) -> int:
    """0 when the disk cannot be asked."""
    try:
        return disk_space(recorder.directory).free_bytes
    except OSError:
        return 0
