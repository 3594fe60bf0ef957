"""The report of a compensation: one HTML file that needs nothing else, and the whole way there in one call."""

from __future__ import annotations

import importlib.metadata
from collections.abc import Iterator, Sequence
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from compensation.drift.choosing import fit
from compensation.drift.drift_model import DriftModel
from compensation.drift.model_file import save_model
from compensation.drift.paper_model import PaperModel
from compensation.drift.validation import (
    PAPER_AFTER_PX,
    PAPER_BEFORE_PX,
    Evaluation,
    evaluate,
    improvement_percent,
)
from compensation.files import check_writable, write_whole
from compensation.markers.detection import Flag
from compensation.observations import Mask, Observations, Progress, Role, observe_sessions
from compensation.report import figures
from compensation.report.page import facts, figure, heading, page, paragraph, table

_LISTED_FRAMES = 20
_LEAST_COVERAGE = 0.9
_LIBRARIES = ("thermostand", "numpy", "opencv-python-headless", "matplotlib")
_CYCLE = (Role.REFERENCE, Role.FIT, Role.VALIDATION)


def analyse(session_paths: Sequence[Path], model_path: Path, report_path: Path, progress: Progress) -> Evaluation:
    """Sessions in; model and report out, each file whole or not there; the markers are looked for once.

    `progress` is stand.progress.progress or alike. Raises SessionError or ConfigError with a sentence.
    """
    for path in (model_path, report_path):
        check_writable(path)
    observations = observe_sessions(session_paths, progress)
    with progress("fit and report", 3) as report:
        report(0, "choosing the form")
        model = fit(observations)
        report(1, "scoring")
        evaluation = evaluate(model, observations)
        report(2, "drawing")
        text = report_page(observations, model, evaluation)
        save_model(model, model_path)
        write_whole(report_path, text)
        report(3, "written")
    return evaluation


def write_report(path: Path, observations: Observations, model: DriftModel, evaluation: Evaluation) -> None:
    """Write the page, whole or not at all; SessionError when the place refuses."""
    write_whole(path, report_page(observations, model, evaluation))


def report_page(observations: Observations, model: DriftModel, evaluation: Evaluation) -> str:
    """The report as HTML text; the same data give the same text."""
    title = f"Thermal compensation of camera {model.camera_serial}"
    parts = [
        heading(title, 1),
        paragraph(_lead(observations), aside=True),
        heading("Result"),
        _result(evaluation),
        *_figures(observations, evaluation),
        heading("Model"),
        _model(model),
        heading("Recorded data"),
        _data(observations),
        _unusable(observations),
        paragraph(_versions(), aside=True),
    ]
    return page(title, [part for part in parts if part])


def _lead(observations: Observations) -> str:
    recipes = ", ".join(dict.fromkeys(session.recipe for session in observations.sessions))
    times = observations.time_ns
    text = f"Recipe {recipes}, recorded {_utc(int(times.min()))} to {_utc(int(times.max()))}, {len(times)} frames."
    if observations.simulated:
        text += " Recorded in a simulated laboratory."
    return text


def _result(evaluation: Evaluation) -> str:
    rows = [
        ("paper (measured)", *_gains(PAPER_BEFORE_PX, PAPER_AFTER_PX)),
        (
            "this report (simulated)" if evaluation.simulated else "this report",
            *_gains(evaluation.rms_before_px, evaluation.rms_after_px),
        ),
    ]
    heads = ("RMS deviation, px", "I before", "I after", "gain", "J before", "J after", "gain")
    i, j = evaluation.coverage_95
    note = (
        f"{evaluation.frames} frames; {evaluation.method}. The deviation is the distance of a marker centre from its "
        f"place at the reference temperature. Of the deviations after compensation, {100 * i:.0f} % (I) and "
        f"{100 * j:.0f} % (J) lie in the 95 % interval that the model claims."
    )
    if min(evaluation.coverage_95) < _LEAST_COVERAGE:
        note += (
            " That is too few: at the held-out temperatures the camera did something that the fitted frames do not "
            "show. Most often its drift depends on the way there (thermal lag, hysteresis) and not on its temperature "
            "alone."
        )
    if evaluation.outside.any():
        note += f" {evaluation.outside.mean():.1%} of the centres are outside the model's valid range."
    paper = (
        "Paper: Adamczyk et al., Temperature Compensation Method for Digital Cameras in 2D and 3D Measurement "
        "Applications, Sensors 2018, 18, 3685, section 6.2, polynomial of degree 4."
    )
    return "\n".join([table(heads, rows), paragraph(note), paragraph(paper, aside=True)])


