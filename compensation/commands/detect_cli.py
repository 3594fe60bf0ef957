"""`compensate detect`: the markers of recorded sessions and of photographs, as a table."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from thermostand.compensation.commands.options import (
    Incomplete,
    MegapixelsOption,
    TargetOption,
    load_target_by_name,
    make_warning_sink,
    report_marker_search,
    say_left_out,
)
from thermostand.compensation.observations import read_frames, read_session_target
from thermostand.foundation.command_app import App
from thermostand.foundation.errors import ConfigError
from thermostand.foundation.files import check_writable
from thermostand.foundation.image_limit import GREATEST_MEGAPIXELS, allow_images_up_to
from thermostand.foundation.output import show
from thermostand.foundation.progress import Report
from thermostand.foundation.usage import escape_line
from thermostand.markers.detection import Detection, DetectionError, Image, detect, make_empty_detection
from thermostand.markers.detections_table import CENTRES, DetectedImage, write_detections
from thermostand.markers.image_file import read_image
from thermostand.markers.target import Target
from thermostand.recording.reading.session import Session, open_whole

app = App()

_DEFAULT_TARGET = "paper-9x6"


@app.command("detect")
def detect_images(
    sources: Annotated[list[Path], typer.Argument(metavar="SESSION|IMAGE...", help="Sessions and image files.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="The CSV file to write.")],
    target: TargetOption = None,
    max_megapixels: MegapixelsOption = GREATEST_MEGAPIXELS,
    incomplete: Incomplete = False,
) -> None:
    """Find the target's markers: a CSV row per marker and image, with covariance and flags.

    x_px, y_px is the centre of the marker's outline in the image, which is what the drift model and a calibration take;
    disc_x_px, disc_y_px is the image of the disc's own centre: use it for positions in space by other programs.

    Example: compensate detect photos/*.png --target robot-cal-tools-10x10 -o markers.csv
    """
    with allow_images_up_to(max_megapixels):
        check_writable(out)
        opened = [_open(path, incomplete) for path in sources]
        chosen = _select_target(opened, target)
        failures: list[str] = []
        suspect: list[str] = []
        with report_marker_search(sum(_count(source) for source in opened), is_quick=True) as report:
            write_detections(out, chosen, _detect_all(opened, chosen, failures, suspect, report))
        shown = {"table": out, "target": chosen.name, "not_found": failures, "suspect": suspect}
        show(shown, [CENTRES, chosen.orientation])
        say_left_out("not found in", failures, suspect)


def _open(path: Path, incomplete: bool) -> Session | Path:
    """A folder is a session, a file is an image."""
    if path.is_dir():
        return open_whole(path, make_warning_sink(incomplete))
    if not path.exists():
        raise ConfigError(f"{path}: no such file or folder")
    return path


def _select_target(sources: Sequence[Session | Path], name: str | None) -> Target:
    """The named target, else the one attached to all the sessions, else the paper's; one table has one target."""
    if name is not None:
        return load_target_by_name(name)
    attached = [read_session_target(source) for source in sources if isinstance(source, Session)]
    if any(target != attached[0] for target in attached):
        raise ConfigError("the sessions have different targets; write a table for each")
    return attached[0] if attached else load_target_by_name(_DEFAULT_TARGET)


def _count(source: Session | Path) -> int:
    return source.frame_count if isinstance(source, Session) else 1


def _detect_all(
    sources: Sequence[Session | Path], target: Target, failures: list[str], suspect: list[str], report: Report
) -> Iterator[DetectedImage]:
    """Every image in turn; where the target is not found all its markers are missing, and `failures` grows by a line;
    `suspect` by the names of those that noise does not describe.

    DetectionError when it is found nowhere.
    """
    several = len(sources) > 1
    images = 0
    for source in sources:
        previous: Detection | None = None
        for name, time_ns, image in _iterate_images(source, several):
            images += 1
            try:
                # Photographs need not be of one pose: only frames of a session are tracked.
                found = detect(image, target, previous, watch=partial(_report_part, report, images - 1, name))
                previous = found if isinstance(source, Session) else None
            except DetectionError as error:
                failures.append(f"{name}: {error}")
                found = make_empty_detection(target)
            if found.is_suspect:
                suspect.append(name)
            report(images, name)
            yield DetectedImage(name, time_ns, found)
    if len(failures) == images:
        raise DetectionError(f"{failures[0] if failures else 'there are no images'}")


def _report_part(report: Report, done: int, name: str, part: float) -> None:
    """Part of one image, behind those before it."""
    report(done + part, name)


def _iterate_images(source: Session | Path, several: bool) -> Iterator[tuple[str, int | None, Image]]:
    """Name (escaped), time and pixels of each image of a source."""
    if not isinstance(source, Session):
        yield escape_line(source.name), None, read_image(source)
        return
    prefix = f"{escape_line(source.path.name)}/" if several else ""
    for index, frame in enumerate(read_frames(source)):
        yield f"{prefix}{index}", frame.time_ns, frame.image
