"""The table of all frames, one row each: when, what for, at which set-point, how warm it was, where the table stood."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from thermostand.recording.exporting.sidecar import StandTemperatures
from thermostand.recording.exporting.tables import Cell, Column
from thermostand.recording.reading.session import Session

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


def frames_rows(session: Session, file_of: Sequence[str] | None) -> tuple[tuple[Column, ...], Iterator[Sequence[Cell]]]:
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
                *stand.at(time_ns),
                *(float(column[place]) for column in table.positions.values()),
            )

    return (*_FIRST, *stand.columns, *axes), rows()
