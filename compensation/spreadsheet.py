"""A table as a spreadsheet, a data logger or another program has written it -> columns of text, points as decimals.

Countries and programs differ in the sign between cells (comma, semicolon, tab, bar, blanks), the decimal sign, the sign
between thousands, the encoding and the line's end. Each is found from the file itself; what could be read in two ways
is an error, never a guess.
"""

from __future__ import annotations

import codecs
import csv
import io
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from thermostand.foundation.errors import SessionError
from thermostand.foundation.files import describe_unreadable

SUFFIXES = (".csv", ".tsv", ".txt")
_BOMS = ((codecs.BOM_UTF8, "utf-8"), (codecs.BOM_UTF16_LE, "utf-16-le"), (codecs.BOM_UTF16_BE, "utf-16-be"))
_WORKBOOKS = (b"PK\x03\x04", b"\xd0\xcf\x11\xe0")  # .xlsx and .ods are ZIP files, .xls is an OLE2 file
_DELIMITERS = "\t;,|"
_NUMBER = re.compile(r"([-+\u2212]?)(\d[\d.,'\u2019 \u00a0\u202f]*|[.,]\d+)([eE][-+]?\d+)?")
_SPACED = re.compile(r"\d{1,3}(?:['\u2019 \u00a0\u202f]\d{3})+(?:[.,]\d*)?")
_SPACES = re.compile(r"['\u2019 \u00a0\u202f]")
_PLAIN = re.compile(r"[-+0-9.eE\n]*")
_POINT, _COMMA = ".", ","
# Of a column: its commas are before three digits, as in 1,234; it has both 1.5 and 1,5; it has no comma, and points, if
# any, before three digits.
_EITHER, _CONTRADICTION, _UNSTATED = "either", "contradiction", ""


@dataclass(frozen=True, slots=True, eq=False)
class Spreadsheet:
    """A table's columns. names: as they are written, in their order. cells: of each column, without blanks at the ends;
    numbers have a point and no sign between thousands. lines: of each row in the file. ambiguous: columns that have a
    number of two readings, and the line of the first one."""

    path: Path
    names: tuple[str, ...]
    cells: tuple[list[str], ...]
    lines: list[int]
    ambiguous: dict[int, int]

    def find(self, name: str) -> int | None:
        """The column of this name, else the one that differs in capitals only; None without."""
        if name in self.names:
            return self.names.index(name)
        folded = [each.casefold() for each in self.names]
        return folded.index(name.casefold()) if name.casefold() in folded else None

    def has(self, name: str) -> bool:
        """Return whether there is a column of this name, whatever its capitals."""
        return self.find(name) is not None

    def states(self, name: str) -> bool:
        """Return whether there is such a column, and any text in it."""
        return self.has(name) and any(self.column(name))

    def column(self, name: str) -> list[str]:
        """The cells of a column; KeyError without."""
        at = self.find(name)
        if at is None:
            raise KeyError(name)
        return self.cells[at]

    def require(self, needed: Sequence[str], why: str) -> None:
        """SessionError, which ends with `why`, when there is none of these columns."""
        for name in needed:
            if not self.has(name):
                found = ", ".join(self.names)
                raise SessionError(f"{self.path}: has no column {name}; {why}; the first line names: {found}")

    def select(self, rows: NDArray[np.bool_]) -> Spreadsheet:
        """The table with the rows of a mask (M,) only."""
        return self.take(np.flatnonzero(rows))

    def take(self, rows: NDArray[np.intp]) -> Spreadsheet:
        """The table with these rows, counted from 0, in this order."""
        wanted = rows.tolist()
        cells = tuple([column[row] for row in wanted] for column in self.cells)
        return replace(self, cells=cells, lines=[self.lines[row] for row in wanted])

    def fault(self, row: int, text: str) -> SessionError:
        """The error of a row, counted from 0."""
        return SessionError(f"{self.path}: line {self.lines[row]}: {text}")

    def numbers(self, name: str) -> NDArray[np.float64]:
        """(M,): a column's values, NaN for `nan` and empty cells; SessionError that names the line of anything else."""
        cells = self.column(name)
        self.check_readable(name)
        if all(cells) and _PLAIN.fullmatch("\n".join(cells)):
            try:
                return self._check_finite(name, np.array(cells).astype(np.float64))
            except ValueError:
                pass  # the line of the fault is found below
        return self._check_finite(name, np.array([self._number(row, name, text) for row, text in enumerate(cells)]))

    def _check_finite(self, name: str, values: NDArray[np.float64]) -> NDArray[np.float64]:
        if np.isinf(values).any():
            row = int(np.flatnonzero(np.isinf(values))[0])
            raise self.fault(row, f"{name} is {self.column(name)[row]!r}, not a finite number")
        return values

    def _number(self, row: int, name: str, text: str) -> float:
        if not text or text.casefold() == "nan":
            return math.nan
        if text.casefold().lstrip("+-") in ("inf", "infinity"):
            return math.inf
        if not _PLAIN.fullmatch(text):
            raise self.fault(row, f"{name} is {text!r}, not a number; write it without a unit, or leave the cell empty")
        try:
            return float(text)
        except ValueError:
            raise self.fault(row, f"{name} is {text!r}, not a number") from None

    def whole_numbers(self, name: str, most: int) -> NDArray[np.int64]:
        """(M,): a column's values, from 0 on below `most`; SessionError that names the line of anything else. 3.0 is 3;
        a number with an exponent has lost digits in a spreadsheet."""
        cells = self.column(name)
        self.check_readable(name)
        found = np.empty(len(cells), np.int64)
        for row, text in enumerate(cells):
            whole, _, rest = text.partition(".")
            if "e" in text.casefold() and _is_number(text):
                raise self.fault(
                    row, f"{name} is {text!r}, which a spreadsheet has rounded; export the column as text, all digits"
                )
            if not (whole.isascii() and whole.isdecimal()) or rest.strip("0") or int(whole) >= most:
                raise self.fault(row, f"{name} is {text!r}, not a whole number from 0 on below {most}")
            found[row] = int(whole)
        return found

    def check_readable(self, name: str) -> None:
        """SessionError when a number of this column has two readings."""
        at = self.find(name)
        if at is not None and at in self.ambiguous:
            raise SessionError(
                f"{self.path}: line {self.ambiguous[at]}: {name} may be read in two ways: its commas may be decimal "
                "signs, or stand between thousands; write points as decimal signs, and nothing between thousands"
            )


