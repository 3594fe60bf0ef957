"""`compensate fit`, `rereference`, `report`, `datasheet` and `budget`: what sessions of one camera say."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from thermostand.compensation.budget.budget import Budget, compute_budget
from thermostand.compensation.budget.budget import format_budget as budget_table
from thermostand.compensation.budget.geometry import load_geometry
from thermostand.compensation.camera_selection import select_camera
from thermostand.compensation.commands.options import (
    CameraName,
    DetailsOption,
    Incomplete,
    MarkerSearch,
    TargetOption,
    load_optional_target,
    open_session,
)
from thermostand.compensation.datasheet.datasheet import compute_datasheet
from thermostand.compensation.datasheet.measurement_details import load_details
from thermostand.compensation.drift.bumps import MOST_STEPS, Cause, find_unrepeated, list_sessions_at_limit
from thermostand.compensation.drift.drift_model import DriftModel
from thermostand.compensation.drift.evaluation import Evaluation, evaluate, format_table
from thermostand.compensation.drift.model_facts import Bump
from thermostand.compensation.drift.model_file import load_model, save_model
from thermostand.compensation.drift.model_selection import Form, check_request
from thermostand.compensation.drift.model_selection import fit as fit_model
from thermostand.compensation.drift.paper_model import MAX_DEGREE
from thermostand.compensation.drift.rereference import fit_like, get_thermal_form
from thermostand.compensation.drift.rereference import rereference as rereference_model
from thermostand.compensation.drift.thermal_model import ThermalModel
from thermostand.compensation.observations import Observations, read_session_target
from thermostand.compensation.reporting.drawing.figures import open_renderer
from thermostand.compensation.reporting.equipment import Line, list_equipment
from thermostand.compensation.reporting.pages import render_datasheet_page, render_pdf, serialise_datasheet
from thermostand.compensation.reporting.report import (
    NoModel,
    can_be_scored,
    check_report_writable,
    fit_and_evaluate,
    get_numbers_path,
    write_report,
)
from thermostand.compensation.reporting.report_numbers import Extras, list_table_positions
from thermostand.compensation.spreadsheet import is_spreadsheet
from thermostand.compensation.validation3d.document import load_validation
from thermostand.foundation.command_app import App
from thermostand.foundation.errors import ConfigError, SessionError
from thermostand.foundation.files import check_writable, write_atomically, write_bytes_atomically
from thermostand.foundation.output import say, show
from thermostand.markers.target import Target
from thermostand.recording.reading.session import Session

app = App()


@app.command("budget")
def budget_of_session(
    session: Annotated[Path, typer.Argument(metavar="SESSION", help="Folder of a recorded session.")],
    geometry: Annotated[str, typer.Option(help="The stand's geometry: a file, or the installed `paper`.")] = "paper",
    target: TargetOption = None,
    camera: CameraName = None,
    incomplete: Incomplete = False,
) -> None:
    """The stand's error budget: refraction, granite, target and table, in um and px, with uncertainty.

    Example: compensate budget sessions/20260101T180000Z-validation --geometry my-stand.yaml
    """
    stand = load_geometry(geometry)
    recorded = open_session(session, camera, incomplete)
    found = compute_budget(recorded, load_optional_target(target) or read_session_target(recorded), stand)
    show(found, [budget_table(found)])


def compute_budgets(
    paths: Sequence[Path], camera: str | None, geometry: str, target: Target | None
) -> dict[str, Budget]:
    """The budget of each session, by its name. SessionError or ConfigError with a sentence."""
    stand = load_geometry(geometry)
    opened = [Session.open(path) for path in paths]
    for session in opened:
        select_camera(session, camera)
    return {
        session.metadata.get("session_id", ""): compute_budget(session, target or read_session_target(session), stand)
        for session in opened
    }


_FORMATS = (".html", ".pdf", ".json")


@app.command("datasheet")
def write_datasheet(
    sessions: Annotated[
        list[Path],
        typer.Argument(
            metavar="SESSION...|CENTRES.csv", help="Folders of sessions of one camera, or a table of centres."
        ),
    ],
    out: Annotated[Path, typer.Option("--out", "-o", metavar="FILE.html|pdf|json", help="The file to write.")],
    *,
    model: Annotated[Path | None, typer.Option(help="Score this model; else one is fitted to the sessions.")] = None,
    details: DetailsOption = None,
    camera: CameraName = None,
    finding: MarkerSearch,
) -> None:
    """Write a camera's thermal datasheet: px/K and ppm/K, settling, hysteresis, what each form of compensation leaves,
    each with its expanded uncertainty and the budget it comes from.

    Example: compensate datasheet sessions/20260101T180000Z-thermal-cycle -o camera.pdf
    """
    if out.suffix.lower() not in _FORMATS:
        raise ConfigError(f"{out}: give a name that ends in {', '.join(_FORMATS)}")
    check_writable(out)
    stated = load_details(details)
    given = None if model is None else load_model(model)
    observations = finding.observed(sessions, camera)
    sheet = compute_datasheet(observations, given or fit_model(observations), stated)
    equipment = _list_equipment(sessions[0], observations)
    if out.suffix.lower() == ".json":
        write_atomically(out, serialise_datasheet(sheet, equipment))
    elif out.suffix.lower() == ".pdf":
        write_bytes_atomically(out, render_pdf(render_datasheet_page(sheet, equipment)))
    else:
        write_atomically(out, render_datasheet_page(sheet, equipment))
    known = sum(one.value == one.value for one in sheet.quantities)
    line = f"{out}: {known} of {len(sheet.quantities)} quantities, with U (k = 2)"
    data = {"file": out, "quantities": sheet.quantities, "not_known": observations.not_known}
    show(data, [line, *_list_unknown(observations)])


Sessions = Annotated[
    list[Path],
    typer.Argument(metavar="SESSION...|CENTRES.csv", help="Folders of recorded sessions, or a table of centres."),
]
DegreeOption = Annotated[
    int | None,
    typer.Option(help=f"Degree of the paper's polynomial, 1 to {MAX_DEGREE}; else chosen by cross-validation."),
]
FormOption = Annotated[
    Form | None, typer.Option(help="The paper's polynomial or the thermal form; else chosen by cross-validation.")
]


@app.command()
def fit(
    sessions: Annotated[
        list[Path],
        typer.Argument(metavar="SESSION...|CENTRES.csv", help="Folders of recorded sessions, or a table of centres."),
    ],
    out: Annotated[Path, typer.Option("--out", "-o", help="The model file (JSON) to write.")],
    *,
    form: FormOption = None,
    degree: DegreeOption = None,
    like: Annotated[
        list[Path] | None,
        typer.Option(metavar="MODEL", help="A model of another unit of its type; give three or more."),
    ] = None,
    camera: CameraName = None,
    finding: MarkerSearch,
) -> None:
    """Fit the drift model to the reference, fit and warm-up frames of sessions of one camera.

    A table, as `compensate observe` or a spreadsheet of any country writes it, has a row for each centre: frame,
    marker, x_px, y_px, camera_degC, and where known time_ns, chamber_degC, role, air_degC, var_x_px2, cov_xy_px2,
    var_y_px2, width_px, height_px, session. It needs no session and no stand.

    One session does not show how well sessions repeat: a dead zone in a mount or a thermometer far from the camera may
    err by 20 mpx and more in another one. What that adds is assumed then, and the model says so; two sessions over the
    same set-points, in another order, measure it.

    With --like few frames are enough, at two temperatures or more: a warm-up, the reference and a set-point on each
    side of it, 14 and 45 degC say, teach more than a hot one alone.

    Example: compensate fit sessions/20260101T180000Z-thermal-cycle -o model.json
    """
    check_request(degree, form)
    check_writable(out)
    if like and (form == "paper" or degree is not None):
        raise ConfigError("--like fits the thermal form, which has no degree; leave out --form and --degree")
    units = [get_thermal_form(load_model(path)) for path in like or ()]
    observations = finding.observed(sessions, camera)
    model = fit_like(observations, units) if units else fit_model(observations, degree, form, say)
    evaluation, unscored = _try_evaluate(model, observations)
    save_model(model, out)
    bumps = list(model.facts.bumps)
    unrepeated = find_unrepeated(observations, model.facts.bumps)
    named = [one for one in unrepeated if one.cause is not Cause.NOTHING]
    data = {"model": out, "form": model.form, "title": model.title, "bumps": [each.model_dump() for each in bumps]}
    stepped = [_format_bump(each, observations) for each in bumps]
    stepped += [
        f"{session_id}: {MOST_STEPS} steps were found, as many as are looked for; there may be more"
        for session_id in list_sessions_at_limit(bumps)
    ]
    stepped += [f"{one.session_id}: {one.text}" for one in named]
    repeats = model.between_sessions if isinstance(model, ThermalModel) else None
    stepped += [] if repeats is None else [repeats.text]
    scored = f"what it gains is not known: {unscored}" if evaluation is None else format_table(evaluation)
    scores = {"not_scored": unscored} if evaluation is None else _describe_scores(evaluation)
    left_out = [f"{count} frames are left out: {reason}" for reason, count in observations.left_out.items()]
    lines = [f"{model.form}: {model.title}", *_list_unknown(observations), *left_out, *stepped, scored]
    data |= {"not_known": observations.not_known}
    show({**data, "left_out": observations.left_out, "unrepeated": named, "between_sessions": repeats, **scores}, lines)


@app.command()
def rereference(
    model: Annotated[Path, typer.Argument(metavar="MODEL", help="A model file, as compensate fit writes it.")],
    session: Annotated[Path, typer.Argument(metavar="SESSION", help="The session, with a few reference frames.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="The model file (JSON) to write, for this session.")],
    *,
    camera: CameraName = None,
    finding: MarkerSearch,
) -> None:
    """Fit a model to where the target is in a new session, with a few reference frames of the session itself.

    Camera or target were taken out since the model was fitted: what that moved is the same in all states, and is taken
    out, with its uncertainty. The new model has the thermal form alone.

    Example: compensate rereference model.json sessions/20260108T180000Z-short -o model-of-the-8th.json
    """
    check_writable(out)
    known = get_thermal_form(load_model(model))
    found = rereference_model(known, finding.observed([session], camera))
    save_model(found, out)
    show({"model": out, "form": found.form, "title": found.title}, [f"{found.form}: {found.title}"])


def _try_evaluate(model: DriftModel, observations: Observations) -> tuple[Evaluation | None, str]:
    """Return what the model gains, or None and why that is not known: the model is valid without it."""
    try:
        return evaluate(model, observations), ""
    except SessionError as error:
        return None, str(error)


def _list_unknown(observations: Observations) -> list[str]:
    return [f"not known: {text}" for text in observations.not_known.values()]


def _list_equipment(source: Path, observations: Observations) -> list[Line]:
    """Return what a session was recorded with; of a table, what it does not say."""
    if is_spreadsheet(source):
        return [("Not known", text) for text in observations.not_known.values()]
    return list_equipment(Session.open(source))


def _format_bump(bump: Bump, observations: Observations) -> str:
    utc = next(facts.utc for facts in observations.sessions if facts.session_id == bump.session_id)
    when = f"{utc.date_time(bump.after_ns)} and {utc.date_time(bump.before_ns)}"
    return f"bump in {bump.session_id} between {when}: {bump.text}; fitted around it"


def _describe_scores(evaluation: Evaluation) -> dict[str, object]:
    """Return what compensation gains, for programs; RMS along x and y, px."""
    return {
        "question": evaluation.question,
        "method": evaluation.method,
        "frames": evaluation.frames,
        "rms_before_px": evaluation.rms_before_px,
        "rms_after_px": evaluation.rms_after_px,
        "coverage_95": evaluation.coverage_95,
    }


def _collect_extras(
    sessions: list[Path],
    camera: str | None,
    budget: str | None,
    target: str | None,
    validation: Path | None,
    details: Path | None,
) -> Extras:
    """equipment is still to be added. ConfigError for a table with --budget."""
    recorded = [path for path in sessions if not is_spreadsheet(path)]
    if budget is not None and len(recorded) < len(sessions):
        raise ConfigError("--budget needs recorded sessions: a table of centres says nothing of the stand")
    return Extras(
        details=load_details(details),
        budgets={} if budget is None else compute_budgets(recorded, camera, budget, load_optional_target(target)),
        positions=list_table_positions([Session.open(path).steps() for path in recorded]),
        validation=None if validation is None else load_validation(validation),
    )


@app.command()
def report(
    sessions: Sessions,
    out: Annotated[Path, typer.Option("--out", "-o", help="The HTML file to write.")],
    *,
    model: Annotated[Path | None, typer.Option(help="Score this model; else one is fitted to the sessions.")] = None,
    budget: Annotated[
        str | None, typer.Option(help="Show the stand's budget, by its geometry: a file, or the installed `paper`.")
    ] = None,
    validation: Annotated[
        Path | None, typer.Option(help="Show the result of `compensate validate`, too: the JSON file next to its page.")
    ] = None,
    details: DetailsOption = None,
    camera: CameraName = None,
    finding: MarkerSearch,
) -> None:
    """Write the report of sessions of one camera: drift, model, and what it gains at held-out temperatures.

    Its numbers are in a JSON file of the same name next to it. Without reference and fit frames it shows the drift
    alone.

    Example: compensate report sessions/20260101T180000Z-thermal-cycle --model model.json -o report.html
    """
    check_report_writable(out, model, validation)
    given, extras = (
        model and load_model(model),
        _collect_extras(sessions, camera, budget, finding.target, validation, details),
    )
    observations = finding.observed(sessions, camera)
    extras = replace(extras, equipment=_list_equipment(sessions[0], observations))
    with open_renderer(finding.workers) as draw:
        if given is None:
            used, evaluation, refusal = fit_and_evaluate(observations)
        else:
            used, refusal = given, ""
            evaluation = evaluate(given, observations) if can_be_scored(observations) else None
        write_report(out, observations, used, evaluation, extras, draw)
    if used is None and refusal:
        raise NoModel(f"no model: {refusal}; {out} shows the drift alone")
    alone = f"drift alone: a model needs reference and fit frames, usable are {observations.roles_text}"
    alone = f"the model is not scored: {refusal}" if refusal else alone
    scores = {} if evaluation is None else _describe_scores(evaluation)
    lines = [alone if evaluation is None else format_table(evaluation), *_list_unknown(observations)]
    numbers = {"report": out, "numbers": get_numbers_path(out), "not_known": observations.not_known}
    show({**numbers, **scores}, lines)
