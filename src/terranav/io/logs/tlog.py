"""MAVLink telemetry logs (.tlog): an 8-byte big-endian stamp [us since 1970] before every frame; decoded by pymavlink.

Messages and their units (MAVLink common.xml):

- GPS_RAW_INT (GPS2_RAW): fix_type 3 and more is a fix in three dimensions; lat, lon [1e-7 deg], alt [mm, above mean sea
  level], vel [cm/s], cog [cdeg].
- GLOBAL_POSITION_INT: the autopilot's own position, lat, lon [1e-7 deg], alt [mm, above mean sea level], vx, vy, vz
  [cm/s, NED]. ATTITUDE: roll, pitch, yaw [rad].
- SCALED_PRESSURE: press_abs [hPa], whose altitude in the standard atmosphere is taken.
- DISTANCE_SENSOR: current, min, max distance [cm], orientation 25 looks down, type 0 laser, 1 ultrasound, 2 infrared, 3
  radar; a reading at or beyond its limits is out of range. RANGEFINDER (ArduPilot): distance [m], no limits, no type.
- ESTIMATOR_STATUS and EKF_STATUS_REPORT do not say whether GNSS is used: with a fix it is taken for not known.
- TERRAIN_REPORT holds heights of the autopilot's own map, which no sensor measured: it is not read.

The clock is time_boot_ms where a message has it (32 bits: it starts again from 0 after 49.7 days); messages without it
get the host's stamp, moved to that clock by the usual difference of the two. A receiver's time_usec, which may be UTC,
is taken where it counts on the vehicle's clock: links deliver in bursts, and 0.2 s at 50 m/s is 10 m of the truth.
"""

from __future__ import annotations

import re
import struct
from array import array
from collections.abc import Iterator
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terranav.core.errors import DataError
from terranav.core.recording import FloatArray
from terranav.io.logs.found import PRESSURE, SEA_LEVEL, Found, Series, pressure_altitude_m, series, velocity_from_course
from terranav.io.logs.opening import STAMPS_US, frame_bytes
from terranav.io.logs.raw import GIVE_UP_BYTES, SPARE_BYTES, library, mapped

#: message -> its number and the fields that are read, the boot clock's first
_FIELDS: dict[str, tuple[int, tuple[str, ...]]] = {
    "GPS_RAW_INT": (24, ("fix_type", "lat", "lon", "alt", "vel", "cog", "time_usec")),
    "GPS2_RAW": (124, ("fix_type", "lat", "lon", "alt", "vel", "cog", "time_usec")),
    "GLOBAL_POSITION_INT": (33, ("time_boot_ms", "lat", "lon", "alt", "vx", "vy", "vz")),
    "ATTITUDE": (30, ("time_boot_ms", "roll", "pitch", "yaw")),
    "SCALED_PRESSURE": (29, ("time_boot_ms", "press_abs")),
    "DISTANCE_SENSOR": (
        132,
        ("time_boot_ms", "current_distance", "min_distance", "max_distance", "orientation", "type", "id"),
    ),
    "RANGEFINDER": (173, ("distance",)),
    "HEARTBEAT": (0, ("autopilot", "type")),
}
_NUMBERS = {number: name for name, (number, _) in _FIELDS.items()}
_DOWN, _FIX_3D = 25, 3
_ROLES = {0: "laser", 1: "radar", 2: "laser", 3: "radar"}
_AUTOPILOTS = {3: "ArduPilot", 12: "PX4"}
_WRAP_MS = 2.0**32
_GROUND_STATIONS = 250
#: a stamp that differs by more from when its message came counts on another clock [s]
_SAME_CLOCK_S = 5.0
#: the two high bytes of a stamp in these decades
_STAMP = re.compile(rb"\0[\x03-\x0e]", re.DOTALL)


