"""Steps that somebody wants to replace others by, checked as an edit checks them: what is wrong with each of them."""

from __future__ import annotations

from collections.abc import Sequence

from experiments.steps import Step, step_of
from experiments.words import in_words
from foundation.errors import ConfigError
from stand.config.stand_config import StandConfig
from stand.estimating.estimate import price
from stand.running.memory.entries import edited
from stand.running.memory.fold import after, refusal
from stand.running.memory.state import RunState
from stand.running.order import plan_faults
from stand.serving.desk import WrittenStep
from stand.serving.plan_faults import PlanCheck, StepFault


def check_edit(state: RunState, from_index: int, steps: Sequence[WrittenStep], config: StandConfig) -> PlanCheck:
    """What an edit of the plan from `from_index` on would say. Changes nothing, and asks no device."""
    by, faults = list[Step](), list[StepFault]()
    texts: list[str] = []
    for index, written in enumerate(steps, from_index):
        try:
            step = step_of(written.kind, dict(written.parameters))
        except ConfigError as error:
            faults.append(StepFault(index=index, text=str(error)))
            texts.append("")
        else:
            by.append(step)
            texts.append(in_words(step))
    if faults:  # the others cannot be judged: what stands before them is not known
        return PlanCheck(faults=tuple(faults), texts=tuple(texts))
    change = edited(0, from_index, by)
    if reason := refusal(state, change):
        return PlanCheck(faults=(StepFault(index=None, text=reason),), texts=tuple(texts))
    plan = after(state, change).plan
    faults = [StepFault(index=index, text=text) for index, text in plan_faults(plan, config)]
    if faults:
        return PlanCheck(faults=tuple(faults), texts=tuple(texts))
    try:
        priced = price(plan, config)
    except ConfigError as error:
        return PlanCheck(faults=(StepFault(index=None, text=str(error)),), texts=tuple(texts))
    return PlanCheck(duration_s=sum(each.duration_s for each in priced[from_index:]), texts=tuple(texts))
