"""Tables for other programs, written row by row: CSV, or Parquet where pyarrow is installed."""

from __future__ import annotations

import csv
import unicodedata
from collections.abc import Sequence
from pathlib import Path
from typing import Literal, NamedTuple, Protocol

from thermostand.foundation.extras import import_extra
from thermostand.foundation.instants import format_utc

TableFormat = Literal["csv", "parquet"]
Cell = int | float | str | None

_PARQUET = ("parquet", ", or choose CSV")
# Rows of a Parquet row group: what is held in memory per table.
GROUP_ROWS = 8192

_FORMULA = ("=", "+", "-", "@")


class Column(NamedTuple):
    """A column and what its cells are: ns an instant as int64, utc the same as a time stamp, count an unsigned 64-bit
    number, value a float of 64 bits, word one of few texts, text any text. None is an empty cell."""

    name: str
    type: Literal["ns", "utc", "count", "value", "word", "text"]


class TableWriter(Protocol):
    """A table being written."""

    def add(self, row: Sequence[Cell]) -> None:
        """One cell for each column; a utc cell is given in ns."""
        ...

    def close(self) -> None:
        """Write what is left."""
        ...


class CsvTable:
    """RFC 4180 in UTF-8 with a header line. A float is the shortest text that reads back as the same float, NaN is
    `nan`; instants are ISO 8601. Texts are such as no spreadsheet takes for a formula (`escape_cell`)."""

    def __init__(self, path: Path, columns: Sequence[Column]) -> None:
        self._file = path.open("w", encoding="utf-8", newline="")
        self._writer = csv.writer(self._file)
        self._writer.writerow([escape_cell(column.name) for column in columns])
        self._instants = [index for index, column in enumerate(columns) if column.type == "utc"]

    def add(self, row: Sequence[Cell]) -> None:
        """Write the row."""
        cells = list(row)
        for index in self._instants:
            cells[index] = format_utc(int(row[index] or 0))
        self._writer.writerow([escape_cell(cell) if isinstance(cell, str) else cell for cell in cells])

    def close(self) -> None:
        """Close the file."""
        self._file.close()


def escape_cell(text: str) -> str:
    """Return the text of a cell with an apostrophe before what a spreadsheet would take for a formula (= + - @ at its
    beginning, leading spaces not counted), and without control characters (tab and line feed become spaces): a
    session may come from anybody."""
    plain = "".join(" " if char in "\t\n\r" else char for char in text if char in "\t\n\r" or not _is_control(char))
    return f"'{plain}" if plain.lstrip().startswith(_FORMULA) else plain


def _is_control(char: str) -> bool:
    """Return whether it is not shown, or changes how what follows is shown: such as ESC, or one that turns the
    direction."""
    return unicodedata.category(char) in ("Cc", "Cf", "Cs")


class ParquetTable:
    """A Parquet file: words as dictionaries, instants as UTC time stamps of ns."""

    def __init__(self, path: Path, columns: Sequence[Column]) -> None:
        self._arrow = import_extra("pyarrow", *_PARQUET)
        types = {
            "ns": self._arrow.int64(),
            "utc": self._arrow.timestamp("ns", "UTC"),
            "count": self._arrow.uint64(),
            "value": self._arrow.float64(),
            "word": self._arrow.dictionary(self._arrow.int32(), self._arrow.string()),
            "text": self._arrow.string(),
        }
        self._schema = self._arrow.schema([(column.name, types[column.type]) for column in columns])
        self._writer = import_extra("pyarrow.parquet", *_PARQUET).ParquetWriter(path, self._schema)
        self._rows: list[Sequence[Cell]] = []

    def add(self, row: Sequence[Cell]) -> None:
        """Keep the row, and write when there are enough for a group."""
        self._rows.append(row)
        if len(self._rows) == GROUP_ROWS:
            self._write()

    def _write(self) -> None:
        columns = [list(column) for column in zip(*self._rows, strict=True)]
        arrays = [self._arrow.array(cells, field.type) for cells, field in zip(columns, self._schema, strict=True)]
        self._writer.write_table(self._arrow.table(arrays, schema=self._schema))
        self._rows.clear()

    def close(self) -> None:
        """Write the last group and the file's index."""
        if self._rows:
            self._write()
        self._writer.close()


TABLES: dict[TableFormat, type[CsvTable] | type[ParquetTable]] = {"csv": CsvTable, "parquet": ParquetTable}


def check_format(table_format: TableFormat) -> None:
    """SessionError when tables of that format cannot be written here."""
    if table_format == "parquet":
        import_extra("pyarrow.parquet", *_PARQUET)
