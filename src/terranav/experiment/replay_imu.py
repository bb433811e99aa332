"""The way 'imu' of `experiment.replay_ways`: strapdown of the inertial sensors that a log holds."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from terranav.core.errors import DataError
from terranav.core.recording import ATTITUDE, VELOCITY, FloatArray, Recording
from terranav.ins.imu import ImuReadings, check_imu, imu_biases, strapdown_of
from terranav.ins.trajectory import Trajectory
from terranav.io.logs import Log
from terranav.io.logs.found import IMU

#: over how long before the cut the sensors are calibrated, and how little of it says nothing [s]
CALIBRATION_S, LEAST_S = 120.0, 20.0


def by_strapdown(
    log: Log, part: Recording, first: int, fix_deg: tuple[float, float]
) -> tuple[dict[str, FloatArray], list[str]]:
    """What a strapdown INS would have indicated.

    Parameters
    ----------
    log : Log
        Opened with its inertial sensors.
    part : Recording
        The epochs without GNSS; attitude and velocity of the first start the INS.
    first : int
        Its first row in the log's recording; the time before calibrates the sensors.
    fix_deg : (latitude, longitude) [deg]
        Where it starts.

    Returns
    -------
    columns : dict of (n,) arrays
        Indicated position, velocity and attitude.
    remarks : list of str

    Raises
    ------
    DataError
        When sensors, attitude or velocity are missing, too slow, or have a gap.
    """
    imu = _readings(log, part)
    check_imu(part.name, imu, float(part.time_s[0]), float(part.time_s[-1]))
    start = _known_motion(part, 0, 1)
    if start is None:
        raise DataError(f"{part.name}: no attitude or velocity at the cut, expected both to start a strapdown INS")
    rec = log.recording
    begin = int(np.searchsorted(rec.time_s, max(imu.time_s[0], part.time_s[0] - CALIBRATION_S)))
    known = _known_motion(rec, begin, first + 1)
    told = ["the inertial sensors could not be calibrated before the cut: their biases are all in the drift"]
    if known is not None and known.time_s[-1] - known.time_s[0] >= LEAST_S:
        biases = imu_biases(imu, known)
        imu = imu.without(biases)
        gyros, accels = _triple(np.degrees(biases[:3])), _triple(biases[3:])
        told = [f"biases taken out, by the time before the cut: gyros {gyros} deg/s, accelerometers {accels} m/s2"]
    start = replace(start, lat_deg=np.array([fix_deg[0]]), lon_deg=np.array([fix_deg[1]]))
    flown = strapdown_of(imu, start, part.time_s, _height(part))
    columns = {"lat_deg": flown.lat_deg, "lon_deg": flown.lon_deg, "alt_m": flown.alt_m}
    columns |= dict(zip(VELOCITY, flown.velocity_mps.T, strict=True))
    return columns | dict(zip(ATTITUDE, flown.attitude_deg.T, strict=True)), told


def _readings(log: Log, part: Recording) -> ImuReadings:
    """The inertial sensors; DataError where the log has none."""
    if "imu" not in log.beside:
        raise DataError(
            f"{part.name}: no inertial sensors are logged in a form that is read (DataFlash IMU, PX4 sensor_combined), "
            "which this way of navigating needs"
        )
    series = log.beside["imu"]
    both = np.stack([series.values[key] for key in IMU], axis=1)
    whole = np.isfinite(both).all(axis=1)
    return ImuReadings(series.time_s[whole], both[whole, :3], both[whole, 3:])


def _known_motion(rec: Recording, first: int, last: int) -> Trajectory | None:
    """Rows first to last where attitude and velocity are logged, None where they never are; no climb where not told."""
    keys = (*ATTITUDE, *VELOCITY[:2])
    if not all(key in rec.columns for key in keys):
        return None
    down = rec.columns.get(VELOCITY[2], np.zeros(len(rec)))
    columns = {key: rec.columns[key][first:last] for key in ("time_s", "lat_deg", "lon_deg", "alt_m", *keys)}
    columns[VELOCITY[2]] = np.nan_to_num(down[first:last])
    there = np.isfinite(np.stack([columns[key] for key in keys])).all(axis=0)
    if not there.any():
        return None
    at = {key: values[there] for key, values in columns.items()}
    velocity, attitude = (np.stack([at[key] for key in names], axis=1) for names in (VELOCITY, ATTITUDE))
    return Trajectory(at["time_s"], at["lat_deg"], at["lon_deg"], at["alt_m"], velocity, attitude)


def _height(part: Recording) -> FloatArray:
    """(n,) what holds the height: the barometer, its gaps bridged, else the indicated altitude [m]."""
    baro = part.columns.get("baro_altitude_m", part.alt_m)
    known = np.isfinite(baro)
    return np.interp(part.time_s, part.time_s[known], baro[known]) if known.any() else part.alt_m


def _triple(values: FloatArray) -> str:
    """Three numbers for people."""
    return ", ".join(f"{value:.3g}" for value in values.tolist())
