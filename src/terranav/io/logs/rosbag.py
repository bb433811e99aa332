"""ROS 1 and ROS 2 bags (.bag, .db3, .mcap, a folder with metadata.yaml), decoded by rosbags.

Messages are known by their type, not by their topic:

- sensor_msgs/NavSatFix: a GNSS fix (status -1 is none), altitude above the WGS-84 ellipsoid as the message says. A
  topic named global_position/global or .../filtered is the autopilot's own estimate (mavros, robot_localization).
- sensor_msgs/Imu: orientation, body (forward, left, up) to east-north-up (REP 103), at most 20 a second.
- geometry_msgs/TwistStamped in a topic named velocity_local or gps_vel: velocity east, north, up [m/s].
- sensor_msgs/FluidPressure [Pa]; sensor_msgs/Range [m] that looks down by the name of its topic or frame, or is alone.
- px4_msgs/*: as in PX4 logs, see `terranav.io.logs.ulog`.

The clock is the header's stamp where it keeps within 5 s of the bag's, else the bag's.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np

from terranav.core.errors import DataError
from terranav.core.recording import FloatArray
from terranav.io.logs.found import (
    ELLIPSOID,
    PRESSURE,
    Found,
    Series,
    attitude_deg,
    pressure_altitude_m,
    series,
)
from terranav.io.logs.mending import mended
from terranav.io.logs.raw import library, silent
from terranav.io.logs.ulog import px4_series

_FIX, _IMU, _TWIST = "sensor_msgs/msg/NavSatFix", "sensor_msgs/msg/Imu", "geometry_msgs/msg/TwistStamped"
_PRESSURE, _RANGE = "sensor_msgs/msg/FluidPressure", "sensor_msgs/msg/Range"
_PX4 = {
    f"px4_msgs/msg/{''.join(part.title() for part in name.split('_'))}": name
    for name in (
        "sensor_gps",
        "vehicle_gps_position",
        "vehicle_global_position",
        "vehicle_local_position",
        "vehicle_attitude",
        "vehicle_air_data",
        "distance_sensor",
        "estimator_status_flags",
    )
} | {"px4_msgs/msg/SensorGps": "sensor_gps"}
_LEAST_STEP_NS = {_IMU: 50_000_000}
_OWN = re.compile(r"global_position/global$|filtered", re.IGNORECASE)
_DOWN = re.compile(r"down|bottom|ground|altimeter|height|agl|lidar", re.IGNORECASE)
_HEADER_S = 5.0


@dataclass(eq=False)
class _Topic:
    """The messages of one topic: bag stamps [ns] and a row of numbers each."""

    kind: str
    stamps_ns: list[int] = field(default_factory=list)
    headers_ns: list[int] = field(default_factory=list)
    rows: list[Any] = field(default_factory=list)
    frame: str = ""

    def time_s(self, start_ns: int) -> FloatArray:
        """(n,) on the bag's clock from `start_ns`: the header's stamps where those can be believed [s]."""
        bag = np.array([stamp - start_ns for stamp in self.stamps_ns], dtype=np.float64) * 1e-9
        header = np.array([stamp - start_ns for stamp in self.headers_ns], dtype=np.float64) * 1e-9
        usable = header.size == bag.size and header.size and np.median(np.abs(header - bag)) < _HEADER_S
        return np.asarray(header if usable else bag)


def read(path: Path) -> Found:
    """Read a bag.

    Parameters
    ----------
    path : Path
        A .bag, .db3 or .mcap file, or a folder with metadata.yaml.

    Returns
    -------
    Found

    Raises
    ------
    DataError
        When the bag is damaged so that rosbags cannot open it.
    ConfigError
        When rosbags is not installed.
    """
    remarks: list[str] = []
    topics: dict[str, _Topic] = {}
    whole = True
    with _opened(path, remarks) as reader:
        whole = not remarks
        wanted = [c for c in reader.connections if c.msgtype in (_FIX, _IMU, _TWIST, _PRESSURE, _RANGE, *_PX4)]
        try:
            with silent():
                _collect(reader, wanted, topics)
        except Exception as problem:  # noqa: BLE001 - rosbags and sqlite raise what the damaged bytes lead them to
            whole = False
            remarks.insert(0, f"the bag is damaged, its messages from there on were not read: {_told(problem)}")
    if not any(topic.rows for topic in topics.values()):
        raise DataError(f"{path}: holds no whole message of a type that is read (NavSatFix, Range, px4_msgs, ...)")
    start_ns = min(topic.stamps_ns[0] for topic in topics.values() if topic.stamps_ns)
    parts = [part for part in _parts(topics, start_ns, remarks) if len(part)]
    in_years = 10**18 < start_ns < 4 * 10**18
    start = datetime(1970, 1, 1, tzinfo=UTC) + timedelta(seconds=start_ns * 1e-9) if in_years else None
    return Found(
        path, "ROS bag", parts, {}, start, remarks, whole, in_order=not any(t.kind in _PX4 for t in topics.values())
    )


def _told(problem: Exception) -> str:
    """The first line of a library's message."""
    return next(iter(str(problem).splitlines()), type(problem).__name__)[:200]


