"""Pictures of another laboratory -> a table of centres: from their names, and a table, what each was taken at.

A temperature in a name is the camera's own: `t25/p0700/0001.png` is at 25 degC and 700 mm, and so is
`000000_t25_p0700_color.png`. The table has a row for each picture, or is a log from which each picture takes what was
recorded at its time. Pictures in which the target stands elsewhere are of another session: a drift is measured against
the reference of its own.
"""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import groupby, pairwise
from pathlib import Path
from typing import cast

import numpy as np

from thermostand.compensation.array_observations import CENTRE_COLUMNS, Index
from thermostand.compensation.finding.workers import open_pool
from thermostand.compensation.measurement_mapping import MeasurementMapping, OurColumn, parse_time
from thermostand.compensation.observations import Float
from thermostand.compensation.spreadsheet import Spreadsheet, read_spreadsheet
from thermostand.experiments.steps import Role
from thermostand.foundation.errors import ConfigError, SessionError
from thermostand.foundation.files import open_atomic
from thermostand.markers.corner_board import BoardOfCorners, SIGMA_px, find_corners
from thermostand.markers.detection import Detection, DetectionError, Image, detect
from thermostand.markers.image_file import read_image
from thermostand.markers.target import Target

_SUFFIXES = (".png", ".tif", ".tiff", ".jpg", ".jpeg", ".bmp", ".pgm")
_TABLES = (".csv", ".tsv")
_COLOUR = "_color"
# `t25`, `t-5`, `t10.5` as a part of the path, between separators: of a folder or of the file's name.
_TEMPERATURE = re.compile(r"(?:^|[/_ ])[tT](-?\d+(?:\.\d+)?)(?:deg[cC])?(?=[/_ ]|\.\w+$)")
_PLACE = re.compile(r"(?:^|[/_ ])[pP](\d+)(?=[/_ ]|\.\w+$)")
_SAME_K = 0.51  # a name has whole degrees
_CHUNK = 64
_GAP_INTERVALS = 5  # of a log's usual ones: beyond, it says nothing of the time between two rows; round number
# As in drift/training_data.py, whose images are 2448 px wide: drift is below it, and a target that was moved rarely is.
_SAME_PLACE_PART = 10 / 2448
_INDEX: dict[OurColumn, str] = {"picture": "Name", "camera_degC": "Temp", "place": "position"}
"""Columns of the index.csv of the one public set of a target over temperature."""


@dataclass(frozen=True, slots=True, eq=False)
class Picture:
    """name: its path in the folder. place: where the target stood, as it was named. time_ns: None when unknown.
    Temperatures are NaN when unknown."""

    path: Path
    name: str
    place: str = ""
    time_ns: int | None = None
    role: Role | None = None
    camera_degC: float = math.nan
    chamber_degC: float = math.nan
    air_degC: float = math.nan


@dataclass(frozen=True, slots=True, eq=False)
class Reading:
    """What a log says between the pictures."""

    time_ns: int
    camera_degC: float
    air_degC: float


@dataclass(frozen=True, slots=True, eq=False)
class Measured:
    """A picture and its points (N, 2) px with covariances (N, 2, 2); NaN without a centre, or with a flag. why: why
    it cannot be used, "" when it can."""

    picture: Picture
    centres_px: Float
    covariance_px2: Float
    size: tuple[int, int]
    is_suspect: bool
    why: str = ""


def measure_points(
    image: Image, board: Target | BoardOfCorners, previous: Detection | None = None
) -> tuple[Float, Float, bool, Detection | None]:
    """Points (N, 2) px and their covariances (N, 2, 2) in a picture, whether these are suspect, and, of discs, the
    detection; DetectionError when the target is not in it."""
    if isinstance(board, Target):
        found = detect(image, board, previous)
        return found.centres_px, found.covariance_px2, found.is_suspect, found
    return find_corners(image, board), np.tile(SIGMA_px**2 * np.eye(2), (board.count, 1, 1)), False, None


