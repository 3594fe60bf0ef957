"""Plans as they are priced, and how long their steps took."""

from collections.abc import Iterable

from thermostand.experiments.steps import (
    Capture,
    PlannedStep,
    Role,
    Step,
    number_steps,
)
from thermostand.foundation.clock import NS_PER_S, to_ns
from thermostand.foundation.items import StepMark, StepState

BEGIN_NS = 1_767_290_400 * NS_PER_S
CAPTURE = Capture(3, 0.5, 0.1, Role.FIT, 31.0)


def make_priced_plan(*steps: Step) -> list[PlannedStep]:
    return list(number_steps(steps))


def marks(plan: Iterable[PlannedStep], durations_s: Iterable[float]) -> list[StepMark]:
    """What a run publishes when the steps take so long."""
    found: list[StepMark] = []
    now_ns = BEGIN_NS
    for item, duration_s in zip(plan, durations_s, strict=True):
        for state in (StepState.STARTED, StepState.DONE):
            parameters = item.step.parameters
            found.append(StepMark(now_ns, item.step_id, item.index, item.step.kind, state, parameters))
            now_ns += to_ns(duration_s) if state is StepState.STARTED else 0
    return found
