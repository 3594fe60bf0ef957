"""A session as files that any program opens: PNG, text, CSV or Parquet.

    OUT/README.txt                   what is where, and how cells are to be read
    OUT/ro-crate-metadata.json       the same for repositories of research data (ro_crate.py)
    OUT/session.json                 the metadata, and in which state the files of the session were
    OUT/attachments/config.yaml ...  the attached files
    OUT/steps.csv, OUT/events.csv    and OUT/notes.csv, the notes that people wrote
    OUT/frames.csv                   every frame with its role, set-point, temperatures and stages (or .parquet)
    OUT/telemetry/regulator.csv      one table per device (or .parquet), and camera_meta: the descriptions of all frames
    OUT/frames/000001.png, .txt      each frame in order of time, and its temperatures: "each captured frame also had
                                     the temperature information (as a separate file saved with the frame)"
                                     (Adamczyk et al., Sensors 2018, 18, 3685, section 2)
    OUT/frames/index.csv             all those texts as one table

An empty cell is what a device does not measure; nan is what it could not measure, and `remarks` then says why.

Each instant is there twice: `time_ns` as it was recorded, on the stand's clock, which never steps and which durations
are to be computed of; `time_utc` with the offset that the host's system clock had against it then (utc_offsets.py).
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from pathlib import Path

from thermostand.foundation.errors import SessionError
from thermostand.foundation.files import create_folder
from thermostand.recording.exporting.ro_crate import write_crate
from thermostand.recording.exporting.sidecar import SIDECAR_COLUMNS, StandTemperatures, format_sidecar, list_frame_facts
from thermostand.recording.exporting.state import describe_state
from thermostand.recording.exporting.tables import TABLES, Cell, Column, CsvTable, TableFormat, check_format
from thermostand.recording.exporting.telemetry_tables import TIME_COLUMNS, write_telemetry
from thermostand.recording.format.decoded_items import decode_frame
from thermostand.recording.format.images import encode_png
from thermostand.recording.reading.notes import read_notes
from thermostand.recording.reading.session import Session

STEP_COLUMNS = (
    *TIME_COLUMNS,
    *(Column(name, "text") for name in ("step_id", "index", "kind", "state", "parameters_json")),
)
EVENT_COLUMNS = (*TIME_COLUMNS, *(Column(name, "text") for name in ("level", "kind", "text", "data_json")))
NOTE_COLUMNS = (Column("time_ns", "ns"), *(Column(name, "text") for name in ("by", "kind", "text")))


README = """What is here was exported from a recorded session of a thermal test stand by `stand session export`.

ro-crate-metadata.json    what is here, for repositories of research data (RO-Crate 1.1)
session.json              what the session is: recipe, camera, operator, version; and the state of its files
attachments/              configuration, recipe and target, as they were recorded
steps.csv, events.csv     what was done, and what happened
notes.csv                 the notes that people wrote about it, if there are any
frames.csv (or .parquet)  every frame: its file, when, what for, set-point, temperatures, stages (columns below)
telemetry/                one table for each device; camera_meta describes every frame
originals/                the pictures of the thermal imager, if there is one, as it stored them
frames/000001.png, .txt   each frame in order of time, and the temperatures at its time; index.csv has all of these

Times    time_ns is the stand's clock, in ns since 1970: it never steps, so take differences of it. time_utc is UTC as
         the computer had it at that moment. time_ns has 19 digits, and spreadsheets round numbers to 15: read the
         column as text there, or use time_utc.
Values   An empty cell is what the device does not measure; nan is what it could not measure, and remarks says why.
         Units are in the names of the columns. A number is the shortest text that reads back as the same number.
         Decimals have a point, and columns a comma between them, whatever the country: import the tables with these
         settings where a spreadsheet expects other ones.
         Thermometers of a laboratory's own names have columns as the others do (telemetry/sensors_temperature).
