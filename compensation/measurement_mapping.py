"""How another laboratory's table or folder of pictures is to be read: which column is what, and how times are written.

    columns:
      picture: Datei            # ours: theirs; a column that is not named here has our name already
      time: Zeitpunkt
      camera_degC: T Sensor [°C]
      chamber_degC: Soll
      role: Zweck
    roles: {Referenz: reference, Messung: fit}
    time_format: "%d.%m.%Y %H:%M:%S"

All of it is optional.
"""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Literal

from pydantic import Field, model_validator

from thermostand.compensation.spreadsheet import Spreadsheet
from thermostand.experiments.steps import Role
from thermostand.foundation.clock import NS_PER_S
from thermostand.foundation.documents import Document

OurColumn = Literal[
    "picture", "place", "time", "role", "chamber_degC", "camera_degC", "air_degC",
    "session", "frame", "marker", "x_px", "y_px", "var_x_px2", "cov_xy_px2", "var_y_px2", "width_px", "height_px",
]  # fmt: skip
_UNIT_NS = {"s": NS_PER_S, "ms": 10**6, "us": 10**3, "ns": 1}


class MeasurementMapping(Document):
    """columns: our name -> the table's. picture: file name; without it the rows are a log, and each picture takes what
    it says at its own time. place: where the target stood. roles: the table's word -> ours. time_format: of the column
    of times, and time_in_name of the pictures' names without suffix, as in Python's strptime; without time_format they
    are ISO 8601, or numbers of time_unit since 1970. Times without a zone are taken as UTC. pictures: a pattern of
    file names. reference_degC: the set-point nearest to it is the reference, where the table has no roles; by default
    that in the middle."""

    columns: dict[OurColumn, str] = Field(default_factory=dict)
    roles: dict[str, Role] = Field(default_factory=dict)
    time_format: str = ""
    time_unit: Literal["s", "ms", "us", "ns"] | None = None
    time_in_name: str = ""
    pictures: str = ""
    reference_degC: float | None = None
    camera_serial: str = ""

    @model_validator(mode="after")
    def _check_times(self) -> MeasurementMapping:
        if self.time_format and self.time_unit:
            raise ValueError("time_format and time_unit exclude each other: times are text, or numbers")
        return self

    def get_name(self, ours: OurColumn) -> str:
        """The table's name of a column."""
        return self.columns.get(ours, ours)

    def check_columns(self, table: Spreadsheet) -> None:
        """SessionError when a column that is named here is not in the table."""
        table.require(list(self.columns.values()), "the mapping names it")

    def parse_times(self, table: Spreadsheet) -> list[int] | None:
        """(M,): the instants, ns since 1970; None for a table without times. SessionError that names the line."""
        if "time" not in self.columns and table.has("time_ns"):
            return table.whole_numbers("time_ns", 2**63 - 1).tolist()
        name = self.get_name("time")
        if not table.has(name):
            return None
        if self.time_unit is not None:
            return [round(value * _UNIT_NS[self.time_unit]) for value in self._list_known(table, name)]
        found: list[int] = []
        for row, text in enumerate(table.column(name)):
            try:
                found.append(parse_time(text, self.time_format))
            except ValueError:
                wanted = f"of the form {self.time_format}" if self.time_format else "ISO 8601; state time_format"
                raise table.fault(row, f"{name} is {text!r}, not a time {wanted}, or time_unit of numbers") from None
        return found

    def _list_known(self, table: Spreadsheet, name: str) -> list[float]:
        values: list[float] = table.numbers(name).tolist()
        for row, value in enumerate(values):
            if value != value:
                raise table.fault(row, f"{name} is empty; each row needs its time")
        return values

    def parse_roles(self, table: Spreadsheet) -> list[Role | None]:
        """(M,): what each row was taken for; None where it does not say."""
        name = self.get_name("role")
        if not table.has(name):
            return [None] * len(table.lines)
        words = {**{str(role): role for role in Role}, **{text.casefold(): role for text, role in self.roles.items()}}
        cells = table.column(name)
        for row, text in enumerate(cells):
            if text and text.casefold() not in words:
                raise table.fault(
                    row, f"{name} is {text!r}; add it to `roles` of the mapping, or use {', '.join(Role)}"
                )
        return [words.get(text.casefold()) for text in cells]


def parse_time(text: str, pattern: str) -> int:
    """An instant, ns since 1970; ValueError when the text is none."""
    found = datetime.strptime(text, pattern) if pattern else datetime.fromisoformat(text)
    whole = found if found.tzinfo else found.replace(tzinfo=UTC)
    return round((whole - datetime(1970, 1, 1, tzinfo=UTC)).total_seconds() * 10**6) * 10**3