def list_pictures(folder: Path, mapping: MeasurementMapping) -> list[Picture]:
    """The pictures of a folder and those in it, with what their names say; ConfigError without any."""
    paths = sorted(path for path in folder.rglob(mapping.pictures or "*") if path.suffix.lower() in _SUFFIXES)
    coloured = [path for path in paths if path.stem.lower().endswith(_COLOUR)]
    if not paths:
        raise ConfigError(f"{folder}: has no pictures ({', '.join(_SUFFIXES)}), and neither have the folders in it")
    found: list[Picture] = []
    for path in coloured or paths:
        name = path.relative_to(folder).as_posix()
        degC, place = _TEMPERATURE.findall(name), _PLACE.findall(name)
        if len(set(degC)) > 1:
            raise ConfigError(f"{path}: its name has several temperatures: {', '.join(degC)} degC; rename it")
        time_ns = None
        if mapping.time_in_name:
            try:
                time_ns = parse_time(path.stem, mapping.time_in_name)
            except ValueError:
                raise ConfigError(f"{path}: its name has no time of the form {mapping.time_in_name}") from None
        own = float(degC[0]) if degC else math.nan
        found.append(Picture(path, name, f"p{place[0]}" if place else "", time_ns, camera_degC=own, chamber_degC=own))
    return found


def find_table(folder: Path) -> Path | None:
    """The one table in a folder, None without; ConfigError when there are several."""
    tables = sorted(path for path in folder.iterdir() if path.suffix.lower() in _TABLES)
    if len(tables) > 1:
        raise ConfigError(f"{folder}: has {len(tables)} tables, {tables[0].name}, ...; name one with --table")
    return tables[0] if tables else None


def add_table(
    pictures: Sequence[Picture], path: Path, mapping: MeasurementMapping
) -> tuple[list[Picture], list[Reading]]:
    """The pictures that a table knows, with what it says of them, and its readings between them.

    ConfigError or SessionError, with the line, when it names none of them, or contradicts a name.
    """
    table = read_spreadsheet(path)
    if not mapping.columns and all(table.has(name) for name in _INDEX.values()):
        mapping = mapping.model_copy(update={"columns": _INDEX})
    mapping.check_columns(table)
    if not table.lines:
        raise SessionError(f"{path}: has no rows")
    rows = _read_rows(table, mapping)
    if table.has(mapping.get_name("picture")):
        return _assign_rows(pictures, table, mapping, rows), []
    return _interpolate_log(pictures, table, rows)


def _read_rows(table: Spreadsheet, mapping: MeasurementMapping) -> list[Picture]:
    """Return what each row says, of a picture that is still to be found."""
    times, roles = mapping.parse_times(table) or [None] * len(table.lines), mapping.parse_roles(table)
    named: dict[OurColumn, list[float]] = {}
    for ours in ("camera_degC", "chamber_degC", "air_degC"):
        theirs = mapping.get_name(ours)
        named[ours] = table.numbers(theirs).tolist() if table.has(theirs) else [math.nan] * len(table.lines)
    place = mapping.get_name("place")
    places = table.column(place) if table.has(place) else [""] * len(table.lines)
    columns = zip(places, times, roles, named["camera_degC"], named["chamber_degC"], named["air_degC"], strict=True)
    return [Picture(Path(), "", *row) for row in columns]


def _assign_rows(
    pictures: Sequence[Picture], table: Spreadsheet, mapping: MeasurementMapping, rows: Sequence[Picture]
) -> list[Picture]:
    """Each picture with the first row that names it; those that no row names are left out."""
    by_name: dict[str, list[int]] = {}
    for number, picture in enumerate(pictures):
        path = Path(picture.name.casefold())
        stem = path.with_suffix("").as_posix()
        for name in {path.as_posix(), stem, stem.removesuffix(_COLOUR), path.name, path.stem}:
            by_name.setdefault(name, []).append(number)
    found: dict[int, Picture] = {}
    for row, text in enumerate(table.column(mapping.get_name("picture"))):
        numbers = by_name.get(text.replace("\\", "/").removeprefix("./").casefold(), [])
        if len(numbers) > 1:
            raise table.fault(row, f"{text!r} may be any of {len(numbers)} pictures; name it with its folder")
        if numbers:
            (number,) = numbers
            merged = _merge(pictures[number], rows[row], table, row)
            found.setdefault(number, merged)
    if not found:
        raise SessionError(f"{table.path}: names none of the {len(pictures)} pictures, such as {pictures[0].name}")
    return [found[number] for number in sorted(found)]