@contextmanager
def _opened(path: Path, remarks: list[str]) -> Iterator[Any]:
    """The bag, open; one that was cut is read up to there."""
    highlevel = library("rosbags.highlevel", path, "a ROS bag")
    typesys = library("rosbags.typesys", path, "a ROS bag")
    source = path if path.is_dir() else mended(path, remarks)
    try:
        with silent():
            store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
            reader = highlevel.AnyReader([source], default_typestore=store)
            reader.open()
    except Exception as problem:  # noqa: BLE001 - see above
        raise DataError(f"{path}: is a damaged ROS bag: {_told(problem)}") from None
    try:
        yield reader
    finally:
        reader.close()


def _collect(reader: Any, wanted: list[Any], topics: dict[str, _Topic]) -> None:
    """Take the numbers of every message of the wanted topics."""
    if not wanted:
        return
    for connection, stamp, raw in reader.messages(connections=wanted):
        topic = topics.setdefault(connection.topic, _Topic(connection.msgtype))
        least = _LEAST_STEP_NS.get(topic.kind, 0)
        if topic.stamps_ns and 0 <= stamp - topic.stamps_ns[-1] < least:
            continue
        message = reader.deserialize(raw, connection.msgtype)
        row = _px4_row(message) if topic.kind in _PX4 else _row(topic.kind, message)
        if row is None:
            continue
        topic.stamps_ns.append(stamp)
        topic.rows.append(row)
        header = getattr(message, "header", None)
        if header is not None:
            topic.headers_ns.append(header.stamp.sec * 10**9 + header.stamp.nanosec)
            topic.frame = str(header.frame_id)


def _row(kind: str, message: Any) -> tuple[float, ...] | None:
    """The numbers of one message, None where it says nothing."""
    if kind == _FIX:
        row = (message.latitude, message.longitude, message.altitude)
        return row if message.status.status >= 0 else None
    if kind == _IMU:
        q = message.orientation
        return (q.w, q.x, q.y, q.z) if message.orientation_covariance[0] != -1 else None
    if kind == _TWIST:
        return message.twist.linear.x, message.twist.linear.y, message.twist.linear.z
    if kind == _PRESSURE:
        return (message.fluid_pressure,)
    return message.range, message.min_range, message.max_range, float(message.radiation_type)


def _px4_row(message: Any) -> dict[str, float]:
    """Every number of a PX4 message by name; arrays by name and index, as pyulog names them."""
    row: dict[str, float] = {}
    for name, value in vars(message).items():
        if isinstance(value, (bool, int, float)):
            row[name] = value
        elif isinstance(value, np.ndarray) and value.size <= 4:
            row |= {f"{name}[{i}]": float(item) for i, item in enumerate(value.tolist())}
    return row


