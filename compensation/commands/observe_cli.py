"""`compensate observe`: pictures and tables of other laboratories become a table of centres."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from thermostand.compensation.array_observations import load_observations
from thermostand.compensation.commands.options import load_board, report_marker_search, say_left_out
from thermostand.compensation.measurement_mapping import MeasurementMapping
from thermostand.compensation.observations import Observations
from thermostand.compensation.pictures import (
    add_table,
    convert_centres,
    find_table,
    list_pictures,
    measure_pictures,
    place_pictures,
    read_pose_spread,
    write_centres,
)
from thermostand.compensation.spreadsheet import is_spreadsheet, read_spreadsheet
from thermostand.foundation.command_app import App
from thermostand.foundation.documents import load_document
from thermostand.foundation.errors import ConfigError
from thermostand.foundation.files import check_writable
from thermostand.foundation.output import show

app = App()


@app.command("observe")
def observe_pictures(
    source: Annotated[
        Path, typer.Argument(metavar="FOLDER|TABLE", help="A folder of pictures, or a table of centres or pictures.")
    ],
    out: Annotated[Path, typer.Option("--out", "-o", help="The table of centres (CSV) to write.")],
    *,
    target: Annotated[
        str | None, typer.Option("--target", help="A target file or an installed name; pictures need it.")
    ] = None,
    table: Annotated[
        Path | None, typer.Option(help="The table of temperatures; else the one in the folder, if there is one.")
    ] = None,
    mapping: Annotated[
        Path | None, typer.Option(help="A YAML file that names the columns of the table, and how times are written.")
    ] = None,
    workers: Annotated[int, typer.Option("--workers", min=1, help="Processes that look for markers.")] = 1,
) -> None:
    """Make a table of centres of pictures whose temperature is in their names, as t25/p0700/0001.png, or in a table;
    or of a table of centres of another program. `compensate fit`, `report` and `datasheet` take it.

    A drift is measured in pictures of a target that stands still: those in which it stands elsewhere, at another
    distance or by 0.4 % of the width, are a session of their own with its own reference.

    Example: compensate observe pictures --target my-target.yaml -o centres.csv
    """
    check_writable(out)
    given = MeasurementMapping() if mapping is None else load_document(mapping, MeasurementMapping)
    if not source.exists():
        raise ConfigError(f"{source}: no such file or folder")
    if source.is_file() and _is_table_of_centres(source, given):
        convert_centres(source, given, out)
        _show_observations(load_observations(out), out, {}, [])
        return
    if target is None:
        raise ConfigError("pictures need --target: the file of the target that they show, or an installed name")
    board = load_board(target)
    folder, named = (source.parent, source) if source.is_file() else (source, table or find_table(source))
    pictures, readings = list_pictures(folder, given), []
    count = len(pictures)
    if named is not None:
        pictures, readings = add_table(pictures, named, given)
    with report_marker_search(len(pictures)) as report:
        measured = measure_pictures(pictures, board, workers, report)
    failures = [f"{one.picture.name}: {one.why}" for one in measured if one.why]
    suspect = [one.picture.name for one in measured if one.is_suspect]
    placed, reference_degC = place_pictures(measured, given.reference_degC)
    poses = read_pose_spread(placed)
    write_centres(out, placed, readings)
    say_left_out("not used:", failures, suspect)
    lines = [f"the reference is at {reference_degC:g} degC"]
    lines += [f"{count - len(pictures)} pictures are not in {named}"] if count > len(pictures) else []
    lines += [
        f"{session or 'pictures'}: stated poses differ by up to {moved:.3g} (in their unit) and {turned_deg:.3g} deg"
        for session, (moved, turned_deg) in poses.items()
    ]
    data: dict[str, object] = {
        "reference_degC": reference_degC,
        "not_used": failures,
        "suspect": suspect,
        "stated_poses": poses,
    }
    _show_observations(load_observations(out, given.camera_serial), out, data, lines)


def _is_table_of_centres(path: Path, mapping: MeasurementMapping) -> bool:
    if not is_spreadsheet(path):
        raise ConfigError(f"{path}: not a folder, and its name does not end as that of a table (.csv, .tsv, .txt)")
    return read_spreadsheet(path).has(mapping.get_name("x_px"))


def _show_observations(found: Observations, out: Path, data: dict[str, object], lines: list[str]) -> None:
    """What the table holds, read back from the file."""
    degC = found.camera_degC[found.usable]
    points = len(np.unique(found.chamber_degC[found.usable]))
    head = (
        f"{out}: {len(found.frame)} pictures ({found.roles_text}), {len(found.sessions)} sessions, "
        f"{points} temperatures {degC.min():g}..{degC.max():g} degC"
    )
    facts = {
        "table": out,
        "pictures": len(found.frame),
        "sessions": [facts.session_id for facts in found.sessions],
        "temperatures": points,
        "not_known": found.not_known,
    }
    show({**facts, **data}, [head, *lines, *(f"not known: {text}" for text in found.not_known.values())])