def _merge(picture: Picture, noted: Picture, table: Spreadsheet, row: int) -> Picture:
    """A picture with what a row says; SessionError when its name says otherwise."""
    if abs(noted.camera_degC - picture.camera_degC) > _SAME_K:
        raise table.fault(
            row,
            f"{picture.name} is at {picture.camera_degC:g} degC by its name, and at {noted.camera_degC:g} by the table",
        )
    from_row = math.isfinite(noted.camera_degC)
    set_point = noted.chamber_degC if math.isfinite(noted.chamber_degC) else picture.chamber_degC
    return replace(
        picture,
        place=picture.place or noted.place,
        time_ns=picture.time_ns if noted.time_ns is None else noted.time_ns,
        role=noted.role,
        camera_degC=noted.camera_degC if from_row else picture.camera_degC,
        chamber_degC=set_point,
        air_degC=noted.air_degC,
    )


def _interpolate_log(
    pictures: Sequence[Picture], table: Spreadsheet, rows: Sequence[Picture]
) -> tuple[list[Picture], list[Reading]]:
    """Temperatures between two rows, set-point and role of the row before; SessionError when times are missing."""
    times = [row.time_ns for row in rows if row.time_ns is not None]
    if len(times) < len(rows):
        raise SessionError(
            f"{table.path}: has no column of pictures' names and none of times: name one in a mapping, as `picture` or "
            f"`time`; it has {', '.join(table.names)}"
        )
    for row, (before, after) in enumerate(pairwise(times), 1):
        if after < before:
            raise table.fault(row, "its time is before that of the line above; sort the rows by time")
    if any(picture.time_ns is None for picture in pictures):
        raise ConfigError(
            f"{table.path}: is a log, and nothing says when {pictures[0].name} was taken; a mapping's time_in_name does"
        )
    at_ns, instants = np.array([picture.time_ns for picture in pictures], np.int64), np.array(times, np.int64)
    camera_degC, air_degC = (
        _interpolate(instants, np.array([getattr(row, name) for row in rows], np.float64), at_ns)
        for name in ("camera_degC", "air_degC")
    )
    before = np.clip(np.searchsorted(instants, at_ns, side="right") - 1, 0, None)
    found: list[Picture] = []
    for picture, row, own_degC, its_air_degC in zip(pictures, before.tolist(), camera_degC, air_degC, strict=True):
        noted = replace(rows[row], time_ns=None, camera_degC=float(own_degC), air_degC=float(its_air_degC))
        found.append(_merge(picture, noted, table, row))
    return found, [Reading(time_ns, row.camera_degC, row.air_degC) for time_ns, row in zip(times, rows, strict=True)]


def _interpolate(instants: Index, values: Float, at_ns: Index) -> Float:
    """The values (K,) between the rows; NaN outside of the log and across its gaps."""
    known = np.isfinite(values)
    if known.sum() < 2:
        return np.full(len(at_ns), np.nan)
    times_ns, origin_ns = instants[known], int(instants[known][0])
    apart_ns = np.diff(times_ns)
    after = np.clip(np.searchsorted(times_ns, at_ns), 1, len(times_ns) - 1)
    near = apart_ns[after - 1] <= _GAP_INTERVALS * max(float(np.median(apart_ns)), 1.0)
    near &= (at_ns >= times_ns[0]) & (at_ns <= times_ns[-1])
    return np.where(near, np.interp(at_ns - origin_ns, times_ns - origin_ns, values[known]), np.nan)


def measure_pictures(
    pictures: Sequence[Picture],
    board: Target | BoardOfCorners,
    workers: int = 1,
    report: Callable[[float, str], None] = lambda done, text: None,
) -> list[Measured]:
    """The points of all pictures, in their order; the same with any number of workers."""
    chunks = [
        own[first : first + _CHUNK]
        for own in (list(each) for _, each in groupby(pictures, lambda one: (one.place, one.chamber_degC)))
        for first in range(0, len(own), _CHUNK)
    ]
    found: list[Measured] = []

    def collect(parts: Iterable[list[Measured]]) -> list[Measured]:
        for part in parts:
            found.extend(part)
            report(len(found), part[-1].picture.name)
        return found

    if workers == 1:
        return collect(measure_chunk(chunk, board) for chunk in chunks)
    with open_pool(workers) as processes:
        return collect(processes.map(measure_chunk, chunks, [board] * len(chunks)))


