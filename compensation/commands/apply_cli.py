"""`compensate apply` and `compensate export`: a drift model put to use."""

from __future__ import annotations

import csv
import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from thermostand.compensation.apply.image_correction import (
    ImageFormat,
    compute_middle_flags,
    correct_image,
    write_image,
)
from thermostand.compensation.apply.runtime_export import export_c, export_ros2, export_runtime
from thermostand.compensation.camera_selection import (
    find_camera_name,
    list_camera_frames,
    read_frame_temperatures,
    select_camera,
)
from thermostand.compensation.commands.options import CameraName, Incomplete, open_session
from thermostand.compensation.drift.drift_model import DriftModel, Outside
from thermostand.compensation.drift.model_file import load_model
from thermostand.compensation.drift.paper_model import PaperModel
from thermostand.compensation.history.thermal_history import Float, States, compute_states_at, read_history
from thermostand.compensation.spreadsheet import Spreadsheet, read_spreadsheet
from thermostand.experiments.steps import Role
from thermostand.foundation.command_app import App
from thermostand.foundation.errors import ConfigError, SessionError
from thermostand.foundation.files import check_writable, open_atomic
from thermostand.foundation.instants import parse_instant
from thermostand.foundation.output import say, show
from thermostand.foundation.progress import progress
from thermostand.markers.image_file import read_image
from thermostand.recording.reading.session import Session

X, Y, TIME, CAMERA = "x_px", "y_px", "time_ns", "camera_degC"
ADDED = ("x_reference_px", "y_reference_px", "var_x_correction_px2", "cov_xy_correction_px2", "var_y_correction_px2",
         "outside")  # fmt: skip


def read_points(path: Path) -> Spreadsheet:
    """A table with columns x_px and y_px, such as `compensate detect` writes; SessionError when it has none, or a row
    that does not fit."""
    table = read_spreadsheet(path)
    table.require((X, Y), f"it needs {X} and {Y}, as compensate detect writes them")
    taken = [name for name in ADDED if table.has(name)]
    if taken:
        raise SessionError(f"{path}: has a column {taken[0]} already; these points have been corrected")
    return table


def parse_times(table: Spreadsheet) -> list[int]:
    """(M,): the instants, ns; SessionError when a row has none."""
    if not table.has(TIME):
        raise ConfigError(f"{table.path}: has no column {TIME}; --session needs the instant of every point")
    for row, text in enumerate(table.column(TIME)):
        if not text:
            raise table.fault(row, f"{TIME} is empty; --session needs the instant of every point")
    return table.whole_numbers(TIME, 2**63 - 1).tolist()


def write_corrected(path: Path, table: Spreadsheet, xy_px: Float, model: DriftModel, states: States) -> None:
    """The table with columns added: the corrected place, the covariance of the correction, and why it is an
    extrapolation (names of Outside joined by `|`, empty inside the calibrated range). nan where it is unknown.

    The file appears when it is complete; SessionError when the place refuses.
    """
    corrected, covariance = model.correct(xy_px, states), model.covariance(xy_px, states)
    flags = model.flags(xy_px, states)
    with open_atomic(path) as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow([*table.names, *ADDED])
        for index, row in enumerate(zip(*table.cells, strict=True)):
            writer.writerow([*row, *_format_added_cells(corrected[index], covariance[index], int(flags[index]))])


def _format_added_cells(place_px: Float, covariance_px2: Float, flags: int) -> Iterator[str]:
    yield from (f"{value:.6f}" for value in place_px)
    yield from (f"{value:.6e}" for value in (covariance_px2[0, 0], covariance_px2[0, 1], covariance_px2[1, 1]))
    yield format_outside(flags)


def format_outside(flags: int) -> str:
    """The names of the flags joined by `|`, empty when there is none."""
    return "|".join(flag.name or "" for flag in Outside(flags))


app = App()

ModelArgument = Annotated[Path, typer.Argument(metavar="MODEL", help="A model file, as compensate fit writes it.")]
TemperatureOption = Annotated[
    float | None, typer.Option("--camera-degC", help="The camera's own temperature, where it was not recorded.")
]
INDEX_COLUMNS = ("image", "frame", "time_ns", "camera_degC", "outside")


