"""The report of a compensation: one HTML file that needs nothing else, its numbers next to it, and how both are made.

report.json has every number of report.html under the names of numbers.py; report.html.jinja has every sentence.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import numpy as np

from thermostand.compensation.drift.candidates import Candidate
from thermostand.compensation.drift.drift_model import DriftModel
from thermostand.compensation.drift.evaluation import Evaluation, evaluate
from thermostand.compensation.drift.model_file import save_model
from thermostand.compensation.drift.model_selection import fit
from thermostand.compensation.observations import Observations, Progress, observe
from thermostand.compensation.reporting.drawing import report_figures as figures
from thermostand.compensation.reporting.drawing.figures import (
    EXAGGERATION,
    Draw,
    PathPanel,
    draw_trajectories,
    render_in_turn,
)
from thermostand.compensation.reporting.equipment import list_equipment
from thermostand.compensation.reporting.pages import (
    NamedFigure,
    draw_validation_figures,
    format_orientation,
    render_page,
)
from thermostand.compensation.reporting.report_numbers import (
    Extras,
    ReportNumbers,
    collect_numbers,
    list_table_positions,
    serialise_numbers,
)
from thermostand.compensation.reporting.tracks import (
    Track,
    compute_displacement_px,
    find_cycle,
    find_warm_ups,
    list_visits,
)
from thermostand.compensation.validation3d.validate import SpatialValidation
from thermostand.experiments.steps import Role
from thermostand.foundation.errors import SessionError
from thermostand.foundation.files import check_writable, write_atomically
from thermostand.recording.reading.session import Session

_MOST_PANELS, _MOST_THERMAL = 4, 10  # what a page holds


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
    positions = list_table_positions([session.steps() for session in sessions])
    extras = Extras(positions=positions, equipment=list_equipment(sessions[0]))
    with progress("fit and report", 3) as report:
        report(0, "choosing the form, scoring")
        model, evaluation, refusal = fit_and_evaluate(observations)
        report(2, "drawing")
        write_report(report_path, observations, model, evaluation, extras)
        if model is not None:
            save_model(model, model_path)
        report(3, "written")
    if model is None and refusal:
        raise NoModel(f"no model: {refusal}; {report_path} shows the drift alone")
    return evaluation


def fit_and_evaluate(observations: Observations) -> tuple[DriftModel | None, Evaluation | None, str]:
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
    """Return whether there are a reference and set-points to fit; without them a report shows the drift alone."""
    return can_be_scored(observations) and bool(observations.of(Role.FIT).any())


def can_be_scored(observations: Observations) -> bool:
    """Return whether a model can be compared with frames at set-points, from a reference on."""
    reference, set_points = observations.of(Role.REFERENCE), observations.of(Role.FIT, Role.VALIDATION)
    return bool(reference.any() and set_points.any())


def check_report_writable(path: Path, *inputs: Path | None) -> None:
    """SessionError when page or numbers could not be written, or would take the place of each other or of an input: to
    be raised before the work."""
    numbers = get_numbers_path(path)
    if numbers.resolve() in [one.resolve() for one in (path, *inputs) if one is not None]:
        raise SessionError(f"{path}: the numbers of this page would overwrite {numbers}; give it another name")
    for one in (path, numbers):
        check_writable(one)


def get_numbers_path(page_path: Path) -> Path:
    """Return the path of the numbers that belong to a page: report.json next to report.html."""
    return page_path.with_name(f"{page_path.stem}.json")


def write_report(
    path: Path | str,
    observations: Observations,
    model: DriftModel | None = None,
    evaluation: Evaluation | None = None,
    extras: Extras | None = None,
    draw: Draw = render_in_turn,
) -> None:
    """Write the report's page and its numbers, each whole or not at all.

    Parameters
    ----------
    path : path
        The HTML file; the numbers are written next to it under the same name with the suffix .json.
    observations : Observations
        The frames of the sessions.
    model : DriftModel, optional
        Without a model the report shows the drift alone.
    evaluation : Evaluation, optional
        What the model gains on held-out frames.
    extras : Extras, optional
        More parts of the report.
    draw : callable
        How the figures are drawn.

    Raises
    ------
    SessionError
        When the place cannot be written.
    """
    extras, path = extras or Extras(), Path(path)
    numbers = collect_numbers(observations, model, evaluation, extras)
    write_atomically(path, _render_observations(observations, evaluation, numbers, extras, draw))
    write_atomically(get_numbers_path(path), serialise_numbers(numbers))


def render_report(
    observations: Observations,
    model: DriftModel | None,
    evaluation: Evaluation | None,
    extras: Extras | None = None,
) -> str:
    """The report as HTML text; the same data give the same text."""
    extras = extras or Extras()
    return _render_observations(
        observations, evaluation, collect_numbers(observations, model, evaluation, extras), extras, render_in_turn
    )


def _render_observations(
    observations: Observations, evaluation: Evaluation | None, numbers: ReportNumbers, extras: Extras, draw: Draw
) -> str:
    has_spots = any(session.spots for session in observations.sessions)
    drawn = draw_figures(observations, evaluation, numbers, extras)
    return render_numbers(numbers, drawn, extras.validation, draw, has_spots=has_spots)


def render_numbers(
    numbers: ReportNumbers,
    drawn: Iterable[NamedFigure] = (),
    validation: SpatialValidation | None = None,
    draw: Draw = render_in_turn,
    *,
    has_spots: bool = False,
) -> str:
    """The page of these numbers and figures. has_spots: whether a thermal imager saw the camera."""
    subject = "Thermal drift" if numbers.model is None else "Thermal compensation"
    tried = () if numbers.model is None else numbers.model.candidates
    paper, others = ([one for one in tried if (one.form == "paper") is is_paper] for is_paper in (True, False))
    others.sort(key=lambda one: (not one.chosen, _compute_held_out_square(one)))
    return render_page(
        "report",
        f"{subject} of camera {numbers.camera}",
        drawn,
        draw,
        n=numbers,
        validation=validation,
        candidates=[*paper, *others],
        listed_candidates=len(paper) + _MOST_THERMAL,
        best=[min(ones, key=_compute_held_out_square) for ones in (paper, others) if ones],
        enlarged=EXAGGERATION,
        curve_points=figures.CURVE_POINTS,
        roles={role for session in numbers.sessions for role in session.frames_by_role},
        moved_roles=set(figures.TARGET_MOVED_ROLES),
        has_spots=has_spots,
        drawn_warm_ups=_MOST_PANELS,
    )


def _compute_held_out_square(one: Candidate) -> float:
    return float(one.fold_squares.mean())


def draw_figures(
    observations: Observations, evaluation: Evaluation | None, numbers: ReportNumbers, extras: Extras
) -> Iterator[NamedFigure]:
    """Warm-up, cycle and the whole recording, what the model makes of it, and where the table was; what was not
    recorded has no figure."""
    if np.isfinite(compute_displacement_px(observations)).any():
        yield from _draw_drift_figures(observations, numbers)
    if evaluation is not None:
        yield "compensated", figures.draw_compensated_paths(observations, evaluation)
        yield "residual-map", figures.draw_residual_map(observations, evaluation)
        yield "fit", figures.draw_measured_against_model(evaluation)
        yield "residuals", figures.draw_residuals(evaluation)
        yield "histogram", figures.draw_deviation_histograms(evaluation)
        yield "temperature", figures.draw_against_temperature(evaluation)
    if extras.positions.calibration or extras.positions.poses:
        yield "table", figures.draw_positions(extras.positions, observations.target)
    if extras.validation is not None:
        yield from draw_validation_figures(extras.validation)


def _draw_drift_figures(observations: Observations, numbers: ReportNumbers) -> Iterator[NamedFigure]:
    if shown := find_warm_ups(observations)[:_MOST_PANELS]:
        rolls_deg = [one.track.roll_deg - shown[0].track.roll_deg for one in shown]
        titles = [format_orientation(roll_deg) if len(numbers.warm_ups) > 1 else "" for roll_deg in rolls_deg]
        yield "warm-up-curves", figures.draw_warm_up_curves(observations, shown, titles)
        panels = [_make_panel(observations, one.track, title) for one, title in zip(shown, titles, strict=True)]
        yield "warm-up-paths", draw_trajectories(observations, panels)
    gaps = [
        {one.session_id: one.gaps for one in found} for found in (numbers.hysteresis_before, numbers.hysteresis_after)
    ]
    for index, facts in enumerate(observations.sessions):
        if (track := find_cycle(observations, index)) is not None:
            yield f"cycle-{index}", draw_trajectories(observations, [_make_panel(observations, track, "")])
            before, after = gaps[0][facts.session_id], gaps[1].get(facts.session_id, ())
            yield f"branches-{index}", figures.draw_branches(list_visits(observations, track), before, after)
    yield "time", figures.draw_against_time(observations)


def _make_panel(observations: Observations, track: Track, title: str) -> PathPanel:
    return PathPanel(title, track.start_px, track.moved_px, observations.camera_degC[track.frames])