def _gains(before: tuple[float, float], after: tuple[float, float]) -> Iterator[str]:
    for b, a in zip(before, after, strict=True):
        yield from (f"{b:.3f}", f"{a:.3f}", f"{improvement_percent(b, a):.0f} %")


def _figures(observations: Observations, evaluation: Evaluation) -> Iterator[str]:
    cycle, warm_up = observations.of(*_CYCLE), observations.of(Role.WARM_UP)
    yield heading("Drift")
    if cycle.any():
        yield figure(
            figures.as_svg(figures.trajectories(observations, cycle), "trajectories"),
            "Drift of each marker over the thermal cycle, enlarged 100 times from its place at the reference "
            "temperature, on the first frame. Colour is the camera's own temperature.",
        )
    if warm_up.any():
        yield figure(
            figures.as_svg(figures.trajectories(observations, warm_up), "warm-up"),
            "The same while the camera warms itself after it was switched on; not used for the fit.",
        )
    yield figure(
        figures.as_svg(figures.against_time(observations), "time"),
        "Mean drift of the markers and the temperatures at each frame. The warm-up has a yellow ground.",
    )
    yield heading("Before and after compensation")
    yield figure(
        figures.as_svg(figures.histogram(evaluation), "histogram"),
        f"Deviations of marker centres from their reference; {evaluation.method}.",
    )
    yield figure(
        figures.as_svg(figures.against_temperature(evaluation), "temperature"),
        f"RMS deviation at each chamber temperature; {evaluation.method}.",
    )
    yield table(
        ("chamber, °C", "camera, °C", "frames", "I before, px", "I after", "J before", "J after"),
        [
            (
                f"{row.chamber_degC:g}",
                f"{row.camera_degC:.2f}",
                str(row.frames),
                *(f"{value:.3f}" for pair in zip(row.before_px, row.after_px, strict=True) for value in pair),
            )
            for row in evaluation.temperatures
        ],
    )


def _model(model: DriftModel) -> str:
    low, high = model.camera_range_degC
    (left, top), (right, bottom) = model.hull_px.min(axis=0), model.hull_px.max(axis=0)
    s_i, s_j = 1000 * model.discrepancy_px
    lines = [
        *_form(model),
        (
            "Reference",
            f"camera {model.reference_degC:.2f} °C, chamber {model.reference_chamber_degC:g} °C, "
            f"target {model.target_name}",
        ),
        (
            "Valid for",
            f"camera {low:.2f} to {high:.2f} °C; I {left:.0f} to {right:.0f} px, J {top:.0f} to {bottom:.0f} px",
        ),
        (
            "Left unexplained",
            f"{s_i:.1f} (I) and {s_j:.1f} (J) mpx, one standard deviation, at temperatures left out of the fit",
        ),
        ("Fitted to", ", ".join(model.session_ids)),
    ]
    return "\n".join([facts(lines), *_choice(model)])


def _form(model: DriftModel) -> list[tuple[str, str]]:
    if not isinstance(model, PaperModel):
        return [("Form", f"displacement to the reference = {model.title}")]
    polynomial = (
        "displacement to the reference = P(I, J, T), one polynomial per coordinate; T is the camera's temperature"
    )
    terms = f"{model.degree}, {model.score.terms} terms per coordinate, condition {model.score.condition:.0f}"
    return [("Form", polynomial), ("Degree", terms)]


