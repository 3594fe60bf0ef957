"""Who has the stand open, and what its service asks of it: here for one run; for days it is a daemon."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping
from dataclasses import asdict
from typing import cast

from pydantic import JsonValue

from thermostand.foundation.errors import StandError
from thermostand.foundation.events import BY_HAND_FAILED, EventKind
from thermostand.foundation.tasks import describe_failure
from thermostand.stand.running.opening.open_stand import OpenStand
from thermostand.stand.running.run import Run
from thermostand.stand.service.manual_control import ManualControl
from thermostand.stand.service.run_queue import RunQueue
from thermostand.stand.serving.api_models import Conflict, DeviceState, HeatByHand, QueuedRun

_BY_HAND_S = 1.0  # so long an order by hand is waited for; what takes longer goes on


class Host:
    """An open stand with its one run, which is the whole queue. orders: of a daemon's queue, None without one."""

    def __init__(self, open_stand: OpenStand, orders: RunQueue | None = None) -> None:
        self.open_stand = open_stand
        self.orders = orders
        self.manual_control = ManualControl(open_stand.assembly, self.check_heat)
        self.manual_tasks: dict[asyncio.Task[object], str] = {}  # orders by hand under way, and the device of each
        self._assembly = open_stand.assembly
        self._hub, self._clock = self._assembly.hub, self._assembly.clock
        self._began_ns = self._clock.now_ns()

    @property
    def active_run(self) -> Run | None:
        """The run that has the stand."""
        return cast("Run | None", self.open_stand.active_run)

    @property
    def has_run(self) -> bool:
        """Whether a run has the stand."""
        return self.active_run is not None

    @property
    def is_leaving(self) -> bool:
        """Whether the stand is closed as soon as it is safe."""
        return False

    @property
    def busy(self) -> tuple[str, ...]:
        """The devices that carry out an order: of a run, or by hand."""
        return tuple(dict.fromkeys((*self._assembly.stand.motions.names, *self.manual_tasks.values())))

    def get_state_fields(self) -> dict[str, object]:
        """The fields of the state that are known whichever program has the stand open."""
        ordered, by_hand = self._assembly.stand.chamber.ordered, None
        if ordered is not None and not self.has_run:  # as it was ordered: the regulator may not answer
            by_hand = HeatByHand(**asdict(ordered), cut_ns=self._assembly.stand.chamber.permits.ended_ns)
        return {"queue": self.queue(), "busy": self.busy, "by_hand": by_hand}

    def queue(self) -> tuple[QueuedRun, ...]:
        """Return what has been run, is and will be."""
        if (active_run := self.active_run) is None:
            return ()
        order, began_ns = active_run.job.order, self._began_ns
        return (
            QueuedRun(
                id=1,
                recipe=order.recipe.name,
                state="running",
                added_ns=began_ns,
                began_ns=began_ns,
                session=active_run.recorder.directory.name,
            ),
        )

    def devices(self) -> tuple[DeviceState, ...]:
        """Return what is there, and what it takes by hand now."""
        return self.manual_control.devices(self.explain_manual_refusal())

    def explain_manual_refusal(self) -> str:
        """Return why no device takes an order now, "" when they do."""
        if self.has_run:
            return "a run has the stand; pause does not change that, STOP ends the run"
        if (fault := self.open_stand.latch.fault) is not None:
            return f"the stand has tripped: {fault.text}; reset it once the cause is removed"
        reasons = self._assembly.stand.gate.reasons
        return f"the stand is held: {', '.join(sorted(reasons))}" if reasons else ""

    async def run_manual_order(self, name: str, verb: str, arguments: Mapping[str, JsonValue]) -> str:
        """Return what came of it within a moment, as a sentence; Conflict when that is nothing good, or it is
        refused."""
        if refused := self.explain_manual_refusal():
            raise Conflict(refused)
        what = f"{name} {verb}"
        hand = asyncio.ensure_future(self.manual_control.work(name, verb, arguments))
        self.manual_tasks[hand] = name
        hand.add_done_callback(self.manual_tasks.pop)
        done, _ = await asyncio.wait([hand], timeout=_BY_HAND_S)
        if not done:
            hand.add_done_callback(lambda ended: self._publish_failure(what, ended))
            return f"{what}: under way"
        if hand.cancelled():
            raise Conflict(f"{what}: stopped")
        error = hand.exception()
        if isinstance(error, StandError):
            raise Conflict(str(error)) from error
        if error is not None:
            raise error
        return f"{what}: done"

    def check_heat(self) -> None:
        """Conflict when nobody may heat by hand now."""
        raise Conflict("there is no heat by hand here: it needs the record between runs of `stand serve`")

    def stop(self) -> None:
        """The stand is made safe at once; a run that has it ends."""
        for hand in self.manual_tasks:
            hand.cancel()
        if self.active_run is None:
            self._assembly.stand.safety.demand()
        else:
            self.active_run.stop()

    def wake(self) -> None:
        """Look at the queue: it may have something to run."""

    def note(self) -> None:
        """Write down what the next one who has the stand has to know."""

    def reset_queue(self) -> None:
        """A queue that was halted goes on."""

    def _publish(self, kind: EventKind, text: str = "", /, **data: object) -> None:
        self._hub.publish(kind.at(self._clock.now_ns(), text, **data))

    def _publish_failure(self, what: str, ended: asyncio.Future[object]) -> None:
        if not ended.cancelled() and (error := ended.exception()) is not None:
            self._publish(BY_HAND_FAILED, describe_failure(error), what=what)
