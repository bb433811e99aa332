"""PX4 logs (.ulg), decoded by pyulog.

Topics and their units, over the firmware's history (PX4 msg/*.msg):

- sensor_gps, vehicle_gps_position: latitude_deg, longitude_deg [deg] and altitude_msl_m [m] since 1.14, before that
  integers lat, lon [1e-7 deg] and alt [mm]; altitudes above mean sea level; fix_type 3 and more is a fix in three
  dimensions; vel_n_m_s, vel_e_m_s, vel_d_m_s [m/s].
- vehicle_global_position: the estimator's lat, lon [deg], alt [m, above mean sea level]. Where it is not logged:
  vehicle_local_position x, y, z [m, NED] about ref_lat, ref_lon, ref_alt, if xy_global says that they are known.
- vehicle_attitude: quaternion, body (forward, right, down) to NED. vehicle_air_data: baro_alt_meter [m].
- distance_sensor: current, min and max distance [m]; orientation 25 looks down; signal_quality 0 is an invalid reading.
- airspeed_validated (airspeed) true_airspeed_m_s [m/s]. sensor_combined: gyro_rad [rad/s], accelerometer_m_s2 [m/s^2]
  of the body's forward, right and down axes, means since the sample before.
- estimator_status_flags cs_gps (cs_gnss_pos since 1.16), before 1.12 bit 2 of estimator_status control_mode_flags: the
  estimator used GNSS.
"""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terranav.core.errors import DataError
from terranav.core.recording import FloatArray
from terranav.io.logs.found import IMU, PRESSURE, SEA_LEVEL, Found, Series, attitude_deg, pressure_altitude_m, series
from terranav.io.logs.raw import library, mapped, silent

Topic = dict[str, NDArray[Any]]
_TOPICS = [
    "sensor_gps",
    "vehicle_gps_position",
    "vehicle_global_position",
    "vehicle_local_position",
    "vehicle_attitude",
    "vehicle_air_data",
    "sensor_baro",
    "distance_sensor",
    "estimator_status",
    "estimator_status_flags",
    "airspeed_validated",
    "airspeed",
]
_DOWN = 25
_GPS_BIT = 1 << 2
_FIX_3D = 3
_SPHERE_M = 6371000.0  # CONSTANTS_RADIUS_OF_EARTH
#: type in distance_sensor: laser, ultrasound, infrared, radar; a wide beam measures to the nearest ground
_ROLES = {0: "laser", 1: "radar", 2: "laser", 3: "radar"}
#: pyulog looks for the next message one byte at a time: after so many steps back the rest is not read
_MAX_STEPS_BACK = 500_000


class _Patient:
    """A mapped file for pyulog: its close does nothing, and it ends early once pyulog steps back too often."""

    def __init__(self, data: Any) -> None:
        self.data, self.tell, self.steps_back, self.cut = data, data.tell, 0, 0

    @property
    def gave_up(self) -> bool:
        """Whether it ended early."""
        return self.steps_back > _MAX_STEPS_BACK

    def seek(self, pos: int, whence: int = 0) -> int:
        """Move, and return the new place as a file does."""
        if whence == 1 and pos < 0:
            self.steps_back += 1
        self.data.seek(pos, whence)
        return int(self.tell())

    def read(self, n: int) -> bytes:
        """Read; note how much was left where less than asked for was: the file is cut there."""
        if self.gave_up:
            return b""
        got: bytes = self.data.read(n)
        self.cut = len(got) if len(got) < n else 0
        return got

    def close(self) -> None:
        """Do nothing."""


def read(path: Path, *, imu: bool = False) -> Found:
    """Read a PX4 log.

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
        When the file is damaged so that pyulog cannot read it.
    ConfigError
        When pyulog is not installed.
    """
    log, remarks, whole = _load(path, [*_TOPICS, "sensor_combined"] if imu else _TOPICS)
    topics = _by_name(log)
    parts = px4_series(topics, remarks)
    utc = _start_utc(topics)
    dropouts = [dropout.duration for dropout in log.dropouts]
    if dropouts:
        remarks.append(
            f"the logger lost data, times: {len(dropouts)}, {sum(dropouts) / 1e3:g} s in all, "
            f"at most {max(dropouts) / 1e3:g} s"
        )
    return Found(path, "PX4 ULog", parts, _vehicle(log), utc, remarks, whole, in_order=False)


