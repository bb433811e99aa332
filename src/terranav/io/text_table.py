"""Delimited text as columns of numbers, exactly: every cell goes through float(), which rounds correctly.

Rows of a wrong length and cells that are no number are errors that name the row and the column.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from terranav.core.checks import nearest_name
from terranav.core.errors import DataError
from terranav.core.recording import FloatArray
from terranav.io.files import existing_file

Texts = NDArray[np.object_]


@dataclass(frozen=True)
class Layout:
    r"""How a text file is a table.

    Attributes
    ----------
    delimiter : str
        One character, or 'whitespace' (any run of it), or 'fixed' (columns of the given widths).
    widths : tuple of int
        Characters per column, for 'fixed'.
    names : tuple of str or None
        The columns' names where the file has no header row; columns beyond them have none.
    skip_lines : int
        Lines before the header row (or the first row of data).
    comment : str
        What follows it in a line is not read; empty for none.
    null : tuple of str or float
        Cells that mean 'no reading': texts as they stand, numbers by value. An empty cell always does.
    decimal_comma : bool
    encoding : str
    """

    delimiter: str = ","
    widths: tuple[int, ...] = ()
    names: tuple[str, ...] | None = None
    skip_lines: int = 0
    comment: str = ""
    null: tuple[str | float, ...] = ()
    decimal_comma: bool = False
    encoding: str = "utf-8-sig"


@dataclass(frozen=True, eq=False)
class TextTable:
    """The cells of a table, and which row of the file (from 1, without the header) each stands in."""

    path: str
    names: tuple[str, ...]
    cells: Texts
    row: NDArray[np.int64]
    layout: Layout

    def __len__(self) -> int:
        return int(self.row.size)

    def select(self, rows: NDArray[Any]) -> TextTable:
        """The rows that a mask or an index picks."""
        return replace(self, cells=self.cells[rows], row=self.row[rows])

    def texts(self, name: str) -> Texts:
        """The cells of a column as text; '' where there is no reading."""
        texts = self._column(name)
        null = self._null_texts(())
        return np.array(["" if text in null else text for text in texts], dtype=object)

    def numbers(self, name: str, null: Sequence[str | float] = ()) -> FloatArray:
        """The cells of a column as numbers, NaN where there is no reading; DataError for anything else."""
        null_texts = self._null_texts(null)
        texts = ["nan" if text in null_texts else text for text in self._column(name)]
        if self.layout.decimal_comma:
            texts = [text.replace(",", ".") for text in texts]
        try:
            values = np.array([to_float(text) for text in texts], dtype=np.float64)
        except ValueError:
            self._bad_cell(name, next(i for i, text in enumerate(texts) if not is_number(text)), "a number or nothing")
        for number in (*self.layout.null, *null):
            if not isinstance(number, str):
                values[values == number] = np.nan
        return values

    def parsed(self, name: str, texts: Texts, parse: Callable[[str], Any], expected: str) -> list[Any]:
        """`parse` of every text that is not empty, None for the rest; DataError where it raises ValueError."""
        values: list[Any] = []
        for i, text in enumerate(texts):
            try:
                values.append(parse(text) if text else None)
            except (ValueError, OverflowError):
                raise DataError(f"{self.path}: {name} in row {self.row[i]} is {text!r}, expected {expected}") from None
        return values

    def _column(self, name: str) -> Texts:
        """The raw cells of a column."""
        if name not in self.names:
            known = [repr(known) for known in self.names if known]
            near = nearest_name(name, [known for known in self.names if known])
            raise DataError(f"{self.path}: no column {name!r}{near}; the table has {', '.join(known)}")
        if self.names.count(name) > 1:
            raise DataError(f"{self.path}: column {name!r} stands {self.names.count(name)} times, expected once")
        cells: Texts = self.cells[:, self.names.index(name)]
        return cells

    def _null_texts(self, more: Sequence[str | float]) -> set[str]:
        """Every text that means 'no reading'."""
        return {"", *[value for value in (*self.layout.null, *more) if isinstance(value, str)]}

    def _bad_cell(self, name: str, i: int, expected: str) -> NoReturn:
        """Raise for one cell."""
        seen = self._column(name)[i]
        raise DataError(f"{self.path}: {name} in row {self.row[i]} is {seen!r}, expected {expected}")


def to_float(text: str) -> float:
    """The nearest float; ValueError where Python would take 1_000, which no table means."""
    if "_" in text:
        raise ValueError(text)
    return float(text)


def is_number(text: str) -> bool:
    """Whether `to_float` takes it."""
    try:
        to_float(text)
    except ValueError:
        return False
    return True


def read_text_table(path: str | Path, what: str, layout: Layout | None = None) -> TextTable:
    """Read a text table.

    Parameters
    ----------
    path : str or Path
    what : str
        What the file should be, for messages.
    layout : Layout, optional
        Comma-separated with a header row unless given.

    Raises
    ------
    DataError
        When the file is missing, a folder, empty or no text, and for rows of a wrong length.
    """
    layout = layout or Layout()
    file = existing_file(path, what)
    try:
        with file.open(encoding=layout.encoding, newline="") as stream:
            lines = iter(stream)
            for _ in range(layout.skip_lines):
                next(lines, None)
            rows = [[cell.strip() for cell in row] for row in _split(lines, layout)]
    except (UnicodeDecodeError, csv.Error):
        raise DataError(f"{path}: is not a text table in {layout.encoding}, expected {what}") from None
    except OSError as problem:
        raise DataError(f"{path}: cannot be read ({problem.strerror}), expected {what}") from None
    if any("\0" in cell for row in rows[:100] for cell in row):
        raise DataError(f"{path}: has NUL characters and is not a text table, expected {what}")
    if not rows:
        raise DataError(f"{path}: holds no row at all, expected {what}")
    names, data = (rows[0], rows[1:]) if layout.names is None else (_padded(str(path), layout.names, rows[0]), rows)
    for number, row in enumerate(data, start=1):
        if len(row) != len(names):
            raise DataError(f"{path}: row {number} has {len(row)} cells, expected {len(names)}")
    cells = np.array(data, dtype=object).reshape(len(data), len(names))
    return TextTable(str(path), tuple(names), cells, np.arange(1, len(data) + 1), layout)


def _padded(path: str, names: Sequence[str], first: Sequence[str]) -> list[str]:
    """The given names, and '' for the columns beyond them."""
    if len(names) > len(first):
        raise DataError(f"{path}: row 1 has {len(first)} cells, expected at least the {len(names)} that are named")
    return [*names, *[""] * (len(first) - len(names))]


def _split(lines: Iterator[str], layout: Layout) -> Iterator[list[str]]:
    """The cells of each line that is not blank."""
    if layout.comment:
        lines = (line.split(layout.comment, 1)[0] for line in lines)
    lines = (line for line in lines if line.strip())
    if layout.delimiter == "whitespace":
        return (line.split() for line in lines)
    if layout.delimiter == "fixed":
        edges = [0, *np.cumsum(layout.widths).tolist()]
        return ([line[a:b] for a, b in pairwise(edges)] for line in lines)
    return csv.reader(lines, delimiter=layout.delimiter, skipinitialspace=True)


def finite_or_nan(value: float) -> str:
    """A float as the shortest text that float() turns back into it; nothing for NaN."""
    return "" if math.isnan(value) else repr(value)
