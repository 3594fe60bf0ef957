"""The `compensate` command: offline, from recorded sessions and photographs."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from compensation.apply_cli import apply_model, export_model
from compensation.budget_cli import budget_of_session, budgets_of_sessions
from compensation.calibration_cli import calibrate_session
from compensation.command_line import (
    AcrossGap,
    Cache,
    Cluster,
    Incomplete,
    TargetOption,
    Workers,
    installed_target,
    named_target,
    one_line_errors,
    said_if,
)
from compensation.drift.choosing import Form, check_request
from compensation.drift.choosing import fit as fit_model
from compensation.drift.evaluation import evaluate, table
from compensation.drift.model_file import load_model, save_model
from compensation.drift.paper_model import MAX_DEGREE
from compensation.finding.found import finder
from compensation.observations import observe_sessions, read_frames, session_target
from compensation.report.extras import Extras
from compensation.report.report import can_be_fitted, check_report_writable, write_report
from compensation.report.table_positions import table_positions
from compensation.validate_cli import validate_session
from compensation.validation3d.reading import load_validation
from foundation.errors import ConfigError
from foundation.files import check_writable
from foundation.image_limit import GREATEST_MEGAPIXELS, images_up_to
from foundation.progress import Report, late_progress, progress
from foundation.usage import OneLineUsage, one_line
from markers.detection import Detection, DetectionError, Image, detect, nothing_found
from markers.image_file import read_image
from markers.table import CENTRES, DetectedImage, write_detections
from markers.target import Target
from recording.reading.session import Session
from recording.reading.using import open_whole

app = typer.Typer(
    cls=OneLineUsage,
    no_args_is_help=True,
    add_completion=False,
    help="Find markers, fit the thermal drift of a camera, report what compensation gains.\n\n"
    "Example: compensate report sessions/20260101T180000Z-thermal-cycle -o report.html",
)

Sessions = Annotated[list[Path], typer.Argument(metavar="SESSION...", help="Folders of recorded sessions.")]
DegreeOption = Annotated[
    int | None,
    typer.Option(help=f"Degree of the paper's polynomial, 1 to {MAX_DEGREE}; else chosen by cross-validation."),
]
FormOption = Annotated[
    Form | None, typer.Option(help="The paper's polynomial or the thermal form; else chosen by cross-validation.")
]

MegapixelsOption = Annotated[
    float, typer.Option("--max-megapixels", min=0.001, max=2000.0, help="Larger images are refused, unread.")
]

_DEFAULT_TARGET = "paper-9x6"

app.command("budget")(budget_of_session)
app.command("calibrate")(calibrate_session)
app.command("apply")(apply_model)
app.command("export")(export_model)
app.command("validate")(validate_session)


@app.command("detect")
def detect_images(
    sources: Annotated[list[Path], typer.Argument(metavar="SESSION|IMAGE...", help="Sessions and image files.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="The CSV file to write.")],
    target: TargetOption = None,
    max_megapixels: MegapixelsOption = GREATEST_MEGAPIXELS,
    incomplete: Incomplete = False,
) -> None:
    """Find the target's markers: a CSV row per marker and image, with covariance and flags.

    x_px, y_px is the centre of the marker's outline in the image; disc_x_px, disc_y_px the image of the disc's centre,
    by the homography of the target: use it for positions in space, or where the target is tilted.

    Example: compensate detect photos/*.png --target robot-cal-tools-10x10 -o markers.csv
    """
    with one_line_errors(), images_up_to(max_megapixels):
        check_writable(out)
        opened = [_open(path, incomplete) for path in sources]
        chosen = _detection_target(opened, target)
        failures: list[str] = []
        with late_progress("find markers", sum(_count(source) for source in opened)) as report:
            write_detections(out, chosen, _detections(opened, chosen, failures, report))
        typer.echo(CENTRES)
        for failure in failures:
            typer.echo(f"not found in {one_line(failure)}", err=True)


@app.command()
def fit(
    sessions: Sessions,
    out: Annotated[Path, typer.Option("--out", "-o", help="The model file (JSON) to write.")],
    form: FormOption = None,
    degree: DegreeOption = None,
    target: TargetOption = None,
    workers: Workers = 1,
    cluster: Cluster = None,
    cache: Cache = True,
    across_gap: AcrossGap = False,
    incomplete: Incomplete = False,
) -> None:
    """Fit the drift model to the reference, fit and warm-up frames of sessions of one camera.

    Example: compensate fit sessions/20260101T180000Z-thermal-cycle -o model.json
    """
    with one_line_errors():
        check_request(degree, form)
        check_writable(out)
        found_by = finder(workers, cluster, use_cache=cache)
        observations = observe_sessions(
            sessions,
            progress,
            named_target(target),
            found_by,
            across_gap=across_gap,
            incomplete=said_if(incomplete),
        )
        model = fit_model(observations, degree, form)
        evaluation = evaluate(model, observations)
        save_model(model, out)
        typer.echo(f"{model.form}: {model.title}")
        typer.echo(table(evaluation))


@app.command()
def report(
    sessions: Sessions,
    out: Annotated[Path, typer.Option("--out", "-o", help="The HTML file to write.")],
    model: Annotated[Path | None, typer.Option(help="Score this model; else one is fitted to the sessions.")] = None,
    budget: Annotated[
        str | None, typer.Option(help="With the stand's budget, by its geometry: a file, or the installed `paper`.")
    ] = None,
    validation: Annotated[
        Path | None, typer.Option(help="With the result of `compensate validate`: the JSON file beside its page.")
    ] = None,
    target: TargetOption = None,
    workers: Workers = 1,
    cluster: Cluster = None,
    cache: Cache = True,
    across_gap: AcrossGap = False,
    incomplete: Incomplete = False,
) -> None:
    """Write the report of sessions of one camera: drift, model, and what it gains at held-out temperatures.

    Its numbers are in a JSON file of the same name beside it. Sessions without a thermal cycle have their drift alone.

    Example: compensate report sessions/20260101T180000Z-thermal-cycle --model model.json -o report.html
    """
    with one_line_errors():
        check_report_writable(out, model, validation)
        found_by = finder(workers, cluster, use_cache=cache)
        given = None if model is None else load_model(model)
        wanted = named_target(target)
        extras = Extras(
            budgets={} if budget is None else budgets_of_sessions(sessions, budget, wanted),
            positions=table_positions([Session.open(path).steps() for path in sessions]),
            validation=None if validation is None else load_validation(validation),
        )
        observations = observe_sessions(
            sessions, progress, wanted, found_by, across_gap=across_gap, incomplete=said_if(incomplete)
        )
        has_cycle = can_be_fitted(observations)
        used = fit_model(observations) if given is None and has_cycle else given
        evaluation = None if used is None or not has_cycle else evaluate(used, observations)
        write_report(out, observations, used, evaluation, extras)
        typer.echo("no thermal cycle: no model, drift alone" if evaluation is None else table(evaluation))


def _open(path: Path, incomplete: bool) -> Session | Path:
    """A folder is a session, a file is an image."""
    if path.is_dir():
        return open_whole(path, said_if(incomplete))
    if not path.exists():
        raise ConfigError(f"{path}: no such file or folder")
    return path


def _detection_target(sources: Sequence[Session | Path], name: str | None) -> Target:
    """The named target, else the one attached to all the sessions, else the paper's; one table has one target."""
    if name is not None:
        return installed_target(name)
    attached = [session_target(source) for source in sources if isinstance(source, Session)]
    if any(target != attached[0] for target in attached):
        raise ConfigError("the sessions have different targets; write a table for each")
    return attached[0] if attached else installed_target(_DEFAULT_TARGET)


def _count(source: Session | Path) -> int:
    return source.frame_count if isinstance(source, Session) else 1


def _detections(
    sources: Sequence[Session | Path], target: Target, failures: list[str], report: Report
) -> Iterator[DetectedImage]:
    """Every image in turn; where the target is not found all its markers are missing, and `failures` grows by a line.

    DetectionError when it is found nowhere.
    """
    several = len(sources) > 1
    images = 0
    for source in sources:
        previous: Detection | None = None
        for name, time_ns, image in _images(source, several):
            watch = partial(_report_part, report, images, name)
            images += 1
            try:
                # Photographs need not be of one pose: only frames of a session are tracked.
                found = detect(image, target, previous, watch=watch)
                previous = found if isinstance(source, Session) else None
            except DetectionError as error:
                failures.append(f"{name}: {error}")
                found = nothing_found(target)
            report(images, name)
            yield DetectedImage(name, time_ns, found)
    if len(failures) == images:
        raise DetectionError(f"{failures[0] if failures else 'there are no images'}")


def _report_part(report: Report, done: int, name: str, part: float) -> None:
    """Part of one image, behind those before it."""
    report(done + part, name)


def _images(source: Session | Path, several: bool) -> Iterator[tuple[str, int | None, Image]]:
    """Name (escaped), time and pixels of each image of a source."""
    if not isinstance(source, Session):
        yield one_line(source.name), None, read_image(source)
        return
    prefix = f"{one_line(source.path.name)}/" if several else ""
    for index, frame in enumerate(read_frames(source)):
        yield f"{prefix}{index}", frame.time_ns, frame.image


if __name__ == "__main__":
    sys.exit(app())