@dataclass(eq=False)
class _Frames:
    """The wanted messages of one system: a row of numbers each, with stamp [s] and place in the file."""

    rows: dict[str, Any] = field(default_factory=lambda: {name: array("d") for name in _FIELDS})

    def table(self, name: str) -> NDArray[np.float64]:
        """(n, 2 + fields): place, stamp [s], fields."""
        width = 2 + len(_FIELDS[name][1])
        return np.frombuffer(self.rows[name], dtype=np.float64).reshape(-1, width)


def read(path: Path) -> Found:
    """Read a telemetry log; of several vehicles the one with most messages.

    Parameters
    ----------
    path : Path

    Returns
    -------
    Found

    Raises
    ------
    DataError
        When no message in the file is whole.
    ConfigError
        When pymavlink is not installed.
    """
    dialect = library("pymavlink.dialects.v20.ardupilotmega", path, "a MAVLink log (.tlog)")
    systems: dict[int, _Frames] = {}
    with mapped(path) as (data, padding):
        walk = _Walk(data, dialect)
        for system, name, row in walk:
            systems.setdefault(system, _Frames()).rows[name].extend(row)
        damaged, unread, zeros = walk.damaged, walk.unread, walk.zeros + padding
    vehicles = {system: frames for system, frames in systems.items() if system < _GROUND_STATIONS} or systems
    if not vehicles:
        raise DataError(f"{path}: holds no whole MAVLink message of a position, an attitude or a sensor")
    system = max(vehicles, key=lambda number: sum(len(rows) for rows in vehicles[number].rows.values()))
    remarks = []
    if damaged:
        remarks.append(f"the file is damaged: {damaged} bytes between messages that are whole were left out")
    if unread:
        remarks.append(f"the file is cut: its last {unread} bytes hold no whole message and were not read")
    if zeros:
        remarks.append(f"the last {zeros} bytes of the file are zero and were not read")
    if len(vehicles) > 1:
        remarks.append(f"{len(vehicles)} vehicles speak in this log: system {system}, with most messages, was read")
    parts, start = _parts(vehicles[system], remarks)
    heartbeat = vehicles[system].table("HEARTBEAT")
    vehicle: dict[str, Any] = {"system_id": system}
    if len(heartbeat):
        vehicle["firmware"] = _AUTOPILOTS.get(int(np.median(heartbeat[:, 2])), "")
    whole = not damaged and not unread
    return Found(path, "MAVLink telemetry log", parts, vehicle, start, remarks, whole, _WRAP_MS * 1e-3)


class _Walk:
    """Iterates over (system, message name, row) of the wanted messages; counts the bytes that belong to none."""

    def __init__(self, data: Any, dialect: Any) -> None:
        self.data, self.dialect, self.damaged, self.unread = data, dialect, 0, 0
        self.zeros = 0
        self.link = dialect.MAVLink(None)

    def __iter__(self) -> Iterator[tuple[int, str, list[float]]]:
        data, size = self.data, len(self.data)
        at = last_good = 0
        while at + 17 <= size:
            length = 8 + frame_bytes(data, at + 8) if data[at + 8] in (0xFD, 0xFE) else 0
            if length and at + length <= size and self._stamped(at) and self._follows(at + length, size):
                found = self._decoded(at, length)
                if found is not None:
                    if found[1]:
                        yield found
                    self.damaged += at - last_good
                    at += length
                    last_good = at
                    continue
            found_stamp = _STAMP.search(data, at + 1, min(size, last_good + GIVE_UP_BYTES))
            if found_stamp is None:
                break
            at = found_stamp.start()
        if size - last_good > SPARE_BYTES or any(data[last_good:size]):
            self.unread = size - last_good
        else:
            self.zeros = size - last_good

    def _stamped(self, at: int) -> bool:
        """Whether a stamp of these decades stands here."""
        (stamp,) = struct.unpack_from(">Q", self.data, at)
        return bool(STAMPS_US[0] < stamp < STAMPS_US[1])

    def _follows(self, at: int, size: int) -> bool:
        """Whether another stamp and frame can begin here: so it looks, or the file ends."""
        return at + 9 > size or self.data[at + 8] in (0xFD, 0xFE) or not any(self.data[at : at + 9])

    def _decoded(self, at: int, length: int) -> tuple[int, str, list[float]] | None:
        """System, name and row of the message here; an empty name for one not wanted, None for damage."""
        data = self.data
        second = data[at + 8] == 0xFD
        number = data[at + 15] | data[at + 16] << 8 | data[at + 17] << 16 if second else data[at + 13]
        name = _NUMBERS.get(number, "")
        if not name:
            return 0, "", []
        try:
            message = self.link.decode(bytearray(data[at + 8 : at + length]))
            (stamp,) = struct.unpack_from(">Q", data, at)
            row = [float(at), stamp * 1e-6, *(float(getattr(message, key)) for key in _FIELDS[name][1])]
        except (self.dialect.MAVError, AttributeError, TypeError, ValueError, struct.error):
            return None
        return int(message.get_srcSystem()), name, row


