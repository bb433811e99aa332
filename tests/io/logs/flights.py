"""One made-up flight over smooth ground, and writers that put it into logs of each format byte by byte."""

from __future__ import annotations

import struct
from collections.abc import Iterable
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Flight:
    """A flight north-east at 20 m/s, up from 30 m to 80 m above ground and down again."""

    time_s: FloatArray
    lat_deg: FloatArray
    lon_deg: FloatArray
    alt_m: FloatArray
    ground_m: FloatArray
    roll_deg: FloatArray

    def first(self, n: int) -> Flight:
        """The first n rows."""
        return Flight(*(getattr(self, field.name)[:n] for field in fields(self)))

    @property
    def clearance_m(self) -> FloatArray:
        return self.alt_m - self.ground_m

    @property
    def slant_m(self) -> FloatArray:
        """What a laser along the body's axis measures."""
        return np.asarray(self.clearance_m / np.cos(np.radians(self.roll_deg)) / np.cos(np.radians(2.0)))


def flight(duration_s: float = 60.0, rate_hz: float = 10.0) -> Flight:
    time_s = np.arange(int(duration_s * rate_hz)) / rate_hz
    ground = 400.0 + 20.0 * np.sin(time_s / 15.0)
    clearance = 30.0 + 50.0 * np.sin(np.pi * time_s / duration_s) ** 2
    lat, lon = 47.0 + time_s * 14.14 / 111195.0, 11.0 + time_s * 14.14 / 75900.0
    return Flight(time_s, lat, lon, ground + clearance, ground, 10.0 * np.sin(time_s / 5.0))


# ---- DataFlash ----
DEGREE_M = 111318.84502145034
LETTERS = {"Q": "Q", "B": "B", "b": "b", "H": "H", "I": "I", "i": "i", "f": "f", "d": "d", "c": "h", "C": "H", "e": "i"}
LETTERS |= {"E": "I", "L": "i", "N": "16s", "Z": "64s", "n": "4s", "h": "h", "M": "B"}
MESSAGES = {
    "PARM": (64, "QNff", "TimeUS,Name,Value,Default"),
    "GPS": (65, "QBBIHBcLLeffffB", "TimeUS,I,Status,GMS,GWk,NSats,HDop,Lat,Lng,Alt,Spd,GCrs,VZ,Yaw,U"),
    "POS": (66, "QLLfff", "TimeUS,Lat,Lng,Alt,RelHomeAlt,RelOriginAlt"),
    "ATT": (67, "QccccCCCCB", "TimeUS,DesRoll,Roll,DesPitch,Pitch,DesYaw,Yaw,ErrRP,ErrYaw,AEKF"),
    "BARO": (68, "QBffcfIffB", "TimeUS,I,Alt,Press,Temp,CRt,SMS,Offset,GndTemp,Health"),
    "RFND": (69, "QBCBB", "TimeUS,Instance,Dist,Stat,Orient"),
    "XKF1": (70, "QBccCfffffffccce", "TimeUS,C,Roll,Pitch,Yaw,VN,VE,VD,dPD,PN,PE,PD,GX,GY,GZ,OH"),
    "XKF4": (71, "QBcccccfbbHBHHb", "TimeUS,C,SV,SP,SH,SM,SVT,errRP,OFN,OFE,FS,TS,SS,GPS,PI"),
    "ORGN": (72, "QBLLe", "TimeUS,Type,Lat,Lng,Alt"),
    "TERR": (73, "QBLLHffHH", "TimeUS,Status,Lat,Lng,Spacing,TerrH,CHeight,Pending,Loaded"),
    "MSG": (74, "QZ", "TimeUS,Message"),
    "IMU": (75, "Qffffff", "TimeUS,GyrX,GyrY,GyrZ,AccX,AccY,AccZ"),
    "RFN2": (76, "QCBBCBB", "TimeUS,Dist1,Stat1,Orient1,Dist2,Stat2,Orient2"),
}
SCALES = {"c": 100, "C": 100, "e": 100, "E": 100, "L": 1e7}


def fmt(name: str, length: int | None = None) -> bytes:
    number, letters, columns = MESSAGES[name]
    size = struct.calcsize("<" + "".join(LETTERS[letter] for letter in letters)) + 3
    logged = "RFND" if name == "RFN2" else name
    body = struct.pack("<BB4s16s64s", number, length or size, logged.encode(), letters.encode(), columns.encode())
    return b"\xa3\x95\x80" + body


