"""What is said of steps that somebody wants to replace others by, before they do."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict


class StepFault(BaseModel):
    """Why the plan cannot be so. index: of the step in the plan, None when it is the plan as a whole."""

    model_config = ConfigDict(frozen=True)

    index: int | None
    text: str


class PlanCheck(BaseModel):
    """faults: what is wrong, none when the steps would be taken; duration_s: how long they take then, else None.
    texts: each of them in words, "" of one that is no step. set_points_degC: of the chamber at each of them, None while
    it is stopped."""

    model_config = ConfigDict(frozen=True, allow_inf_nan=False)

    faults: tuple[StepFault, ...] = ()
    duration_s: float | None = None
    texts: tuple[str, ...] = ()
    set_points_degC: tuple[float | None, ...] = ()
