"""What a recorded session is worth: the drift fitted, validated at the held-out temperatures, and reported."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from experiments.steps import Capture, PlannedStep, Role
from foundation.errors import ConfigError, StandError
from foundation.progress import progress

MODEL_NAME, REPORT_NAME = "model.json", "report.html"


class NotReported(StandError):
    """The run is complete and recorded, and no report could be made of it; the text says why."""


def check_reportable(plan: Iterable[PlannedStep]) -> None:
    """ConfigError when the plan leaves no drift to report, to be told before anything moves."""
    roles = {planned.step.role for planned in plan if isinstance(planned.step, Capture)}
    if Role.WARM_UP not in roles and not {Role.REFERENCE, Role.FIT} <= roles:
        raise ConfigError("--report needs a recipe with a thermal_cycle or a warm_up: their frames show the drift")


def report_session(session: Path, folder: Path) -> list[str]:
    """Fit and report a session into `folder`; the lines to show: the table beside the paper's and where the files are.
    A session without a thermal cycle has a report of its drift, and no model.

    The session's own folder will do: whatever reads a session looks only at what a run has left there. NotReported when
    the frames do not allow it or a file cannot be written; what was recorded is as it was.
    """
    # Figures and fit take half a second to import, which `stand status` need not wait for.
    from compensation.drift.evaluation import table
    from compensation.reporting.report import analyse

    model, report = folder / MODEL_NAME, folder / REPORT_NAME
    try:
        evaluation = analyse([session], model, report, progress)
    except (StandError, OSError) as error:
        remedy = f"`compensate report {session} -o report.html` tries again"
        raise NotReported(f"{session} is recorded, but not reported: {error}; {remedy}") from error
    fitted = [] if evaluation is None else [table(evaluation), f"model    {model}"]
    return [*fitted, f"report   {report}"]
