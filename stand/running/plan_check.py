"""Steps that somebody wants to replace others by, checked as an edit checks them: what is wrong with each of them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from thermostand.experiments.steps import STEPS, PlannedStep, Situation, Step, step_of
from thermostand.foundation.errors import ConfigError
from thermostand.stand.config.stand_config import StandConfig
from thermostand.stand.estimating.estimate import price
from thermostand.stand.running.memory.entries import edited
from thermostand.stand.running.memory.fold import after, refusal
from thermostand.stand.running.memory.state import RunState
from thermostand.stand.running.order import plan_faults
from thermostand.stand.serving.desk import PlanCheck, StepFault, WrittenStep

_SET_POINT = "chamber_degC"


def steps_of(
    plan: Sequence[PlannedStep], from_index: int, steps: Sequence[WrittenStep]
) -> Iterator[tuple[Step | ConfigError, float | None]]:
    """Each of the steps that are to follow the first `from_index` of the plan, or what is wrong with it; and the
    chamber's set-point there, None while it is stopped. Frames that are not said to be at one are at that."""
    found = Situation()
    for planned in plan[:from_index]:
        found = planned.step.situation_after(found)
    for written in steps:
        here_degC, parameters = found.set_point_degC, dict[str, object](written.parameters)
        is_labelled = written.kind in STEPS and STEPS[written.kind].at_set_point
        if is_labelled and parameters.get(_SET_POINT) is None and here_degC is not None:
            parameters[_SET_POINT] = here_degC
        try:
            step = step_of(written.kind, parameters)
        except ConfigError as error:
            yield error, here_degC
        else:
            found = step.situation_after(found)
            yield step, here_degC


def check_edit(state: RunState, from_index: int, steps: Sequence[WrittenStep], config: StandConfig) -> PlanCheck:
    """What an edit of the plan from `from_index` on would say. Changes nothing, and asks no device."""
    found = list(steps_of(state.plan, from_index, steps))
    seen = PlanCheck(
        texts=tuple("" if isinstance(step, ConfigError) else step.words for step, _ in found),
        set_points_degC=tuple(degC for _, degC in found),
    )
    by = [step for step, _ in found if not isinstance(step, ConfigError)]
    wrong = [(index, step) for index, (step, _) in enumerate(found, from_index) if isinstance(step, ConfigError)]
    if wrong:  # the others cannot be judged: what stands before them is not known
        return _with_faults(seen, [(index, str(error)) for index, error in wrong])
    change = edited(0, from_index, by)
    if reason := refusal(state, change):
        return _with_faults(seen, [(None, reason)])
    plan = after(state, change).plan
    if faults := list(plan_faults(plan, config)):
        return _with_faults(seen, faults)
    try:
        priced = price(plan, config)
    except ConfigError as error:
        return _with_faults(seen, [(None, str(error))])
    return seen.model_copy(update={"duration_s": sum(each.duration_s for each in priced[from_index:])})


def _with_faults(seen: PlanCheck, faults: Sequence[tuple[int | None, str]]) -> PlanCheck:
    return seen.model_copy(update={"faults": tuple(StepFault(index=index, text=text) for index, text in faults)})
