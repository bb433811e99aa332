"""The made-up flight as a ROS 1 or ROS 2 bag, written by rosbags."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.io.logs.flights import HOST_US, Flight, quaternion


def messages(made: Flight, store: Any, max_m: float = 50.0) -> Any:
    """Yield topic, message and stamp [ns] in the order of time; two range sensors, one of which looks down."""
    types = store.types
    seq = {"seq": 0} if "seq" in types["std_msgs/msg/Header"].__dataclass_fields__ else {}
    fix, imu, pressure, ranging, twist = (
        types[name]
        for name in (
            "sensor_msgs/msg/NavSatFix",
            "sensor_msgs/msg/Imu",
            "sensor_msgs/msg/FluidPressure",
            "sensor_msgs/msg/Range",
            "geometry_msgs/msg/TwistStamped",
        )
    )
    vector, quat = types["geometry_msgs/msg/Vector3"], types["geometry_msgs/msg/Quaternion"]
    zero9 = np.zeros(9)
    for i, t in enumerate(made.time_s.tolist()):
        stamp = HOST_US * 1000 + round(t * 1e9)
        time = types["builtin_interfaces/msg/Time"](sec=stamp // 10**9, nanosec=stamp % 10**9)

        def header(frame: str, time: Any = time) -> Any:
            return types["std_msgs/msg/Header"](stamp=time, frame_id=frame, **seq)

        status = types["sensor_msgs/msg/NavSatStatus"](status=0, service=1)
        where = (float(made.lat_deg[i]), float(made.lon_deg[i]), float(made.alt_m[i]))
        raw, own = fix(header("gps"), status, *where, zero9, 0), fix(header("map"), status, *where, zero9, 0)
        # forward-left-up to east-north-up: pitch and heading turn round
        w, x, y, z = quaternion(float(made.roll_deg[i]), -2.0, 90.0 - 45.0)
        hpa = 1013.25 * (1 - (made.alt_m[i] - 30.0) / 44330.77) ** (1 / 0.190263)
        slant = float(made.slant_m[i])
        if i % 2 == 0:
            yield "/mavros/global_position/raw/fix", raw, stamp
        yield "/mavros/global_position/global", own, stamp
        zero = vector(0.0, 0.0, 0.0)
        yield "/mavros/imu/data", imu(header("base"), quat(x, y, z, w), zero9, zero, zero9, zero, zero9), stamp
        yield "/mavros/imu/pressure", pressure(header("base"), float(hpa) * 100.0, 0.0), stamp
        yield "/lidar_down", ranging(header("lidar"), 1, 0.1, 0.2, max_m, min(slant, max_m + 1)), stamp
        yield "/front", ranging(header("front"), 1, 0.1, 0.2, 10.0, 5.0), stamp
        motion = types["geometry_msgs/msg/Twist"](vector(14.14, 14.14, -0.5), zero)
        yield "/mavros/local_position/velocity_local", twist(header("map"), motion), stamp


def write_bag(path: Path, made: Flight, kind: str) -> Path:
    """Write '.bag', 'mcap' or 'sqlite3' and return the file, of the latter two inside their folder."""
    typesys = pytest.importorskip("rosbags.typesys", reason="needs the extra 'logs'")
    if kind == ".bag":
        writer_of = pytest.importorskip("rosbags.rosbag1").Writer
        store = typesys.get_typestore(typesys.Stores.ROS1_NOETIC)
        writer, pack = writer_of(path), store.serialize_ros1
    else:
        rosbag2 = pytest.importorskip("rosbags.rosbag2")
        store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
        plugin = rosbag2.StoragePlugin.MCAP if kind == "mcap" else rosbag2.StoragePlugin.SQLITE3
        writer, pack = rosbag2.Writer(path, version=9, storage_plugin=plugin), store.serialize_cdr
    with writer:
        known: dict[str, Any] = {}
        for topic, message, stamp in messages(made, store):
            name = message.__msgtype__
            if topic not in known:
                known[topic] = writer.add_connection(topic, name, typestore=store)
            writer.write(known[topic], stamp, pack(message, name))
    if kind == ".bag":
        return path
    return next(file for file in path.iterdir() if file.suffix in (".mcap", ".db3"))
