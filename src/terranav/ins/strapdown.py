"""What a strapdown INS of a given grade makes of a flight without any aid but its barometer.

Truth -> IMU readings -> errors of the grade -> strapdown integration; both ends by the python-ins package. Drawn per
run: constant gyro and accelerometer biases, white noise of both (angular and velocity random walk), initial errors of
position, velocity, tilt and heading.

The vertical channel of a free INS is unstable (its error grows as cosh(sqrt(2 g / R) t)). It is held by the barometer
in the usual third-order loop, with e = INS height - barometric height:

    height rate -= k1 e,   up velocity rate -= k2 e + s,   s rate = k3 e
    k1 = 3 / tau,  k2 = 3 / tau^2 + 2 g / R,  k3 = 1 / tau^3

a triple pole at -1 / tau, so that a constant accelerometer bias leaves no height error.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.random import Generator
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import CubicHermiteSpline
from scipy.spatial.transform import Rotation, RotationSpline

from terranav.core.checks import finite
from terranav.core.earth import GRAVITY_MPS2, SCHULER_RAD_PER_S, metres_per_degree, shift, wrap_longitude
from terranav.core.errors import ConfigError, DataError
from terranav.core.ins_grade import InsGrade
from terranav.ins.trajectory import Trajectory

FloatArray = NDArray[np.float64]

BARO_LOOP_S = 30.0  # tau: slower than the noise of the barometer, faster than the weather
_HOLD_S = 2.0  # between two corrections of the vertical channel
_GYRO = ["gyro_x", "gyro_y", "gyro_z"]
_ACCEL = ["accel_x", "accel_y", "accel_z"]
_STATE = ["lat", "lon", "alt", "VN", "VE", "VD", "roll", "pitch", "heading"]


def free_inertial(
    truth: Trajectory,
    grade: InsGrade,
    rng: Generator,
    output_rate_hz: float = 1.0,
    *,
    imu_rate_hz: float = 50.0,
    baro_altitude_m: ArrayLike | None = None,
) -> Trajectory:
    """Fly a strapdown INS along a trajectory.

    Parameters
    ----------
    truth : Trajectory
        With at least two samples. Where its samples are not those of the IMU it is interpolated, smoothly in velocity
        and attitude; then its velocity must be the rate of its position.
    grade : InsGrade
        The errors are drawn from its initial sigmas and its inertial-sensor figures; the walks of position and velocity
        that a grade on position level states have no part in an IMU and are left out.
    rng : Generator
    output_rate_hz : float
        Samples a second of what is returned [Hz]; imu_rate_hz must be a whole multiple.
    imu_rate_hz : float
        Samples a second of the IMU [Hz].
    baro_altitude_m : (n,) or None [m]
        Barometric altitude at the truth's times; NaN is no reading, bridged linearly. None is the true altitude.

    Returns
    -------
    Trajectory
        Indicated position, velocity and attitude.

    Raises
    ------
    ConfigError
        For impossible rates.
    DataError
        For a trajectory of one sample, and a barometer of another length or without a reading.
    """
    finite("output_rate_hz", output_rate_hz, above=0.0)
    finite("imu_rate_hz", imu_rate_hz, above=0.0)
    stride = round(imu_rate_hz / output_rate_hz)
    if stride < 1 or not math.isclose(stride * output_rate_hz, imu_rate_hz, rel_tol=1e-9):
        raise ConfigError(
            f"imu_rate_hz is {imu_rate_hz:g}, expected a whole multiple of output_rate_hz ({output_rate_hz:g})"
        )
    if len(truth) < 2:
        raise DataError(f"trajectory has {len(truth)} sample, expected at least two")
    baro = _whole_baro(truth, baro_altitude_m)
    samples = math.floor((truth.time_s[-1] - truth.time_s[0]) * imu_rate_hz * (1.0 + 1e-12) + 1e-9) + 1
    time = truth.time_s[0] + np.arange(samples) / imu_rate_hz
    smooth = _resampled(truth, time)
    states = _integrated(
        _imu(smooth, grade, rng),
        _first_state(smooth, grade, rng),
        np.interp(time, truth.time_s, baro),
        max(1, round(_HOLD_S * imu_rate_hz)),
    )[::stride]
    lat, lon = states[:, 0], wrap_longitude(states[:, 1])
    attitude = np.stack([states[:, 6], states[:, 7], states[:, 8] % 360.0], axis=1)
    return Trajectory(time[::stride], lat, lon, states[:, 2], states[:, 3:6], attitude)


def _whole_baro(truth: Trajectory, baro_altitude_m: ArrayLike | None) -> FloatArray:
    """Barometric altitude (n,) at the truth's times, gaps bridged."""
    if baro_altitude_m is None:
        return truth.alt_m
    baro = np.asarray(baro_altitude_m, dtype=np.float64)
    if baro.shape != truth.time_s.shape:
        raise DataError(f"baro_altitude_m has shape {baro.shape}, expected {truth.time_s.shape} like the trajectory")
    known = np.isfinite(baro)
    if not known.any():
        raise DataError("baro_altitude_m has no reading, expected at least one to hold the vertical channel")
    return np.interp(truth.time_s, truth.time_s[known], baro[known])


