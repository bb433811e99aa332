"""How a vehicle navigates once GNSS is gone: ways of dead reckoning over what its log holds.

Every way starts at the last fix and gives a Recording whose indicated position is the dead reckoning's. What the
estimators are told of it (InsGrade) is of the way, not of the vehicle; `Flown.ins` overrides it:

=========  ================================================================  ===========================================
way        indicated position                                                told, 1-sigma per axis
=========  ================================================================  ===========================================
velocity   the autopilot's velocity, summed up                               0.3 m/s, walks 0.3 m/sqrt(s) and 0.01
                                                                             m/s/sqrt(s)
airspeed   true airspeed along the heading and the wind before the cut       the wind: 1 m/s, 5 m/s where none was seen;
                                                                             walks 0.5 m/sqrt(s) and 0.05 m/s/sqrt(s)
position   the logged own position, moved to the last fix                    the recording's grade, else as for velocity
imu        strapdown of the inertial sensors, calibrated before the cut      a MEMS unit, `MEMS`
drift      the true position and a drift drawn from a grade                  the very grade
=========  ================================================================  ===========================================
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from terranav.core.earth import metres_per_degree, offset_m, shift, wrap_longitude
from terranav.core.errors import DataError
from terranav.core.ins_grade import InsGrade
from terranav.core.recording import ATTITUDE, TRUTH, VELOCITY, FloatArray, Recording
from terranav.io.logs import Log

#: 1-sigma of a GNSS fix per axis: receiver, delay and interpolation [m]
FIX_SIGMA_M = 5.0
#: an INS of one nautical mile an hour: half of them are closer than that after an hour (CEP = 1.1774 sigma)
NMPH_MPS = 1852.0 / 3600.0 / 1.1774
#: random walk of the position of such an INS [m/sqrt(s)]: none drifts in a straight line
DRIFT_WALK = 0.3
#: how long before the cut the wind is averaged [s]
WIND_S = 300.0
#: least that says anything [s]
_LEAST_S = 20.0
_SLOWEST_MPS = 5.0
#: a MEMS unit of an autopilot, its biases taken out before the cut: what is left, and what comes back as it warms
MEMS = InsGrade(
    position_sigma_m=FIX_SIGMA_M,
    velocity_sigma_mps=0.2,
    position_walk_m_per_sqrt_s=0.0,
    attitude_sigma_deg=0.3,
    heading_sigma_deg=2.0,
    gyro_bias_sigma_deg_per_h=20.0,
    accel_bias_sigma_ug=3000.0,
    gyro_walk_deg_per_sqrt_h=0.5,
    accel_walk_mps_per_sqrt_h=0.1,
    name="MEMS",
)
_BY_VELOCITY = InsGrade(FIX_SIGMA_M, 0.3, 0.3, 0.01)


@dataclass(frozen=True)
class Way:
    """One way of dead reckoning: its name, what it is, and the columns it lives on."""

    name: str
    told: str
    uses: tuple[str, ...] = ()


WAYS: dict[str, Way] = {
    way.name: way
    for way in (
        Way("velocity", "the vehicle's own velocity, summed up from the last fix", VELOCITY[:2]),
        Way("airspeed", "airspeed along the heading, with the wind before the cut", ("heading_deg",)),
        Way("position", "the vehicle's own position, set to the last fix", ("lat_deg", "lon_deg")),
        Way("imu", "its inertial sensors by strapdown, calibrated before the cut"),
        Way("drift", "its true track and the drift of a stated INS"),
    )
}


@dataclass(frozen=True)
class Flown:
    """What is stated of the INS rather than logged.

    Attributes
    ----------
    drift : InsGrade, optional
        Of the way 'drift'; one nautical mile an hour unless given.
    drift_seed : int
        Which drift to draw.
    ins : InsGrade, optional
        What the estimators are told, instead of what goes with the way.
    """

    drift: InsGrade | None = None
    drift_seed: int = 0
    ins: InsGrade | None = None


@dataclass(frozen=True)
class _Made:
    """What a way makes: new columns, the INS that is told, remarks."""

    columns: dict[str, FloatArray]
    ins: InsGrade | None
    remarks: list[str] = field(default_factory=list)


def nautical_miles_an_hour(rate: float) -> InsGrade:
    """An INS on position level with a velocity error of so many nautical miles an hour (CEP), and a walk."""
    return InsGrade(FIX_SIGMA_M, rate * NMPH_MPS, DRIFT_WALK, name=f"{rate:g} nmi/h")


def dead_reckoned(log: Log, way: Way, first: int, last: int, flown: Flown) -> tuple[Recording, list[str]]:
    """A stretch of a log as navigated without GNSS.

    Parameters
    ----------
    log : Log
    way : Way
    first, last : int
        The row of the last fix, and the row after the last.
    flown : Flown

    Returns
    -------
    Recording, list of str
        Its truth is GNSS's; what is to be said of how it was made.

    Raises
    ------
    DataError
        When the log does not hold what the way needs.
    """
    rec = log.recording
    part = replace(rec, columns={key: values[first:last] for key, values in rec.columns.items()})
    made = _MAKERS[way.name](log, part, first, flown)
    source = {**rec.source, "gnss": f"withheld; navigated by {way.name}: {way.told}"}
    flight = replace(part, columns={**part.columns, **made.columns}, ins=flown.ins or made.ins, source=source)
    return flight, made.remarks


Track = tuple[FloatArray, FloatArray]


def summed_up(time_s: FloatArray, velocity_mps: FloatArray, start_deg: tuple[float, float], alt_m: FloatArray) -> Track:
    """Latitude and longitude (n,) [deg] of a velocity (n, 2) [m/s] from a start on, by the trapezoid, at its height."""
    steps = 0.5 * np.diff(time_s)[:, None] * (velocity_mps[1:] + velocity_mps[:-1])
    height = np.radians(0.5 * (alt_m[1:] + alt_m[:-1]))  # [m/deg] that height adds to a degree
    lat = np.full(time_s.size, start_deg[0])
    for _ in range(3):  # the length of a degree changes with the latitude by 1e-4 a degree
        per_lat, per_lon = metres_per_degree(0.5 * (lat[1:] + lat[:-1]))
        lat = start_deg[0] + _running(steps[:, 0] / (per_lat + height))
    shrink = np.cos(np.radians(0.5 * (lat[1:] + lat[:-1])))
    lon = start_deg[1] + _running(steps[:, 1] / (per_lon + height * shrink))
    return lat, wrap_longitude(lon)


def _running(steps: FloatArray) -> FloatArray:
    """Running sums (n,) of steps (n - 1,), from zero."""
    return np.concatenate([[0.0], np.cumsum(steps)])


def filled(rec: Recording, key: str, fallback: str) -> FloatArray:
    """A column with its gaps bridged linearly; another column where it holds nothing."""
    column = rec.columns.get(key)
    if column is None or not np.isfinite(column).any():
        return rec.columns[fallback]
    known = np.isfinite(column)
    values = np.unwrap(column[known], period=360.0) if "lon" in key or "heading" in key else column[known]
    return np.interp(rec.time_s, rec.time_s[known], values)


def _start_deg(part: Recording) -> tuple[float, float]:
    """The last fix; the indicated position where none is known."""
    at = tuple(float(part.columns[key][0]) if key in part.columns else np.nan for key in TRUTH[:2])
    return (at[0], at[1]) if np.isfinite(at).all() else (float(part.lat_deg[0]), float(part.lon_deg[0]))


def _bridged(rec: Recording, keys: tuple[str, ...], what: str) -> tuple[FloatArray, list[str]]:
    """Columns (n, k) with their gaps bridged; DataError where one holds nothing, a remark where it had gaps."""
    if not all(key in rec.columns and np.isfinite(rec.columns[key]).any() for key in keys):
        raise DataError(f"{rec.name}: no {what} is logged from the cut on, which this way of navigating needs")
    known = np.isfinite(np.stack([rec.columns[key] for key in keys])).all(axis=0)
    lost = float(1.0 - known.mean())
    told = [f"no {what} at {100 * lost:.1f} % of the epochs: bridged in a straight line"] if lost > 0 else []
    return np.stack([filled(rec, key, key) for key in keys], axis=1), told


def _by_velocity(log: Log, part: Recording, first: int, flown: Flown) -> _Made:
    """The autopilot's velocity."""
    velocity, told = _bridged(part, VELOCITY[:2], "velocity")
    lat, lon = summed_up(part.time_s, velocity, _start_deg(part), part.alt_m)
    return _Made({"lat_deg": lat, "lon_deg": lon}, _BY_VELOCITY, told)