def measure_chunk(pictures: Sequence[Picture], board: Target | BoardOfCorners) -> list[Measured]:
    """The points of pictures that follow each other: discs are tracked from one to the next."""
    previous: Detection | None = None
    size = (0, 0)
    found: list[Measured] = []
    for picture in pictures:
        centres, covariance = np.full((board.count, 2), np.nan), np.full((board.count, 2, 2), np.nan)
        suspect, why = False, "its camera temperature is not known" if math.isnan(picture.camera_degC) else ""
        try:
            image = read_image(picture.path)
            before, size = size, (image.shape[1], image.shape[0])
            if not why:
                begin = previous if size == before else None
                centres, covariance, suspect, previous = measure_points(image, board, begin)
        except DetectionError as error:
            why, previous = str(error).removeprefix(f"{picture.path}: "), None
        if previous is not None:
            centres = np.where((previous.flags == 0)[:, None], centres, np.nan)
        found.append(Measured(picture, centres, covariance, size, suspect, why))
    return found


@dataclass(frozen=True, slots=True, eq=False)
class Placed:
    """A measured picture, the session it is of, and its role."""

    measured: Measured
    session: str
    role: Role


def place_pictures(measured: Sequence[Measured], reference_degC: float | None) -> tuple[list[Placed], float]:
    """The usable pictures, by session in their order, and the set-point of the reference.

    Pictures of one place in which the target stands within 0.4 % of the image's width are one session. ConfigError when
    none of the sessions has the reference and another temperature, or the pictures have several sizes.
    """
    usable = [one for one in measured if not one.why]
    if not usable:
        raise ConfigError(f"no picture can be used; {measured[0].picture.name}: {measured[0].why}")
    if len(sizes := sorted({one.size for one in usable})) > 1:
        raise ConfigError(f"the pictures have several sizes, {sizes[0]} and {sizes[1]} px; give those of one camera")
    points = np.unique([_get_set_point(one.picture) for one in usable])
    wanted = float(np.median(points)) if reference_degC is None else reference_degC
    reference = float(points[np.argmin(np.abs(points - wanted))])
    placed: list[Placed] = []
    for place in dict.fromkeys(one.picture.place for one in usable):
        groups = _split_by_place([one for one in usable if one.picture.place == place])
        for number, group in enumerate(groups, 1):
            name = f"{place or 'place'}-{number}" if len(groups) > 1 else place
            placed += [Placed(one, name, _find_role(one.picture, reference)) for one in group]
    return _leave_out_unreferenced(placed), reference


def _split_by_place(measured: Sequence[Measured]) -> list[list[Measured]]:
    """Pictures in which the target stands where it does in the first of them."""
    groups: list[list[Measured]] = []
    firsts: list[Float] = []
    for one in measured:
        away_px = [
            float(np.nanmean(shift)) if np.isfinite(shift).any() else math.inf
            for shift in (np.linalg.norm(one.centres_px - first, axis=1) for first in firsts)
        ]
        if away_px and min(away_px) < _SAME_PLACE_PART * one.size[0]:
            groups[away_px.index(min(away_px))].append(one)
        else:
            groups.append([one])
            firsts.append(one.centres_px)
    return groups


def _get_set_point(picture: Picture) -> float:
    return picture.chamber_degC if math.isfinite(picture.chamber_degC) else float(round(picture.camera_degC))


def _find_role(picture: Picture, reference_degC: float) -> Role:
    if picture.role is not None:
        return picture.role
    return Role.REFERENCE if _get_set_point(picture) == reference_degC else Role.FIT


def _leave_out_unreferenced(placed: Sequence[Placed]) -> list[Placed]:
    """Sessions without a reference or without another temperature show no drift: their pictures are of no use to a
    fit; ConfigError when that is so of all."""
    points: dict[str, set[float]] = {}
    for one in placed:
        if one.role in (Role.REFERENCE, Role.FIT, Role.WARM_UP, Role.VALIDATION):
            points.setdefault(one.session, set()).add(_get_set_point(one.measured.picture))
    referenced = {one.session for one in placed if one.role is Role.REFERENCE}
    useful = {name for name, own in points.items() if name in referenced and len(own) > 1}
    if not useful:
        raise ConfigError(
            f"no place of the target was seen at the reference and at another temperature ({len(points)} places, by "
            "0.4 % of the width): the drift cannot be separated from how the target was moved; keep it in place, or "
            "state reference_degC or roles in a mapping"
        )
    return [one if one.session in useful else replace(one, role=Role.OTHER) for one in placed]