def _parts(topics: dict[str, _Topic], start_ns: int, remarks: list[str]) -> Iterator[Series]:
    """The series of every role: of several topics the one with most messages."""
    px4: dict[str, list[Any]] = {}
    lags: list[FloatArray] = []
    best: dict[str, Series] = {}
    alone = sum(topic.kind == _RANGE for topic in topics.values()) == 1
    for name, topic in topics.items():
        if not topic.rows:
            continue
        if topic.kind in _PX4:
            keys = set.intersection(*(set(row) for row in topic.rows))
            table = {key: np.array([row[key] for row in topic.rows]) for key in sorted(keys)}
            if "timestamp" in table:
                px4.setdefault(_PX4[topic.kind], []).append(table)
                lags.append(table["timestamp"] * 1e-6 - topic.time_s(start_ns))
            continue
        part = _made(name, topic, start_ns, alone, remarks)
        if part is not None and (part.role not in best or len(part) > len(best[part.role])):
            best[part.role] = part
    yield from best.values()
    if px4:
        lag_s = float(np.median(np.concatenate(lags)))
        for part in px4_series(px4, remarks):
            if part.role not in best:
                yield series(part.role, part.source, part.time_s - lag_s, part.values, part.order, **_about(part))


def _about(part: Series) -> dict[str, Any]:
    """What a series keeps besides its rows."""
    return {"height": part.height, "limits_m": part.limits_m, "uses_gnss": part.uses_gnss}


def _made(name: str, topic: _Topic, start_ns: int, alone: bool, remarks: list[str]) -> Series | None:
    """The series of one topic, None where its role is not known."""
    time_s, order = topic.time_s(start_ns), np.array(topic.stamps_ns) - start_ns
    columns = np.array(topic.rows, dtype=np.float64).T
    source = f"{name} ({topic.kind.rsplit('/', 1)[1]})"
    if topic.kind == _FIX:
        own = bool(_OWN.search(name))
        values = dict(zip(("lat_deg", "lon_deg", "alt_m"), columns, strict=True))
        more: dict[str, Any] = {"height": ELLIPSOID, "uses_gnss": None if own else True}
        return series("own" if own else "gnss", source, time_s, values, order, **more)
    if topic.kind == _IMU:
        turned = attitude_deg(*columns)
        # east-north-up and forward-left-up to north-east-down and forward-right-down
        values = {"roll_deg": turned["roll_deg"], "pitch_deg": -turned["pitch_deg"]}
        values["heading_deg"] = (90.0 - turned["heading_deg"]) % 360.0
        return series("attitude", source, time_s, values, order)
    if topic.kind == _TWIST:
        if not re.search(r"velocity_local|gps_vel", name):
            return None
        values = {"vn_mps": columns[1], "ve_mps": columns[0], "vd_mps": -columns[2]}
        return series("velocity", source, time_s, values, order, uses_gnss=True if "gps_vel" in name else None)
    if topic.kind == _PRESSURE:
        values = {"altitude_m": pressure_altitude_m(columns[0] / 100.0)}
        return series("baro", source, time_s, values, order, height=PRESSURE, uses_gnss=False)
    if not alone and not _DOWN.search(f"{name} {topic.frame}"):
        remarks.append(f"{name}: nothing says that this range sensor looks down, it was left out")
        return None
    if not _DOWN.search(f"{name} {topic.frame}"):
        remarks.append(f"{name}: the only range sensor is taken to look down")
    distance, low, high = columns[:3]
    good = (distance > 0) & (distance >= low) & (distance <= high)
    limits = (float(np.median(low)), float(np.median(high)))
    role = "radar" if np.median(columns[3]) == 0 else "laser"  # 0: ultrasound, a wide beam
    values = {"range_m": np.where(good, distance, np.nan)}
    return series(role, source, time_s, values, order, limits_m=limits, uses_gnss=False)