def _load(path: Path, names: list[str]) -> tuple[Any, list[str], bool]:
    """The log as pyulog gives it, what is to be said of it, and whether all of it was read."""
    core = library("pyulog.core", path, "a PX4 log (.ulg)")
    remarks: list[str] = []
    with mapped(path) as (data, zeros):
        size, stream = len(data), _Patient(data)
        try:
            with silent(), np.errstate(all="ignore"):
                log = core.ULog(stream, names)
        except Exception as problem:  # noqa: BLE001 - on damage pyulog raises whatever the bytes lead it to
            told = str(problem).splitlines()[:1] or [type(problem).__name__]
            raise DataError(f"{path}: is damaged, or no PX4 log: {told[0]}") from None
        given_up, left = stream.gave_up, size - stream.tell()
        cut = stream.cut if any(data[size - stream.cut :]) else 0
    if given_up:
        remarks.append(f"the file is damaged: the last {left} of its {size} bytes hold no message that can be read")
    if log.file_corruption:
        remarks.append("the file is damaged: messages that cannot be read were left out")
    if cut:
        remarks.append(f"the file is cut: its last {cut} bytes hold no whole message and were not read")
    if zeros:
        remarks.append(f"the last {zeros} bytes of the file are zero and were not read")
    return log, remarks, not (given_up or log.file_corruption or cut)


def px4_series(topics: dict[str, list[Topic]], remarks: list[str]) -> list[Series]:
    """The series that PX4 topics hold.

    Parameters
    ----------
    topics : dict
        By name (sensor_gps, vehicle_global_position, ...) the instances of a topic: fields (n,) by name, one of them
        'timestamp' [us].
    remarks : list of str
        Gains what is to be said of sensors left out.
    """
    made = (*_positions(topics), *_others(topics), _altimeter(topics, remarks))
    return [part for part in made if part is not None and len(part)]


def _by_name(log: Any) -> dict[str, list[Topic]]:
    """The instances of each topic, those with a time stamp and at least one row."""
    topics: dict[str, list[Topic]] = {}
    for item in sorted(log.data_list, key=lambda data: int(data.multi_id)):
        if "timestamp" in item.data and len(item.data["timestamp"]):
            topics.setdefault(item.name, []).append(item.data)
    return topics


def _time_s(topic: Topic) -> FloatArray:
    """(n,) when each row was measured [s]: the sample's own stamp where there is one."""
    stamp = topic["timestamp"].astype(np.float64)
    if "timestamp_sample" in topic:
        sample = topic["timestamp_sample"].astype(np.float64)
        # an empty or absurd stamp of the sample is not believed
        stamp = np.where((sample > 0) & (np.abs(stamp - sample) < 2e6), sample, stamp)
    return np.asarray(stamp * 1e-6)


def _has(topic: Topic, *names: str) -> bool:
    """Whether a topic has all of these fields."""
    return all(name in topic for name in names)


def _positions(topics: dict[str, list[Topic]]) -> list[Series | None]:
    """GNSS and the autopilot's own position."""
    gnss = max(
        (t for name in ("vehicle_gps_position", "sensor_gps") for t in topics.get(name, []) if "fix_type" in t),
        key=lambda t: np.count_nonzero(t["fix_type"] >= _FIX_3D),
        default=None,
    )
    own = next((t for t in topics.get("vehicle_global_position", []) if _has(t, "lat", "lon", "alt")), None)
    if own is not None:
        return [_gnss(gnss), _global(own)]
    return [_gnss(gnss), _local(next(iter(topics.get("vehicle_local_position", [])), None))]


def _gnss(topic: Topic | None) -> Series | None:
    """The receiver's position and velocity where it had a fix in three dimensions."""
    if topic is None:
        return None
    if _has(topic, "latitude_deg", "longitude_deg", "altitude_msl_m"):
        values = {"lat_deg": topic["latitude_deg"], "lon_deg": topic["longitude_deg"], "alt_m": topic["altitude_msl_m"]}
    elif _has(topic, "lat", "lon", "alt"):
        values = {"lat_deg": topic["lat"] / 1e7, "lon_deg": topic["lon"] / 1e7, "alt_m": topic["alt"] / 1e3}
    else:
        return None
    if _has(topic, "vel_n_m_s", "vel_e_m_s", "vel_d_m_s"):
        values |= {f"v{axis}_mps": topic[f"vel_{axis}_m_s"] for axis in "ned"}
    made = series("gnss", "vehicle_gps_position / sensor_gps", _time_s(topic), values, height=SEA_LEVEL, uses_gnss=True)
    fix = topic["fix_type"] >= _FIX_3D
    return made.rows(fix) if len(made) == fix.size else made


