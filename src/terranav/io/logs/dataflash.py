"""ArduPilot DataFlash logs (.BIN).

Messages and their units (AP_Logger/LogStructure.h and the LogStructure.h of the libraries; the multipliers of the
format letters are applied, so all are in base units):

- GPS (instance 0 and 1; GPS2 before 4.0): Status 3 and more is a fix in three dimensions; Lat, Lng [deg], Alt [m, above
  mean sea level], Spd [m/s], GCrs [deg], VZ [m/s, down]; GWk, GMS [week, ms].
- POS: the vehicle's canonical position, Lat, Lng [deg], Alt [m, above mean sea level]. Where it is not logged: XKF1
  (NKF1) PN, PE, PD [m] about the origin of the filter (ORGN type 0); where that is not, AHR2.
- ATT: Roll, Pitch, Yaw [deg]. XKF1 (NKF1): VN, VE, VD [m/s]. BARO: Alt [m] above where it was set.
- RFND: Dist [m], Stat (4 good, 2 too near, 3 too far), Orient (25 down); its limits are parameters.
- ARSP: Airspeed [m/s], equivalent: what the pitot tube tells. IMU: GyrX, GyrY, GyrZ [rad/s], AccX, AccY, AccZ [m/s^2]
  of the body's forward, right and down axes.
- XKF4 (NKF4): SS, the status of the filter; bit 13: it uses GNSS.
- TERR holds heights of the autopilot's own map, which no sensor measured: it is not read.
"""

from __future__ import annotations

from dataclasses import replace
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terranav.core.errors import DataError
from terranav.core.recording import FloatArray
from terranav.io.logs.clocks import utc_of_gps
from terranav.io.logs.dataflash_rows import Rows, read_rows
from terranav.io.logs.found import (
    IMU,
    SEA_LEVEL,
    TAKE_OFF,
    Found,
    Series,
    series,
    true_airspeed_mps,
    velocity_from_course,
)

Table = dict[str, NDArray[Any]]
_WANTED = ("GPS", "GPS2", "POS", "AHR2", "ATT", "BARO", "RFND", "ORGN", "XKF1", "NKF1", "XKF4", "NKF4", "ARSP")
_DEGREE_M = 0.011131884502145034 * 1e7  # LOCATION_SCALING_FACTOR
_DOWN, _GOOD, _FIX_3D = 25, 4, 3
_USING_GPS = 1 << 13
#: RNGFNDn_TYPE of radars and of ultrasonic sensors, whose wide beam measures to the nearest ground
_WIDE = {2, 11, 13, 23, 30, 33, 39, 41, 42, 43, 44}
_MS_WRAP_S = 2**32 * 1e-3


def read(path: Path, *, imu: bool = False) -> Found:
    """Read a DataFlash log.

    Parameters
    ----------
    path : Path
    imu : bool
        Whether to read the inertial sensors.

    Returns
    -------
    Found

    Raises
    ------
    DataError
        When the file cannot be read or no message in it is whole.
    ConfigError
        When pymavlink is not installed.
    """
    rows = read_rows(path, (*_WANTED, "IMU") if imu else _WANTED)
    if not rows.counts or set(rows.counts) <= {"FMT", "FMTU", "UNIT", "MULT"}:
        raise DataError(f"{path}: is no DataFlash log, or damaged: it holds no whole message but definitions")
    remarks, whole = _damage(rows)
    tables = {name: table for name, table in rows.tables.items() if _clock(table) is not None}
    made = [_gnss(tables), _own(tables), _velocity(tables), _attitude(tables), _baro(tables), _fusing(tables)]
    made += [_airspeed(tables), _imu(tables)]
    parts = [part for part in (*made, *_altimeters(tables, rows.parameters, remarks)) if part is not None]
    start = _start_utc(tables, remarks)
    if rows.counts.get("TERR"):
        remarks.append("TERR is the autopilot's own map, which no sensor measured: it was not read")
    vehicle = {"firmware": next((text for text in rows.texts if text.startswith("Ardu")), "")}
    wrap_s = _MS_WRAP_S if any("TimeUS" not in table for table in tables.values()) else None
    return Found(path, "ArduPilot DataFlash log", parts, vehicle, start, remarks, whole, wrap_s)