def _choice(model: DriftModel) -> Iterator[str]:
    """What was tried: the degrees of the paper's form, and every form where there was more than one."""
    yield paragraph(
        "Leave-temperatures-out: each chamber set-point with all its visits is predicted from the others. In use is "
        "the simplest degree within one standard error of the best, or the one asked for.",
        aside=True,
    )
    if isinstance(model, PaperModel):
        rows = [
            (f"{score.degree}", f"{score.terms}", f"{score.condition:.0f}", *(f"{value:.4f}" for value in score.rms_px))
            for score in model.scores
        ]
        heads = ("degree", "terms", "condition", "RMS I, px", "RMS J, px")
        yield table(heads, rows, chosen=model.degree - 1)
    if any(one.form != "paper" for one in model.candidates):
        rows = [
            (
                one.name,
                f"{one.terms}",
                *(f"{value:.4f}" for value in one.rms_px),
                "" if one.bic is None else f"{one.bic:.0f}",
            )
            for one in model.candidates
        ]
        chosen = next((index for index, one in enumerate(model.candidates) if one.chosen), None)
        yield table(("form", "coefficients", "RMS I, px", "RMS J, px", "BIC"), rows, chosen=chosen)


def _data(observations: Observations) -> str:
    tables: list[str] = []
    for index, session in enumerate(observations.sessions):
        own = observations.session == index
        times, camera = observations.time_ns[own], observations.camera_degC[own & observations.usable]
        set_points = observations.chamber_degC[own]
        set_points = np.unique(set_points[np.isfinite(set_points)])
        lines = [
            ("Session", f"{session.session_id} (recipe {session.recipe}, operator {session.operator or 'not named'})"),
            ("Camera", f"{session.camera_serial}, {observations.image_size[0]} x {observations.image_size[1]} px"),
            ("Recorded", f"{_utc(int(times[0]))} to {_utc(int(times[-1]))} by thermostand {session.software_version}"),
            ("Frames", _frames_by_role(observations, own)),
            ("Chamber", ", ".join(f"{value:g}" for value in set_points) + " °C"),
            ("Camera's temperature", f"{camera.min():.2f} to {camera.max():.2f} °C"),
            ("Markers", _markers(observations, own)),
        ]
        if session.incomplete:
            lines.append(("Not read", f"{session.incomplete} segments that were not finished"))
        tables.append(facts(lines))
    return "\n".join(tables)


def _frames_by_role(observations: Observations, own: Mask) -> str:
    counts = [(role, int((own & (observations.role == str(role))).sum())) for role in Role]
    listed = ", ".join(f"{count} {role.replace('_', '-')}" for role, count in counts if count)
    unusable = int((own & ~observations.usable).sum())
    return f"{own.sum()} ({listed})" + (f"; {unusable} of them cannot be used" if unusable else "")


def _markers(observations: Observations, own: Mask) -> str:
    """How many centres there are, and how many were set aside and why."""
    flags = observations.flags[own & observations.usable]
    text = f"{observations.target.name}, {flags.size} centres in usable frames, {np.count_nonzero(flags)} set aside"
    reasons = [(flag, int(((flags & flag) != 0).sum())) for flag in Flag]
    listed = ", ".join(f"{count} {(flag.name or '').lower().replace('_', ' ')}" for flag, count in reasons if count)
    return text + (f" ({listed})" if listed else "")


def _unusable(observations: Observations) -> str:
    """The frames that were left out, with their reasons; "" when there are none."""
    rows = [
        (f"{observations.sessions[observations.session[index]].session_id}, frame {observations.frame[index]}", reason)
        for index, reason in enumerate(observations.reasons)
        if reason
    ]
    if not rows:
        return ""
    if len(rows) > _LISTED_FRAMES:
        rows = [*rows[:_LISTED_FRAMES], (f"and {len(rows) - _LISTED_FRAMES} more", "")]
    return heading("Frames left out") + facts(rows)


def _utc(time_ns: int) -> str:
    return datetime.fromtimestamp(time_ns / 1e9, UTC).strftime("%Y-%m-%d %H:%M UTC")


def _versions() -> str:
    return "Made by " + ", ".join(f"{name} {importlib.metadata.version(name)}" for name in _LIBRARIES) + "."
