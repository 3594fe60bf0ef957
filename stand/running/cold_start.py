"""A warm-up that was killed, or held by an interlock, cannot be gone on with: its camera is warm. Which steps are done
again, from cold."""

from __future__ import annotations

from collections.abc import Collection, Iterable

from experiments.steps import Capture, PlannedStep, PowerCamera, Prompt, Role


def cold_start(plan: Iterable[PlannedStep], done: Collection[str], begun: Collection[str]) -> tuple[PlannedStep, ...]:
    """The steps to be done again, the capture last: from switching the camera off to its capture, but for what the
    operator was asked for. Empty when no warm-up was interrupted after its camera was, or may have been, switched on.

    `done`, `begun`: ids of steps.
    """
    steps = tuple(plan)
    last = next((step.index for step in steps if _is_warm_up(step) and step.step_id not in done), 0)
    on = _last_switch(steps[:last], on=True)
    off = _last_switch(steps[: on or 0], on=False)
    if on is None or off is None or not {steps[on].step_id} & {*done, *begun}:
        return ()
    return tuple(step for step in steps[off : last + 1] if not isinstance(step.step, Prompt))


def _is_warm_up(planned: PlannedStep) -> bool:
    return isinstance(planned.step, Capture) and planned.step.role is Role.WARM_UP


def _last_switch(steps: tuple[PlannedStep, ...], *, on: bool) -> int | None:
    return next((step.index for step in reversed(steps) if step.step == PowerCamera(on)), None)