def _damage(rows: Rows) -> tuple[list[str], bool]:
    """What is to be said of damage, and whether the log is whole."""
    remarks = []
    if rows.damaged:
        remarks.append(f"the file is damaged: {rows.damaged} bytes between messages that are whole were left out")
    if rows.unread > 0:
        remarks.append(f"the file is cut: its last {rows.unread} bytes hold no whole message and were not read")
    if rows.zeros:
        remarks.append(f"the last {rows.zeros} bytes of the file are zero and were not read")
    return remarks, not (rows.damaged or rows.unread)


def _clock(table: Table) -> FloatArray | None:
    """(n,) seconds since start-up, or None."""
    for key, unit_s in (("TimeUS", 1e-6), ("TimeMS", 1e-3)):
        if key in table and table[key].dtype.kind in "iu":
            return np.asarray(table[key].astype(np.float64) * unit_s)
    return None


def _series(role: str, source: str, table: Table, values: dict[str, Any], **more: Any) -> Series:
    """A Series of one table's rows."""
    clock = _clock(table)
    assert clock is not None
    return series(role, source, clock, values, table["_offset"], **more)


def _first(tables: dict[str, Table], *columns: str, names: tuple[str, ...]) -> tuple[str, Table] | None:
    """The first of these tables with the columns, one instance: of a filter (C) the primary core, else the first."""
    for name in names:
        table = tables.get(name)
        if table is None or not all(column in table and table[column].dtype.kind in "iuf" for column in columns):
            continue
        key = next((key for key in ("C", "I", "Instance") if key in table), None)
        if key is not None:
            present = np.unique(table[key]).tolist()
            primary = _primary_core(tables) if key == "C" else None
            rows = table[key] == (primary if primary in present else present[0])
            table = {column: values[rows] for column, values in table.items()}
        return name, table
    return None


def _primary_core(tables: dict[str, Table]) -> int | None:
    """The core of the filter that steered for most of the log (PI of XKF4), None where that is not logged."""
    table = tables.get("XKF4", tables.get("NKF4", {}))
    if "PI" not in table or table["PI"].dtype.kind not in "iu":
        return None
    cores, counts = np.unique(table["PI"], return_counts=True)
    return int(cores[counts.argmax()])


def _gnss(tables: dict[str, Table]) -> Series | None:
    """The receiver with the most fixes in three dimensions."""
    receivers = []
    for name in ("GPS", "GPS2"):
        table = tables.get(name)
        if table is None or not all(key in table for key in ("Status", "Lat", "Lng", "Alt")):
            continue
        for instance in np.unique(table["I"]).tolist() if "I" in table else [None]:
            rows = table["Status"] >= _FIX_3D
            if instance is not None:
                rows = rows & (table["I"] == instance)
            source = name if instance is None else f"{name} instance {instance}"
            receivers.append((source, {key: values[rows] for key, values in table.items()}))
    if not receivers:
        return None
    source, best = max(receivers, key=lambda receiver: receiver[1]["Lat"].size)
    values = {"lat_deg": best["Lat"], "lon_deg": best["Lng"], "alt_m": best["Alt"]}
    if "Spd" in best and "GCrs" in best:
        values["vn_mps"], values["ve_mps"] = velocity_from_course(best["Spd"], best["GCrs"])
        if "VZ" in best:
            values["vd_mps"] = best["VZ"]
    return _series("gnss", source, best, values, height=SEA_LEVEL, uses_gnss=True)


def _own(tables: dict[str, Table]) -> Series | None:
    """The autopilot's own position."""
    for names in (("POS",), ("XKF1", "NKF1"), ("AHR2",)):
        if names[0] != "XKF1":
            found = _first(tables, "Lat", "Lng", "Alt", names=names)
            if found is not None:
                name, table = found
                values = {"lat_deg": table["Lat"], "lon_deg": table["Lng"], "alt_m": table["Alt"]}
                return _series("own", name, table, values, height=SEA_LEVEL)
            continue
        found, origin = _first(tables, "PN", "PE", "PD", names=names), _origin(tables)
        if found is not None and origin is not None:
            name, table = found
            lat, lon = _offset(origin[0], origin[1], table["PN"].astype(float), table["PE"].astype(float))
            values = {"lat_deg": lat, "lon_deg": lon, "alt_m": origin[2] - table["PD"].astype(float)}
            return _series("own", f"{name} about ORGN", table, values, height=SEA_LEVEL)
    return None


