"""The times of a foreign table: text with zones, dates and times of day in columns of their own, counted seconds."""

from __future__ import annotations

from collections.abc import Callable
from datetime import UTC, datetime, timedelta, timezone

import numpy as np

from terranav.core.recording import FloatArray
from terranav.io.table_units import SECONDS
from terranav.io.text_table import TextTable
from terranav.io.toml_table import TomlTable

_UNIX = datetime(1970, 1, 1, tzinfo=UTC)
_DAY_S = 86400.0
_FORMATS = "'iso', 'unix', 'seconds' or a pattern such as '%Y/%m/%d %H:%M:%S'"


def times_of(table: TextTable, spec: TomlTable) -> tuple[FloatArray, datetime | None]:
    """Read the times of every row as the [time] table of a columns file says.

    Parameters
    ----------
    table : TextTable
    spec : TomlTable
        [time]; its keys are described in io/tables.py.

    Returns
    -------
    seconds : (n,) [s]
        Since `zero` or, without one, since an unknown instant; NaN where the row has no time.
    zero : datetime or None
        In UTC.
    """
    zero, zone = _zero(spec), _zone(spec)
    rollover = spec.flag("rollover", False)
    if "rate_hz" in spec:
        rate_hz = spec.number("rate_hz", 1.0, above=0.0)
        seconds: FloatArray = (table.row - 1) / rate_hz
        return seconds, zero
    columns = _columns(spec)
    form = spec.text("format", _FORMATS) or "iso"
    if form in ("unix", "seconds"):
        factor = SECONDS[spec.choice("unit", SECONDS, "s")]
        if len(columns) != 1:
            spec.fail("columns", f"one column for format {form!r}")
        counts = table.numbers(columns[0])
        # differences of the raw counts are exact where the counts in seconds are not
        first = float(counts[np.isfinite(counts)][0]) if np.isfinite(counts).any() else 0.0
        seconds = (counts - first) * factor
        zero = _UNIX if form == "unix" else zero
        if zero is None:
            seconds += first * factor
        else:
            zero += timedelta(seconds=first * factor)
    elif form == "iso" or "%" in form:
        seconds, zero = _from_text(table, columns, form, zone, zero)
    else:
        spec.fail("format", _FORMATS)
    return _unrolled(seconds) if rollover else seconds, zero


def _columns(spec: TomlTable) -> list[str]:
    """The source columns that together say the time."""
    column, columns = spec.text("column", "the name of a column"), spec.texts("columns")
    if column is not None and columns is None:
        return [column]
    if column is None and columns:
        return columns
    spec.missing("column", 'one of column = "...", columns = ["...", "..."] or rate_hz = ...')


def _zone(spec: TomlTable) -> timezone:
    """The offset from UTC of texts that carry none."""
    text = spec.text("zone") or "+00:00"
    try:
        offset = datetime.strptime(text, "%z").utcoffset()
    except ValueError:
        spec.fail("zone", "an offset from UTC such as '+01:00'")
    return timezone(offset or timedelta())


def _zero(spec: TomlTable) -> datetime | None:
    """The instant from which times count."""
    value = spec.value("zero")
    if value is None:
        return None
    try:
        stamp = value if isinstance(value, datetime) else datetime.fromisoformat(value)
    except (TypeError, ValueError):
        spec.fail("zero", "a date and time such as '2021-01-20T00:00:00Z'")
    return (stamp if stamp.tzinfo else stamp.replace(tzinfo=UTC)).astimezone(UTC)


def _from_text(
    table: TextTable, columns: list[str], form: str, zone: timezone, midnight: datetime | None
) -> tuple[FloatArray, datetime | None]:
    """Times from texts; a pattern without a date counts from `midnight`."""
    parts = [table.texts(column) for column in columns]
    texts = np.array([" ".join(row) if all(row) else "" for row in zip(*parts, strict=True)], dtype=object)
    parse: Callable[[str], datetime]
    if form == "iso":
        parse, expected = datetime.fromisoformat, "a time such as 2021-01-20T17:14:42Z"
    else:
        parse, expected = (lambda text: datetime.strptime(text, form)), f"a time like {form}"
    stamps = [
        None if stamp is None else stamp if stamp.tzinfo else stamp.replace(tzinfo=zone)
        for stamp in table.parsed(" + ".join(columns), texts, parse, expected)
    ]
    has_date = form == "iso" or any(code in form for code in ("%d", "%j", "%D", "%x", "%c"))
    known = [stamp for stamp in stamps if stamp is not None]
    if not known:
        return np.full(len(table), np.nan), None
    first = known[0] if has_date else known[0].replace(hour=0, minute=0, second=0, microsecond=0)
    seconds = np.array([np.nan if stamp is None else (stamp - first).total_seconds() for stamp in stamps])
    return seconds, first.astimezone(UTC) if has_date else midnight


def _unrolled(seconds: FloatArray) -> FloatArray:
    """Add a day after each jump back by more than half a day."""
    known = np.isfinite(seconds)
    days = np.cumsum(np.diff(seconds[known], prepend=seconds[known][:1]) < -_DAY_S / 2)
    seconds = seconds.copy()
    seconds[known] += days * _DAY_S
    return seconds
