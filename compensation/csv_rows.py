"""Rows of a CSV table that any program may have written."""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from thermostand.foundation.errors import SessionError

Row = Mapping[str, str]


def read_rows(path: Path, needed: Sequence[str], why: str) -> tuple[list[dict[str, str]], Sequence[str]]:
    """The rows, and the names of all columns; SessionError when it is no table, lacks one of the `needed` columns
    (`why` follows the name of the first), or a row has not as many cells as the first line."""
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            reader = csv.DictReader(file, strict=True)
            rows = list(reader)
            columns = reader.fieldnames or ()
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise SessionError(f"{path}: cannot be read as a CSV table ({error})") from error
    if missing := [name for name in needed if name not in columns]:
        raise SessionError(f"{path}: has no column {missing[0]}; {why}")
    for line, row in enumerate(rows, 2):
        if None in row or None in row.values():
            raise SessionError(f"{path}: line {line} has not as many cells as the first line")
    return rows, columns


def numbers(path: Path, rows: Sequence[Row], column: str) -> NDArray[np.float64]:
    """(M,): a column's values, NaN for `nan` and empty cells; SessionError that names the line of anything else."""
    return np.array([_number(path, line, column, row[column].strip()) for line, row in enumerate(rows, 2)])


def _number(path: Path, line: int, column: str, text: str) -> float:
    try:
        value = float(text) if text else math.nan
    except ValueError:
        raise SessionError(f"{path}: line {line}: {column} is {text!r}, not a number") from None
    if math.isinf(value):
        raise SessionError(f"{path}: line {line}: {column} is {text!r}, not a finite number")
    return value