def is_spreadsheet(path: Path) -> bool:
    """Return whether the name says that it is a table."""
    return path.suffix.lower() in SUFFIXES


def read_spreadsheet(path: Path) -> Spreadsheet:
    """The table of a file, whose first line names the columns; rows and unnamed columns without any text are left out.

    SessionError when it is no table, no text, or a row has not as many cells as the first line.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise SessionError(describe_unreadable(path, error)) from error
    text = _decode(path, data)
    lines, skipped = text.splitlines(), 0
    first = lines[0].strip().strip('"') if lines else ""
    delimiter = first[4:5] if first.casefold().startswith("sep=") else ""
    if delimiter:
        text, skipped = "\n".join(lines[1:]), 1
    rows, numbers = _split(path, text, delimiter, skipped)
    if not rows:
        return Spreadsheet(path, (), (), [], {})
    return _make_spreadsheet(path, rows, numbers)


def _decode(path: Path, data: bytes) -> str:
    """The text, with newlines as line ends."""
    if data.startswith(_WORKBOOKS):
        raise SessionError(f"{path}: is a workbook of a spreadsheet program, not a table; save it as CSV")
    encoding = next((name for bom, name in _BOMS if data.startswith(bom)), "")
    if not encoding and b"\0" in data[:200]:
        encoding = "utf-16-le" if data[1:2] == b"\0" else "utf-16-be"
    for each in [encoding] if encoding else ["utf-8", "cp1252"]:  # the latter: Windows programs of western Europe
        try:
            text = data.decode(each).removeprefix("\ufeff")
        except UnicodeDecodeError:
            continue
        if "\0" not in text:
            return text.replace("\r\n", "\n").replace("\r", "\n")
    raise SessionError(f"{path}: cannot be read as a CSV table: it is not text; save it as CSV, UTF-8")


def _split(path: Path, text: str, delimiter: str, skipped: int) -> tuple[list[list[str]], list[int]]:
    """The rows that have any text, and their lines; the first one names the columns."""
    head = next((line for line in text.split("\n") if line.strip()), "")
    delimiter = delimiter or max(_DELIMITERS, key=lambda one: (head.count(one), -_DELIMITERS.index(one)))
    if delimiter not in head and len(head.split()) > 1:
        found = [(line.split(), number) for number, line in enumerate(text.split("\n"), 1 + skipped)]
    else:
        reader = csv.reader(io.StringIO(text), delimiter=delimiter, strict=True)
        found: list[tuple[list[str], int]] = []
        try:
            for row in reader:
                found.append(([cell.strip() for cell in row], reader.line_num + skipped))
        except csv.Error as error:
            line = reader.line_num + skipped
            raise SessionError(f"{path}: line {line}: cannot be read as a CSV table ({error})") from error
    kept = [(row, number) for row, number in found if any(row)]
    return [row for row, _ in kept], [number for _, number in kept]


def _make_spreadsheet(path: Path, rows: list[list[str]], numbers: list[int]) -> Spreadsheet:
    head = rows[0]
    width = max(at for at, name in enumerate(head, 1) if name)
    for row, number in zip(rows[1:], numbers[1:], strict=True):
        if len(row) < width or any(row[len(head) :]):
            raise SessionError(
                f"{path}: line {number} has not as many cells as the first line ({len(row)}, not {width})"
            )
    kept = [at for at, name in enumerate(head) if name]
    names = tuple(head[at] for at in kept)
    if len(set(names)) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise SessionError(f"{path}: has two columns {twice}; give one of them another name")
    cells = [[row[at] for row in rows[1:]] for at in kept]
    signs = [_find_decimal_sign(column) for column in cells]
    own = {sign for sign in signs if sign in (_POINT, _COMMA)}
    ambiguous: dict[int, int] = {}
    for at, sign in enumerate(signs):
        if len(own) == 1 and (sign == _EITHER or (sign == _UNSTATED and own == {_COMMA})):
            (sign,) = own  # 1,234 or 1.234 alone: the other columns decide, if they agree
        if sign in (_EITHER, _CONTRADICTION):
            ambiguous[at] = numbers[1 + next(row for row, text in enumerate(cells[at]) if "," in text)]
        elif sign == _COMMA or any("," in text or _SPACED.match(text) or "\u2212" in text for text in cells[at]):
            cells[at] = [_rewrite(text, sign or _POINT) for text in cells[at]]
    return Spreadsheet(path, names, tuple(cells), numbers[1:], ambiguous)


def _find_decimal_sign(cells: list[str]) -> str:
    """Return which sign is the decimal one in a column, or one of the other answers above."""
    text = "\n".join(cells)
    if "," not in text and "." not in text:
        return _UNSTATED
    votes = {_vote(cell) for cell in set(cells)}
    if {_POINT, _COMMA} <= votes:
        return _CONTRADICTION
    return next((sign for sign in (_POINT, _COMMA, _EITHER) if sign in votes), _UNSTATED)


def _vote(text: str) -> str:
    """Return what one cell says of the decimal sign of its column."""
    match = _NUMBER.fullmatch(text)
    if match is None:
        return _UNSTATED
    body, exponent = _SPACES.sub("", match[2]), match[3]
    commas, points = body.count(","), body.count(".")
    if commas and points:
        return _COMMA if body.rindex(",") > body.rindex(".") else _POINT
    if commas + points == 0:
        return _UNSTATED
    sign, other = (_COMMA, _POINT) if commas else (_POINT, _COMMA)
    if commas + points > 1:
        return other if _is_grouped(body, sign) else _UNSTATED
    if exponent or not _is_grouped(body, sign):
        return sign
    return _EITHER if commas else _UNSTATED


def _is_grouped(body: str, sign: str) -> bool:
    """Return whether the digits stand in threes, as in 1,234,567."""
    first, *others = body.split(sign)
    return 1 <= len(first) <= 3 and first[0] != "0" and all(len(other) == 3 for other in others)


def _rewrite(text: str, decimal: str) -> str:
    """A number with a point and nothing between thousands; other text as it is."""
    match = _NUMBER.fullmatch(text)
    if match is None:
        return text
    body = match[2]
    if _SPACES.search(body):
        if not _SPACED.fullmatch(body):
            return text
        body = _SPACES.sub("", body)
    thousands = _COMMA if decimal == _POINT else _POINT
    whole, *rest = body.split(decimal)
    if len(rest) > 1 or thousands in "".join(rest) or (thousands in whole and not _is_grouped(whole, thousands)):
        return text
    sign = "-" if match[1] in ("-", "\u2212") else ""
    return sign + whole.replace(thousands, "") + ("." + rest[0] if rest else "") + (match[3] or "")


def _is_number(text: str) -> bool:
    try:
        return math.isfinite(float(text))
    except ValueError:
        return False
