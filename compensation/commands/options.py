"""What the commands of `compensate` share: their options, and the sessions, targets and markers these name."""

from __future__ import annotations

import importlib.resources
from collections.abc import Generator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from thermostand.compensation.array_observations import load_observations
from thermostand.compensation.camera_selection import select_camera
from thermostand.compensation.finding.finder import finder
from thermostand.compensation.observations import Observations, observe
from thermostand.compensation.spreadsheet import is_spreadsheet
from thermostand.foundation.errors import ConfigError
from thermostand.foundation.output import say
from thermostand.foundation.progress import Report, progress, show_late_progress
from thermostand.markers.corner_board import BoardOfCorners, load_corner_board
from thermostand.markers.detections_table import format_noise_warning
from thermostand.markers.target import Target, load_target
from thermostand.recording.reading.session import Say, Session, open_whole

TargetOption = Annotated[
    str | None, typer.Option("--target", help="A target file or an installed name; else the session's own.")
]
CameraName = Annotated[
    str | None,
    typer.Option("--camera", help="The camera to use in sessions of several, by its name in the stand's file."),
]
DetailsOption = Annotated[
    Path | None,
    typer.Option(help="A file that states what no recording knows: lens, certificates, places of sensors, u_air_K."),
]
MegapixelsOption = Annotated[
    float, typer.Option("--max-megapixels", min=0.001, max=2000.0, help="Larger images are refused, unread.")
]
Incomplete = Annotated[bool, typer.Option("--incomplete", help="Use a session although part of it is missing.")]


@dataclass(frozen=True, slots=True)
class MarkerSearch:
    """How a command finds the markers of the sessions it is given."""

    target: TargetOption = None
    workers: Annotated[int, typer.Option("--workers", help="Processes that look for markers, side by side.")] = 1
    cluster: Annotated[
        str | None, typer.Option("--cluster", help="A Dask scheduler, host:port, whose workers see the same files.")
    ] = None
    cache: Annotated[bool, typer.Option("--cache/--no-cache", help="Keep the markers found, and reuse those kept.")] = (
        True
    )
    across_gap: Annotated[
        bool,
        typer.Option(
            "--across-gap",
            help="Use frames from before and after a gap together, though camera minus air has changed in it.",
        ),
    ] = False
    incomplete: Incomplete = False

    def observed(self, sessions: Sequence[Path], camera: str | None) -> Observations:
        """The markers of the sessions, or of one table of centres. Raises as `observe` and `load_observations`, and
        ConfigError for a target that is neither a file nor installed."""
        if any(is_spreadsheet(path) for path in sessions):
            if len(sessions) > 1:
                raise ConfigError(f"{sessions[1]}: a table of centres is used by itself; give one file, or sessions")
            return load_observations(sessions[0])
        wanted, found_by = load_optional_target(self.target), finder(self.workers, self.cluster, use_cache=self.cache)
        warn = make_warning_sink(self.incomplete)
        return observe(sessions, progress, wanted, found_by, across_gap=self.across_gap, incomplete=warn, camera=camera)


def open_session(path: Path, camera: str | None, incomplete: bool) -> Session:
    """The session with the frames of one camera; raises as `open_whole` and `take`."""
    session = open_whole(path, make_warning_sink(incomplete))
    select_camera(session, camera)
    return session


def load_target_by_name(name: str) -> Target:
    """The target of a file, or of an installed name; ConfigError that lists what there is."""
    if Path(name).is_file():
        return load_target(Path(name))
    folder = Path(str(importlib.resources.files("thermostand.configs"))) / "targets"
    known = {path.stem: path for path in sorted(folder.glob("*.yaml"))}
    if name.removesuffix(".yaml") not in known:
        raise ConfigError(f"{name}: no such file, and not one of the installed targets: {', '.join(known)}")
    return load_target(known[name.removesuffix(".yaml")])


def load_board(name: str) -> Target | BoardOfCorners:
    """A board of squares or tags when the file says so, else a target of dots."""
    corners = load_corner_board(Path(name)) if Path(name).is_file() else None
    return corners or load_target_by_name(name)


def load_optional_target(name: str | None) -> Target | None:
    """The target of an option, None when it was not given."""
    return None if name is None else load_target_by_name(name)


def make_warning_sink(incomplete: bool) -> Say | None:
    """Make what `open_whole` takes: with --incomplete what is missing is a warning, otherwise it is refused."""
    return (lambda text: say(f"warning: {text}")) if incomplete else None


@contextmanager
def report_marker_search(count: int, *, is_quick: bool = False) -> Generator[Report]:
    """Progress of a search in so many images; is_quick: shown only once it has taken a while. When code has to be
    compiled first, that is shown in place of the time left."""
    from thermostand.markers.compile_ahead import compile_ahead  # numba takes long to load

    compile_ahead(
        lambda: say("the search for markers is compiled for this machine, which takes a moment; the result is kept")
    )
    with (show_late_progress if is_quick else progress)("find markers", count) as report:
        yield report


def say_left_out(what: str, failures: Sequence[str], suspect: Sequence[str]) -> None:
    """Messages about images that were not used, and those that noise does not describe."""
    for failure in failures:
        say(f"{what} {failure}")
    if suspect:
        say(format_noise_warning(len(suspect)))