def _offset(lat_deg: float, lon_deg: float, north_m: FloatArray, east_m: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Latitude and longitude (n,) [deg] of the filter's coordinates [m], as AP_Common Location::offset has them.

    One length for a degree of latitude everywhere, and for one of longitude that times the cosine of the middle
    latitude. The autopilot made the coordinates with it, so it, and not the ellipsoid, gives back what it meant.
    """
    lat = lat_deg + north_m / _DEGREE_M
    middle = np.radians(0.5 * (lat + lat_deg))
    return lat, lon_deg + east_m / (_DEGREE_M * np.maximum(np.cos(middle), 0.01))


def _origin(tables: dict[str, Table]) -> tuple[float, float, float] | None:
    """Where the filter's coordinates count from: latitude, longitude [deg], altitude [m]."""
    table = tables.get("ORGN")
    if table is None or not all(key in table for key in ("Lat", "Lng", "Alt")):
        return None
    rows = np.flatnonzero((table["Type"] == 0) if "Type" in table else np.ones(table["Lat"].size, dtype=bool))
    if rows.size == 0:
        return None
    lat, lon, alt = (float(table[key][rows[-1]]) for key in ("Lat", "Lng", "Alt"))
    return lat, lon, alt


def _velocity(tables: dict[str, Table]) -> Series | None:
    """The filter's velocity."""
    found = _first(tables, "VN", "VE", "VD", names=("XKF1", "NKF1"))
    if found is None:
        return None
    name, table = found
    return _series("velocity", name, table, {"vn_mps": table["VN"], "ve_mps": table["VE"], "vd_mps": table["VD"]})


def _attitude(tables: dict[str, Table]) -> Series | None:
    """The vehicle's attitude."""
    found = _first(tables, "Roll", "Pitch", "Yaw", names=("ATT", "XKF1", "NKF1", "AHR2"))
    if found is None:
        return None
    name, table = found
    values = {"roll_deg": table["Roll"], "pitch_deg": table["Pitch"], "heading_deg": table["Yaw"] % 360.0}
    return _series("attitude", name, table, values)


def _baro(tables: dict[str, Table]) -> Series | None:
    """The first barometer."""
    found = _first(tables, "Alt", names=("BARO",))
    if found is None:
        return None
    return _series("baro", "BARO", found[1], {"altitude_m": found[1]["Alt"]}, height=TAKE_OFF, uses_gnss=False)


def _airspeed(tables: dict[str, Table]) -> Series | None:
    """The first airspeed sensor, its reading made true airspeed by the altitude."""
    found = _first(tables, "Airspeed", names=("ARSP",))
    own = _own(tables)
    if found is None or own is None or not len(own):
        return None
    name, table = found
    part = _series("airspeed", name, table, {"airspeed_mps": table["Airspeed"]}, uses_gnss=False)
    altitude = np.interp(part.time_s, own.time_s, own.values["alt_m"])
    return replace(part, values={"airspeed_mps": true_airspeed_mps(part.values["airspeed_mps"], altitude)})


def _imu(tables: dict[str, Table]) -> Series | None:
    """The first inertial sensor."""
    names = ("GyrX", "GyrY", "GyrZ", "AccX", "AccY", "AccZ")
    found = _first(tables, *names, names=("IMU",))
    if found is None:
        return None
    values = dict(zip(IMU, (found[1][name] for name in names), strict=True))
    return _series("imu", found[0], found[1], values, uses_gnss=False)


def _fusing(tables: dict[str, Table]) -> Series | None:
    """Whether the filter used GNSS."""
    found = _first(tables, "SS", names=("XKF4", "NKF4"))
    if found is None:
        return None
    name, table = found
    using = (table["SS"].astype(np.uint64) & np.uint64(_USING_GPS)) != 0
    return _series("fusing", f"{name} SS bit 13", table, {"gnss": using})


def _altimeters(tables: dict[str, Table], parameters: dict[str, float], remarks: list[str]) -> list[Series]:
    """The laser and the radar that look down, one of each: the one with most good readings."""
    table = tables.get("RFND")
    if table is None:
        return []
    made = [part for part in _rangefinders(table, parameters) if part is not None]
    if len(made) < _sensors(table):
        remarks.append(f"{_sensors(table) - len(made)} range finders do not look down and were left out")
    best: dict[str, Series] = {}
    for part in sorted(made, key=lambda part: np.count_nonzero(np.isfinite(part.values["range_m"]))):
        if part.role in best:
            remarks.append(f"{best[part.role].source} has fewer readings than {part.source} and was left out")
        best[part.role] = part
    return list(best.values())


def _sensors(table: Table) -> int:
    """How many range finders RFND tells of."""
    key = next((key for key in ("Instance", "I") if key in table), None)
    return np.unique(table[key]).size if key else sum(f"Dist{n}" in table for n in (1, 2))


def _rangefinders(table: Table, parameters: dict[str, float]) -> list[Series | None]:
    """Every range finder: RFND has an instance in each row since 4.0, before that two sensors side by side."""
    key = next((key for key in ("Instance", "I") if key in table), None)
    if key is None:
        names = [(n, {f: f"{f}{n}" for f in ("Dist", "Stat", "Orient")}) for n in (1, 2) if f"Dist{n}" in table]
        both = [(n, {f: table[name] for f, name in by.items() if name in table}) for n, by in names]
        shared = {name: table[name] for name in ("TimeUS", "TimeMS", "_offset") if name in table}
        return [_rangefinder(n, fields | shared, parameters) for n, fields in both]
    made = []
    for instance in np.unique(table[key]).tolist():
        rows = table[key] == instance
        made.append(_rangefinder(int(instance) + 1, {f: values[rows] for f, values in table.items()}, parameters))
    return made


def _rangefinder(number: int, table: Table, parameters: dict[str, float]) -> Series | None:
    """One range finder, None where it does not look down."""
    if "Dist" not in table or ("Orient" in table and np.median(table["Orient"]) != _DOWN):
        return None
    distance = table["Dist"].astype(float)
    limits = _limits(number, parameters)
    good = table["Stat"] == _GOOD if "Stat" in table else distance > 0
    good &= distance > 0
    if limits is not None and "Stat" not in table:
        good &= (distance >= limits[0]) & (distance <= limits[1])
    kind = parameters.get(f"RNGFND{number}_TYPE", parameters.get("RNGFND_TYPE" if number == 1 else "", 0.0))
    role = "radar" if int(kind if np.isfinite(kind) else 0) in _WIDE else "laser"
    values = {"range_m": np.where(good, distance, np.nan)}
    return _series(role, f"RFND {number}", table, values, limits_m=limits, uses_gnss=False)


def _limits(number: int, parameters: dict[str, float]) -> tuple[float, float] | None:
    """Smallest and largest range [m]: RNGFNDn_MIN, _MAX [m] since 4.7, RNGFNDn_MIN_CM, _MAX_CM [cm] before."""
    for prefix in (f"RNGFND{number}", *(["RNGFND"] if number == 1 else ["RNGFND2"])):
        for suffix, unit_m in (("", 1.0), ("_CM", 0.01)):
            low, high = parameters.get(f"{prefix}_MIN{suffix}"), parameters.get(f"{prefix}_MAX{suffix}")
            if low is not None and high is not None and 0 <= low < high < np.inf:
                return low * unit_m, high * unit_m
    return None


def _start_utc(tables: dict[str, Table], remarks: list[str]) -> datetime | None:
    """UTC of the autopilot's start-up, by the week and time of the first fix."""
    table = tables.get("GPS")
    if table is None or not all(key in table for key in ("GWk", "GMS", "Status")):
        return None
    fixed = np.flatnonzero((table["Status"] >= _FIX_3D) & (table["GWk"] > 0))
    clock = _clock(table)
    if fixed.size == 0 or clock is None:
        return None
    first = int(fixed[fixed.size // 2])
    week, milliseconds = int(table["GWk"][first]), float(table["GMS"][first])
    instant, rolled = utc_of_gps(week, milliseconds * 1e-3)
    if rolled:
        remarks.append(f"the receiver's GPS week {week} has rolled over: 1024 weeks were added to its dates")
    return instant - timedelta(seconds=float(clock[first]))