def _global(topic: Topic) -> Series:
    """The estimator's position on the globe."""
    values = {"lat_deg": topic["lat"], "lon_deg": topic["lon"], "alt_m": topic["alt"]}
    made = series("own", "vehicle_global_position", _time_s(topic), values, height=SEA_LEVEL)
    good = np.ones(topic["lat"].size, dtype=bool)
    for name in ("lat_lon_valid", "alt_valid"):
        if name in topic:
            good &= topic[name] != 0
    return made.rows(good) if len(made) == good.size else made


def _local(topic: Topic | None) -> Series | None:
    """The estimator's position about its origin, where that is known on the globe."""
    if topic is None or not _has(topic, "x", "y", "z", "ref_lat", "ref_lon", "ref_alt", "xy_global"):
        return None
    lat, lon = _on_sphere(topic["ref_lat"], topic["ref_lon"], topic["x"].astype(float), topic["y"].astype(float))
    values = {"lat_deg": lat, "lon_deg": lon, "alt_m": topic["ref_alt"].astype(float) - topic["z"]}
    made = series("own", "vehicle_local_position", _time_s(topic), values, height=SEA_LEVEL)
    there = (topic["xy_global"] != 0) & (topic.get("z_global", topic["xy_global"]) != 0)
    return made.rows(there) if len(made) == there.size and there.any() else None