def _parts(frames: _Frames, remarks: list[str]) -> tuple[list[Series], datetime | None]:
    """Every series on the vehicle's clock, and UTC of its start-up."""
    tables = {name: frames.table(name) for name in _FIELDS}
    booted = np.concatenate([tables[name][:, :3] for name, (_, keys) in _FIELDS.items() if keys[0] == "time_boot_ms"])
    booted = booted[np.argsort(booted[:, 0], kind="stable")]
    clock = _Clock(booted)
    made = [
        _gnss(tables, clock),
        _own(tables["GLOBAL_POSITION_INT"], clock),
        _attitude(tables["ATTITUDE"], clock),
        _baro(tables["SCALED_PRESSURE"], clock),
        *_altimeters(tables, clock, remarks),
    ]
    return [part for part in made if part is not None and len(part)], clock.start_utc


class _Clock:
    """The vehicle's clock: its own stamps, and the host's moved to it."""

    def __init__(self, booted: NDArray[np.float64]) -> None:
        self.places = booted[:, 0]
        self.lags = booted[:, 1] - booted[:, 2] * 1e-3
        usual = float(np.median(self.lags)) if len(booted) else 0.0
        in_years = len(booted) and STAMPS_US[0] < usual * 1e6 < STAMPS_US[1]
        self.start_utc = datetime(1970, 1, 1, tzinfo=UTC) + timedelta(seconds=usual) if in_years else None

    def host(self, table: NDArray[np.float64]) -> FloatArray:
        """(n,) host stamps on the vehicle's clock: by the median difference of the 101 stamps around each [s]."""
        if not len(self.places):
            return np.asarray(table[:, 1])
        around = np.clip(np.searchsorted(self.places, table[:, 0]), 0, len(self.places) - 1)
        starts = np.clip(around - 50, 0, max(len(self.places) - 101, 0))
        width = min(101, len(self.places))
        windows = np.lib.stride_tricks.sliding_window_view(self.lags, width)
        needed, back = np.unique(starts, return_inverse=True)
        medians = np.array([np.median(windows[start]) for start in needed])
        return np.asarray(table[:, 1] - medians[back])

    def stamped(self, table: NDArray[np.float64], column: int) -> FloatArray:
        """(n,) stamps of a column [us] where they count on the vehicle's clock, else the host's moved to it [s]."""
        arrived = self.host(table)
        own = table[:, column] * 1e-6 % (_WRAP_MS * 1e-3)
        return np.where(np.abs(own - arrived) < _SAME_CLOCK_S, own, arrived)

    @staticmethod
    def boot(table: NDArray[np.float64]) -> FloatArray:
        """(n,) the vehicle's own stamps [s]."""
        return np.asarray(table[:, 2] * 1e-3)


