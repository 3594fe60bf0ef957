"""What the stand asks of the compensation: the report of a recorded session (the drift fitted, validated at the
held-out temperatures, and reported), and the decisions of a cycle that decides. Nothing else of the stand imports it.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

from thermostand.compensation.design import decision_process
from thermostand.experiments.steps import Capture, PlannedStep
from thermostand.foundation.errors import ConfigError, StandError
from thermostand.foundation.progress import progress

MODEL_NAME, REPORT_NAME = "model.json", "report.html"
DECIDES = decision_process.decide_next_visit  # for a process of its own, which imports the rest when it is asked


class Reported(NamedTuple):
    """unexplained: what no temperature explains, a sentence each. results: the table next to the paper's, and where the
    files are."""

    unexplained: tuple[str, ...]
    results: tuple[str, ...]

    @property
    def lines(self) -> list[str]:
        """All of it, to be shown."""
        return [*(f"warning: {text}" for text in self.unexplained), *self.results]


class NotReported(StandError):
    """The run is complete and recorded, and no report could be made of it; the text says why."""


def check_reportable(plan: Iterable[PlannedStep]) -> None:
    """ConfigError when the plan takes no frames, before anything moves."""
    if not any(isinstance(planned.step, Capture) for planned in plan):
        raise ConfigError("--report needs a recipe that takes frames; this one has no capture")


def report_session(session: Path, folder: Path) -> Reported:
    """Fit and report a session into `folder`. Without reference and fit frames there is a report of the drift alone.

    The session's own folder will do: readers of a session look only at the files that a run has left there. NotReported
    when the frames do not allow it or a file cannot be written; what was recorded is as it was.
    """
    # Figures and fit take half a second to import, which `stand status` need not wait for.
    from thermostand.compensation.drift.evaluation import format_table
    from thermostand.compensation.observations import MixedEquilibria
    from thermostand.compensation.reporting.report import NoModel, analyse

    model, report = folder / MODEL_NAME, folder / REPORT_NAME
    try:
        evaluation = analyse([session], model, report, progress)
    except NoModel as error:
        raise NotReported(f"{session} is recorded, but {error}") from error
    except (StandError, OSError) as error:
        flag = " --across-gap" if isinstance(error, MixedEquilibria) else ""
        remedy = f"`compensate report {session}{flag} -o report.html` tries again"
        raise NotReported(f"{session} is recorded, but not reported: {error}; {remedy}") from error
    fitted = [] if evaluation is None else [format_table(evaluation), f"model    {model}"]
    return Reported(tuple(_describe_movements(report.with_suffix(".json"))), (*fitted, f"report   {report}"))


def _describe_movements(numbers: Path) -> Iterator[str]:
    """Steps of the image, slips, fixings that settle differently each time."""
    found = json.loads(numbers.read_text())
    for bump in found["bumps"]:
        yield f"between {bump['after']} and {bump['before']} {bump['text']}; no temperature explains it"
    yield from (one["text"] for one in found["unrepeated"] if one["cause"] != "nothing")