def message(name: str, *values: Any) -> bytes:
    number, letters, _ = MESSAGES[name]
    scaled = [
        round(value * SCALES[letter]) if letter in SCALES else value
        for letter, value in zip(letters, values, strict=True)
    ]
    return struct.pack("<BBB" + "".join(LETTERS[letter] for letter in letters), 0xA3, 0x95, number, *scaled)


def dataflash(
    made: Flight, *, without: Iterable[str] = (), max_m: float = 50.0, start_us: int = 5_000_000, week: int = 2300
) -> bytes:
    """A log of ArduCopter 4.x: GPS at 5 Hz, the rest at the flight's rate, a laser that ends at `max_m`."""
    names = [name for name in MESSAGES if name not in ("RFN2", *without)]
    out = [fmt(name) for name in names]
    us = (start_us + np.round(made.time_s * 1e6)).astype(int).tolist()
    head = [
        message("MSG", us[0], b"ArduCopter V4.5.1"),
        message("PARM", us[0], b"RNGFND1_TYPE", 8.0, 0.0),
        message("PARM", us[0], b"RNGFND1_MIN_CM", 20.0, 20.0),
        message("PARM", us[0], b"RNGFND1_MAX_CM", max_m * 100, 700.0),
        message("ORGN", us[0], 0, made.lat_deg[0], made.lon_deg[0], made.alt_m[0]),
    ]
    out += [packed for packed, name in zip(head, ("MSG", "PARM", "PARM", "PARM", "ORGN"), strict=True) if name in names]
    for i, t in enumerate(us):
        lat, lon, alt = made.lat_deg[i], made.lon_deg[i], made.alt_m[i]
        slant = made.slant_m[i]
        north, east = (lat - made.lat_deg[0]) * DEGREE_M, (lon - made.lon_deg[0]) * DEGREE_M
        east *= np.cos(np.radians((lat + made.lat_deg[0]) / 2))
        rows = {
            "POS": (t, lat, lon, alt, alt - made.alt_m[0], alt - made.alt_m[0]),
            "ATT": (t + 1000, 0, made.roll_deg[i], 0, 2.0, 0, 45.0, 0, 0, 3),
            "BARO": (t + 2000, 0, alt - made.alt_m[0] + 0.5, 95000.0, 20.0, 0.0, 0, 0.0, 20.0, 1),
            "RFND": (t + 3000, 0, min(slant, 600.0) if slant < max_m else 0.0, 4 if slant < max_m else 3, 25),
            "XKF1": (t + 4000, 0, 0, 0, 45.0, 14.14, 14.14, 0.5, 0, north, east, made.alt_m[0] - alt, 0, 0, 0, 0),
            "XKF4": (t + 5000, 0, 0, 0, 0, 0, 0, 0.0, 0, 0, 0, 0, 1 << 13, 0, 0),
            "IMU": (t + 6000, *[0.0] * 6),
            "TERR": (t + 7000, 2, lat, lon, 100, made.ground_m[i], 30.0, 0, 56),
        }
        out += [message(name, *values) for name, values in rows.items() if name in names]
        if i % 2 == 0 and "GPS" in names:
            milliseconds = 3_600_000 + t // 1000
            out.append(
                message("GPS", t + 500, 0, 3, milliseconds, week, 14, 0.8, lat, lon, alt, 20.0, 45.0, 0.5, 0.0, 1)
            )
    return b"".join(out)


# ---- MAVLink ----
HOST_US = 1_700_000_000_000_000


