"""A made-up ArduPilot flight over the sample DEM, written as a DataFlash log byte by byte: for trials of `replay`.

An aeroplane at 30 m/s, 10 Hz, over real ground: a minute at rest where wanted, then legs with banked turns. What is
simulated: laser altimeter (1 m noise, 600 m range), barometer (0.5 m noise, a weather drift of 3 m over 1000 s), GNSS
(1.5 m), the autopilot's velocity (a constant error and a walk where it has no GNSS, 0.1 m/s noise where it has),
airspeed (0.5 m/s noise, 1 % scale) in a steady wind of 5 m/s, heading (1 degree), inertial sensors of a grade at 50 Hz.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

import terranav as tn
from terranav.core.earth import GRAVITY_MPS2, shift
from terranav.ins.drift import draw_drift
from terranav.ins.trajectory import Route, Trajectory, fly
from terranav.sensors.bands import Band
from terranav.sensors.barometer import Barometer

FloatArray = NDArray[np.float64]

SPEED_MPS, ALTITUDE_M, LASER_M = 30.0, 1100.0, 600.0
WIND_MPS = (3.0, 4.0)  # towards north, east
CLIMB_S = 120.0
SHORTEST_LEG_M = 10_000.0
#: corners of the circuit over the sample DEM, latitude and longitude [deg]; flown round and round
CORNERS = ((36.55, -84.36), (36.67, -84.30), (36.69, -84.16), (36.60, -84.10), (36.50, -84.14), (36.48, -84.28))
VELOCITY_ERROR = tn.InsGrade(5.0, 0.4, 0.3)
LETTERS = {"Q": "Q", "B": "B", "H": "H", "I": "I", "f": "f", "c": "h", "C": "H", "L": "i", "N": "16s", "Z": "64s"}
LETTERS |= {"b": "b"}
MESSAGES = {
    "PARM": (64, "QNff", "TimeUS,Name,Value,Default"),
    "GPS": (65, "QBBIHBcLLffff", "TimeUS,I,Status,GMS,GWk,NSats,HDop,Lat,Lng,Alt,Spd,GCrs,VZ"),
    "POS": (66, "QLLf", "TimeUS,Lat,Lng,Alt"),
    "ATT": (67, "QccC", "TimeUS,Roll,Pitch,Yaw"),
    "BARO": (68, "QBf", "TimeUS,I,Alt"),
    "RFND": (69, "QBfBB", "TimeUS,Instance,Dist,Stat,Orient"),
    "XKF1": (70, "QBfff", "TimeUS,C,VN,VE,VD"),
    "XKF4": (71, "QBHb", "TimeUS,C,SS,PI"),
    "MSG": (74, "QZ", "TimeUS,Message"),
    "IMU": (75, "QBffffff", "TimeUS,I,GyrX,GyrY,GyrZ,AccX,AccY,AccZ"),
    "ARSP": (76, "QBf", "TimeUS,I,Airspeed"),
}
SCALES = {"c": 100.0, "C": 100.0, "L": 1e7}
_START_US = 5_000_000


@dataclass(frozen=True)
class Made:
    """What flight to make.

    Attributes
    ----------
    minutes : float
        Under way.
    seed : int
    rest_s : float
        At rest before [s].
    uses_gnss : bool
        Whether the autopilot's velocity and position were made with GNSS.
    without : iterable of str
        Messages left out.
    imu : InsGrade, optional
        Inertial sensors of this grade, at 50 Hz; none unless given.
    laser_m : float
        Longest range of the altimeter [m].
    """

    minutes: float = 30.0
    seed: int = 1
    rest_s: float = 60.0
    uses_gnss: bool = False
    without: Iterable[str] = ()
    imu: tn.InsGrade | None = None
    laser_m: float = LASER_M


def flown(minutes: float, rate_hz: float) -> Trajectory:
    """So many minutes of the circuit."""
    legs = int(minutes * 60.0 * SPEED_MPS / SHORTEST_LEG_M) + 2
    corners = [CORNERS[i % len(CORNERS)] for i in range(legs + 1)]
    path = fly(Route([(lat, lon, ALTITUDE_M) for lat, lon in corners], SPEED_MPS), rate_hz)
    count = int(minutes * 60.0 * rate_hz)
    return Trajectory(*(part[:count] for part in vars(path).values()))


def dataflash(made: Made) -> bytes:
    """The log of a flight."""
    rng = np.random.default_rng(made.seed)
    path = flown(made.minutes, 50.0 if made.imu else 10.0)
    at = path.every(5) if made.imu else path
    rows = _sensors(made, at, rng)
    out = _head(made)
    names = [name for name in MESSAGES if name not in made.without and name not in ("PARM", "MSG", "IMU")]
    if made.imu is not None:
        rows["IMU"] = _imu(path, made.imu, rng)
        names.append("IMU")
    packed: list[tuple[int, bytes]] = []
    for place, name in enumerate(names):
        if name in rows:
            stamps, values = rows[name]
            us = (_START_US + np.round(stamps * 1e6)).astype(int) + 137 * place
            packed += [(t, message(name, t, *one)) for t, one in zip(us.tolist(), values, strict=True)]
    packed.sort(key=lambda one: one[0])
    return b"".join([*out, *(one for _, one in packed)])


def _sensors(
    made: Made, at: Trajectory, rng: np.random.Generator
) -> dict[str, tuple[FloatArray, list[tuple[Any, ...]]]]:
    """Stamps [s] and values of every message."""
    rest = np.arange(round(made.rest_s * 10.0)) / 10.0
    time_s = np.concatenate([rest, made.rest_s + at.time_s])
    row = np.concatenate([np.zeros(rest.size, dtype=int), np.arange(len(at))])
    moving = np.concatenate([np.zeros(rest.size), np.ones(len(at))])
    n = time_s.size
    dem = tn.sample_map()
    lat, lon, true_alt = at.lat_deg[row], at.lon_deg[row], at.alt_m[row]
    ground = np.asarray(dem.sample(lat, lon), dtype=np.float64)
    velocity = at.velocity_mps[row] * moving[:, None]
    if made.rest_s > 0.0:  # up from the ground; a flight that begins in the air keeps its height
        climbed = np.clip((time_s - made.rest_s) / CLIMB_S, 0.0, 1.0)
        true_alt = ground[0] + (true_alt - ground[0]) * climbed**2 * (3.0 - 2.0 * climbed)
        velocity[:, 2] = -np.gradient(true_alt, time_s)
    roll, pitch, heading = (column * (moving if i < 2 else 1.0) for i, column in enumerate(at.attitude_deg[row].T))
    baro = Barometer((Band(sigma_m=0.5),), drift_sigma_m=3.0).measure(true_alt, rng, time_s)
    slant = (true_alt - ground + rng.normal(0.0, 1.0, n)) / np.cos(np.radians(roll)) / np.cos(np.radians(pitch))
    good = slant < made.laser_m
    error_m, error_mps = draw_drift(time_s, VELOCITY_ERROR, rng)
    if made.uses_gnss:
        error_m, error_mps = rng.normal(0.0, 1.0, (n, 2)), rng.normal(0.0, 0.1, (n, 2))
    own_lat, own_lon = shift(lat, lon, *(error_m - error_m[0]).T)
    gnss_lat, gnss_lon = shift(lat, lon, *rng.normal(0.0, 1.5, (2, n)))
    air = velocity[:, :2] - np.array(WIND_MPS) * moving[:, None]
    crab = np.degrees(np.arctan2(air[:, 1], air[:, 0]))
    heading = np.where(moving > 0, crab, heading) + rng.normal(0.0, 1.0, n)
    if made.imu is not None:  # the strapdown needs the attitude that the sensors were made with
        heading = at.attitude_deg[row, 2] + rng.normal(0.0, 0.2, n)
    thin = (1.0 - ALTITUDE_M / 44330.77) ** (0.5 * (1.0 / 0.190263 - 1.0))
    pitot = np.hypot(*air.T) * 1.01 * thin + rng.normal(0.0, 0.5, n)
    speed, course = np.hypot(*velocity[:, :2].T), np.degrees(np.arctan2(velocity[:, 1], velocity[:, 0])) % 360.0
    own = velocity[:, :2] + error_mps
    flags = (1 << 13) if made.uses_gnss else 0
    half = slice(None, None, 2)
    milliseconds = np.round(time_s * 1e3).astype(int) + 3_600_000

    def rows(*columns: Any, every: slice = slice(None)) -> tuple[FloatArray, list[tuple[Any, ...]]]:
        wide = [np.broadcast_to(np.asarray(column), n)[every].tolist() for column in columns]
        return time_s[every], list(zip(*wide, strict=True))

    return {
        "GPS": rows(0, 3, milliseconds, 2300, 14, 0.8, gnss_lat, gnss_lon, true_alt + rng.normal(0.0, 3.0, n), speed,
                    course, velocity[:, 2], every=half),
        "POS": rows(own_lat, own_lon, true_alt + rng.normal(0.0, 1.0, n)),
        "ATT": rows(roll, pitch, heading % 360.0),
        "BARO": rows(0, baro - true_alt[0]),
        "RFND": rows(0, np.where(good, slant, 0.0), np.where(good, 4, 3), 25),
        "XKF1": rows(0, own[:, 0], own[:, 1], velocity[:, 2]),
        "XKF4": rows(0, flags, 0),
        "ARSP": rows(0, np.maximum(pitot, 0.0)),
    }  # fmt: skip


def _imu(path: Trajectory, grade: tn.InsGrade, rng: np.random.Generator) -> tuple[FloatArray, list[tuple[Any, ...]]]:
    """Rates of the inertial sensors under way, with the errors of a grade; python-ins makes the true ones."""
    from pyins import sim

    lla = np.stack([path.lat_deg, path.lon_deg, path.alt_m], axis=1)
    _, imu = sim.generate_imu(path.time_s, lla, path.attitude_deg, path.velocity_mps, sensor_type="rate")
    gyro, accel = imu.to_numpy()[:, :3], imu.to_numpy()[:, 3:]
    n, dt = len(path), float(path.time_s[1] - path.time_s[0])
    gyro_noise = np.radians(grade.gyro_walk_deg_per_sqrt_h) / 60.0 / np.sqrt(dt)
    accel_noise = grade.accel_walk_mps_per_sqrt_h / 60.0 / np.sqrt(dt)
    gyro = gyro + np.radians(grade.gyro_bias_sigma_deg_per_h) / 3600.0 * rng.standard_normal(3)
    accel = accel + 1e-6 * GRAVITY_MPS2 * grade.accel_bias_sigma_ug * rng.standard_normal(3)
    gyro = gyro + gyro_noise * rng.standard_normal((n, 3))
    accel = accel + accel_noise * rng.standard_normal((n, 3))
    return path.time_s, [(0, *one) for one in np.concatenate([gyro, accel], axis=1).tolist()]


def _head(made: Made) -> list[bytes]:
    """Definitions and parameters."""
    out = [fmt(name) for name in MESSAGES]
    parameters = {b"RNGFND1_TYPE": 8.0, b"RNGFND1_MIN_CM": 20.0, b"RNGFND1_MAX_CM": made.laser_m * 100.0}
    out.append(message("MSG", _START_US, b"ArduPlane V4.5.1"))
    return out + [message("PARM", _START_US, name, value, 0.0) for name, value in parameters.items()]


def fmt(name: str) -> bytes:
    """The definition of a message."""
    number, letters, columns = MESSAGES[name]
    size = struct.calcsize("<" + "".join(LETTERS[letter] for letter in letters)) + 3
    body = struct.pack("<BB4s16s64s", number, size, name.encode(), letters.encode(), columns.encode())
    return b"\xa3\x95\x80" + body


def message(name: str, *values: Any) -> bytes:
    """One message, its values in base units."""
    number, letters, _ = MESSAGES[name]
    pairs = zip(letters, values, strict=True)
    scaled = [round(value * SCALES[letter]) if letter in SCALES else value for letter, value in pairs]
    return struct.pack("<BBB" + "".join(LETTERS[letter] for letter in letters), 0xA3, 0x95, number, *scaled)
