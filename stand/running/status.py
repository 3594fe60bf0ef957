"""The status of a run while it is under way."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

from thermostand.experiments.steps import describe_step
from thermostand.foundation.clock import NS_PER_S, Clock, Now, to_ns, utc_offset_ns
from thermostand.foundation.events import ETA_SLIPPED, PLAN_CHANGED
from thermostand.foundation.hub import Hub
from thermostand.foundation.instants import format_local
from thermostand.foundation.items import Batch, Event, Item, StepMark
from thermostand.foundation.readings import Quality
from thermostand.recording.writing.recorder import Recorder
from thermostand.stand.estimating.eta import Eta
from thermostand.stand.estimating.run_estimate import PlanEstimate
from thermostand.stand.running.memory.state import RunState
from thermostand.stand.running.opening.stop import Stop
from thermostand.stand.safety.gate import HELD, RELEASED, Gate, Phase
from thermostand.stand.safety.latch import Latch
from thermostand.stand.serving.api_models import RunStatus

# Says when the end of a run moves: an event each time it is later by another tenth of the whole.

_SHARE = 0.1  # of the time that is left; round number, nothing was measured
_LEAST_S = 300.0  # a minute's slip of a short run is not reported


class EtaSlip:
    """A subscriber behind the one that follows the run. left_s: real seconds to the end, from an instant in ns on."""

    def __init__(self, hub: Hub, clock: Now, left_s: Callable[[int], float], utc_offset_ns: Callable[[], int]) -> None:
        self._hub, self._clock, self._left_s, self._utc_offset_ns = hub, clock, left_s, utc_offset_ns
        now_ns = clock.now_ns()
        self._step_s = max(_SHARE * left_s(now_ns), _LEAST_S)
        self._end_s = now_ns / NS_PER_S + left_s(now_ns)  # as it was reported last

    def __call__(self, item: Item) -> None:
        """Look at the end when a step begins or ends, or something holds the run or lets it go."""
        is_event = isinstance(item, Event) and item.kind in (HELD, RELEASED, PLAN_CHANGED)
        if not is_event and not isinstance(item, StepMark):
            return
        now_ns = self._clock.now_ns()
        end_s = now_ns / NS_PER_S + self._left_s(now_ns)
        later_s = end_s - self._end_s
        if later_s < self._step_s:
            return
        self._end_s = end_s
        end_ns = round(end_s * NS_PER_S)
        at = format_local(end_ns + self._utc_offset_ns())
        self._hub.publish(ETA_SLIPPED.at(now_ns, at, later_s=round(later_s, 1), end_ns=end_ns))


State = Literal["running", "held", "stopping"]
STATES: dict[Phase, State] = {
    Phase.IDLE: "running",
    Phase.RUNNING: "running",
    Phase.HELD: "held",
    Phase.ABORTING: "stopping",
    Phase.ENDING: "stopping",
    Phase.ENDED: "stopping",
}


class StatusBoard:
    """A subscriber of the hub that remembers what an operator asks for. latch: whether the stand has tripped.

    eta: the time left, of the whole and of each step. soaked_again_s: for how long a camera that was off has been
    soaked again, None when it need not be.
    """

    def __init__(
        self,
        recipe: str,
        estimate: PlanEstimate,
        state: RunState,
        gate: Gate,
        stop: Stop,
        latch: Latch,
        *,
        recorder: Recorder,
        clock: Clock,
        soaked_again_s: Callable[[], float | None] = lambda: None,
    ) -> None:
        self._recipe = recipe
        self._soaked_again_s = soaked_again_s
        self.eta = Eta(estimate.steps, state.done, state.soaked_s, estimate.after_s)
        self._gate = gate
        self._stop = stop
        self._latch = latch
        self._recorder = recorder
        self._clock = clock
        self._step = 0
        self._doing = ""
        self._state: State = STATES[stop.phase]
        self._since_ns = clock.now_ns()
        self._since_utc_offset_ns = self._warning_utc_offset_ns = utc_offset_ns(clock)
        self._temperatures_degC: dict[str, float | None] = {}
        self._warning: Event | None = None

    def __call__(self, item: Item) -> None:
        """Follow one item."""
        self._follow_state()
        match item:
            case StepMark():
                self.eta.mark(item)
                self._step = item.index + 1
                self._doing = describe_step(item.kind, item.parameters)
            case Event():
                self.eta.event(item)
                if item.level != "info":
                    self._warning, self._warning_utc_offset_ns = item, utc_offset_ns(self._clock)
            case Batch():
                for reading in item.readings:
                    if reading.unit == "degC":
                        is_bad = reading.quality is Quality.BAD
                        self._temperatures_degC[reading.channel] = None if is_bad else reading.value
            case _:
                pass

    def status(self) -> RunStatus:
        """The status as it is now."""
        self._follow_state()
        now_ns, saved = self._clock.now_ns(), self._recorder.saved
        warning, fault = self._warning, self._latch.fault
        return RunStatus(
            recipe=self._recipe,
            step=self._step,
            steps=self.eta.count,
            doing=self._describe_step(),
            state=self._state,
            reasons=tuple(sorted(self._gate.reasons)),
            now_ns=now_ns,
            since_ns=self._since_ns,
            end_ns=None if self._state == "stopping" else now_ns + to_ns(self.eta.left_s(now_ns)),
            end_within_s=self.eta.within_s(),
            frames_planned=self.eta.frames,
            temperatures_degC=self._temperatures_degC,
            frames_saved=saved.frames,
            frames_lost=saved.frames_lost,
            disk_free_bytes=self._recorder.disk_free_bytes,
            warning="" if warning is None else warning.text,
            warning_level="" if warning is None else "error" if warning.level == "error" else "warning",
            warning_ns=None if warning is None else warning.time_ns,
            utc_offset_ns=utc_offset_ns(self._clock),
            since_utc_offset_ns=self._since_utc_offset_ns,
            warning_utc_offset_ns=self._warning_utc_offset_ns,
            fault_rule="" if fault is None else fault.rule,
            fault="" if fault is None else fault.text,
        )

    def _describe_step(self) -> str:
        """The step under way in words; before that a camera that was off comes to equilibrium."""
        return describe_doing(self._doing, self._soaked_again_s(), goes_on=self.eta.goes_on)

    def left_s(self, now_ns: int) -> float:
        """Return how long the run still takes, from now on."""
        return self.eta.left_s(now_ns)

    def _follow_state(self) -> None:
        state = STATES[self._stop.phase]
        if state != self._state:
            self._state, self._since_ns = state, self._clock.now_ns()
            self._since_utc_offset_ns = utc_offset_ns(self._clock)


def describe_doing(step: str, soaked_again_s: float | None, *, goes_on: bool) -> str:
    """The step under way, in words, and what it waits for. soaked_again_s: how long a camera that was off has soaked
    again, None when it need not. goes_on: whether a soak goes on beyond its time."""
    if goes_on:
        step = f"{step}, and until the chamber has stayed in its band"
    if soaked_again_s is None:
        return step
    soaking = f"the camera was or may have been off and soaks again, for {soaked_again_s / 60:.0f} min so far"
    return f"{soaking}; then: {step}" if step else soaking