def tlog(
    made: Flight,
    *,
    max_m: float = 50.0,
    start_ms: int = 5000,
    version: int = 2,
    without: Iterable[str] = (),
    system: int = 1,
) -> bytes:
    """Telemetry at the flight's rate, GPS at half of it, the host 0.2 s behind the vehicle."""
    mavlink = pytest.importorskip("pymavlink.dialects.v20.ardupilotmega", reason="needs the extra 'logs'")
    link = mavlink.MAVLink(None, srcSystem=system, srcComponent=1)
    out = []
    for i, t in enumerate(made.time_s.tolist()):
        ms = (start_ms + round(t * 1000)) % 2**32
        lat, lon, alt = round(made.lat_deg[i] * 1e7), round(made.lon_deg[i] * 1e7), round(made.alt_m[i] * 1e3)
        hpa = 1013.25 * (1 - (made.alt_m[i] - 30.0) / 44330.77) ** (1 / 0.190263)
        slant_cm = round(min(made.slant_m[i], max_m) * 100)
        roll = float(np.radians(made.roll_deg[i]))
        messages = [
            mavlink.MAVLink_global_position_int_message(ms, lat, lon, alt, 0, 1414, 1414, 50, 4500),
            mavlink.MAVLink_attitude_message(ms, roll, float(np.radians(2.0)), float(np.radians(45.0)), 0, 0, 0),
            mavlink.MAVLink_scaled_pressure_message(ms, hpa, 0.0, 2000),
            mavlink.MAVLink_distance_sensor_message(ms, 20, round(max_m * 100), slant_cm, 0, 0, 25, 255),
            mavlink.MAVLink_system_time_message(HOST_US, ms),
        ]
        if i % 2 == 0:
            usec = ms * 1000
            messages.append(mavlink.MAVLink_gps_raw_int_message(usec, 3, lat, lon, alt, 80, 80, 2000, 4500, 14))
        for packed in messages:
            if packed.get_type() in without:
                continue
            stamp = HOST_US + 200_000 + round(t * 1e6)
            out.append(struct.pack(">Q", stamp) + packed.pack(link, force_mavlink1=version == 1))
    return b"".join(out)


# ---- PX4 ----
ULOG_HEAD = b"\x55\x4c\x6f\x67\x01\x12\x35\x01"
TOPICS = {
    "sensor_gps": "uint64_t timestamp;uint64_t timestamp_sample;double latitude_deg;double longitude_deg;"
    "double altitude_msl_m;uint64_t time_utc_usec;float vel_n_m_s;float vel_e_m_s;float vel_d_m_s;uint8_t fix_type;",
    "vehicle_gps_position": "uint64_t timestamp;uint64_t time_utc_usec;int32_t lat;int32_t lon;int32_t alt;"
    "float vel_n_m_s;float vel_e_m_s;float vel_d_m_s;uint8_t fix_type;",
    "vehicle_global_position": "uint64_t timestamp;double lat;double lon;float alt;float eph;",
    "vehicle_local_position": "uint64_t timestamp;float x;float y;float z;float vx;float vy;float vz;double ref_lat;"
    "double ref_lon;float ref_alt;bool xy_valid;bool v_xy_valid;bool xy_global;bool z_global;",
    "vehicle_attitude": "uint64_t timestamp;float[4] q;",
    "vehicle_air_data": "uint64_t timestamp;float baro_alt_meter;",
    "distance_sensor": "uint64_t timestamp;float min_distance;float max_distance;float current_distance;"
    "int8_t signal_quality;uint8_t type;uint8_t orientation;",
    "estimator_status_flags": "uint64_t timestamp;bool cs_gps;",
}
PACKED = {
    "sensor_gps": "<QQdddQfffB",
    "vehicle_gps_position": "<QQiiifffB",
    "vehicle_global_position": "<Qddff",
    "vehicle_local_position": "<Qffffffddf????",
    "vehicle_attitude": "<Qffff",
    "vehicle_air_data": "<Qf",
    "distance_sensor": "<QfffbBB",
    "estimator_status_flags": "<Q?",
}


def quaternion(roll_deg: float, pitch_deg: float, heading_deg: float) -> tuple[float, float, float, float]:
    """Body to NED, scalar first: heading, then pitch, then roll."""
    (cr, sr), (cp, sp), (cy, sy) = (
        (float(np.cos(np.radians(a) / 2)), float(np.sin(np.radians(a) / 2))) for a in (roll_deg, pitch_deg, heading_deg)
    )
    w, x = cr * cp * cy + sr * sp * sy, sr * cp * cy - cr * sp * sy
    return w, x, cr * sp * cy + sr * cp * sy, cr * cp * sy - sr * sp * cy