def _resampled(truth: Trajectory, time: FloatArray) -> Trajectory:
    """The trajectory at other times; itself where they are its own."""
    if time.size == len(truth) and np.allclose(time, truth.time_s, rtol=0.0, atol=1e-9):
        return truth
    per_lat, per_lon = metres_per_degree(truth.lat_deg)
    north, east, down = truth.velocity_mps.T
    rates = np.stack(
        [
            north / (per_lat + np.radians(truth.alt_m)),
            east / (per_lon + np.radians(truth.alt_m) * np.cos(np.radians(truth.lat_deg))),
            -down,
        ],
        axis=1,
    )
    place = np.stack([truth.lat_deg, np.unwrap(truth.lon_deg, period=360.0), truth.alt_m], axis=1)
    lat, lon, alt = CubicHermiteSpline(truth.time_s, place, rates)(time).T
    velocity = CubicHermiteSpline(
        truth.time_s, truth.velocity_mps, np.gradient(truth.velocity_mps, truth.time_s, axis=0)
    )
    attitude = RotationSpline(truth.time_s, Rotation.from_euler("ZYX", truth.attitude_deg[:, ::-1], degrees=True))
    rph = attitude(time).as_euler("ZYX", degrees=True)[:, ::-1]
    return Trajectory(time, lat, lon, alt, velocity(time), rph)


def _imu(truth: Trajectory, grade: InsGrade, rng: Generator) -> Any:
    """Angle and velocity increments (python-ins DataFrame) of an IMU of this grade."""
    from pyins import sim  # brings numba: only when used

    lla = np.stack([truth.lat_deg, np.unwrap(truth.lon_deg, period=360.0), truth.alt_m], axis=1)
    _, imu = sim.generate_imu(truth.time_s, lla, truth.attitude_deg, truth.velocity_mps, sensor_type="increment")
    dt = truth.time_s[1] - truth.time_s[0]
    deg_per_h, ug = math.radians(1.0) / 3600.0, 1e-6 * GRAVITY_MPS2
    gyro_bias = grade.gyro_bias_sigma_deg_per_h * deg_per_h * rng.standard_normal(3)
    accel_bias = grade.accel_bias_sigma_ug * ug * rng.standard_normal(3)
    gyro_noise = math.radians(grade.gyro_walk_deg_per_sqrt_h) / 60.0 * rng.standard_normal((len(truth), 3))
    accel_noise = grade.accel_walk_mps_per_sqrt_h / 60.0 * rng.standard_normal((len(truth), 3))
    imu[_GYRO] += gyro_bias * dt + gyro_noise * math.sqrt(dt)
    imu[_ACCEL] += accel_bias * dt + accel_noise * math.sqrt(dt)
    return imu


def _first_state(truth: Trajectory, grade: InsGrade, rng: Generator) -> FloatArray:
    """Initial state (9,) as the INS believes it."""
    north, east = grade.position_sigma_m * rng.standard_normal(2)
    velocity = truth.velocity_mps[0] + np.append(grade.velocity_sigma_mps * rng.standard_normal(2), 0.0)
    sigma = np.array([grade.attitude_sigma_deg, grade.attitude_sigma_deg, grade.heading_sigma_deg])
    # about the axes north, east and down, so that tilt is the same whatever the heading
    wrong = Rotation.from_rotvec(sigma * rng.standard_normal(3), degrees=True)
    true = Rotation.from_euler("ZYX", truth.attitude_deg[0, ::-1], degrees=True)
    attitude = (wrong * true).as_euler("ZYX", degrees=True)[::-1]
    lat, lon = shift(truth.lat_deg[0], truth.lon_deg[0], north, east)
    return np.concatenate([[float(lat), float(lon), truth.alt_m[0]], velocity, attitude])


def _integrated(imu: Any, first: FloatArray, baro_m: FloatArray, hold: int) -> FloatArray:
    """States (n, 9) of the strapdown integration, its vertical channel corrected every `hold` samples."""
    import pandas as pd
    from pyins import strapdown

    increments = strapdown.compute_increments_from_imu(imu, "increment")
    dt = float(increments["dt"].iloc[0]) * hold
    k1 = 3.0 / BARO_LOOP_S
    k2 = 3.0 / BARO_LOOP_S**2 + 2.0 * SCHULER_RAD_PER_S**2
    k3 = 1.0 / BARO_LOOP_S**3
    states = np.empty((len(imu), first.size))
    states[0] = first
    states[0, 2] += baro_m[0] - first[2]
    bias = 0.0
    integrator = strapdown.Integrator(pd.Series(states[0], index=_STATE, name=imu.index[0]))
    for start in range(0, len(increments), hold):
        state, excess = states[start].copy(), states[start, 2] - baro_m[start]
        state[2] -= k1 * dt * excess
        state[5] += (k2 * excess + bias) * dt
        bias += k3 * dt * excess
        chunk = increments.iloc[start : start + hold]
        integrator.trajectory = integrator.trajectory.iloc[[-1]]  # what is done lies in `states`
        integrator.set_pva(pd.Series(state, index=_STATE))
        states[start + 1 : start + 1 + len(chunk)] = integrator.integrate(chunk).to_numpy()[1:]
    return states