@app.command("apply")
def apply_model(
    model: ModelArgument,
    source: Annotated[Path, typer.Argument(metavar="POINTS.csv|IMAGE|SESSION", help="What is to be corrected.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="The file to write; for a session a new folder.")],
    *,
    session: Annotated[
        Path | None, typer.Option(help="For points with time_ns, or an image: the session that recorded the camera.")
    ] = None,
    time: Annotated[
        str | None, typer.Option(help="For an image: when it was taken, local time (2026-01-01T18:00:00) or time_ns.")
    ] = None,
    camera_degC: TemperatureOption = None,
    frames: Annotated[
        str | None,
        typer.Option(metavar="FIRST:END", help="For a session: only these frames, counted from 0, without END."),
    ] = None,
    form: Annotated[
        ImageFormat, typer.Option("--format", help="For images: tiff is float32, png rounded to the original's bits.")
    ] = "tiff",
    camera: CameraName = None,
    incomplete: Incomplete = False,
) -> None:
    """Put points or images where they would have been at the reference temperature.

    A table gets columns: corrected place, covariance of the correction, and why it is an extrapolation, if it is. For
    measurement correct points; images are for software that wants pixels. Of a session of several cameras it is the
    model's own, or --camera.

    Example: compensate apply model.json markers.csv --session sessions/20260101T180000Z-thermal-cycle -o corrected.csv
    """
    used = load_model(model)
    if source.is_dir():
        own = "a session has temperatures of its own"
        _refuse(("--session", session), ("--camera-degC", camera_degC), ("--time", time), why=own)
        _correct_session(used, _open_session(source, used, camera, incomplete), out, frames, form)
    elif source.suffix.lower() == ".csv":
        _refuse(("--frames", frames), why="it selects frames of a session")
        _refuse(("--time", time), why="the points have a column time_ns")
        check_writable(out)
        recorded = None if session is None else _open_session(session, used, camera, incomplete)
        used = _correct_points(used, source, out, recorded, camera_degC)
    else:
        _refuse(("--frames", frames), why="it selects frames of a session")
        recorded = None if session is None else _open_session(session, used, camera, incomplete)
        used, states = _select_image_state(used, source, recorded, time, camera_degC)
        check_writable(out)
        image = read_image(source)
        write_image(out, correct_image(image, used, states), form, image.dtype)
        _warn(compute_middle_flags(used, states))
    show({"out": out, "form": used.form}, ())


def _open_session(path: Path, model: DriftModel, camera: str | None, incomplete: bool) -> Session:
    session = open_session(path, camera, incomplete)
    if camera is None:
        select_camera(session, find_camera_name(session, model.facts.camera_serial))
    _offer_rereference(model, session)
    return session


# Not done by itself: it would take out a shift of the target that somebody wants to see, and gains 0.3 to 1.2 mpx where
# nothing was moved.
def _offer_rereference(model: DriftModel, session: Session) -> None:
    """Print a hint where the model is of other sessions, and this one has reference frames that would take out what
    differs between them."""
    if model.form != "thermal" or session.metadata.get("session_id") in model.facts.session_ids:
        return
    if any(mark.parameters.get("role") == str(Role.REFERENCE) for mark in session.steps()):
        say(
            "the model was fitted to other sessions, and this one has reference frames of its own: "
            "`compensate rereference` makes a model of them that leaves less here"
        )


def _select_image_state(
    model: DriftModel, source: Path, session: Session | None, time: str | None, camera_degC: float | None
) -> tuple[DriftModel, States]:
    """The form for one image, and the thermal state it was taken in."""
    if session is None:
        _refuse(("--time", time), why="it is an instant of a session; give --session as well")
        if camera_degC is None:
            raise ConfigError(f"{source}: give the camera's temperature with --camera-degC, or --session and --time")
        used = _select_temperature_form(model)
        return used, States.at_degC(camera_degC, 1, used.memory)
    _refuse(("--camera-degC", camera_degC), why="the session has it")
    if time is None:
        raise ConfigError(f"{source}: say with --time when this image was taken in the session")
    states = _read_recorded_states(model, session, [_parse_instant_ns(time, session)])
    if np.isnan(model.shift(np.zeros((1, 2)), states)).all():
        raise SessionError(f"{source}: {session.path} does not tell the camera's state at {time}")
    return model, states


def _parse_instant_ns(text: str, session: Session) -> int:
    """time_ns as it is; else a time as people write it, local when it names no zone, by the session's clock."""
    if text.isdecimal():
        return int(text)
    begin_ns = min((step.time_ns for step in session.steps()), default=0)
    try:
        return parse_instant(text, begin_ns, session.utc.stand_ns)
    except ConfigError as error:
        raise ConfigError(f"--time {text}: give time_ns, or a time such as 2026-01-01T18:00:00") from error


@app.command("export")
def export_model(
    model: ModelArgument,
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", help="A folder for drift.json and drift_runtime.py, which needs numpy."),
    ] = None,
    c: Annotated[
        Path | None, typer.Option("--c", metavar="FILE.h", help="A C99 header; the names in it begin with the file's.")
    ] = None,
    ros2: Annotated[
        Path | None, typer.Option("--ros2", metavar="FOLDER", help="A ROS 2 package with a node, for colcon.")
    ] = None,
) -> None:
    """Write the model for other programs: a Python module that needs numpy only, a C99 header, a ROS 2 package.

    Example: compensate export model.json -o runtime --c drift.h
    """
    if out is None and c is None and ros2 is None:
        raise ConfigError("nothing to write: give -o FOLDER for Python, --c FILE.h for C, --ros2 FOLDER for ROS 2")
    used = load_model(model)
    written = [] if out is None else [*export_runtime(used, out)]
    written += [] if c is None else [export_c(used, c)]
    written += [] if ros2 is None else [*export_ros2(used, ros2)]
    show(written, written)


def _refuse(*options: tuple[str, object], why: str) -> None:
    given = [name for name, value in options if value is not None]
    if given:
        raise ConfigError(f"{given[0]} does not belong here: {why}")


def _correct_points(
    model: DriftModel, source: Path, out: Path, session: Session | None, camera_degC: float | None
) -> DriftModel:
    """The form that it was done with."""
    table = read_points(source)
    xy_px = np.column_stack([table.numbers(X), table.numbers(Y)])
    if session is not None:
        _refuse(("--camera-degC", camera_degC), why="the session has it")
        states = _read_recorded_states(model, session, parse_times(table))
        model = model.of_sessions([session.metadata.get("session_id", "")])
    elif camera_degC is not None or table.has(CAMERA):
        model = _select_temperature_form(model)
        degC = table.numbers(CAMERA) if camera_degC is None else camera_degC
        states = States.at_degC(degC, len(xy_px), model.memory)
    else:
        raise ConfigError(f"{source}: has no column {CAMERA}; give --session, or --camera-degC")
    _check_known(model, xy_px, states)
    write_corrected(out, table, xy_px, model, states)
    outside = int((model.flags(xy_px, states) != 0).sum())
    if outside:
        say(f"warning: {outside} of {len(xy_px)} points are outside the model's valid range")
    return model


def _select_temperature_form(model: DriftModel) -> DriftModel:
    """The form of the model that needs the camera's temperature only, with a message when it is not the one in use;
    ConfigError when the file has none."""
    if isinstance(model, PaperModel):
        return model
    if not isinstance(model.other, PaperModel):
        raise ConfigError(
            f"a model of the form {model.form} needs the thermal state, which is not known here; give --session"
        )
    left, usual = (" and ".join(f"{px:z.3f}" for px in one.discrepancy_px) for one in (model.other, model))
    say(
        f"the camera's temperature alone: corrected with the paper's form of the model ({model.other.title}), which "
        f"leaves {left} px along x and y beyond the markers' noise, at set-points left out of its fit; with the "
        f"history of a session (--session) the thermal form leaves {usual} px"
    )
    return model.other


def _read_recorded_states(model: DriftModel, session: Session, time_ns: Sequence[int]) -> States:
    """The thermal state at each instant, of which the same may come many times and in any order."""
    say(f"corrected with the {model.form} form of the model ({model.title}), by what {session.path.name} recorded")
    recorded_degC = read_frame_temperatures(session)
    instants, where = np.unique(np.array(time_ns, np.int64), return_inverse=True)
    camera_degC = np.array([recorded_degC.get(instant, math.nan) for instant in instants.tolist()])
    return compute_states_at(read_history(session), model.memory, instants, camera_degC).where(where)


def _check_known(model: DriftModel, xy_px: np.ndarray[tuple[int, ...], np.dtype[np.float64]], states: States) -> None:
    known = np.isfinite(xy_px).all(axis=1)
    if known.any() and np.isnan(model.shift(xy_px, states)[known]).all():
        raise ConfigError(
            f"a model of the form {model.form} needs the thermal state, which is not known here; give --session"
        )


def _correct_session(model: DriftModel, session: Session, out: Path, frames: str | None, form: ImageFormat) -> None:
    own = list_camera_frames(session)
    selected = [own[index] for index in _parse_frame_range(frames, len(own))]
    states = _read_recorded_states(model, session, session.frame_times_ns[selected].tolist())
    try:
        out.mkdir()
    except OSError as error:
        raise SessionError(f"{out}: cannot be made ({error.strerror}); images go into a new folder") from error
    with progress("correct images", len(selected)) as report, open_atomic(out / "images.csv") as index:
        writer = csv.writer(index, lineterminator="\n")
        writer.writerow(INDEX_COLUMNS)
        for done, number in enumerate(selected):
            frame, state = session.frame(number), states.where(np.array([done]))
            name = f"{number:06d}.{form}"
            write_image(out / name, correct_image(frame.image, model, state), form, frame.image.dtype)
            outside = format_outside(compute_middle_flags(model, state))
            writer.writerow((name, number, frame.time_ns, f"{frame.camera_degC:z.3f}", outside))
            report(done + 1, name)


def _parse_frame_range(frames: str | None, count: int) -> range:
    """ConfigError when the text is no FIRST:END within the session."""
    if frames is None:
        return range(count)
    first, colon, end = frames.partition(":")
    numbers_given = all(text.isdecimal() or not text for text in (first, end))
    if not colon or not numbers_given:
        raise ConfigError(f"--frames {frames}: give FIRST:END, such as 0:10")
    selected = range(int(first or 0), int(end or count))
    if not selected or selected.stop > count:
        raise ConfigError(f"--frames {frames}: the session has {count} frames of the camera, counted from 0")
    return selected


def _warn(flags: int) -> None:
    if flags:
        say(f"warning: outside the model's valid range ({format_outside(flags)})")
