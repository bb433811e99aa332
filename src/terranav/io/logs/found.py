"""What a reader found in a log: named series, each with its clock, unit, height reference and limits.

Every reader of `terranav.io.logs` returns a `Found`; `terranav.io.logs.assembly` makes a Recording of it. A series is
of one role, and the role says its columns:

    gnss      lat_deg, lon_deg, alt_m and, where logged, vn_mps, ve_mps, vd_mps    the receiver's: the truth
    own       lat_deg, lon_deg, alt_m and, where logged, vn_mps, ve_mps, vd_mps    the autopilot's own estimate
    velocity  vn_mps, ve_mps, vd_mps
    attitude  roll_deg, pitch_deg, heading_deg
    baro      altitude_m
    laser     range_m      slant range down the body's axis; NaN where the sensor said that it has none
    radar     range_m      range to the nearest ground (radar and ultrasonic sensors); NaN likewise
    depth     depth_m      below the surface, positive down
    fusing    gnss         1 where the autopilot's estimate used GNSS, 0 where not
    airspeed  airspeed_mps true airspeed
    imu       gyro_*_radps, accel_*_mps2      angular rate and specific force about and along the body's forward,
                                              right and down axes; read only when asked for
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from terranav.core.recording import ATTITUDE, VELOCITY, FloatArray

POSITION = ("lat_deg", "lon_deg", "alt_m")
IMU = ("gyro_x_radps", "gyro_y_radps", "gyro_z_radps", "accel_x_mps2", "accel_y_mps2", "accel_z_mps2")
ROLES: dict[str, tuple[str, ...]] = {
    "gnss": POSITION,
    "own": POSITION,
    "velocity": VELOCITY,
    "attitude": ATTITUDE,
    "baro": ("altitude_m",),
    "laser": ("range_m",),
    "radar": ("range_m",),
    "depth": ("depth_m",),
    "fusing": ("gnss",),
    "airspeed": ("airspeed_mps",),
    "imu": IMU,
}
SEA_LEVEL = "above mean sea level"
ELLIPSOID = "above the WGS-84 ellipsoid"
TAKE_OFF = "above the place where the barometer was set"
PRESSURE = "pressure altitude of the standard atmosphere"
#: height reference -> the vertical datum it is, in the words of terranav.maps.datum
DATUMS = {SEA_LEVEL: "mean sea level", ELLIPSOID: "ellipsoid"}
NO_HEIGHT = "no height logged: 0 m stands for it"
#: standard atmosphere (ICAO Doc 7488): altitude = _ISA_M (1 - (p / 1013.25 hPa) ^ _ISA_POWER)
_ISA_M, _ISA_POWER, _ISA_HPA = 44330.77, 0.190263, 1013.25


@dataclass(frozen=True, eq=False)
class Series:
    """One named series of a log.

    Attributes
    ----------
    role : str
        A key of ROLES.
    source : str
        The messages it was made of, as the format calls them.
    time_s : (n,) [s]
        On the log's one clock.
    values : mapping of str to (n,) arrays
        The columns of its role; NaN is 'nothing measured'.
    order : (n,) int64
        Where in the file each row stood (any rising count): what tells a clock that stepped back from a late row.
    height : str
        What its heights count from; '' where it has none.
    limits_m : tuple of float, optional
        Smallest and largest range that the altimeter can measure [m].
    uses_gnss : bool, optional
        Whether GNSS went into it; None: not known.
    """

    role: str
    source: str
    time_s: FloatArray
    values: Mapping[str, FloatArray]
    order: NDArray[np.int64]
    height: str = ""
    limits_m: tuple[float, float] | None = None
    uses_gnss: bool | None = None

    def __len__(self) -> int:
        return int(self.time_s.size)

    def rows(self, keep: NDArray[Any]) -> Series:
        """The rows that a mask or an index picks."""
        values = {key: array[keep] for key, array in self.values.items()}
        return replace(self, time_s=self.time_s[keep], values=values, order=self.order[keep])


@dataclass(frozen=True, eq=False)
class Found:
    """Everything that a reader found in one log.

    Attributes
    ----------
    path : Path
    format : str
        The format in words.
    series : list of Series
        At most one of a role.
    vehicle : dict
        Plain facts of the vehicle: firmware, type, system id.
    start_utc : datetime, optional
        The instant of time 0 of the log's clock, in UTC.
    remarks : list of str
        What the reader noticed, damage first, a line each.
    whole : bool
        False where part of the file could not be read.
    wrap_s : float, optional
        The period after which the log's clock starts again from 0 [s].
    in_order : bool
        Whether `order` compares across series: False where the format keeps each apart.
    """

    path: Path
    format: str
    series: list[Series]
    vehicle: dict[str, Any] = field(default_factory=dict)
    start_utc: datetime | None = None
    remarks: list[str] = field(default_factory=list)
    whole: bool = True
    wrap_s: float | None = None
    in_order: bool = True


def series(
    role: str,
    source: str,
    time_s: ArrayLike,
    values: Mapping[str, ArrayLike],
    order: ArrayLike | None = None,
    **more: Any,
) -> Series:
    """Make a Series of anything array-like; rows without a finite time are left out, infinities become NaN.

    Parameters
    ----------
    role, source : str
    time_s : (n,) [s]
    values : mapping of str to (n,)
    order : (n,) int, optional
        The order of the rows unless given.
    **more
        height, limits_m, uses_gnss.
    """
    time = np.array(time_s, dtype=np.float64).reshape(-1)
    place = np.arange(time.size) if order is None else np.array(order)
    columns = {key: np.array(value, dtype=np.float64).reshape(-1) for key, value in values.items()}
    for column in columns.values():
        column[~np.isfinite(column)] = np.nan
    there = np.isfinite(time) & (np.abs(time) < 1e11)
    made = Series(role, source, time, columns, place.astype(np.int64), **more)
    return made if there.all() else made.rows(there)


def pressure_altitude_m(pressure_hpa: ArrayLike) -> FloatArray:
    """Altitude of a pressure in the standard atmosphere (ICAO Doc 7488), any shape [hPa] -> [m]; NaN where p <= 0."""
    pressure = np.array(pressure_hpa, dtype=np.float64)
    pressure[~(pressure > 0)] = np.nan
    return np.asarray(_ISA_M * (1.0 - (pressure / _ISA_HPA) ** _ISA_POWER))


def true_airspeed_mps(equivalent_mps: ArrayLike, altitude_m: ArrayLike) -> FloatArray:
    """True airspeed of what a pitot tube tells [m/s] at an altitude of the standard atmosphere, shapes that broadcast.

    v = v_e sqrt(rho0 / rho), and up to 11 km rho / rho0 = (T / T0)^(1 / _ISA_POWER - 1), T / T0 = 1 - h / _ISA_M.
    """
    cooling = 1.0 - np.clip(np.asarray(altitude_m, dtype=np.float64), -1000.0, 11000.0) / _ISA_M
    return np.asarray(np.asarray(equivalent_mps, dtype=np.float64) * cooling ** (-0.5 * (1.0 / _ISA_POWER - 1.0)))


def velocity_from_course(speed_mps: ArrayLike, course_deg: ArrayLike) -> tuple[FloatArray, FloatArray]:
    """North and east velocity of a speed over ground and its course, shapes (n,) [m/s], [deg] -> [m/s]."""
    speed, course = np.asarray(speed_mps, dtype=np.float64), np.radians(np.asarray(course_deg, dtype=np.float64))
    return speed * np.cos(course), speed * np.sin(course)


def attitude_deg(w: ArrayLike, x: ArrayLike, y: ArrayLike, z: ArrayLike) -> dict[str, FloatArray]:
    """Roll, pitch and heading (n,) [deg] of quaternions body-to-NED, scalar first (Diebel 2006, eq. 290)."""
    a, b, c, d = (np.asarray(part, dtype=np.float64) for part in (w, x, y, z))
    norm = np.sqrt(a * a + b * b + c * c + d * d)
    norm[~((norm > 0.5) & (norm < 2.0))] = np.nan
    a, b, c, d = a / norm, b / norm, c / norm, d / norm
    roll = np.arctan2(2 * (a * b + c * d), 1 - 2 * (b * b + c * c))
    pitch = np.arcsin(np.clip(2 * (a * c - d * b), -1.0, 1.0))
    heading = np.arctan2(2 * (a * d + b * c), 1 - 2 * (c * c + d * d))
    return {
        "roll_deg": np.degrees(roll),
        "pitch_deg": np.degrees(pitch),
        "heading_deg": np.degrees(heading) % 360.0,
    }
