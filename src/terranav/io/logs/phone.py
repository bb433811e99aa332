"""A phone's sensor log as CSV: GNSS and pressure, one row a sample (columns named latitude, longitude, altitude, ...).

The GNSS altitude of phones counts from the mean sea level (iOS, and Android as its loggers write it). Speed and course
are GNSS's. Roll, pitch and yaw are the phone's own, not the vehicle's, and the magnetometer sees the vehicle: none of
them is used.
"""

from __future__ import annotations

import csv
import math
from array import array
from collections.abc import Iterator
from datetime import UTC, datetime
from itertools import islice
from pathlib import Path

import numpy as np

from terranav.core.errors import DataError
from terranav.core.recording import FloatArray
from terranav.io.logs.found import (
    NO_HEIGHT,
    PRESSURE,
    SEA_LEVEL,
    Found,
    Series,
    pressure_altitude_m,
    series,
    velocity_from_course,
)

_NAMES = {
    "time": ("time", "timestamp", "seconds_elapsed"),
    "lat": ("latitude",),
    "lon": ("longitude",),
    "alt": ("altitude",),
    "speed": ("speed",),
    "course": ("bearing", "course"),
    "pressure": ("pressure",),
}
#: counts since 1970 by size: seconds, ms, us, ns
_UNIX = ((1e17, 1e-9), (1e14, 1e-6), (1e11, 1e-3), (0.0, 1.0))
_MAX_ROWS = 20_000_000


def read(path: Path) -> Found:
    """Read a phone's log.

    Parameters
    ----------
    path : Path
        CSV with a header; latitude, longitude [deg] and time (ISO with or without zone, or a count since 1970 in s, ms,
        us or ns) are needed; altitude [m], speed [m/s], bearing [deg], pressure [hPa] are read where they are.

    Raises
    ------
    DataError
        When a needed column is missing or no row is whole.
    """
    remarks: list[str] = []
    try:
        with path.open(encoding="utf-8-sig", errors="replace", newline="") as stream:
            lines = (line.replace("\0", "") for line in stream)
            header = [name.strip().lower() for name in next(csv.reader(islice(lines, 1)), [])]
            columns, bad = _columns(csv.reader(_whole(lines, remarks)), _places(path, header), len(header))
    except (OSError, csv.Error) as problem:
        raise DataError(f"{path}: cannot be read as CSV ({problem})") from None
    if bad:
        remarks.append(f"{bad} rows are cut or hold no time and were left out")
    if not columns["time"].size:
        raise DataError(f"{path}: no row has a time, expected ISO texts or counts since 1970")
    time_s = columns["time"]
    start_s = float(time_s[0])
    start = datetime.fromtimestamp(start_s, UTC) if 1e8 < start_s < 1e10 else None
    parts = _series(columns, time_s - start_s)
    return Found(path, "phone CSV", parts, start_utc=start, remarks=remarks, whole=not bad)


def _whole(lines: Iterator[str], remarks: list[str]) -> Iterator[str]:
    """The lines without the last where it has no end: its last number may be cut, and still look like one."""
    for line in lines:
        if line.endswith(("\n", "\r")):
            yield line
        elif line.strip():
            remarks.append("the file ends within a line, which may be cut and was left out")


def _places(path: Path, header: list[str]) -> dict[str, int]:
    """Where each wanted column stands."""
    places = {
        key: next(header.index(name) for name in names if name in header)
        for key, names in _NAMES.items()
        if any(name in header for name in names)
    }
    for key in ("time", "lat", "lon"):
        if key not in places:
            raise DataError(f"{path}: no column {_NAMES[key][0]!r}, expected one in a phone's log")
    return places


def _columns(rows: Iterator[list[str]], places: dict[str, int], width: int) -> tuple[dict[str, FloatArray], int]:
    """The wanted columns as numbers, and how many rows were left out."""
    cells = {key: array("d") for key in places}
    bad = 0
    for row in islice(rows, _MAX_ROWS):
        if not row:
            continue
        time_s = _seconds(row[places["time"]].strip()) if len(row) == width else math.nan
        if not math.isfinite(time_s):
            bad += 1
            continue
        for key, place in places.items():
            cells[key].append(time_s if key == "time" else _number(row[place]))
    return {key: np.array(column, dtype=np.float64) for key, column in cells.items()}, bad


def _number(text: str) -> float:
    """A cell as a number, NaN for anything else."""
    try:
        return float(text)
    except ValueError:
        return math.nan


def _seconds(text: str) -> float:
    """Seconds since 1970 of an ISO text or a count; NaN for anything else."""
    count = _number(text)
    if math.isfinite(count):
        return count * next(factor for least, factor in _UNIX if abs(count) >= least)
    try:
        instant = datetime.fromisoformat(text)
        return (instant if instant.tzinfo else instant.replace(tzinfo=UTC)).timestamp()
    except (ValueError, OverflowError):
        return math.nan


def _series(columns: dict[str, FloatArray], time_s: FloatArray) -> list[Series]:
    """GNSS and barometer."""
    none = np.full(time_s.size, np.nan)
    alt, has_alt = columns.get("alt", none), "alt" in columns
    values = {"lat_deg": columns["lat"], "lon_deg": columns["lon"], "alt_m": alt if has_alt else np.zeros(time_s.size)}
    speed, course = columns.get("speed", none).copy(), columns.get("course", none)
    speed[speed < 0] = np.nan
    if np.isfinite(speed * course).any():
        values["vn_mps"], values["ve_mps"] = velocity_from_course(speed, np.where(course < 0, np.nan, course))
    height = SEA_LEVEL if has_alt else NO_HEIGHT
    parts = [series("gnss", "latitude, longitude, altitude", time_s, values, height=height, uses_gnss=True)]
    baro = pressure_altitude_m(columns.get("pressure", none))
    if np.isfinite(baro).any():
        parts.append(series("baro", "pressure", time_s, {"altitude_m": baro}, height=PRESSURE, uses_gnss=False))
    return parts