def write_centres(path: Path, placed: Sequence[Placed], readings: Sequence[Reading] = ()) -> None:
    """Write the table of centres that `load_observations` reads; it appears when it is complete. SessionError when the
    place cannot be written to."""
    with open_atomic(path) as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(CENTRE_COLUMNS)
        for frame, one in enumerate(placed):
            writer.writerows(_iterate_rows(frame, one))
        for reading in readings:
            degC = {"camera_degC": _format_degC(reading.camera_degC), "air_degC": _format_degC(reading.air_degC)}
            known: dict[str, object] = {"time_ns": reading.time_ns, **degC}
            writer.writerow([known.get(name, "") for name in CENTRE_COLUMNS])


def _iterate_rows(frame: int, one: Placed) -> Iterator[tuple[object, ...]]:
    picture, measured = one.measured.picture, one.measured
    time_ns = "" if picture.time_ns is None else picture.time_ns
    degC = map(_format_degC, (picture.chamber_degC, picture.camera_degC, picture.air_degC))
    of_frame = (one.session, frame, picture.name, time_ns, str(one.role), *degC, *measured.size)
    for marker in np.flatnonzero(np.isfinite(measured.centres_px[:, 0])).tolist():
        (x, y), covariance = measured.centres_px[marker], measured.covariance_px2[marker]
        variances = (f"{value:.6e}" for value in (covariance[0, 0], covariance[0, 1], covariance[1, 1]))
        yield (*of_frame, marker, f"{x:.6f}", f"{y:.6f}", *variances)


def _format_degC(value: float) -> str:
    return f"{value:.4f}" if math.isfinite(value) else ""


def read_pose_spread(pictures: Iterable[Placed]) -> dict[str, tuple[float, float]]:
    """Return how far the poses of the target that are noted with the pictures differ within each session: the largest
    distance from the first one, in the files' own unit, and angle, deg. SessionError for a file that is no 4x4 pose."""
    firsts: dict[str, Float] = {}
    spread: dict[str, tuple[float, float]] = {}
    for one in pictures:
        path = find_pose(one.measured.picture.path)
        if path is None:
            continue
        pose = _read_pose(path)
        first = firsts.setdefault(one.session, pose)
        cosine = (np.trace(first[:3, :3].T @ pose[:3, :3]) - 1) / 2
        moved = float(np.linalg.norm(pose[:3, 3] - first[:3, 3])), float(np.degrees(np.arccos(np.clip(cosine, -1, 1))))
        before = spread.get(one.session, (0.0, 0.0))
        spread[one.session] = max(before[0], moved[0]), max(before[1], moved[1])
    return spread


def find_pose(picture: Path) -> Path | None:
    """The text file with a picture's pose, None without."""
    stem = picture.stem.removesuffix(_COLOUR)
    names = [f"{picture.stem}.txt", f"{stem}.txt", f"{stem}_sdepth.txt"]
    return next((path for path in map(picture.with_name, names) if path.is_file()), None)


def _read_pose(path: Path) -> Float:
    try:
        pose = np.loadtxt(path, delimiter="," if "," in path.read_text(encoding="utf-8") else None)
    except (OSError, ValueError) as error:
        raise SessionError(f"{path}: not a 4x4 pose ({error})") from error
    if pose.shape != (4, 4) or not np.allclose(pose[3], (0, 0, 0, 1)):
        raise SessionError(f"{path}: not a 4x4 pose: its last row is 0 0 0 1")
    return pose


def convert_centres(path: Path, mapping: MeasurementMapping, out: Path) -> None:
    """Write a table of centres with our names, times and roles; SessionError that names the line of what is wrong."""
    table = read_spreadsheet(path)
    mapping.check_columns(table)
    times, roles = mapping.parse_times(table), mapping.parse_roles(table)
    columns: dict[str, Sequence[object]] = {}
    for name in CENTRE_COLUMNS:
        theirs = mapping.columns.get(cast(OurColumn, name), name)
        if name == "role" and table.has(theirs):
            columns[name] = ["" if role is None else str(role) for role in roles]
        elif name == "time_ns" and times is not None:
            columns[name] = times
        elif table.has(theirs):
            columns[name] = table.column(theirs)
            if name not in ("session", "image"):
                table.check_readable(theirs)
    with open_atomic(out) as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(columns)
        writer.writerows(zip(*columns.values(), strict=True))