def projected(lat_deg: float, lon_deg: float, ref_lat_deg: float, ref_lon_deg: float) -> tuple[float, float]:
    """PX4's x and y: azimuthal equidistant on its sphere, forward."""
    lat, ref, turn = np.radians(lat_deg), np.radians(ref_lat_deg), np.radians(lon_deg - ref_lon_deg)
    arc = np.arccos(np.clip(np.sin(ref) * np.sin(lat) + np.cos(ref) * np.cos(lat) * np.cos(turn), -1.0, 1.0))
    k = 6371000.0 * (arc / np.sin(arc) if arc > 0 else 1.0)
    return float(k * (np.cos(ref) * np.sin(lat) - np.sin(ref) * np.cos(lat) * np.cos(turn))), float(
        k * np.cos(lat) * np.sin(turn)
    )


def ulog(
    made: Flight, *, without: Iterable[str] = ("vehicle_gps_position",), max_m: float = 50.0, sensor: int = 0
) -> bytes:
    """A PX4 log of 1.14; with vehicle_gps_position in place of sensor_gps, one of 1.11."""
    names = [name for name in TOPICS if name not in without]

    def block(kind: str, body: bytes) -> bytes:
        return struct.pack("<HB", len(body), ord(kind)) + body

    out = [ULOG_HEAD + struct.pack("<Q", 5_000_000), block("B", bytes(40))]
    out += [block("F", f"{name}:{TOPICS[name]}".encode()) for name in names]
    out += [block("A", struct.pack("<BH", 0, i) + name.encode()) for i, name in enumerate(names)]
    for i, t in enumerate(made.time_s.tolist()):
        us, utc = 5_000_000 + round(t * 1e6), HOST_US + round(t * 1e6)
        lat, lon, alt = float(made.lat_deg[i]), float(made.lon_deg[i]), float(made.alt_m[i])
        slant = float(min(made.slant_m[i], max_m + 1))
        north, east = projected(lat, lon, float(made.lat_deg[0]), float(made.lon_deg[0]))
        rows: dict[str, tuple[Any, ...]] = {
            "sensor_gps": (us + 100_000, us, lat, lon, alt, utc, 14.14, 14.14, 0.5, 3),
            "vehicle_gps_position": (
                us,
                utc,
                round(lat * 1e7),
                round(lon * 1e7),
                round(alt * 1e3),
                14.14,
                14.14,
                0.5,
                3,
            ),
            "vehicle_global_position": (us, lat, lon, alt, 0.5),
            "vehicle_local_position": (
                *(us, north, east, made.alt_m[0] - alt, 14.14, 14.14, 0.5),
                *(made.lat_deg[0], made.lon_deg[0], made.alt_m[0], True, True, True, True),
            ),
            "vehicle_attitude": (us, *quaternion(made.roll_deg[i], 2.0, 45.0)),
            "vehicle_air_data": (us, alt - 33.0),
            "distance_sensor": (us, 0.2, max_m, slant, -1, sensor, 25),
            "estimator_status_flags": (us, True),
        }
        for number, name in enumerate(names):
            if "gps" not in name or i % 2 == 0:
                out.append(block("D", struct.pack("<H", number) + struct.pack(PACKED[name], *rows[name])))
    return b"".join(out)


# ---- NMEA ----
def sentence(text: str) -> bytes:
    total = 0
    for letter in text.encode():
        total ^= letter
    return f"${text}*{total:02X}\r\n".encode()


def degrees(value: float, digits: int) -> str:
    return f"{int(value):0{digits}d}{(value % 1) * 60:09.6f}"


def nmea(made: Flight, *, start_s: float = 86_390.0, date: str = "010324") -> bytes:
    """A ship's sentences: the clock passes midnight after ten seconds."""
    out = []
    for i, t in enumerate(made.time_s.tolist()):
        of_day = (start_s + t) % 86_400
        clock = f"{int(of_day // 3600):02d}{int(of_day // 60 % 60):02d}{of_day % 60:06.3f}"
        lat, lon = degrees(made.lat_deg[i], 2), degrees(made.lon_deg[i], 3)
        day = date if start_s + t < 86_400 else f"{int(date[:2]) + 1:02d}{date[2:]}"
        out.append(sentence(f"GPGGA,{clock},{lat},N,{lon},E,1,12,0.8,{made.alt_m[i]:.3f},M,46.9,M,,"))
        out.append(sentence(f"GPRMC,{clock},A,{lat},N,{lon},E,38.88,45.0,{day},,,A"))
        out.append(sentence("HEHDT,45.0,T"))
        out.append(sentence(f"SDDPT,{made.clearance_m[i]:.2f},1.5,200.0"))
    return b"".join(out)
