"""Which rows of a foreign table become epochs: those with a good fix, in the order of time, one a time, reachable."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terranav.core.earth import offset_m
from terranav.core.errors import DataError
from terranav.core.recording import LIMITS, REQUIRED, FloatArray
from terranav.io.text_table import TextTable
from terranav.io.toml_table import TomlTable

Rows = NDArray[np.intp]

_LOOK_BACK = 100  # rows: a longer run of false positions in one place would pass for the truth


@dataclass(frozen=True)
class RowPolicy:
    """What to do with rows that cannot be epochs: stop, unless the columns file lets them go.

    Attributes
    ----------
    drop_bad_fix, sort, drop_duplicate_time : bool
    max_speed_mps : float
        Infinite for no limit [m/s].
    """

    drop_bad_fix: bool = False
    sort: bool = False
    drop_duplicate_time: bool = False
    max_speed_mps: float = np.inf


def policy_from(spec: TomlTable) -> RowPolicy:
    """Read the policies of [rows]."""
    return RowPolicy(
        drop_bad_fix=spec.choice("on_bad_fix", ("error", "drop"), "error") == "drop",
        sort=spec.choice("on_unsorted", ("error", "sort"), "error") == "sort",
        drop_duplicate_time=spec.choice("on_duplicate_time", ("error", "drop"), "error") == "drop",
        max_speed_mps=spec.number("max_speed_mps", np.inf, above=0.0),
    )


def kept_rows(table: TextTable, columns: Mapping[str, FloatArray], policy: RowPolicy) -> tuple[Rows, str]:
    """Pick the rows to keep, in the order of time, and tell what became of the others.

    Parameters
    ----------
    table : TextTable
        Knows the rows' numbers in the file.
    columns : mapping of recording column to (n,) array
        At least the required ones.
    policy : RowPolicy

    Returns
    -------
    rows : (k,) indices
    story : str
        Empty when nothing happened.

    Raises
    ------
    DataError
        Naming the first row that the policy does not let pass, or when nothing is left.
    """
    story: list[str] = []
    rows = _with_fix(table, columns, policy, story)
    rows = _in_order(table, columns["time_s"], rows, policy, story)
    rows = _one_a_time(table, columns["time_s"], rows, policy, story)
    if np.isfinite(policy.max_speed_mps):
        rows = _reachable(table, columns, rows, policy.max_speed_mps, story)
    return rows, "".join(f"; {text}" for text in story)


def _with_fix(table: TextTable, columns: Mapping[str, FloatArray], policy: RowPolicy, story: list[str]) -> Rows:
    """The rows that have a time and a position on the globe."""
    good = np.ones(len(table), dtype=bool)
    for key in REQUIRED:
        low, high = LIMITS.get(key, (-np.inf, np.inf))
        wrong = good & ~(np.isfinite(columns[key]) & (columns[key] >= low) & (columns[key] <= high))
        if not wrong.any():
            continue
        if not policy.drop_bad_fix:
            i = int(np.flatnonzero(wrong)[0])
            seen = f"{key} is {'missing' if np.isnan(columns[key][i]) else format(columns[key][i], '.10g')}"
            expected = f"a number in [{low:g}, {high:g}]" if key in LIMITS else "a time"
            raise _refused(table, i, seen, expected, "on_bad_fix = 'drop'")
        story.append(f"{wrong.sum()} dropped without a good {key}")
        good &= ~wrong
    if not good.any():
        raise DataError(f"{table.path}: none of {len(table)} rows has a time and a position, expected at least one")
    return np.flatnonzero(good)


def _in_order(table: TextTable, time_s: FloatArray, rows: Rows, policy: RowPolicy, story: list[str]) -> Rows:
    """The rows sorted by time, equal times in the order of the file."""
    backward = np.flatnonzero(np.diff(time_s[rows]) < 0)
    if not backward.size:
        return rows
    if not policy.sort:
        seen, expected = "the time goes back", "times that increase"
        raise _refused(table, rows[backward[0] + 1], seen, expected, "on_unsorted = 'sort'")
    story.append(f"sorted by time (steps back: {backward.size})")
    return rows[np.argsort(time_s[rows], kind="stable")]


def _one_a_time(table: TextTable, time_s: FloatArray, rows: Rows, policy: RowPolicy, story: list[str]) -> Rows:
    """The first row of each time."""
    again = np.diff(time_s[rows], prepend=-np.inf) == 0
    if not again.any():
        return rows
    if not policy.drop_duplicate_time:
        first = rows[np.flatnonzero(again)[0]]
        seen, expected = "the time is that of another row", "one row a time"
        raise _refused(table, first, seen, expected, "on_duplicate_time = 'drop'")
    story.append(f"{again.sum()} dropped with the time of another row")
    first_of_each: Rows = rows[~again]
    return first_of_each


def _reachable(
    table: TextTable, columns: Mapping[str, FloatArray], rows: Rows, max_speed_mps: float, story: list[str]
) -> Rows:
    """The longest chain of rows in which each can be reached from the one before at the given speed."""
    time_s, lat, lon = (columns[key][rows] for key in REQUIRED[:3])
    length = np.ones(rows.size, dtype=np.int64)
    before = np.full(rows.size, -1, dtype=np.int64)
    for i in range(1, rows.size):
        span = slice(max(0, i - _LOOK_BACK), i)
        metres = np.hypot(*offset_m(lat[span], lon[span], lat[i], lon[i]))
        chain = np.where(metres <= max_speed_mps * (time_s[i] - time_s[span]), length[span], 0)
        best = chain.size - 1 - int(np.argmax(chain[::-1]))  # the latest of equals
        if chain[best]:
            length[i], before[i] = chain[best] + 1, span.start + best
    chosen = [int(np.argmax(length))]
    while before[chosen[-1]] >= 0:
        chosen.append(int(before[chosen[-1]]))
    if 2 * len(chosen) < rows.size:
        share = f"{len(chosen)} of {rows.size} rows"
        raise DataError(
            f"{table.path}: only {share} can be reached at max_speed_mps = {max_speed_mps:g}, expected at least half"
        )
    if len(chosen) < rows.size:
        story.append(f"{rows.size - len(chosen)} dropped as out of reach at {max_speed_mps:g} m/s")
    kept: Rows = rows[chosen[::-1]]
    return kept


def _refused(table: TextTable, i: Any, seen: str, expected: str, remedy: str) -> DataError:
    """An error for one row that names the policy which would let the table pass."""
    return DataError(f"{table.path}: in row {table.row[i]} {seen}, expected {expected} (or set {remedy} under [rows])")
