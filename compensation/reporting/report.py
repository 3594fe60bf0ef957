"""The report of a compensation: one HTML file that needs nothing else, its numbers beside it, and the whole way there.

report.json has every number of report.html under the names of compensation/reporting/numbers.py.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from pathlib import Path

from thermostand.compensation.budget.budget import Budget, Contribution
from thermostand.compensation.drift.choosing import fit
from thermostand.compensation.drift.drift_model import DriftModel
from thermostand.compensation.drift.evaluation import Evaluation, evaluate
from thermostand.compensation.drift.model_file import save_model
from thermostand.compensation.observations import Observations, Progress, observe
from thermostand.compensation.reporting.compensation_section import (
    compensation_section,
    model_section,
    uncertainty_section,
)
from thermostand.compensation.reporting.data_section import data_section, utc
from thermostand.compensation.reporting.drawing.drawing import Draw, one_by_one
from thermostand.compensation.reporting.drift_section import drift_section
from thermostand.compensation.reporting.equipment import equipment_of
from thermostand.compensation.reporting.extras import Extras
from thermostand.compensation.reporting.gather import numbers_of
from thermostand.compensation.reporting.numbers import Numbers, as_json
from thermostand.compensation.reporting.page import Drawing, Heading, Paragraph, Part, Table, page
from thermostand.compensation.reporting.result_section import result_section
from thermostand.compensation.reporting.table_positions import TablePositions, positions_figure, table_positions
from thermostand.compensation.reporting.validation_report import validation_parts
from thermostand.compensation.validation3d.validate import Validation
from thermostand.experiments.steps import Role
from thermostand.foundation.errors import SessionError
from thermostand.foundation.files import check_writable, write_whole
from thermostand.markers.target import Target
from thermostand.recording.reading.session import Session


class NoModel(SessionError):
    """The frames allow no model; the report that was written shows the drift alone."""


def analyse(
    session_paths: Sequence[Path], model_path: Path, report_path: Path, progress: Progress
) -> Evaluation | None:
    """Sessions in; model, report and its numbers out, each file whole or not there; the markers are looked for once.

    Without reference and fit frames there is no model, and None; NoModel when there are, and they allow none.
    `progress` is foundation.progress.progress or alike. Raises SessionError or ConfigError with a sentence.
    """
    check_writable(model_path)
    check_report_writable(report_path, model_path)
    observations = observe(session_paths, progress)
    sessions = [Session.open(path) for path in session_paths]
    positions = table_positions([session.steps() for session in sessions])
    extras = Extras(positions=positions, equipment=equipment_of(sessions[0]))
    with progress("fit and report", 3) as report:
        report(0, "choosing the form, scoring")
        model, evaluation, refusal = fitted(observations)
        report(2, "drawing")
        write_report(report_path, observations, model, evaluation, extras)
        if model is not None:
            save_model(model, model_path)
        report(3, "written")
    if model is None and refusal:
        raise NoModel(f"no model: {refusal}; {report_path} shows the drift alone")
    return evaluation


def fitted(observations: Observations) -> tuple[DriftModel | None, Evaluation | None, str]:
    """Model and score, a model that cannot be scored, or neither; and why frames that are made for a model allow no
    model or score, "" when there are no such."""
    if not can_be_fitted(observations):
        return None, None, ""
    try:
        model = fit(observations)
    except SessionError as error:
        return None, None, str(error)
    try:
        return model, evaluate(model, observations), ""
    except SessionError as error:
        return model, None, str(error)


def can_be_fitted(observations: Observations) -> bool:
    """Whether there are a reference and set-points to fit; without them a report shows the drift alone."""
    return can_be_scored(observations) and bool(observations.of(Role.FIT).any())


def can_be_scored(observations: Observations) -> bool:
    """Whether a model can be compared with frames at set-points, from a reference on."""
    reference, set_points = observations.of(Role.REFERENCE), observations.of(Role.FIT, Role.VALIDATION)
    return bool(reference.any() and set_points.any())


def check_report_writable(path: Path, *inputs: Path | None) -> None:
    """SessionError when page or numbers could not be written, or would take the place of each other or of an input: to
    be raised before the work."""
    numbers = numbers_path(path)
    if numbers.resolve() in [one.resolve() for one in (path, *inputs) if one is not None]:
        raise SessionError(f"{path}: the numbers of this page would overwrite {numbers}; give it another name")
    for one in (path, numbers):
        check_writable(one)


def numbers_path(page_path: Path) -> Path:
    """Of the numbers that belong to a page: report.json beside report.html."""
    return page_path.with_name(f"{page_path.stem}.json")


def write_report(
    path: Path | str,
    observations: Observations,
    model: DriftModel | None = None,
    evaluation: Evaluation | None = None,
    extras: Extras | None = None,
    draw: Draw = one_by_one,
) -> None:
    """Write page and numbers, each whole or not at all; without a model the drift alone. draw: how the figures are
    drawn. SessionError when the place refuses."""
    extras, path = extras or Extras(), Path(path)
    numbers = numbers_of(observations, model, evaluation, extras)
    text = _page(observations, evaluation, numbers, extras, draw)
    write_whole(path, text)
    write_whole(numbers_path(path), as_json(numbers))


def report_page(
    observations: Observations,
    model: DriftModel | None,
    evaluation: Evaluation | None,
    extras: Extras | None = None,
) -> str:
    """The report as HTML text; the same data give the same text."""
    extras = extras or Extras()
    return _page(observations, evaluation, numbers_of(observations, model, evaluation, extras), extras, one_by_one)


def _page(
    observations: Observations, evaluation: Evaluation | None, numbers: Numbers, extras: Extras, draw: Draw
) -> str:
    subject = "Thermal drift" if numbers.model is None else "Thermal compensation"
    title = f"{subject} of camera {numbers.camera}"
    parts = [Heading(title, 1), Paragraph(_lead(numbers), aside=True), *result_section(numbers, extras.validation)]
    parts += drift_section(observations, numbers)
    parts += _compensation(observations, evaluation, numbers)
    parts += space_section(extras.positions, observations.target, extras.validation)
    parts += stand_section(numbers)
    parts += data_section(numbers)
    return page(title, parts, draw)


def _compensation(observations: Observations, evaluation: Evaluation | None, numbers: Numbers) -> Iterator[Part]:
    if evaluation is not None and numbers.score is not None:
        yield from compensation_section(observations, evaluation, numbers.score)
    if numbers.model is not None:
        yield from model_section(numbers.model)
    yield from uncertainty_section(numbers)


def _lead(numbers: Numbers) -> str:
    recipes = ", ".join(dict.fromkeys(session.recipe for session in numbers.sessions))
    begin, end = min(one.begin for one in numbers.sessions), max(one.end for one in numbers.sessions)
    frames = sum(session.frames for session in numbers.sessions)
    text = f"Recipe {recipes}, recorded {utc(begin)} to {utc(end)}, {frames} frames."
    return text + (" Recorded in a simulated laboratory." if numbers.simulated else "")


def space_section(positions: TablePositions, target: Target, validation: Validation | None) -> Iterator[Part]:
    """What there is of it; nothing when the target was never moved on purpose."""
    if validation is None and not positions.calibration and not positions.poses:
        return
    yield Heading("In three dimensions")
    if positions.calibration or positions.poses:
        yield Drawing(
            positions_figure(positions, target),
            "table",
            "Where the table held the target, seen from above; the camera looks from the left.",
        )
    if validation is not None:
        yield Paragraph(f"Validated in session {validation.session_id}.", aside=True)
        yield from validation_parts(validation, level=3)


def stand_section(numbers: Numbers) -> Iterator[Part]:
    """A table for each session whose budget was asked for."""
    if not numbers.budgets:
        return
    yield Heading("The stand's budget")
    yield Paragraph(
        "What the stand itself does to the image, at its largest over the session's captures, with standard "
        "uncertainties; a line without one is a scatter. It is part of the drift above unless it was corrected."
    )
    for session_id, budget in numbers.budgets.items():
        yield Paragraph(f"{session_id}: {_state(budget)}", aside=True)
        heads = ("contribution", "µm", "± µm", "mpx", "± mpx", "at", "correctable")
        yield Table(heads, [_line(one) for one in budget.contributions])


def _state(budget: Budget) -> str:
    reference, (low, high) = budget.reference, budget.air_degC
    return (
        f"reference with air {reference.air_degC:z.2f} °C, granite {reference.granite_inside_degC:z.2f} °C inside and "
        f"{reference.granite_outside_degC:z.2f} °C outside, artifact {reference.artifact_degC:z.2f} °C, laboratory "
        f"{reference.laboratory_degC:z.2f} °C; captures with air of {low:z.1f} to {high:z.1f} °C."
    )


def _line(one: Contribution) -> tuple[str, ...]:
    numbers = (_number(one.um), _number(one.u_um), _number(1e3 * one.px), _number(1e3 * one.u_px))
    return (one.name, *numbers, one.where, "yes" if one.corrected else "")


def _number(value: float) -> str:
    return f"{value:z.2f}" if math.isfinite(value) else ""