def _on_sphere(
    lat_deg: FloatArray, lon_deg: FloatArray, x_m: FloatArray, y_m: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Latitude and longitude (n,) [deg] of PX4's local coordinates [m]: its azimuthal equidistant map of a sphere.

    PX4 src/lib/geo MapProjection::reproject; Snyder 1987, eqs. 20-14 and 20-15. The autopilot made x and y with it, so
    its inverse, and not the ellipsoid, gives back the position it meant.
    """
    lat, lon = np.radians(lat_deg), np.radians(lon_deg)
    x, y = x_m / _SPHERE_M, y_m / _SPHERE_M
    arc = np.hypot(x, y)
    ratio = np.sinc(arc / np.pi)  # sin(arc) / arc
    sine = np.cos(arc) * np.sin(lat) + x * ratio * np.cos(lat)
    east = np.arctan2(y * ratio, np.cos(lat) * np.cos(arc) - np.sin(lat) * x * ratio)
    return np.degrees(np.arcsin(np.clip(sine, -1.0, 1.0))), np.degrees(lon + east)


def _others(topics: dict[str, list[Topic]]) -> list[Series | None]:
    """Velocity, attitude, barometer, airspeed, inertial sensors, and whether GNSS was used."""
    made = (_velocity, _attitude, _baro, _airspeed, _imu, _fusing)
    return [one(topics) for one in made]


def _velocity(topics: dict[str, list[Topic]]) -> Series | None:
    """The estimator's velocity."""
    for topic in topics.get("vehicle_local_position", []):
        if _has(topic, "vx", "vy", "vz"):
            valid = topic["v_xy_valid"] != 0 if "v_xy_valid" in topic else np.ones(topic["vx"].size, dtype=bool)
            values = {
                key: np.where(valid, topic[name].astype(float), np.nan)
                for key, name in zip(("vn_mps", "ve_mps", "vd_mps"), ("vx", "vy", "vz"), strict=True)
            }
            return series("velocity", "vehicle_local_position", _time_s(topic), values)
    return None


def _attitude(topics: dict[str, list[Topic]]) -> Series | None:
    """The estimator's attitude."""
    for topic in topics.get("vehicle_attitude", []):
        if _has(topic, "q[0]", "q[1]", "q[2]", "q[3]"):
            values = attitude_deg(*(topic[f"q[{i}]"] for i in range(4)))
            return series("attitude", "vehicle_attitude", _time_s(topic), values)
    return None


def _baro(topics: dict[str, list[Topic]]) -> Series | None:
    """The barometer's altitude."""
    for topic in topics.get("vehicle_air_data", []):
        if "baro_alt_meter" in topic:
            values = {"altitude_m": topic["baro_alt_meter"]}
            return series("baro", "vehicle_air_data", _time_s(topic), values, height=PRESSURE, uses_gnss=False)
    for topic in topics.get("sensor_baro", []):
        if "pressure" in topic:
            pressure = topic["pressure"].astype(float)
            # hPa until 1.13, Pa since
            pressure = pressure / 100.0 if np.nanmedian(pressure) > 5000.0 else pressure
            values = {"altitude_m": pressure_altitude_m(pressure)}
            return series("baro", "sensor_baro", _time_s(topic), values, height=PRESSURE, uses_gnss=False)
    return None


def _airspeed(topics: dict[str, list[Topic]]) -> Series | None:
    """The airspeed that the autopilot trusts, else the sensor's."""
    for name in ("airspeed_validated", "airspeed"):
        for topic in topics.get(name, []):
            if "true_airspeed_m_s" in topic:
                speed = np.where(topic["true_airspeed_m_s"] > 0, topic["true_airspeed_m_s"].astype(float), np.nan)
                return series("airspeed", name, _time_s(topic), {"airspeed_mps": speed}, uses_gnss=False)
    return None


def _imu(topics: dict[str, list[Topic]]) -> Series | None:
    """The inertial sensors that the estimator used."""
    names = [f"{sensor}[{axis}]" for sensor in ("gyro_rad", "accelerometer_m_s2") for axis in range(3)]
    for topic in topics.get("sensor_combined", []):
        if _has(topic, *names):
            values = dict(zip(IMU, (topic[name] for name in names), strict=True))
            return series("imu", "sensor_combined", _time_s(topic), values, uses_gnss=False)
    return None


def _fusing(topics: dict[str, list[Topic]]) -> Series | None:
    """Whether the estimator used GNSS."""
    for topic in topics.get("estimator_status_flags", []):
        for name in ("cs_gnss_pos", "cs_gps"):
            if name in topic:
                return series("fusing", f"estimator_status_flags {name}", _time_s(topic), {"gnss": topic[name] != 0})
    for topic in topics.get("estimator_status", []):
        if "control_mode_flags" in topic:
            using = (topic["control_mode_flags"].astype(np.uint64) & np.uint64(_GPS_BIT)) != 0
            return series("fusing", "estimator_status control_mode_flags", _time_s(topic), {"gnss": using})
    return None


def _altimeter(topics: dict[str, list[Topic]], remarks: list[str]) -> Series | None:
    """The range sensor that looks down and has most readings in range."""
    sensors = [t for t in topics.get("distance_sensor", []) if _has(t, "current_distance", "type")]
    down = [t for t in sensors if "orientation" not in t or np.median(t["orientation"]) == _DOWN]
    if len(sensors) > len(down):
        remarks.append(f"{len(sensors) - len(down)} of {len(sensors)} range sensors do not look down and were left out")
    made = [_range(topic) for topic in down]
    if len(made) > 1:
        remarks.append(f"{len(made)} range sensors look down: the one with most readings in range was read")
    return max(made, key=lambda part: np.count_nonzero(np.isfinite(part.values["range_m"])), default=None)


def _range(topic: Topic) -> Series:
    """The readings of one range sensor, NaN where out of its limits or said to be invalid."""
    distance = topic["current_distance"].astype(float)
    limits = None
    good = distance > 0
    if _has(topic, "min_distance", "max_distance"):
        low, high = float(np.median(topic["min_distance"])), float(np.median(topic["max_distance"]))
        if 0 <= low < high:
            limits = (low, high)
            good &= (distance >= low) & (distance <= high)
    if "signal_quality" in topic:
        good &= topic["signal_quality"] != 0
    values = {"range_m": np.where(good, distance, np.nan)}
    role = _ROLES.get(int(topic["type"][0]), "laser")
    return series(
        role, f"distance_sensor type {int(topic['type'][0])}", _time_s(topic), values, limits_m=limits, uses_gnss=False
    )


def _start_utc(topics: dict[str, list[Topic]]) -> datetime | None:
    """UTC of time 0 of the autopilot's clock, by the receiver's time."""
    for name in ("vehicle_gps_position", "sensor_gps"):
        for topic in topics.get(name, []):
            if "time_utc_usec" in topic:
                utc = topic["time_utc_usec"].astype(np.float64) * 1e-6
                known = (utc > 1e9) & (utc < 4e9)
                if known.any():
                    start_s = float(np.median(utc[known] - _time_s(topic)[known]))
                    return datetime(1970, 1, 1, tzinfo=UTC) + timedelta(seconds=start_s)
    return None


def _vehicle(log: Any) -> dict[str, Any]:
    """What the log says of hardware and firmware."""
    info = log.msg_info_dict
    facts = {key: str(info[name]) for key, name in (("system", "sys_name"), ("hardware", "ver_hw")) if name in info}
    try:
        version = log.get_version_info_str()
    except (TypeError, ValueError):
        version = None
    return facts | ({"firmware": version} if version else {})
