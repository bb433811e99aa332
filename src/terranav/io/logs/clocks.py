"""The clock of a log: wild stamps thrown out, counters that started again carried on, restarts told apart.

Nothing here knows a format. All series of a log share one clock, so it is mended once, over all rows in the order in
which they stand in the file.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from datetime import UTC, datetime, timedelta

import numpy as np
from numpy.typing import NDArray

from terranav.core.recording import FloatArray
from terranav.io.logs.found import Series

#: a stamp this far from the median of its seven neighbours in the file is damage [s]
WILD_S = 10.0
#: a clock that falls back by more than this has started again; less is a late row [s]
RESTART_S = 2.0
#: a silence of more than this ends a run: no INS carries on over it [s]
SILENCE_S = 3600.0
_NEIGHBOURS = 7
_GPS_ZERO = datetime(1980, 1, 6, tzinfo=UTC)
#: first GPS week at which UTC lags GPS by so many seconds (IERS bulletins C 45, 49, 52)
_LEAPS = ((1930, 18), (1851, 17), (1695, 16), (0, 15))
_WEEK_COUNT = 1024
#: no autopilot log is older than this GPS week (October 2008): an earlier one has rolled over
_FIRST_WEEK = 1500


def one_run(parts: Sequence[Series], wrap_s: float | None, in_order: bool = True) -> tuple[list[Series], list[str]]:
    """Put the series of a log on one rising clock.

    Parameters
    ----------
    parts : sequence of Series
    wrap_s : float, optional
        Period after which the clock starts again from 0 [s]; such a step is no restart.
    in_order : bool
        Whether the order of rows is known across series. Where it is not, every series is taken for one rising clock.

    Returns
    -------
    parts : list of Series
        The rows of the longest run (the one with most positions), each sorted by time, one row a time.
    remarks : list of str
        What was thrown out, and why.
    """
    parts, remarks = _without_wild(parts)
    if not parts:
        return [], remarks
    which = np.concatenate([np.full(len(part), i) for i, part in enumerate(parts)])
    row = np.concatenate([np.arange(len(part)) for part in parts])
    order = [part.order if in_order else part.time_s for part in parts]
    in_file = np.argsort(np.concatenate(order), kind="stable")
    which, row = which[in_file], row[in_file]
    time = np.concatenate([part.time_s for part in parts])[in_file]
    if wrap_s is not None and time.size > 1 and np.abs(np.diff(time)).max() > wrap_s / 2:
        unwrapped = np.unwrap(time, period=wrap_s)
        if abs(unwrapped[-1] - time[-1]) > wrap_s / 2:
            remarks.append(f"the clock started again from 0 (its counter holds {wrap_s:g} s) and was carried on")
        time = unwrapped
    run = _runs(time)
    wanted = np.isin(which, [i for i, part in enumerate(parts) if part.role in ("own", "gnss")])
    counts = np.bincount(run[wanted] if wanted.any() else run, minlength=int(run[-1]) + 1)
    best = int(counts.argmax())
    if counts.size > 1:
        remarks.append(_told(time, run, best))
    kept = run == best
    return [_in_order(part, row, time, kept & (which == i)) for i, part in enumerate(parts)], remarks


def _without_wild(parts: Sequence[Series]) -> tuple[list[Series], list[str]]:
    """The series without the rows whose stamps are damage; those that keep a row."""
    kept, lost = [], 0
    for part in parts:
        good = ~_wild(part.time_s)
        lost += int(np.count_nonzero(~good))
        kept.append(part if good.all() else part.rows(good))
    told = [f"{lost} rows with a time stamp far from their neighbours' were left out"] if lost else []
    return [part for part in kept if len(part)], told


def _wild(time: FloatArray) -> NDArray[np.bool_]:
    """(n,) whether a stamp is far from the median of its neighbours in the file."""
    return np.asarray(np.abs(time - median_around(time)) > WILD_S)


def median_around(values: FloatArray) -> FloatArray:
    """(n,) the median of each value and its three neighbours on either side; the values themselves where n < 7.

    Beyond the ends the values are mirrored in the point of the end, so that a steady slope stays one.
    """
    half = _NEIGHBOURS // 2
    if values.size < _NEIGHBOURS:
        return values
    before, after = 2 * values[0] - values[half:0:-1], 2 * values[-1] - values[-2 : -2 - half : -1]
    padded = np.concatenate([before, values, after])
    return np.asarray(np.median(np.lib.stride_tricks.sliding_window_view(padded, _NEIGHBOURS), axis=1))


def _runs(time: FloatArray) -> NDArray[np.int64]:
    """(n,) number of the run that each row belongs to: a new one where the clock falls back or is silent for long."""
    starts = np.zeros(time.size, dtype=np.int64)
    newest, seen = float(time[0]), 0
    for i in (np.flatnonzero((np.diff(time) < -RESTART_S) | (np.diff(time) > SILENCE_S)) + 1).tolist():
        newest = max(newest, float(time[seen:i].max()))
        if time[i] < newest - RESTART_S or time[i] > newest + SILENCE_S:
            starts[i] = 1
            newest = float(time[i])
        seen = i
    return np.cumsum(starts)


def _told(time: FloatArray, run: NDArray[np.int64], best: int) -> str:
    """The remark on a clock that started again."""
    inside = time[run == best]
    others = int(np.count_nonzero(run != best))
    return (
        f"the clock steps {int(run[-1])} times (a restart, a set clock or a silence of more than {SILENCE_S:g} s): the "
        f"run with most positions was read, {inside.max() - inside.min():.1f} s; {others} rows of others were left out"
    )


def _in_order(part: Series, row: NDArray[np.int64], time: FloatArray, kept: NDArray[np.bool_]) -> Series:
    """The kept rows of one series, sorted by time, the first of each time."""
    times, first = np.unique(time[kept], return_index=True)
    return replace(part.rows(row[kept][first]), time_s=times)


def utc_of_gps(week: int, seconds: float) -> tuple[datetime, bool]:
    """UTC of a GPS week and second of the week, and whether the week had rolled over (its counter holds 1024).

    UTC = GPS time - 15..18 leap seconds, those from 2009 on (IERS bulletins C); no leap second is foreseen by 2026.
    """
    rolled = 0 < week < _FIRST_WEEK
    while week < _FIRST_WEEK:
        week += _WEEK_COUNT
    leap_s = next(leap for first, leap in _LEAPS if week >= first)
    return _GPS_ZERO + timedelta(weeks=week, seconds=seconds - leap_s), rolled