def _by_airspeed(log: Log, part: Recording, first: int, flown: Flown) -> _Made:
    """Airspeed and heading."""
    if "airspeed" not in log.beside:
        raise DataError(f"{part.name}: no airspeed is logged, which this way of navigating needs")
    air, told = _air_velocity(log, part)
    rec = log.recording
    begin = int(np.searchsorted(rec.time_s, part.time_s[0] - WIND_S))
    wind, sigma = np.zeros(2), 5.0
    before = replace(rec, columns={key: values[begin:first] for key, values in rec.columns.items()}) if first else None
    seen = None if before is None else _wind(log, before)
    if seen is None:
        told.append("no wind was seen before the cut: taken for calm, 5 m/s (1 sigma)")
    else:
        wind, sigma = seen, 1.0
        blows_from = np.degrees(np.arctan2(-wind[1], -wind[0])) % 360.0
        told.append(f"wind before the cut: {np.hypot(*wind):.1f} m/s from {blows_from:.0f} deg")
    velocity = air + wind
    lat, lon = summed_up(part.time_s, velocity, _start_deg(part), part.alt_m)
    columns = {"lat_deg": lat, "lon_deg": lon, VELOCITY[0]: velocity[:, 0], VELOCITY[1]: velocity[:, 1]}
    return _Made(columns, InsGrade(FIX_SIGMA_M, sigma, 0.5, 0.05), told)