def _gnss(tables: dict[str, NDArray[np.float64]], clock: _Clock) -> Series | None:
    """The receiver with the most fixes in three dimensions."""
    fixed = {name: tables[name][tables[name][:, 2] >= _FIX_3D] for name in ("GPS_RAW_INT", "GPS2_RAW")}
    name = max(fixed, key=lambda key: len(fixed[key]))
    table = fixed[name]
    if not len(table):
        return None
    values: dict[str, FloatArray] = {"lat_deg": table[:, 3] / 1e7, "lon_deg": table[:, 4] / 1e7}
    values["alt_m"] = table[:, 5] / 1e3
    # 65535 stands for 'not known' in both
    known = (table[:, 6] != 65535) & (table[:, 7] != 65535)
    north, east = velocity_from_course(table[:, 6] / 100.0, table[:, 7] / 100.0)
    values["vn_mps"], values["ve_mps"] = np.where(known, north, np.nan), np.where(known, east, np.nan)
    return series("gnss", name, clock.stamped(table, 8), values, table[:, 0], height=SEA_LEVEL, uses_gnss=True)


def _own(table: NDArray[np.float64], clock: _Clock) -> Series | None:
    """The autopilot's own position and velocity."""
    if not len(table):
        return None
    values = {"lat_deg": table[:, 3] / 1e7, "lon_deg": table[:, 4] / 1e7, "alt_m": table[:, 5] / 1e3}
    values |= {key: table[:, 6 + i] / 100.0 for i, key in enumerate(("vn_mps", "ve_mps", "vd_mps"))}
    return series("own", "GLOBAL_POSITION_INT", clock.boot(table), values, table[:, 0], height=SEA_LEVEL)


def _attitude(table: NDArray[np.float64], clock: _Clock) -> Series:
    """The vehicle's attitude."""
    roll, pitch, yaw = np.degrees(table[:, 3:6].T)
    values = {"roll_deg": roll, "pitch_deg": pitch, "heading_deg": yaw % 360.0}
    return series("attitude", "ATTITUDE", clock.boot(table), values, table[:, 0])


def _baro(table: NDArray[np.float64], clock: _Clock) -> Series:
    """The barometer."""
    values = {"altitude_m": pressure_altitude_m(table[:, 3])}
    return series("baro", "SCALED_PRESSURE", clock.boot(table), values, table[:, 0], height=PRESSURE, uses_gnss=False)


def _altimeters(tables: dict[str, NDArray[np.float64]], clock: _Clock, remarks: list[str]) -> list[Series]:
    """The laser and the radar that look down, the one of each with most readings in range."""
    table = tables["DISTANCE_SENSOR"]
    down = table[table[:, 6] == _DOWN]
    if len(down) < len(table):
        remarks.append(f"{len(table) - len(down)} rows of range sensors that do not look down were left out")
    best: dict[str, Series] = {}
    for number in np.unique(down[:, 8]).tolist():
        part = _range(down[down[:, 8] == number], clock)
        other = best.get(part.role)
        if other is None or np.isfinite(part.values["range_m"]).sum() > np.isfinite(other.values["range_m"]).sum():
            best[part.role] = part
        if other is not None:
            remarks.append(f"several sensors of one kind look down: {best[part.role].source} was read")
    table = tables["RANGEFINDER"]
    if not best and len(table):
        values = {"range_m": np.where(table[:, 2] > 0, table[:, 2], np.nan)}
        best["laser"] = series("laser", "RANGEFINDER", clock.host(table), values, table[:, 0], uses_gnss=False)
    return list(best.values())


def _range(table: NDArray[np.float64], clock: _Clock) -> Series:
    """One range sensor, NaN where out of range."""
    current, low, high = (table[:, i] / 100.0 for i in (3, 4, 5))
    bounded = high > low
    # at its upper limit an autopilot reports the limit itself
    good = (current > 0) & (~bounded | ((current >= low) & (current < high)))
    limits = (float(np.median(low)), float(np.median(high))) if bounded.all() else None
    role = _ROLES.get(int(np.median(table[:, 7])), "laser")
    source = f"DISTANCE_SENSOR {int(table[0, 8])}"
    values = {"range_m": np.where(good, current, np.nan)}
    return series(role, source, clock.boot(table), values, table[:, 0], limits_m=limits, uses_gnss=False)