Frames   Columns of frames.csv: file (the image here, else the recorded segment that has it); camera; step_id, the step
         of the plan that took it; role, what for; superseded, yes when the capture was begun again later;
         set_point_degC of the chamber; camera_temperature_degC, the camera's own; flags, why a fit leaves it out
         (temperature_suspect, unsettled); for each thermometer the last
         reading (NAME_degC, in degrees Celsius) and how old it was (NAME_age_s, in seconds); NAME_position_mm or
         NAME_position_deg of each stage, in millimetres or degrees, interpolated to the middle of the exposure.
Texts    Cells of the CSV tables are safe for spreadsheets, also of a stranger's session. A text that a spreadsheet
         would take for a formula (its first character, leading spaces not counted, is one of = + - @) has
         an apostrophe (') before it: take that away to have the text as it was recorded. Control characters and those
         that turn the direction of writing are left out; tabs and line ends are spaces. Numbers are never changed.
         Parquet tables, session.json and attachments have all texts as they were recorded.
"""


def export(
    session: Session,
    out: Path,
    *,
    frames: bool = True,
    telemetry: TableFormat | None = "csv",
    report: Callable[[float, str], None],
) -> None:
    """Write `session` as the folder `out`, which must not exist, laid out as above; memory stays flat.

    Parameters
    ----------
    session : Session
        The session to export.
    out : path
        The folder to make.
    frames : bool
        Whether images are written.
    telemetry : table format, optional
        The format of the tables; None leaves them out.
    report : callable
        Gets the share of the work that is done (0 to 1) and what is being done.

    Raises
    ------
    SessionError
        When the session cannot be read, `out` cannot be written, or the format needs a package that is missing; `out`
        then does not appear.
    """
    if telemetry is not None:
        check_format(telemetry)
    read = (*(session.telemetry_segments if telemetry is not None else ()), *(session.frame_segments if frames else ()))
    work = _ExportProgress(read, report)
    with create_folder(out) as folder:
        _write_facts(session, folder)
        if telemetry is not None:
            write_telemetry(session, folder / "telemetry", telemetry, work.done)
        if frames:
            _write_frames(session, folder / "frames", work)
        if session.frame_count:
            _write_frames_table(session, folder, frames, telemetry or "csv")
        _write_originals(session, folder / "originals")
        write_crate(session, out, folder)


class _ExportProgress:
    """How far the export is, by the bytes of the segments it reads."""

    def __init__(self, segments: Sequence[Path], report: Callable[[float, str], None]) -> None:
        self._total_bytes = max(1, sum(path.stat().st_size for path in segments))
        self._done_bytes = 0
        self._report = report

    def done(self, size_bytes: int, text: str) -> None:
        """Note that so much more has been read."""
        self._done_bytes += size_bytes
        self._report(min(1.0, self._done_bytes / self._total_bytes), text)


def _write_facts(session: Session, folder: Path) -> None:
    """Write what is small: metadata, attachments, steps and events."""
    utc = session.utc
    state = describe_state(session)
    (folder / "README.txt").write_text(README + state.text, encoding="utf-8")
    text = json.dumps({**session.metadata, **state._asdict()}, indent=2, ensure_ascii=False)
    (folder / "session.json").write_text(text + "\n", encoding="utf-8")
    attachments = folder / "attachments"
    attachments.mkdir()
    for name, content in session.attachments.items():
        if Path(name).name != name or name in ("", "..") or "\0" in name:
            raise SessionError(f"{session.path}: the attachment {name!r} has no name that a file can have")
        (attachments / name).write_text(content, encoding="utf-8", newline="")
    _write_csv(
        folder / "steps.csv",
        STEP_COLUMNS,
        (
            (m.time_ns, utc.utc_ns(m.time_ns), m.step_id, m.index, m.kind, m.state.value, _serialise(m.parameters))
            for m in session.steps()
        ),
    )
    _write_csv(
        folder / "events.csv",
        EVENT_COLUMNS,
        (
            (e.time_ns, utc.utc_ns(e.time_ns), e.level, e.kind, e.text, _serialise(e.data) if e.data else "")
            for e in session.events()
        ),
    )
    if rows := list(_iterate_note_rows(session)):
        _write_csv(folder / "notes.csv", NOTE_COLUMNS, rows)


def _iterate_note_rows(session: Session) -> Iterator[Sequence[Cell]]:
    by_operator = read_notes(session.path)
    for note in by_operator.notes:
        yield (note.time_ns, note.by, "note", note.text)
    for tag in by_operator.tags:
        yield (None, None, "tag", tag)


def _serialise(fields: Mapping[str, object]) -> str:
    return json.dumps(dict(fields), sort_keys=True, ensure_ascii=False)


def _write_csv(path: Path, columns: Sequence[Column], rows: Iterable[Sequence[Cell]]) -> None:
    with closing(CsvTable(path, columns)) as table:
        for row in rows:
            table.add(row)


def _write_frames(session: Session, folder: Path, work: _ExportProgress) -> None:
    folder.mkdir()
    stand = StandTemperatures(session)
    with closing(CsvTable(folder / "index.csv", (*SIDECAR_COLUMNS, *stand.columns))) as index:
        for number, image in enumerate(session.images(), 1):
            name = f"{number:06d}"
            facts = (*list_frame_facts(f"{name}.png", image.meta, session.utc), *stand.read_at(image.time_ns))
            (folder / f"{name}.png").write_bytes(encode_png(decode_frame(image).image))
            (folder / f"{name}.txt").write_text(format_sidecar(stand.columns, facts), encoding="utf-8")
            index.add(facts)
            work.done(image.stored_bytes, f"frame {number} of {session.frame_count}")


def _write_frames_table(session: Session, folder: Path, has_images: bool, table_format: TableFormat) -> None:
    names = [f"frames/{number:06d}.png" for number in range(1, session.frame_count + 1)] if has_images else None
    columns, rows = make_frames_rows(session, names)
    with closing(TABLES[table_format](folder / f"frames.{table_format}", columns)) as table:
        for row in rows:
            table.add(row)


def _write_originals(session: Session, folder: Path) -> None:
    for number, original in enumerate(session.originals(), 1):
        folder.mkdir(exist_ok=True)
        plain = "".join(each if each.isalnum() or each in "._-" else "_" for each in original.name)
        (folder / f"{number:04d}-{plain[-100:]}").write_bytes(original.data)


# The table of all frames, one row each: when, what for, at which set-point, how warm it was, where the table stood.

_FIRST = (
    Column("file", "text"),
    Column("time_utc", "utc"),
    Column("time_ns", "ns"),
    Column("camera", "word"),
    Column("step_id", "word"),
    Column("role", "word"),
    Column("superseded", "word"),
    Column("set_point_degC", "value"),
    Column("camera_temperature_degC", "value"),
    Column("flags", "word"),
)


def make_frames_rows(
    session: Session, file_of: Sequence[str] | None
) -> tuple[tuple[Column, ...], Iterator[Sequence[Cell]]]:
    """The columns and the rows of F frames in order of time. file_of: F names of exported images; without them `file`
    is the segment that has the image."""
    table, stand = session.frames_table(), StandTemperatures(session)
    units = session.units()
    axes = [Column(f"{axis}_position_{units[f'{axis}.position']}", "value") for axis in table.positions]

    def rows() -> Iterator[Sequence[Cell]]:
        for place in range(len(table)):
            time_ns = int(table.time_ns[place])
            yield (
                str(table.file[place]) if file_of is None else file_of[place],
                session.utc.utc_ns(time_ns),
                time_ns,
                str(table.camera[place]),
                str(table.step_id[place]),
                str(table.role[place]),
                "yes" if table.superseded[place] else "no",
                float(table.chamber_degC[place]),
                float(table.camera_degC[place]),
                str(table.flags[place]),
                *stand.read_at(time_ns),
                *(float(column[place]) for column in table.positions.values()),
            )

    return (*_FIRST, *stand.columns, *axes), rows()
