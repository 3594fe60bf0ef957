"""What a recipe would do on a stand, before anybody queues it: for the form in which people design a session."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate
from pathlib import Path
from typing import Literal, cast

import yaml
from pydantic import JsonValue

from thermostand.experiments.detectability import estimate_detectability
from thermostand.foundation.clock import to_ns
from thermostand.foundation.documents import parse_yaml
from thermostand.stand.estimating.course import predict_course
from thermostand.stand.estimating.learned_durations import load_learned_durations
from thermostand.stand.estimating.run_estimate import estimate_plan, explain_small_disk, find_existing
from thermostand.stand.running.order import Order
from thermostand.stand.serving.api_models import PlanWarning, RunPreview


@dataclass(frozen=True, slots=True)
class Turn:
    """When a run that is queued now has its turn. ahead: how many come before it; begin_ns: None when unknown."""

    begins: Literal["now", "queued", "halted"]
    ahead: int
    begin_ns: int | None


def preview_order(order: Order, directory: Path, turn: Turn, lacks: Sequence[str]) -> RunPreview:
    """Return what the order would do; its session would lie in `directory`. ConfigError as estimate_plan."""
    config, plan = order.config, tuple(order.recipe.plan())
    estimate, learned = estimate_plan(plan, config, directory), load_learned_durations(directory)
    begins_s = [0.0, *accumulate(step.duration_s for step in estimate.steps)]
    small_disk = explain_small_disk(directory, estimate.steps, config)
    looks = estimate_detectability(plan)
    document = cast("dict[str, JsonValue]", parse_yaml(order.recipe_text, "recipe.yaml"))
    return RunPreview(
        recipe=document,
        recipe_text=yaml.safe_dump(document, sort_keys=False, allow_unicode=True, default_flow_style=None, width=100),
        steps=len(plan),
        duration_s=estimate.duration_s - estimate.after_s,
        after_s=estimate.after_s,
        begins=turn.begins,
        ahead=turn.ahead,
        begin_ns=turn.begin_ns,
        end_ns=None if turn.begin_ns is None else turn.begin_ns + to_ns(estimate.duration_s),
        frames=sum(step.frames for step in estimate.steps),
        size_bytes=round(sum(step.size_bytes for step in estimate.steps)),
        free_bytes=shutil.disk_usage(find_existing(directory)).free,
        lacks=(*lacks, *([small_disk] if small_disk else [])),
        warnings=tuple(
            PlanWarning(step=step.planned.index, at_s=at_s, text=step.warning)
            for step, at_s in zip(estimate.steps, begins_s, strict=False)
            if step.warning
        ),
        looks="" if looks is None else str(looks),
        learned=str(learned),
        chamber_degC=config.set_points_degC,
        dew_degC=None if config.dew is None else config.dew.lowest_degC(config.ending.ambient_degC),
        course=predict_course(estimate, config, learned.chamber),
    )