def _air_velocity(log: Log, rec: Recording) -> tuple[FloatArray, list[str]]:
    """North and east velocity (n, 2) through the air [m/s]."""
    attitude, told = _bridged(rec, ("heading_deg",), "heading")
    speeds = log.beside["airspeed"]
    there = np.isfinite(speeds.values["airspeed_mps"])
    if not there.any():
        raise DataError(f"{rec.name}: the airspeed sensor gave no reading")
    time_s = speeds.time_s[there]
    away = np.abs(rec.time_s - time_s[np.clip(np.searchsorted(time_s, rec.time_s), 0, time_s.size - 1)])
    lost = float((away > 5.0).mean())
    if lost > 0:
        told.append(f"no airspeed within 5 s at {100 * lost:.1f} % of the epochs: bridged in a straight line")
    speed = np.interp(rec.time_s, time_s, speeds.values["airspeed_mps"][there])
    if ATTITUDE[1] in rec.columns:
        speed = speed * np.cos(np.radians(np.nan_to_num(rec.columns[ATTITUDE[1]])))
    heading = np.radians(attitude[:, 0])
    return np.stack([speed * np.cos(heading), speed * np.sin(heading)], axis=1), told


def _wind(log: Log, before: Recording) -> FloatArray | None:
    """Mean wind (2,) north and east [m/s] while GNSS was there, None where it flew too short."""
    if not before.has_truth or not np.isfinite(before.columns.get("heading_deg", np.full(1, np.nan))).any():
        return None
    air, _ = _air_velocity(log, before)
    true = np.stack([before.columns[key] for key in TRUTH[:2]])
    flying = np.isfinite(true).all(axis=0) & (np.hypot(*air.T) > _SLOWEST_MPS)
    rows = np.flatnonzero(flying)
    if rows.size < 2 or before.time_s[rows[-1]] - before.time_s[rows[0]] < _LEAST_S:
        return None
    pairs = np.flatnonzero(flying[1:] & flying[:-1])
    north, east = offset_m(true[0, pairs], true[1, pairs], true[0, pairs + 1], true[1, pairs + 1])
    dt = np.diff(before.time_s)[pairs]
    through = (0.5 * dt[:, None] * (air[pairs] + air[pairs + 1])).sum(axis=0)
    return np.asarray((np.array([north.sum(), east.sum()]) - through) / dt.sum())


def _by_position(log: Log, part: Recording, first: int, flown: Flown) -> _Made:
    """The own position, moved to the last fix."""
    if log.facts.get("own_position", {}).get("used_gnss") is None:
        raise DataError(f"{part.name}: the vehicle's own position is not logged, only GNSS's; expected --drift")
    lat, lon = _start_deg(part)
    north, east = offset_m(lat, lon, part.lat_deg[0], part.lon_deg[0])
    lats, lons = shift(part.lat_deg, part.lon_deg, -north, -east)
    if not part.has_truth:
        return _Made({}, part.ins)
    ins = replace(part.ins, position_sigma_m=FIX_SIGMA_M) if part.ins is not None else _BY_VELOCITY
    return _Made({"lat_deg": lats, "lon_deg": lons}, ins)


def _by_drift(log: Log, part: Recording, first: int, flown: Flown) -> _Made:
    """The true track and a drift; the truth stays unknown where it is."""
    from terranav.ins.drift import add_drift

    grade = flown.drift or nautical_miles_an_hour(1.0)
    columns = {key: values for key, values in part.columns.items() if key not in TRUTH}
    for key in TRUTH[:2]:
        own = key.removeprefix("true_")
        columns[own] = filled(part, key, own) if part.has_truth else part.columns[own]
    columns["lon_deg"] = wrap_longitude(columns["lon_deg"])
    drifted = add_drift(replace(part, columns=columns, ins=None), grade, flown.drift_seed)
    truth = {key: part.columns.get(key, drifted.columns[key]) for key in TRUTH} if part.has_truth else {}
    told = f"the drift is drawn from {grade.name or 'the grade given'}, seed {flown.drift_seed}"
    return _Made({**drifted.columns, **truth}, grade, [told])


def _by_imu(log: Log, part: Recording, first: int, flown: Flown) -> _Made:
    """Strapdown of the logged inertial sensors."""
    from terranav.experiment.replay_imu import by_strapdown

    columns, told = by_strapdown(log, part, first, _start_deg(part))
    return _Made(columns, MEMS, told)


_MAKERS: dict[str, Callable[[Log, Recording, int, Flown], _Made]] = {
    "velocity": _by_velocity,
    "airspeed": _by_airspeed,
    "position": _by_position,
    "imu": _by_imu,
    "drift": _by_drift,
}
